"""Wrong inputs that a fit alone would hide: flags on logs and models that contradict each other.

Four kinds of test, the most direct first. Each finding says what was seen, what it probably is and
the way out; where several causes look alike it names them all.

Log alone. The command is held at a known rate, the log's own frequency column changes with it, the
joint named by a segment is the one that moves, and the sample rate resolves the band.

Torque against position and command. A drive computes, whatever the mechanics behind it, with
s = i omega

    torque = exp(-s lag) [stiffness (exp(-s delay) command - position) - damping s position]

The torque column so gives the gains that were on the drive, and
shows a position or command column that was scaled, filtered or shifted in time.

Gravity. The mean torque of each joint against that of the model in the logged pose, which has the
other sign on the other side of the body, and the mean distance of the position from the command.

Response against the simulator, without a torque column. About the optimum of the fit in time its
Jacobian also gives, to first order, what another armature, a compliance between rotor and link and
a wrong scale of the position would change. One least-squares step finds them. A filter on the
position passes for a light rotor behind a soft belt, one on the command for a negative compliance;
a position in whole counts of an encoder was not filtered.

Without torque and frequency columns three errors leave no trace, which a match states. Gains on the
drive and a torque constant act as one product, which is what a match finds: wrongly stated gains
change no matched number. A command column that is late by less than the joint's own delay leaves a
smaller delay, which is that behind the column. The same joint of another leg responds alike. A mild
filter of a position without counts of an encoder passes for a soft belt.

Thresholds lie outside the range of the same statistic on logs of 160 virtual robots without error,
drawn at random as `python -m benchmarks wrong-inputs` draws them but with seed 1 (those of the fit
on 109 of them); the range stands beside each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy.optimize import least_squares

from pronk.arrays import Array, ComplexArray
from pronk.errors import LogError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.identifiability import bench_inertia
from pronk.identify.match.measured_joint import gains_on_drive
from pronk.identify.match.result import JointFit
from pronk.identify.match.time_fit import TimeFit
from pronk.robots.model import bench_spec
from pronk.robots.robot import Joint, RobotSpec

CAUSES: Mapping[str, tuple[str, str]] = {
    "drive gains": ("the drive had other gains than stated", "state those of this recording"),
    "torque constant": ("the motor's torque constant is not the drive's", "log the drive's torque"),
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
    "friction": (
        "the model's dry friction is wrong",
        "set `frictionloss` in robot.yaml; the gains hold with the fitted one",
    ),
    "dead joint": ("the drive was off or the encoder stuck", "repair it and record again"),
}
"""Cause: what it is, and the way out."""


class Finding:
    """One contradiction between a log and what it is said to be."""

    def __init__(self, seen: str, *causes: str) -> None:
        """Say what was seen, and which keys of `CAUSES` explain it alike."""
        self.seen, self.causes = seen, causes

    def __str__(self) -> str:
        """What was seen, what it probably is, and the way out."""
        what = ", or ".join(CAUSES[one][0] for one in self.causes)
        out = "; ".join(dict.fromkeys(CAUSES[one][1] for one in self.causes))
        return f"{self.seen}: {what}; {out}"


LOW_HZ = 0.25
"""Below it a chirp of 20 s is in its ramp."""
HIGHEST_HZ = 20.0
"""No test looks above it, nor above one and a half times the joint's band."""
COMMAND_POWER = 0.05
"""Magnitude of the command over its largest at which a frequency is looked at."""
COHERENT = 0.8
"""Coherence from which on a response is looked at."""
GROUP = 5
"""Frequencies that are averaged over, 0.25 Hz in a chirp of 20 s."""
FEW = 60
"""Frequencies below which columns are not compared."""
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
LAW_RESIDUAL = 0.1
"""What the drive's law leaves of a torque that is that drive's: 0.009 to 0.017."""
LAW_GAINS = 0.12
"""Gains of the law over those on the drive, less 1: -0.087 to 0.003 and -0.042 to 0.017."""
LAW_SCALE = 0.02
"""Scale of the position in the law, less 1: -0.002 to 0.001."""
LAW_FILTER_S = 3e-3
"""Time constant of position or command in the law; below 0 without a filter."""
LAW_GAIN = 1.5
"""Residual of the law without a signature over that with it: 1.00 to 1.020."""
LAW_LEAD_S = 1e-3
"""Torque before the command; the delay of the law is 0.1 to 2.3 ms longer than the true one."""
OFFSET_RAD = 0.02
"""Mean position from where gravity leaves it; encoders are off by 2 mrad."""
SIDE = -0.3
"""Mean torque over the model's: 0.6 to 1.5 where gravity has the sign of a side."""
FRICTION = (0.5, 2.0)
"""Fitted dry friction over the model's: 0.55 to 1.47 where the true one is 0.75 to 1.33 times the
model's (n = 60, torque constants of 0.75 to 1.25)."""
RESPONSE_SCALE = (-0.026, 0.02)
"""Scale of the position by the response, less 1: -0.019 to 0.005."""
RESPONSE_SOFT = (-2.0, 3.0, 5.5)
"""Compliance of the belt and rotor inertia that is missing, in standard deviations of their priors:
-1.4 to 5.3, and 0.6 to 27 where the position was filtered at 10 to 30 Hz. The highest limit holds
for a position in whole counts of an encoder, which no filter leaves, the middle one for others:
11 of 109 right logs exceed it (light rotors behind the softest belts), 3 of 109 filtered do not."""
STIFFNESS = (0.65, 1.3)
"""Fitted stiffness over the drive's: 0.66 to 1.23 with torque constants of 0.75 to 1.25."""


class _Recorded(NamedTuple):
    """What one log recorded of one joint."""

    log: JointLog
    joint: Joint
    column: int
    parts: Sequence[JointLog]
    """Every excitation of the joint, one log each, largest amplitude first."""

    @classmethod
    def of(cls, log: JointLog, joint: str, robot: RobotSpec) -> _Recorded:
        """Cut a log into the excitations of a joint."""
        parts = [log.cut(excitation.segment) for excitation in log.excitations(joint)]
        return cls(log, robot.joint(joint), log.column(joint), parts)


def require_plausible(logs: Mapping[str, Sequence[JointLog]], robot: RobotSpec) -> None:
    """Refuse logs, by the joint that they excite, of which every number would be wrong.

    Raises:
        LogError: A sign is flipped, angles are in degrees, or another joint moved.
    """
    for joint, log in ((joint, log) for joint, sources in logs.items() for log in sources):
        if log.unit(joint) == "rad":
            own = _Recorded.of(log, joint, robot)
            for one in (*_names(own), *_gross(own)):
                raise LogError(f"{log.source or 'log'}: {joint}: {one}.")


def findings(
    logs: Sequence[JointLog],
    joint: str,
    robot: RobotSpec,
    *,
    fit: JointFit | None = None,
    time_fit: TimeFit | None = None,
) -> tuple[list[Finding], tuple[str, ...]]:
    """Contradictions between the logs of a joint, the robot's model and fitted parameters.

    Of logs that `require_plausible` has let pass those that excite the joint are used. The dry
    friction of `fit` is compared with the model's; without `time_fit` the response is not tested.
    Also returns the causes out of `CAUSES` that would leave no trace in these logs.
    """
    found: list[Finding] = []
    settled, logs = True, [log for log in logs if joint in log.excited_joints]
    for own in (_Recorded.of(log, joint, robot) for log in logs):
        if dead := list(_dead(own)):
            found += dead
            continue  # what remains would repeat it in other words
        stated = gains_on_drive(own.log, joint, robot)
        found += _clock(own, robot.policy_rate_hz)
        torque = _torque(own, stated)
        found += [*(torque or ()), *_gravity(own, robot)]
        settled = settled and torque is not None
    wrong = {cause for one in found for cause in one.causes}
    if wrong <= {"drive gains", "torque column"}:
        if time_fit is not None and not settled:
            found += _response(time_fit, robot, logs)
        model = robot.joint(joint).drive.frictionloss
        dry = np.nan if fit is None else fit.frictionloss
        ratio = dry / max(model, 1e-3)
        if ratio < FRICTION[0] or ratio > FRICTION[1]:
            what = f"friction: {dry:.2g} N m of dry friction fit where the model has {model:.2g}"
            found.append(Finding(what, "friction"))
    hidden = _those(
        {
            "drive gains": not settled,
            "other leg": not all("excited" in log.origin.metadata for log in logs),
            "command delay": not settled and any(log.frequency is None for log in logs),
            "position filter": not settled and not _counted(logs, joint),
        }
    )
    # Of several findings of the same causes the first.
    firsts = list({one.causes: one for one in reversed(found)}.values())[::-1]
    return firsts, tuple(cause for cause in hidden if cause not in wrong)


def _those(causes: Mapping[str, bool]) -> list[str]:
    """The causes that are possible."""
    return [cause for cause, possible in causes.items() if possible]


def _names(own: _Recorded) -> Iterator[Finding]:
    """Whether the named joint is the one that was excited."""
    log, joint = own.log, own.joint.name
    stated = log.origin.metadata.get("excited", joint)
    if stated != joint:
        yield Finding(f"the log says that {stated} was excited, its columns {joint}", "other leg")
    for part in own.parts:
        travel, commanded = np.ptp(part.position, axis=0), np.ptp(part.command, axis=0)
        for i, name in enumerate(part.joints):
            if i == own.column or commanded[i] > 0.0 or log.unit(name) != "rad":
                continue
            if travel[i] > max(0.5 * commanded[own.column], 2.0 * travel[own.column]):
                yield Finding(
                    f"{name} moved by {travel[i]:.2g} rad while {joint} was commanded", "other leg"
                )
                return


def _gross(own: _Recorded) -> Iterator[Finding]:
    """Sign and unit: phase and gain at low frequency, and the range of the joint."""
    low, high = own.joint.range
    command, degree = own.log.command[:, own.column], np.pi / 180.0
    least, most = float(command.min()), float(command.max())
    inside = low <= degree * least and degree * most <= high
    if (least < low - 1.0 or most > high + 1.0) and inside:
        yield Finding(
            f"the command goes from {least:.3g} to {most:.3g}, the joint from {low:.3g} to "
            f"{high:.3g} rad",
            "degrees",
        )
        return
    slow = _spectra(own, min(1.0, 0.2 * own.joint.band_hz[1]))
    cross = complex(np.vdot(slow["command"], slow["position"]))
    power = [float(np.sum(np.abs(slow[name]) ** 2)) for name in ("command", "position")]
    if abs(cross) ** 2 < COHERENT * power[0] * power[1] or not all(power):
        return
    gain = abs(cross) / power[0]
    if 0.5 < gain * degree < 2.0 or 0.5 < gain / degree < 2.0:
        yield Finding(f"at low frequency the position is {gain:.3g} times the command", "degrees")
    elif cross.real < -0.7 * abs(cross):
        yield Finding("at low frequency the position moves against the command", "sign")


def _spectra(own: _Recorded, top_hz: float) -> dict[str, ComplexArray]:
    """Spectra of the columns of a joint where its command has power, parts one after another.

    Beside command, position, and torque if it is there, `s`, which is i omega [rad/s]; each of
    shape (f,).
    """
    names, torque, rows = ["command", "position"], own.log.torque, []
    if torque is not None and np.ptp(torque[:, own.column]) > 0.0:
        names.append("torque")
    for part in own.parts:
        columns = [getattr(part, name)[:, own.column] for name in names]
        both = _transformed(part.time, columns, top_hz)
        power = np.abs(both[1])
        rows.append(both[:, power > COMMAND_POWER * power.max(initial=0.0)])
    return dict(zip(["s", *names], np.hstack(rows), strict=True))


def _transformed(time: Array, columns: Sequence[Array], top_hz: float) -> ComplexArray:
    """Spectra of columns between `LOW_HZ` and `top_hz`, after i omega [rad/s], shape (1 + n, f)."""
    grid, step = np.linspace(time[0], time[-1], len(time), retstep=True)
    even = np.array([np.interp(grid, time, column) for column in columns])
    hz = np.fft.rfftfreq(len(grid), float(step))
    inside = (hz >= LOW_HZ) & (hz <= top_hz)
    spectra = np.fft.rfft(even - even.mean(axis=1)[:, None])
    return np.vstack([2j * np.pi * hz, spectra])[:, inside]


def _dead(own: _Recorded) -> Iterator[Finding]:
    """A joint that stands still for a second or more while its command moves.

    Inside the band it moves by no more than `STILL`; above it the reading does not change at all.
    """
    column, top = own.column, own.joint.band_hz[1]
    for part in own.parts:
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
                yield Finding(
                    f"{own.joint.name} stands still at {part.time[first]:.1f} s while its "
                    "command moves",
                    "dead joint",
                )
                return


def _clock(own: _Recorded, policy_rate_hz: float) -> Iterator[Finding]:
    """Sample rate; instants at which the command changes, its rate and the frequency column."""
    log, top = own.log, own.joint.band_hz[1]
    if log.rate_hz < RATE_MIN * top:
        yield Finding(
            f"{log.rate_hz:.3g} samples a second are {log.rate_hz / top:.2g} a period at {top:g} "
            f"Hz, fewer than {RATE_MIN:g}",
            "sample rate",
        )
    stated = log.origin.metadata.get("command_rate_hz")
    tick = 1.0 / (float(stated) if stated else policy_rate_hz)
    if log.rate_hz * tick < 3.0:
        return
    periods, sharpness, shifts = [], [], []
    for part in own.parts:
        size = np.abs(np.diff(part.command[:, own.column]))
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
        yield Finding(
            f"the command changes every {1e3 * period:.2f} ms instead of {1e3 * tick:.2f}, "
            f"{period / tick:.4f} times",
            *(("time",) if stated else ("time", "command rate")),
        )
    elif sharp < SHARP_MIN and (stated or off < TICK_OFF):
        yield Finding(
            f"the command changes all the time instead of once in {1e3 * tick:.1f} ms",
            "command filter",
        )
        return
    if shifts and abs(shift := float(np.median(shifts))) > SHIFT_SAMPLES / log.rate_hz:
        yield Finding(
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


def _torque(own: _Recorded, stated: tuple[float, float]) -> list[Finding] | None:
    """Compare the torque with what a drive of the stated gains (stiffness, damping) computes.

    None if there is no torque column or it does not follow the law of a drive, which otherwise
    settles scale and filters.
    """
    spectra = _spectra(own, min(1.5 * own.joint.band_hz[1], HIGHEST_HZ))
    if "torque" not in spectra or len(spectra["s"]) < FEW:
        return None
    # Divided by the command all frequencies count alike.
    s, command = spectra["s"], spectra["command"]
    q, t = spectra["position"] / command, spectra["torque"] / command

    # What each wrong input leaves to be undone; Butterworth filters of first and second order.
    undone: dict[str, Callable[[float], tuple[Any, Any]]] = {
        "": lambda size: (1.0, 1.0),
        "encoder scale": lambda size: (1.0, 1.0 / (1.0 + size)),
        "position filter": lambda size: (1.0, 1.0 + s * size),
        "position filter of second order": lambda size: (1.0, 1.0 + s * size + (s * size) ** 2 / 2),
        "command filter": lambda size: (1.0 + s * size, 1.0),
    }

    def residual(x: Array, name: str) -> Array:
        stiffness, damping, delay, lag, size = x
        sent, read = undone[name](size)
        sent, read = np.exp(-s * delay) * sent, q * read
        off = (stiffness * (sent - read) - damping * s * read) * np.exp(-s * lag) - t
        # The last row holds a size that changes nothing.
        return np.concatenate([off.real / stated[0], off.imag / stated[0], [1e-3 * size]])

    start = np.array([*stated, 0.005, 0.0005, 0.0])
    scale = np.array([0.1 * stated[0], 0.1 * max(stated[1], 1e-3), 2e-3, 5e-4, 0.01])
    # Sampling, averaging of the speed and the current loop of a drive make the lag.
    high = np.array([np.inf, np.inf, np.inf, 2e-3, 0.05])
    low = np.array([-np.inf, -np.inf, -np.inf, 0.0, -0.05])
    fits = {
        name: least_squares(residual, start, x_scale=scale, bounds=(low, high), args=(name,))
        for name in undone
    }
    wrong = min(fits, key=lambda name: fits[name].cost)
    if fits[""].cost < LAW_GAIN**2 * fits[wrong].cost:
        wrong = ""
    stiffness, damping, delay, _, size = fits[wrong].x.tolist()
    left = np.sqrt(2.0 * fits[wrong].cost) * stated[0] / np.linalg.norm(t)
    if left > LAW_RESIDUAL or stiffness < 0.0:
        return None
    found = []
    if wrong == "encoder scale" and abs(size) > LAW_SCALE:
        found.append(Finding(f"the torque is that of the position {1.0 + size:.3f} times", wrong))
    elif "filter" in wrong and size > LAW_FILTER_S:
        name = wrong.split()[0]
        what = f"the torque is that of the {name} {1e3 * size:.1f} ms earlier"
        found.append(Finding(what, f"{name} filter"))
    ratios = stiffness / stated[0], damping / max(stated[1], 1e-9)
    if max(abs(ratio - 1.0) for ratio in ratios) > LAW_GAINS:
        alike = abs(ratios[0] / ratios[1] - 1.0) < LAW_GAINS
        whose = "of the robot's file" if own.log.stiffness is None else "stated in the log"
        what = (
            f"the torque is that of a drive with {stiffness:.3g} / {damping:.3g} instead of "
            f"{stated[0]:.3g} / {stated[1]:.3g} {whose}"
        )
        found.append(Finding(what, *("drive gains", "torque column")[: 1 + alike]))
    if delay < -LAW_LEAD_S:
        what = f"the torque follows the command before it was given ({1e3 * delay:.1f} ms)"
        found.append(Finding(what, "command delay"))
    return found


def _gravity(own: _Recorded, robot: RobotSpec) -> Iterator[Finding]:
    """Mean torque of the joints of a limb, and where the excited one rests."""
    log = own.log
    names = [name for name in log.joints if log.unit(name) == "rad" and name in robot.joint_names]
    root = max(names, key=lambda name: len(set(robot.joint(name).chain) & set(names)))
    mean = {
        name: tuple(
            float(np.mean([getattr(part, kind)[:, part.column(name)].mean() for part in own.parts]))
            for kind in ("command", "position")
        )
        for name in names
    }
    needed = _holding_torques(robot, root, {name: q for name, (_, q) in mean.items()})
    for name in (name for name in needed if name in mean):
        known, (stiffness, _) = robot.joint(name), gains_on_drive(log, name, robot)
        command, position = mean[name]
        torque = stiffness * (command - position)
        mirrored = any(
            other.original[0] == known.original[0] and other.original[1] == -known.original[1]
            for other in robot.joints
        )
        if mirrored and abs(needed[name]) > 0.1 and torque / needed[name] < SIDE:
            yield Finding(
                f"{name} is held by {torque:+.2f} N m, where the model needs {needed[name]:+.2f}",
                "other side",
            )
        if name == own.joint.name:
            off = position - (command - needed[name] / stiffness)
            if abs(off) > OFFSET_RAD:
                alike = {
                    "encoder scale": abs(off) < 0.3 * abs(position - off),
                    "encoder offset": True,
                    "drive gains": 0.5 < torque * needed[name] / max(needed[name] ** 2, 1e-9) < 2.0,
                }
                yield Finding(
                    f"{name} moves about {position:.3f} rad, where its command and gravity leave "
                    f"it at {position - off:.3f}",
                    *_those(alike),
                )


def _holding_torques(robot: RobotSpec, root: str, at: Mapping[str, float]) -> dict[str, float]:
    """Torque that holds each joint of a chain at a position [N m]; default where one is missing."""
    model = bench_spec(robot, root).compile()
    data = mujoco.MjData(model)
    names = [model.joint(i).name for i in range(model.njnt)]
    data.qpos[:] = [at.get(name, robot.joint(name).default_position) for name in names]
    mujoco.mj_forward(model, data)
    return dict(zip(names, data.qfrc_bias.tolist(), strict=True))


RING_HZ = 100.0
"""Rotor and link ring at about it [Hz]; the compliance is known to its own size."""
_PRIOR = {"armature": 0.15, "compliance": 1.0}
"""Standard deviations: of the logarithm about the robot's file; of the compliance about 1."""
_DEVIATION = 0.0115
"""Standard deviation of a response relative to the model's: 0.1 dB."""


def response_test(fit: TimeFit, robot: RobotSpec) -> tuple[float, float, float] | None:
    """Find scale, armature and compliance in one step from the optimum of a fit in time.

    With `D(s)` the dynamic stiffness of joint and drive, the fitted damping d moves a position q by
    `-s q / D` a unit, so that `q / D` is known without a simulation; armature moves it by
    `-s^2 q / D`, stiffness k by `q / k - q / D`, and a compliance c behind the link's own dynamic
    stiffness `L = gravity + inertia s^2` by `L^2 q / D`. Each is divided by the measured position
    and averaged over narrow bands, the simulated position being the instrument.

    Returns:
        Scale of the position less 1, logarithm of the rotor inertia over the model's, and
        compliance over that which lets rotor and link ring at `RING_HZ`; None where the damping
        was not fitted or nothing is coherent.
    """
    problem, solution = fit.problem, fit.solution
    if "damping" not in problem.fitted:
        return None
    joint, drive = robot.joint(problem.simulations.joint), problem.drive(solution.x)
    armature = max(joint.drive.armature, 1e-4)
    inertia, gravity = bench_inertia(robot, joint.original[0])
    top_hz = min(1.5 * joint.band_hz[1], HIGHEST_HZ)
    changes = np.column_stack([solution.residual, solution.jacobian])
    parts = np.split(changes, np.cumsum([len(repeat.time) for repeat in problem.repeats])[:-1])
    rows, names = [], ["scale", "compliance", "armature", "stiffness"]
    names += [name for name in problem.fitted if name not in names]
    for repeat, own in zip(problem.repeats, parts, strict=True):
        columns = [*(own / repeat.weight[:, None]).T, repeat.position]
        spectra = _transformed(repeat.time, columns, top_hz)
        s, residual, *fitted, q = spectra[:, : spectra.shape[1] // GROUP * GROUP]
        by_name = dict(zip(problem.fitted, fitted, strict=True))
        soft = -by_name["damping"] / (drive["damping"] * s)
        link = gravity + (inertia - joint.drive.armature) * s**2
        by_name = {
            "scale": q,
            "compliance": link**2 * soft / (armature * (2.0 * np.pi * RING_HZ) ** 2),
            "armature": -drive["armature"] * s**2 * soft,
            "stiffness": q - drive["stiffness"] * soft,
        } | by_name
        whole = np.stack([q, residual, *(by_name[name] for name in names)])
        whole = whole.reshape(len(whole), -1, GROUP)
        simulated = whole[0] + whole[1]
        alike, *cross = (np.conj(simulated) * whole).sum(axis=2)
        power = (np.abs(simulated) ** 2).sum(axis=1) * (np.abs(whole[0]) ** 2).sum(axis=1)
        use = np.abs(alike) ** 2 > COHERENT * power
        rows.append(np.array(cross)[:, use] / alike[use])
    if not (responses := np.hstack(rows)).size:
        return None
    both = np.hstack([responses.real, responses.imag]).T / _DEVIATION
    prior, known = np.diag([1.0 / _PRIOR.get(name, np.inf) for name in names]), np.zeros(len(names))
    lighter = float(np.log(drive["armature"] / armature))
    known[1:3] = -1.0 / _PRIOR["compliance"], lighter / _PRIOR["armature"]
    matrix, right = np.vstack([both[:, 1:], prior]), np.concatenate([both[:, 0], known])
    scale, compliance, rotor, *_ = np.linalg.lstsq(matrix, -right, rcond=None)[0].tolist()
    return scale, lighter + rotor, compliance


def _counted(logs: Sequence[JointLog], joint: str) -> bool:
    """Whether all positions of a joint are in whole counts of an encoder, which no filter leaves.

    Rounded decimals are none.
    """
    for log in logs:
        moves = np.abs(np.diff(log.position[:, log.column(joint)]))
        count = float(moves[moves > 0.0].min(initial=np.inf))
        few = moves[(moves > 0.0) & (moves < 20.0 * count)] / count
        whole = len(few) >= FEW and np.mean(np.abs(few - np.round(few)) < 0.05) > 0.99
        decimals = np.log10([count, np.rad2deg(count)])
        if not whole or np.abs(decimals - np.round(decimals)).min() <= 1e-3:
            return False
    return True


def _response(fit: TimeFit, robot: RobotSpec, logs: Sequence[JointLog]) -> Iterator[Finding]:
    """What the response says of scale, filters, delay and gains; a torque column says it better."""
    values, joint = fit.estimate.values, fit.problem.simulations.joint
    # Logs of 100 Hz may have their commands a sample late.
    if values["delay"] < -1.0 / min(log.rate_hz for log in logs):
        yield Finding(
            f"the position leads its command by {-1e3 * values['delay']:.1f} ms", "command delay"
        )
        return
    if test := response_test(fit, robot):
        scale, rotor, compliance = test
        counted = _counted(logs, joint)
        soft = (compliance - 1.0) / _PRIOR["compliance"] - rotor / _PRIOR["armature"]
        scaled = not RESPONSE_SCALE[0] < scale < RESPONSE_SCALE[1]
        if scaled or not RESPONSE_SOFT[0] < soft < RESPONSE_SOFT[1 + counted]:
            # Gain and phase of a drive with unknown inertia and belt do not separate them.
            unlike = {
                "encoder scale": scaled,
                "position filter": not counted,
                "command filter": True,
                "drive gains": "stiffness" not in fit.problem.fitted,
                "torque constant": "stiffness" not in fit.problem.fitted,
            }
            yield Finding(
                f"no joint of the model responds so (position {1.0 + scale:.3f} times, rotor "
                f"{np.exp(rotor):.2g} times, belt compliance {compliance:.2g} times)",
                *_those(unlike),
            )
    ratio = values["stiffness"] / gains_on_drive(logs[0], joint, robot)[0]
    if not STIFFNESS[0] <= ratio <= STIFFNESS[1]:
        what = f"the stiffness is {ratio:.2f} times that of the drive"
        yield Finding(what, "drive gains", "torque constant")
