"""The end of an episode; physics gone wrong ends that of one robot alone."""

from __future__ import annotations

import math
from typing import Any

import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("mjlab")

import torch
from torch import Tensor

import training_env
from parts import where
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.mdp.observations import CRITIC
from training_env import N

pytestmark = pytest.mark.train

STILL = torch.zeros(N, 12)


@pytest.fixture
def env() -> Any:
    return training_env.fresh(training_env.nominal(), scripted=True)


def ends(env: Any, name: str) -> list[int]:
    """Return the robots whose episode a term would end in the present state."""
    cfg = env.termination_manager.get_term_cfg(name)
    return cfg.func(env, **cfg.params).nonzero().flatten().tolist()


def test_a_fall_is_a_lean_of_more_than_70_degrees_or_a_trunk_on_the_ground(env: Any) -> None:
    """In any direction, at any heading."""
    leans = [("x", 69.5), ("x", 70.5), ("y", -69.5), ("y", -70.5), ("x", -70.5), ("y", 180.0)]
    for i, (axis, angle) in enumerate(leans):
        turned = Rotation.from_euler("z", 40.0 * i, degrees=True)
        turned = turned * Rotation.from_euler(axis, angle, degrees=True)
        env.sim.data.qpos[i, 3:7] = torch.tensor(turned.as_quat(scalar_first=True)).float()
        env.sim.data.qpos[i, 2] = 1.0
    env.sim.data.qpos[6:, 2] = torch.tensor([0.079, 0.081])
    assert ends(env, "fell") == [1, 3, 4, 5, 6]


def test_implausible_states_are_found(env: Any) -> None:
    assert ends(env, "non_finite") == []
    qpos = env.sim.data.qpos
    qvel = env.sim.data.qvel
    qpos[0, 0] = math.nan
    qpos[1, 18] = math.inf
    qvel[2, 17] = -math.inf
    qpos[3, 7] = math.inf
    qpos[3, 8] = -math.inf
    qvel[4, 9] = 199.0
    qvel[5, 9] = -201.0
    qvel[6, 2] = 201.0
    assert ends(env, "non_finite") == [0, 1, 2, 3, 5, 6]


def play(env: Any, bad: dict[str, float]) -> list[list[Tensor]]:
    """Take ten steps from the same start; before the fourth, robot 3 gets bad numbers."""
    training_env.fresh(env, scripted=True)
    actions = torch.rand(10, N, 12, generator=torch.Generator().manual_seed(1)) - 0.5
    seen = []
    for step, action in enumerate(actions):
        if step == 3:
            for name, value in bad.items():
                getattr(env.sim.data, name)[3] = value
        observation, reward, *_ = env.step(action)
        groups = {name: group.clone() for name, group in observation.items()}
        # mjlab computes all forces anew when a robot resets.
        groups["critic"][:, where(CRITIC, "foot_force")] = 0.0
        data = env.sim.data
        seen.append([data.qpos.clone(), data.qvel.clone(), reward.clone(), *groups.values()])
        if step == 3 and bad:
            assert env.reset_terminated.tolist() == [i == 3 for i in range(N)]
            log = {name: float(value) for name, value in env.extras["log"].items()}
            assert log["Episode_Termination/non_finite"] == 1
            for name, value in log.items():
                assert math.isfinite(value), name
    return seen


@pytest.mark.parametrize(
    "bad",
    [{"qvel": math.nan}, {"qpos": math.nan}, {"qvel": math.inf}, {"qvel": 1e6}],
    ids=str,
)
def test_physics_gone_wrong_ends_one_episode_and_touches_no_other(
    env: Any, bad: dict[str, float]
) -> None:
    """State, rewards and observations of the other robots are equal bit for bit."""
    usual_steps = play(env, {})
    spoiled_steps = play(env, bad)
    other_robots = torch.arange(N) != 3
    for usual, spoiled in zip(usual_steps, spoiled_steps, strict=True):
        for usual_tensor, spoiled_tensor in zip(usual, spoiled, strict=True):
            assert torch.isfinite(spoiled_tensor).all()
            assert torch.equal(usual_tensor[other_robots], spoiled_tensor[other_robots])
    lengths = [10] * N
    lengths[3] = 6
    assert env.episode_length_buf.tolist() == lengths
    for name, value in vars(motion_command(env).state).items():
        if torch.is_tensor(value):
            assert torch.isfinite(value).all(), name


@pytest.mark.parametrize("decimation", [2, 4, 6])
def test_time_out_after_a_fixed_number_of_policy_steps(env: Any, decimation: int) -> None:
    """20 s at 50 Hz, however long each step takes (D1); not a fall."""
    env.cfg.decimation = decimation
    env.episode_length_buf[2] = 998
    env.step(STILL)
    assert not env.reset_buf.any()
    _, _, terminated, truncated, _ = env.step(STILL)
    assert truncated.tolist() == [i == 2 for i in range(N)]
    assert not terminated.any()
    assert env.episode_length_buf[2] == 0
