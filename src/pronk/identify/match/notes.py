"""Remarks on the logs of a match that say what to look at, and refuse or flag nothing."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from pronk.arrays import Array
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.velocity import velocity_note
from pronk.identify.match.result import JointResult
from pronk.identify.response.estimate import resolution_note
from pronk.robots.robot import RobotSpec

OTHER_POSE = 0.3
"""Distance of a joint from its pose in the robot's file from which on it is said [rad]."""
WIDE_SHARE = 0.25
"""Half of the interval of a stiffness over the stiffness from which on the interval is wide."""
MOVING_SHARE = 0.02
"""Travel of a held joint over that of the excited one from which on it moves along."""
_LEAST_PERCENT = 1.0
"""Share of the samples at either end of the positions that does not count for a travel [%]."""


def match_notes(
    logs: Sequence[JointLog], joints: Mapping[str, JointResult], robot: RobotSpec
) -> tuple[str, ...]:
    """Return all remarks on the logs of a match, each once.

    They are those of the readers, then on wrong velocities, other poses, coarse responses, and wide
    intervals.

    Args:
        logs: The logs.
        joints: Results by joint.
        robot: The robot.
    """
    notes = []
    for log in logs:
        source = Path(log.source or "log").name
        for note in log.notes:
            notes.append(f"{source}: {note}")
        for name in joints:
            if name in log.excited_joints:
                notes.append(velocity_note(log, name, source))
        notes.append(pose_note(log, joints, robot, source))
    for joint in joints.values():
        if joint.responses is not None:
            notes.append(resolution_note(joint.responses.measured[0]))
        notes.append(wide_interval_note(logs, joint, robot))
    return tuple(dict.fromkeys(note for note in notes if note))


def pose_note(log: JointLog, joints: Iterable[str], robot: RobotSpec, source: str) -> str:
    """Say which joints of a log stand elsewhere than in the pose of the robot's file.

    A log may well be of another pose, and is simulated there. Columns that are exchanged, an
    encoder with another zero, a wrong sign and a wrong unit show in the same way, and often in
    nothing else.

    Args:
        log: The log.
        joints: The joints that were matched.
        robot: The robot, with the pose of its file.
        source: Name of the log for the note.

    Returns:
        The note; empty where every joint is within `OTHER_POSE` of the file's pose.
    """
    positions: dict[str, float] = {}
    for joint in joints:
        if joint not in log.excited_joints:
            continue
        for excitation in log.excitations(joint):
            for name in robot.joint_names:
                if name in log.joints and log.unit(name) == "rad":
                    position = float(excitation.pose[log.column(name)])
                    positions.setdefault(name, position)
    differences = []
    for name, position in positions.items():
        default = robot.joint(name).default_position
        if abs(position - default) > OTHER_POSE:
            differences.append(f"{name} {position:.3g} rad (file: {default:.3g})")
    if not differences:
        return ""
    return (
        f"{source}: the log was recorded in another pose than that of the robot's file: "
        f"{', '.join(differences)}. It is simulated in the pose of the log; if the robot did not "
        "stand there, columns are exchanged, or a unit, a sign or the zero of an encoder is wrong"
    )


def wide_interval_note(logs: Sequence[JointLog], joint: JointResult, robot: RobotSpec) -> str:
    """Say which held joints moved along where the interval of a stiffness is wide.

    Held joints are simulated with the gains that are stated for them and the dry friction of the
    robot's file. Where these are wrong, amplitudes and parts of a recording disagree on the gains
    of the excited joint, which widens its interval.

    Args:
        logs: The logs.
        joint: Result of the excited joint.
        robot: The robot.

    Returns:
        The note; empty where the interval is narrow or not known, and where no held joint moved.
    """
    stiffness = joint.gains.stiffness
    low, high = stiffness.total95
    half_width = 0.5 * (high - low)
    if not WIDE_SHARE * stiffness.value < half_width < math.inf:
        return ""
    shares = moving_shares(logs, joint.joint, robot)
    if not shares:
        return ""
    moving = ", ".join(f"{name} by {100.0 * share:.0f} %" for name, share in shares.items())
    return (
        f"{joint.joint}: the interval of its stiffness is wide "
        f"(+-{100.0 * half_width / stiffness.value:.0f} %), and joints that hold their place moved "
        f"along: {moving} of its travel. Wrong gains or a wrong dry friction of these would widen "
        "it: match them first, then give their gains (--drive-gains) and friction (robot.yaml)"
    )


def moving_shares(logs: Sequence[JointLog], name: str, robot: RobotSpec) -> dict[str, float]:
    """Return the travel of held joints over that of the excited one, where it is large enough.

    Args:
        logs: The logs.
        name: The excited joint.
        robot: The robot, which knows the joints of its chain and those that are clamped.

    Returns:
        Largest share over the excitations, by joint that moves along.
    """
    joint = robot.joint(name)
    shares: dict[str, float] = {}
    for log in logs:
        if name not in log.excited_joints:
            continue
        for excitation in log.excitations(name):
            travel = _travel(excitation.position)
            if travel == 0.0:
                continue
            during = (log.time >= excitation.time[0]) & (log.time <= excitation.time[-1])
            for other in joint.chain:
                if other == name or other in joint.clamped or other not in log.joints:
                    continue
                column = log.column(other)
                is_held = np.ptp(log.command[during, column]) == 0.0
                if not is_held or log.unit(other) != log.unit(name):
                    continue
                share = _travel(log.position[during, column]) / travel
                if share >= MOVING_SHARE:
                    shares[other] = max(share, shares.get(other, 0.0))
    return shares


def _travel(position: Array) -> float:
    """Return how far a joint moves, without its most extreme samples."""
    low, high = np.nanpercentile(position, (_LEAST_PERCENT, 100.0 - _LEAST_PERCENT))
    return float(high - low)
