"""Wrong inputs that a fit alone would hide: flags on logs and models that contradict each other.

Four kinds of test, the most direct first. Each finding says what was seen, what it probably is and
the way out; where several causes look alike it names them all.

Log alone. The command is held at a known rate, the log's own frequency column changes with it, the
joint named by a segment is the one that moves, and the sample rate resolves the band.

Columns against each other. Velocity is `i omega` times position, and a drive computes

    torque = exp(-i omega lag) [stiffness (exp(-i omega delay) command - position)
                                - damping i omega position]

whatever the mechanics behind it. The torque column so gives the gains that were on the drive, and
shows a position or command column that was scaled, filtered or shifted in time.

Gravity. The mean torque of each joint against that of the model in the logged pose, which has the
other sign on the other side of the body, and the mean distance of the position from the command.

Response against the simulator. About the fitted parameters the logarithm of the measured response
differs from the simulated one by the simulator's own sensitivities (stiffness, damping, armature,
friction, delay), by a compliance between rotor and link, and by the signature of a wrong input: a
constant (encoder scale) or `omega^2` in the gain (a filter on the position; of the other sign on
the command). Each signature is fitted with all of the former, these with their prior ranges (a
score test), so that a soft belt or a light rotor is not taken for a filter.

Thresholds lie outside the range of the same statistic on logs of 154 virtual robots without error,
drawn at random as `python -m benchmarks wrong-inputs` draws them but with seed 1 (those of the fit
on the 58 of them whose friction is within a third of the model's); the range stands beside each.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from pronk.errors import LogError
from pronk.logs.joint_log import JointLog
from pronk.match.identifiability import bench_inertia
from pronk.match.measured_joint import DB, MeasuredJoint, gains_on_drive
from pronk.match.parameters import FREE, PARAMETERS
from pronk.match.result import JointFit
from pronk.match.simulated import SimRequest, responses
from pronk.response.estimate import estimate_parts, excitations, excited_joints, log_rate
from pronk.response.response import Estimator, FrequencyResponse
from pronk.robots.model import bench_spec
from pronk.robots.robot import RobotSpec
from pronk.simulators.simulator import JointRigs

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

CAUSES: Mapping[str, tuple[str, str]] = {
    "drive gains": (
        "the drive had other gains than stated",
        "state the gains that were on the drive while this log was recorded",
    ),
    "torque constant": (
        "the motor's torque constant is not the drive's",
        "log the drive's torque, which distinguishes the two",
    ),
    "torque column": ("the torque column has another scale", "give its unit and side of the gear"),
    "other leg": ("the columns are another joint's", "give the order of the file's joints"),
    "other side": (
        "the columns are those of the other side of the body, or have the other sign",
        "give the order of the file's joints and the signs of their axes",
    ),
    "sign": ("a sign is flipped", "negate the position or the command when reading"),
    "degrees": ("degrees are read as radians", "read the log with unit deg"),
    "encoder scale": ("the position has a wrong scale", "give the reader the scale of the encoder"),
    "encoder offset": ("the encoder has an offset", "zero the encoder"),
    "time": ("the timestamps run at a wrong rate", "check the clock and the unit of the time"),
    "command rate": (
        "the command was sent at another rate than the robot's policy rate",
        "state the rate of the commands in the log or the robot's file",
    ),
    "sample rate": ("the log is too slow for the band", "log faster, or lower the joint's band"),
    "position filter": ("the position was filtered or delayed", "log the encoder unfiltered"),
    "command filter": ("the command was filtered or interpolated", "log the command as sent"),
    "command delay": ("the command column is already delayed", "log the command when it is sent"),
    "velocity column": ("the velocity column has another scale", "give its unit"),
    "friction": (
        "the model's dry friction is wrong",
        "set `frictionloss` in robot.yaml; the gains hold with the fitted one",
    ),
    "dead joint": ("the drive was off or the encoder stuck", "repair it and record again"),
}
"""Cause: what it is, and the way out."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One contradiction between a log and what it is said to be."""

    causes: tuple[str, ...]
    """Keys of `CAUSES` that explain it alike."""
    seen: str
    """What was seen."""

    def __str__(self) -> str:
        """What was seen, what it probably is, and the way out."""
        what = ", or ".join(CAUSES[one][0] for one in self.causes)
        out = "; ".join(dict.fromkeys(CAUSES[one][1] for one in self.causes))
        return f"{self.seen}: {what}; {out}"


def _finding(seen: str, *causes: str) -> Finding:
    return Finding(causes=causes, seen=seen)


RATE_MIN = 6.0
"""Samples in a period at the top of the band, at least: 100 Hz for 15 Hz has 6.7, 50 Hz 3.3.
Matched gains of logs thinned to 100 Hz move by 1.7 % at most on nine of ten joints (on the tenth by
14 %, its delay held at 0), at 50 Hz by 20 % or more on five of ten."""
TICK_OFF = 2e-3
"""Relative difference of the command's period from the stated one. Crystals keep 1e-4."""
SHARP_MIN = 0.9
"""Length of the mean phase of the command's changes within a tick: 1 where it is held. Butterworth
filters of 10 to 60 Hz leave 0.08 to 0.77, linear interpolation 0.01."""
SMEARED_MIN = 0.05
"""The same of a command that is computed for every sample: 0.01 to 0.03 for chirps."""
SHIFT_SAMPLES = 0.75
"""Changes of the command after those of the frequency column; 0 in the logs of `pronk sweep`."""
STILL = 0.02
"""Travel of the position over that of the command in a second below which a joint stands."""
STILL_RAD = 0.15
"""Least travel of the command for that: dry friction may hold a joint against a smaller one, as it
does the elbow of an SO-101 at 0.08 rad."""
VELOCITY_SCALE = 0.04
"""Velocity over the change of the position, less 1: -0.002 to 0.019 for virtual robots, -0.034 to
-0.013 for the SO-101's own estimate of its speed."""
VELOCITY_EARLY_S = 1e-3
"""Velocity before the change of the position: -0.17 to -0.10 ms for virtual robots."""
LAW_RESIDUAL = 0.1
"""What the drive's law leaves of a torque that is that drive's: 0.004 to 0.017."""
LAW_GAINS = 0.12
"""Gains of the law over those on the drive, less 1: -0.085 to 0.049 and -0.041 to 0.023."""
LAW_SCALE = 0.02
"""Scale of the position in the law, less 1: -0.004 to 0.002."""
LAW_FILTER_S = 3e-3
"""Time constants of the position and of the command in the law: -4.2 to 0.7 and -1.2 to 0 ms."""
LAW_GAIN = 1.5
"""Residual of the law without a signature over that with it: 1.00 to 1.024."""
LAW_LEAD_S = 1e-3
"""Torque before the command, the true delay added: -1.6 to 0.86 ms."""
OFFSET_RAD = 0.02
"""Mean position from where gravity leaves it; encoders are off by 2 mrad."""
SIDE = -0.3
"""Mean torque over the model's: 0.6 to 1.5 where gravity has the sign of a side."""
FRICTION = (0.5, 2.0)
"""Fitted dry friction over the model's: fitted over true is 0.80 to 1.33 for virtual robots with
torque constants of 0.75 to 1.25 (n = 58), so that 0.6 to 1.77 passes for a model within a third."""
RESPONSE_SCALE = (-0.015, 0.03)
"""Scale by the response: 0.004 to 0.012 where the model's friction is right."""
RESPONSE_SQUARE = (-3e-5, 8e-5)
"""Squared time constant by the response [s^2]: -1.2e-5 to 4.1e-5."""
RESPONSE_LEAD_S = 5e-4
"""Lead of the position by the response: 0.0 to 0.1 ms where the simulator itself made the log.
Virtual robots without delay are 2.8 to 3.6 ms late, since its explicit steps are early."""
STIFFNESS = (0.62, 1.3)
"""Fitted stiffness over the drive's: 0.68 to 1.23 with torque constants of 0.75 to 1.25."""


def require_plausible(logs: Mapping[str, Sequence[JointLog]], robot: RobotSpec) -> None:
    """Refuse logs, by the joint that they excite, of which every number would be wrong.

    Raises:
        LogError: A sign is flipped, angles are in degrees, or another joint moved.
    """
    for joint, sources in logs.items():
        for log in sources:
            if log.unit(joint) != "rad":
                continue
            for one in (*_names(log, joint), *_gross(log, joint, robot)):
                raise LogError(f"{log.source or 'log'}: {joint}: {one}.")


def flags(
    logs: Sequence[JointLog],
    fit: JointFit,
    robot: RobotSpec,
    *,
    rigs: JointRigs | None = None,
    goals: Sequence[MeasuredJoint] = (),
) -> tuple[str, ...]:
    """What is implausible in logs of a fitted joint that `require_plausible` let pass."""
    sources = [log for log in logs if fit.joint in excited_joints(log)]
    found = findings(sources, fit.joint, robot, fit=fit, rigs=rigs, goals=goals)
    return tuple(str(one) for one in found)


def findings(
    logs: Sequence[JointLog],
    joint: str,
    robot: RobotSpec,
    *,
    fit: JointFit | None = None,
    rigs: JointRigs | None = None,
    goals: Sequence[MeasuredJoint] = (),
) -> list[Finding]:
    """Contradictions between the logs of a joint, the robot's model and fitted parameters.

    `require_plausible` has let the logs pass.

    Args:
        logs: Logs that excite the joint.
        joint: Its name.
        robot: The robot.
        fit: How it was matched; its dry friction is compared with the model's.
        rigs: The simulator that it was matched in; without it, or if it cannot set friction and
            armature, the response is not tested.
        goals: Responses of the joint, largest amplitude first, for that test.
    """
    found: list[Finding] = []
    settled = True
    for log in logs:
        if dead := list(_dead(log, joint, robot)):
            found += dead
            continue  # what remains would repeat it in other words
        found += [*_clock(log, joint, robot), *_rate(log, joint, robot)]
        columns, valid = _columns(log, joint, robot)
        found += columns
        settled = settled and valid
        found += _gravity(log, joint, robot)
    wrong = {cause for one in found for cause in one.causes}
    if rigs is not None and goals and wrong <= {"drive gains", "torque column"}:
        on_drive = gains_on_drive(logs[0], joint, robot)
        values: Mapping[str, float] = {name: getattr(fit, name, np.nan) for name in FREE}
        known = bool(np.isfinite(values["frictionloss"]))
        if set(FREE) <= set(rigs.parameters) and not (settled and known):
            test = response_test(rigs, goals, on_drive, values)
            if test is not None and not known:
                values, known = test.values, True
            if test is not None and not settled:
                found += _response(test, values["stiffness"] / on_drive[0])
        if known:
            found += _friction(values["frictionloss"], robot.joint(joint).drive.frictionloss)
    return list({one.causes: one for one in reversed(found)}.values())[::-1]


def _friction(dry: float, model: float) -> Iterator[Finding]:
    """Dry friction of the responses against the model's [N m]."""
    if not FRICTION[0] <= dry / max(model, 1e-3) <= FRICTION[1]:
        yield _finding(
            f"friction: {dry:.2g} N m of dry friction fit where the model has {model:.2g}",
            "friction",
        )


def _names(log: JointLog, joint: str) -> Iterator[Finding]:
    """Whether the named joint is the one that was excited."""
    stated = log.metadata.get("excited", joint)
    if stated != joint:
        yield _finding(f"the log says that {stated} was excited, its columns {joint}", "other leg")
    column = log.column(joint)
    for part in _parts(log, joint):
        travel = np.ptp(part.position, axis=0)
        commanded = np.ptp(part.command, axis=0)
        for i, name in enumerate(part.joints):
            if i == column or commanded[i] > 0.0 or log.unit(name) != "rad":
                continue
            if travel[i] > 0.5 * commanded[column] and travel[i] > 2.0 * travel[column]:
                yield _finding(
                    f"{name} moved by {travel[i]:.2g} rad while {joint} was commanded", "other leg"
                )
                return


def _parts(log: JointLog, joint: str) -> list[JointLog]:
    """Every excitation of a joint, one log each."""
    return [part for group in excitations(log, joint) for part in group]


def _gross(log: JointLog, joint: str, robot: RobotSpec) -> Iterator[Finding]:
    """Sign and unit: phase and gain at low frequency, and the range of the joint."""
    low, high = robot.joint(joint).range
    command = log.command[:, log.column(joint)]
    least, most = float(command.min()), float(command.max())
    degree = np.pi / 180.0
    inside = low <= degree * least and degree * most <= high
    if (least < low - 1.0 or most > high + 1.0) and inside:
        yield _finding(
            f"the command goes from {least:.3g} to {most:.3g}, the joint from {low:.3g} to "
            f"{high:.3g} rad",
            "degrees",
        )
        return
    slow = _slow(
        _responses(log, joint, robot, "position"), min(1.0, 0.2 * robot.joint(joint).band_hz[1])
    )
    if not len(slow):
        return
    gain = float(np.median(np.abs(slow)))
    if 0.5 < gain * degree < 2.0 or 0.5 < gain / degree < 2.0:
        yield _finding(f"at low frequency the position is {gain:.3g} times the command", "degrees")
    elif (slow / np.abs(slow)).mean().real < -0.7:
        yield _finding("at low frequency the position moves against the command", "sign")


_SLOW = 6
_LOW_HZ = 0.25
"""Below it a chirp of 20 s is in its ramp."""


def _responses(
    log: JointLog, joint: str, robot: RobotSpec, channel: str
) -> list[FrequencyResponse]:
    """Response of a column to the command, one an amplitude, largest first."""
    groups = excitations(log, joint)
    rate = log_rate(groups)
    top = max(1.5 * robot.joint(joint).band_hz[1], 2.0 * _LOW_HZ)
    found = []
    for parts in groups:
        moved = [replace(part, position=getattr(part, channel)) for part in parts]
        if moved[0].segments[0].kind != "sine_steps":
            try:
                found.append(estimate_parts(moved, joint, Estimator(max_hz=min(top, 20.0)), rate))
            except LogError:
                continue  # too short for the estimator
    return found


def _slow(responses: Sequence[FrequencyResponse], top_hz: float) -> ComplexArray:
    """Response at the lowest coherent frequencies, up to one that any joint follows."""
    if not responses:
        return np.empty(0, dtype=np.complex128)
    first = responses[0]
    return np.asarray(first.response[first.band(_LOW_HZ, top_hz, 0.8)][:_SLOW])


def _dead(log: JointLog, joint: str, robot: RobotSpec) -> Iterator[Finding]:
    """A joint that stands still for a second or more while its command moves.

    Inside the band it moves by no more than `STILL`; above it the reading does not change at all.
    """
    column, top = log.column(joint), robot.joint(joint).band_hz[1]
    for part in _parts(log, joint):
        whole = float(np.ptp(part.command[:, column]))
        edges = np.searchsorted(part.time, np.arange(part.time[0], part.time[-1], 1.0))
        for first, stop in pairwise(edges):
            command = part.command[first:stop, column]
            commanded = float(np.ptp(command))
            if stop - first < 4 or commanded < max(0.5 * whole, STILL_RAD):
                continue
            crossings = np.count_nonzero(np.diff(np.sign(command - command.mean())))
            travel = float(np.ptp(part.position[first:stop, column]))
            if travel == 0.0 or (crossings <= 2.0 * top and travel < STILL * commanded):
                yield _finding(
                    f"{joint} stands still at {part.time[first]:.1f} s while its command moves",
                    "dead joint",
                )
                return


def _rate(log: JointLog, joint: str, robot: RobotSpec) -> Iterator[Finding]:
    """Whether the samples resolve the band."""
    top = robot.joint(joint).band_hz[1]
    if log.rate_hz < RATE_MIN * top:
        yield _finding(
            f"{log.rate_hz:.3g} samples a second are {log.rate_hz / top:.2g} a period at {top:g} "
            f"Hz, fewer than {RATE_MIN:g}",
            "sample rate",
        )


def _clock(log: JointLog, joint: str, robot: RobotSpec) -> Iterator[Finding]:
    """Instants at which the command changes, against its rate and the frequency column."""
    stated = log.metadata.get("command_rate_hz")
    tick = 1.0 / (float(stated) if stated else robot.policy_rate_hz)
    if log.rate_hz * tick < 3.0:
        return
    column = log.column(joint)
    periods, sharpness, shifts = [], [], []
    for part in _parts(log, joint):
        size = np.abs(np.diff(part.command[:, column]))
        instants = part.time[1:]
        period, sharp = _beat(instants, size, tick)
        periods.append(period)
        sharpness.append(sharp)
        if part.frequency is not None:
            changes = (np.diff(np.nan_to_num(part.frequency)) != 0.0).astype(np.float64)
            turns = np.exp(2j * np.pi * instants / period)
            late = np.angle((size @ turns) * np.conj(changes @ turns))
            shifts.append(float(late) / (2.0 * np.pi) * period)
    period, sharp = float(np.median(periods)), float(np.median(sharpness))
    off = abs(period / tick - 1.0)
    if sharp < SMEARED_MIN and not stated:
        return  # a command that changes with every sample
    if off > TICK_OFF and sharp > SHARP_MIN:
        yield _finding(
            f"the command changes every {1e3 * period:.2f} ms instead of {1e3 * tick:.2f}, "
            f"{period / tick:.4f} times",
            *(("time",) if stated else ("time", "command rate")),
        )
    elif sharp < SHARP_MIN and (stated or off < TICK_OFF):
        yield _finding(
            f"the command changes all the time instead of once in {1e3 * tick:.1f} ms",
            "command filter",
        )
        return
    if shifts and abs(shift := float(np.median(shifts))) > SHIFT_SAMPLES / log.rate_hz:
        yield _finding(
            f"the command changes {1e3 * shift:.1f} ms after the log's frequency column",
            "command delay",
        )


def _beat(instants: Array, size: Array, tick: float) -> tuple[float, float]:
    """Period near `tick` [s] at which changes of some sizes recur, and how sharply (0 to 1)."""
    span = float(instants[-1] - instants[0])
    rate = (len(instants) - 1) / span
    length = 4 * len(size)
    spectrum = np.abs(np.fft.rfft(size, length))
    hz = np.fft.rfftfreq(length, 1.0 / rate)
    near = np.flatnonzero((hz > 0.75 / tick) & (hz < 1.33 / tick))
    coarse = hz[near[np.argmax(spectrum[near])]]
    # The timestamps themselves, about the peak: a tenth of the resolution of the excitation.
    fine = coarse + np.linspace(-0.5, 0.5, 21) / span
    lengths = np.abs(np.exp(2j * np.pi * np.outer(fine, instants)) @ size)
    best = int(np.argmax(lengths))
    return 1.0 / float(fine[best]), float(lengths[best] / size.sum())


def _columns(log: JointLog, joint: str, robot: RobotSpec) -> tuple[list[Finding], bool]:
    """Compare velocity and torque with position and command.

    Also returns whether the torque follows the drive's law, which then settles scale and filters.
    """
    positions = _responses(log, joint, robot, "position")
    if not positions:
        return [], False
    found: list[Finding] = []
    column = log.column(joint)
    if log.velocity is not None and np.ptp(log.velocity[:, column]) > 0.0:
        found += _velocity(positions[0], _responses(log, joint, robot, "velocity")[0])
    if log.torque is None or np.ptp(log.torque[:, column]) == 0.0:
        return found, False
    stated = gains_on_drive(log, joint, robot)
    law = torque_law(positions, _responses(log, joint, robot, "torque"), stated)
    if law.valid:
        found += _law_findings(law, stated, log.stiffness is not None)
    return found, law.valid


def velocity_ratio(position: FrequencyResponse, velocity: FrequencyResponse) -> tuple[float, float]:
    """Velocity over `i omega` position: gain at low frequency, and time by which it is early [s].

    NaN where too few frequencies are coherent in both.
    """
    use = position.band(_LOW_HZ, np.inf, 0.9) & velocity.band(_LOW_HZ, np.inf, 0.9)
    if int(use.sum()) < 2 * _SLOW:
        return float("nan"), float("nan")
    omega = position.omega[use]
    ratio = velocity.response[use] / (1j * omega * position.response[use])
    if not np.abs(ratio).all():
        return float("nan"), float("nan")
    sign = float(np.sign(np.median(ratio[: 2 * _SLOW].real)))
    phase = np.unwrap(np.angle(ratio * sign))
    # A difference quotient and a filter act as 1 - a omega^2 on the gain, from 1 at standstill.
    slow = omega <= max(2.0 * np.pi * 5.0, omega[2 * _SLOW - 1])
    slope = np.stack([np.ones(int(slow.sum())), omega[slow] ** 2], axis=1)
    fit = np.linalg.lstsq(slope, np.log(np.abs(ratio[slow])), rcond=None)[0]
    return sign * float(np.exp(fit[0])), float(omega @ phase / (omega @ omega))


def _velocity(position: FrequencyResponse, velocity: FrequencyResponse) -> Iterator[Finding]:
    gain, early = velocity_ratio(position, velocity)
    if gain < 0.0:
        yield _finding("the velocity has the other sign than the change of the position", "sign")
    elif abs(gain - 1.0) > VELOCITY_SCALE:
        causes = ("encoder scale", "time", "velocity column")
        degrees = not 0.1 < gain < 10.0
        yield _finding(
            f"the velocity is {gain:.3f} times the change of the position",
            *(("degrees",) if degrees else causes),
        )
    if early > VELOCITY_EARLY_S:
        yield _finding(
            f"the position is {1e3 * early:.1f} ms later than the velocity", "position filter"
        )


@dataclass(frozen=True, kw_only=True)
class TorqueLaw:
    """The drive's law, fitted to the torque column."""

    stiffness: float
    """[N m/rad]"""
    damping: float
    """[N m s/rad]"""
    delay: float
    """Of the command in the torque [s]."""
    residual: float
    """Root mean square of what it leaves, over that of the torque [1]."""
    wrong: Mapping[str, tuple[float, float]]
    """Signature of a wrong input to its size and to the residual without it over that with it.

    `encoder scale` [1], `position filter` and `command filter`, first-order time constants [s].
    """

    @property
    def valid(self) -> bool:
        """True if the torque column is that of this law."""
        return self.residual < LAW_RESIDUAL and self.stiffness > 0.0


def torque_law(
    positions: Sequence[FrequencyResponse],
    torques: Sequence[FrequencyResponse],
    stated: tuple[float, float],
) -> TorqueLaw:
    """Fit the law of a drive to responses of position and torque, alike in amplitude.

    `stated` gains (stiffness, damping) are where the search begins.
    """
    omega, position, torque = [], [], []
    for one, other in zip(positions, torques, strict=True):
        use = one.band(_LOW_HZ, np.inf, 0.8) & other.band(_LOW_HZ, np.inf, 0.8)
        omega.append(one.omega[use])
        position.append(one.response[use])
        torque.append(other.response[use])
    s, q, t = 1j * np.concatenate(omega), np.concatenate(position), np.concatenate(torque)
    nothing = TorqueLaw(stiffness=np.nan, damping=np.nan, delay=np.nan, residual=np.inf, wrong={})
    if len(s) < 4 * _SLOW:
        return nothing

    def residual(x: Array, name: str = "") -> Array:
        stiffness, damping, delay, lag = x[:4]
        size = x[4] if name else 0.0
        read = q / (1.0 + size) if name == "encoder scale" else q
        read = read * (1.0 + s * size) if name == "position filter" else read
        sent = np.exp(-s * delay)
        sent = sent * (1.0 + s * size) if name == "command filter" else sent
        off = (stiffness * (sent - read) - damping * s * read) * np.exp(-s * lag) - t
        return np.concatenate([off.real, off.imag]) / stated[0]

    start = np.array([*stated, 0.005, 0.0005])
    scale = np.array([0.1 * stated[0], 0.1 * max(stated[1], 1e-3), 2e-3, 5e-4, 0.01])
    low, high = np.full(5, -np.inf), np.full(5, np.inf)
    # Sampling, averaging of the speed and the current loop of a drive.
    low[3], high[3] = 0.0, 2e-3

    def fit(begin: Array, name: str = "") -> tuple[Array, float]:
        n = len(begin)
        found = least_squares(
            residual, begin, x_scale=scale[:n], bounds=(low[:n], high[:n]), args=(name,)
        )
        return np.asarray(found.x), float(np.sqrt(2.0 * found.cost))

    best, left = fit(start)
    wrong, whole = {}, float(np.sqrt((np.abs(t) ** 2).sum())) / stated[0]
    signatures = ("encoder scale", "position filter", "command filter")
    fits = {name: fit(np.append(best, 0.0), name) for name in signatures}
    for name, (x, rest) in fits.items():
        wrong[name] = float(x[4]), left / rest
    top = max(fits, key=lambda name: wrong[name][1])
    if wrong[top][1] > LAW_GAIN:
        best, left = fits[top]
    return TorqueLaw(
        stiffness=float(best[0]),
        damping=float(best[1]),
        delay=float(best[2]),
        residual=left / whole,
        wrong=wrong,
    )


_LAW_LIMITS = {
    "encoder scale": LAW_SCALE,
    "position filter": LAW_FILTER_S,
    "command filter": LAW_FILTER_S,
}


def _law_findings(law: TorqueLaw, stated: tuple[float, float], logged: bool) -> Iterator[Finding]:
    name, (size, gain) = max(law.wrong.items(), key=lambda item: item[1][1])
    if gain > LAW_GAIN and (size if "filter" in name else abs(size)) > _LAW_LIMITS[name]:
        words = f"{1e3 * size:.1f} ms" if "filter" in name else f"{1.0 + size:.3f}"
        yield _finding(f"the torque is that of a drive with {name} {words}", name)
    ratios = law.stiffness / stated[0], law.damping / max(stated[1], 1e-9)
    if max(abs(ratio - 1.0) for ratio in ratios) > LAW_GAINS:
        alike = abs(ratios[0] / ratios[1] - 1.0) < LAW_GAINS
        whose = "stated in the log" if logged else "of the robot's file"
        yield _finding(
            f"the torque is that of a drive with {law.stiffness:.3g} / {law.damping:.3g} instead "
            f"of {stated[0]:.3g} / {stated[1]:.3g} {whose}",
            *(("drive gains", "torque column") if alike else ("drive gains",)),
        )
    if law.delay < -LAW_LEAD_S:
        yield _finding(
            f"the torque follows the command before it was given ({1e3 * law.delay:.1f} ms)",
            "command delay",
        )


def _gravity(log: JointLog, joint: str, robot: RobotSpec) -> Iterator[Finding]:
    """Mean torque of the joints of a limb, and where the excited one rests."""
    names = [name for name in log.joints if log.unit(name) == "rad" and name in robot.joint_names]
    root = max(names, key=lambda name: len(set(robot.joint(name).chain) & set(names)))
    parts = _parts(log, joint)
    mean = {
        name: tuple(
            float(np.mean([getattr(part, kind)[:, part.column(name)].mean() for part in parts]))
            for kind in ("command", "position")
        )
        for name in names
    }
    own = _holding_torques(robot, root, {name: q for name, (_, q) in mean.items()})
    for name in own:
        if name not in mean:
            continue
        known = robot.joint(name)
        stiffness, _ = gains_on_drive(log, name, robot)
        command, position = mean[name]
        torque = stiffness * (command - position)
        mirrored = any(
            other.original[0] == known.original[0] and other.original[1] == -known.original[1]
            for other in robot.joints
        )
        if mirrored and abs(own[name]) > 0.1 and torque / own[name] < SIDE:
            yield _finding(
                f"{name} is held by {torque:+.2f} N m, where the model needs {own[name]:+.2f}",
                "other side",
            )
        if name == joint:
            off = position - (command - own[name] / stiffness)
            if abs(off) > OFFSET_RAD:
                scale = position / (position - off)
                causes = ["encoder offset"]
                if abs(scale - 1.0) < 0.3:
                    causes.insert(0, "encoder scale")
                yield _finding(
                    f"{name} moves about {position:.3f} rad, where its command and gravity leave "
                    f"it at {position - off:.3f}",
                    *causes,
                )


def _holding_torques(robot: RobotSpec, root: str, at: Mapping[str, float]) -> dict[str, float]:
    """Torque that holds each joint of a chain at a position [N m]; default where one is missing."""
    model = bench_spec(robot, root).compile()
    data = mujoco.MjData(model)
    names = [model.joint(i).name for i in range(model.njnt)]
    data.qpos[:] = [at.get(name, robot.joint(name).default_position) for name in names]
    mujoco.mj_forward(model, data)
    return dict(zip(names, data.qfrc_bias.tolist(), strict=True))


@dataclass(frozen=True, kw_only=True)
class ResponseTest:
    """Parameters fitted to gain and phase at all amplitudes, and signatures of wrong inputs."""

    values: Mapping[str, float]
    """By name in `FREE`."""
    wrong: Mapping[str, tuple[float, float]]
    """`encoder scale` [1] and `filter` [s^2], the square of a time constant, positive on the
    position and negative on the command; each with its standard deviation."""


_PRIOR = {"stiffness": 0.2, "armature": 0.15}
"""Standard deviations of the logarithms about the stated gains and the robot's file."""
_RING_HZ = 100.0
"""Rotor and link ring at about it [Hz]; the compliance is known to its own size."""
_DELAY_S = 0.005
"""Where the search begins [s]."""
_TEST_ROUNDS = 6
_TEST_SETTLED = 0.02


def response_test(
    rigs: JointRigs,
    goals: Sequence[MeasuredJoint],
    on_drive: tuple[float, float],
    fitted: Mapping[str, float] | None = None,
) -> ResponseTest | None:
    """Fit the simulator to gain and phase, and one signature of a wrong input at a time.

    `on_drive` are the gains on the drive, `fitted` where to begin. None if a simulation diverges.
    """
    goals = goals[:2]
    robot, name = rigs.robot, goals[0].joint
    drive, kinds = robot.joint(name).drive, [PARAMETERS[one] for one in FREE]
    armature = max(drive.armature, PARAMETERS["armature"].low)
    known = dict(zip(FREE, (*on_drive, armature, drive.frictionloss, _DELAY_S), strict=True))
    given = {
        k: max(v, PARAMETERS[k].low)
        for k, v in (fitted or {}).items()
        if k in FREE and np.isfinite(v)
    }
    start = {k: max(v, PARAMETERS[k].start) for k, v in known.items()} | given
    low = np.array([kind.scaled(kind.low) for kind in kinds])
    high = np.array([kind.scaled(kind.high) for kind in kinds])
    # A command column that is late makes the position lead.
    low[FREE.index("delay")] = -high[FREE.index("delay")]
    x = np.clip([PARAMETERS[one].scaled(start[one]) for one in FREE], low, high)
    centre = [np.log(known[one]) if one in _PRIOR else 0.0 for one in FREE]
    prior = np.array([1.0 / _PRIOR.get(one, np.inf) for one in FREE])
    inertia, gravity = bench_inertia(robot, robot.joint(name).original[0])
    omega = np.concatenate([goal.omega for goal in goals])
    measured = np.concatenate([goal.measured.response[goal.fit_mask] for goal in goals])
    weight = DB / np.concatenate([goal.deviation_db() for goal in goals])
    compliance = 1.0 / (armature * (2.0 * np.pi * _RING_HZ) ** 2)

    def values_at(point: Array) -> dict[str, float]:
        return {
            one: kind.unscaled(float(number))
            for one, kind, number in zip(FREE, kinds, point, strict=True)
        }

    def rows(change: Any) -> Array:
        """Weighted change of gain and phase by a change of the log response, shape (2 f,)."""
        return np.concatenate([np.real(change) * weight, np.imag(change) * weight])

    def offs(points: Sequence[Array]) -> list[Array]:
        """Rows of the simulated over the measured response at some points."""
        requests = [SimRequest(goal, **values_at(point)) for point in points for goal in goals]
        tracks = responses(rigs, requests)
        found = []
        for k in range(0, len(requests), len(goals)):
            # What diverged or stands still is not finite and ends the test.
            with np.errstate(divide="ignore", invalid="ignore"):
                parts = [
                    np.log(one / goal.measured.response[goal.fit_mask])
                    for one, goal in zip(tracks[k : k + len(goals)], goals, strict=True)
                ]
            whole = np.concatenate([part.real + 1j * np.unwrap(part.imag) for part in parts])
            found.append(rows(whole))
        return found

    size, late = len(FREE), FREE.index("delay")
    simulated = [k for k in range(size) if k != late]  # a delay needs no simulation
    steps = np.diag([kind.step for kind in kinds])[simulated]
    for _ in range(_TEST_ROUNDS):
        residual, *moved = offs([x, *(x + steps)])
        if not np.isfinite([residual, *moved]).all():
            return None
        slopes = [(one - residual) / kinds[k].step for one, k in zip(moved, simulated, strict=True)]
        slopes.insert(late, rows(-1j * omega))
        values = values_at(x)
        link = gravity - (inertia - drive.armature) * omega**2
        closed = measured * np.exp(1j * omega * values["delay"]) / values["stiffness"]
        belt = rows(compliance * link**2 * closed)
        whole = np.vstack([np.column_stack([*slopes, belt]), np.diag(np.append(prior, 1.0))])
        right = np.concatenate([residual, prior * (x - centre), [-1.0]])
        step = np.clip(np.linalg.lstsq(whole, -right, rcond=None)[0][:size], -0.5, 0.5)
        x = np.clip(x + step, low, high)
        if np.abs(step[simulated]).max() < _TEST_SETTLED:
            break
    signatures: dict[str, Array] = {
        "encoder scale": -np.ones(len(omega)),
        "filter": 0.5 * omega**2,
    }
    wrong = {}
    for cause, signature in signatures.items():
        unit = 1e-4 if cause == "filter" else 1.0
        extra = np.concatenate([rows(unit * signature), np.zeros(size + 1)])
        both = np.column_stack([whole, extra])
        found = np.linalg.lstsq(both, -right, rcond=None)[0]
        deviation = np.sqrt(np.linalg.pinv(both.T @ both)[-1, -1])
        wrong[cause] = float(unit * found[-1]), float(unit * deviation)
    return ResponseTest(values=values_at(x), wrong=wrong)


def _response(test: ResponseTest, stiffness: float) -> Iterator[Finding]:
    """What the response says of scale, filters, delay and gains; a torque column says it better.

    `stiffness` is the fitted one over the drive's.
    """
    if (delay := test.values["delay"]) < -RESPONSE_LEAD_S:
        yield _finding(
            f"the position leads its command by {-1e3 * delay:.1f} ms",
            "command delay",
        )
        return
    (scale, _), (square, _) = test.wrong["encoder scale"], test.wrong["filter"]
    scales, squares = RESPONSE_SCALE, RESPONSE_SQUARE
    if not (scales[0] < scale < scales[1] and squares[0] < square < squares[1]):
        # Gain and phase of a drive with unknown inertia and belt do not tell them apart.
        yield _finding(
            f"no joint of the model responds so (scale {1.0 + scale:.3f}, squared time constant "
            f"{1e6 * square:.0f} ms^2)",
            *("position filter", "command filter", "encoder scale"),
        )
    if not STIFFNESS[0] <= stiffness <= STIFFNESS[1]:
        yield _finding(
            f"the stiffness is {stiffness:.2f} times that of the drive",
            *("drive gains", "torque constant"),
        )
