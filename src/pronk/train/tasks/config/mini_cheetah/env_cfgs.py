"""Environment of the Mini Cheetah: the shared one with the paper's randomization (D5, D6)."""

from __future__ import annotations

from typing import Any

from mjlab.envs import ManagerBasedRlEnvCfg

from pronk.robots.robot import RobotSpec
from pronk.train.gains import TrainingGains
from pronk.train.tasks.jump_env_cfg import jump_env_cfg


def env_cfg(robot: RobotSpec, gains: TrainingGains, **options: Any) -> ManagerBasedRlEnvCfg:
    """The environment; options are those of `jump_env_cfg`."""
    cfg = jump_env_cfg(robot, gains, **options)
    cfg.events["shank_length"].params["span"] = (0.18, 0.20)  # D5 [m]
    cfg.events["base_mass"].params["added"] = (-0.4, 1.6)  # D6 [kg]
    cfg.events["battery"].params["voltage"] = (22.2, 25.2)  # six cells, 3.7 to 4.2 V
    return cfg
