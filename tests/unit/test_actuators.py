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
from mjlab.actuator import DcMotorActuator
from mjlab.actuator.actuator import ActuatorCmd

import training_env
from pronk.errors import PronkError, RobotError
from pronk.identify.match.gains import GroupGains
from pronk.jump.train.mdp.actions import DelayedJointPositionActionCfg
from pronk.jump.train.mdp.actuators import drive_cfgs
from pronk.jump.train.mdp.events import check_ellipsoid, randomize_decimation, sample_gains
from pronk.jump.train.tasks.jump_env_cfg import without_randomization
from pronk.robots.motor import torque_limits
from training_env import MATCHED, ROBOT

pytestmark = pytest.mark.train


def test_drives_of_every_group() -> None:
    drives = drive_cfgs(ROBOT, MATCHED)
    for group, drive in zip(ROBOT.groups, drives, strict=True):
        legs = ("FR", "FL", "HR", "HL")
        assert drive.target_names_expr == tuple(f"{leg}_{group}" for leg in legs)
    knee = drives[2]
    assert knee.stiffness == 21.5
    assert knee.damping == 0.55
    assert knee.frictionloss == 0.2
    assert knee.viscous_damping == 0.01
    assert knee.armature == pytest.approx(72e-6 * 9.33**2, rel=1e-4)
    assert knee.effort_limit == pytest.approx(17.0 * 9.33 / 6.0, rel=1e-4)
    # 1.5 * 9.33 * .05 * 24 / .173; 24 / (2 * 9.33 * .05)
    assert knee.saturation_effort == pytest.approx(97.075, rel=1e-4)
    assert knee.velocity_limit == pytest.approx(25.723, rel=1e-4)


def test_drives_of_another_robot_or_of_unlike_joints_are_refused() -> None:
    with pytest.raises(PronkError, match="so101"):
        drive_cfgs(ROBOT, replace(MATCHED, robot="so101"))
    weak_knee = replace(ROBOT.joint("FR_knee"), drive=ROBOT.joint("FR_hip_roll").drive)
    joints = []
    for joint in ROBOT.joints:
        joints.append(weak_knee if joint.name == "FR_knee" else joint)
    with pytest.raises(RobotError, match="group knee"):
        drive_cfgs(replace(ROBOT, joints=tuple(joints)), MATCHED)


@pytest.mark.parametrize("group", range(3))
def test_law_of_the_drives_is_that_of_the_actuator_model(group: int) -> None:
    """Over more than twice the no-load speed and torques far beyond the limits."""
    cfg = drive_cfgs(ROBOT, MATCHED)[group]
    draw = np.random.default_rng(group)
    shape = (5000, 4)
    target, position = draw.uniform(-4.0, 4.0, (2, *shape))
    speed = draw.uniform(-60.0, 60.0, shape)
    stiffness = draw.uniform(10.0, 30.0, shape)
    damping = draw.uniform(0.2, 0.8, shape)
    torque = stiffness * (target - position) - damping * speed
    low, high = torque_limits(speed, cfg.saturation_effort, cfg.velocity_limit, cfg.effort_limit)
    expected = np.clip(torque, low, high)
    params = {
        "stiffness": torch.as_tensor(stiffness),
        "damping": torch.as_tensor(damping),
        "saturation_effort": torch.full(shape, cfg.saturation_effort, dtype=torch.float64),
        "velocity_limit_motor": torch.full(shape, cfg.velocity_limit, dtype=torch.float64),
        "force_limit": torch.full(shape, cfg.effort_limit, dtype=torch.float64),
    }
    command = ActuatorCmd(
        position_target=torch.as_tensor(target),
        velocity_target=torch.zeros(shape, dtype=torch.float64),
        effort_target=torch.zeros(shape, dtype=torch.float64),
        pos=torch.as_tensor(position),
        vel=torch.as_tensor(speed),
    )
    computed = DcMotorActuator.control_law(params, command)
    np.testing.assert_allclose(computed, expected, rtol=1e-9, atol=1e-9)
    assert 0.1 < (np.abs(expected) < 0.999 * cfg.effort_limit).mean() < 0.9


def test_draws_from_the_ellipsoid() -> None:
    torch.manual_seed(1)
    knee = MATCHED.groups["knee"]
    gains = np.float64(sample_gains(knee, "ellipsoid", 4000, "cpu").numpy())
    offset = gains - np.array(knee.ellipsoid_center)
    # The fraction of the ellipse's area within a draw is uniform in the ellipse.
    inside = np.einsum("ni,ij,nj->n", offset, np.linalg.inv(knee.ellipsoid), offset)
    np.testing.assert_allclose(np.cov(gains.T), np.array(knee.ellipsoid) / 4, rtol=0.1)
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
    assert len(pairs) == 25
    assert chisquare(list(pairs.values())).pvalue > 1e-3
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
