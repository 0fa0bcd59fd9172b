"""Closed-form joints, to test estimators with and to draw beside measurements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def second_order(
    omega: Array, *, stiffness: float, damping: float, inertia: float, delay_s: float = 0.0
) -> ComplexArray:
    """Response of an ideal joint to its position command.

    `stiffness exp(-s delay) / (inertia s^2 + damping s + stiffness)` at s = j omega: paper M2 with
    zero target velocity (reading A9), where `damping` is the drive's and the joint's own together.

    Units: rad/s, N m/rad, N m s/rad, kg m^2 (link and armature), s.
    """
    s = 1j * np.asarray(omega, dtype=np.float64)
    joint = stiffness / (inertia * s**2 + damping * s + stiffness)
    return np.asarray(joint * np.exp(-s * delay_s))


def simulate_second_order(
    command: Array, rate_hz: float, *, stiffness: float, damping: float, inertia: float
) -> Array:
    """Exact response [rad] of the same joint, at rest at first, to a held command [rad].

    The command is constant within each step of `1 / rate_hz`, for which the zero-order-hold
    equivalent is exact.
    """
    joint = (np.array([stiffness]), np.array([inertia, damping, stiffness]))
    numerator, denominator, _ = cont2discrete(joint, 1.0 / rate_hz, method="zoh")
    rest = float(command[0])
    return np.asarray(lfilter(np.ravel(numerator), denominator, command - rest) + rest)
