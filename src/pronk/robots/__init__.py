"""What a robot is: joints, drives, limits, default pose and its MuJoCo model.

One folder per robot, one constants file in it with a source beside every number.
"""

from __future__ import annotations

from pronk.errors import RobotError
from pronk.robots.robot import Drive, Joint, Robot

ROBOT_NAMES: tuple[str, ...] = ("mini_cheetah", "go2", "so101")
"""The robots that `load_robot` knows."""


def load_robot(name: str) -> Robot:
    """The robot called `name`.

    Raises:
        RobotError: There is none; the message lists those there are.
    """
    if name == "mini_cheetah":
        from pronk.robots.mini_cheetah import MINI_CHEETAH

        return MINI_CHEETAH
    if name == "go2":
        from pronk.robots.go2 import GO2

        return GO2
    if name == "so101":
        from pronk.robots.so101 import SO101

        return SO101
    raise RobotError(f"there is no robot {name!r}; the robots are {', '.join(ROBOT_NAMES)}.")


__all__ = ["ROBOT_NAMES", "Drive", "Joint", "Robot", "load_robot"]
