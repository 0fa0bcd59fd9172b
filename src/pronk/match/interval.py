"""How far the matched gains can be believed: repeats are the unit of uncertainty.

Noise on a robot is coloured and neighbouring frequencies share it, so intervals that take
samples or frequencies for independent are several times too narrow. Repeats of the same question
are independent whatever the colour. Every repeat is fitted by itself, and the interval is
Student's t over the fits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pronk.match.refine import Fit, residual_db
from pronk.match.target import DB, FLOOR_DB

Array = NDArray[np.float64]

_SHARED = 1.5
"""Equivalent noise bandwidth of the Hann window in bins (Harris 1978, table 1): how many
neighbouring frequencies share their noise."""


@dataclass(frozen=True, kw_only=True)
class Interval:
    """Uncertainty of one joint's gains."""

    covariance: Array
    """Of (stiffness, damping), shape (2, 2)."""
    half_width: Array
    """Of the interval of each gain by itself, shape (2,)."""
    repeat_gains: Array
    """(stiffness, damping) of each repeat fitted by itself, shape (repeats, 2)."""
    flags: tuple[str, ...] = ()

    def around(self, gain: float, index: int) -> tuple[float, float]:
        """Interval of gain 0 (stiffness) or 1 (damping) around its value, not below zero."""
        half = float(self.half_width[index])
        return max(gain - half, 0.0), gain + half


def interval(fit: Fit, *, level: float = 0.95) -> Interval:
    """Interval of a fit, from the repeats of its measured response.

    Each repeat is fitted by one Gauss-Newton step from the common optimum, with the simulator's
    own derivatives there: repeats differ by little, and the step is exact to first order.

    With one repeat there is nothing to compare; the interval is then that of the coherence
    (Fisher information of the weighted fit, widened by the correlation of neighbouring
    frequencies and by the misfit), which takes noise for white, and a flag says so.
    """
    goal = fit.target
    optimum = np.array([fit.stiffness, fit.damping])
    count = len(goal.measured.repeats)
    if count < 2:
        return _from_coherence(fit, optimum, level)
    use_phase = len(fit.residual) > int(goal.inside.sum())
    measured = goal.measured.repeats[:, goal.inside]
    change = residual_db(goal, measured, goal.measured.response[goal.inside], use_phase)
    # The residual is simulated less measured: a larger answer asks for a larger simulated one.
    gains = optimum * np.exp(change @ fit.influence().T)
    spread = np.atleast_2d(np.cov(gains.T, ddof=1))
    covariance = spread / count
    quantile = float(stats.t.ppf(0.5 + level / 2.0, count - 1))
    flags: tuple[str, ...] = ()
    if count == 2:
        flags = ("two repeats: the interval is wide, three or more narrow it",)
    return Interval(
        covariance=covariance,
        half_width=quantile * np.sqrt(np.diag(covariance)),
        repeat_gains=gains,
        flags=flags,
    )


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
    quantile = float(stats.norm.ppf(0.5 + level / 2.0))
    return Interval(
        covariance=covariance,
        half_width=quantile * np.sqrt(np.diag(covariance)),
        repeat_gains=optimum[None, :],
        flags=("one repeat: the interval assumes white noise",),
    )


def measurement_error_db(fit: Fit, *, level: float = 0.95) -> float:
    """Root mean square half-width of the measured gain's own interval in the band [dB]."""
    goal = fit.target
    return float(DB * np.sqrt(np.mean(goal.measured.relative_error(level)[goal.inside] ** 2)))
