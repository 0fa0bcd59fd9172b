"""Recordings of SAGE (Sim2Real Actuator Gap Estimator): a folder of four files.

`control.csv` holds the commands, `state_motor.csv` what was measured, each row a timestamp in
microseconds and lists written as text in the order of `joint_list.txt`; `event.csv` marks when
the motion began and when the motors were disabled.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import orjson

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.files import sha256
from pronk.identify.logs.columns import Columns, in_force
from pronk.identify.logs.csv_npz_reader import read_rows, read_text
from pronk.robots.robot import RobotSpec

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
"""Names in SAGE recordings to joint names of the SO-101.

Jaw is on a 0 to 1 scale whose travel in radians is not recorded: not an angle. (Its encoder moves
in steps of 0.00065660, and a servo's step is 2 pi / 4096: 2.336 rad a unit; its velocity column,
which is an angle's, gives 2.33. The recordings state neither, so neither is assumed.)

Positions are taken as they are: joint position [rad] = +1 * recorded position + 0. Evidence for +1:
in all four recordings about their pose the three joints that carry weight sit
beside their mean command in the direction gravity pulls them in the [cad] model, and in
proportion: +.038, +.037, +.010 rad for gravity torques of +.49, +.40, +.10 N m (Pitch, Elbow,
Wrist_Pitch; 11 to 13 N m/rad), the other two within .003 rad. No recording determines the sign of
Rotation and Wrist_Roll, which gravity does not load in this pose, nor small zero offsets: those
are +1 and 0 by default, not by measurement. Recorded torques are magnitudes and have no sign."""


def is_sage(path: Path) -> bool:
    """True if a folder holds a SAGE recording."""
    return path.is_dir() and all((path / name).is_file() for name in FILES)


def read_sage(path: Path, *, robot: RobotSpec | None = None) -> Columns:
    """Read a SAGE folder.

    The command in force at a state is the last one at or before its timestamp. Joints of the
    SO-101 get their robot's names; the unit of its Jaw stays `unknown` unless a scale is given.
    """
    for name in FILES:
        if not (path / name).is_file():
            raise LogError(
                f"{path}: no {name}; a SAGE recording is a folder with {', '.join(FILES)}."
            )
    lines = read_text(path / "joint_list.txt").splitlines()
    joints = tuple(line.strip() for line in lines if line.strip())
    if not joints:
        raise LogError(f"{path / 'joint_list.txt'}: no joints; expected one name a line.")
    so101 = all(name in SAGE_JOINTS for name in joints) and (robot is None or robot.name == "so101")
    sent, (wanted,) = _rows(path / "control.csv", ("positions",), len(joints))
    time, (position, velocity, torque) = _rows(
        path / "state_motor.csv", ("positions", "velocities", "torques"), len(joints)
    )
    if (np.diff(sent) < 0.0).any():
        row = int(np.argmax(np.diff(sent) < 0.0)) + 3
        raise LogError(f"{path / 'control.csv'}: time goes back in row {row}; sort the file.")
    index = in_force(sent, time)
    start, stop = _events(path / "event.csv")
    early, outside = index < 0, (index >= 0) & ((time < start) | (time > stop))
    kept = np.flatnonzero(~early & ~outside)
    still = not velocity.any()
    notes = {
        "Jaw is on a scale of its own, not in radians": so101 and "Jaw" in joints,
        f"{early.sum()} states before the first command were dropped": early.any(),
        f"{outside.sum()} states before MOTION_START or after DISABLE were dropped": outside.any(),
        "velocities are all zero: not measured": still,
    }
    return Columns(
        where=str(path),
        joints=joints,
        names={name: SAGE_JOINTS[name] for name in joints} if so101 else None,
        robot="so101" if so101 else "unknown",
        time=time[kept],
        command=wanted[index[kept]],
        position=position[kept],
        velocity=None if still else velocity[kept],
        torque=torque[kept],
        unit="rad",
        time_unit="us",
        no_angles=("Jaw",) if so101 else (),
        row=lambda i: f"row {int(kept[i]) + 2} of state_motor.csv",
        notes=tuple(note for note, applies in notes.items() if applies),
        sha256=hashlib.sha256("".join(sha256(path / f) for f in FILES).encode()).hexdigest(),
        metadata={"format": "sage"},
    )


def _rows(path: Path, lists: tuple[str, ...], width: int) -> tuple[Array, Array]:
    """Timestamps and list columns of one file, shapes (n,) and (lists, n, width)."""
    header, rows = read_rows(path)
    names = ("timestamp", *lists)
    if missing := [name for name in names if name not in header]:
        raise LogError(f"{path}: no column {missing[0]!r}; the header is {', '.join(header)}.")
    columns = [header.index(name) for name in names]
    time, values = np.empty(len(rows)), np.empty((len(lists), len(rows), width))
    for i, row in enumerate(rows):
        stamp, *cells = (row[column] for column in columns)
        try:
            time[i] = float(stamp)
            # JSON, not eval: text of a file must not run.
            for k, cell in enumerate(cells):
                numbers = orjson.loads(cell)
                if not isinstance(numbers, list) or len(numbers) != width:
                    raise ValueError
                values[k, i] = numbers
        except (ValueError, TypeError):
            raise LogError(
                f"{path}: row {i + 2} is not a timestamp and lists of {width} numbers "
                f"({', '.join(lists)}); repair or remove that row."
            ) from None
    return time, values


def _events(path: Path) -> tuple[float, float]:
    """When the motion began and when the motors were disabled, in the file's own unit."""
    found = {"MOTION_START": -np.inf, "DISABLE": np.inf}
    header, rows = read_rows(path) if path.is_file() else ([], [])
    for i, row in enumerate(rows):
        cells = dict(zip(header, row, strict=True))
        try:
            found[cells["event"].strip()] = float(cells["timestamp"])
        except (KeyError, ValueError):
            raise LogError(f"{path}: row {i + 2} holds no event and its timestamp.") from None
    return found["MOTION_START"], found["DISABLE"]
