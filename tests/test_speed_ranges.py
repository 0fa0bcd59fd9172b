"""The velocity ranges: how they grow, whom they wait for, and what a checkpoint knows of them."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pronk.errors import ArtefactError, PronkError

torch = pytest.importorskip("torch")

import small_env
from pronk.train.mdp.commands import motion_command
from pronk.train.mdp.speed_ranges import Growth, SpeedRanges

pytestmark = pytest.mark.train

N = 9
EVERYBODY = torch.ones(N, dtype=torch.bool)


@pytest.fixture
def env() -> Any:
    return small_env.fresh(small_env.quiet())


@pytest.mark.parametrize(
    ("steps", "part"), [(0, 0.3), (1250, 0.475), (2500, 0.65), (5000, 1.0), (9999, 1.0)]
)
def test_ranges_grow_in_proportion(env: Any, steps: int, part: float) -> None:
    """And commands are drawn from so much of them, and not more."""
    ranges = SpeedRanges(Growth(start=0.3, steps=5000), "cpu")
    ranges.grown.fill_(steps)
    assert float(ranges.part) == pytest.approx(part)
    command = motion_command(env)
    whole, command.ranges = command.ranges, ranges
    velocity = []
    for _ in range(200):
        command.reset(torch.arange(small_env.ROBOTS))
        velocity.append(command.velocity.clone())
    command.ranges = whole
    most, limits = torch.cat(velocity).abs().amax(dim=0), part * torch.tensor([3.0, 1.0, 2.0])
    assert (most <= limits + 1e-6).all()
    assert (most > 0.97 * limits).all()


def test_ranges_wait_for_who_does_not_keep_up() -> None:
    """Six of nine do as told, three stand: exp(-4 e^2) is 1 and, at 2 m/s, next to nothing."""
    ranges = SpeedRanges(Growth(lose=0.3, keep=0.5), "cpu")
    error = torch.zeros(N, 2)
    error[::3, 0] = 2.0
    seen = []
    for _ in range(400):
        ranges.advance(error, EVERYBODY)
        seen.append((float(ranges.kept), float(ranges.grown)))
    kept = [2 / 3 * (1.0 - 0.99**k) for k in range(1, 401)]
    assert [k for k, _ in seen] == pytest.approx(kept, rel=1e-3)
    # 2/3 (1 - .99^k) is .3 at k = 59.5 and .5 at k = 137.9, and half way between at 91.2.
    counted = [n for _, n in seen]
    assert counted[58] == 0.0
    assert counted[59] > 0.0
    assert counted[91] - counted[90] == pytest.approx(0.5, abs=0.02)
    assert counted[399] - counted[138] == pytest.approx(400 - 139)
    for _ in range(200):  # and then nobody: .65 .99^k falls below .3 in 78 steps
        before = float(ranges.grown)
        ranges.advance(torch.full((N, 2), 2.0), EVERYBODY)
    assert counted[399] + 26 < before < counted[399] + 78
    assert float(ranges.grown) == before


def test_who_counts() -> None:
    """Who jumps does not; a robot that is not a number does, and keeps nothing."""
    ranges = SpeedRanges(Growth(), "cpu")
    error = torch.zeros(N, 2)
    error[0], error[1] = 5.0, math.nan
    walks = EVERYBODY.clone()
    walks[0] = False
    for _ in range(2000):
        ranges.advance(error, walks)
    assert float(ranges.kept) == pytest.approx(7 / 8, rel=1e-3)
    for _ in range(2000):
        ranges.advance(error, ~EVERYBODY)
    assert float(ranges.kept) == pytest.approx(0.0, abs=1e-3), "nobody keeps nothing"


def test_ranges_grow_in_an_environment_that_is_told_what_its_robots_do(env: Any) -> None:
    """Everybody stands and is told to; a caller's commands teach nothing about it."""
    command = motion_command(env)
    for scripted in (False, True):
        command.scripted = scripted
        before = float(command.ranges.kept)
        for _ in range(5):
            command.velocity[:] = 0.0
            env.step(torch.zeros(small_env.ROBOTS, 12))
        assert (float(command.ranges.kept) > before + 0.02) is not scripted


def test_ranges_continue_from_a_checkpoint() -> None:
    ranges = SpeedRanges(Growth(), "cpu")
    ranges.resume({"speed_ranges": torch.tensor(1234.0)})
    assert ranges.grown == 1234.0
    with pytest.raises(ArtefactError, match="speed_ranges"):
        ranges.resume({})


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"start": 0.0}, "ranges begin with a part of 0.0; above 0, and 1 at most"),
        ({"start": 1.5}, "ranges begin with a part of 1.5"),
        ({"keep": 1.0}, "stay up to 0.36 and grow at full rate from 1.0; expected 0 or more"),
        ({"keep": math.nan}, "grow at full rate from nan"),
        ({"lose": 0.6}, "stay up to 0.6 and grow at full rate from 0.52"),
        ({"lose": -0.1}, "stay up to -0.1"),
        ({"steps": 0}, "ranges grow in 0 policy steps; 1 or more"),
    ],
)
def test_growth_that_is_none_is_refused(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(PronkError, match=said):
        Growth(**wrong)
