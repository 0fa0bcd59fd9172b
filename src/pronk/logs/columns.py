"""What every importer does with the columns it found: check them, and make a JointLog of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.logs.correlation import correlation_note
from pronk.logs.joint_log import JointLog, Segment
from pronk.logs.timing import TIME_UNITS, check_claim, check_increasing, check_unit, examine
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

UNITS = {"rad": 1.0, "deg": np.pi / 180.0}
"""Radians in each unit of angle."""

_EPOCH_S = 1e6
"""Clocks that begin later than this count from an epoch, and are made to begin at zero [s]."""

Names = Mapping[str, str] | Sequence[str]
"""Joint names: new ones by the file's own, or all of them in the order of the columns."""


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Columns of a foreign file, as they stand there. Shapes (n,) and (n, joints)."""

    where: str
    """File, for messages."""
    joints: tuple[str, ...]
    time: Array
    command: Array
    position: Array
    velocity: Array | None = None
    torque: Array | None = None
    units: tuple[str, ...] = ()
    """Unit of each joint, where the format says that one is not an angle."""
    row: Callable[[int], str] = "sample {}".format
    """Names a sample as the user finds it in the file."""
    notes: tuple[str, ...] = ()
    sha256: str = ""
    metadata: dict[str, str] = field(default_factory=dict)


def import_columns(
    columns: Columns,
    *,
    robot: Robot | None,
    robot_name: str = "unknown",
    unit: str,
    time_unit: str,
    joint_names: Names | None = None,
    rate_hz: float | None = None,
    drop_duplicates: bool = False,
    scale: Mapping[str, float] | None = None,
) -> JointLog:
    """Check columns of a foreign file and make a log of them.

    Args:
        columns: What was read.
        robot: The robot, if it was named.
        robot_name: Its name otherwise.
        unit: Unit of angles in the file, `rad` or `deg`.
        time_unit: Unit of the timestamps, one of `TIME_UNITS`.
        joint_names: Names to give the joints.
        rate_hz: Rate that the file is claimed to have.
        drop_duplicates: Drop rows that repeat the one before in full.
        scale: Radians per unit of joints whose unit is unknown, by (new) joint name; for command
            and position, the velocity is left as it is.

    Raises:
        LogError: Something cannot be believed; the message names it and the way out.
        RobotError: The robot has no such joint.
    """
    where = columns.where
    factor = UNITS.get(unit)
    if factor is None:
        raise LogError(f"{where}: unit {unit!r}; expected one of {', '.join(UNITS)}.")
    if time_unit not in TIME_UNITS:
        raise LogError(
            f"{where}: time_unit {time_unit!r}; expected one of {', '.join(TIME_UNITS)}."
        )
    notes = list(columns.notes)
    keep = np.ones(len(columns.time), dtype=bool)
    if drop_duplicates and len(columns.time) > 1:
        same = np.diff(columns.time) == 0.0
        for values in (columns.command, columns.position, columns.velocity, columns.torque):
            if values is not None:
                same &= (np.diff(values, axis=0) == 0.0).all(axis=1)
        keep[1:] = ~same
        if dropped := int(same.sum()):
            notes.append(f"{dropped} rows that repeat the one before were dropped")
    kept = np.flatnonzero(keep)
    time = columns.time[keep]
    check_increasing(time, where, lambda i: columns.row(int(kept[i])))
    seconds = TIME_UNITS[time_unit]
    check_unit(time * seconds, where, time_unit)
    if abs(time[0] * seconds) > _EPOCH_S:
        notes.append(
            f"the clock is made to begin at zero (the first timestamp is {time[0] * seconds:.6f} s)"
        )
        # Before the unit is changed: nothing is rounded away.
        time = time - time[0]
    time = time * seconds
    timing = examine(time)
    notes.append(timing.words())
    if rate_hz is not None:
        check_claim(timing, where, rate_hz)
    joints = _renamed(where, columns.joints, joint_names)
    if robot is not None:
        for name in joints:
            robot.joint(name)
    factors, units = _factors(where, joints, columns.units, factor, scale or {})

    def scaled(values: Array, by: Array | float = 1.0) -> Array:
        return np.asarray(values[keep] * by)

    # A scale says what a unit of position is; the velocity beside it may be an angle already.
    rates = np.array(
        [1.0 if joint in (scale or {}) else f for joint, f in zip(joints, factors, strict=True)]
    )
    command = scaled(columns.command, factors)
    if note := _correlation(time, command, joints, timing.rate_hz):
        notes.append(note)
    return JointLog(
        robot=robot.name if robot is not None else robot_name,
        joints=joints,
        time=time,
        command=command,
        position=scaled(columns.position, factors),
        velocity=None if columns.velocity is None else scaled(columns.velocity, rates),
        torque=None if columns.torque is None else scaled(columns.torque),
        segments=_questions(time, command, joints),
        pose=np.asarray(0.5 * (command.max(axis=0) + command.min(axis=0))),
        units=units,
        source=where,
        sha256=columns.sha256,
        notes=tuple(notes),
        metadata=columns.metadata,
    )


def _renamed(where: str, joints: tuple[str, ...], names: Names | None) -> tuple[str, ...]:
    if names is None:
        return joints
    if isinstance(names, Mapping):
        if unknown := [name for name in names if name not in joints]:
            raise LogError(
                f"{where}: joint_names renames {', '.join(unknown)}; the file has "
                f"{', '.join(joints)}."
            )
        return tuple(names.get(joint, joint) for joint in joints)
    if len(names) != len(joints):
        raise LogError(
            f"{where}: {len(names)} joint_names for {len(joints)} columns; give one name each, in "
            "the file's order."
        )
    return tuple(names)


def _factors(
    where: str,
    joints: tuple[str, ...],
    units: tuple[str, ...],
    factor: float,
    scale: Mapping[str, float],
) -> tuple[Array, tuple[str, ...]]:
    """Radians per unit of each column, 1 where that is unknown, and the units that result."""
    if unknown := [name for name in scale if name not in joints]:
        raise LogError(
            f"{where}: a scale is given for {', '.join(unknown)}; the joints are "
            f"{', '.join(joints)}."
        )
    factors, result = [], []
    for joint, unit in zip(joints, units or ("rad",) * len(joints), strict=True):
        if joint in scale:
            if not (np.isfinite(scale[joint]) and scale[joint] != 0.0):
                raise LogError(
                    f"{where}: the scale of {joint} is {scale[joint]}; expected a number."
                )
            factors.append(float(scale[joint]))
            result.append("rad")
        else:
            factors.append(factor if unit == "rad" else 1.0)
            result.append(unit)
    return np.array(factors), tuple(result)


def _questions(time: Array, command: Array, joints: tuple[str, ...]) -> tuple[Segment, ...]:
    """One question of unknown kind for every joint whose command moves, over the whole log."""
    amplitude = 0.5 * np.ptp(command, axis=0) if len(command) else np.zeros(len(joints))
    return tuple(
        Segment(
            kind="unknown",
            joints=(joint,),
            start=float(time[0]),
            stop=float(time[-1]),
            amplitude=float(peak),
        )
        for joint, peak in zip(joints, amplitude, strict=True)
        if peak > 0.0
    )


def _correlation(time: Array, command: Array, joints: tuple[str, ...], rate_hz: float) -> str:
    """Warning where the commands of several joints are alike."""
    moving = np.flatnonzero(np.ptp(command, axis=0) > 0.0)
    if len(moving) < 2 or not np.isfinite(command).all():
        return ""
    # The command is held, so reading it on a uniform grid moves no edge by more than a sample.
    grid = time[0] + np.arange(len(time)) / rate_hz
    index = np.clip(np.searchsorted(time, grid + 0.5 / rate_hz) - 1, 0, len(time) - 1)
    return correlation_note(command[index][:, moving], [joints[i] for i in moving], rate_hz)
