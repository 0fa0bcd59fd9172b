"""The Mini Cheetah's training task: pronk's, with joints that are measured on their rotors."""

from __future__ import annotations

from collections.abc import Mapping

from mjlab.envs import ManagerBasedRlEnvCfg

from pronk.jump.train.gains import TrainingGains
from pronk.jump.train.mdp.events import Shape
from pronk.jump.train.tasks.jump_env_cfg import jump_env_cfg, set_rotor_frequency
from pronk.robots.robot import RobotSpec

LOWEST_ROTOR_HZ = 40.0
"""Lowest natural frequency of a rotor on its belt or gear that is drawn [Hz]. The estimate of the
velocity is made of joint speeds, which the encoders measure on the rotors. With it, contact drawn
and more pay for the velocity, five seeds land 499 of 500 jumps on the virtual robot, 99 at least
(docs/evidence/training.md, "Contact and rotors as the default")."""


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
    set_rotor_frequency(cfg, LOWEST_ROTOR_HZ)
    return cfg
