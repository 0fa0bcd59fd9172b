"""Recordings of SAGE (Sim2Real Actuator Gap Estimator): a folder of four files.

`control.csv` holds the commands, `state_motor.csv` what was measured, each row a timestamp in
microseconds and lists written as text in the order of `joint_list.txt`; `event.csv` marks when
the motion began and when the motors were disabled.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import orjson
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.files import sha256
from pronk.logs.columns import Columns, Names, import_columns
from pronk.logs.csv_reader import read_rows, read_text
from pronk.logs.joint_log import JointLog
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

FILES = ("control.csv", "state_motor.csv", "joint_list.txt")
"""What makes a folder a SAGE recording; `event.csv` is read where it is there."""

SAGE_JOINTS = {
    "Rotation": "shoulder_pan",
    "Pitch": "shoulder_lift",
    "Elbow": "elbow_flex",
    "Wrist_Pitch": "wrist_flex",
    "Wrist_Roll": "wrist_roll",
    "Jaw": "gripper",
}
"""Names in [sage] recordings to joint names of the SO-101."""
SAGE_UNITS = {name: "unknown" if name == "Jaw" else "rad" for name in SAGE_JOINTS}
"""Jaw is on a 0 to 1 scale whose travel in radians is not recorded: not an angle."""
SAGE_MAPPING = {name: (1.0, 0.0) for name in SAGE_JOINTS if name != "Jaw"}
"""(sign, offset): joint position [rad] = sign * recorded position + offset.

Evidence for +1: in all four recordings about their pose the three joints that carry weight sit
beside their mean command in the direction gravity pulls them in the [cad] model, and in
proportion: +.038, +.037, +.010 rad for gravity torques of +.49, +.40, +.10 N m (Pitch, Elbow,
Wrist_Pitch; 11 to 13 N m/rad), the other two within .003 rad. No recording determines the sign of
Rotation and Wrist_Roll, which gravity does not load in this pose, nor small zero offsets: those
are +1 and 0 by default, not by measurement. Recorded torques are magnitudes and have no sign."""


def is_sage(path: Path) -> bool:
    """True if a folder holds a SAGE recording."""
    return path.is_dir() and all((path / name).is_file() for name in FILES)


def read_sage(
    path: Path,
    *,
    robot: Robot | None = None,
    joint_names: Names | None = None,
    unit: str = "rad",
    time_unit: str = "us",
    rate_hz: float | None = None,
    drop_duplicates: bool = False,
    scale: Mapping[str, float] | None = None,
) -> JointLog:
    """Read a SAGE folder.

    The command in force at a state is the last one at or before its timestamp. The joints of the
    SO-101 get their robot's names; its Jaw is on a 0 to 1 scale, not an angle, so its unit stays
    `unknown` unless a scale is given. (In the published recordings the Jaw's encoder moves in steps
    of 0.00065660, and a servo's step is 2 pi / 4096: 2.336 rad a unit. Its velocity column, which
    is an angle's, says 2.33. Neither is stated anywhere, so neither is assumed.)

    Args:
        path: The folder.
        robot: The robot; the SO-101 is recognized by itself.
        joint_names: Names to give the joints.
        unit: Unit of the angles; SAGE writes radians.
        time_unit: Unit of the timestamps; SAGE writes microseconds.
        rate_hz: Rate that the recording is claimed to have.
        drop_duplicates: Drop rows that repeat the one before in full.
        scale: Radians per unit of joints whose unit is unknown, by joint name.

    Raises:
        LogError: A file is missing or cannot be believed; the message names file and row.
        RobotError: The robot has no such joint.
    """
    for name in FILES:
        if not (path / name).is_file():
            raise LogError(
                f"{path}: no {name}; a SAGE recording is a folder with {', '.join(FILES)}."
            )
    joints = tuple(line.strip() for line in read_text(path / "joint_list.txt").splitlines())
    joints = tuple(name for name in joints if name)
    if not joints:
        raise LogError(f"{path / 'joint_list.txt'}: no joints; expected one name a line.")
    so101 = all(name in SAGE_JOINTS for name in joints) and (robot is None or robot.name == "so101")
    units: tuple[str, ...] = ()
    notes = []
    if so101:
        units = tuple(SAGE_UNITS[name] for name in joints)
        for name in joints:
            if SAGE_UNITS[name] != "rad":
                notes.append(f"{name} is on a scale of its own, not in radians")
        if joint_names is None:
            joint_names = {name: SAGE_JOINTS[name] for name in joints}
    sent, (wanted,) = _rows(path / "control.csv", ("positions",), len(joints))
    time, (position, velocity, torque) = _rows(
        path / "state_motor.csv", ("positions", "velocities", "torques"), len(joints)
    )
    if len(sent) and (np.diff(sent) < 0.0).any():
        row = int(np.argmax(np.diff(sent) < 0.0)) + 3
        raise LogError(f"{path / 'control.csv'}: time goes back in row {row}; sort the file.")
    index = np.searchsorted(sent, time, side="right") - 1
    inside = index >= 0
    if early := int((~inside).sum()):
        notes.append(f"{early} states before the first command were dropped")
    start, stop = _events(path / "event.csv")
    outside = inside & ((time < start) | (time > stop))
    if late := int(outside.sum()):
        inside &= ~outside
        notes.append(f"{late} states before MOTION_START or after DISABLE were dropped")
    kept = np.flatnonzero(inside)
    still = not velocity.any()
    if still:
        notes.append("velocities are all zero: not measured")
    return import_columns(
        Columns(
            where=str(path),
            joints=joints,
            time=time[inside],
            command=wanted[index[inside]],
            position=position[inside],
            velocity=None if still else velocity[inside],
            torque=torque[inside],
            units=units,
            row=lambda i: f"row {int(kept[i]) + 2} of state_motor.csv",
            notes=tuple(notes),
            sha256=hashlib.sha256("".join(sha256(path / f) for f in FILES).encode()).hexdigest(),
            metadata={"format": "sage"},
        ),
        robot=robot,
        robot_name="so101" if so101 else "unknown",
        unit=unit,
        time_unit=time_unit,
        joint_names=joint_names,
        rate_hz=rate_hz,
        drop_duplicates=drop_duplicates,
        scale=scale,
    )


def _rows(path: Path, lists: tuple[str, ...], width: int) -> tuple[Array, list[Array]]:
    """Timestamps and list columns of one file, shapes (n,) and (n, width) each."""
    header, rows = read_rows(path)
    for name in ("timestamp", *lists):
        if name not in header:
            raise LogError(f"{path}: no column {name!r}; the header is {', '.join(header)}.")
    stamp = header.index("timestamp")
    columns = [header.index(name) for name in lists]
    time = np.empty(len(rows))
    values = np.empty((len(lists), len(rows), width))
    for i, row in enumerate(rows):
        try:
            time[i] = float(row[stamp])
            for k, column in enumerate(columns):
                # JSON, not eval: text from elsewhere must not run.
                numbers = orjson.loads(row[column])
                if not isinstance(numbers, list) or len(numbers) != width:
                    raise ValueError
                values[k, i] = numbers
        except (ValueError, TypeError):
            raise LogError(
                f"{path}: row {i + 2} is not a timestamp and lists of {width} numbers "
                f"({', '.join(lists)}); repair or remove that row."
            ) from None
    return time, list(values)


def _events(path: Path) -> tuple[float, float]:
    """When the motion began and when the motors were disabled, in the file's own unit."""
    start, stop = -np.inf, np.inf
    if not path.is_file():
        return start, stop
    header, rows = read_rows(path)
    for name in ("timestamp", "event"):
        if name not in header:
            raise LogError(f"{path}: no column {name!r}; the header is {', '.join(header)}.")
    for i, row in enumerate(rows):
        try:
            time = float(row[header.index("timestamp")])
        except ValueError:
            raise LogError(f"{path}: row {i + 2} holds no timestamp.") from None
        event = row[header.index("event")].strip()
        if event == "MOTION_START":
            start = time
        elif event == "DISABLE":
            stop = time
    return start, stop
