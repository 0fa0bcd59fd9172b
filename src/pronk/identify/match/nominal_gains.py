"""Nominal gains: those that were on the real drives while a log was recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from pronk.errors import LogError, PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.robots.robot import RobotSpec

Pair = tuple[float, float]
"""Stiffness [N m/rad] and damping [N m s/rad]."""
DriveGains = Mapping[str, Pair] | Literal["default"]
"""Gains on the real drives, by joint or joint group, or `default`: those of the robot's file."""

_SAME_GAINS = 0.01
"""Relative difference between gains of the log and gains of the user that counts as rounding."""


def gains_by_joint(robot: RobotSpec, drive_gains: DriveGains) -> dict[str, Pair]:
    """Spread gains that are named by joint or by joint group over the joints.

    Args:
        robot: The robot, which knows its joints and joint groups.
        drive_gains: Stiffness and damping by joint or group, or `default`.

    Returns:
        Stiffness and damping by joint.

    Raises:
        PronkError: A name is neither a joint nor a joint group.
    """
    if drive_gains == "default":
        return {joint.name: (joint.stiffness, joint.damping) for joint in robot.joints}
    by_joint: dict[str, Pair] = {}
    for name, pair in drive_gains.items():
        if name in robot.groups:
            for joint in robot.group(name):
                by_joint[joint.name] = pair
        elif name in robot.joint_names:
            by_joint[name] = pair
        else:
            raise PronkError(
                f"drive gains of {name!r}; expected a joint ({', '.join(robot.joint_names)}) or a "
                f"joint group ({', '.join(robot.groups)})."
            )
    return by_joint


def held_pairs(logs: Sequence[JointLog], robot: RobotSpec) -> dict[str, list[Pair]]:
    """Return the gains that logs state of joints that they do not excite.

    Args:
        logs: The logs as they were read.
        robot: The robot.

    Returns:
        Different gains by the original of the joint (`Joint.original`), which is simulated in its
        place.
    """
    pairs: dict[str, list[Pair]] = {}
    for log in logs:
        if log.stiffness is None or log.damping is None:
            continue
        excited_joints = log.excited_joints
        for column, name in enumerate(log.joints):
            pair = (float(log.stiffness[column]), float(log.damping[column]))
            if name in excited_joints or name not in robot.joint_names or not pair[0] > 0.0:
                continue
            known_pairs = pairs.setdefault(robot.joint(name).original[0], [])
            if not any(
                np.allclose(pair, known_pair, rtol=_SAME_GAINS) for known_pair in known_pairs
            ):
                known_pairs.append(pair)
    return pairs


def robot_as_recorded(
    robot: RobotSpec, drive_gains: DriveGains | None, logs: Sequence[JointLog]
) -> RobotSpec:
    """Give the joints of a robot the gains that were on their drives during the recordings.

    The joints that hold their place while another one is excited are simulated with them.

    Args:
        robot: The robot, whose file has the gains of the other joints.
        drive_gains: Gains that are stated for the recordings.
        logs: The recordings, which may have the gains of joints that they do not excite. Where they
            state different ones, those of the robot's file stay.
    """
    stated: dict[str, Pair] = {}
    pairs = held_pairs(logs, robot)
    for joint in robot.joints:
        joint_pairs = pairs.get(joint.original[0], [])
        if len(joint_pairs) == 1:
            stated[joint.name] = joint_pairs[0]
    if drive_gains is not None and drive_gains != "default":
        stated |= gains_by_joint(robot, drive_gains)
    if not stated:
        return robot
    joints = []
    for joint in robot.joints:
        if joint.name in stated:
            stiffness, damping = stated[joint.name]
            joints.append(replace(joint, stiffness=stiffness, damping=damping, servo="position"))
        else:
            joints.append(joint)
    return replace(robot, joints=tuple(joints))


def assumed_held_gains(
    robot: RobotSpec, joint_name: str, logs: Sequence[JointLog]
) -> tuple[str, ...]:
    """Warn of joints whose gains are not known and that hold their place for another one.

    `pronk robot new` assumes gains where a model has no position servo, and says so by `servo` in
    the robot's file. A soft neighbour moves along and changes the matched gains.

    Args:
        robot: The robot with the gains that are stated for the recordings.
        joint_name: The excited joint.
        logs: The logs as they were read.

    Returns:
        One flag, or none.
    """
    logged: set[str] = set()
    for log in logs:
        if log.stiffness is not None:
            logged |= set(log.joints)
    joint = robot.joint(joint_name)
    assumed = []
    for name in joint.chain:
        is_held = name != joint_name and name not in joint.clamped
        if is_held and name not in logged and robot.joint(name).servo != "position":
            assumed.append(name)
    pairs = held_pairs(logs, robot)
    contradictory = []
    for name in joint.chain:
        if name != joint_name and len(pairs.get(robot.joint(name).original[0], [])) > 1:
            contradictory.append(name)
    if contradictory:
        return (
            f"held joints: the logs state different gains of {', '.join(contradictory)}, which "
            f"hold their place while {joint_name} is excited, and those of the robot's file were "
            "simulated; match logs of different gains one at a time",
        )
    if not assumed:
        return ()
    names = ", ".join(assumed)
    return (
        f"held joints: the gains of {names} are assumed (`servo` in the robot's file), and these "
        f"joints hold their place while {joint_name} is excited, so that its gains depend on them; "
        f"give --drive-gains {assumed[0]}=STIFFNESS,DAMPING, or set them in the robot's file and "
        "remove `servo`",
    )


def with_drive_gains(
    logs: Sequence[JointLog], robot: RobotSpec, drive_gains: DriveGains | None = None
) -> list[JointLog]:
    """Give every log the gains that were on the real drives.

    Args:
        logs: Logs of one robot.
        robot: The robot; its file has the gains of joints that stood still.
        drive_gains: Gains where the logs do not have them.

    Returns:
        The logs with their excitations marked and with gains for every column.

    Raises:
        LogError: Gains of an excited joint are neither in the log nor given, or the two differ, or
            logs excite a joint with different gains on its drive.
        PronkError: A name of `drive_gains` is neither a joint nor a joint group.
    """
    stated: dict[str, Pair] = {}
    if drive_gains is not None and drive_gains != "default":
        stated = gains_by_joint(robot, drive_gains)
    completed = []
    for plain_log in logs:
        log = plain_log.segmented()
        stiffness = np.zeros(len(log.joints))
        damping = np.zeros(len(log.joints))
        for column, name in enumerate(log.joints):
            pair = _column_gains(log, column, stated.get(name))
            if pair is None and name in log.excited_joints and drive_gains != "default":
                raise LogError(
                    f"{log.source or 'log'}: the gains that were on the drive of {name} are not in "
                    "the log; give --drive-gains JOINT_OR_GROUP=STIFFNESS,DAMPING, or "
                    "--drive-gains default if they were those of the robot's file."
                )
            if pair is None and name in robot.joint_names:
                joint = robot.joint(name)
                pair = (joint.stiffness, joint.damping)
            if pair is not None:
                stiffness[column] = pair[0]
                damping[column] = pair[1]
        completed.append(replace(log, stiffness=stiffness, damping=damping))
    _require_same_gains(completed)
    return completed


def _require_same_gains(logs: Sequence[JointLog]) -> None:
    """Refuse logs that excite a joint with different gains on its drive.

    A match finds one pair of simulated gains for each joint, which cannot stand for two drives.

    Args:
        logs: Logs with their excitations marked and with gains for every column.

    Raises:
        LogError: Gains differ; the message names the joint, the logs and the way out.
    """
    first: dict[str, tuple[JointLog, Pair]] = {}
    for log in logs:
        assert log.stiffness is not None
        assert log.damping is not None
        for name in log.excited_joints:
            column = log.column(name)
            pair = (float(log.stiffness[column]), float(log.damping[column]))
            first_log, first_pair = first.setdefault(name, (log, pair))
            if not np.allclose(pair, first_pair, rtol=_SAME_GAINS):
                raise LogError(
                    f"{log.source or 'log'}: {name} was excited at {pair[0]:g} N m/rad and "
                    f"{pair[1]:g} N m s/rad, and at {first_pair[0]:g} and {first_pair[1]:g} in "
                    f"{first_log.source or 'another log'}; simulated gains stand for one pair on "
                    "the drive, so match logs of different gains one at a time."
                )


def _column_gains(log: JointLog, column: int, stated: Pair | None) -> Pair | None:
    """Return the gains of one column of a log: the stated ones, else the log's, else None.

    Raises:
        LogError: The log and the user state different gains.
    """
    if log.stiffness is None or log.damping is None:
        return stated
    logged = (float(log.stiffness[column]), float(log.damping[column]))
    if stated is None:
        return logged
    if not np.allclose(logged, stated, rtol=_SAME_GAINS):
        raise LogError(
            f"{log.source or 'log'}: {log.joints[column]} was recorded at {logged[0]:g} N m/rad "
            f"and {logged[1]:g} N m s/rad by the log, at {stated[0]:g} and {stated[1]:g} by "
            "--drive-gains; leave the option out, or correct the log."
        )
    return stated


def gains_on_drive(log: JointLog, joint_name: str, robot: RobotSpec) -> Pair:
    """Return the gains on a joint's real drive: the log's if it has them, else the robot file's."""
    joint = robot.joint(joint_name)
    column = log.column(joint_name)
    stiffness = joint.stiffness
    if log.stiffness is not None:
        stiffness = float(log.stiffness[column])
    damping = joint.damping
    if log.damping is not None:
        damping = float(log.damping[column])
    return stiffness, damping
