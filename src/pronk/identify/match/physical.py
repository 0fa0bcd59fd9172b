"""Physical parameters of drives, from those that a simulator's law needs at its step.

A fit in time finds the parameters with which the simulator moves as the robot does. The explicit
law holds a torque over a step h, so that these are not the drive's own. Without friction and limits
the law is linear,

    J (q+ - 2 q + q-) / h^2 = k (u - q) - d (q - q-) / h - b (q+ - q) / h - g q

with the inertia J, the gains k and d, the damping b of the joint, which MuJoCo treats implicitly,
and the stiffness g of gravity. Its response to a held command is compared with that of the joint in
continuous time, `k / (J' s^2 + (d' + b) s + k + g)` behind the hold, whose inertia, damping and
delay are fitted to it over the joint's band. To first order the inertia is J - h d / 2 + h b / 2
and the law answers half a step early, by which the fitted delay is too long. Dry friction is the
same to first order.

The stiffness is taken as stated. A drive whose motor gives more torque than stated has a larger
inertia, damping and friction in the same motion: this counts in the intervals
(`MatchSettings.gain_uncertainty`). The inertia and weight of the links are taken as the model has
them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from pronk.arrays import Array, ComplexArray
from pronk.identify.match.gains import FittedValue
from pronk.identify.match.least_squares import DriveVector, Residuals
from pronk.identify.match.parameters import PARAMETERS
from pronk.identify.match.replay import Replay
from pronk.identify.match.result import DriveFit
from pronk.robots.model import bench_inertia
from pronk.robots.robot import RobotSpec

PHYSICAL = ("damping", "armature", "frictionloss", "delay")
"""Parameters that are a property of the drive, in the order of `PARAMETERS`."""
VELOCITY_LAG_S = 1e-3
"""Longest time constant with which drives filter the velocity, the time between two computations
of the torque included [s]. The damping of a drive that does so takes `damping * lag` off the
inertia, which no motion shows."""
CORRECTION_ERROR = 0.15
"""Share of the correction that counts as its own error: friction, limits and the time in which the
drive itself computes are not in it."""
LOWEST_HZ = 0.3
"""Lowest frequency of the comparison [Hz], that of the weights of a fit in time."""


@dataclass(frozen=True, kw_only=True)
class LinearLaw:
    """A joint in the explicit law at a step, without friction and limits."""

    stiffness: float
    """Stiffness of the drive [N m/rad]."""
    damping: float
    """Damping of the drive [N m s/rad]."""
    inertia: float
    """Inertia, armature included [kg m^2]."""
    viscous: float
    """Damping of the joint itself [N m s/rad]."""
    gravity: float
    """How much gravity moves the joint back [N m/rad]."""
    step_s: float
    """Step of the simulator [s]."""

    def stable(self) -> bool:
        """Return whether the law does not swing from step to step, as no joint does."""
        after, now, before = self._coefficients()
        poles = np.roots([after, now, before]).astype(np.complex128)
        inside = np.abs(poles) < 1.0
        return bool(inside.all() and (poles.real > 0.0).all())

    def response(self, omega: Array) -> ComplexArray:
        """Return the response from the command of a step to the position at its start, (f,)."""
        after, now, before = self._coefficients()
        turn = np.exp(1j * omega * self.step_s)
        return np.asarray(self.stiffness / (after * turn + now + before / turn))

    def _coefficients(self) -> tuple[float, float, float]:
        """Return the factors of the next, the present and the last position."""
        step_s = self.step_s
        inertia = self.inertia / step_s**2
        after = inertia + self.viscous / step_s
        now = self.stiffness + self.gravity + (self.damping - self.viscous) / step_s
        before = inertia - self.damping / step_s
        return after, now - 2.0 * inertia, before


@dataclass(frozen=True, kw_only=True)
class ContinuousJoint:
    """The joint in continuous time that a joint in a law at a step is."""

    inertia: float
    """Inertia, armature included [kg m^2]."""
    damping: float
    """Damping of the drive [N m s/rad]."""
    lead_s: float
    """How much earlier the law answers a command [s]."""


def continuous_joint(law: LinearLaw, highest_hz: float) -> ContinuousJoint | None:
    """Fit the joint in continuous time to a joint in the explicit law.

    Every octave up to a frequency [Hz] counts alike, as in the fit of a sweep in time.

    Returns:
        The joint; None where the law swings from step to step.
    """
    if not law.stable() or law.stiffness + law.gravity <= 0.0:
        return None
    omega = 2.0 * np.pi * np.geomspace(min(LOWEST_HZ, 0.1 * highest_hz), highest_hz, 60)
    of_law = law.response(omega)
    half_step = 0.5 * law.step_s
    hold = np.sinc(omega * half_step / np.pi)

    def difference(numbers: Array) -> Array:
        inertia = numbers[0] * law.inertia
        damping = numbers[1] * law.damping + law.viscous
        lead_s = numbers[2] * half_step
        denominator = law.stiffness + law.gravity - inertia * omega**2 + 1j * omega * damping
        turned = np.exp(1j * omega * (lead_s - half_step))
        error = law.stiffness * hold * turned / denominator - of_law
        return np.concatenate([error.real, error.imag])

    start = np.array([1.0, 1.0, 1.0])
    fitted = least_squares(difference, start, x_scale=[0.1, 0.1, 0.1], method="trf").x
    return ContinuousJoint(
        inertia=float(fitted[0]) * law.inertia,
        damping=float(fitted[1]) * law.damping,
        lead_s=float(fitted[2]) * half_step,
    )


def physical_drives(
    replay: Replay, fits: Mapping[str, DriveFit], robot: RobotSpec, gain_uncertainty: float
) -> tuple[dict[str, DriveFit], dict[str, dict[str, FittedValue]]]:
    """Find the physical parameters of drives whose stiffness was taken as stated.

    Args:
        replay: The recordings that were fitted.
        fits: The fits in the explicit law at the robot's timestep.
        robot: The robot as it was simulated.
        gain_uncertainty: Relative uncertainty of the stated stiffness and of the torque constant.

    Returns:
        The fits, with the uncertainty in the total intervals of armature and friction, and the
        physical values by joint and name (`physical_drive`).
    """
    effects = stated_gain_effect(replay, fits)
    widened_fits = {}
    physical = {}
    for joint, fit in fits.items():
        effect = effects[joint]
        physical[joint] = physical_drive(fit, robot, effect, gain_uncertainty)
        total95 = dict(fit.total95)
        for name in ("armature", "frictionloss"):
            if name in effect and name in total95:
                center = fit.values[name]
                stated = abs(effect[name]) * gain_uncertainty * center
                low = center - float(np.hypot(center - total95[name][0], stated))
                high = center + float(np.hypot(total95[name][1] - center, stated))
                total95[name] = (max(low, 0.0), high)
        widened_fits[joint] = replace(fit, total95=total95)
    return widened_fits, physical


def stated_gain_effect(replay: Replay, fits: Mapping[str, DriveFit]) -> dict[str, dict[str, float]]:
    """Find how fitted parameters move if the stiffness was another than stated.

    To first order, by the derivatives of the simulated positions.

    Args:
        replay: The recordings that were fitted.
        fits: The fit of each joint.

    Returns:
        For each joint and fitted parameter, its relative change (of the delay the change [s]) for a
        relative change of the stiffness; nothing for joints whose stiffness was fitted.
    """
    samples = [np.ones(len(recording.time), dtype=bool) for recording in replay.recordings]
    values = {joint: dict(fit.values) for joint, fit in fits.items()}
    residuals = Residuals(replay, samples, DriveVector({}, values))
    changed_names = ["stiffness"]
    for name in PHYSICAL:
        if any(name in fit.ci95 for fit in fits.values()):
            changed_names.append(name)
    sets: list[dict[str, dict[str, float]]] = [values]
    steps = {}
    for name in changed_names:
        parameter = PARAMETERS[name]
        step = replay.delay_step_s if name == "delay" else parameter.step
        steps[name] = step
        changed = {joint: dict(drive) for joint, drive in values.items()}
        for drive in changed.values():
            drive[name] = drive[name] * (1.0 + step) if parameter.log else drive[name] + step
        sets.append(changed)
    before, *after = [residuals.compared(positions) for positions in replay.positions(sets)]
    derivative = {}
    for name, moved in zip(changed_names, after, strict=True):
        step = np.log1p(steps[name]) if PARAMETERS[name].log else steps[name]
        derivative[name] = (moved - before) / step
    effects: dict[str, dict[str, float]] = {}
    for joint, fit in fits.items():
        names = [name for name in PHYSICAL if name in fit.ci95]
        effects[joint] = {}
        if "stiffness" in fit.ci95 or not names:
            continue
        rows = residuals.rows(joint)
        jacobian = np.stack([derivative[name][rows] for name in names], axis=1)
        scale = np.linalg.norm(jacobian, axis=0)
        scale[scale == 0.0] = 1.0
        change = np.linalg.lstsq(jacobian / scale, -derivative["stiffness"][rows], rcond=None)[0]
        effects[joint] = dict(zip(names, (change / scale).tolist(), strict=True))
    return effects


def physical_drive(
    fit: DriveFit, robot: RobotSpec, effect: Mapping[str, float], gain_uncertainty: float
) -> dict[str, FittedValue]:
    """Return the fitted parameters of a drive as physical values.

    Args:
        fit: The fit in the explicit law at the robot's timestep.
        robot: The robot as it was simulated.
        effect: How each parameter moves with the stiffness, by `stated_gain_effect`.
        gain_uncertainty: Relative uncertainty of the stated stiffness and of the torque constant.

    Returns:
        Values with their total intervals by name; empty where the law is another, its step is too
        long for the joint, or the stiffness was fitted, so that the parameters are equivalents of
        the law.
    """
    if robot.law.kind != "explicit" or not effect:
        return {}
    joint = robot.joint(fit.joint)
    inertia, gravity = bench_inertia(robot, joint.original[0])
    link_inertia = inertia - joint.drive.armature

    def corrected(damping: float, armature: float) -> ContinuousJoint | None:
        law = LinearLaw(
            stiffness=fit.values["stiffness"],
            damping=damping,
            inertia=link_inertia + armature,
            viscous=joint.drive.viscous_damping,
            gravity=gravity,
            step_s=robot.timestep_s,
        )
        return continuous_joint(law, joint.band_hz[1])

    damping = fit.values["damping"]
    armature = fit.values["armature"]
    center = corrected(damping, armature)
    if center is None:
        return {}
    shifts = {
        "damping": center.damping - damping,
        "armature": center.inertia - link_inertia - armature,
        "frictionloss": 0.0,
        "delay": -center.lead_s,
    }
    # Of the inertia that the damping of a drive with a filtered velocity hides, half is expected.
    hidden = 0.5 * damping * VELOCITY_LAG_S
    values = {}
    for name, change in effect.items():
        value = fit.values[name] + shifts[name]
        stated = change * gain_uncertainty
        if PARAMETERS[name].log:
            stated *= fit.values[name]
        errors = [stated, CORRECTION_ERROR * shifts[name]]
        if name == "armature":
            value += hidden
            errors.append(hidden)
            low_damping, high_damping = fit.total95.get("damping", (damping, damping))
            for end in (low_damping, high_damping):
                moved = corrected(end, armature)
                if moved is not None:
                    errors.append((moved.inertia - center.inertia) / np.sqrt(2.0))
        low, high = fit.total95[name]
        lower = float(np.linalg.norm([fit.values[name] - low, *errors]))
        upper = float(np.linalg.norm([high - fit.values[name], *errors]))
        lowest = value - lower
        if PARAMETERS[name].log:
            lowest = max(lowest, 0.0)
        values[name] = FittedValue(value=value, total95=(lowest, value + upper))
    return values
