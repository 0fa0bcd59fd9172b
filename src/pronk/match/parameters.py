"""The parameters of a joint's drive that a log can give, and how each is searched."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.match.identifiability import SD_MAX

Array = NDArray[np.float64]


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
    sd_max: float
    """Standard deviation beyond which it counts as unknown: relative, or in `unit`."""
    log: bool = True

    def scaled(self, value: float) -> float:
        """The number that is searched."""
        return float(np.log(value)) if self.log else float(value)

    def unscaled(self, scaled: float) -> float:
        """The parameter that a searched number stands for."""
        return float(np.exp(scaled)) if self.log else float(scaled)

    def slope(self, scaled: float) -> float:
        """Derivative of the parameter by the searched number."""
        return float(np.exp(scaled)) if self.log else 1.0


PARAMETERS: Mapping[str, Parameter] = {
    "stiffness": Parameter(
        low=0.5, high=200.0, unit="N m/rad", start=0.5, step=0.02, sd_max=SD_MAX
    ),
    "damping": Parameter(
        low=0.005, high=20.0, unit="N m s/rad", start=0.005, step=0.02, sd_max=SD_MAX
    ),
    "armature": Parameter(low=1e-4, high=1.0, unit="kg m^2", start=1e-3, step=0.03, sd_max=SD_MAX),
    # From too little friction the search sees no sticking and does not find it.
    "frictionloss": Parameter(low=1e-3, high=3.0, unit="N m", start=0.2, step=0.03, sd_max=SD_MAX),
    # A delay is known if it is known to a physics step of the training simulator.
    "delay": Parameter(low=0.0, high=0.1, unit="s", start=0.01, step=1e-3, sd_max=0.005, log=False),
    "offset": Parameter(
        low=-0.2, high=0.2, unit="rad", start=-0.2, step=2e-3, sd_max=0.01, log=False
    ),
}
"""Bounds are far from what servos of small robots have; a fit that ends there is flagged."""

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
    return (
        np.array([kind.scaled(kind.low) for kind in kinds]),
        np.array([kind.scaled(kind.high) for kind in kinds]),
    )


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
