"""CSV with one column per joint and quantity; NPZ with arrays by name, no pickle."""

from __future__ import annotations

import csv
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.errors import LogError, printable
from pronk.files import check_archive, check_size, sha256
from pronk.identify.logs.columns import Columns, import_columns
from pronk.identify.logs.csv_table import MAX_COLUMNS, CsvTable, read_table, read_text
from pronk.identify.logs.joint_log import JointLog, LogOrigin
from pronk.identify.logs.options import NeedsOptionsError, ReadOptions
from pronk.robots.robot import RobotSpec

QUANTITIES = ("command", "position", "velocity", "torque")
"""Quantities of a joint: beginnings of column names, and names of arrays."""
_CELL_BYTES = 64
"""Memory that a cell of a CSV file takes, about [bytes]."""


def read_rows(path: Path) -> tuple[list[str], list[list[str]]]:
    """Read the header and the rows of a CSV file, all of the same length.

    The delimiter is the comma, semicolon or tab, whichever the header has most of.

    Raises:
        LogError: The file is no table, or a row, which the message names, has another length.
    """
    text = read_text(path)
    first_line = text.split("\n", 1)[0]
    delimiter = max(",;\t", key=first_line.count)
    cells = text.count(delimiter) + text.count("\n")
    check_size(path, _CELL_BYTES * cells, LogError)
    try:
        rows = [row for row in csv.reader(text.splitlines(), delimiter=delimiter) if row]
    except csv.Error as error:
        raise LogError(f"{path}: not CSV ({' '.join(str(error).split())}).") from None
    if len(rows) < 2:
        raise LogError(f"{path}: {len(rows)} rows; expected a header and samples below it.")
    header = [name.strip() for name in rows[0]]
    if len(header) > MAX_COLUMNS:
        raise LogError(f"{path}: {len(header)} columns; expected {MAX_COLUMNS} at most.")
    for i, row in enumerate(rows[1:]):
        if len(row) != len(header):
            raise LogError(
                f"{path}: row {i + 2} has {len(row)} cells and the header {len(header)}; repair or "
                "remove that row."
            )
    return header, rows[1:]


def read_csv(path: Path, robot: RobotSpec | None, options: ReadOptions) -> JointLog:
    """Read a CSV file; `csv_table` says which forms of it are read.

    Columns are called `time`, `command.JOINT`, `position.JOINT`, and optionally `velocity.JOINT`
    [angle/s] and `torque.JOINT` [N m]; with torques, commands need not be there. A file with other
    names is read by `options.columns`, for instance
    `{"time": "t", "position.FR_knee": "q3", "command.FR_knee": "q3_des"}`, and one without a header
    by the numbers of its columns, from 0, as in `{"time": "0", "position.FR_knee": "2"}`.

    Raises:
        LogError: Columns are missing or a cell is no number; the message names columns and row.
    """
    table = read_table(path)
    names = _column_names(table, robot, options)
    joints = []
    for name in names:
        quantity, _, joint = name.partition(".")
        if quantity == "position":
            joints.append(joint)
    has_torque = all(f"torque.{joint}" in names for joint in joints)
    has_command = any(name.startswith("command.") for name in names)
    needed = ["time"]
    if not joints:
        needed.append("position.JOINT")
    if has_command or not has_torque:
        for joint in joints:
            needed.append(f"command.{joint}")
    missing = [name for name in needed if name not in names]
    if missing:
        example = ",".join(
            f"{name}={k if not table.header else 'NAME'}" for k, name in enumerate(missing)
        )
        raise NeedsOptionsError(
            path,
            f"no column called {', '.join(missing)}; {table.names}; say which they are with "
            f"--columns {example} (a name, or the number of a column from 0)",
        )
    indices: dict[str, int] = {}
    absent = []
    for name, file_name in names.items():
        index = table.index(file_name)
        if index is None:
            absent.append(f"{file_name!r} (for {name})")
        else:
            indices[name] = index
    if absent:
        raise NeedsOptionsError(
            path,
            f"no column called {', '.join(absent)}; {table.names}, and the columns have the "
            f"numbers 0 to {table.width - 1}",
        )
    arrays: dict[str, Array] = {}
    for quantity in QUANTITIES:
        column_names = [f"{quantity}.{joint}" for joint in joints]
        if names.keys() >= set(column_names):
            columns = [table.numbers(indices[name]) for name in column_names]
            arrays[quantity] = np.stack(columns, axis=1)
    time, is_date = table.timestamps(indices["time"])
    if is_date and options.time_unit not in (None, "s"):
        raise LogError(
            f"{path}: --time-unit {options.time_unit}, but the times are dates or times of day; "
            "leave the option out."
        )
    columns_of_file = Columns(
        origin=LogOrigin(source=str(path), sha256=sha256(path)),
        joints=tuple(joints),
        time=time,
        command=arrays.get("command"),
        position=arrays["position"],
        velocity=arrays.get("velocity"),
        torque=arrays.get("torque"),
        row=lambda sample: f"row {table.lines[sample]}",
        notes=table.notes,
    )
    return import_columns(columns_of_file, robot, options)


def _column_names(table: CsvTable, robot: RobotSpec | None, options: ReadOptions) -> dict[str, str]:
    """Names of the columns in the file by those of pronk: stated ones, or their own."""
    stated = options.columns or {}
    if not isinstance(stated, Mapping):
        stated = _columns_of_one_joint(table.path, stated, robot, options)
    for name in stated:
        if not _is_column_name(name):
            raise LogError(
                f"{table.path}: --columns names {name!r}; expected time, or a quantity and a "
                f"joint, for instance position.FR_knee (quantities: {', '.join(QUANTITIES)})."
            )
    names = {}
    for name in table.header:
        if _is_column_name(name) and name not in stated.values():
            names[name] = name
    names.update(stated)
    return names


def _columns_of_one_joint(
    path: Path, columns: Sequence[str], robot: RobotSpec | None, options: ReadOptions
) -> dict[str, str]:
    """Names by those of pronk for columns that are given in the order time, command, position."""
    order = options.joint_order
    joints = list(robot.joint_names) if robot is not None else ["joint"]
    if order not in (None, "default"):
        joints = order.split(",") if isinstance(order, str) else list(order or ())
    if len(columns) != 3 or len(joints) != 1:
        example = ",".join(f"position.{joint}=NAME" for joint in joints[:2])
        raise LogError(
            f"{path}: --columns {','.join(columns)} without names; expected the three columns "
            "time, command and position of one joint, which --joint-order NAME names; otherwise "
            f"name each of them, as in --columns time=NAME,command.{joints[0]}=NAME,{example}."
        )
    return {
        "time": columns[0],
        f"command.{joints[0]}": columns[1],
        f"position.{joints[0]}": columns[2],
    }


def _is_column_name(name: str) -> bool:
    """Return True for `time`, and for a quantity and a joint with a dot between them."""
    quantity, _, joint = name.partition(".")
    return name == "time" or (quantity in QUANTITIES and bool(joint))


def read_npz(path: Path, robot: RobotSpec | None, options: ReadOptions) -> JointLog:
    """Read the arrays `time` (n,), `command` and `position` (n, joints).

    `velocity`, `torque` and `joints` (the names) are read where they are there; with `torque`, a
    `command` need not be.

    Raises:
        LogError: An array is missing, or is no array of numbers.
    """
    arrays, names_in_file = _load_arrays(path)
    needed = ["time", "position"]
    if "torque" not in arrays:
        needed.append("command")
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise LogError(
            f"{path}: no array {', '.join(missing)}; it holds {', '.join(names_in_file) or 'none'}."
        )
    numbers_in_file = sum(array.size for array in arrays.values())
    check_size(path, 8 * numbers_in_file, LogError)
    joints = _text(path, arrays.pop("joints", np.empty(0, dtype=str)))
    numbers: dict[str, Array] = {}
    for name, array in arrays.items():
        try:
            numbers[name] = np.asarray(array, dtype=np.float64)
        except (TypeError, ValueError):
            raise LogError(f"{path}: the array {name} does not hold numbers.") from None
    time = numbers.pop("time")
    for name, values in numbers.items():
        if time.ndim != 1 or values.shape[:1] != time.shape:
            raise LogError(
                f"{path}: time has shape {time.shape} and {name} {values.shape}; expected (n,) and "
                "(n, joints)."
            )
        if len(time):
            numbers[name] = values.reshape(len(time), -1)
    notes = []
    unread = [name for name in names_in_file if name not in ("time", *QUANTITIES, "joints")]
    if unread:
        notes.append(f"arrays that are not read: {printable(', '.join(unread)[:200])}")
    columns = Columns(
        origin=LogOrigin(source=str(path), sha256=sha256(path)),
        joints=joints,
        time=time,
        command=numbers.get("command"),
        position=numbers["position"],
        velocity=numbers.get("velocity"),
        torque=numbers.get("torque"),
        notes=tuple(notes),
    )
    return import_columns(columns, robot, options)


def _load_arrays(path: Path) -> tuple[dict[str, NDArray[np.generic]], list[str]]:
    """Load the arrays that a log has, and the names of all that the file holds."""
    arrays = {}
    try:
        check_archive(path, LogError)
        with np.load(path, allow_pickle=False) as stored:
            names = list(stored.files)
            for name in ("time", *QUANTITIES, "joints"):
                if name in names:
                    arrays[name] = np.asarray(stored[name])
    except LogError:
        raise
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise LogError(f"{path}: cannot be read ({reason}).") from None
    except Exception as error:
        # zipfile, zlib and the npy parser fail in many ways on a damaged file.
        reason = f"{type(error).__name__}: {error}"[:120]
        raise LogError(f"{path}: not a readable NPZ file ({reason}).") from error
    return arrays, names


def _text(path: Path, array: NDArray[np.generic]) -> tuple[str, ...]:
    """Names in an array of text."""
    if array.size > MAX_COLUMNS:
        raise LogError(f"{path}: {array.size} joints; expected {MAX_COLUMNS} at most.")
    try:
        names = np.ascontiguousarray(array.reshape(-1), dtype=str)
    except (TypeError, ValueError):
        raise LogError(f"{path}: its joints are no text.") from None
    # NumPy takes numbers beyond Unicode for characters; Python then fails anywhere.
    if names.size and (names.view(np.uint32) > sys.maxunicode).any():
        raise LogError(f"{path}: its joints are no text.")
    return tuple(str(name) for name in names)
