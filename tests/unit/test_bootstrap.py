"""Intervals over seeds and jumps: closed forms, and coverage of a simulated truth."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pronk.jump.study.bootstrap import (
    RESAMPLES,
    SeedEstimate,
    WeightedCell,
    contrast_interval,
    hierarchical_draws,
    mean_interval,
    seed_mean,
)
from pronk.jump.trial.results import share_interval

STUDIES = 300
"""Simulated studies of each case; the standard error of a coverage of 95 % is 1.3 %."""


def difference_interval(
    seeds: list[list[np.ndarray]],
    other_seeds: list[list[np.ndarray]],
    *,
    is_share: bool,
    rng_seed: int = 0,
    resamples: int = RESAMPLES,
) -> SeedEstimate:
    """Return the mean over some seeds less that over others, with its interval."""
    arms = []
    for weight, values in ((1.0, seeds), (-1.0, other_seeds)):
        arms.append([WeightedCell(weight=weight, seeds=dict(enumerate(values)))])
    return contrast_interval(arms, is_share=is_share, rng_seed=rng_seed, resamples=resamples)


def simulated_seeds(
    rng: np.random.Generator, *, seeds: int, jumps: int, between: float, within: float
) -> list[list[np.ndarray]]:
    """Return jumps of a mean of zero, a normal effect of each seed, and normal noise."""
    values = []
    for _ in range(seeds):
        effect = between * rng.standard_normal()
        values.append([effect + within * rng.standard_normal(jumps)])
    return values


def test_the_draws_have_the_variance_of_two_levels() -> None:
    """Var = (between-seed variance of the means + mean variance within / jumps) / seeds."""
    rng = np.random.default_rng(1)
    seeds = simulated_seeds(rng, seeds=6, jumps=15, between=1.0, within=2.0)
    drawn = hierarchical_draws(seeds, rng, 40_000)
    means = np.array([values[0].mean() for values in seeds])
    within = np.mean([values[0].var() / len(values[0]) for values in seeds])
    expected = (means.var() + within) / len(seeds)
    assert drawn.mean() == pytest.approx(means.mean(), abs=0.02)
    assert drawn.var() == pytest.approx(expected, rel=0.05)


def test_commands_are_resampled_by_themselves() -> None:
    """Commands that differ, with jumps that do not scatter, leave a mean without scatter."""
    seed = [np.full(5, 0.3), np.full(5, 0.9)]
    drawn = hierarchical_draws([seed, seed], np.random.default_rng(0), 500)
    assert np.allclose(drawn, 0.6)


@pytest.mark.parametrize("seeds", [3, 5, 10])
@pytest.mark.parametrize(("between", "within"), [(1.0, 1.0), (1.0, 0.1), (0.0, 1.0)])
def test_intervals_of_means_cover_the_truth(seeds: int, between: float, within: float) -> None:
    rng = np.random.default_rng(2)
    covered = 0
    for study in range(STUDIES):
        values = simulated_seeds(rng, seeds=seeds, jumps=20, between=between, within=within)
        estimate = mean_interval(values, is_share=False, rng_seed=study, resamples=399)
        covered += estimate.low <= 0.0 <= estimate.high
    coverage = covered / STUDIES
    assert coverage > 0.91
    if between > within:
        assert coverage < 0.985  # not so wide that they would cover anything


@pytest.mark.parametrize("seeds", [(3, 3), (5, 5), (5, 10)])
def test_intervals_of_differences_cover_the_truth(seeds: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    covered = 0
    for study in range(STUDIES):
        arm = simulated_seeds(rng, seeds=seeds[0], jumps=20, between=1.0, within=1.0)
        other = simulated_seeds(rng, seeds=seeds[1], jumps=20, between=0.5, within=1.0)
        shifted = [[values[0] - 0.7] for values in other]
        estimate = difference_interval(arm, shifted, is_share=False, rng_seed=study, resamples=399)
        covered += estimate.low <= 0.7 <= estimate.high
    assert covered / STUDIES > 0.92


def test_intervals_of_shares_cover_the_truth_where_seeds_fail_as_a_whole() -> None:
    """Each seed lands with a share of its own, drawn from a beta distribution of mean 0.9."""
    rng = np.random.default_rng(4)
    covered = 0
    for study in range(STUDIES):
        values = []
        for share in rng.beta(9.0, 1.0, size=5):
            values.append([(rng.random(50) < share).astype(float)])
        estimate = mean_interval(values, is_share=True, rng_seed=study, resamples=399)
        covered += estimate.low <= 0.9 <= estimate.high
    assert covered / STUDIES > 0.88


def test_a_share_without_failures_has_an_interval() -> None:
    seeds = [[np.ones(20)], [np.ones(20)], [np.ones(20)]]
    estimate = mean_interval(seeds, is_share=True)
    low, _ = share_interval(60, 60)
    assert (estimate.value, estimate.high) == (1.0, 1.0)
    assert estimate.low == pytest.approx(low)
    difference = difference_interval(seeds, seeds, is_share=True)
    assert difference.value == 0.0
    assert difference.low < -0.03
    assert difference.high > 0.03


def test_seeds_weigh_alike_whatever_their_number_of_jumps() -> None:
    seeds = [[np.full(2, 1.0)], [np.full(200, 0.0)]]
    assert mean_interval(seeds, is_share=False).value == 0.5


def test_unknown_values_are_left_out() -> None:
    seeds = [[np.array([1.0, math.nan])], [np.array([math.nan, math.nan])], [np.array([3.0])]]
    assert seed_mean(seeds[0]) == 1.0
    assert math.isnan(seed_mean(seeds[1]))
    estimate = mean_interval(seeds, is_share=False)
    assert estimate.value == 2.0
    assert estimate.seeds == (2,)


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_seeds_have_no_interval(count: int) -> None:
    seeds = [[np.array([1.0, 2.0])]] * count
    compared = [[np.array([1.0])], [np.array([2.0])]]
    for estimate in (
        mean_interval(seeds, is_share=False),
        difference_interval(seeds, compared, is_share=False),
        difference_interval(compared, seeds, is_share=True),
    ):
        assert math.isnan(estimate.low)
        assert math.isnan(estimate.high)


def test_a_contrast_is_the_weighted_sum_of_means() -> None:
    """Own less other robot, of two arms on two robots, in closed form."""
    means = {("a", "r"): 1.0, ("a", "s"): 2.0, ("b", "r"): 5.0, ("b", "s"): 11.0}
    weights = {("a", "r"): 0.5, ("a", "s"): -0.5, ("b", "r"): -0.5, ("b", "s"): 0.5}
    arms = []
    for arm in ("a", "b"):
        cells = []
        for robot in ("r", "s"):
            values = {seed: [np.full(4, means[arm, robot])] for seed in (1, 2, 3)}
            cells.append(WeightedCell(weight=weights[arm, robot], seeds=values))
        arms.append(cells)
    estimate = contrast_interval(arms, is_share=False)
    assert estimate.value == pytest.approx(0.5 * (1.0 - 2.0 - 5.0 + 11.0))
    assert (estimate.low, estimate.high) == pytest.approx((estimate.value, estimate.value))
    assert estimate.seeds == (3, 3)


def test_robots_weigh_alike_whatever_their_number_of_jumps() -> None:
    many = WeightedCell(weight=0.5, seeds={1: [np.zeros(100)], 2: [np.zeros(100)]})
    few = WeightedCell(weight=0.5, seeds={1: [np.ones(2)], 2: [np.ones(2)]})
    other = WeightedCell(weight=-1.0, seeds={1: [np.zeros(5)], 2: [np.zeros(5)]})
    assert contrast_interval([[many, few], [other]], is_share=True).value == 0.5


def test_what_a_seed_does_on_all_robots_cancels_in_a_contrast() -> None:
    """One policy on two robots has one effect of its seed, which own less other leaves out."""
    rng = np.random.default_rng(5)
    cells = []
    for weight in (1.0, -1.0):
        values = {}
        for seed in range(5):
            values[seed] = [10.0 * seed + 0.1 * rng.standard_normal(50)]
        cells.append(WeightedCell(weight=weight, seeds=values))
    together = contrast_interval([cells], is_share=False)
    apart = contrast_interval([cells[:1], cells[1:]], is_share=False)
    assert together.high - together.low < 0.5
    assert apart.high - apart.low > 10.0


def test_a_contrast_leaves_out_a_seed_that_one_robot_lacks() -> None:
    first = WeightedCell(weight=1.0, seeds={1: [np.ones(3)], 2: [np.ones(3)], 3: [np.ones(3)]})
    second = WeightedCell(weight=1.0, seeds={1: [np.ones(3)], 2: [np.full(3, math.nan)]})
    estimate = contrast_interval([[first, second]], is_share=False)
    assert estimate.seeds == (1,)
    assert math.isnan(estimate.low)


def test_intervals_of_contrasts_cover_the_truth() -> None:
    """Two arms on two robots; a seed has an effect on both robots and one on each."""
    rng = np.random.default_rng(6)
    covered = 0
    for study in range(STUDIES):
        arms = []
        for sign in (1.0, -1.0):
            cells: list[dict[int, list[np.ndarray]]] = [{}, {}]
            for seed in range(5):
                shared = rng.standard_normal()
                for place, values in enumerate(cells):
                    own = 0.4 if (place == 0) == (sign > 0.0) else 0.0
                    effect = own + shared + 0.5 * rng.standard_normal()
                    values[seed] = [effect + rng.standard_normal(10)]
            weights = (0.5 * sign, -0.5 * sign)
            arms.append(
                [
                    WeightedCell(weight=weight, seeds=values)
                    for weight, values in zip(weights, cells, strict=True)
                ]
            )
        estimate = contrast_interval(arms, is_share=False, rng_seed=study, resamples=399)
        covered += estimate.low <= 0.4 <= estimate.high
    assert covered / STUDIES > 0.92
