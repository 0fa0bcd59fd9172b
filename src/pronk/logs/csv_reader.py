"""CSV with one column per joint and quantity."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.files import sha256, write_text
from pronk.logs.columns import Columns, import_columns
from pronk.logs.joint_log import JointLog
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

QUANTITIES = ("command", "position", "velocity", "torque")
MOST_BYTES = 2**30
"""Largest file that is read [bytes]."""


def read_text(path: Path) -> str:
    """A text file, UTF-8 with or without byte order mark.

    Raises:
        LogError: Missing, too large, or not text.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise LogError(f"{path}: larger than {MOST_BYTES >> 20} MiB; split the recording.")
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise LogError(f"{path}: no such file.") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except UnicodeDecodeError as error:
        raise LogError(f"{path}: not text (byte {error.start} is not UTF-8).") from None


def read_rows(path: Path) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a CSV file; comma, semicolon or tab, whichever the header has most of.

    Raises:
        LogError: No header and rows, or a row of another length; the message names the row.
    """
    text = read_text(path)
    first = text.split("\n", 1)[0]
    delimiter = max(",;\t", key=first.count)
    try:
        rows = [row for row in csv.reader(text.splitlines(), delimiter=delimiter) if row]
    except csv.Error as error:
        raise LogError(f"{path}: not CSV ({' '.join(str(error).split())}).") from None
    if len(rows) < 2:
        raise LogError(f"{path}: {len(rows)} rows; expected a header and samples below it.")
    header = [name.strip() for name in rows[0]]
    for i, row in enumerate(rows[1:]):
        if len(row) != len(header):
            raise LogError(
                f"{path}: row {i + 2} has {len(row)} cells and the header {len(header)}; repair or "
                "remove that row."
            )
    return header, rows[1:]


def read_csv(
    path: Path,
    *,
    robot: Robot | None = None,
    unit: str | None = None,
    columns: Mapping[str, str] | None = None,
    time_unit: str = "s",
    rate_hz: float | None = None,
    drop_duplicates: bool = False,
) -> JointLog:
    """Read a CSV file.

    Columns are called `time`, `command.JOINT`, `position.JOINT`, and if there are any
    `velocity.JOINT` and `torque.JOINT`; `columns` tells which columns are meant where they have
    other names. A velocity is in the unit of the angles per second, torque in N m.

    Args:
        path: The file.
        robot: The robot, to check the joint names against.
        unit: Unit of all angles, `rad` or `deg`. It must be said.
        columns: The file's name for each of ours, for instance `{"time": "t",
            "position.FR_knee": "q3", "command.FR_knee": "q3_des"}`.
        time_unit: Unit of the time column.
        rate_hz: Rate that the file is claimed to have.
        drop_duplicates: Drop rows that repeat the one before in full.

    Raises:
        LogError: Something is missing or cannot be believed; the message names column and row.
        RobotError: The robot has no such joint.
    """
    if unit is None:
        raise LogError(
            f"{path}: a CSV file does not say whether its angles are radians or degrees; give "
            "unit='rad' or unit='deg'."
        )
    header, rows = read_rows(path)
    where = dict(columns or {})
    for name in where:
        kind, _, joint = name.partition(".")
        if name != "time" and not (kind in QUANTITIES and joint):
            raise LogError(
                f"{path}: columns names {name!r}; expected time, or a quantity and a joint, for "
                f"instance position.FR_knee (quantities: {', '.join(QUANTITIES)})."
            )
    for name in header:
        kind, _, joint = name.partition(".")
        if name not in where and name not in where.values():
            if kind in QUANTITIES and joint:
                where[name] = name
            elif name == "time":
                where["time"] = name
    listed = ", ".join(header)
    for ours, theirs in where.items():
        if header.count(theirs) != 1:
            many = "several columns" if theirs in header else "no column"
            raise LogError(
                f"{path}: {many} called {theirs!r} (wanted for {ours}); the header is {listed}."
            )
    if "time" not in where:
        raise LogError(
            f"{path}: no column called 'time'; the header is {listed}; say which it is with "
            "columns={'time': ...}."
        )
    joints = tuple(
        dict.fromkeys(name.partition(".")[2] for name in where if name.startswith("position."))
    )
    if not joints:
        raise LogError(
            f"{path}: no column called 'position.JOINT'; the header is {listed}; say which they "
            "are with columns={'position.JOINT': ..., 'command.JOINT': ...}."
        )

    def matrix(quantity: str) -> Array:
        return np.stack(
            [_numbers(path, header, rows, where[f"{quantity}.{joint}"]) for joint in joints], axis=1
        )

    def there(quantity: str) -> bool:
        return all(f"{quantity}.{joint}" in where for joint in joints)

    if missing := [joint for joint in joints if f"command.{joint}" not in where]:
        raise LogError(
            f"{path}: no column for the command of {', '.join(missing)}; the header is {listed}; "
            "say which it is with columns={'command.JOINT': ...}."
        )
    return import_columns(
        Columns(
            where=str(path),
            joints=joints,
            time=_numbers(path, header, rows, where["time"]),
            command=matrix("command"),
            position=matrix("position"),
            velocity=matrix("velocity") if there("velocity") else None,
            torque=matrix("torque") if there("torque") else None,
            row=lambda i: f"row {i + 2}",
            sha256=sha256(path),
        ),
        robot=robot,
        unit=unit,
        time_unit=time_unit,
        rate_hz=rate_hz,
        drop_duplicates=drop_duplicates,
    )


def _numbers(path: Path, header: list[str], rows: list[list[str]], name: str) -> Array:
    """One column as numbers, shape (n,)."""
    index = header.index(name)
    cells = [row[index] for row in rows]
    try:
        values = np.array(cells, dtype=np.float64)
    except ValueError:
        values = np.full(len(cells), np.nan)
        for i, cell in enumerate(cells):
            try:
                values[i] = float(cell)
            except ValueError:
                break
    if not np.isfinite(values).all():
        i = int(np.argmin(np.isfinite(values)))
        raise LogError(
            f"{path}: row {i + 2} holds {cells[i][:40]!r} in column {name!r}; expected a finite "
            "number; repair or remove that row."
        )
    return values


def write_csv(path: Path, log: JointLog) -> None:
    """Write the columns of a log as `read_csv` reads them (unit='rad'), whole or not at all."""
    names, values = ["time"], [log.time[:, None]]
    for quantity in QUANTITIES:
        matrix = getattr(log, quantity)
        if matrix is not None:
            names += [f"{quantity}.{joint}" for joint in log.joints]
            values.append(matrix)
    rows = np.hstack(values).tolist()
    lines = [",".join(names), *(",".join(map(repr, row)) for row in rows)]
    write_text(path, "\n".join(lines) + "\n")
