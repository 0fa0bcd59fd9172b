"""Training environments on Warp's CPU device, built once for all tests of a process."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache
from typing import Any

import pytest

pytest.importorskip("mjlab")

import torch
from mjlab.envs import ManagerBasedRlEnv
from torch import Tensor

from pronk.identify.match.gains import GroupGains
from pronk.jump.train.gains import TrainingGains, training_gains
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.mdp.observations import RANDOMIZED, randomized_parameters
from pronk.jump.train.phases import PHASES, STEPS_PER_ITERATION
from pronk.jump.train.tasks import load_task
from pronk.jump.train.tasks.jump_env_cfg import without_randomization
from pronk.robots import load_robot

N = 8
"""Robots of the nominal environment."""
MANY = 64
"""Robots of the randomized one."""
ITERATIONS = 10**9
"""Of each phase: no test comes to the end of one."""
ROBOT = load_robot("mini_cheetah")
MATCHED = TrainingGains(
    name="matched",
    robot="mini_cheetah",
    groups={
        "hip_roll": GroupGains(
            stiffness=20.0, damping=0.45, stiffness_range=2.0, damping_range=0.1
        ),
        "hip_pitch": GroupGains(
            stiffness=17.5, damping=0.4, stiffness_range=1.5, damping_range=0.05
        ),
        "knee": GroupGains(
            stiffness=21.5,
            damping=0.55,
            stiffness_range=1.0,
            damping_range=0.05,
            ellipsoid=((0.5, 0.008), (0.008, 0.0004)),
            ellipsoid_center=(22.0, 0.54),
        ),
    },
    delay_s=0.0055,
)
_starts = itertools.count(step=10**6)


def config(num_envs: int, gains: TrainingGains) -> Any:
    """Return the task's environment, with phases that do not end."""
    task = load_task("mini_cheetah")
    return task.env_cfg(
        task.robot, gains, iterations=dict.fromkeys(PHASES, ITERATIONS), num_envs=num_envs
    )


@cache
def nominal() -> Any:
    """Return `N` nominal robots with nominal gains, exact measurements, no delay."""
    cfg = config(N, training_gains("naive", ROBOT))
    without_randomization(cfg)
    return _built(cfg)


def by_joint_gains() -> TrainingGains:
    """Gains of each joint of its own: right and left differ, and so do their frictions."""
    joints = {}
    frictions = {}
    for number, joint in enumerate(ROBOT.joints):
        stiffness = 16.0 + number
        damping = 0.40 + 0.01 * number
        joints[joint.name] = GroupGains(
            stiffness=stiffness,
            damping=damping,
            stiffness_range=0.2,
            damping_range=0.004,
            ellipsoid=((0.04, 0.0006), (0.0006, 0.000016)),
            ellipsoid_center=(stiffness, damping),
        )
        frictions[joint.name] = (0.10 + 0.01 * number, 0.105 + 0.01 * number)
    return replace(
        MATCHED, joints=joints, frictions=frictions, delay_s=0.006, delay_span_s=(0.0055, 0.0065)
    )


@cache
def drawn_by_joint() -> Any:
    """Return `MANY` robots with gains by joint."""
    return _built(config(MANY, by_joint_gains()))


@cache
def randomized() -> Any:
    """Return `MANY` robots with matched gains and everything randomized, as in training."""
    return _built(config(MANY, MATCHED))


def _built(cfg: Any) -> Any:
    # So few robots are faster on one thread than on several that wait for each other.
    torch.set_num_threads(1)
    return ManagerBasedRlEnv(cfg, device="cpu")


def fresh(env: Any, phase: str = "walk", *, scripted: bool = False) -> Any:
    """Take the environment to the beginning of a phase and of all episodes, at the nominal rate."""
    command = motion_command(env)
    command.scripted = scripted
    command.ranges.grown.zero_()
    command.ranges.tracking.zero_()
    env.cfg.decimation = ROBOT.decimation
    # A step that was never counted, so that nothing measured before is taken for this step's.
    phase_start = list(PHASES).index(phase) * ITERATIONS * STEPS_PER_ITERATION
    env.common_step_counter = phase_start + next(_starts)
    env.reset(seed=0)
    command.velocity.zero_()
    command.jump.zero_()
    env.termination_manager.compute()  # no robot fell
    return env


def drawn(env: Any) -> dict[str, Tensor]:
    """The randomized parameters by name, (N, size) each; gains in the robot's order of joints."""
    parts = randomized_parameters(env)
    groups = len(ROBOT.groups)
    # Each group's gains are one part, leg by leg.
    stiffness = torch.stack(parts[-2 * groups : -groups], dim=-1).flatten(1)
    damping = torch.stack(parts[-groups:], dim=-1).flatten(1)
    numbers = [*parts[: -2 * groups], stiffness, damping]
    parameters = {}
    for name, part in zip(RANDOMIZED, numbers, strict=True):
        parameters[name] = part.clone()
    return parameters
