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
from pronk.identify.logs.columns import Columns, command_index, import_columns
from pronk.identify.logs.csv_npz_reader import read_rows
from pronk.identify.logs.csv_table import read_text
from pronk.identify.logs.joint_log import JointLog, LogOrigin
from pronk.identify.logs.options import ReadOptions
from pronk.robots.robot import RobotSpec

FILES = ("control.csv", "state_motor.csv", "joint_list.txt")
"""Files that make a folder a SAGE recording; `event.csv` is read if the folder has it."""

SAGE_JOINTS = {
    "Rotation": "shoulder_pan",
    "Pitch": "shoulder_lift",
    "Elbow": "elbow_flex",
    "Wrist_Pitch": "wrist_flex",
    "Wrist_Roll": "wrist_roll",
    "Jaw": "gripper",
}
"""Joint names of the SO-101 by those in SAGE recordings.

The Jaw is on a scale of 0 to 1 whose travel in radians is not recorded, so it is no angle. (Its
encoder moves in steps of 0.00065660, and a step of the servo is 2 pi / 4096: 2.336 rad a unit. Its
velocity column, which is that of an angle, gives 2.33. The recordings state neither, so neither is
assumed.)

Positions are taken as they are: joint position [rad] = +1 * recorded position + 0. The evidence for
the sign: in all four recordings about their pose the three joints that carry weight sit beside
their mean command in the direction in which gravity pulls them in the CAD model, and in proportion:
+.038, +.037, +.010 rad for gravity torques of +.49, +.40, +.10 N m (Pitch, Elbow, Wrist_Pitch; 11
to 13 N m/rad), the other two within .003 rad. No recording determines the sign of Rotation and
Wrist_Roll, which gravity does not load in this pose, nor small zero offsets: these are +1 and 0 by
default, not by measurement. Recorded torques are magnitudes and have no sign.
"""


def is_sage(path: Path) -> bool:
    """Return True if a folder holds a SAGE recording."""
    return path.is_dir() and all((path / name).is_file() for name in FILES)


def read_sage(path: Path, robot: RobotSpec | None, options: ReadOptions) -> JointLog:
    """Read a SAGE folder.

    The command in force at a state is the last one at or before its timestamp. Joints of the
    SO-101 get the names of their robot; the unit of its Jaw stays `unknown` unless a scale is
    given.

    Raises:
        LogError: A file is missing or a row is damaged; the message names it.
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
    sent, controls = _read_lists(path / "control.csv", ("positions",), len(joints))
    time, states = _read_lists(
        path / "state_motor.csv", ("positions", "velocities", "torques"), len(joints)
    )
    steps_back = np.flatnonzero(np.diff(sent) < 0.0)
    if len(steps_back):
        raise LogError(
            f"{path / 'control.csv'}: time goes back in row {steps_back[0] + 3}; sort the file."
        )
    index = command_index(sent, time)
    motion_start, disabled = _events(path / "event.csv")
    before_command = index < 0
    outside_motion = ~before_command & ((time < motion_start) | (time > disabled))
    kept = np.flatnonzero(~before_command & ~outside_motion)
    has_velocity = bool(states["velocities"].any())

    is_so101 = all(name in SAGE_JOINTS for name in joints)
    if robot is not None and robot.name != "so101":
        is_so101 = False
    notes = []
    if is_so101 and "Jaw" in joints:
        notes.append("Jaw is on a scale of its own, not in radians")
    if before_command.any():
        notes.append(f"{before_command.sum()} states before the first command were dropped")
    if outside_motion.any():
        notes.append(
            f"{outside_motion.sum()} states before MOTION_START or after DISABLE were dropped"
        )
    if not has_velocity:
        notes.append("velocities are all zero: not measured")
    hashes = "".join(sha256(path / name) for name in FILES)
    columns = Columns(
        origin=LogOrigin(
            source=str(path),
            sha256=hashlib.sha256(hashes.encode()).hexdigest(),
            metadata={"format": "sage"},
        ),
        joints=joints,
        standard_names={name: SAGE_JOINTS[name] for name in joints} if is_so101 else None,
        robot="so101" if is_so101 else "unknown",
        time=time[kept],
        command=controls["positions"][index[kept]],
        position=states["positions"][kept],
        velocity=states["velocities"][kept] if has_velocity else None,
        torque=states["torques"][kept],
        unit="rad",
        time_unit="us",
        not_angles=("Jaw",) if is_so101 else (),
        row=lambda sample: f"row {int(kept[sample]) + 2} of state_motor.csv",
        notes=tuple(notes),
    )
    return import_columns(columns, robot, options)


def _read_lists(path: Path, names: tuple[str, ...], width: int) -> tuple[Array, dict[str, Array]]:
    """Timestamps of one file, shape (n,), and its list columns by name, shapes (n, width)."""
    header, rows = read_rows(path)
    for name in ("timestamp", *names):
        if name not in header:
            raise LogError(f"{path}: no column {name!r}; the header is {', '.join(header)}.")
    time = np.empty(len(rows))
    arrays = {name: np.empty((len(rows), width)) for name in names}
    for i, row in enumerate(rows):
        try:
            time[i] = float(row[header.index("timestamp")])
            for name in names:
                # JSON, not eval: text of a file must not run.
                numbers = orjson.loads(row[header.index(name)])
                if not isinstance(numbers, list) or len(numbers) != width:
                    raise ValueError
                arrays[name][i] = numbers
        except (ValueError, TypeError):
            raise LogError(
                f"{path}: row {i + 2} is not a timestamp and lists of {width} numbers "
                f"({', '.join(names)}); repair or remove that row."
            ) from None
    return time, arrays


def _events(path: Path) -> tuple[float, float]:
    """When the motion began and when the motors were disabled, in the file's own unit."""
    instants = {"MOTION_START": -np.inf, "DISABLE": np.inf}
    if path.is_file():
        header, rows = read_rows(path)
        for i, row in enumerate(rows):
            cells = dict(zip(header, row, strict=True))
            try:
                instants[cells["event"].strip()] = float(cells["timestamp"])
            except (KeyError, ValueError):
                raise LogError(f"{path}: row {i + 2} holds no event and its timestamp.") from None
    return instants["MOTION_START"], instants["DISABLE"]
