"""Uncertainty of fitted parameters: a delete-one-block jackknife, linearized at the optimum.

A block is a repeat of a sweep, or 20 s of a recording in time. Noise on a robot is coloured and
neighbouring frequencies and samples share it, so intervals that take them for independent are
several times too narrow; repeats and long blocks are independent whatever the colour. The interval
is Student's t over the blocks, which holds with as few as three; with many repeats the bootstrap
over them assumes no normal distribution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pronk.errors import IdentifiabilityError
from pronk.match.measured_joint import DB, FLOOR_DB
from pronk.match.parameters import PARAMETERS
from pronk.match.refine import Fit, residual_db

Array = NDArray[np.float64]

_SHARED = 1.5
"""Equivalent noise bandwidth of the Hann window in bins (Harris 1978, table 1): how many
neighbouring frequencies share their noise."""

BOOTSTRAP_REPEATS = 8
"""Fewest repeats to resample: with n of them the bootstrap's spread is too small by
sqrt((n - 1) / n), and its tails hold no more than the repeats do."""
_RESAMPLES = 2000


def jackknife(moves: Array) -> Array:
    """Covariance of an optimum that moves by `moves` when one block is left out.

    `(n - 1) / n sum (move - mean) (move - mean)^T`; where the optimum is the mean of n repeats,
    `moves = repeats / (n - 1)` gives their sample covariance over n.

    Args:
        moves: Shape (n, p).

    Returns:
        Shape (p, p).
    """
    about = moves - np.mean(moves, axis=0)
    count = len(moves)
    return np.asarray((count - 1) / count * about.T @ about)


def block_moves(jacobian: Array, residual: Array, blocks: NDArray[np.int64]) -> Array:
    """Where the optimum moves when one block of residuals is left out, to first order.

    `(A - A_b)^-1 J_b^T r_b` with A = J^T J and A_b = J_b^T J_b.

    Args:
        jacobian: Shape (m, p).
        residual: Shape (m,).
        blocks: Number of the block of each residual, shape (m,).

    Returns:
        Shape (blocks, p).
    """
    whole = jacobian.T @ jacobian
    # A parameter without effect must come out as very uncertain, not as an error.
    whole = whole + 1e-12 * np.trace(whole) * np.eye(len(whole))
    moves = []
    for number in np.unique(blocks):
        own = jacobian[blocks == number]
        left = whole - own.T @ own
        moves.append(np.linalg.lstsq(left, own.T @ residual[blocks == number], rcond=None)[0])
    return np.array(moves)


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Fitted parameters of one joint with their uncertainty."""

    values: Mapping[str, float]
    """Every parameter, fitted or held."""
    fitted: tuple[str, ...]
    covariance: Array
    """Of (stiffness, damping), zero for what was held, shape (2, 2)."""
    sd: Mapping[str, float]
    """Standard deviation of each fitted parameter: relative, of delay and offset in [s], [rad]."""
    ci95: Mapping[str, tuple[float, float]]
    """95 % interval of each fitted parameter, Student's t; empty without repeats."""

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Fitted parameters whose deviation is beyond the limit of `PARAMETERS`."""
        return tuple(n for n in self.fitted if not self.sd[n] <= PARAMETERS[n].sd_max)


def estimate(
    fitted: Sequence[str], x: Array, covariance: Array, freedom: int, held: Mapping[str, float]
) -> Estimate:
    """Turn searched numbers into parameters with intervals.

    Args:
        fitted: Names of the searched numbers.
        x: The optimum, shape (p,).
        covariance: Of the searched numbers, shape (p, p).
        freedom: Degrees of freedom of the covariance; with 0 there are no intervals.
        held: Values of the parameters that were not fitted.
    """
    kinds = [PARAMETERS[name] for name in fitted]
    sd = np.sqrt(np.diag(covariance))
    slope = np.array([kind.slope(float(value)) for kind, value in zip(kinds, x, strict=True)])
    own = covariance * np.outer(slope, slope)
    places = [fitted.index(name) if name in fitted else None for name in ("stiffness", "damping")]
    ci95 = {}
    if freedom:
        # e^20 is as good as infinite and does not overflow.
        half = np.minimum(sd * float(stats.t.ppf(0.975, freedom)), 20.0)
        for name, kind, value, reach in zip(fitted, kinds, x, half, strict=True):
            floor = -np.inf if name == "offset" else 0.0
            ci95[name] = (max(kind.unscaled(value - reach), floor), kind.unscaled(value + reach))
    values = {name: kind.unscaled(float(v)) for name, kind, v in zip(fitted, kinds, x, strict=True)}
    return Estimate(
        values={**held, **values},
        fitted=tuple(fitted),
        covariance=np.array(
            [[0.0 if i is None or j is None else own[i, j] for j in places] for i in places]
        ),
        sd=dict(zip(fitted, sd.tolist(), strict=True)),
        ci95=ci95,
    )


@dataclass(frozen=True, kw_only=True)
class Interval:
    """Uncertainty of one joint's gains."""

    covariance: Array
    """Of (stiffness, damping), shape (2, 2)."""
    below: Array
    """From the lower end of each gain's own interval to the gain, shape (2,)."""
    above: Array
    """From the gain to the upper end, shape (2,)."""
    repeat_gains: Array
    """(stiffness, damping) of each repeat fitted by itself, shape (repeats, 2)."""
    flags: tuple[str, ...] = ()

    def around(self, gain: float, index: int) -> tuple[float, float]:
        """Interval of gain 0 (stiffness) or 1 (damping) around its value, not below zero."""
        return max(gain - float(self.below[index]), 0.0), gain + float(self.above[index])


def interval(
    fit: Fit, *, level: float = 0.95, method: Literal["student", "bootstrap"] = "student"
) -> Interval:
    """Interval of a fit, from the repeats of its measured response.

    Each repeat is fitted by one Gauss-Newton step from the common optimum, with the simulator's
    own derivatives there: repeats differ by little, and the step is exact to first order.

    With one repeat there is nothing to compare; the interval is then that of the coherence
    (Fisher information of the weighted fit, widened by the correlation of neighbouring
    frequencies and by the misfit), which takes noise for white, and a flag states it.

    Args:
        fit: The fit.
        level: Share of such intervals that shall hold the true value.
        method: `student`, or `bootstrap` (bias-corrected and accelerated, over repeats).

    Raises:
        IdentifiabilityError: Too few repeats for the bootstrap.
    """
    goal = fit.target
    optimum = np.array([fit.stiffness, fit.damping])
    count = len(goal.measured.repeats)
    if method == "bootstrap" and count < BOOTSTRAP_REPEATS:
        raise IdentifiabilityError(
            f"{goal.joint}: a bootstrap over {count} repeats covers too little; record "
            f"{BOOTSTRAP_REPEATS} or more, or take the student interval, which holds with three."
        )
    if count < 2:
        return _from_coherence(fit, optimum, level)
    use_phase = len(fit.residual) > int(goal.fit_mask.sum())
    measured = goal.measured.repeats[:, goal.fit_mask]
    change = residual_db(goal, measured, goal.measured.response[goal.fit_mask], use_phase)
    # Residuals are simulated less measured: a larger measured response needs larger gains there.
    gains = optimum * np.exp(change @ fit.influence().T)
    covariance = jackknife(gains / (count - 1))
    if method == "bootstrap":
        below, above = _bootstrapped(gains, level)
    else:
        quantile = float(stats.t.ppf(0.5 + level / 2.0, count - 1))
        below = above = quantile * np.sqrt(np.diag(covariance))
    flags: tuple[str, ...] = ()
    if count == 2:
        flags = ("two repeats: the interval is wide, three or more narrow it",)
    return Interval(
        covariance=covariance,
        below=below,
        above=above,
        repeat_gains=gains,
        flags=flags,
    )


def _bootstrapped(gains: Array, level: float) -> tuple[Array, Array]:
    """How far the interval of the mean reaches below and above it, each shape (2,)."""
    ends = stats.bootstrap(
        (gains,),
        np.mean,
        axis=0,
        confidence_level=level,
        n_resamples=_RESAMPLES,
        method="BCa",
        rng=np.random.default_rng(0),
    ).confidence_interval
    mean = gains.mean(axis=0)
    return mean - ends.low, ends.high - mean


def _from_coherence(fit: Fit, optimum: Array, level: float) -> Interval:
    """Interval from the coherence of a single repeat."""
    goal = fit.target
    variance = np.maximum(goal.deviation_db() ** 2 - FLOOR_DB**2, 0.0)
    if len(fit.residual) > len(variance):
        variance = np.concatenate([variance, variance])
    influence = fit.influence()
    free = max(len(fit.residual) - fit.jacobian.shape[1], 1)
    misfit = max(1.0, float(fit.weight @ fit.residual**2) / free)
    relative = _SHARED * misfit * (influence * variance) @ influence.T
    covariance = relative * np.outer(optimum, optimum)
    half = float(stats.norm.ppf(0.5 + level / 2.0)) * np.sqrt(np.diag(covariance))
    return Interval(
        covariance=covariance,
        below=half,
        above=half,
        repeat_gains=optimum[None, :],
        flags=("one repeat: the interval assumes white noise",),
    )


def measurement_error_db(fit: Fit, *, level: float = 0.95) -> float:
    """Root mean square half-width of the measured gain's own interval in the band [dB]."""
    goal = fit.target
    return float(DB * np.sqrt(np.mean(goal.measured.relative_error(level)[goal.fit_mask] ** 2)))
