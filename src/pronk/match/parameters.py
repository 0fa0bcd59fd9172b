"""The one list of parameters of a joint's drive, and which of them each mode fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pronk.errors import PronkError


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
    remedy: str
    """What to record where it is not identified."""
    sd_max: float = 0.3
    """Standard deviation beyond which it counts as unknown, in `unit` or relative: at 95 % it would
    reach from a half to twice its value."""
    log: bool = True

    def scaled(self, value: float) -> float:
        """Return the number that is searched."""
        return float(np.log(value)) if self.log else float(value)

    def unscaled(self, scaled: float) -> float:
        """Return the parameter that a searched number stands for."""
        return float(np.exp(scaled)) if self.log else float(scaled)


PARAMETERS: Mapping[str, Parameter] = {
    "stiffness": Parameter(
        low=0.5,
        high=200.0,
        unit="N m/rad",
        start=0.5,
        step=0.02,
        remedy="a pose or a payload in which gravity loads the joint, or a torque channel, "
        "gives the stiffness",
    ),
    "damping": Parameter(
        low=0.005,
        high=20.0,
        unit="N m s/rad",
        start=0.005,
        step=0.02,
        remedy="a faster sweep, or another damping on the drive, gives the damping",
    ),
    "armature": Parameter(
        low=1e-4,
        high=1.0,
        unit="kg m^2",
        start=1e-3,
        step=0.03,
        remedy="a sweep to higher frequencies at an amplitude that the drive can follow, or a "
        "second payload, gives the armature",
    ),
    "frictionloss": Parameter(
        low=1e-3,
        high=3.0,
        unit="N m",
        start=0.2,  # from too little friction the search sees no sticking and does not find it
        step=0.03,
        remedy="a second, smaller amplitude gives the dry friction",
    ),
    "delay": Parameter(
        low=0.0,
        high=0.1,
        unit="s",
        start=0.01,
        step=1e-3,
        sd_max=0.005,  # a physics step of the training simulator
        log=False,
        remedy="the phase at higher frequencies, or steps logged faster, gives the delay",
    ),
    "offset": Parameter(
        low=-0.2,
        high=0.2,
        unit="rad",
        start=-0.2,
        step=2e-3,
        sd_max=0.01,
        log=False,
        remedy="the same pose approached from both sides gives the offset",
    ),
}
"""Bounds are far from what servos of small robots have; a fit that ends there is flagged. Steps are
far above the chatter of dry friction and small against the curvature of the error."""

GAINS = ("stiffness", "damping")
FREE = ("stiffness", "damping", "armature", "frictionloss", "delay")
"""What mode `drive` can fit to sweeps."""
DRIVE_MODE = ("damping", "armature", "frictionloss", "delay")
"""Mode `drive`: the stiffness is known."""
GAINS_MODE = ("stiffness", "damping", "frictionloss", "delay")
"""Mode `gains` of whole arms: the armature is known; friction and delay are fitted too, so that
they do not pass for damping."""


def checked_names(names: Sequence[str], allowed: Sequence[str]) -> tuple[str, ...]:
    """Parameter names in the order of `PARAMETERS`; PronkError for an unknown name or none."""
    if not names or (unknown := [name for name in names if name not in allowed]):
        raise PronkError(
            f"free parameters {', '.join(unknown) if names else 'none'}; expected some of "
            f"{', '.join(allowed)}."
        )
    return tuple(name for name in PARAMETERS if name in names)
