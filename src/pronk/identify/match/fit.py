"""Least squares over parameters of joint drives: problems and solvers.

Every fit is a `Problem`: residuals and their Jacobian as functions of searched numbers. Another
kind of measurement is another subclass; solvers and `uncertainty` stay the same.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from scipy.optimize import least_squares

from pronk.arrays import Array, Mask
from pronk.identify.match.parameters import PARAMETERS

_AT_BOUND = 1e-3
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
        shared: Collection[str] = (),
        refitted: Collection[str] = (),
    ) -> None:
        """Choose what is searched: the `fitted` parameters, from where `start` has them, by joint.

        The `shared` parameters are one for all joints. Published values may be a bad place to begin
        (`Parameter.start`); those of the `refitted` joints come from an earlier fit.
        """
        self.start = start
        self.slots: list[tuple[str, str]] = []
        """Joint and name of each searched number; of a shared one the first joint."""
        self.column: dict[tuple[str, str], int] = {}
        """Searched number of each joint and name."""
        for joint, name in ((joint, name) for joint, names in fitted.items() for name in names):
            same = [n for n, (_, known) in enumerate(self.slots) if known == name in shared]
            self.column[joint, name] = same[0] if same else len(self.slots)
            self.slots += [] if same else [(joint, name)]
        kinds = [PARAMETERS[name] for _, name in self.slots]
        self.low = np.array([kind.scaled(kind.low) for kind in kinds])
        self.high = np.array([kind.scaled(kind.high) for kind in kinds])
        begin = []
        for (joint, name), kind in zip(self.slots, kinds, strict=True):
            least = kind.low if joint in refitted else max(kind.start, kind.low)
            begin.append(kind.scaled(max(start[joint][name], least)))
        margin = 1e-3 * (self.high - self.low)
        self.begin: Array = np.clip(begin, self.low + margin, self.high - margin)

    def values(self, x: Array) -> dict[str, dict[str, float]]:
        """Parameters by joint that some searched numbers stand for."""
        out = {joint: dict(values) for joint, values in self.start.items()}
        for (joint, name), column in self.column.items():
            out[joint][name] = PARAMETERS[name].unscaled(float(x[column]))
        return out

    @abstractmethod
    def residual(self, x: Array) -> Array:
        """Weighted simulated less measured values, shape (m,)."""

    @abstractmethod
    def jacobian(self, x: Array) -> Array:
        """Derivative of `residual`, shape (m, p)."""


class CachedProblem(Problem):
    """A problem whose residual and Jacobian are found together, once for each point."""

    @cached_property
    def known(self) -> dict[bytes, tuple[Array, Array]]:
        """Residual and Jacobian by the bytes of a point."""
        return {}

    @abstractmethod
    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Find residual and Jacobian."""

    def residual(self, x: Array) -> Array:
        """Weighted simulated less measured values, shape (m,)."""
        return self._both(x)[0]

    def jacobian(self, x: Array) -> Array:
        """Derivative of `residual`, shape (m, p)."""
        return self._both(x)[1]

    def _both(self, x: Array) -> tuple[Array, Array]:
        if x.tobytes() not in self.known:
            self.known[x.tobytes()] = self.evaluate(x)
        return self.known[x.tobytes()]


@dataclass(frozen=True, kw_only=True)
class Solution:
    """The optimum of a problem."""

    x: Array
    """Searched numbers, shape (p,)."""
    residual: Array
    """Shape (m,)."""
    jacobian: Array
    """Shape (m, p)."""
    at_bound: Mask
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
    problems: Sequence[P],
    evaluate: Callable[[Sequence[tuple[P, Array]]], None] = lambda points: None,
    *,
    tolerance: float = 0.0,
    longest: float = 0.3,
) -> list[Solution]:
    """Solve small problems by damped Gauss-Newton within their bounds, in step.

    In step because the simulator is fastest with many simulations at once: `evaluate` prepares all
    residuals and Jacobians of one round, each problem at its point. A problem is done when its next
    step, which is no longer than `longest`, is short, or promises to reduce the sum of squares by
    less than `tolerance` of it: near the optimum the chatter of dry friction hides more.
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
            residual = problems[i].residual(points[i])
            cost, short = float(residual @ residual), np.abs(steps[i]).max() < _SETTLED
            if np.isfinite(cost) and cost <= costs[i] * (1.0 + 1e-9):
                costs[i], best[i] = cost, points[i]
                steps[i] = _step(problems[i], points[i], longest)
                short = np.abs(steps[i]).max() < _SETTLED
            else:
                # Worse (or diverged): go back half the way. A step too short to matter that no
                # longer helps has reached the optimum.
                steps[i] = steps[i] / 2.0
            points[i] = best[i] + steps[i]
            # A step that was cut short in one number may promise nothing; it is tried all the same.
            if (
                costs[i] == np.inf
                or short
                or 0.0 <= _promised(problems[i], best[i], steps[i]) < tolerance
            ):
                settled[i] = costs[i] < np.inf
                active.remove(i)
    return [Solution.at(*one) for one in zip(problems, best, settled, strict=True)]


def _step(problem: Problem, x: Array, longest: float) -> Array:
    """Gauss-Newton step from a point, within the bounds, shape (p,)."""
    residual, jacobian = problem.residual(x), problem.jacobian(x)
    free = np.ones(len(x), dtype=bool)
    while True:
        own, step = jacobian[:, free], np.zeros(len(x))
        step[free] = -np.linalg.lstsq(own.T @ own, own.T @ residual, rcond=None)[0]
        step = np.clip(x + np.clip(step, -longest, longest), problem.low, problem.high) - x
        stuck = free & (step == 0.0) & ((x == problem.low) | (x == problem.high))
        if not stuck.any() or stuck[free].all():
            return step
        free &= ~stuck


def _promised(problem: Problem, x: Array, step: Array) -> float:
    """Share of the sum of squares that a step from a point takes away, to first order."""
    residual = problem.residual(x)
    after = residual + problem.jacobian(x) @ step
    return 1.0 - float(after @ after) / float(residual @ residual)
