"""Does the joint answer alike, however far it is asked? Friction says no.

Dry friction takes a fixed torque, which is a large share of a small movement, so its joint looks
stiffer and more damped the less it moves. Gains that differ between amplitudes carry friction
that the simulator lacks.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pronk.match.refine import Fit

Array = NDArray[np.float64]

SPREAD_MAX = 0.05
"""Relative change of stiffness between amplitudes that is worth a flag; the paper's own
randomization is 2 N m/rad on 20 (D3), twice that."""


def amplitude_gains(fits: Sequence[Fit]) -> Array:
    """(amplitude, stiffness, damping) of each amplitude fitted by itself, shape (m, 3)."""
    return np.array(
        [(fit.target.measured.amplitude, fit.stiffness, fit.damping) for fit in fits]
    ).reshape(-1, 3)


def amplitude_spread(gains: Array) -> float:
    """Largest relative change of stiffness from the first amplitude; NaN with one amplitude.

    Args:
        gains: As `amplitude_gains` gives them, the matched amplitude first.
    """
    if len(gains) < 2:
        return float("nan")
    return float(np.abs(gains[1:, 1] / gains[0, 1] - 1.0).max())


def amplitude_flags(gains: Array) -> tuple[str, ...]:
    """What to tell the user of the spread."""
    spread = amplitude_spread(gains)
    if not spread > SPREAD_MAX:
        return ()
    largest, smallest = gains[:, 0].max(), gains[:, 0].min()
    return (
        f"friction: stiffness changes by {100.0 * spread:.0f} % between {smallest:.3g} and "
        f"{largest:.3g} rad; give the simulator the joint's dry friction, or match at the "
        "amplitude that the policy will use",
    )
