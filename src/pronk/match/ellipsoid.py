"""The smallest ellipse that holds all joints of a group, their uncertainty included."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pronk.match.gains import JointGains

Array = NDArray[np.float64]

_DIRECTIONS = 24
"""Points on each joint's own ellipse; the enclosing one misses less than 1 % between them."""
_FLOOR = 1e-3
"""Smallest relative standard deviation, so that a single exact joint still has an ellipse."""


def interval_points(gains: JointGains, level: float = 0.95) -> Array:
    """Points on the ellipse that holds a joint's true gains with probability `level`.

    Args:
        gains: Matched gains and their covariance; where it is not finite, as without repeats,
            the gains are taken for exact.
        level: Probability, for two gains jointly.

    Returns:
        (stiffness, damping) [N m/rad, N m s/rad], shape (24, 2).
    """
    centre = np.array([gains.stiffness, gains.damping])
    covariance = np.array(gains.covariance, dtype=np.float64)
    if not np.isfinite(covariance).all():
        covariance = np.zeros((2, 2))
    covariance = covariance + np.diag((_FLOOR * centre) ** 2)
    radius = np.sqrt(stats.chi2.ppf(level, 2))
    angle = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(centre + radius * (np.linalg.cholesky(covariance) @ circle).T)


def enclosing(points: Array, *, tolerance: float = 1e-4, rounds: int = 2000) -> tuple[Array, Array]:
    """Minimum-volume ellipsoid that covers some points.

    Khachiyan's algorithm (Todd and Yildirim, *On Khachiyan's algorithm for the computation of
    minimum-volume enclosing ellipsoids*, 2007), then scaled so that every point is inside.

    Args:
        points: shape (n, d), spanning all d directions.
        tolerance: Relative excess of volume that is good enough.
        rounds: Most iterations.

    Returns:
        Centre c, shape (d,), and shape matrix E, shape (d, d), of
        `{x : (x - c)^T E^-1 (x - c) <= 1}`.
    """
    n, d = points.shape
    lifted = np.vstack([points.T / np.abs(points).max(axis=0)[:, None], np.ones(n)])
    weights = np.full(n, 1.0 / n)
    for _ in range(rounds):
        spread = (lifted * weights) @ lifted.T
        distance = np.einsum("ij,ij->j", lifted, np.linalg.solve(spread, lifted))
        worst = int(np.argmax(distance))
        excess = distance[worst] / (d + 1.0) - 1.0
        if excess < tolerance:
            break
        step = (distance[worst] - d - 1.0) / ((d + 1.0) * (distance[worst] - 1.0))
        weights *= 1.0 - step
        weights[worst] += step
    centre = points.T @ weights
    about = points - centre
    shape = d * (about.T * weights) @ about
    reach = np.einsum("ij,ji->i", about, np.linalg.solve(shape, about.T)).max()
    return np.asarray(centre), np.asarray(shape * max(reach, 1.0))
