"""When an episode ends, and that physics gone wrong is one robot's own affair."""

from __future__ import annotations

import math
from typing import Any

import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("mjlab")
pytestmark = pytest.mark.train

import torch
from torch import Tensor

import small_env
from parts import where
from pronk.train.mdp.commands import motion_command
from pronk.train.mdp.observations import CRITIC
from pronk.train.mdp.reward_sum import reward_sum

N = small_env.ROBOTS
STILL = torch.zeros(N, 12)
FORCE = slice(54, 58)
"""Forces of the feet, in the critic's vector."""


@pytest.fixture(scope="module")
def built() -> Any:
    return small_env.quiet()


@pytest.fixture
def env(built: Any) -> Any:
    small_env.fresh(built)
    motion_command(built).scripted = True
    return built


def ends(env: Any, name: str) -> list[bool]:
    """Whose episode a term would end in the present state."""
    cfg = env.termination_manager.get_term_cfg(name)
    found: list[bool] = cfg.func(env, **cfg.params).tolist()
    return found


def only(*robots: int) -> list[bool]:
    return [i in robots for i in range(N)]


# --- Falls ----------------------------------------------------------------------------------------


def test_a_lean_of_more_than_70_degrees_is_a_fall(env: Any) -> None:
    """In whatever direction, and whatever the heading."""
    for i, (axis, angle) in enumerate(
        [("x", 69.5), ("x", 70.5), ("y", -69.5), ("y", -70.5), ("x", -70.5), ("y", 180.0)]
    ):
        leaning = Rotation.from_euler("z", 40.0 * i, degrees=True)
        leaning = leaning * Rotation.from_euler(axis, angle, degrees=True)
        env.sim.data.qpos[i, 3:7] = torch.tensor(leaning.as_quat(scalar_first=True)).float()
        env.sim.data.qpos[i, 2] = 1.0
    assert ends(env, "fell") == only(1, 3, 4, 5)


def test_a_trunk_on_the_ground_is_a_fall(env: Any) -> None:
    env.sim.data.qpos[:3, 2] = torch.tensor([0.079, 0.081, 0.05])
    assert ends(env, "fell") == only(0, 2)


def test_a_fall_ends_the_episode_of_one_robot(env: Any) -> None:
    env.step(STILL)
    env.sim.data.qpos[6, 2:7] = torch.tensor([0.1, 0.0, 1.0, 0.0, 0.0])  # on its back
    _, _, terminated, truncated, _ = env.step(STILL)
    assert terminated.tolist() == only(6)
    assert not truncated.any()
    assert env.episode_length_buf.tolist() == [0 if i == 6 else 2 for i in range(N)]
    assert env.sim.data.qpos[6, 2] > 0.25


# --- Physics gone wrong ---------------------------------------------------------------------------


def test_a_robot_as_usual_is_finite(env: Any) -> None:
    for _ in range(3):
        env.step(2.0 * torch.rand(N, 12) - 1.0)
    assert ends(env, "non_finite") == only()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_noticed_wherever_it_is(env: Any, bad: float) -> None:
    qpos, qvel = env.sim.data.qpos, env.sim.data.qvel
    qpos[0, 0] = qpos[1, 5] = qpos[2, 18] = bad
    qvel[3, 0] = qvel[4, 17] = bad
    assert ends(env, "non_finite") == only(0, 1, 2, 3, 4)


def test_infinities_do_not_cancel(env: Any) -> None:
    env.sim.data.qpos[2, 7], env.sim.data.qpos[2, 8] = math.inf, -math.inf
    assert ends(env, "non_finite") == only(2)


def test_speeds_that_no_robot_has(env: Any) -> None:
    """200 rad/s is five times what an unloaded drive can do."""
    env.sim.data.qvel[1, 9], env.sim.data.qvel[2, 9] = 199.0, -201.0
    env.sim.data.qvel[3, 2] = 201.0
    assert ends(env, "non_finite") == only(2, 3)


def played(env: Any, bad: dict[str, float]) -> list[tuple[Tensor, ...]]:
    """Ten steps from the same start; in the fourth, robot 3 gets bad numbers."""
    small_env.fresh(env)
    motion_command(env).scripted = True
    actions = torch.rand(10, N, 12, generator=torch.Generator().manual_seed(1)) - 0.5
    seen = []
    for step, action in enumerate(actions):
        if step == 3:
            for name, value in bad.items():
                getattr(env.sim.data, name)[3] = value
        observation, reward, *_ = env.step(action)
        data = env.sim.data
        groups = {name: group.clone() for name, group in observation.items()}
        # mjlab computes all drives anew when somebody resets, and the feet's forces with them.
        groups["critic"][:, FORCE] = 0.0
        assert all(torch.isfinite(group).all() for group in observation.values())
        seen.append((data.qpos.clone(), data.qvel.clone(), reward.clone(), *groups.values()))
        if step == 3 and bad:
            assert env.termination_manager.get_term("non_finite").tolist() == only(3)
            assert env.reset_terminated.tolist() == only(3)
            assert env.extras["log"]["Episode_Termination/non_finite"] == 1
            assert env.episode_length_buf.tolist() == [0 if i == 3 else 4 for i in range(N)]
    return seen


@pytest.mark.parametrize(
    "bad",
    [{"qvel": math.nan}, {"qpos": math.nan}, {"qvel": math.inf}, {"qvel": 1e6}],
    ids=str,
)
def test_physics_gone_wrong_ends_one_robot_and_touches_no_other(
    env: Any, bad: dict[str, float]
) -> None:
    """State, rewards and observations of the others are, bit for bit, as if nothing were.

    But for one part of what the critic reads, see `played`.
    """
    assert where(CRITIC, "foot_force") == FORCE
    usual, wrong = played(env, {}), played(env, bad)
    others = torch.arange(N) != 3
    for step, (expected, found) in enumerate(zip(usual, wrong, strict=True)):
        for a, b in zip(expected, found, strict=True):
            assert torch.isfinite(b).all(), step
            assert torch.equal(a[others], b[others]), step
    assert env.episode_length_buf.tolist() == [6 if i == 3 else 10 for i in range(N)]
    assert not env.termination_manager.get_term("non_finite").any()


def test_logged_rewards_stay_finite(env: Any) -> None:
    env.step(STILL)
    env.sim.data.qvel[3] = math.nan
    env.step(STILL)
    logged = {name: float(value) for name, value in env.extras["log"].items()}
    assert all(math.isfinite(value) for value in logged.values()), logged
    table = reward_sum(env)
    assert torch.isfinite(table.values).all()
    env.step(STILL)
    tracker = motion_command(env).tracker
    for name, value in vars(tracker).items():
        assert not torch.is_tensor(value) or torch.isfinite(value).all(), name


# --- Time -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("decimation", [2, 4, 6])
def test_an_episode_has_a_fixed_number_of_policy_steps(env: Any, decimation: int) -> None:
    """20 s at 50 Hz, however long each step takes (D1); the end of time is no fall."""
    env.cfg.decimation = decimation
    env.episode_length_buf[2] = 998
    env.step(STILL)
    assert env.reset_buf.tolist() == only()
    _, _, terminated, truncated, _ = env.step(STILL)
    assert truncated.tolist() == only(2)
    assert not terminated.any()
    assert env.episode_length_buf[2] == 0
