"""Least squares over parameters of joint drives: parameters, problems, solvers, uncertainty.

Every fit is a `Problem`: residuals and their Jacobian as functions of searched numbers. Responses
of single joints (`response_fit`) and positions of a whole arm in time (`arm`) differ in nothing
else. The unit of uncertainty is a block: a repeat of a sweep, or 20 s of a recording in time.
Noise on a robot is coloured and neighbouring frequencies and samples share it, so intervals that
take them for independent are several times too narrow; blocks are independent whatever the colour.
Intervals are Student's t over the blocks, which holds with as few as three.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import least_squares

from pronk.errors import PronkError
from pronk.match.identifiability import SD_MAX

Array = NDArray[np.float64]

_AT_BOUND = 1e-3
_LONGEST = 0.3
"""Longest step of one round of `solve_together`."""
_SETTLED = 3e-4
"""A problem of `solve_together` whose next step is shorter is done: 0.03 % of a gain."""
_ROUNDS = 12
"""Three or four are usual."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One parameter. Positive ones are searched in their logarithm."""

    low: float
    high: float
    unit: str
    start: float
    """Where the search begins if the published value is smaller."""
    step: float
    """Finite difference, of the logarithm or of the parameter itself."""
    sd_max: float = SD_MAX
    """Standard deviation beyond which it counts as unknown: relative, or in `unit`."""
    log: bool = True

    def scaled(self, value: float) -> float:
        """Return the number that is searched."""
        return float(np.log(value)) if self.log else float(value)

    def unscaled(self, scaled: float) -> float:
        """Return the parameter that a searched number stands for."""
        return float(np.exp(scaled)) if self.log else float(scaled)


PARAMETERS: Mapping[str, Parameter] = {
    "stiffness": Parameter(low=0.5, high=200.0, unit="N m/rad", start=0.5, step=0.02),
    "damping": Parameter(low=0.005, high=20.0, unit="N m s/rad", start=0.005, step=0.02),
    "armature": Parameter(low=1e-4, high=1.0, unit="kg m^2", start=1e-3, step=0.03),
    # From too little friction the search sees no sticking and does not find it.
    "frictionloss": Parameter(low=1e-3, high=3.0, unit="N m", start=0.2, step=0.03),
    # A delay is known if it is known to a physics step of the training simulator.
    "delay": Parameter(low=0.0, high=0.1, unit="s", start=0.01, step=1e-3, sd_max=0.005, log=False),
    "offset": Parameter(
        low=-0.2, high=0.2, unit="rad", start=-0.2, step=2e-3, sd_max=0.01, log=False
    ),
}
"""Bounds are far from what servos of small robots have; a fit that ends there is flagged. Steps are
far above the chatter of dry friction and small against the curvature of the error."""

GAINS = ("stiffness", "damping")
DRIVE_MODE = ("damping", "armature", "frictionloss", "delay")
"""Mode `drive`: the stiffness is known."""
GAINS_MODE = ("stiffness", "damping", "frictionloss", "delay")
"""Mode `gains` of whole arms: the armature is known; friction and delay are fitted too, so that
they do not pass for damping."""


def checked_names(names: Sequence[str], allowed: Sequence[str]) -> tuple[str, ...]:
    """Parameter names in the order of `PARAMETERS`.

    Raises:
        PronkError: A name is unknown, or there is none.
    """
    if not names or (unknown := [name for name in names if name not in allowed]):
        raise PronkError(
            f"free parameters {', '.join(unknown) if names else 'none'}; expected some of "
            f"{', '.join(allowed)}."
        )
    return tuple(name for name in PARAMETERS if name in names)


def bounds(names: Sequence[str]) -> tuple[Array, Array]:
    """Lower and upper bounds of the searched numbers, each of shape (p,)."""
    kinds = [PARAMETERS[name] for name in names]
    low = np.array([kind.scaled(kind.low) for kind in kinds])
    return low, np.array([kind.scaled(kind.high) for kind in kinds])


def begin(names: Sequence[str], values: Sequence[float], fitted: Sequence[bool]) -> Array:
    """Searched numbers to begin with, inside the bounds, shape (p,).

    Args:
        names: The parameters.
        values: Their values so far.
        fitted: True for a value from an earlier fit; a published one may be a bad place to begin.
    """
    low, high = bounds(names)
    scaled = []
    for name, value, known in zip(names, values, fitted, strict=True):
        kind = PARAMETERS[name]
        scaled.append(kind.scaled(max(value if known else max(value, kind.start), kind.low)))
    margin = 1e-3 * (high - low)
    return np.asarray(np.clip(scaled, low + margin, high - margin))


class Problem(Protocol):
    """Residuals as a function of searched numbers."""

    low: Array
    """Lower bounds, shape (p,)."""
    high: Array
    """Upper bounds, shape (p,)."""
    begin: Array
    """Where to begin, shape (p,)."""

    def residual(self, x: Array) -> Array:
        """Weighted simulated less measured values, shape (m,)."""

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

    Trust-region reflective method (Branch, Coleman and Li, SIAM J. Sci. Comput. 21, 1999).

    Args:
        problem: What to solve.
        tolerance: Relative change of cost or numbers that ends the search.
        rounds: Most evaluations of the residual.
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

    In step because the simulator is fastest with many simulations at once. Bounds are not used.

    Args:
        problems: What to solve.
        evaluate: Prepares all residuals and Jacobians of one round, each problem at its point.
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
            residual, jacobian = (
                problems[i].residual(points[i]),
                problems[i].jacobian(points[i]),
            )
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
    """Fitted parameters of one joint with their uncertainty."""

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
    values, ci95 = dict(held), {}
    sd = np.sqrt(np.diag(covariance))
    for i, name in enumerate(fitted):
        kind, at = PARAMETERS[name], float(x[i])
        values[name] = kind.unscaled(at)
        if freedom:
            # e^20 is as good as infinite and does not overflow.
            half = min(float(sd[i] * stats.t.ppf(0.975, freedom)), 20.0)
            floor = -np.inf if name == "offset" else 0.0
            ci95[name] = (max(kind.unscaled(at - half), floor), kind.unscaled(at + half))
    own = np.zeros((2, 2))
    places = [(k, fitted.index(name)) for k, name in enumerate(GAINS) if name in fitted]
    for k, i in places:
        for n, j in places:
            own[k, n] = covariance[i, j] * np.exp(x[i]) * np.exp(x[j])
    return Estimate(
        values=values, covariance=own, sd=dict(zip(fitted, sd.tolist(), strict=True)), ci95=ci95
    )
