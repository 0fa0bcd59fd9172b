"""What a simulation is held against: a measured response and the way to it from positions.

With the command given, the H1 estimate is linear in the position, `response = position @ matrix`,
so the simulated positions of a whole grid become responses in one product, through the very
windows and segments that the log went through.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Literal

import numpy as np

from pronk.arrays import Array, ComplexArray, Mask
from pronk.errors import IdentifiabilityError, LogError, PronkError
from pronk.identify.logs.joint_log import JointLog, group_repeats
from pronk.identify.match.settings import MatchSettings
from pronk.identify.response.estimate import (
    estimate,
    log_rate,
    operator,
)
from pronk.identify.response.h1 import H1Operator
from pronk.identify.response.response import FrequencyResponse
from pronk.identify.simulators.command_trace import CommandTrace, command_trace
from pronk.robots.robot import RobotSpec

Pair = tuple[float, float]
"""Stiffness [N m/rad] and damping [N m s/rad]."""

_SAME_GAINS = 0.01
"""Relative difference of gains by the log and by the user that is rounding."""
DB = 20.0 / np.log(10.0)
"""Decibels per neper: `20 log10(gain) = DB * log(gain)`."""
FLOOR_DB = 0.1
"""Smallest deviation used of a measured gain [dB]. Coherence near 1 would otherwise let a few
frequencies outvote the band, though the model itself is not better than this."""
_TAIL = 2e-4
"""Absolute error of gain that leaving out the end of the log would cause in a joint that follows
its command: 0.002 dB at gain 1. Over the paper's grid it was 0.001 dB; nodes differ by 0.02 dB."""


def rms(values: Array | ComplexArray) -> float:
    """Root mean square of magnitudes."""
    return float(np.sqrt(np.mean(np.abs(values) ** 2)))


@dataclass(frozen=True, kw_only=True)
class MeasuredJoint:
    """A joint's measured response at one amplitude, ready to be compared with simulations."""

    trace: CommandTrace
    sign: float
    """Between this joint's coordinate and that of the joint simulated in its place."""
    measured: FrequencyResponse
    operator: Callable[[], H1Operator]
    """The way from positions to the response; computed once."""
    command: Callable[[RobotSpec], CommandTrace]
    """The `trace` for the step and decimation of a robot."""
    fit_mask: Mask
    """Frequencies that the fit looks at: in the band, coherent enough, shape (f,)."""
    warnings: tuple[str, ...] = ()
    """What could not be used beside it."""

    @property
    def joint(self) -> str:
        """The excited joint."""
        return self.trace.joint

    @property
    def omega(self) -> Array:
        """Angular frequencies of the fit [rad/s], shape (inside,)."""
        return self.measured.omega[self.fit_mask]

    def on(self, robot: RobotSpec) -> MeasuredJoint:
        """Return the same, to be compared with simulations at another step or decimation."""
        return replace(self, trace=self.command(robot))

    @cached_property
    def fit_matrix(self) -> Array:
        """From position about the pose at each step to the response, shape (steps, 2 inside).

        Real and imaginary columns side by side: one real product is faster than one of complex
        numbers. A chirp leaves the band long before it ends: the rows end where all remaining
        positions together move no gain by `_TAIL`, judged by a joint that follows its command
        perfectly, so later steps need not be simulated.
        """
        chosen = self.operator().matrix(self.trace.time, self.fit_mask)
        command = self.trace.command - self.trace.command[0]
        tail = np.abs(np.cumsum((chosen * command[:, None])[::-1], axis=0)[::-1]).max(axis=1)
        loud = np.nonzero(tail > _TAIL)[0]
        chosen = chosen[: int(loud[-1]) + 2] if len(loud) else chosen
        return np.hstack([chosen.real, chosen.imag])

    @property
    def steps(self) -> int:
        """Steps that the fit needs."""
        return len(self.fit_matrix)

    def fit_response(self, position: Array) -> ComplexArray:
        """Response at the frequencies inside, in this joint's coordinate, shape (..., inside).

        `position` is that of the joint simulated [rad], shape (..., at least `steps`).
        """
        # The mean is removed; without it nothing is cut off where the steps end at rest.
        moved = position[..., : self.steps] - position[..., :1]
        pair = moved @ self.fit_matrix
        half = pair.shape[-1] // 2
        return np.asarray(self.sign * (pair[..., :half] + 1j * pair[..., half:]))

    def full_response(self, position: Array) -> ComplexArray:
        """Response at all frequencies, shape (f,), of positions of shape (all steps,)."""
        time = self.trace.time
        return np.asarray(self.sign * self.operator().response(time, position[: len(time)]))

    def deviation_db(self) -> Array:
        """Standard deviation of the measured gain from its coherence [dB], shape (inside,)."""
        return np.asarray(np.hypot(DB * self.measured.deviation()[self.fit_mask], FLOOR_DB))

    def error_db(self, simulated: ComplexArray) -> Array:
        """Gain over the measured one [dB] of a simulated response, both of shape (..., inside)."""
        measured = np.abs(self.measured.response[self.fit_mask])
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(DB * (np.log(np.abs(simulated)) - np.log(measured)))

    def rms_db(self, simulated: ComplexArray) -> float:
        """Root mean square of `error_db`, frequencies counting alike [dB]."""
        return rms(self.error_db(simulated))

    def measurement_error_db(self) -> float:
        """Root mean square half-width of the measured gain's own 95 % interval in the band [dB]."""
        relative = self.measured.relative_error(0.95)[self.fit_mask]
        return float(DB * np.sqrt(np.mean(relative**2)))


def logs_by_joint(logs: Sequence[JointLog], robot: RobotSpec) -> dict[str, list[JointLog]]:
    """Logs that excite each joint, joints in the robot's order; LogError if none does."""
    where: dict[str, list[JointLog]] = {}
    for log in logs:
        for name in log.excited_joints:
            where.setdefault(name, []).append(log)
    for name in where:
        robot.joint(name)
    if not where:
        fit = any(log.torque is not None for log in logs)
        raise LogError(
            f"{len(logs)} logs excite no joint by a commanded position; expected some of "
            f"{', '.join(robot.joint_names)}"
            + ("; --mode drive fits drives to torques." if fit else ".")
        )
    return {name: where[name] for name in robot.joint_names if name in where}


DriveGains = Mapping[str, Pair] | Literal["default"]
"""Gains on the real drives, by joint or joint group, or `default`: those of the robot's file."""


def gains_by_joint(robot: RobotSpec, given: DriveGains) -> dict[str, Pair]:
    """Gains by joint from those by joint or group; PronkError if a name is neither."""
    if given == "default":
        return {joint.name: (joint.stiffness, joint.damping) for joint in robot.joints}
    by_joint: dict[str, Pair] = {}
    for name, pair in given.items():
        if name not in (*robot.joint_names, *robot.groups):
            raise PronkError(
                f"drive gains of {name!r}; expected a joint ({', '.join(robot.joint_names)}) or a "
                f"joint group ({', '.join(robot.groups)})."
            )
        members = robot.group(name) if name in robot.groups else (robot.joint(name),)
        by_joint |= {joint.name: pair for joint in members}
    return by_joint


def with_drive_gains(
    logs: Sequence[JointLog], robot: RobotSpec, given: DriveGains | None = None
) -> list[JointLog]:
    """Logs with segments and the gains that were on the real drives: their own, or the given ones.

    LogError if a log has no gains and none are given for a joint of it, or they contradict it.
    """
    by_joint = {} if given is None or given == "default" else gains_by_joint(robot, given)
    out = []
    for log in logs:
        log = log.segmented()
        where, moved, pairs = log.source or "log", log.excited_joints, []
        for column, name in enumerate(log.joints):
            own: Pair | None = None
            if log.stiffness is not None and log.damping is not None:
                own = float(log.stiffness[column]), float(log.damping[column])
            stated = by_joint.get(name, own)
            if own and stated and not np.allclose(own, stated, rtol=_SAME_GAINS):
                raise LogError(
                    f"{where}: {name} was recorded at {own[0]:g} N m/rad and {own[1]:g} N m s/rad "
                    f"by the log, at {stated[0]:g} and {stated[1]:g} by --drive-gains; leave the "
                    "option out, or correct the log."
                )
            if stated is None and name in moved and given != "default":
                raise LogError(
                    f"{where}: the gains that were on the drive of {name} are not in the log; give "
                    "--drive-gains JOINT_OR_GROUP=STIFFNESS,DAMPING, or --drive-gains default if "
                    "they were those of the robot's file."
                )
            if stated is None and name in robot.joint_names:
                stated = robot.joint(name).stiffness, robot.joint(name).damping
            pairs.append(stated or (0.0, 0.0))
        stiffness, damping = np.array(pairs).T
        out.append(replace(log, stiffness=stiffness, damping=damping))
    return out


def gains_on_drive(log: JointLog, joint: str, robot: RobotSpec) -> tuple[float, float]:
    """Stiffness and damping on the real drive: the log's if it has them, else the robot's."""
    known, column = robot.joint(joint), log.column(joint)
    return (
        known.stiffness if log.stiffness is None else float(log.stiffness[column]),
        known.damping if log.damping is None else float(log.damping[column]),
    )


def measured_joints(
    log: JointLog, joint: str, robot: RobotSpec, settings: MatchSettings
) -> list[MeasuredJoint]:
    """Estimate a joint's responses and prepare each for comparison, largest amplitude first.

    Sine steps are left out: they are read step by step and have no single matrix. LogError if the
    joint was not excited or did not move, or its unit is unknown; IdentifiabilityError if too
    little of the band is coherent at the largest amplitude.
    """
    where = log.source or "log"
    chosen = tuple(one for one in log.segmented().segments if one.kind != "sine_steps")
    if not any(joint in segment.joints for segment in chosen):
        raise LogError(
            f"{where}: {joint} was excited by sine steps only; match a chirp or a multisine, and "
            "keep the steps to check it."
        )
    log = replace(log, segments=chosen)
    known, excitations = robot.joint(joint), log.excitations(joint)
    rate_hz = log_rate(excitations)
    found: list[MeasuredJoint] = []
    warnings: list[str] = []
    groups = group_repeats(excitations)
    for (part, *_), response in zip(groups, estimate(log, joint, settings.estimator), strict=True):
        # Of several repeats any one, their commands being the same.
        command = partial(command_trace, part)
        try:
            inside = _inside(response, known.band_hz, settings.coherence_min, where)
        except IdentifiabilityError as error:
            # The largest amplitude must be usable; a smaller one only checks it.
            if not found:
                raise
            warnings.append(f"the response at {response.amplitude:.3g} rad is left out: {error}")
            continue
        found.append(
            MeasuredJoint(
                trace=command(robot),
                sign=known.original[1],
                measured=response,
                operator=cache(partial(operator, part, settings.estimator, rate_hz)),
                command=command,
                fit_mask=inside,
            )
        )
    found[0] = replace(found[0], warnings=tuple(warnings))
    return found


def merged(found: Sequence[Sequence[MeasuredJoint]]) -> list[MeasuredJoint]:
    """Join repeats of the same excitation from several logs; one an amplitude, largest first.

    Each log counts by its repeats. LogError if one amplitude has different frequencies in several.
    """
    groups: dict[tuple[object, ...], list[MeasuredJoint]] = {}
    for goal in (goal for row in found for goal in row):
        measured = goal.measured
        key = (round(measured.amplitude, 4), measured.estimator, len(measured.omega))
        groups.setdefault(key, []).append(goal)
    out = []
    for first, *others in groups.values():
        if not others:
            out.append(first)
            continue
        each = [goal.measured for goal in (first, *others)]
        if not all(np.allclose(one.omega, first.measured.omega) for one in each):
            raise LogError(
                f"{first.joint} was excited at {first.measured.amplitude:.3g} rad in several logs "
                "whose responses have different frequencies; match them one at a time."
            )
        share = [len(one.repeats) for one in each]
        measured = replace(
            first.measured,
            response=np.average([one.response for one in each], axis=0, weights=share),
            coherence=np.average([one.coherence for one in each], axis=0, weights=share),
            averages=np.sum([one.averages for one in each], axis=0),
            repeats=np.concatenate([one.repeats for one in each]),
            source=", ".join(dict.fromkeys(one.source for one in each)),
        )
        # Only frequencies that are coherent in all logs.
        inside = np.logical_and.reduce([goal.fit_mask for goal in (first, *others)])
        warnings = dict.fromkeys(one for goal in (first, *others) for one in goal.warnings)
        out.append(replace(first, measured=measured, fit_mask=inside, warnings=tuple(warnings)))
    return sorted(out, key=lambda goal: -goal.measured.amplitude)


def _inside(
    measured: FrequencyResponse, band_hz: tuple[float, float], coherence_min: float, where: str
) -> Mask:
    """Coherent frequencies of the band; refuses a band that is mostly incoherent."""
    low, high = band_hz
    band = measured.band(low, high)
    if int(band.sum()) < 3:
        raise IdentifiabilityError(
            f"{where}: {measured.joint} has a response at {int(band.sum())} frequencies between "
            f"{low:g} and {high:g} Hz; a match needs 3 or more, so sweep longer or higher."
        )
    coherent = measured.band(low, high, coherence_min)
    moved = np.abs(measured.response[band]).max()
    if not moved > 1e-3:
        raise IdentifiabilityError(
            f"{where}: {measured.joint} did not move (largest gain {moved:.1e} between {low:g} and "
            f"{high:g} Hz); check that its drive is on and that the column is the right one."
        )
    if 2 * int(coherent.sum()) < int(band.sum()):
        raise IdentifiabilityError(
            f"{where}: {measured.joint} is coherent (at least {coherence_min:g}) at only "
            f"{int(coherent.sum())} of {int(band.sum())} frequencies between {low:g} and {high:g} "
            "Hz; repeat the sweep with a larger amplitude, a stiffer base or more repeats."
        )
    return coherent
