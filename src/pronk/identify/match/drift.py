"""Compare two matches of one robot: which gains have changed, and which cannot be told.

Two estimates with total 95 % intervals differ by chance by the root of the sum of the squares of
their half-widths at most, in 19 of 20 pairs of the same robot. A total interval also holds what the
model does not explain, which is much the same in both matches, so that fewer than 1 in 20 differ.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from pronk.errors import PronkError
from pronk.identify.match.gains import FittedValue, JointGains, MatchedGains
from pronk.identify.match.parameters import GAINS, PARAMETERS
from pronk.identify.simulators.info import SimulatorInfo

DriftVerdict = Literal["within", "outside", "not resolved"]
"""What two estimates say of a change: `outside` where they differ by more than their intervals,
`within` where they do not and a change that matters would show, `not resolved` where it would
not."""

CHANGE_THAT_MATTERS = 0.1
"""Relative change of a gain that matters: of the stiffness it shifts the resonance by 5 %, of the
damping it changes the height of the resonance by 0.8 dB. Where the intervals are no wider, a change
of twice as much is outside in 39 of 40 cases."""
DELAY_THAT_MATTERS_S = 0.002
"""Change of the delay that matters [s]: 7 degrees of phase at 10 Hz."""
STICKING_THAT_MATTERS_RAD = 0.01
"""Change of the position error at which dry friction holds a joint that matters [rad]."""
_SAME_ARMATURE = 0.01
"""Relative difference of two armatures that were not fitted from which on they are of two
models."""


@dataclass(frozen=True, kw_only=True)
class ParameterDrift:
    """Two estimates of a parameter of a joint's drive."""

    joint: str
    """Name of the joint."""
    parameter: str
    """Name of the parameter, as in `match.parameters.PARAMETERS`."""
    old: float
    """Earlier value, in the unit of the parameter."""
    new: float
    """Later value."""
    interval: float
    """Largest difference by chance, the root of the summed squares of the half-widths that face
    each other; NaN where an interval is not known."""
    matters: float
    """Change that matters."""
    verdict: DriftVerdict
    """What the two say."""
    reason: str = ""
    """Why the change is not resolved, where it is not by the width of the intervals."""

    @property
    def unit(self) -> str:
        """Unit of the parameter."""
        return PARAMETERS[self.parameter].unit

    @property
    def change(self) -> float:
        """Later value less the earlier one."""
        return self.new - self.old


@dataclass(frozen=True, kw_only=True)
class Drift:
    """The difference of two matches of one robot."""

    parameters: tuple[ParameterDrift, ...]
    """Parameters of the joints that both have: stiffness and damping of each, dry friction and
    delay where both fitted them."""
    only_old: tuple[str, ...]
    """Joints that the earlier match alone has."""
    only_new: tuple[str, ...]
    """Joints that the later match alone has."""

    @property
    def outside(self) -> tuple[ParameterDrift, ...]:
        """Parameters that have changed by more than their intervals."""
        return tuple(parameter for parameter in self.parameters if parameter.verdict == "outside")

    @property
    def unresolved_gains(self) -> tuple[ParameterDrift, ...]:
        """Stiffnesses and dampings of which a change that matters would not show."""
        unresolved = []
        for parameter in self.parameters:
            if parameter.parameter in GAINS and parameter.verdict == "not resolved":
                unresolved.append(parameter)
        return tuple(unresolved)


def compare_gains(
    old: MatchedGains, new: MatchedGains, matters: float = CHANGE_THAT_MATTERS
) -> Drift:
    """Compare two matches of one robot in one simulator.

    Args:
        old: Earlier match.
        new: Later match.
        matters: Relative change of stiffness and damping that matters, above 0.

    Returns:
        A verdict for each parameter that both have.

    Raises:
        PronkError: The matches are of two robots or two simulators, or have no joint in common.
    """
    if not 0.0 < matters < 10.0:
        raise PronkError(
            f"--matters {matters:g}; expected the relative change of a gain that matters, above 0, "
            "as in 0.1."
        )
    if old.robot != new.robot:
        raise PronkError(
            f"the gains are of two robots, {old.robot} and {new.robot}; expected two matches of "
            "one."
        )
    if _conditions(old.simulator) != _conditions(new.simulator):
        raise PronkError(
            f"the gains hold for two simulators, {_simulator_words(old.simulator)} and "
            f"{_simulator_words(new.simulator)}; the same joint has other gains in each. Match the "
            "logs of both for one (pronk match --for), or translate one (pronk translate)."
        )
    parameters: list[ParameterDrift] = []
    for name, old_joint in old.joints.items():
        new_joint = new.joints.get(name)
        if new_joint is not None:
            parameters.extend(_joint_drift(name, old_joint, new_joint, matters))
    if not parameters:
        raise PronkError(
            f"no joint is in both: the earlier gains have {', '.join(old.joints)}, the later ones "
            f"{', '.join(new.joints)}."
        )
    return Drift(
        parameters=tuple(parameters),
        only_old=tuple(name for name in old.joints if name not in new.joints),
        only_new=tuple(name for name in new.joints if name not in old.joints),
    )


def compare_values(
    old: FittedValue, new: FittedValue, matters: float
) -> tuple[float, DriftVerdict]:
    """Compare two estimates of one number by their total intervals.

    Args:
        old: Earlier estimate.
        new: Later estimate.
        matters: Change that matters, in the unit of the number.

    Returns:
        The largest difference by chance, in the direction of the change, and the verdict.
    """
    rise = math.hypot(old.total95[1] - old.value, new.value - new.total95[0])
    fall = math.hypot(old.value - old.total95[0], new.total95[1] - new.value)
    change = new.value - old.value
    interval = rise if change >= 0.0 else fall
    if not math.isfinite(rise + fall):
        return math.nan, "not resolved"
    if abs(change) > interval:
        return interval, "outside"
    if max(rise, fall) > matters:
        return interval, "not resolved"
    return interval, "within"


def _joint_drift(
    name: str, old: JointGains, new: JointGains, matters: float
) -> list[ParameterDrift]:
    """Compare the parameters of a joint."""
    joint_reason = _incomparable(old, new)
    pairs: Mapping[str, tuple[FittedValue, FittedValue, float]] = {
        "stiffness": (old.stiffness, new.stiffness, matters * old.stiffness.value),
        "damping": (old.damping, new.damping, matters * old.damping.value),
        "frictionloss": (
            old.frictionloss,
            new.frictionloss,
            STICKING_THAT_MATTERS_RAD * old.stiffness.value,
        ),
        "delay": (old.delay_s, new.delay_s, DELAY_THAT_MATTERS_S),
    }
    drifts = []
    for parameter, (old_value, new_value, change) in pairs.items():
        interval, verdict = compare_values(old_value, new_value, change)
        is_gain = parameter in GAINS
        if math.isnan(interval) and not is_gain:
            # A friction or delay that was not fitted in both is none of this comparison.
            continue
        reason = joint_reason
        if math.isnan(interval) and not reason:
            reason = "it was held, or has no total interval, in one of the two"
        if reason:
            verdict = "not resolved"
        drifts.append(
            ParameterDrift(
                joint=name,
                parameter=parameter,
                old=old_value.value,
                new=new_value.value,
                interval=interval,
                matters=change,
                verdict=verdict,
                reason=reason,
            )
        )
    return drifts


def _incomparable(old: JointGains, new: JointGains) -> str:
    """Say why no parameter of a joint can be compared; empty if they can."""
    for label, joint in (("earlier", old), ("later", new)):
        if not joint.matched:
            reasons = "; ".join(joint.reasons) or "it is marked so"
            return f"the {label} gains are no match ({reasons})"
    armatures = (old.armature.value, new.armature.value)
    is_fitted = math.isfinite(old.armature.total95[0]) or math.isfinite(new.armature.total95[0])
    if not is_fitted and abs(armatures[1] - armatures[0]) > _SAME_ARMATURE * max(armatures):
        return (
            f"the models have armatures of {armatures[0]:.4g} and {armatures[1]:.4g} kg m^2, with "
            "which the same joint has other gains"
        )
    return ""


def _conditions(simulator: SimulatorInfo) -> tuple[str, str, int, float]:
    """What makes gains of two simulators comparable: engine, law, iterations, step [us]."""
    law = simulator.drive_law
    return simulator.engine, law.kind, law.iterations, round(1e6 * simulator.timestep_s)


def _simulator_words(simulator: SimulatorInfo) -> str:
    """Name a simulator with its law and step."""
    return (
        f"{simulator.profile or simulator.engine} (law {simulator.drive_law.label} at "
        f"{1e3 * simulator.timestep_s:g} ms)"
    )
