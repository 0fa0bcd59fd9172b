"""Whether a joint's answer can be believed: did it move, freely, in radians, and is it known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.logs.joint_log import JointLog
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

LARGEST_COMMAND = 6.3
"""Peak of a command about its middle above which radians are not believed: a full turn [rad]."""
LARGEST_POSITION = 4.0 * np.pi
"""Largest position at which radians are believed: two turns [rad]."""

_FEW_STEPS = 3.0
"""Encoder steps within which a joint counts as unmoved."""
_UNMOVED = 0.01
"""Share of the command's travel below which a joint did not move; chirps begin far below any
joint's bandwidth, where it follows one to one."""
_NEAR_END = 0.005
"""Share of the position's travel that counts as being at its end."""
_MOVES_ON = 0.15
"""Share of its own travel that the command must move outward meanwhile. A joint that friction holds
at its turning point stands still while the command comes back, not while it moves on."""
_LONG_RUN_S = 0.1
"""Time at an end from which on it is not the turning point of an oscillation [s]."""
_MOSTLY = 0.05
"""Share of the time at an end, in such runs, that makes a joint saturated."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """How a joint moved."""

    travel: float
    """Greatest less least position [rad]."""
    commanded: float
    """Greatest less least command [rad]."""
    step: float
    """Smallest change of position that occurs: the encoder's step, or noise [rad]."""
    at_end: float
    """Share of the time that the joint lies at an end of its travel while the command moves on
    outward."""


def motion(log: JointLog, joint: str) -> Motion:
    """How a joint moved over a log.

    Raises:
        LogError: There is no such joint.
    """
    column = log.column(joint)
    position, command = log.position[:, column], log.command[:, column]
    levels = np.unique(position)
    travel, commanded = float(np.ptp(position)), float(np.ptp(command))
    at_end = 0.0
    if travel > 0.0 and commanded > 0.0:
        for outward in (1.0, -1.0):
            out = outward * position
            near = out >= out.max() - _NEAR_END * travel
            at_end += _stopped(log.time, near, outward * command, _MOVES_ON * commanded)
    return Motion(
        travel=travel,
        commanded=commanded,
        step=float(np.diff(levels).min()) if len(levels) > 1 else 0.0,
        at_end=at_end / float(log.time[-1] - log.time[0]),
    )


def _stopped(time: Array, near: NDArray[np.bool_], command: Array, outward: float) -> float:
    """Time in long runs of `near` during which the command grows by more than `outward` [s]."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], near.astype(np.int8), [0]))))
    total = 0.0
    for first, stop in edges.reshape(-1, 2):
        length = float(time[stop - 1] - time[first])
        grows = float(command[first:stop].max() - command[first])
        if length >= _LONG_RUN_S and grows > outward:
            total += length
    return total


def check_motion(log: JointLog, joint: str) -> Motion:
    """Refuse a joint that was not excited, did not move, or lies at an end of its travel.

    Returns:
        How it moved.

    Raises:
        LogError: Says which, with the numbers.
    """
    where = log.source or "log"
    found = motion(log, joint)
    unit = log.unit(joint) if log.unit(joint) != "unknown" else "of an unknown unit"
    if found.commanded == 0.0:
        raise LogError(f"{where}: {joint} was not excited; its command is constant.")
    if found.travel < _UNMOVED * found.commanded or (
        found.travel <= _FEW_STEPS * found.step and found.travel < 0.5 * found.commanded
    ):
        raise LogError(
            f"{where}: {joint} did not move: its command travels {found.commanded:.3g} {unit}, its "
            f"position {found.travel:.3g}; check that its drive was enabled, the joint free, and "
            "the columns named right."
        )
    if found.at_end > _MOSTLY:
        raise LogError(
            f"{where}: {joint} is saturated: for {100.0 * found.at_end:.0f} % of the time it lies "
            "at an end of its travel while its command moves on; ask with a smaller amplitude or "
            "farther from its stops."
        )
    check_radians(log, joint)
    return found


def check_radians(log: JointLog, joint: str) -> None:
    """Refuse a joint in radians that turns as only degrees would.

    Raises:
        LogError: Says what was found.
    """
    if log.unit(joint) != "rad":
        return
    column = log.column(joint)
    command, position = log.command[:, column], log.position[:, column]
    peak = 0.5 * float(np.ptp(command))
    farthest = float(max(np.abs(position).max(), np.abs(command).max()))
    if peak <= LARGEST_COMMAND and farthest <= LARGEST_POSITION:
        return
    swings = peak > LARGEST_COMMAND
    what = f"its command swings by {peak:.3g}" if swings else f"it reaches {farthest:.3g}"
    raise LogError(
        f"{log.source or 'log'}: {joint} is said to be in radians and {what}, more than a joint "
        "turns; the file is probably in degrees (unit='deg')."
    )


def check_joints(log: JointLog, robot: Robot) -> None:
    """Refuse a log that names joints the robot does not have.

    Raises:
        RobotError: Lists the robot's joints.
    """
    for name in log.joints:
        robot.joint(name)
