"""Figures over many jumps: spreads, success rates, and the scatter of one policy over another's."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

RESAMPLES = 4999
"""Of a bootstrap."""
FEWEST = 5
"""Jumps, the paper's number, below which a sample drawn from itself is too often one jump alone,
which does not scatter: the bootstrap then has no interval to give."""


@dataclass(frozen=True, kw_only=True)
class Spread:
    """A figure over many jumps; unknown values are left out. NaN where there are none."""

    mean: float
    std: float
    """With n - 1; NaN for one."""
    least: float
    p05: float
    p50: float
    p95: float
    most: float
    n: int
    """Jumps that have the figure."""

    @classmethod
    def of(cls, values: ArrayLike) -> Self:
        """Sum up one value a jump."""
        known = np.asarray(values, dtype=float)
        known = known[np.isfinite(known)]
        if not len(known):
            return cls(n=0, **dict.fromkeys(_STATISTICS, math.nan))
        quantiles = np.quantile(known, [0.0, 0.05, 0.5, 0.95, 1.0])
        return cls(
            **dict(zip(_STATISTICS[2:], quantiles.tolist(), strict=True)),
            mean=float(known.mean()),
            std=float(known.std(ddof=1)) if len(known) > 1 else math.nan,
            n=len(known),
        )


_STATISTICS = ("mean", "std", "least", "p05", "p50", "p95", "most")


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One policy with one command."""

    policy: str
    case: str
    n: int
    """Jumps asked for."""
    told: int
    """Robots that had not fallen when the jump input came."""
    found: int
    """Jumps there were."""
    succeeded: int
    """Of those, with a good landing."""
    success: float
    """Share of all n."""
    success_ci95: tuple[float, float]
    """Wilson's interval of it."""
    fell: int
    figures: Mapping[str, Spread]
    joints: Mapping[str, Mapping[str, Spread]]
    """Figures that every joint has: by figure, then by joint."""


@dataclass(frozen=True, kw_only=True)
class Ratio:
    """Scatter of another policy over that of the first."""

    figure: str
    case: str | None
    """None: sums of the standard deviations over the paper's commands, which is the ratio of their
    means (reading A4); over all, where none of the paper's was tried."""
    policy: str
    other: str
    value: float
    """Standard deviation of the other over that of the first."""
    low: float
    high: float
    """95 % bootstrap interval; NaN with fewer than `FEWEST` jumps of either policy in a command."""
    n: tuple[int, int]
    """Jumps of the first and of the other."""


def share_interval(count: int, n: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    from scipy.stats import binomtest

    interval = binomtest(count, n).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def ratio_of_scatter(
    own: list[Array], others: list[Array], *, seed: int, resamples: int = RESAMPLES
) -> tuple[float, float, float]:
    """Sum of the standard deviations of `others` over that of `own`, and its 95 % interval.

    The interval is a bootstrap's, percentile by percentile: every sample is drawn anew from itself,
    independently. NaN where a sample has fewer than two values or `own` does not scatter; with
    fewer than `FEWEST` values in a sample the interval alone is NaN.

    Args:
        own: One sample of a figure for each command.
        others: The same of the other policy.
        seed: Of the bootstrap.
        resamples: How many times.

    Returns:
        (ratio, low, high)
    """
    from scipy.stats import DegenerateDataWarning, bootstrap

    least = 1e-9 * max((float(np.abs(each).max()) for each in own if len(each)), default=0.0)

    def ratio(*samples: Array, axis: int = -1) -> Array:
        spreads = [np.std(sample, axis=axis, ddof=1) for sample in samples]
        above, below = sum(spreads[len(own) :]), sum(spreads[: len(own)])
        # A resample of one value alone has no scatter but rounding; it says nothing.
        known = np.asarray(below) > least
        out = np.full(np.shape(below), np.nan)
        share: Array = np.divide(above, below, out=out, where=known)
        return share

    samples = (*own, *others)
    if min(map(len, samples)) < 2:
        return math.nan, math.nan, math.nan
    value = float(ratio(*samples))
    if not math.isfinite(value):
        return math.nan, math.nan, math.nan
    if min(map(len, samples)) < FEWEST:
        return value, math.nan, math.nan
    with warnings.catch_warnings():
        # Of resamples without scatter, which the quantiles below leave out.
        warnings.simplefilter("ignore", DegenerateDataWarning)
        drawn = bootstrap(
            samples,
            ratio,
            n_resamples=resamples,
            vectorized=True,
            method="percentile",
            rng=np.random.default_rng(seed),
            batch=1000,
        ).bootstrap_distribution
    low, high = np.nanquantile(drawn, [0.025, 0.975])
    return value, float(low), float(high)
