"""The table of the parameters of a joint's drive that can be fitted, and which each mode fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pronk.errors import PronkError


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One parameter of a drive: its bounds, its unit, its scale and where it acts."""

    unit: str
    low: float
    """Lower bound of the search for the joints of small robots; `search_range` widens it."""
    high: float
    """Upper bound of the search for the joints of small robots; `search_range` widens it."""
    start: float
    """Where the search begins if the nominal value is smaller (`drive_fit`, step 1). Of the dry
    friction it is a share of the torque scale (`SearchRange`)."""
    step: float
    """Finite difference, of the logarithm or of the parameter itself. Far above the chatter of dry
    friction, and small against the curvature of the error."""
    remedy: str
    """What to record where the recordings do not identify it."""
    sd_max: float = 0.3
    """Standard deviation beyond which it counts as unknown, in `unit` or relative. At 95 % a
    relative deviation of 0.3 reaches from a half to twice the value."""
    log: bool = True
    """True if it is positive and searched in its logarithm."""
    may_vanish: bool = False
    """True if a drive may have none of it, so that its lower bound is a possible result."""
    acts_on: Literal["drive", "command", "reading"] = "drive"
    """What it changes: the simulated drive, the time of the command, or the encoder's reading."""

    def scaled(self, value: float) -> float:
        """Return the number that is searched in place of a value."""
        return float(np.log(value)) if self.log else float(value)

    def unscaled(self, number: float) -> float:
        """Return the value that a searched number stands for."""
        return float(np.exp(number)) if self.log else float(number)


PARAMETERS: Mapping[str, Parameter] = {
    "stiffness": Parameter(
        unit="N m/rad",
        low=0.01,
        high=200.0,
        start=0.01,
        step=0.02,
        remedy="a pose or a payload in which gravity loads the joint, or a torque channel, gives "
        "the stiffness",
    ),
    "damping": Parameter(
        unit="N m s/rad",
        low=0.005,
        high=20.0,
        start=0.005,
        step=0.02,
        remedy="a faster sweep, or another damping on the drive, gives the damping",
    ),
    "armature": Parameter(
        unit="kg m^2",
        low=1e-4,
        high=1.0,
        start=1e-3,
        step=0.03,
        remedy="a sweep to higher frequencies at an amplitude that the drive can follow, or a "
        "second payload, gives the armature",
    ),
    "frictionloss": Parameter(
        unit="N m",
        low=1e-3,
        high=3.0,
        # From too little friction the search sees no sticking and does not find it, from too much
        # the joint stands. It is 0.2 N m for a leg of 17 N m/rad at 0.25 rad.
        start=0.05,
        step=0.03,
        remedy="a second, smaller amplitude gives the dry friction",
        may_vanish=True,
    ),
    "stribeck": Parameter(
        unit="of the frictionloss",
        low=0.0,
        # Beyond it MuJoCo's bristles no longer follow a start from rest at a step of 5 ms.
        high=0.9,
        start=0.3,
        step=0.02,
        remedy="slow motion that sticks and slips, or starts from rest, gives the share of the dry "
        "friction that motion takes away",
        sd_max=0.15,
        log=False,
        may_vanish=True,
    ),
    "effort_limit": Parameter(
        unit="N m",
        # `search_range` gives the bounds, by the torque scale.
        low=1e-3,
        high=100.0,
        start=1e-3,
        step=0.02,
        remedy="a larger amplitude, at which the drive is at its torque limit, gives the limit",
    ),
    "delay": Parameter(
        unit="s",
        # Below zero where the log has the command later than the drive had it.
        low=-0.03,
        high=0.1,
        start=0.01,
        step=1e-3,
        remedy="the phase at higher frequencies, or steps logged faster, gives the delay",
        # A physics step of the training simulator.
        sd_max=0.005,
        log=False,
        acts_on="command",
    ),
    "offset": Parameter(
        unit="rad",
        low=-0.2,
        high=0.2,
        start=-0.2,
        step=2e-3,
        remedy="the same pose approached from both sides gives the offset",
        sd_max=0.01,
        log=False,
        acts_on="reading",
    ),
}

WIDEST_FACTOR = 100.0
"""Largest factor between the nominal value of a parameter and a bound of its search: beyond any
error of a robot's file by a unit, a gear or a torque constant but degrees for radians twice."""


@dataclass(frozen=True, kw_only=True)
class SearchRange:
    """Where one parameter of one joint is searched."""

    low: float
    high: float
    start: float
    """Where the search begins if the nominal value is smaller."""


def search_range(name: str, nominal: float, torque_scale: float) -> SearchRange:
    """Return where a parameter of a joint is searched, by the size of the joint.

    The bounds of `PARAMETERS` are those of joints of some 20 N m/rad. Those of gains and inertia
    are widened to `WIDEST_FACTOR` about the nominal value, those of the dry friction to the torque
    scale and a thousandth of it.

    Args:
        name: Name of the parameter.
        nominal: Nominal value.
        torque_scale: Nominal stiffness times the largest amplitude of the command [N m].
    """
    parameter = PARAMETERS[name]
    if name == "frictionloss":
        return SearchRange(
            low=min(parameter.low, 1e-3 * torque_scale),
            high=max(parameter.high, torque_scale),
            start=parameter.start * torque_scale,
        )
    if name == "effort_limit":
        return SearchRange(low=1e-3 * torque_scale, high=10.0 * torque_scale, start=0.0)
    if parameter.log and nominal > 0.0:
        low = min(parameter.low, nominal / WIDEST_FACTOR)
        return SearchRange(
            low=low,
            high=max(parameter.high, nominal * WIDEST_FACTOR),
            start=min(parameter.start, nominal),
        )
    return SearchRange(low=parameter.low, high=parameter.high, start=parameter.start)


GAINS = ("stiffness", "damping")
FREE = ("stiffness", "damping", "armature", "frictionloss", "delay")
"""Parameters that mode `drive` can fit to sweeps."""
DRIVE_MODE = ("damping", "armature", "frictionloss", "delay")
"""Parameters of mode `drive`, in which the stiffness is known."""
GAINS_MODE = ("stiffness", "damping", "frictionloss", "delay")
"""Parameters of mode `gains`, in which the armature is known. Friction and delay are fitted too, so
that they do not pass for damping."""
WITHOUT_FRICTION = ("stiffness", "damping", "delay")
"""Parameters of mode `gains` for frameworks whose joints have no dry friction as a torque."""


def checked_names(names: Sequence[str], allowed: Sequence[str]) -> tuple[str, ...]:
    """Sort parameter names in the order of `PARAMETERS`.

    Raises:
        PronkError: There is no name, or one is not allowed.
    """
    unknown = [name for name in names if name not in allowed]
    if unknown or not names:
        raise PronkError(
            f"free parameters {', '.join(unknown) or 'none'}; expected some of "
            f"{', '.join(allowed)}."
        )
    return tuple(name for name in PARAMETERS if name in names)
