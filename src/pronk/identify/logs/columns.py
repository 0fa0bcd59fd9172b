"""Columns of a file from elsewhere, checked and converted to a JointLog."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.identify.logs.checks import TIME_UNITS, check_unit, correlation_note
from pronk.identify.logs.joint_log import JointLog, LogOrigin, check_increasing
from pronk.names import check_names
from pronk.robots.robot import RobotSpec

UNITS = {"rad": 1.0, "deg": np.pi / 180.0}
"""Radians in each unit of angle."""
_EPOCH_S = 1e6
"""Clocks that begin later than this count from an epoch, and are made to begin at zero [s]."""


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Columns of a file, as they stand there. Shapes (n,) and (n, joints)."""

    where: str
    """File, for messages."""
    joints: tuple[str, ...] = ()
    """Names of the columns; empty if the file has none."""
    time: Array
    position: Array
    command: Array | None = None
    """None where the drives were commanded in torque."""
    velocity: Array | None = None
    torque: Array | None = None
    unit: str | None = None
    """Unit of the angles, one of `UNITS`, where the format defines it."""
    time_unit: str = "s"
    """One of `TIME_UNITS`."""
    no_angles: tuple[str, ...] = ()
    """Joints whose position is on another scale than `unit`, by their names in the file."""
    names: Mapping[str, str] | None = None
    """Joint names that the format's own stand for."""
    row: Callable[[int], str] = "sample {}".format
    """Names a sample as the user finds it in the file."""
    robot: str = "unknown"
    notes: tuple[str, ...] = ()
    sha256: str = ""
    metadata: dict[str, str] = field(default_factory=dict)


def import_columns(
    columns: Columns,
    robot: RobotSpec | None = None,
    *,
    unit: str | None = None,
    time_unit: str | None = None,
    joint_names: Mapping[str, str] | None = None,
    joint_order: Sequence[str] | None = None,
    drop_duplicates: bool = False,
    scale: Mapping[str, float] | None = None,
) -> JointLog:
    """Check columns and make a log of them; a LogError names what is implausible and the way out.

    `unit` of the angles is `rad` or `deg`, and required where the format has none; `time_unit` is
    one of `TIME_UNITS`. `joint_names` gives new names by the file's own; `joint_order` names
    columns that have no names (see `ordered`). Duplicates are rows that repeat the one before in
    full. `scale` gives radians per unit of joints whose unit is unknown, by (new) joint name, for
    command and position; the velocity is left as it is.
    """
    where, sent, scale = columns.where, columns.command, scale or {}
    unit, time_unit = unit or columns.unit, time_unit or columns.time_unit
    if unit is None:
        raise LogError(
            f"{where}: the file does not say whether its angles are radians or degrees; give "
            "--unit rad or --unit deg."
        )
    for name, value, known in (("--unit", unit, UNITS), ("--time-unit", time_unit, TIME_UNITS)):
        if value not in known:
            raise LogError(f"{where}: {name} {value}; expected one of {', '.join(known)}.")
    if sent is None and columns.torque is None:
        raise LogError(f"{where}: neither a commanded position nor a torque; expected one of them.")
    joints = _named(columns, robot, joint_names, joint_order)
    keep, notes = np.arange(len(columns.time)), list(columns.notes)
    if sent is None:
        # A command that stands still excites nothing.
        sent = np.repeat(columns.position[:1], len(columns.time), axis=0)
        notes.append("no commanded position, so the drives count as commanded in torque")
    if drop_duplicates and len(keep) > 1:
        every = (sent, columns.position, columns.velocity, columns.torque)
        table = np.column_stack([columns.time, *(v for v in every if v is not None)])
        same = (np.diff(table, axis=0) == 0.0).all(axis=1)
        keep = np.flatnonzero(np.concatenate(([True], ~same)))
        if dropped := int(same.sum()):
            notes.append(f"{dropped} rows that repeat the one before were dropped")
    time, seconds = columns.time[keep], TIME_UNITS[time_unit]
    check_increasing(time, where, lambda i: columns.row(int(keep[i])))
    check_unit(time * seconds, where, time_unit)
    if abs(time[0] * seconds) > _EPOCH_S:
        notes.append(
            f"the clock is made to begin at zero (the first timestamp is {time[0] * seconds:.6f} s)"
        )
        # Before the unit is changed: nothing is rounded away.
        time = time - time[0]
    time = time * seconds
    for joint, factor in scale.items():
        if joint not in joints:
            raise LogError(f"{where}: --scale names {joint}; the joints are {', '.join(joints)}.")
        if not (np.isfinite(factor) and factor != 0.0):
            raise LogError(f"{where}: the scale of {joint} is {factor}; expected a number.")
    renamed = dict(zip(columns.joints, joints, strict=False))
    other = {renamed[name] for name in columns.no_angles if name in renamed}
    angle = {joint: 1.0 if joint in other else UNITS[unit] for joint in joints}
    factors = np.array([scale.get(joint, angle[joint]) for joint in joints])
    # A scale defines the unit of position; the velocity beside it may be an angle already.
    rates = np.array([1.0 if joint in scale else angle[joint] for joint in joints])
    command = sent[keep] * factors
    # A command that is not finite is refused below, by name.
    if np.isfinite(command).all() and (note := correlation_note(time, command, joints)):
        notes.append(note)
    return JointLog(
        robot=robot.name if robot is not None else columns.robot,
        joints=joints,
        time=time,
        command=command,
        position=columns.position[keep] * factors,
        velocity=None if columns.velocity is None else columns.velocity[keep] * rates,
        torque=None if columns.torque is None else columns.torque[keep],
        units=tuple(
            "unknown" if joint in other and joint not in scale else "rad" for joint in joints
        ),
        notes=tuple(notes),
        origin=LogOrigin(source=where, sha256=columns.sha256, metadata=columns.metadata),
    )


def _named(
    columns: Columns,
    robot: RobotSpec | None,
    names: Mapping[str, str] | None,
    order: Sequence[str] | None,
) -> tuple[str, ...]:
    """Names of the joints, as many as there are columns."""
    where, joints = columns.where, columns.joints
    shape = (len(columns.time), columns.position.shape[-1])
    command = columns.position if columns.command is None else columns.command
    if command.shape != shape or columns.position.shape != shape:
        raise LogError(
            f"{where}: time has shape {columns.time.shape}, command {command.shape} and position "
            f"{columns.position.shape}; expected (n,), (n, joints) and (n, joints)."
        )
    stated = ordered(f"{where}: its {shape[1]} columns", shape[1], robot, order, joints)
    names = columns.names if names is None else names
    if unknown := [name for name in names or {} if name not in stated]:
        raise LogError(
            f"{where}: --joint-names renames {', '.join(unknown)}; the joints are "
            f"{', '.join(stated)}."
        )
    named = tuple((names or {}).get(joint, joint) for joint in stated)
    check_names(named, f"{where} (--joint-names THEIRS=OURS renames joints)", LogError)
    return named


def ordered(
    what: str,
    count: int,
    robot: RobotSpec | None,
    order: Sequence[str] | None,
    joints: Sequence[str] = (),
) -> tuple[str, ...]:
    """Joint of each of several values (`what`): by the file, or in the order that the user states.

    `order` is joint names, one a value (a list, or text with commas), or `default`: the robot's
    joints in its own order. An order is never assumed: a LogError says that neither the file
    (`joints`) nor the user names the joints, or that they differ.
    """
    own = () if robot is None else robot.joint_names
    stated = tuple(order.split(",") if isinstance(order, str) else order or ())
    if stated == ("default",):
        stated = tuple(joints) or own
    if not stated and not joints:
        default = f"default if that is {','.join(own)}" if own else "default with --robot"
        raise LogError(
            f"{what} have no joint names; give --joint-order NAME,NAME,... in the file's order, or "
            f"--joint-order {default}."
        )
    if stated and joints and stated != tuple(joints):
        raise LogError(
            f"{what} are {', '.join(joints)} by the file and {', '.join(stated)} by --joint-order; "
            "leave the option out; --joint-names THEIRS=OURS renames joints."
        )
    stated = stated or tuple(joints)
    if len(stated) != count:
        raise LogError(
            f"{what} have {len(stated)} joint names ({', '.join(stated)}); expected one each."
        )
    return stated


def in_force(sent: Array, time: Array) -> NDArray[np.intp]:
    """Index of the last command sent at or before each instant; -1 before the first."""
    return np.asarray(np.searchsorted(sent, time, side="right") - 1)
