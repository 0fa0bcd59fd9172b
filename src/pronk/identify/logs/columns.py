"""Columns of a file from elsewhere, checked and converted to a JointLog."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array, Mask
from pronk.errors import LogError
from pronk.identify.logs.checks import check_unit, correlation_note
from pronk.identify.logs.joint_log import JointLog, LogOrigin, check_increasing
from pronk.identify.logs.options import ANGLE_UNITS, TIME_UNITS, NeedsOptionsError, ReadOptions
from pronk.names import check_names
from pronk.robots.robot import RobotSpec

_EPOCH_S = 1e6
"""Clocks that begin later than this count from an epoch, and are made to begin at zero [s]."""


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Columns of a file in its own units and under its own names."""

    origin: LogOrigin
    """The file."""
    time: Array
    """Timestamps, shape (n,)."""
    position: Array
    """Measured positions, shape (n, joints)."""
    command: Array | None = None
    """Commanded positions, shape (n, joints); None where the drives were commanded in torque."""
    velocity: Array | None = None
    """Measured velocities, shape (n, joints), if there are any."""
    torque: Array | None = None
    """Measured torques [N m], shape (n, joints), if there are any."""
    joints: tuple[str, ...] = ()
    """Names of the columns; empty if the file has none."""
    standard_names: Mapping[str, str] | None = None
    """The robot's joint names by those of the format, where these are known."""
    not_angles: tuple[str, ...] = ()
    """Joints whose position is on another scale than `unit`, by their names in the file."""
    unit: str | None = None
    """Unit of the angles, one of `ANGLE_UNITS`; None where the format does not define it."""
    time_unit: str = "s"
    """Unit of the timestamps, one of `TIME_UNITS`."""
    row: Callable[[int], str] = "sample {}".format
    """Names a sample as the user finds it in the file."""
    robot: str = "unknown"
    """Name of the robot, where the format tells."""
    notes: tuple[str, ...] = ()
    """Remarks of the reader."""


def import_columns(columns: Columns, robot: RobotSpec | None, options: ReadOptions) -> JointLog:
    """Check the columns of a file and make a log of them.

    Args:
        columns: Columns as they stand in the file.
        robot: The robot, if it is known, for its name and the default joint order.
        options: Units, joint names, scales, and whether repeated rows are dropped.

    Returns:
        The log, in seconds and radians, without segments.

    Raises:
        LogError: Something is missing or implausible; the message names it and the way out.
    """
    source = columns.origin.source
    unit = options.unit or columns.unit
    time_unit = options.time_unit or columns.time_unit
    if unit is None:
        raise NeedsOptionsError(
            source,
            "the file does not say whether its angles are radians or degrees; give --unit rad or "
            "--unit deg",
        )
    if columns.command is None and columns.torque is None:
        raise LogError(
            f"{source}: neither a commanded position nor a torque; expected one of them."
        )
    joints = _joint_names(columns, robot, options)
    notes = list(columns.notes)
    renamed = []
    for logged_name, ours in zip(columns.joints, joints, strict=False):
        if logged_name != ours:
            renamed.append(f"{logged_name}: {ours}")
    if renamed and robot is not None:
        notes.append(f"joints by their names in {robot.name}: {', '.join(renamed)}")
    command = columns.command
    if command is None:
        # A command that stands still excites nothing.
        command = np.repeat(columns.position[:1], len(columns.time), axis=0)
        notes.append("no commanded position, so the drives count as commanded in torque")
    rows = np.arange(len(columns.time))
    repeats = _repeated_rows(columns, command)
    _check_repeats(columns, command, repeats, dropped=options.drop_duplicates)
    if options.drop_duplicates and repeats.any():
        rows = np.flatnonzero(~repeats)
        notes.append(f"{np.count_nonzero(repeats)} rows that repeat the one before were dropped")

    time = columns.time[rows]
    seconds = TIME_UNITS[time_unit]
    check_increasing(time, source, lambda sample: columns.row(int(rows[sample])))
    check_unit(time * seconds, source, time_unit)
    if abs(time[0] * seconds) > _EPOCH_S:
        notes.append(
            f"the clock is made to begin at zero (the first timestamp is {time[0] * seconds:.6f} s)"
        )
        # Before the unit is changed: nothing is rounded away.
        time = time - time[0]
    time = time * seconds

    stated_scales = options.scale or {}
    for joint in stated_scales:
        if joint not in joints:
            raise LogError(f"{source}: --scale names {joint}; the joints are {', '.join(joints)}.")
    position_scale = np.full(len(joints), ANGLE_UNITS[unit])
    velocity_scale = np.full(len(joints), ANGLE_UNITS[unit])
    units = ["rad"] * len(joints)
    for k, joint in enumerate(joints):
        if joint in stated_scales:
            # The velocity beside a position on another scale may be an angle already.
            position_scale[k] = stated_scales[joint]
            velocity_scale[k] = 1.0
        elif columns.joints and columns.joints[k] in columns.not_angles:
            position_scale[k] = 1.0
            velocity_scale[k] = 1.0
            units[k] = "unknown"

    command = command[rows] * position_scale
    # A command that is not finite is refused below, by name.
    if np.isfinite(command).all():
        correlation = correlation_note(time, command, joints)
        if correlation:
            notes.append(correlation)
    return JointLog(
        robot=robot.name if robot is not None else columns.robot,
        joints=joints,
        time=time,
        command=command,
        position=columns.position[rows] * position_scale,
        velocity=None if columns.velocity is None else columns.velocity[rows] * velocity_scale,
        torque=None if columns.torque is None else columns.torque[rows],
        units=tuple(units),
        notes=tuple(notes),
        origin=columns.origin,
    )


def _joint_names(
    columns: Columns, robot: RobotSpec | None, options: ReadOptions
) -> tuple[str, ...]:
    """Names of the joints of a log, as many as the file has columns."""
    source = columns.origin.source
    shape = (len(columns.time), columns.position.shape[-1])
    command = columns.position if columns.command is None else columns.command
    if command.shape != shape or columns.position.shape != shape:
        raise LogError(
            f"{source}: time has shape {columns.time.shape}, command {command.shape} and position "
            f"{columns.position.shape}; expected (n,), (n, joints) and (n, joints)."
        )
    names = ordered_joints(
        f"{source}: its {shape[1]} columns", shape[1], robot, options.joint_order, columns.joints
    )
    new_names = columns.standard_names if options.joint_names is None else options.joint_names
    if robot is not None:
        new_names = {**robot_names(names, robot), **(new_names or {})}
    if new_names is not None:
        unknown = [name for name in new_names if name not in names]
        if unknown:
            raise LogError(
                f"{source}: --joint-names renames {', '.join(unknown)}; the joints of the log are "
                f"{', '.join(names)}. The log's name stands first, as in --joint-names "
                f"{names[0]}={next(iter(new_names.values()))}."
            )
        names = tuple(new_names.get(name, name) for name in names)
    check_names(
        names,
        f"{source} (--joint-names THEIRS=OURS renames joints, as in --joint-names m0=knee)",
        LogError,
    )
    return names


def _quantities(columns: Columns, command: Array) -> dict[str, Array]:
    """Quantities of the joints in the file by name, shape (n, joints) each."""
    quantities = {"command": command, "position": columns.position}
    if columns.velocity is not None:
        quantities["velocity"] = columns.velocity
    if columns.torque is not None:
        quantities["torque"] = columns.torque
    return quantities


def _repeated_rows(columns: Columns, command: Array) -> Mask:
    """Return True for each row that repeats the one before in full, shape (n,)."""
    repeats = np.concatenate(([False], np.diff(columns.time) == 0.0))
    for values in _quantities(columns, command).values():
        is_same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
        repeats[1:] &= is_same.all(axis=1)
    return repeats


def _check_repeats(columns: Columns, command: Array, repeats: Mask, *, dropped: bool) -> None:
    """Refuse rows that repeat the timestamp of the one before, with a LogError.

    Rows of one time with other values are samples. No option drops them, as that loses data.

    Args:
        columns: Columns as they stand in the file.
        command: Their commands in the unit of the file, shape (n, joints).
        repeats: True for each row that repeats the one before in full, shape (n,).
        dropped: Whether those rows are dropped.
    """
    source = columns.origin.source
    same_time = np.concatenate(([False], np.diff(columns.time) == 0.0))
    different = np.flatnonzero(same_time & ~repeats)
    if len(different):
        row = int(different[0])
        difference = _first_difference(columns, command, row)
        raise LogError(
            f"{source}: {columns.row(row)} repeats the timestamp {columns.time[row]:.9g} of the "
            f"one before with other values ({difference}). Of {len(columns.time)} rows "
            f"{len(different)} do so; they are samples, and to drop them loses data. Timestamps "
            "that are rounded too coarsely, the times of packets that hold several samples, and "
            "two recordings in one file look so: write the time of each sample with more digits, "
            "or split the file."
        )
    if repeats.any() and not dropped:
        row = int(np.argmax(repeats))
        raise LogError(
            f"{source}: {columns.row(row)} repeats the timestamp {columns.time[row]:.9g} of the "
            f"one before; timestamps must increase. Of {len(columns.time)} rows "
            f"{np.count_nonzero(repeats)} repeat the one before in full, and none has other values "
            "at the same time: --drop-duplicates drops them."
        )


def _first_difference(columns: Columns, command: Array, row: int) -> str:
    """Say which quantity of a row first differs from that of the row before."""
    for quantity, values in _quantities(columns, command).items():
        for column, (before, after) in enumerate(zip(values[row - 1], values[row], strict=True)):
            if before == after or (np.isnan(before) and np.isnan(after)):
                continue
            name = quantity
            if columns.joints:
                name = f"{quantity} of {columns.joints[column]}"
            return f"{name} {after:.6g} after {before:.6g}"
    raise ValueError(f"row {row} repeats the one before")


def ordered_joints(
    values: str,
    count: int,
    robot: RobotSpec | None,
    order: str | Sequence[str] | None,
    names: Sequence[str] = (),
) -> tuple[str, ...]:
    """Name the joint of each of several values; an order is never assumed.

    Args:
        values: The values in words, for messages, as in `log.npz: its 3 columns`.
        count: Number of the values.
        robot: The robot, whose joints `default` stands for.
        order: The order that the user states: see `ReadOptions.joint_order`.
        names: Names of the joints by the file; empty if it has none.

    Returns:
        One name a value.

    Raises:
        LogError: Neither the file nor the user names the joints, or the two differ, or the names
            are not as many as the values.
    """
    robot_joints = () if robot is None else robot.joint_names
    stated: tuple[str, ...] = ()
    if order is not None:
        stated = tuple(order.split(",")) if isinstance(order, str) else tuple(order)
    if stated == ("default",):
        stated = tuple(names) or robot_joints
    if not stated and not names:
        default = "default with --robot"
        if robot_joints:
            default = f"default if that is {','.join(robot_joints)}"
        path, _, words = values.partition(": ")
        raise NeedsOptionsError(
            path,
            f"{words} have no joint names; give --joint-order NAME,NAME,... in the file's order, "
            f"or --joint-order {default}",
        )
    if stated and names and stated != tuple(names):
        raise LogError(
            f"{values} are {', '.join(names)} by the file and {', '.join(stated)} by "
            "--joint-order; leave the option out; --joint-names renames joints, as in "
            f"--joint-names {names[0]}={stated[0]}."
        )
    joints = stated or tuple(names)
    if len(joints) != count:
        raise LogError(
            f"{values} have {len(joints)} joint names ({', '.join(joints)}); expected one each."
        )
    return joints


def robot_names(names: Sequence[str], robot: RobotSpec | None) -> dict[str, str]:
    """Return the robot's joint names by those that its maker's models or drivers give them.

    A name that is none of the robot's is one of the maker's for the same joint, or one of these
    names in another case or without `joint` at its end. A name that fits two joints is left.
    """
    if robot is None:
        return {}
    by_simple_name: dict[str, list[str]] = {}
    for joint in robot.joints:
        for name in {_simple_name(joint.name), _simple_name(joint.own_name)}:
            if name:
                by_simple_name.setdefault(name, []).append(joint.name)
    by_maker = {joint.own_name: joint.name for joint in robot.joints if joint.own_name}
    renamed = {}
    for name in names:
        if name in robot.joint_names:
            continue
        candidates = by_simple_name.get(_simple_name(name), [])
        if name in by_maker:
            renamed[name] = by_maker[name]
        elif len(candidates) == 1:
            renamed[name] = candidates[0]
    # Two columns of one joint are not told apart by their names.
    targets = list(renamed.values())
    unique = {}
    for name, joint_name in renamed.items():
        if targets.count(joint_name) == 1 and joint_name not in names:
            unique[name] = joint_name
    return unique


def _simple_name(name: str) -> str:
    """A joint's name in lower case, without `joint` at its end."""
    return name.casefold().removesuffix("joint").rstrip("_- ")


def command_index(
    sent: Array | NDArray[np.int64], time: Array | NDArray[np.int64]
) -> NDArray[np.intp]:
    """Return the index of the last command sent at or before each instant; -1 before the first.

    `sent` holds the increasing instants of the commands and `time` the instants asked for, both in
    one unit.
    """
    return np.asarray(np.searchsorted(sent, time, side="right") - 1)
