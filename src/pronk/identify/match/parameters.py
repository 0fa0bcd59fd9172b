"""The one list of parameters of a joint's drive, and which of them each mode fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pronk.errors import PronkError


@dataclass(frozen=True)
class Parameter:
    """One parameter. Positive ones are searched in their logarithm."""

    low: float
    high: float
    unit: str
    step: float
    """Finite difference, of the logarithm or of the parameter itself."""
    start: float
    """Where the search begins if the published value is smaller."""
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


_POSE = "a pose or a payload in which gravity loads the joint, or a torque channel, gives the "
_SWEEP = "a sweep to higher frequencies at an amplitude that the drive can follow, or a second "
PARAMETERS: Mapping[str, Parameter] = {
    "stiffness": Parameter(0.01, 200.0, "N m/rad", 0.02, 0.01, f"{_POSE}stiffness"),
    "damping": Parameter(
        *(0.005, 20.0, "N m s/rad", 0.02, 0.005),
        "a faster sweep, or another damping on the drive, gives the damping",
    ),
    "armature": Parameter(1e-4, 1.0, "kg m^2", 0.03, 1e-3, f"{_SWEEP}payload, gives the armature"),
    "frictionloss": Parameter(
        # From too little friction the search sees no sticking and does not find it.
        *(1e-3, 3.0, "N m", 0.03, 0.2),
        "a second, smaller amplitude gives the dry friction",
    ),
    "stribeck": Parameter(
        # Beyond the bound MuJoCo's bristles no longer follow a start from rest at a step of 5 ms.
        *(0.0, 0.9, "of the frictionloss", 0.02, 0.3),
        "slow motion that sticks and slips, or starts from rest, gives the share of the dry "
        "friction that motion takes away",
        sd_max=0.15,
        log=False,
    ),
    "delay": Parameter(
        # Known if known to a physics step of the training simulator. Below zero where the log has
        # the command later than the drive had it.
        *(-0.03, 0.1, "s", 1e-3, 0.01),
        "the phase at higher frequencies, or steps logged faster, gives the delay",
        sd_max=0.005,
        log=False,
    ),
    "offset": Parameter(
        *(-0.2, 0.2, "rad", 2e-3, -0.2),
        "the same pose approached from both sides gives the offset",
        sd_max=0.01,
        log=False,
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
