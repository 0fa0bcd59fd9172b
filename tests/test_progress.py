"""Figures of episodes, and the line that says how far training has come."""

from __future__ import annotations

from io import StringIO
from typing import Any

import pytest

torch = pytest.importorskip("torch")

pytest.importorskip("tensordict")

from rich.console import Console
from tensordict import TensorDict
from torch.utils._python_dispatch import TorchDispatchMode

from pronk.train.rl.rollout import make_finite
from pronk.train.runner.progress import Episodes, ProgressLine, duration, rate

pytestmark = pytest.mark.train


def test_episodes_are_summed_from_end_to_end() -> None:
    episodes = Episodes(2, "cpu")
    # Robot 0: ends after 2 steps with 1 + 2. Robot 1: after 3 steps with 10 + 20 + 30.
    rewards = torch.tensor([[1.0, 10.0], [2.0, 20.0], [4.0, 30.0], [8.0, 40.0]])
    dones = torch.tensor([[0, 0], [1, 0], [0, 1], [0, 0]])
    for reward, done in zip(rewards, dones, strict=True):
        episodes.step(reward, done, {})
    figures = episodes.figures()
    assert figures["Train/mean_reward"] == (3.0 + 60.0) / 2
    assert figures["Train/mean_episode_length"] == 2.5
    assert episodes.returns.tolist() == [12.0, 40.0]
    assert episodes.lengths.tolist() == [2.0, 1.0]


def test_nothing_is_said_of_episodes_before_one_has_ended() -> None:
    episodes = Episodes(2, "cpu")
    episodes.step(torch.ones(2), torch.zeros(2), {})
    assert "Train/mean_reward" not in episodes.figures()


def test_means_are_of_the_last_hundred_episodes_or_a_little_more() -> None:
    episodes = Episodes(60, "cpu")
    for reward in (1.0, 2.0, 3.0):
        episodes.step(torch.full((60,), reward), torch.ones(60), {})
        figures = episodes.figures()
    assert figures["Train/mean_reward"] == 2.5  # 120 episodes; those of the first are out


def test_logged_figures_are_averaged_over_the_steps_that_gave_them() -> None:
    episodes = Episodes(1, "cpu")
    zero = torch.zeros(1)
    episodes.step(zero, zero, {"Episode_Reward/slip": torch.tensor(1.0), "height": 2})
    episodes.step(zero, zero, {})
    episodes.step(zero, zero, {"Episode_Reward/slip": torch.tensor([4.0])})
    figures = episodes.figures()
    assert figures["Episode_Reward/slip"] == 2.5
    assert figures["Episode/height"] == 2.0
    assert "Episode_Reward/slip" not in episodes.figures()


def test_environments_with_non_finite_physics_are_counted() -> None:
    episodes = Episodes(3, "cpu")
    wrong = torch.tensor([True, False, True])
    for total in (2.0, 4.0):
        episodes.step(torch.ones(3), torch.tensor([1, 0, 0]), {}, wrong)
        assert episodes.figures()["Train/non_finite"] == total


class Waits(TorchDispatchMode):
    """Counts what would make the host wait for a GPU."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        blocking = (torch.ops.aten._local_scalar_dense, torch.ops.aten.nonzero)
        self.count += func.overloadpacket in blocking
        return func(*args, **(kwargs or {}))


def test_no_step_waits_for_the_device() -> None:
    episodes = Episodes(4, "cpu")
    observations = TensorDict({"measured": torch.rand(4, 3)}, batch_size=[4])
    with Waits() as waits:
        wrong = make_finite(observations)
        episodes.step(torch.ones(4), torch.tensor([1, 0, 1, 0]), {"a/b": torch.ones(())}, wrong)
    assert waits.count == 0
    with Waits() as waits:
        episodes.figures()
    assert waits.count > 0  # the counter counts


def test_what_is_not_finite_becomes_zero_in_its_row_alone() -> None:
    nan, inf = float("nan"), float("inf")
    groups = {
        "measured": torch.tensor([[1.0, 2.0], [nan, 3.0], [4.0, 5.0]]),
        "critic": torch.tensor([[1.0], [2.0], [-inf]]),
    }
    observations = TensorDict(groups, batch_size=[3])
    assert make_finite(observations).tolist() == [False, True, True]
    assert observations["measured"].tolist() == [[1.0, 2.0], [0.0, 3.0], [4.0, 5.0]]
    assert observations["critic"].tolist() == [[1.0], [2.0], [0.0]]
    assert not bool(make_finite(observations).any())


def test_away_from_a_terminal_progress_is_a_plain_line_now_and_then() -> None:
    stream = StringIO()
    figures = {
        "Train/mean_reward": 12.345,
        "Train/mean_episode_length": 801.0,
        "Curriculum/speed_range": 0.4321,
        "Train/non_finite": 2.0,
        "Loss/value": 0.1,
    }
    with ProgressLine("walk", done=10, total=13, console=Console(file=stream)) as line:
        for done in (11, 12, 13):
            line.show(done, figures, steps=100)
    first, last = stream.getvalue().splitlines()
    assert first.startswith("walk 11/13  ")
    assert "  reward 12.35  episode 801 steps  speed_range 0.432  non-finite 2  " in first
    assert last.startswith("walk 13/13  ")
    assert last.endswith("  0 s left")
    assert "\x1b" not in stream.getvalue()


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.5, "0.5"), (253_412.0, "253 k"), (999_900.0, "1 M"), (1.254e6, "1.25 M"), (42.0, "42")],
)
def test_rates_are_short(value: float, text: str) -> None:
    assert rate(value) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.2, "0 s"),
        (59.4, "59 s"),
        (200.0, "3 min 20 s"),
        (3599.6, "1 h 00 min"),
        (3900.0, "1 h 05 min"),
    ],
)
def test_durations_are_short(seconds: float, text: str) -> None:
    assert duration(seconds) == text
