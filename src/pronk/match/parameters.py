"""The parameters of a drive that a log may tell, and how each is searched."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.match.identifiability import SD_MAX


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One kind of parameter. Positive ones are searched in their logarithm."""

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


KINDS: Mapping[str, Kind] = {
    "stiffness": Kind(low=0.5, high=200.0, unit="N m/rad", start=0.5, step=0.02, sd_max=SD_MAX),
    "damping": Kind(low=0.005, high=20.0, unit="N m s/rad", start=0.005, step=0.02, sd_max=SD_MAX),
    "armature": Kind(low=1e-4, high=1.0, unit="kg m^2", start=1e-3, step=0.03, sd_max=SD_MAX),
    # From too little friction the search sees no sticking and does not find it.
    "frictionloss": Kind(low=1e-3, high=3.0, unit="N m", start=0.2, step=0.03, sd_max=SD_MAX),
    # A delay is known if it is known to a physics step of the training simulator.
    "delay": Kind(low=0.0, high=0.1, unit="s", start=0.01, step=1e-3, sd_max=0.005, log=False),
    "offset": Kind(low=-0.2, high=0.2, unit="rad", start=-0.2, step=2e-3, sd_max=0.01, log=False),
}
"""Bounds are far from what servos of small robots have; a fit that ends there is flagged."""

PARAMETERS = tuple(KINDS)
"""What `fit_drive` can be asked for."""
DRIVE_MODE = ("damping", "armature", "frictionloss", "delay")
"""Mode `drive`: the stiffness is known."""
GAINS_MODE = ("stiffness", "damping", "frictionloss", "delay")
"""Mode `gains`: the armature is known; friction and delay are fitted too, so that they do not pose
as damping."""


def asked_of(
    parameters: Sequence[str] | Mapping[str, Sequence[str]], joints: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """Parameter names by joint, checked, in the order of `PARAMETERS`.

    Raises:
        PronkError: A name is unknown, or nothing is asked.
    """
    by_joint = (
        {joint: tuple(parameters.get(joint, ())) for joint in joints}
        if isinstance(parameters, Mapping)
        else {joint: tuple(parameters) for joint in joints}
    )
    for names in by_joint.values():
        for name in names:
            if name not in KINDS:
                raise PronkError(
                    f"there is no drive parameter {name!r}; expected some of "
                    f"{', '.join(PARAMETERS)}."
                )
    if not any(by_joint.values()):
        raise PronkError(f"no parameter to fit; expected some of {', '.join(PARAMETERS)}.")
    return {
        joint: tuple(name for name in PARAMETERS if name in names)
        for joint, names in by_joint.items()
    }


def gains_covariance(
    fitted: Sequence[str], covariance: NDArray[np.float64]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """The part of a covariance that is of (stiffness, damping); zero for what was held.

    Args:
        fitted: Names of the rows and columns.
        covariance: Shape (fitted, fitted).
    """

    def of(first: str, second: str) -> float:
        if first not in fitted or second not in fitted:
            return 0.0
        return float(covariance[fitted.index(first), fitted.index(second)])

    kp, kd = "stiffness", "damping"
    return (of(kp, kp), of(kp, kd)), (of(kd, kp), of(kd, kd))
