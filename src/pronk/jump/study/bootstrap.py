"""Intervals over seeds and jumps: the hierarchical bootstrap, widened for few seeds.

Policies of one arm differ by the seed of their training, jumps of one policy by their start and
noise. A resample draws seeds with replacement, and for each drawn seed its jumps with replacement,
command by command. Its distribution has the skewness of the data, but is too narrow for few seeds:
the variance of n values about their own mean is (n - 1) / n of the true one, and a normal quantile
stands where one of Student's t with n - 1 degrees of freedom belongs. Deviations from the estimate
are therefore stretched by sqrt(n / (n - 1)) t / z (after Hesterberg, "What Teachers Should Know
About the Bootstrap", 2015, who moves the quantile instead, which the smallest and largest seed
bound). Jumps are in the distribution twice, in the scatter of seeds and by themselves, so intervals
are a little too wide rather than too narrow where seeds do not differ.

An arm with a single seed has an estimate but no interval, and neither has a contrast in which it
counts. Drawn again and again the seed is always the same one, so that the arm's scatter over seeds
would be left out as if it were zero. Against n seeds of an arm that scatters as much the interval
would be sqrt(1 / (n + 1)) times as wide as it should be: 0.41 times with five. The scatter of other
arms is not put in its place, since arms do not scatter alike.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, t

from pronk.arrays import Array
from pronk.jump.trial.results import share_interval

RESAMPLES = 1999
"""Number of resamples; the ends of an interval are the 50th from each end."""
LEVEL = 0.95
"""Coverage of the intervals [1]."""

SeedValues = Sequence[Array]
"""Values of the jumps of one seed, an array (n,) for each command; NaN where there is no value."""


@dataclass(frozen=True, kw_only=True)
class SeedEstimate:
    """A mean over seeds, or a difference of two, with its 95 % interval."""

    value: float
    """NaN if no seed has a value."""
    low: float
    """NaN with fewer than two seeds that have a value."""
    high: float
    seeds: tuple[int, ...]
    """Number of seeds with a value, of each arm."""


def finite_seeds(seeds: Sequence[SeedValues]) -> list[list[Array]]:
    """Return the finite values of each seed by command; empty ones are left out."""
    kept = []
    for commands in seeds:
        strata = []
        for values in commands:
            numbers = np.asarray(values, dtype=float)
            numbers = numbers[np.isfinite(numbers)]
            if len(numbers):
                strata.append(numbers)
        if strata:
            kept.append(strata)
    return kept


def seed_mean(commands: SeedValues) -> float:
    """Return the mean of all finite values of one seed; NaN without any."""
    strata = finite_seeds([commands])
    if not strata:
        return math.nan
    return float(np.concatenate(strata[0]).mean())


def hierarchical_draws(
    seeds: Sequence[SeedValues], rng: np.random.Generator, resamples: int = RESAMPLES
) -> Array:
    """Draw means over seeds of the hierarchical bootstrap. (resamples,).

    Args:
        seeds: Finite values of each seed, by command.
        rng: Generator of all draws.
        resamples: Number of resamples.
    """
    return _weighted_draws([1.0], [[commands] for commands in seeds], rng, resamples)


def _weighted_draws(
    weights: Sequence[float],
    seeds: Sequence[Sequence[SeedValues]],
    rng: np.random.Generator,
    resamples: int,
) -> Array:
    """Draw means over seeds of a weighted sum of the means of several cells. (resamples,).

    Args:
        weights: Weight of each cell.
        seeds: Finite values of each seed, by cell and command.
        rng: Generator of all draws.
        resamples: Number of resamples.
    """
    count = len(seeds)
    drawn_seed = rng.integers(count, size=(resamples, count))
    means = np.empty((resamples, count))
    for index, cells in enumerate(seeds):
        slots = drawn_seed == index
        draws = int(slots.sum())
        weighted = np.zeros(draws)
        for weight, commands in zip(weights, cells, strict=True):
            total = np.zeros(draws)
            number = 0
            for values in commands:
                picked = rng.integers(len(values), size=(draws, len(values)))
                total += values[picked].sum(axis=1)
                number += len(values)
            weighted += weight * total / number
        means[slots] = weighted
    drawn: Array = means.mean(axis=1)
    return drawn


def mean_interval(
    seeds: Sequence[SeedValues], *, is_share: bool, rng_seed: int = 0, resamples: int = RESAMPLES
) -> SeedEstimate:
    """Return the mean over seeds with its interval.

    Args:
        seeds: Values of the jumps of each seed, by command; of a share 1 and 0.
        is_share: True for a share. Its interval is at least Wilson's over all jumps, which is not
            empty where all jumps ended alike, and stays within 0 and 1.
        rng_seed: Seed of the resamples.
        resamples: Number of resamples.
    """
    kept = finite_seeds(seeds)
    count = len(kept)
    if not count:
        return SeedEstimate(value=math.nan, low=math.nan, high=math.nan, seeds=(0,))
    value = float(np.mean([seed_mean(commands) for commands in kept]))
    if count < 2:
        return SeedEstimate(value=value, low=math.nan, high=math.nan, seeds=(count,))
    drawn = hierarchical_draws(kept, np.random.default_rng(rng_seed), resamples)
    low, high = _stretched(drawn, value, math.sqrt(count / (count - 1)), count - 1.0)
    if is_share:
        wilson_low, wilson_high = _wilson(kept)
        low = max(min(low, wilson_low), 0.0)
        high = min(max(high, wilson_high), 1.0)
    return SeedEstimate(value=value, low=low, high=high, seeds=(count,))


@dataclass(frozen=True, kw_only=True)
class WeightedCell:
    """The jumps of an arm on one robot, with their weight in a contrast."""

    weight: float
    seeds: Mapping[int, SeedValues]
    """Values of the jumps of each seed, by command."""


def contrast_interval(
    arms: Sequence[Sequence[WeightedCell]],
    *,
    is_share: bool,
    rng_seed: int = 0,
    resamples: int = RESAMPLES,
) -> SeedEstimate:
    """Return a weighted sum of the means of arms on robots, with its interval.

    Arms are independent: a seed of one arm has nothing in common with that of another but its
    number. The robots of one arm are not, since the same policies are on all of them: a resample
    draws the seeds of an arm once. Degrees of freedom are those of Welch and Satterthwaite.

    Args:
        arms: The cells of each arm, one for each robot. A seed without a value in one of them
            is left out of its arm. The contrast has no interval if an arm is left with one seed.
        is_share: True for shares. The interval is then at least that of the jumps alone, by the
            Wilson intervals of the cells after Newcombe (Zou and Donner, "Construction of
            confidence limits about effect measures", 2008).
        rng_seed: Seed of the resamples.
        resamples: Number of resamples.
    """
    rng = np.random.default_rng(rng_seed)
    value = 0.0
    deviations = np.zeros(resamples)
    variances = []
    counts = []
    kept_arms = []
    for cells in arms:
        weights = [cell.weight for cell in cells]
        kept = _complete_seeds(cells)
        count = len(kept)
        counts.append(count)
        if not count:
            value = math.nan
            continue
        totals = np.zeros(count)
        for index, seed in enumerate(kept):
            for weight, commands in zip(weights, seed, strict=True):
                totals[index] += weight * seed_mean(commands)
        mean = float(totals.mean())
        value += mean
        if count > 1:
            drawn = _weighted_draws(weights, kept, rng, resamples)
            deviations += (drawn - mean) * math.sqrt(count / (count - 1))
            variances.append(float(totals.var(ddof=1)) / count)
        kept_arms.append((weights, kept))
    if min(counts) < 2:
        return SeedEstimate(value=value, low=math.nan, high=math.nan, seeds=tuple(counts))
    freedom = _welch(variances, counts)
    low, high = _stretched(value + deviations, value, 1.0, freedom)
    if not is_share:
        return SeedEstimate(value=value, low=low, high=high, seeds=tuple(counts))
    squares_below = 0.0
    squares_above = 0.0
    largest = 0.0
    smallest = 0.0
    for weights, kept in kept_arms:
        for place, weight in enumerate(weights):
            seeds = [seed[place] for seed in kept]
            share = _pooled_share(seeds)
            wilson_low, wilson_high = _wilson(seeds)
            ends = sorted((weight * (wilson_low - share), weight * (wilson_high - share)))
            squares_below += ends[0] ** 2
            squares_above += ends[1] ** 2
            largest += max(weight, 0.0)
            smallest += min(weight, 0.0)
    low = max(min(low, value - math.sqrt(squares_below)), smallest)
    high = min(max(high, value + math.sqrt(squares_above)), largest)
    return SeedEstimate(value=value, low=low, high=high, seeds=tuple(counts))


def _complete_seeds(cells: Sequence[WeightedCell]) -> list[list[list[Array]]]:
    """Return the finite values by cell and command of each seed that has some in every cell."""
    complete = set(cells[0].seeds)
    for cell in cells[1:]:
        complete &= set(cell.seeds)
    kept = []
    for seed in sorted(complete):
        strata = finite_seeds([cell.seeds[seed] for cell in cells])
        if len(strata) == len(cells):
            kept.append(strata)
    return kept


def _stretched(drawn: Array, value: float, factor: float, freedom: float) -> tuple[float, float]:
    """Return the quantiles of a distribution, their distance from the estimate stretched."""
    tail = 0.5 * (1.0 - LEVEL)
    stretch = factor * float(t.ppf(1.0 - tail, freedom) / norm.ppf(1.0 - tail))
    low, high = np.quantile(drawn, [tail, 1.0 - tail])
    return value + stretch * (float(low) - value), value + stretch * (float(high) - value)


def _welch(variances: Sequence[float], counts: Sequence[int]) -> float:
    """Return the degrees of freedom of a sum of means after Welch and Satterthwaite."""
    total = math.fsum(variances)
    smallest = float(min(counts) - 1)
    if total <= 0.0:
        return smallest
    parts = 0.0
    for variance, count in zip(variances, counts, strict=True):
        parts += variance**2 / (count - 1)
    return max(total**2 / parts, smallest)


def _pooled_share(seeds: Sequence[SeedValues]) -> float:
    """Return the share of all jumps of all seeds."""
    jumps = np.concatenate([np.concatenate(commands) for commands in seeds])
    return float(jumps.mean())


def _wilson(seeds: Sequence[SeedValues]) -> tuple[float, float]:
    """Return Wilson's interval of the share of all jumps of all seeds."""
    jumps = np.concatenate([np.concatenate(commands) for commands in seeds])
    return share_interval(round(float(jumps.sum())), len(jumps))
