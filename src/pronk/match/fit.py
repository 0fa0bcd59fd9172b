"""Least squares over parameters of joint drives: problems, solvers, uncertainty.

Every fit is a `Problem`: residuals and their Jacobian as functions of searched numbers. Another
kind of measurement is another subclass; solvers and uncertainty stay the same. The unit of
uncertainty is a block: a repeat of a sweep, or 20 s of a recording in time. Noise on a robot is
coloured and neighbouring frequencies and samples share it, so intervals that take them for
independent are several times too narrow; blocks are independent whatever the colour. Intervals are
Student's t over the blocks, which holds with as few as three.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import least_squares

from pronk.match.parameters import GAINS, PARAMETERS

Array = NDArray[np.float64]

_AT_BOUND = 1e-3
_LONGEST = 0.3
"""Longest step of one round of `solve_together`."""
_SETTLED = 3e-4
"""A problem of `solve_together` whose next step is shorter is done: 0.03 % of a gain."""
_ROUNDS = 12
"""Three or four are usual."""


class Problem(ABC):
    """Weighted simulated less measured values of some joints, by the parameters of their drives."""

    def __init__(
        self,
        start: Mapping[str, Mapping[str, float]],
        fitted: Mapping[str, Sequence[str]],
        *,
        refitted: Collection[str] = (),
    ) -> None:
        """Choose what is searched.

        Args:
            start: Parameters by joint; of the fitted ones, where to begin.
            fitted: Names of the parameters to fit, by joint.
            refitted: Joints whose values come from an earlier fit; published values may be a bad
                place to begin (`Parameter.start`).
        """
        self.start = start
        self.slots = [(joint, name) for joint, names in fitted.items() for name in names]
        """Joint and name of each searched number."""
        kinds = [PARAMETERS[name] for _, name in self.slots]
        self.low = np.array([kind.scaled(kind.low) for kind in kinds])
        self.high = np.array([kind.scaled(kind.high) for kind in kinds])
        begin = []
        for (joint, name), kind in zip(self.slots, kinds, strict=True):
            value = start[joint][name]
            least = kind.low if joint in refitted else max(kind.start, kind.low)
            begin.append(kind.scaled(max(value, least)))
        margin = 1e-3 * (self.high - self.low)
        self.begin: Array = np.clip(begin, self.low + margin, self.high - margin)

    def values(self, x: Array) -> dict[str, dict[str, float]]:
        """Parameters by joint that some searched numbers stand for."""
        out = {joint: dict(values) for joint, values in self.start.items()}
        for (joint, name), number in zip(self.slots, x, strict=True):
            out[joint][name] = PARAMETERS[name].unscaled(float(number))
        return out

    @abstractmethod
    def residual(self, x: Array) -> Array:
        """Weighted simulated less measured values, shape (m,)."""

    @abstractmethod
    def jacobian(self, x: Array) -> Array:
        """Derivative of `residual`, shape (m, p)."""


@dataclass(frozen=True, kw_only=True)
class Solution:
    """The optimum of a problem."""

    x: Array
    """Searched numbers, shape (p,)."""
    residual: Array
    """Shape (m,)."""
    jacobian: Array
    """Shape (m, p)."""
    at_bound: NDArray[np.bool_]
    """Which numbers ended at a bound, shape (p,)."""
    settled: bool
    """False if the rounds ran out."""

    @classmethod
    def at(cls, problem: Problem, x: Array, settled: bool) -> Solution:
        """Evaluate a problem at its optimum."""
        near = _AT_BOUND * (problem.high - problem.low)
        return cls(
            x=x,
            residual=problem.residual(x),
            jacobian=problem.jacobian(x),
            at_bound=np.minimum(x - problem.low, problem.high - x) < near,
            settled=settled,
        )


def solve(problem: Problem, *, tolerance: float, rounds: int) -> Solution:
    """Minimize the sum of squared residuals within the bounds.

    Trust-region reflective method (Branch, Coleman and Li, SIAM J. Sci. Comput. 21, 1999), until
    the relative change of cost or numbers is below `tolerance`.
    """
    found = least_squares(
        problem.residual,
        problem.begin,
        jac=problem.jacobian,
        bounds=(problem.low, problem.high),
        x_scale="jac",
        xtol=tolerance,
        ftol=tolerance,
        max_nfev=rounds,
    )
    return Solution.at(problem, np.asarray(found.x), bool(found.success))


P = TypeVar("P", bound=Problem)


def solve_together(
    problems: Sequence[P], evaluate: Callable[[Sequence[tuple[P, Array]]], None]
) -> list[Solution]:
    """Solve small problems by damped Gauss-Newton, in step, from points near their optima.

    In step because the simulator is fastest with many simulations at once: `evaluate` prepares all
    residuals and Jacobians of one round, each problem at its point. Bounds are not used.
    """
    points = [problem.begin for problem in problems]
    best, steps = list(points), [np.full(len(point), np.inf) for point in points]
    costs, settled = [np.inf] * len(problems), [False] * len(problems)
    active = list(range(len(problems)))
    for _ in range(_ROUNDS):
        if not active:
            break
        evaluate([(problems[i], points[i]) for i in active])
        for i in active.copy():
            residual, jacobian = problems[i].residual(points[i]), problems[i].jacobian(points[i])
            cost = float(residual @ residual)
            if not np.isfinite(cost) or not cost <= costs[i] * (1.0 + 1e-9):
                # Worse (or diverged): go back half the way. A step too short to matter that no
                # longer helps has reached the optimum.
                if costs[i] == np.inf or np.abs(steps[i]).max() < _SETTLED:
                    settled[i] = costs[i] < np.inf
                    active.remove(i)
                else:
                    steps[i] = steps[i] / 2.0
                    points[i] = best[i] + steps[i]
                continue
            change = np.linalg.lstsq(jacobian.T @ jacobian, jacobian.T @ residual, rcond=None)[0]
            steps[i] = np.clip(-change, -_LONGEST, _LONGEST)
            costs[i], best[i], points[i] = cost, points[i], points[i] + steps[i]
            if np.abs(steps[i]).max() < _SETTLED:
                settled[i] = True
                active.remove(i)
    return [Solution.at(*one) for one in zip(problems, best, settled, strict=True)]


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
    """Turn searched numbers into parameters with intervals.

    Args:
        fitted: Names of the searched numbers.
        x: The optimum, shape (p,).
        covariance: Of the searched numbers, shape (p, p); of the parameters if `symmetric`.
        freedom: Degrees of freedom of the covariance; with 0 there are no intervals.
        held: Values of the parameters that were not fitted.
        symmetric: Intervals are symmetric about the parameters, not about the searched numbers.
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
            ci95[name] = (float(low if name == "offset" else max(low, 0.0)), float(high))
    scale = np.array([best[name] if PARAMETERS[name].log else 1.0 for name in fitted])
    if symmetric:
        sd = sd / scale
    else:
        covariance = covariance * np.outer(scale, scale)
    own = np.zeros((2, 2))
    places = [(k, fitted.index(name)) for k, name in enumerate(GAINS) if name in fitted]
    for k, i in places:
        for n, j in places:
            own[k, n] = covariance[i, j]
    return Estimate(
        values={**held, **best},
        covariance=own,
        sd=dict(zip(fitted, sd.tolist(), strict=True)),
        ci95=ci95,
    )
