"""The drive law of training, gain draws and policy step lengths, without an environment."""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chisquare, kstest

pytest.importorskip("mjlab")

import torch

import training_env
from pronk.errors import PronkError, RobotError
from pronk.identify.match.gains import GroupGains
from pronk.jump.train.mdp.actions import DelayedJointPositionActionCfg
from pronk.jump.train.mdp.actuators import PositionDrive, drive_cfgs
from pronk.jump.train.mdp.events import check_ellipsoid, randomize_decimation, sample_gains
from pronk.jump.train.tasks.jump_env_cfg import without_randomization
from pronk.robots.motor import torque_limits
from training_env import MATCHED, ROBOT

pytestmark = pytest.mark.train


def test_drives_of_every_group() -> None:
    drives = drive_cfgs(ROBOT, MATCHED)
    assert [drive.target_names_expr for drive in drives] == [
        tuple(f"{leg}_{group}" for leg in ("FR", "FL", "HR", "HL")) for group in ROBOT.groups
    ]
    knee = drives[2]
    assert (knee.stiffness, knee.damping) == (21.5, 0.55)
    assert (knee.frictionloss, knee.viscous_damping) == (0.2, 0.01)
    # 72e-6 * 9.33^2; 17 N m * 9.33 / 6; 1.5 * 9.33 * .05 * 24 / .173; 24 / (2 * 9.33 * .05)
    found = (knee.armature, knee.effort_limit, knee.saturation_effort, knee.velocity_limit)
    assert found == pytest.approx((0.0062675, 26.435, 97.075, 25.723), rel=1e-4)
    with pytest.raises(PronkError, match="so101"):
        drive_cfgs(ROBOT, replace(MATCHED, robot="so101"))
    weak = replace(ROBOT.joint("FR_knee"), drive=ROBOT.joint("FR_hip_roll").drive)
    joints = tuple(weak if j.name == "FR_knee" else j for j in ROBOT.joints)
    with pytest.raises(RobotError, match="group knee"):
        drive_cfgs(replace(ROBOT, joints=joints), MATCHED)


@pytest.mark.parametrize("group", range(3))
def test_law_of_the_drives_is_that_of_the_actuator_model(group: int) -> None:
    """Over more than twice the no-load speed and torques far beyond the limits."""
    cfg = drive_cfgs(ROBOT, MATCHED)[group]
    draw = np.random.default_rng(group)
    target, position = draw.uniform(-4.0, 4.0, (2, 5000, 4))
    speed = draw.uniform(-60.0, 60.0, (5000, 4))
    stiffness, damping = draw.uniform(10.0, 30.0, (5000, 4)), draw.uniform(0.2, 0.8, (5000, 4))
    limits = (cfg.saturation_effort, cfg.velocity_limit, cfg.effort_limit)
    torque = stiffness * (target - position) - damping * speed
    expected = np.clip(torque, *torque_limits(speed, *limits))
    stall, no_load, limit = (np.full((5000, 4), value) for value in limits)
    params = {"stiffness": stiffness, "damping": damping, "back_emf": stall / no_load}
    params |= {"saturation_effort": stall, "force_limit": limit}
    params |= {"position_target": target, "pos": position, "vel": speed}
    tensors = {name: torch.as_tensor(value) for name, value in params.items()}
    found = PositionDrive.control_law(tensors, SimpleNamespace(**tensors))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert 0.1 < (np.abs(expected) < 0.999 * cfg.effort_limit).mean() < 0.9


def test_draws_from_the_ellipsoid() -> None:
    torch.manual_seed(1)
    knee = MATCHED.groups["knee"]
    x = np.float64(sample_gains(knee, "ellipsoid", 4000, "cpu").numpy())
    away = x - np.array(knee.ellipsoid_center)
    # The fraction of the ellipse's area within a draw is uniform in the ellipse.
    inside = np.einsum("ni,ij,nj->n", away, np.linalg.inv(knee.ellipsoid), away)
    np.testing.assert_allclose(np.cov(x.T), np.array(knee.ellipsoid) / 4, rtol=0.1)
    assert inside.min() >= -1e-5
    assert inside.max() <= 1.0 + 1e-5
    assert kstest(inside, "uniform").pvalue > 1e-3


@pytest.mark.parametrize(
    "changes",
    [
        {"ellipsoid": ((0.0, 0.0), (0.0, 0.0))},
        {"ellipsoid": ((0.5, 0.02), (0.02, 0.0004))},
        {"ellipsoid": ((1.0, 0.0), (0.0, 1.0)), "ellipsoid_center": (20.0, 0.5)},
    ],
)
def test_impossible_ellipsoids_are_refused(changes: dict[str, Any]) -> None:
    gains: GroupGains = replace(MATCHED.groups["knee"], **changes)
    with pytest.raises(PronkError, match="ellipsoid"):
        check_ellipsoid(gains)


def test_lengths_of_policy_steps_are_uniform_and_independent() -> None:
    env = SimpleNamespace(cfg=SimpleNamespace(decimation=0), common_step_counter=0)
    lengths = []
    for env.common_step_counter in range(5000):
        randomize_decimation(env, None, 4, (-2, 2))
        lengths.append(env.cfg.decimation)
    assert set(lengths) == {2, 3, 4, 5, 6}
    pairs = Counter(itertools.pairwise(lengths))
    assert chisquare([pairs[a, b] for a in range(2, 7) for b in range(2, 7)]).pvalue > 1e-3
    with pytest.raises(PronkError, match="decimation"):
        randomize_decimation(env, None, 4, (-4, 2))


@pytest.mark.parametrize(
    ("delay_s", "randomized", "fixed"),
    [(0.0055, (0, 2), (1, 1)), (0.0, (0, 1), (0, 0)), (0.0135, (2, 4), (3, 3))],
)
def test_delays_are_centred_on_the_matched_one(
    delay_s: float, randomized: tuple[int, int], fixed: tuple[int, int]
) -> None:
    cfg = training_env.config(1, replace(MATCHED, delay_s=delay_s))
    assert cfg.actions["joint_position"].delay_steps == randomized
    without_randomization(cfg, noise=True)
    assert cfg.actions["joint_position"].delay_steps == randomized
    assert set(cfg.events) == {"reset", "decimation"}
    without_randomization(cfg)
    assert cfg.actions["joint_position"].delay_steps == fixed
    assert set(cfg.events) == {"reset"}
    assert not cfg.observations["measured"].enable_corruption


@pytest.mark.parametrize("delay", [(2, 1), (-1, 1)])
def test_impossible_delays_are_refused(delay: tuple[int, int]) -> None:
    with pytest.raises(PronkError, match="delay_steps"):
        DelayedJointPositionActionCfg(
            entity_name="robot", actuator_names=(".*",), delay_steps=delay
        )
