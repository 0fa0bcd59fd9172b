"""Rows of unit quaternions w, x, y, z: product, rotation vectors, and vectors turned back.

Written out because the control loop does it a thousand times a second on a handful of rows, where
a general library spends its time on preparations.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Row k: what Hamilton's product makes of part k of its left factor.
_FACTORS = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
_SIGNS = np.array([[1.0, 1, 1, 1], [-1, 1, -1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1]])
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


def product(a: Array, b: Array) -> Array:
    """The rotations `b`, then `a`: Hamilton's product. (n, 4) each."""
    both: Array = np.add.reduce(a[:, :, None] * (b.take(_FACTORS, axis=1) * _SIGNS), axis=1)
    return both


def of_vector(rotation: Array) -> Array:
    """Rotation vectors of any size as quaternions. (n, 3) [rad] to (n, 4)."""
    half = 0.5 * rotation
    # Never 0, so that sin(x) / x is 1 there.
    angle = np.sqrt((half * half).sum(axis=1, keepdims=True) + 1e-300)
    return np.concatenate([np.cos(angle), half * (np.sin(angle) / angle)], axis=1)


def about_z(yaw: Array) -> Array:
    """Rotations about the vertical. (n,) [rad] to (n, 4)."""
    turn = np.zeros((len(yaw), 4))
    turn[:, 0], turn[:, 3] = np.cos(0.5 * yaw), np.sin(0.5 * yaw)
    return turn


def turned_back(q: Array, v: Array) -> Array:
    """World vectors in the frames of bodies, R(q)^T v. (n, 4) and (n, 3) to (n, 3)."""
    w, u = q[:, :1], q[:, 1:]
    # v - 2 w (u x v) + 2 u x (u x v), since the inverse has -u.
    cross = _cross(u, v)
    turned: Array = v - 2.0 * (w * cross - _cross(u, cross))
    return turned


def normalized(q: Array) -> Array:
    """Quaternions of length 1. (n, 4)."""
    unit: Array = q / np.sqrt((q * q).sum(axis=1, keepdims=True))
    return unit


def _cross(a: Array, b: Array) -> Array:
    ahead = a.take(_NEXT, axis=1) * b.take(_LAST, axis=1)
    across: Array = ahead - a.take(_LAST, axis=1) * b.take(_NEXT, axis=1)
    return across
