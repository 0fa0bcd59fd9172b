"""The Go2's training task: pronk's, with what is not in proportion to the robot's size.

Its motors are slower for their torque than the Mini Cheetah's, and its knees stop at 0.84 rad
before a straight leg. With all of its torque from a deep crouch it leaves the ground at 2.0 to 2.5
m/s, by the charge of the battery, where the Mini Cheetah could at 3; so what a jump is differs.
"""

from __future__ import annotations

from collections.abc import Mapping

from mjlab.envs import ManagerBasedRlEnvCfg

from pronk.jump.train.gains import TrainingGains
from pronk.jump.train.mdp.commands import NAME as COMMAND
from pronk.jump.train.mdp.events import Shape
from pronk.jump.train.mdp.jump import JumpSettings
from pronk.jump.train.tasks.jump_env_cfg import jump_env_cfg
from pronk.robots.robot import RobotSpec

SPEEDS = (2.5, 1.0, 2.2)
"""Half-widths of the commands: forward, left [m/s], yaw rate [rad/s]. It is to keep 2 m/s, .8 m/s
and 2 rad/s; jumps are commanded at 2 m/s and at 1 m/s sideways."""
JUMP = JumpSettings(
    # The knees turn at 13.6 rad/s at this lift-off in the default pose; without load at 15.7.
    liftoff_velocity=2.3,
    # Deeper, for a longer way: the trunk falls by 9 cm and stops 4 cm below that, at .16 m.
    fall_s=0.14,
    ready_s=0.29,
    prompt_s=0.31,
    # Where the countermovement stops. With .13 thighs or shanks touched the ground in crouches.
    crouch=0.16,
)
"""Definition of a good jump."""
COUNTED_FROM = 0.5
"""Ranges of the commands grow with the tracking of robots that are commanded half of them or more,
by the worst direction. With all robots, also those that stand, turn or walk slowly, they grew to
the whole while policies walked 0.4 to 1.2 m/s where 2 m/s were commanded; with the mean of the fast
ones one policy of four ran back and sideways but stood when told to run forwards
(docs/evidence/go2.md)."""
VOLTAGE = (28.8, 33.6)
"""Battery of 8 lithium cells at no load, from 3.6 V (nominal, and all but empty) to 4.2 V (full)
[V]."""
RESISTANCE = (0.03, 0.08)
"""Of these cells, 3 to 8 milliohm each, with plugs and wires [ohm]."""


def env_cfg(
    robot: RobotSpec,
    gains: TrainingGains,
    *,
    iterations: Mapping[str, int],
    gain_shape: Shape = "box",
    num_envs: int = 4096,
    seed: int = 0,
) -> ManagerBasedRlEnvCfg:
    """Configure the environment of all phases; the arguments are those of `jump_env_cfg`."""
    cfg = jump_env_cfg(
        robot,
        gains,
        iterations=iterations,
        gain_shape=gain_shape,
        num_envs=num_envs,
        seed=seed,
    )
    command = cfg.commands[COMMAND]
    command.limits = SPEEDS
    command.counted_from = COUNTED_FROM
    command.settings = JUMP
    cfg.events["battery"].params["voltage"] = VOLTAGE
    cfg.events["battery"].params["resistance"] = RESISTANCE
    return cfg
