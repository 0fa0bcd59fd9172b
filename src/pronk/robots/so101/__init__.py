"""SO-101 follower arm: six Feetech STS3215 servos on a fixed base."""

from __future__ import annotations

from pronk.robots.robot import Joint, Robot
from pronk.robots.so101 import constants as c
from pronk.robots.so101.model import build_spec

_ALL = tuple(link.joint for link in c.CHAIN)

SO101 = Robot(
    name="so101",
    joints=tuple(
        Joint(
            name=link.joint,
            group=link.joint,
            drive=c.DRIVE,
            range=link.range,
            default_position=c.DEFAULT_POSITION[link.joint],
            stiffness=c.STIFFNESS,
            damping=c.DAMPING,
            band_hz=c.BAND_HZ,
            chain=_ALL,  # one arm: every joint feels every other
        )
        for link in c.CHAIN
    ),
    build_spec=build_spec,
    base_body="base",
    grid_stiffness=c.GRID_STIFFNESS,
    grid_damping=c.GRID_DAMPING,
)
"""Six joints, each a group of its own, root first."""

__all__ = ["SO101", "build_spec"]
