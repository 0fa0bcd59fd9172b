"""The training environment with few robots, made once for all tests of a process."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cache
from typing import Any

os.environ.setdefault("MJLAB_WARP_QUIET", "1")

ROBOTS = 8
GRIP = 3.0
"""Friction of the feet in the environment with noise: the most that D2 draws."""


@cache
def quiet() -> Any:
    """Nominal robots, nothing drawn, exact measurements."""
    from pronk.train.mdp.randomization import Randomization

    return _built(Randomization.none())


@cache
def noisy() -> Any:
    """Nominal robots on feet that grip, with the paper's measurement noise."""
    from pronk.train.mdp.randomization import Randomization

    paper = Randomization.paper()
    return _built(
        replace(
            Randomization.none(),
            friction=(GRIP, GRIP),
            position_noise=paper.position_noise,
            velocity_noise=paper.velocity_noise,
            angular_velocity_noise=paper.angular_velocity_noise,
            gravity_noise=paper.gravity_noise,
        )
    )


@cache
def drawn() -> Any:
    """Everything drawn, as in training."""
    from pronk.train.mdp.randomization import Randomization

    return _built(Randomization.paper())


def fresh(env: Any) -> Any:
    """The environment as it was when built: first phase, first step, nominal rate, seed 0."""
    from pronk.train.mdp.commands import motion_command
    from pronk.train.mdp.reward_sum import reward_sum
    from pronk.train.mdp.reward_table import ROWS
    from pronk.train.phases import PHASES, enter_phase

    reward_sum(env).set_rows(ROWS)
    enter_phase(env, PHASES[0])
    motion_command(env).scripted = False
    motion_command(env).ranges.grown.zero_()
    motion_command(env).ranges.kept.zero_()
    env.cfg.decimation = 4
    env.common_step_counter = 0
    motion_command(env)._motion_step = -1  # what was measured in that step was another's
    env.reset(seed=0)
    env.termination_manager.compute()  # no robot fell
    return env


def _built(randomization: Any) -> Any:
    import torch
    from mjlab.envs import ManagerBasedRlEnv

    from pronk.train.tasks import env_cfg

    torch.set_num_threads(1)  # so few robots are faster on one thread than on threads that wait
    return ManagerBasedRlEnv(env_cfg(num_envs=ROBOTS, randomization=randomization), device="cpu")
