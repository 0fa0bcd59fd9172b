"""The ranges of the velocity commands: how they grow with the tracking performance."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pronk.errors import PronkError

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

from pronk.train.mdp.speed_ranges import Growth, SpeedRanges

pytestmark = pytest.mark.train

N = 9
ALL = torch.ones(N, dtype=torch.bool)


@pytest.mark.parametrize(
    ("steps", "fraction"), [(0, 0.3), (1250, 0.475), (2500, 0.65), (5000, 1.0), (9999, 1.0)]
)
def test_ranges_grow_in_proportion_to_the_steps(steps: int, fraction: float) -> None:
    ranges = SpeedRanges(Growth(start=0.3, steps=5000), "cpu")
    ranges.grown.fill_(steps)
    assert float(ranges.fraction) == pytest.approx(fraction)


def test_growth_follows_the_mean_tracking() -> None:
    """Six of nine track exactly, three are 2 m/s off, where the kernel is next to nothing."""
    ranges = SpeedRanges(Growth(no_growth_tracking=0.3, full_rate_tracking=0.5), "cpu")
    error = torch.zeros(N, 2)
    error[::3, 0] = 2.0
    tracking, grown = [], []
    for _ in range(400):
        ranges.advance(error, ALL)
        tracking.append(float(ranges.tracking))
        grown.append(float(ranges.grown))
    assert tracking == pytest.approx([2 / 3 * (1 - 0.99**k) for k in range(1, 401)], rel=1e-3)
    # 2/3 (1 - .99^k) is .3 at k = 59.5 and .5 at k = 137.9, and half way between at 91.2.
    assert (grown[58], grown[59] > 0.0) == (0.0, True)
    assert grown[91] - grown[90] == pytest.approx(0.5, abs=0.02)
    assert grown[399] - grown[138] == pytest.approx(400 - 139)
    for _ in range(200):  # none tracks: .65 .99^k falls below .3 in 78 steps
        before = float(ranges.grown)
        ranges.advance(torch.full((N, 2), 2.0), ALL)
    assert grown[399] + 26 < before < grown[399] + 78
    assert float(ranges.grown) == before


def test_robots_that_count() -> None:
    """Those in jump mode do not; one with a state that is not finite does, as not tracking."""
    ranges = SpeedRanges(Growth(), "cpu")
    error = torch.zeros(N, 2)
    error[0], error[1] = 5.0, math.nan
    walks = torch.arange(N) > 0
    for _ in range(2000):
        ranges.advance(error, walks)
    assert float(ranges.tracking) == pytest.approx(7 / 8, rel=1e-3)
    for _ in range(2000):
        ranges.advance(error, ~ALL)
    assert float(ranges.tracking) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    "wrong",
    [
        {"start": 0.0},
        {"start": 1.5},
        {"full_rate_tracking": 1.0},
        {"full_rate_tracking": math.nan},
        {"no_growth_tracking": 0.6},
        {"no_growth_tracking": -0.1},
        {"steps": 0},
    ],
)
def test_impossible_growth_is_refused(wrong: dict[str, Any]) -> None:
    (name, value), *_ = wrong.items()
    with pytest.raises(PronkError, match=f"{name} {value}"):
        Growth(**wrong)
