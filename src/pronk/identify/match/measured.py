"""Measured responses of joints, and simulated ones through the same estimator.

With the command given, the H1 estimate is linear in the position, `response = position @ matrix`.
The simulated positions of a whole grid of gains therefore become responses in one product, through
the very windows and segments that the log went through.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from pronk.arrays import Array, ComplexArray, Mask
from pronk.errors import IdentifiabilityError, LogError
from pronk.identify.logs.joint_log import Excitation, JointLog, group_repeats
from pronk.identify.logs.velocity import velocity_column
from pronk.identify.match.settings import MatchSettings
from pronk.identify.response.estimate import (
    estimate_response,
    fitting_estimator,
    log_rate,
    operator,
)
from pronk.identify.response.h1 import H1Operator
from pronk.identify.response.response import (
    LONGEST_SEGMENT_S,
    FrequencyResponse,
    ShortExcitationError,
)
from pronk.identify.simulators.command_trace import CommandTrace, command_trace
from pronk.identify.simulators.simulator import JointRigs
from pronk.robots.robot import RobotSpec

T = TypeVar("T")

DB = 20.0 / np.log(10.0)
"""Decibels per neper: `20 log10(gain) = DB * log(gain)`."""
FLOOR_DB = 0.1
"""Smallest deviation of a measured gain that is used [dB]. Coherence near 1 would otherwise let a
few frequencies outvote the band, though the model itself is not better than this."""
EXCITED_POWER = 1e-3
"""Power of the command over its largest from which on a frequency counts as excited: 30 dB."""
FEWEST_EXCITED = 4
"""Fewest excited frequencies of a sweep's response: a single sine has up to three."""
_FOLLOWS = 0.1
"""Share of the command by which a slow position may differ without being said."""
_BINS_OF_A_SINE = 6
"""Most frequencies over which the Hann window spreads a sine at 30 dB."""
_HIGHEST_HZ = 25.0
"""Frequency up to which commands are looked at [Hz]; above are the images of a held one."""
MOST_SINES = 4
"""Most single sines of a command that are listed one by one."""
_SAME_AMPLITUDE_RAD = 1e-4
"""Difference of the amplitudes of two logs below which they are the same [rad]."""
_TAIL = 2e-4
"""Absolute error of gain that leaving out the end of the log would cause in a joint that follows
its command: 0.002 dB at gain 1. Over the paper's grid it was 0.001 dB; nodes differ by 0.02 dB."""


def rms(values: Array | ComplexArray) -> float:
    """Return the root mean square of magnitudes."""
    return float(np.sqrt(np.mean(np.abs(values) ** 2)))


@dataclass(frozen=True, kw_only=True)
class MeasuredJoint:
    """Response of a joint at one amplitude, ready to be compared with simulations."""

    trace: CommandTrace
    """Command at every physics step of the simulator."""
    sign: float
    """1, or -1 where the joint mirrors the joint that is simulated in its place."""
    measured: FrequencyResponse
    """Response that was measured, at f frequencies."""
    operator: H1Operator
    """Linear map from positions to the response."""
    excited_mask: Mask
    """Frequencies in the band that the command excites, shape (f,)."""
    fit_mask: Mask
    """Frequencies that a fit compares: in the band, excited, coherent enough, shape (f,)."""
    warnings: tuple[str, ...] = ()
    """Sentences on smaller amplitudes that could not be used."""

    @property
    def joint(self) -> str:
        """Name of the excited joint."""
        return self.trace.joint

    @property
    def omega(self) -> Array:
        """Angular frequencies of the fit [rad/s], shape (inside,)."""
        return self.measured.omega[self.fit_mask]

    @cached_property
    def fit_matrix(self) -> Array:
        """Matrix from positions about the pose to the response, shape (steps, 2 inside).

        Real and imaginary columns lie side by side: one real product is faster than a complex one.
        A chirp leaves the band long before it ends. The rows end where all later positions
        together move no gain by `_TAIL`, judged by a joint that follows its command perfectly, so
        that later steps need not be simulated.
        """
        matrix = self.operator.matrix(self.trace.time, self.fit_mask)
        command = self.trace.command - self.trace.command[0]
        contributions = (matrix * command[:, None])[::-1]
        remaining = np.abs(np.cumsum(contributions, axis=0)[::-1]).max(axis=1)
        loud_steps = np.nonzero(remaining > _TAIL)[0]
        if len(loud_steps):
            matrix = matrix[: int(loud_steps[-1]) + 2]
        return np.hstack([matrix.real, matrix.imag])

    @property
    def steps(self) -> int:
        """Physics steps that the fit needs."""
        return len(self.fit_matrix)

    def fit_response(self, position: Array) -> ComplexArray:
        """Estimate responses at the frequencies of the fit, in this joint's coordinate.

        Args:
            position: Positions of the simulated joint [rad], shape (..., at least `steps`).

        Returns:
            Responses, shape (..., inside).
        """
        # The mean is removed; without it nothing is cut off where the steps end at rest.
        moved = position[..., : self.steps] - position[..., :1]
        pair = moved @ self.fit_matrix
        half = pair.shape[-1] // 2
        return np.asarray(self.sign * (pair[..., :half] + 1j * pair[..., half:]))

    def full_response(self, position: Array) -> ComplexArray:
        """Estimate the response at all frequencies, shape (f,), of positions at all steps [rad]."""
        time = self.trace.time
        return np.asarray(self.sign * self.operator.response(time, position[: len(time)]))

    def deviation_db(self) -> Array:
        """Return the standard deviation of the measured gain by coherence [dB], (inside,)."""
        return np.asarray(np.hypot(DB * self.measured.deviation()[self.fit_mask], FLOOR_DB))

    def error_db(self, simulated: ComplexArray) -> Array:
        """Return the gain over the measured one [dB] of responses of shape (..., inside)."""
        measured_gain = np.abs(self.measured.response[self.fit_mask])
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(DB * (np.log(np.abs(simulated)) - np.log(measured_gain)))

    def rms_db(self, simulated: ComplexArray) -> float:
        """Return the root mean square of `error_db`, every frequency counting alike [dB]."""
        return rms(self.error_db(simulated))

    def measurement_error_db(self) -> float:
        """Return the RMS half-width of the measured gain's own 95 % interval in the band [dB]."""
        relative = self.measured.relative_error(0.95)[self.fit_mask]
        return float(DB * np.sqrt(np.mean(relative**2)))


def logs_by_joint(logs: Sequence[JointLog], robot: RobotSpec) -> dict[str, list[JointLog]]:
    """Sort logs by the joints that they excite.

    Args:
        logs: Logs of one robot; a log may excite several joints.
        robot: The robot.

    Returns:
        Logs of each excited joint, joints in the robot's order.

    Raises:
        LogError: No log excites a joint by a commanded position.
        RobotError: An excited joint is not the robot's.
    """
    excited_in: dict[str, list[JointLog]] = {}
    for log in logs:
        for name in log.excited_joints:
            excited_in.setdefault(name, []).append(log)
    for name in excited_in:
        robot.joint(name)
    if not excited_in:
        message = (
            f"{len(logs)} logs excite no joint by a commanded position; expected some of "
            f"{', '.join(robot.joint_names)}"
        )
        if any(log.torque is not None for log in logs):
            raise LogError(f"{message}; --mode drive fits drives to torques.")
        raise LogError(f"{message}.")
    return {name: excited_in[name] for name in robot.joint_names if name in excited_in}


def measured_joints(
    logs: Sequence[JointLog], joint_name: str, robot: RobotSpec, settings: MatchSettings
) -> list[MeasuredJoint]:
    """Estimate a joint's responses, repeats in several logs put together.

    Sine steps are left out: they are read step by step and have no single matrix.

    Args:
        logs: Logs that excite the joint.
        joint_name: The joint.
        robot: The robot as it is simulated; the commands are sampled at its physics steps.
        settings: Estimator and lowest coherence.

    Returns:
        One response an amplitude, the largest amplitude first.

    Raises:
        LogError: The joint was not excited or did not move, or its unit is unknown.
        IdentifiabilityError: Too little of the band is coherent at the largest amplitude of every
            log.
        ShortExcitationError: All excitations are too short for a response in the joint's band.
    """
    targets: list[MeasuredJoint] = []
    errors: list[IdentifiabilityError | ShortExcitationError] = []
    for log in logs:
        try:
            targets += _responses_of_log(log, joint_name, robot, settings)
        except (IdentifiabilityError, ShortExcitationError) as error:
            errors.append(error)
    if not targets:
        raise errors[0]
    merged = [merged_repeats(repeats) for repeats in grouped(targets, _same_signal)]
    merged.sort(key=lambda target: -target.measured.amplitude)
    left_out = [f"a log has no response to compare: {error}" for error in errors]
    merged[0] = replace(merged[0], warnings=(*merged[0].warnings, *left_out))
    return merged


def _same_signal(first: MeasuredJoint, second: MeasuredJoint) -> bool:
    """Return whether two responses are of one amplitude and have the same frequencies."""
    one = first.measured
    other = second.measured
    return (
        abs(one.amplitude - other.amplitude) < _SAME_AMPLITUDE_RAD
        and one.estimator == other.estimator
        and len(one.omega) == len(other.omega)
        and bool(np.allclose(one.omega, other.omega))
    )


def _responses_of_log(
    log: JointLog, joint_name: str, robot: RobotSpec, settings: MatchSettings
) -> list[MeasuredJoint]:
    """Estimate the responses of one joint in one log, the largest amplitude first."""
    source = log.source or "log"
    segments = [segment for segment in log.segmented().segments if segment.kind != "sine_steps"]
    if not any(joint_name in segment.joints for segment in segments):
        raise LogError(
            f"{source}: {joint_name} was excited by sine steps only; match a chirp or a multisine, "
            "and keep the steps to check it."
        )
    log = replace(log, segments=tuple(segments))
    joint = robot.joint(joint_name)
    excitations = log.excitations(joint_name)
    rate_hz = log_rate(excitations)
    estimator = fitting_estimator(excitations, settings.estimator)
    responses = estimate_response(log, joint_name, estimator)
    targets: list[MeasuredJoint] = []
    warnings: list[str] = []
    for repeats, response in zip(group_repeats(excitations), responses, strict=True):
        response_operator = operator(repeats[0], estimator, rate_hz)
        excited_mask = response.band(*joint.band_hz)
        if response.estimator == "H1":
            power = response_operator.excitation
            # Frequencies beside a single line that only show its leakage have no coherence.
            excited = (power >= EXCITED_POWER * power.max()) & (response.coherence > 0.0)
            excited_mask = excited_mask & excited
        try:
            fit_mask = _compared_frequencies(
                response, excited_mask, joint.band_hz, settings.coherence_min, repeats[0]
            )
        except (IdentifiabilityError, ShortExcitationError) as error:
            # The largest amplitude must be usable; a smaller one only checks it.
            if not targets:
                raise
            warnings.append(f"the response at {response.amplitude:.3g} rad is left out: {error}")
            continue
        if response.estimator == "H1" and single_sines(repeats[0]):
            excited_count = int(excited_mask.sum())
            count = int(response.band(*joint.band_hz).sum())
            warnings.append(few_frequencies(repeats[0], excited_count, count, joint.band_hz))
        # The commands of all repeats are the same, so that of the first stands for them.
        targets.append(
            MeasuredJoint(
                trace=command_trace(repeats[0], robot),
                sign=joint.original[1],
                measured=response,
                operator=response_operator,
                excited_mask=excited_mask,
                fit_mask=fit_mask,
            )
        )
    targets[0] = replace(targets[0], warnings=tuple(warnings))
    return targets


def merged_repeats(targets: Sequence[MeasuredJoint]) -> MeasuredJoint:
    """Put responses of one amplitude from several logs together; each log counts by its repeats.

    Raises:
        LogError: The responses have different frequencies.
    """
    first = targets[0]
    if len(targets) == 1:
        return first
    response_sum = np.zeros_like(first.measured.response)
    coherence_sum = np.zeros_like(first.measured.coherence)
    averages = np.zeros_like(first.measured.averages)
    repeats = []
    # Only frequencies that are coherent in all logs are compared.
    fit_mask = first.fit_mask
    excited_mask = first.excited_mask
    sources: list[str] = []
    warnings: list[str] = []
    for target in targets:
        measured = target.measured
        if not np.allclose(measured.omega, first.measured.omega):
            raise LogError(
                f"{first.joint} was excited at {measured.amplitude:.3g} rad in several logs whose "
                "responses have different frequencies; match them one at a time."
            )
        weight = len(measured.repeats)
        response_sum = response_sum + weight * measured.response
        coherence_sum = coherence_sum + weight * measured.coherence
        averages = averages + measured.averages
        repeats.append(measured.repeats)
        fit_mask = fit_mask & target.fit_mask
        excited_mask = excited_mask & target.excited_mask
        if measured.source not in sources:
            sources.append(measured.source)
        for warning in target.warnings:
            if warning not in warnings:
                warnings.append(warning)
    all_repeats = np.concatenate(repeats)
    merged = replace(
        first.measured,
        response=response_sum / len(all_repeats),
        coherence=coherence_sum / len(all_repeats),
        averages=averages,
        repeats=all_repeats,
        source=", ".join(sources),
    )
    return replace(
        first,
        measured=merged,
        excited_mask=excited_mask,
        fit_mask=fit_mask,
        warnings=tuple(warnings),
    )


def _compared_frequencies(
    response: FrequencyResponse,
    excited: Mask,
    band_hz: tuple[float, float],
    coherence_min: float,
    excitation: Excitation,
) -> Mask:
    """Return the coherent ones of the excited frequencies of a band, shape (f,).

    Raises:
        ShortExcitationError: The band has fewer than three frequencies.
        IdentifiabilityError: The command excites hardly any of them, the joint did not move, or
            more than half of the excited ones are incoherent.
    """
    source = excitation.source or "log"
    low_hz, high_hz = band_hz
    band = response.band(low_hz, high_hz)
    count = int(band.sum())
    if count < 3:
        raise ShortExcitationError(
            f"{source}: {response.joint} has a response at {count} frequencies between "
            f"{low_hz:g} and {high_hz:g} Hz; a comparison needs 3 or more, so sweep longer or "
            "higher."
        )
    excited_count = int(excited.sum())
    if response.estimator == "H1" and excited_count < FEWEST_EXCITED:
        sines = single_sines(excitation)
        if not sines and response.segment_s < LONGEST_SEGMENT_S and excited_count > 0:
            raise ShortExcitationError(
                f"{source}: the response of {response.joint} shows {excited_count} of the "
                f"frequencies that its command excites, for it has segments of "
                f"{response.segment_s:g} s; a comparison needs {FEWEST_EXCITED} or more, so sweep "
                "longer."
            )
        velocity = velocity_column(excitation.log, response.joint)
        velocity_words = ""
        if velocity is not None and not velocity.usable:
            velocity_words = f" Note: {velocity.note(response.joint)}."
        raise IdentifiabilityError(
            f"{source}: {few_frequencies(excitation, excited_count, count, band_hz)}; sweep the "
            f"band, as `pronk sweep` does.{velocity_words}"
        )
    largest_gain = np.abs(response.response[band]).max()
    if not largest_gain > 1e-3:
        raise IdentifiabilityError(
            f"{source}: {response.joint} did not move (largest gain {largest_gain:.1e} between "
            f"{low_hz:g} and {high_hz:g} Hz); check that its drive is on, that the column is "
            "the right one, and that command and position are of one unit."
        )
    coherent = excited & response.band(low_hz, high_hz, coherence_min)
    if 2 * int(coherent.sum()) < excited_count:
        raise IdentifiabilityError(
            f"{source}: {response.joint} is coherent (at least {coherence_min:g}) at only "
            f"{int(coherent.sum())} of the {excited_count} frequencies that the command excites "
            f"between {low_hz:g} and {high_hz:g} Hz; repeat the sweep with a larger amplitude, a "
            "stiffer base or more repeats."
        )
    return coherent


def few_frequencies(
    excitation: Excitation, excited_count: int, count: int, band_hz: tuple[float, float]
) -> str:
    """Say which frequencies a command excites alone.

    Args:
        excitation: The excitation.
        excited_count: Number of frequencies in the band that it excites.
        count: Number of frequencies in the band.
        band_hz: The joint's band [Hz].
    """
    sines = single_sines(excitation)
    if sines:
        frequencies = f"{', '.join(f'{sine_hz:.2g}' for sine_hz in sines)} Hz"
        motion = slow_motion(excitation)
    else:
        hz, power = _command_power(excitation)
        loud = hz[power >= EXCITED_POWER * power.max()]
        frequencies = f"{loud[0]:.2g} to {loud[-1]:.2g} Hz"
        motion = ""
    return (
        f"the command of {excitation.joint} excites only {frequencies} ({excited_count} of {count} "
        f"frequencies between {band_hz[0]:g} and {band_hz[1]:g} Hz{motion})"
    )


def single_sines(excitation: Excitation) -> list[float]:
    """Return the frequencies of a command of up to `MOST_SINES` sines [Hz]; empty for others."""
    hz, power = _command_power(excitation)
    loud = np.flatnonzero(power >= EXCITED_POWER * power.max())
    sines = np.split(loud, np.flatnonzero(np.diff(loud) > 2) + 1)
    if len(sines) > MOST_SINES or max(len(sine) for sine in sines) > _BINS_OF_A_SINE:
        return []
    return [float(np.average(hz[sine], weights=power[sine])) for sine in sines]


def slow_motion(excitation: Excitation) -> str:
    """Say how a position differs from a command of few frequencies, to be put behind them.

    Empty where the position follows to a tenth.
    """
    time = excitation.time
    hz, power = _command_power(excitation)
    omega = 2.0 * np.pi * hz[int(np.argmax(power))]
    columns = np.stack([np.ones(len(time)), np.cos(omega * time), np.sin(omega * time)], axis=1)
    pair = np.stack([excitation.command, excitation.position], axis=1)
    offset, cosine, sine = np.linalg.lstsq(columns, pair, rcond=None)[0]
    gain = float(np.hypot(cosine[1], sine[1]) / np.hypot(cosine[0], sine[0]))
    difference = float(offset[1] - offset[0])
    amplitude = float(np.hypot(cosine[0], sine[0]))
    if abs(gain - 1.0) < _FOLLOWS and abs(difference) < _FOLLOWS * amplitude:
        return ""
    return (
        f"; there the position is {gain:.2f} times the command, and its mean {difference:+.2g} rad "
        "off that of the command"
    )


def _command_power(excitation: Excitation) -> tuple[Array, Array]:
    """Return frequencies above 0 [Hz] and the power of a command at them, shapes (f,)."""
    time = excitation.time
    grid = np.linspace(time[0], time[-1], len(time))
    held = np.interp(grid, time, excitation.command)
    window = np.hanning(len(grid))
    power = np.abs(np.fft.rfft((held - np.average(held, weights=window)) * window)) ** 2
    hz = np.fft.rfftfreq(len(grid), float(grid[1] - grid[0]))
    inside = (hz > 0.0) & (hz <= _HIGHEST_HZ)
    return np.asarray(hz[inside]), np.asarray(power[inside])


def simulated_response(
    rigs: JointRigs, target: MeasuredJoint, values: Mapping[str, float]
) -> ComplexArray:
    """Simulate the command of a measured response and estimate the response of the simulation.

    Args:
        rigs: Joints in the simulator.
        target: The measured response.
        values: Parameters of the drive by name. Those that the simulator cannot set are left as
            the simulator has them; the `delay` [s] turns the phase.

    Returns:
        Response at all frequencies of the measured one, shape (f,); NaN where it diverged.
    """
    names = set(rigs.parameters)
    if rigs.sets_effort_limit:
        names.add("effort_limit")
    settable = {}
    for name, value in values.items():
        if name in names and name != "delay":
            settable[name] = np.array([value])
    response = np.full(len(target.measured.omega), np.nan, dtype=np.complex128)
    for _, position in rigs.run([target.trace], settable, len(target.trace.command)):
        response = target.full_response(position[0])
    delay_s = values.get("delay", 0.0)
    return np.asarray(response * np.exp(-1j * target.measured.omega * delay_s))


def grouped(items: Sequence[T], same: Callable[[T, T], bool]) -> list[list[T]]:
    """Gather items that are the same as the first item of a group."""
    groups: list[list[T]] = []
    for item in items:
        for group in groups:
            if same(group[0], item):
                group.append(item)
                break
        else:
            groups.append([item])
    return groups
