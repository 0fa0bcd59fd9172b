"""Wrong inputs that a fit alone would hide: flags on logs and models that contradict each other.

Four kinds of test, the most direct first. Each finding says what was seen, what it probably is and
the way out; where several causes look alike it names them all.

Log alone. The command is held at a known rate, the log's own frequency column changes with it, the
joint named by a segment is the one that moves, and the sample rate resolves the band.

Columns against each other. Velocity is `s = i omega` times position, and a drive computes

    torque = exp(-s lag) [stiffness (exp(-s delay) command - position) - damping s position]

whatever the mechanics behind it. The torque column so gives the gains that were on the drive, and
shows a position or command column that was scaled, filtered or shifted in time.

Gravity. The mean torque of each joint against that of the model in the logged pose, which has the
other sign on the other side of the body, and the mean distance of the position from the command.

Response against the simulator, without a torque column. About the optimum of the fit in time its
Jacobian also gives, to first order, what another armature, a compliance between rotor and link and
a wrong scale of the position would change. One least-squares step finds them. A filter on the
position passes for a light rotor behind a soft belt, one on the command for a negative compliance.

Without torque and frequency columns three errors leave no trace. Gains on the drive and a torque
constant act as one product, which is what a match finds: wrongly stated gains change no matched
number. A command column that is late by less than the joint's own delay leaves a smaller delay,
which is that behind the column. The same joint of another leg responds alike.

Thresholds lie outside the range of the same statistic on logs of 160 virtual robots without error,
drawn at random as `python -m benchmarks wrong-inputs` draws them but with seed 1 (those of the fit
on 40 of them); the range stands beside each.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from pronk.errors import LogError
from pronk.logs.joint_log import JointLog
from pronk.match.identifiability import bench_inertia
from pronk.match.measured_joint import gains_on_drive
from pronk.match.result import JointFit
from pronk.match.time_fit import TimeFit
from pronk.response.estimate import excitations, excited_joints
from pronk.robots.model import bench_spec
from pronk.robots.robot import RobotSpec

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


LOW_HZ = 0.25
"""Below it a chirp of 20 s is in its ramp."""
HIGHEST_HZ = 20.0
"""No test looks above it, nor above one and a half times the joint's band."""
COMMAND_POWER = 0.05
"""Magnitude of the command over its largest at which a frequency is looked at."""
COHERENCE = 0.8
"""Coherence from which on a response is looked at."""
GROUP = 5
"""Frequencies that are averaged over, 0.25 Hz in a chirp of 20 s."""
FEW = 12
"""Groups of frequencies below which columns are not compared."""
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
VELOCITY_SCALE = 0.043
"""Velocity over the change of the position, less 1: -0.004 to 0.003 for virtual robots, -0.032 to
0.040 for the SO-101's own estimate of its speed."""
VELOCITY_EARLY_S = 1e-3
"""Velocity before the change of the position: -0.17 to -0.10 ms for virtual robots."""
LAW_RESIDUAL = 0.1
"""What the drive's law leaves of a torque that is that drive's: 0.009 to 0.017."""
LAW_GAINS = 0.12
"""Gains of the law over those on the drive, less 1: -0.087 to 0.003 and -0.042 to 0.017."""
LAW_SCALE = 0.02
"""Scale of the position in the law, less 1: -0.002 to 0.001."""
LAW_FILTER_S = 3e-3
"""Time constants of the position and of the command in the law: -7.1 to 0 and -1.2 to 0 ms."""
LAW_GAIN = 1.5
"""Residual of the law without a signature over that with it: 1.00 to 1.020."""
LAW_LEAD_S = 1e-3
"""Torque before the command; the delay of the law is 0.1 to 2.3 ms longer than the true one."""
OFFSET_RAD = 0.02
"""Mean position from where gravity leaves it; encoders are off by 2 mrad."""
SIDE = -0.3
"""Mean torque over the model's: 0.6 to 1.5 where gravity has the sign of a side."""
FRICTION = (0.5, 2.0)
"""Fitted dry friction over the model's: fitted over true is 0.75 to 1.14 for virtual robots with
torque constants of 0.75 to 1.25, so that 0.56 to 1.52 passes for a model within a third."""
RESPONSE_SCALE = (-0.026, 0.02)
"""Scale of the position by the response, less 1: -0.019 to 0.005."""
RESPONSE_FILTER = (-2.0, 3.65)
"""Compliance of the belt less that of the model, plus rotor inertia that is missing, both in
standard deviations of their priors: -0.7 to 3.5, and once 5.1 for a rotor of 0.6 times the model's
behind the softest belt."""
STIFFNESS = (0.68, 1.3)
"""Fitted stiffness over the drive's: 0.74 to 1.23 with torque constants of 0.75 to 1.25."""


def require_plausible(logs: Mapping[str, Sequence[JointLog]], robot: RobotSpec) -> None:
    """Refuse logs, by the joint that they excite, of which every number would be wrong.

    Raises:
        LogError: A sign is flipped, angles are in degrees, or another joint moved.
    """
    for joint, sources in logs.items():
        for log in sources:
            if log.unit(joint) != "rad":
                continue
            parts = _parts(log, joint)
            for one in (*_names(log, joint, parts), *_gross(log, joint, robot, parts)):
                raise LogError(f"{log.source or 'log'}: {joint}: {one}.")


def flags(
    logs: Sequence[JointLog], fit: JointFit, robot: RobotSpec, time_fit: TimeFit | None = None
) -> tuple[str, ...]:
    """What is implausible in logs of a fitted joint that `require_plausible` let pass."""
    sources = [log for log in logs if fit.joint in excited_joints(log)]
    found = findings(sources, fit.joint, robot, fit=fit, time_fit=time_fit)
    return tuple(str(one) for one in found)


def findings(
    logs: Sequence[JointLog],
    joint: str,
    robot: RobotSpec,
    *,
    fit: JointFit | None = None,
    time_fit: TimeFit | None = None,
) -> list[Finding]:
    """Contradictions between the logs of a joint, the robot's model and fitted parameters.

    `require_plausible` has let the logs pass.

    Args:
        logs: Logs that excite the joint.
        joint: Its name.
        robot: The robot.
        fit: How it was matched; its dry friction is compared with the model's.
        time_fit: Its fit in time; without it the response is not tested.
    """
    found: list[Finding] = []
    settled = True
    for log in logs:
        parts = _parts(log, joint)
        if dead := list(_dead(joint, robot, parts)):
            found += dead
            continue  # what remains would repeat it in other words
        found += [*_clock(log, joint, robot, parts), *_rate(log, joint, robot)]
        columns, valid = _columns(log, joint, robot, parts)
        found += columns
        settled = settled and valid
        found += _gravity(log, joint, robot, parts)
    wrong = {cause for one in found for cause in one.causes}
    if wrong <= {"drive gains", "torque column"}:
        if time_fit is not None and not settled:
            sample = 1.0 / min(log.rate_hz for log in logs)
            found += _response(time_fit, robot, gains_on_drive(logs[0], joint, robot)[0], sample)
        if fit is not None and np.isfinite(fit.frictionloss):
            found += _friction(fit.frictionloss, robot.joint(joint).drive.frictionloss)
    return list({one.causes: one for one in reversed(found)}.values())[::-1]


def _friction(dry: float, model: float) -> Iterator[Finding]:
    """Fitted dry friction against the model's [N m]."""
    if not FRICTION[0] <= dry / max(model, 1e-3) <= FRICTION[1]:
        yield _finding(
            f"friction: {dry:.2g} N m of dry friction fit where the model has {model:.2g}",
            "friction",
        )


def _parts(log: JointLog, joint: str) -> list[JointLog]:
    """Every excitation of a joint, one log each, largest amplitude first."""
    return [part for group in excitations(log, joint) for part in group]


def _names(log: JointLog, joint: str, parts: Sequence[JointLog]) -> Iterator[Finding]:
    """Whether the named joint is the one that was excited."""
    stated = log.metadata.get("excited", joint)
    if stated != joint:
        yield _finding(f"the log says that {stated} was excited, its columns {joint}", "other leg")
    column = log.column(joint)
    for part in parts:
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


def _gross(
    log: JointLog, joint: str, robot: RobotSpec, parts: Sequence[JointLog]
) -> Iterator[Finding]:
    """Sign and unit: phase and gain at low frequency, and the range of the joint."""
    known = robot.joint(joint)
    low, high = known.range
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
    slow = _spectra(parts, joint, min(1.0, 0.2 * known.band_hz[1]))
    cross = complex(np.vdot(slow["command"], slow["position"]))
    power = [float(np.sum(np.abs(slow[name]) ** 2)) for name in ("command", "position")]
    if abs(cross) ** 2 < COHERENCE * power[0] * power[1] or not all(power):
        return
    gain = abs(cross) / power[0]
    if 0.5 < gain * degree < 2.0 or 0.5 < gain / degree < 2.0:
        yield _finding(f"at low frequency the position is {gain:.3g} times the command", "degrees")
    elif cross.real < -0.7 * abs(cross):
        yield _finding("at low frequency the position moves against the command", "sign")


def _spectra(parts: Sequence[JointLog], joint: str, top_hz: float) -> dict[str, ComplexArray]:
    """Spectra of the columns of one joint where its command has power, parts one after another.

    Beside command, position, and velocity and torque if they are there, `s`, which is i omega
    [rad/s]; each of shape (f,), of each part a multiple of `GROUP` between `LOW_HZ` and `top_hz`.
    """
    column = parts[0].column(joint)
    names = [n for n in ("command", "position", "velocity", "torque") if _has(parts, n, column)]
    rows: list[ComplexArray] = []
    for part in parts:
        count = len(part.time)
        grid, step = np.linspace(part.time[0], part.time[-1], count, retstep=True)
        values = [np.interp(grid, part.time, getattr(part, name)[:, column]) for name in names]
        hz = np.fft.rfftfreq(count, float(step))
        inside = (hz >= LOW_HZ) & (hz <= top_hz)
        both = np.fft.rfft(values - np.mean(values, axis=1, keepdims=True))[:, inside]
        power = np.abs(both[0])
        strong = power > COMMAND_POWER * power.max(initial=0.0)
        whole = np.vstack([2j * np.pi * hz[inside], both])[:, strong]
        rows.append(whole[:, : len(whole[0]) // GROUP * GROUP])
    return dict(zip(["s", *names], np.hstack(rows), strict=True))


def _has(parts: Sequence[JointLog], name: str, column: int) -> bool:
    """Whether a log has a column; velocity and torque of a joint that has none are zero."""
    values = [getattr(part, name) for part in parts]
    wanted = name in ("command", "position")
    return wanted or all(v is not None and np.ptp(v[:, column]) > 0.0 for v in values)


def _dead(joint: str, robot: RobotSpec, parts: Sequence[JointLog]) -> Iterator[Finding]:
    """A joint that stands still for a second or more while its command moves.

    Inside the band it moves by no more than `STILL`; above it the reading does not change at all.
    """
    column, top = parts[0].column(joint), robot.joint(joint).band_hz[1]
    for part in parts:
        whole = float(np.ptp(part.command[:, column]))
        edges = np.searchsorted(part.time, np.arange(part.time[0], part.time[-1], 1.0))
        for first, stop in pairwise(edges):
            command = part.command[first:stop, column]
            if stop - first < 4 or np.ptp(command) < max(0.5 * whole, STILL_RAD):
                continue
            crossings = np.count_nonzero(np.diff(np.sign(command - command.mean())))
            travel = float(np.ptp(part.position[first:stop, column]))
            slow = crossings <= 2.0 * top and travel < STILL * float(np.ptp(command))
            if travel == 0.0 or slow:
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


def _clock(
    log: JointLog, joint: str, robot: RobotSpec, parts: Sequence[JointLog]
) -> Iterator[Finding]:
    """Instants at which the command changes, against its rate and the frequency column."""
    stated = log.metadata.get("command_rate_hz")
    tick = 1.0 / (float(stated) if stated else robot.policy_rate_hz)
    if log.rate_hz * tick < 3.0:
        return
    column = log.column(joint)
    periods, sharpness, shifts = [], [], []
    for part in parts:
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


def _columns(
    log: JointLog, joint: str, robot: RobotSpec, parts: Sequence[JointLog]
) -> tuple[list[Finding], bool]:
    """Compare velocity and torque with position and command.

    Also returns whether the torque follows the drive's law, which then settles scale and filters.
    """
    spectra = _spectra(parts, joint, min(1.5 * robot.joint(joint).band_hz[1], HIGHEST_HZ))
    found: list[Finding] = []
    if len(spectra["s"]) < FEW * GROUP:
        return found, False
    if "velocity" in spectra:
        found += _velocity(spectra)
    if "torque" not in spectra:
        return found, False
    stated = gains_on_drive(log, joint, robot)
    law = torque_law(spectra, stated)
    if law.valid:
        found += _law_findings(law, stated, log.stiffness is not None)
    return found, law.valid


def _crossed(reference: ComplexArray, *signals: ComplexArray) -> tuple[ComplexArray, Array]:
    """Cross spectra of signals with a reference, summed over `GROUP` frequencies each.

    Also returns the smallest coherence of a signal with the reference in each group.
    """
    own, rows = reference.reshape(-1, GROUP), np.stack(signals).reshape(len(signals), -1, GROUP)
    cross = (np.conj(own) * rows).sum(axis=2)
    power = (np.abs(own) ** 2).sum(axis=1) * (np.abs(rows) ** 2).sum(axis=2)
    coherence = np.abs(cross) ** 2 / np.maximum(power, np.finfo(float).tiny)
    return cross, coherence.min(axis=0)


def velocity_ratio(spectra: Mapping[str, ComplexArray]) -> tuple[float, float]:
    """Velocity over `s` position: gain at low frequency, and time by which it is early [s].

    A difference quotient and filters act as `1 + s early + b s^2` on it. NaN where too few
    frequencies are coherent.
    """
    s, command = spectra["s"], spectra["command"]
    cross, coherence = _crossed(command, s * spectra["position"], spectra["velocity"])
    use = coherence > 0.9
    if int(use.sum()) < FEW:
        return float("nan"), float("nan")
    middle = s.reshape(-1, GROUP).mean(axis=1)[use]
    powers = np.stack([middle**k for k in range(3)], axis=1)
    ratio = cross[1, use] / cross[0, use]
    matrix, right = (np.concatenate([x.real, x.imag]) for x in (powers, ratio))
    gain, slope, _ = np.linalg.lstsq(matrix, right, rcond=None)[0]
    return float(gain), float(slope / gain)


def _velocity(spectra: Mapping[str, ComplexArray]) -> Iterator[Finding]:
    gain, early = velocity_ratio(spectra)
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


def torque_law(spectra: Mapping[str, ComplexArray], stated: tuple[float, float]) -> TorqueLaw:
    """Fit the law of a drive to spectra of command, position and torque.

    `stated` gains (stiffness, damping) are where the search begins.
    """
    # Divided by the command all frequencies count alike.
    s, command = spectra["s"], spectra["command"]
    q, t = spectra["position"] / command, spectra["torque"] / command

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
    wrong, whole = {}, float(np.linalg.norm(t)) / stated[0]
    fits = {name: fit(np.append(best, 0.0), name) for name in _LAW_LIMITS}
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


def _gravity(
    log: JointLog, joint: str, robot: RobotSpec, parts: Sequence[JointLog]
) -> Iterator[Finding]:
    """Mean torque of the joints of a limb, and where the excited one rests."""
    names = [name for name in log.joints if log.unit(name) == "rad" and name in robot.joint_names]
    root = max(names, key=lambda name: len(set(robot.joint(name).chain) & set(names)))
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
    """What the responses of a joint say beside its fitted drive."""

    scale: float
    """Of the position, less 1."""
    armature: float
    """Rotor inertia over the model's, its logarithm."""
    compliance: float
    """Of the belt, over that which lets rotor and link ring at `RING_HZ`."""

    @property
    def filtered(self) -> float:
        """Belt that is too soft and rotor that is too light, in standard deviations."""
        return (self.compliance - 1.0) / _PRIOR["compliance"] - self.armature / _PRIOR["armature"]


_PRIOR = {"armature": 0.15, "compliance": 1.0}
"""Standard deviations: of the logarithm about the robot's file; of the compliance about 1."""
RING_HZ = 100.0
"""Rotor and link ring at about it [Hz]; the compliance is known to its own size."""
_DEVIATION = 0.0115
"""Standard deviation of a response relative to the model's: 0.1 dB."""


def response_test(fit: TimeFit, robot: RobotSpec) -> ResponseTest | None:
    """Find scale, armature and compliance in one step from the optimum of a fit in time.

    With `D(s)` the dynamic stiffness of joint and drive, the fitted damping d moves a position q by
    `-s q / D` a unit, so that `q / D` is known without a simulation; armature moves it by
    `-s^2 q / D`, stiffness k by `q / k - q / D`, and a compliance c behind the link's own dynamic
    stiffness `L = gravity + inertia s^2` by `L^2 q / D`. Each is divided by the measured position
    and averaged over narrow bands, the simulated position being the instrument.

    None where the damping was not fitted or nothing is coherent.
    """
    problem, solution = fit.problem, fit.solution
    if "damping" not in problem.fitted:
        return None
    joint, drive = robot.joint(problem.records[0].trace.joint), problem.drive(solution.x)
    armature = max(joint.drive.armature, 1e-4)
    inertia, gravity = bench_inertia(robot, joint.original[0])
    top_hz = min(1.5 * joint.band_hz[1], HIGHEST_HZ)
    changes = np.column_stack([solution.residual, solution.jacobian])
    rows, first = [], 0
    names: list[str] = []
    for repeat in (repeat for one in problem.records for repeat in one.repeats):
        count = len(repeat.time)
        own = changes[first : first + count] / repeat.weight[:, None]
        first += count
        grid, step = np.linspace(repeat.time[0], repeat.time[-1], count, retstep=True)
        signals = [*own.T, repeat.position - repeat.position.mean()]
        hz = np.fft.rfftfreq(count, float(step))
        inside = np.flatnonzero((hz >= LOW_HZ) & (hz <= top_hz))
        inside = inside[: len(inside) // GROUP * GROUP]
        even = [np.interp(grid, repeat.time, x) for x in signals]
        residual, *fitted, q = np.fft.rfft(even)[:, inside]
        s, by_name = 2j * np.pi * hz[inside], dict(zip(problem.fitted, fitted, strict=True))
        soft = -by_name["damping"] / (drive["damping"] * s)
        link = gravity + (inertia - joint.drive.armature) * s**2
        columns = {
            "scale": q,
            "compliance": link**2 * soft / (armature * (2.0 * np.pi * RING_HZ) ** 2),
            "armature": -drive["armature"] * s**2 * soft,
            "stiffness": q - drive["stiffness"] * soft,
            "delay": -s * (q + residual),
        } | by_name
        names = list(columns)
        simulated = q + residual
        _, coherence = _crossed(simulated, q)
        (alike, *cross), _ = _crossed(simulated, q, residual, *columns.values())
        use = coherence > COHERENCE
        rows.append(np.array(cross)[:, use] / alike[use])
    if not (whole := np.hstack(rows)).size:
        return None
    both = np.vstack([whole.real.T, whole.imag.T]) / _DEVIATION
    prior = np.diag([1.0 / _PRIOR.get(name, np.inf) for name in names])
    known = np.zeros(len(names))
    known[names.index("compliance")] = -1.0 / _PRIOR["compliance"]
    known[names.index("armature")] = np.log(drive["armature"] / armature) / _PRIOR["armature"]
    right = np.concatenate([both[:, 0], known])
    found = np.linalg.lstsq(np.vstack([both[:, 1:], prior]), -right, rcond=None)[0]
    step_of = dict(zip(names, found.tolist(), strict=True))
    return ResponseTest(
        scale=step_of["scale"],
        armature=step_of["armature"] + float(np.log(drive["armature"] / armature)),
        compliance=step_of["compliance"],
    )


def _response(fit: TimeFit, robot: RobotSpec, stated: float, sample: float) -> Iterator[Finding]:
    """What the response says of scale, filters, delay and gains; a torque column says it better.

    `stated` is the stiffness on the drive; a log may have its commands a `sample` [s] late.
    """
    values = fit.estimate.values
    if values["delay"] < -sample:
        yield _finding(
            f"the position leads its command by {-1e3 * values['delay']:.1f} ms",
            "command delay",
        )
        return
    test = response_test(fit, robot)
    if test is not None:
        scaled = not RESPONSE_SCALE[0] < test.scale < RESPONSE_SCALE[1]
        if scaled or not RESPONSE_FILTER[0] < test.filtered < RESPONSE_FILTER[1]:
            # Gain and phase of a drive with unknown inertia and belt do not tell them apart.
            yield _finding(
                f"no joint of the model responds so (position {1.0 + test.scale:.3f} times, rotor "
                f"{np.exp(test.armature):.2g} times, belt compliance {test.compliance:.2g} times)",
                *("position filter", "command filter", *(("encoder scale",) if scaled else ())),
            )
    ratio = values["stiffness"] / stated
    if not STIFFNESS[0] <= ratio <= STIFFNESS[1]:
        yield _finding(
            f"the stiffness is {ratio:.2f} times that of the drive",
            *("drive gains", "torque constant"),
        )
