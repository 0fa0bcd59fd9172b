"""Getting up and down without a policy: minimum-jerk paths from wherever the robot is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.errors import RobotError
from pronk.robots.robot import Robot

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Of standing up, taking over and sitting down [s]."""

    damp_s: float = 1.0
    """Least time in damping before the robot stands up: it sinks to the ground meanwhile."""
    fold_s: float = 1.0
    """From the measured pose to the folded one."""
    rise_s: float = 1.5
    """From there to the default pose."""
    ramp_s: float = 0.5
    """In which the stiffness grows from none to that of the robot's drives."""
    blend_s: float = 0.4
    """In which the policy's targets take the place of the pose; 0 for the conditions of
    training."""
    halt_s: float = 1.0
    """In which the policy is commanded to stand still before the robot sits down."""
    sit_s: float = 1.5
    """From the measured pose to the folded one."""

    def __post_init__(self) -> None:
        """Refuse times that are none.

        Raises:
            RobotError: Names the field.
        """
        for name, value in vars(self).items():
            if not 0.0 <= value < math.inf:
                raise RobotError(f"Timing.{name} is {value}; it must be finite, not negative.")

    @property
    def stand_s(self) -> float:
        """Of the whole way up [s]."""
        return self.fold_s + self.rise_s


def minimum_jerk(share: float) -> float:
    """Position on a straight way with the least jerk, at rest at both ends.

    `10 s^3 - 15 s^4 + 6 s^5` (Flash and Hogan, 1985).

    Args:
        share: Of the time, clipped to 0 to 1.
    """
    s = min(max(share, 0.0), 1.0)
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


@dataclass(frozen=True, kw_only=True)
class Path:
    """Joint targets through poses, at rest at each, and a stiffness that grows meanwhile."""

    began: float
    """[s]"""
    poses: tuple[Array, ...]
    """Joint positions, the measured ones first [rad]. Each (joints,)."""
    seconds: tuple[float, ...]
    """From each pose to the next [s]."""
    ramp_s: float = 0.0
    """In which the stiffness grows [s]."""

    def target(self, t: float) -> Array:
        """Joint targets at a time [rad]. (joints,)."""
        left = t - self.began
        for start, goal, seconds in zip(self.poses, self.poses[1:], self.seconds, strict=False):
            if left < seconds:
                return start + (goal - start) * minimum_jerk(left / seconds)
            left -= seconds
        return self.poses[-1]

    def stiffness(self, t: float) -> float:
        """Share of the drives' stiffness at a time, 0 to 1."""
        return minimum_jerk((t - self.began) / self.ramp_s) if self.ramp_s > 0.0 else 1.0

    def done(self, t: float) -> bool:
        """Whether the last pose is reached, as far as targets go."""
        return t >= self.began + sum(self.seconds)


def default_pose(robot: Robot) -> Array:
    """[rad], (joints,)."""
    return np.array([joint.default_position for joint in robot.joints])


def folded_pose(robot: Robot) -> Array:
    """[rad], (joints,).

    Raises:
        RobotError: A robot without legs of this kind has none.
    """
    pose = [joint.folded_position for joint in robot.joints]
    if any(position is None for position in pose):
        raise RobotError(
            f"{robot.name} has no folded pose, so it cannot stand up; give each of its joints a "
            "folded position."
        )
    return np.array(pose, dtype=float)


def stand_up(robot: Robot, measured: Array, began: float, timing: Timing) -> Path:
    """From the measured pose over the folded one to the default pose, stiffness growing."""
    return Path(
        began=began,
        poses=(measured.copy(), folded_pose(robot), default_pose(robot)),
        seconds=(timing.fold_s, timing.rise_s),
        ramp_s=timing.ramp_s,
    )


def sit_down(robot: Robot, measured: Array, began: float, timing: Timing) -> Path:
    """From the measured pose to the folded one."""
    return Path(began=began, poses=(measured.copy(), folded_pose(robot)), seconds=(timing.sit_s,))
