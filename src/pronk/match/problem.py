"""The least-squares problem that every fit of drive parameters is, and its solver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]


class Problem(Protocol):
    """Residuals as a function of searched numbers (`pronk.match.parameters`)."""

    low: Array
    """Lower bounds, shape (p,)."""
    high: Array
    """Upper bounds, shape (p,)."""
    begin: Array
    """Where to begin, inside the bounds, shape (p,)."""

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


_AT_BOUND = 1e-3


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
    x = np.asarray(found.x)
    distance = np.minimum(x - problem.low, problem.high - x)
    return Solution(
        x=x,
        residual=problem.residual(x),
        jacobian=problem.jacobian(x),
        at_bound=distance < _AT_BOUND * (problem.high - problem.low),
        settled=bool(found.success),
    )
