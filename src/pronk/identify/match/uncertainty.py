"""Confidence intervals of fitted parameters.

The unit of uncertainty is a block: a repeat of a sweep, or 20 s of a recording in time. Noise on a
robot is coloured and neighbouring frequencies and samples share it, so intervals that take them for
independent are several times too narrow; blocks are independent whatever the colour. Intervals are
Student's t over the blocks, which holds with as few as three.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pronk.arrays import Array
from pronk.identify.match.parameters import GAINS, PARAMETERS


def jackknife(moves: Array) -> Array:
    """Covariance of an optimum that moves by `moves` when one block is left out, shape (p, p).

    `(n - 1) / n sum (move - mean) (move - mean)^T` for moves of shape (n, p); where the optimum is
    the mean of n repeats, `moves = repeats / (n - 1)` gives their sample covariance over n.
    """
    about = moves - np.mean(moves, axis=0)
    count = len(moves)
    return np.asarray((count - 1) / count * about.T @ about)


def block_moves(jacobian: Array, residual: Array, blocks: NDArray[np.int64]) -> Array:
    """Where the optimum moves when one block of residuals is left out, shape (blocks, p).

    To first order `(A - A_b)^-1 J_b^T r_b` with A = J^T J and A_b = J_b^T J_b; `blocks` holds the
    number of the block of each residual, shape (m,).
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


def time_blocks(times: Sequence[Array], length_s: float) -> list[NDArray[np.int64]]:
    """Number of the block of each timestamp of some recordings [s], blocks of about `length_s`."""
    out, first = [], 0
    for time in times:
        span = time[-1] - time[0]
        count = max(round(span / length_s), 1)
        share = ((time - time[0]) / span * count).astype(np.int64)
        out.append(first + np.minimum(share, count - 1))
        first += count
    return out


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Parameters of one joint with their uncertainty."""

    values: Mapping[str, float]
    """Every parameter, fitted or held."""
    covariance: Array
    """Of (stiffness, damping), zero for what was held, shape (2, 2)."""
    sd: Mapping[str, float]
    """Standard deviation of each fitted parameter: relative, of delay and offset in [s], [rad]."""
    ci95: Mapping[str, tuple[float, float]]
    """95 % interval of each fitted parameter; empty without repeats."""
    repeat_gains: Array = field(default_factory=lambda: np.empty((0, 2)))
    """(stiffness, damping) of each repeat fitted by itself, shape (repeats, 2)."""
    flags: tuple[str, ...] = ()

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Fitted parameters whose deviation is beyond the limit of `PARAMETERS`."""
        return tuple(n for n, sd in self.sd.items() if not sd <= PARAMETERS[n].sd_max)


def estimate(
    fitted: Sequence[str],
    x: Array,
    covariance: Array,
    freedom: float,
    held: Mapping[str, float],
    *,
    symmetric: bool = False,
) -> Estimate:
    """Turn searched numbers `x`, shape (p,), into parameters with intervals.

    The covariance, shape (p, p), is that of the searched numbers, or of the parameters if
    `symmetric`: intervals are then symmetric about the parameters. With 0 degrees of `freedom`
    there are no intervals. `held` are the values of what was not fitted.
    """
    best = {name: PARAMETERS[name].unscaled(float(at)) for name, at in zip(fitted, x, strict=True)}
    sd, ci95 = np.sqrt(np.diag(covariance)), {}
    quantile = stats.t.ppf(0.975, freedom) if freedom else np.nan
    for name, at, half in zip(fitted, x, quantile * sd, strict=True):
        if symmetric:
            low, high = best[name] - half, best[name] + half
        else:
            # e^20 is as good as infinite and does not overflow.
            low, high = (PARAMETERS[name].unscaled(at + s * min(half, 20.0)) for s in (-1, 1))
        if freedom:
            ci95[name] = (float(max(low, 0.0) if PARAMETERS[name].log else low), float(high))
    scale = np.array([best[name] if PARAMETERS[name].log else 1.0 for name in fitted])
    if symmetric:
        sd = sd / scale
    else:
        covariance = covariance * np.outer(scale, scale)
    own, rows = np.zeros((2, 2)), [k for k, name in enumerate(GAINS) if name in fitted]
    columns = [fitted.index(GAINS[k]) for k in rows]
    own[np.ix_(rows, rows)] = covariance[np.ix_(columns, columns)]
    return Estimate(
        values={**held, **best},
        covariance=own,
        sd=dict(zip(fitted, sd.tolist(), strict=True)),
        ci95=ci95,
    )
