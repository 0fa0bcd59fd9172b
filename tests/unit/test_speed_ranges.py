"""The ranges of the velocity commands: how they grow with the tracking performance."""

from __future__ import annotations

import math

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

from pronk.jump.train.mdp.speed_ranges import DIRECTIONS, SpeedRanges, fast_commands

pytestmark = pytest.mark.train

N = 9
ALL = torch.ones(1, N, dtype=torch.bool)


def test_ranges_grow_in_proportion_to_the_steps() -> None:
    ranges = SpeedRanges("cpu")
    for steps, fraction in ((0, 0.35), (1250, 0.5125), (2500, 0.675), (5000, 1.0), (9999, 1.0)):
        ranges.grown.fill_(steps)
        assert float(ranges.fraction) == pytest.approx(fraction)


def test_growth_follows_the_mean_tracking() -> None:
    """Six of nine track exactly, three are 2 m/s off, where the kernel is next to nothing."""
    ranges = SpeedRanges("cpu")
    error = torch.zeros(N, 2)
    error[::3, 0] = 2.0
    tracking, grown = [], []
    for _ in range(400):
        ranges.advance(error, ALL)
        tracking.append(float(ranges.tracking))
        grown.append(float(ranges.grown))
    assert tracking == pytest.approx([2 / 3 * (1 - 0.99**k) for k in range(1, 401)], rel=1e-3)
    # 2/3 (1 - .99^k) is .36 at k = 77.3 and .52 at k = 150.6, and .44 at 107.3.
    assert (grown[76], grown[77] > 0.0) == (0.0, True)
    assert grown[107] - grown[106] == pytest.approx(0.5, abs=0.03)
    assert grown[399] - grown[151] == pytest.approx(400 - 152)
    for _ in range(200):  # none tracks: .655 .99^k falls below .36 in 60 steps
        before = float(ranges.grown)
        ranges.advance(torch.full((N, 2), 2.0), ALL)
    assert grown[399] + 22 < before < grown[399] + 60
    assert float(ranges.grown) == before


def test_robots_that_count() -> None:
    """Those in jump mode do not; one with a state that is not finite does, as not tracking."""
    ranges = SpeedRanges("cpu")
    error = torch.zeros(N, 2)
    error[0], error[1] = 5.0, math.nan
    walks = torch.arange(N)[None] > 0
    for _ in range(2000):
        ranges.advance(error, walks)
    assert float(ranges.tracking) == pytest.approx(7 / 8, rel=1e-3)
    before = float(ranges.tracking)
    ranges.advance(error, ~ALL)
    assert float(ranges.tracking) == before


def test_a_command_is_fast_by_its_share_of_the_range_in_use() -> None:
    limits = torch.tensor([2.0, 1.0, 2.0])
    velocity = torch.tensor([[0.0, 0.0], [0.49, 0.0], [-0.5, 0.0], [0.1, 0.25], [0.1, -0.24]])
    fast = fast_commands(velocity, limits, torch.tensor(0.5), 0.5)
    assert fast.any(dim=0).tolist() == [False, False, True, True, False]


def test_a_fast_command_belongs_to_the_direction_that_it_uses_most_of() -> None:
    limits = torch.tensor([2.0, 1.0, 2.0])
    velocity = torch.tensor([[1.6, 0.5], [-1.6, 0.5], [0.4, 0.9], [0.4, -0.9], [2.0, -2.0]])
    fast = fast_commands(velocity, limits, torch.tensor(1.0), 0.5)
    found = [DIRECTIONS[row] for row in fast.float().argmax(dim=0)]
    assert found == ["forward", "back", "left", "right", "right"]
    assert fast.sum(dim=0).tolist() == [1] * 5


def test_robots_that_stand_do_not_let_the_ranges_grow_where_fast_ones_count() -> None:
    """Eight stand as commanded, one that is commanded to walk does not."""
    error = torch.zeros(N, 2)
    error[0, 0] = 2.0
    velocity = -error
    limits = torch.tensor([2.0, 1.0, 2.0])
    by_all = SpeedRanges("cpu")
    by_fast = SpeedRanges("cpu", len(DIRECTIONS))
    for _ in range(400):
        by_all.advance(error, ALL)
        by_fast.advance(error, fast_commands(velocity, limits, by_fast.fraction, 0.5))
    assert float(by_all.grown) > 100.0
    assert float(by_fast.grown) == 0.0


def test_the_direction_that_is_tracked_worst_decides() -> None:
    """Runs back and sideways are exact, and robots stand when told to run forwards."""
    limits = torch.tensor([2.0, 1.0, 2.0])
    velocity = torch.tensor([[2.0, 0.0], [-2.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    ranges = SpeedRanges("cpu", len(DIRECTIONS))
    fast = fast_commands(velocity, limits, torch.tensor(1.0), 0.5)
    stands = torch.zeros(4, 2)
    stands[0] = -velocity[0]
    for _ in range(400):
        ranges.advance(stands, fast)
    assert float(ranges.grown) == 0.0
    for _ in range(400):
        ranges.advance(torch.zeros(4, 2), fast)
    assert float(ranges.grown) > 300.0
