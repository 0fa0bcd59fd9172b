"""CSV with one column per joint and quantity; NPZ with arrays by name, no pickle."""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pronk.arrays import Array
from pronk.errors import LogError, printable
from pronk.files import check_archive, check_size, sha256
from pronk.identify.logs.columns import Columns
from pronk.robots.robot import RobotSpec

QUANTITIES = ("command", "position", "velocity", "torque")
_MOST_COLUMNS = 4096
_CELL_BYTES = 64
"""What a cell of a CSV file takes in memory, about [bytes]."""


def read_text(path: Path) -> str:
    """Read a text file, UTF-8 with or without byte order mark."""
    try:
        check_size(path, path.stat().st_size, LogError)
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except UnicodeDecodeError as error:
        raise LogError(f"{path}: not text (byte {error.start} is not UTF-8).") from None


def read_rows(path: Path) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a CSV file; comma, semicolon or tab, whichever the header has most of.

    A LogError names a row of another length.
    """
    text = read_text(path)
    delimiter = max(",;\t", key=text.split("\n", 1)[0].count)
    check_size(path, _CELL_BYTES * (text.count(delimiter) + text.count("\n")), LogError)
    try:
        rows = [row for row in csv.reader(text.splitlines(), delimiter=delimiter) if row]
    except csv.Error as error:
        raise LogError(f"{path}: not CSV ({' '.join(str(error).split())}).") from None
    if len(rows) < 2:
        raise LogError(f"{path}: {len(rows)} rows; expected a header and samples below it.")
    header = [name.strip() for name in rows[0]]
    if len(header) > _MOST_COLUMNS:
        raise LogError(f"{path}: {len(header)} columns; expected {_MOST_COLUMNS} at most.")
    for i, row in enumerate(rows[1:]):
        if len(row) != len(header):
            raise LogError(
                f"{path}: row {i + 2} has {len(row)} cells and the header {len(header)}; repair or "
                "remove that row."
            )
    return header, rows[1:]


def read_csv(
    path: Path, *, robot: RobotSpec | None = None, columns: Mapping[str, str] | None = None
) -> Columns:
    """Read a CSV file; a LogError names the column and row where something is missing.

    Columns are called `time`, `command.JOINT`, `position.JOINT`, and optionally `velocity.JOINT`
    [angle/s] and `torque.JOINT` [N m]; with torques, commands need not be there. `columns` gives
    the file's own name for each of them, for instance
    `{"time": "t", "position.FR_knee": "q3", "command.FR_knee": "q3_des"}`.
    """
    header, rows = read_rows(path)
    given, listed = dict(columns or {}), ", ".join(header)
    names = {name: name for name in header if _is_ours(name) and name not in given.values()}
    names |= given
    if wrong := [name for name in given if not _is_ours(name)]:
        raise LogError(
            f"{path}: --columns names {wrong[0]!r}; expected time, or a quantity and a joint, for "
            f"instance position.FR_knee (quantities: {', '.join(QUANTITIES)})."
        )
    joints = tuple(name.partition(".")[2] for name in names if name.startswith("position."))
    by_torque = all(f"torque.{joint}" in names for joint in joints)
    commanded = [name for name in names if name.startswith("command.")]
    needed = ["time", *(f"command.{joint}" for joint in joints if commanded or not by_torque)]
    missing = [name for name in needed if name not in names] or ["position.JOINT"] * (not joints)
    if missing:
        raise LogError(
            f"{path}: no column called {', '.join(missing)}; the header is {listed}; "
            f"say which it is with --columns {missing[0]}=NAME."
        )
    for name, theirs in names.items():
        if header.count(theirs) != 1:
            many = "several columns" if theirs in header else "no column"
            raise LogError(f"{path}: {many} called {theirs!r} (for {name}); it has {listed}.")

    def numbers(name: str) -> Array:
        index = header.index(names[name])
        values = np.array([_number(row[index]) for row in rows])
        if len(wrong := np.flatnonzero(~np.isfinite(values))):
            raise LogError(
                f"{path}: row {wrong[0] + 2} holds {rows[wrong[0]][index][:40]!r} in column "
                f"{names[name]!r}; expected a finite number; repair or remove that row."
            )
        return values

    found = {
        quantity: np.stack([numbers(f"{quantity}.{joint}") for joint in joints], axis=1)
        for quantity in QUANTITIES
        if all(f"{quantity}.{joint}" in names for joint in joints)
    }
    return Columns(
        where=str(path),
        joints=joints,
        time=numbers("time"),
        row=lambda i: f"row {i + 2}",
        sha256=sha256(path),
        **found,  # type: ignore[arg-type]
    )


def read_npz(path: Path, *, robot: RobotSpec | None = None) -> Columns:
    """Read the arrays `time` (n,), `command` and `position` (n, joints).

    `velocity`, `torque` and `joints` (the names) are read where they are there; with `torque`, a
    `command` need not be.
    """
    try:
        check_archive(path, LogError)
        with np.load(path, allow_pickle=False) as stored:
            others, known = stored.files, ("time", *QUANTITIES, "joints")
            arrays = {name: np.asarray(stored[name]) for name in known if name in others}
    except LogError:
        raise
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise LogError(f"{path}: cannot be read ({reason}).") from None
    except Exception as error:
        # zipfile, zlib and the npy parser fail in many ways on a damaged file.
        reason = f"{type(error).__name__}: {error}"[:120]
        raise LogError(f"{path}: not a readable NPZ file ({reason}).") from error
    extra = ", ".join(name for name in others if name not in arrays)
    needed = ("time", "position", *["command"] * ("torque" not in arrays))
    if missing := [name for name in needed if name not in arrays]:
        raise LogError(
            f"{path}: no array {', '.join(missing)}; it holds {', '.join(others) or 'none'}."
        )
    check_size(path, sum(8 * array.size for array in arrays.values()), LogError)
    names = arrays.pop("joints", np.empty(0, dtype=str)).reshape(-1)
    if len(names) > _MOST_COLUMNS:
        raise LogError(f"{path}: {len(names)} joints; expected {_MOST_COLUMNS} at most.")
    try:
        found = {name: np.asarray(array, dtype=np.float64) for name, array in arrays.items()}
        names = np.ascontiguousarray(names, dtype=str)
        # NumPy takes numbers beyond Unicode for characters; Python then fails anywhere.
        if names.size and (names.view(np.uint32) > sys.maxunicode).any():
            raise ValueError
    except (TypeError, ValueError):
        raise LogError(f"{path}: its arrays are not numbers, or its joints no text.") from None
    time = found.pop("time")
    for name, values in found.items():
        if time.ndim != 1 or values.shape[:1] != time.shape:
            raise LogError(
                f"{path}: time has shape {time.shape} and {name} {values.shape}; expected (n,) and "
                "(n, joints)."
            )
        found[name] = values.reshape(len(time), -1) if len(time) else values
    return Columns(
        where=str(path),
        joints=tuple(map(str, names)),
        notes=(f"arrays that are not read: {printable(extra[:200])}",) if extra else (),
        time=time,
        sha256=sha256(path),
        **found,  # type: ignore[arg-type]
    )


def _is_ours(name: str) -> bool:
    kind, _, joint = name.partition(".")
    return name == "time" or (kind in QUANTITIES and bool(joint))


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan
