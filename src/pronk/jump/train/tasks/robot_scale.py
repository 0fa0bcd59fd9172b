"""Size of a robot over that of the Mini Cheetah, for which the numbers of the task were found."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pronk.robots.legged import HIP_PITCH, KNEE, Legged

STANDING_HEIGHT = 0.2989695
"""Height of the Mini Cheetah's trunk in its default pose [m]."""
MASS = 12.0
"""Mass of the Mini Cheetah [kg]."""
KNEE_LEVER = 0.195 * math.sin(0.8)
"""Horizontal distance from its foot to its knee in that pose [m]."""
_DIGITS = 3
"""Decimals of a ratio: the Mini Cheetah's, read from its model, are then 1 without a rest."""


@dataclass(frozen=True, kw_only=True)
class RobotScale:
    """Ratios of a robot to the Mini Cheetah."""

    length: float = 1.0
    """Of the heights of the standing trunk."""
    torque: float = 1.0
    """Of the torques of knees that carry the robot in its default pose."""


MINI_CHEETAH = RobotScale()
"""The Mini Cheetah's own."""


def robot_scale(body: Legged) -> RobotScale:
    """Compute the size of a robot over that of the Mini Cheetah.

    Args:
        body: Dimensions of the robot.
    """
    hip_pitch = body.default_position[body.leg_joints[HIP_PITCH]]
    knee = body.default_position[body.leg_joints[KNEE]]
    shank_angle = hip_pitch + knee
    lever = body.shank_length * abs(math.sin(shank_angle))
    torque = body.total_mass * lever / (MASS * KNEE_LEVER)
    return RobotScale(
        length=round(body.standing_height / STANDING_HEIGHT, _DIGITS),
        torque=round(torque, _DIGITS),
    )
