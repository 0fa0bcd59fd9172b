"""The plan of a sweep: its excitations, their order, and the worst case before anything moves.

Nothing moves before `SweepPlan.check` has passed. It refuses what could exceed a limit of the
robot in any corner of the robot's uncertainty, and names the amplitude that would fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pronk.arrays import Array
from pronk.errors import PlanError
from pronk.identify.excitation.signals import Chirp, Signal
from pronk.identify.excitation.worst_case import SPEED_SHARE, Forecast, Uncertainty, forecast
from pronk.robots.robot import RobotSpec

POSE_RAMP_S = 2.0
"""Time to move softly to the pose before the excitations of a joint [s]."""
_STILL = 1e-6
"""Share of an amplitude that stands for none: the joints are held in their pose."""
_CLOSE = 1.04
"""Ratio of an amplitude that is too large to one that fits at which the search for it ends."""
_MOST_FORECASTS = 25
"""Forecasts of the search for an amplitude, at most."""
_NEAR_FORECASTS = 3
"""Forecasts that are tried in a row a tenth below an amplitude that is too large; then the search
goes halfway to one that fits."""
RESOLVED_RAD = 1e-4
"""Smallest amplitude of a sweep: about one count of an encoder of 16 bits at the joint, 2 pi / 2^16
[rad]. What moves less, no encoder of a robot's joint measures."""
SWINGING_RAD = 1e-3
"""Smallest amplitude that is offered for a joint that swings undamped [rad]: below its resonance
the joint moves by that amplitude alone, ten counts of such an encoder."""
SWINGING = 3.0
"""Reach over the amplitude of the command, in the worst case, from which on a joint is said to
swing undamped; a joint that is damped at a sixth of critical has it in resonance."""
RESONANT = 1.5
"""The same of the model as it is, of a joint that is damped at a third of critical."""
FRICTION_SHARE = 0.5
"""Share of the planned torque that dry friction may take before a warning."""


@dataclass(frozen=True, kw_only=True)
class PlannedExcitation:
    """A signal that will be sent to one joint."""

    joint: str
    """Name of the joint."""
    signal: Signal
    """The signal."""
    repeat: int = 0
    """Number of this repeat of the same signal, from 0."""
    clamped: tuple[str, ...] = ()
    """Names of the joints that are fixed mechanically during the excitation."""
    sign: float = 1.0
    """Factor of the signal, 1 or -1: mirror-image joints are excited mirrored, so that the match
    simulates each family once."""

    def offsets(self, rate_hz: float) -> Array:
        """Return command offsets about the pose at each tick [rad], shape (ticks,)."""
        return np.asarray(self.sign * self.signal.samples(rate_hz))


@dataclass(frozen=True, kw_only=True)
class SweepPlan:
    """Excitations in the order of the sweep, as `make_plan` builds them."""

    robot: RobotSpec
    """The robot."""
    excitations: tuple[PlannedExcitation, ...]
    """Excitations, joint by joint, the largest amplitude of each joint first."""
    rate_hz: float
    """Rate of the commands [Hz]."""
    settle_s: float
    """Rest after each excitation, logged as its part [s]."""
    stiffness: Array
    """Stiffness on the drives [N m/rad], shape (joints,)."""
    damping: Array
    """Damping on the drives [N m s/rad], shape (joints,)."""
    uncertainty: Uncertainty
    """Differences of the robot from its model that the worst case covers."""
    forecasts: tuple[Forecast, ...] = ()
    """Worst case of the loudest excitation of each joint, for it and its neighbours, over every
    corner of the uncertainty; quieter ones of the same signal stay inside."""
    timestep_s: Mapping[str, float] = field(default_factory=dict)
    """Physics step of the forecast of each excited joint [s]."""

    @property
    def pose(self) -> Array:
        """Positions the signals are centred on [rad], shape (joints,)."""
        return np.array([joint.default_position for joint in self.robot.joints])

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the excited joints, in order; each has a log file of its own."""
        return tuple(dict.fromkeys(excitation.joint for excitation in self.excitations))

    def seconds(self, excitation: PlannedExcitation) -> float:
        """Return the time of one excitation, its rest included [s]."""
        return excitation.signal.duration_s(self.rate_hz) + self.settle_s

    @property
    def duration_s(self) -> float:
        """Time of the whole sweep on the machine's clock [s]."""
        excited_s = sum(self.seconds(excitation) for excitation in self.excitations)
        return excited_s + len(self.joints) * (POSE_RAMP_S + 2.0 * self.settle_s)

    def rows(self) -> list[dict[str, str | float]]:
        """Return the worst case of each excited joint, one row a joint, for JSON.

        Entries with `nominal` are of the model as it is, without uncertainty.
        """
        rows: list[dict[str, str | float]] = []
        for worst in self.forecasts:
            if worst.amplitude == 0.0:
                continue
            nominal = worst.nominal or worst
            rows.append(
                {
                    "joint": worst.joint,
                    "amplitude_rad": worst.amplitude,
                    "lowest_rad": worst.lowest,
                    "range_low_rad": worst.range[0],
                    "highest_rad": worst.highest,
                    "range_high_rad": worst.range[1],
                    "speed_rad_s": worst.speed,
                    "no_load_speed_rad_s": worst.no_load_speed,
                    "torque_nm": worst.torque,
                    "effort_limit_nm": worst.effort_limit,
                    "torque_share": worst.torque_share,
                    "mechanical_power_w": worst.mechanical_power,
                    "electrical_power_w": worst.electrical_power,
                    "bus_current_a": worst.bus_current,
                    "nominal_lowest_rad": nominal.lowest,
                    "nominal_highest_rad": nominal.highest,
                    "nominal_speed_rad_s": nominal.speed,
                    "nominal_torque_nm": nominal.torque,
                    "timestep_s": self.timestep_s[worst.joint],
                }
            )
        return rows

    def check(self) -> None:
        """Refuse a sweep that could exceed a limit.

        Raises:
            PlanError: A joint could exceed a limit; the message names joint, number, limit, and
                the amplitude that fits in simulation.
        """
        for worst in self.forecasts:
            breach = next(worst.breaches(), "")
            if not breach:
                continue
            loudest = self._loudest(worst.excited)
            fitting_rad = self.fitting_amplitude(worst.excited)
            swing = self._swing(worst.excited)
            least_rad = SWINGING_RAD if swing > SWINGING else RESOLVED_RAD
            if 0.0 < fitting_rad < least_rad:
                way_out = (
                    f"only amplitudes below {least_rad:g} rad would fit, which no encoder "
                    "resolves, so choose other joints, another pose or other gains"
                )
            elif fitting_rad > 0.0:
                way_out = f"an amplitude of {fitting_rad:.3g} rad fits (--amplitude)"
            else:
                way_out = "no amplitude fits, so choose other joints or another pose"
            if swing > SWINGING:
                way_out += (
                    f"; it swings by {swing:.0f} times its command, as its gains hardly damp it: "
                    "state the damping of the drive, or the viscous friction of the joint"
                )
            raise PlanError(
                f"{worst.excited}: excited with {loudest.signal.amplitude:g} rad, {worst.joint} "
                f"could {breach} (inertia, gains and friction uncertain by "
                f"{100 * self.uncertainty.inertia:.0f}, {100 * self.uncertainty.stiffness:.0f} and "
                f"{100 * self.uncertainty.friction:.0f} %); {way_out}."
            )

    def warnings(self) -> list[str]:
        """Return sentences on what will keep a sweep of this plan from showing the gains."""
        sentences = []
        for worst in self.forecasts:
            friction = self.robot.joint(worst.joint).drive.frictionloss
            nominal = worst.nominal or worst
            if worst.amplitude > 0.0 and friction > FRICTION_SHARE * nominal.torque:
                sentences.append(
                    f"{worst.joint}: the dry friction of its robot.yaml ({friction:.3g} N m) takes "
                    f"{100 * min(1.0, friction / nominal.torque):.0f} % of the planned torque "
                    f"({nominal.torque:.3g} N m), so that a match will find friction and little "
                    "else; take a larger amplitude or other gains, or check the friction"
                )
        return sentences

    def _swing(self, joint: str) -> float:
        """Return how far an excited joint moves, over the amplitude of its command."""
        swing = 0.0
        for worst in self.forecasts:
            if worst.joint == joint and worst.amplitude > 0.0:
                nominal = worst.nominal or worst
                # Between its ends, so that where it sags to is no part of it. The worst case has
                # where it sags to in every corner, so that it alone tells nothing.
                if (nominal.highest - nominal.lowest) / (2.0 * worst.amplitude) > RESONANT:
                    swing = (worst.highest - worst.lowest) / (2.0 * worst.amplitude)
        return swing

    def fitting_amplitude(self, joint: str) -> float:
        """Find the largest amplitude of a joint's signal that exceeds no limit.

        Args:
            joint: Name of an excited joint.

        Returns:
            The amplitude [rad], at most that of the plan, with three digits and within 5 % of the
            largest; 0 where the joints exceed a limit even as they hold their pose.
        """
        excitation = self._loudest(joint)
        forecasts = [worst for worst in self.forecasts if worst.excited == joint]
        if not _exceeds(forecasts):
            return excitation.signal.amplitude
        if _exceeds(self._at_share(excitation, _STILL)):
            return 0.0
        fitting = _STILL
        too_large = 1.0
        # Motion grows about as the amplitude does.
        share = 0.98 / max(_linear_share(worst) for worst in forecasts)
        too_large_in_a_row = 0
        for _ in range(_MOST_FORECASTS):
            if not fitting < share < too_large:
                share = (fitting * too_large) ** 0.5
            forecasts = self._at_share(excitation, share)
            if _exceeds(forecasts):
                too_large = share
                share = 0.9 * share
                too_large_in_a_row += 1
                if too_large_in_a_row > _NEAR_FORECASTS:
                    share = (fitting * too_large) ** 0.5
            else:
                too_large_in_a_row = 0
                fitting = share
                share = share / max(_linear_share(worst) for worst in forecasts)
                share = min(max(share, _CLOSE * fitting), 0.5 * (fitting + too_large))
            if too_large <= _CLOSE * fitting:
                break
        amplitude = fitting * excitation.signal.amplitude
        # Three significant digits.
        scale = 10.0 ** (np.floor(np.log10(amplitude)) - 2)
        return float(np.floor(amplitude / scale * (1.0 + 1e-12)) * scale)

    def _loudest(self, joint: str) -> PlannedExcitation:
        """Return the excitation of a joint that is forecast: its first one."""
        for excitation in self.excitations:
            if excitation.joint == joint:
                return excitation
        raise PlanError(f"the plan does not excite {joint}; it excites {', '.join(self.joints)}.")

    def _at_share(self, excitation: PlannedExcitation, share: float) -> list[Forecast]:
        """Forecast a share of an excitation."""
        signal = replace(excitation.signal, amplitude=share * excitation.signal.amplitude)
        forecasts, _ = self._worst(
            replace(excitation, signal=signal), {}, self.timestep_s[excitation.joint]
        )
        return forecasts

    def _worst(
        self,
        excitation: PlannedExcitation,
        cache: dict[tuple[object, ...], tuple[list[Forecast], float]],
        timestep_s: float | None = None,
    ) -> tuple[list[Forecast], float]:
        """Forecast every joint of the chain; mirror-image legs are simulated once.

        Args:
            excitation: The excitation.
            cache: Forecasts that were made, which is added to.
            timestep_s: Physics step [s]; one at which the peaks have converged if None.

        Returns:
            The forecasts, and the physics step [s].
        """
        robot = self.robot
        excited = robot.joint(excitation.joint)
        original_name, sign = excited.original
        original = robot.joint(original_name)
        chain = excited.chain or (excited.name,)
        original_chain = original.chain or (original_name,)
        stiffness = {}
        damping = {}
        names = {}
        for name, simulated_name in zip(chain, original_chain, strict=True):
            column = robot.joint_names.index(name)
            stiffness[simulated_name] = float(self.stiffness[column])
            damping[simulated_name] = float(self.damping[column])
            names[simulated_name] = name
        offsets = sign * original.original[1] * excitation.offsets(self.rate_hz)
        key = (original_name, str((stiffness, damping)), offsets.tobytes())
        if key not in cache:
            cache[key] = forecast(
                robot,
                original_name,
                offsets,
                rate_hz=self.rate_hz,
                stiffness=stiffness,
                damping=damping,
                uncertainty=self.uncertainty,
                timestep_s=timestep_s,
            )
        simulated_forecasts, timestep_s = cache[key]
        forecasts = []
        for simulated in simulated_forecasts:
            mirrored = simulated.mirrored(robot, names[simulated.joint])
            forecasts.append(mirrored.of_excitation(excitation.joint))
        return forecasts, timestep_s


def _exceeds(forecasts: Sequence[Forecast]) -> bool:
    """Tell whether a joint could exceed a limit."""
    breaches: list[str] = []
    for worst in forecasts:
        breaches += worst.breaches()
    return len(breaches) > 0


def _linear_share(worst: Forecast) -> float:
    """Return the share of the limits of torque and speed that a joint uses, at standstill."""
    speed_share = worst.speed / (SPEED_SHARE * worst.no_load_speed)
    return max(worst.torque / worst.effort_limit, speed_share, 1e-9)


def make_plan(
    robot: RobotSpec,
    joints: Sequence[str] | None = None,
    signal: Signal | None = None,
    *,
    amplitudes: Sequence[float] = (0.25, 0.125),
    repeats: int | Sequence[int] = 3,
    settle_s: float = 0.5,
    drive_gains: Mapping[str, tuple[float, float]] | None = None,
    uncertainty: Uncertainty | None = None,
) -> SweepPlan:
    """Plan a sweep, and forecast its effect on the robot; call its `check` before anything moves.

    The joints are excited one at a time. Joints that the robot's file clamps for an excitation are
    clamped, the others are held by their drives. Each excitation ends with a rest.

    Args:
        robot: The robot.
        joints: Names of the joints to excite, in order; all in the robot's order if None.
        signal: The signal; the paper's chirp if None.
        amplitudes: Peaks of the signal [rad]. Two amplitudes show friction.
        repeats: Times that each amplitude is repeated, one number for all or one each. Intervals
            need three repeats of the largest amplitude, which is the one matched.
        settle_s: Rest after each excitation [s].
        drive_gains: Stiffness [N m/rad] and damping [N m s/rad] on the drives by joint, where they
            are not the robot's.
        uncertainty: Differences of the robot from its model; the defaults of `Uncertainty` if None.

    Raises:
        PlanError: The plan excites nothing, or a number cannot be.
        RobotError: The robot has no such joint.
    """
    # One joint at a time: paper F1. Held by their drives: F5. Clamped: F6.
    stated_gains = drive_gains or {}
    names = robot.joint_names if joints is None else tuple(dict.fromkeys(joints))
    for name in (*names, *stated_gains):
        robot.joint(name)
    counts = [repeats] * len(amplitudes) if isinstance(repeats, int) else list(repeats)
    if not names or not amplitudes or len(counts) != len(amplitudes) or min(counts) < 1:
        raise PlanError(
            f"a plan of {len(names)} joints, {len(amplitudes)} amplitudes and {repeats} repeats "
            "excites nothing; expected at least one of each, and one number of repeats for all or "
            "one an amplitude."
        )
    repeated = [peak for peak in dict.fromkeys(amplitudes) if list(amplitudes).count(peak) > 1]
    if repeated:
        raise PlanError(
            f"the amplitude {repeated[0]:g} rad is given twice; expected each amplitude once, with "
            "its repeats (--repeats, one number for all or one an amplitude)."
        )
    if 0.0 < max(amplitudes) < RESOLVED_RAD:
        raise PlanError(
            f"an amplitude of {max(amplitudes):g} rad is less than an encoder resolves; expected "
            f"at least {RESOLVED_RAD:g} rad."
        )
    if not (np.isfinite(settle_s) and settle_s >= 0.0):
        raise PlanError(f"settle_s is {settle_s}; expected 0 s or more, for instance 0.5.")
    stiffness = np.array([joint.stiffness for joint in robot.joints])
    damping = np.array([joint.damping for joint in robot.joints])
    for name, (joint_stiffness, joint_damping) in stated_gains.items():
        column = robot.joint_names.index(name)
        stiffness[column] = joint_stiffness
        damping[column] = joint_damping
    for label, values in (("stiffness", stiffness), ("damping", damping)):
        if not (np.isfinite(values).all() and (values >= 0.0).all()):
            raise PlanError(
                f"a {label} on the drives is negative or not finite; expected 0 or more."
            )
    base_signal = Chirp() if signal is None else signal
    counts_by_amplitude = dict(sorted(zip(amplitudes, counts, strict=True), reverse=True))
    excitations = []
    for name in names:
        joint = robot.joint(name)
        for amplitude, count in counts_by_amplitude.items():
            for repeat in range(count):
                excitation = PlannedExcitation(
                    joint=name,
                    signal=replace(base_signal, amplitude=amplitude),
                    repeat=repeat,
                    clamped=joint.clamped,
                    sign=joint.original[1],
                )
                excitations.append(excitation)
    plan = SweepPlan(
        robot=robot,
        excitations=tuple(excitations),
        rate_hz=robot.policy_rate_hz,
        settle_s=settle_s,
        stiffness=stiffness,
        damping=damping,
        uncertainty=Uncertainty() if uncertainty is None else uncertainty,
    )
    cache: dict[tuple[object, ...], tuple[list[Forecast], float]] = {}
    forecasts: list[Forecast] = []
    timestep_by_joint = {}
    for excitation in excitations:
        if excitation.repeat == 0 and excitation.signal.amplitude == max(amplitudes):
            joint_forecasts, timestep_s = plan._worst(excitation, cache)
            forecasts += joint_forecasts
            timestep_by_joint[excitation.joint] = timestep_s
    return replace(plan, forecasts=tuple(forecasts), timestep_s=timestep_by_joint)
