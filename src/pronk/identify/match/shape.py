"""A filter of a real drive's commands with which its joint responds like a simulated one.

Matching changes the simulated joint; this changes the real one, so that a policy trained with given
gains meets them on hardware. The filter runs at the rate of the commands and approximates
`H_simulated / H_measured`, whose delay it cannot take away: of all filters

    F(z) = (b0 + b1 / z + b2 / z^2) / (1 + a1 / z + a2 / z^2),    F(1) = 1,

that are stable, the one with the smallest `|F H_measured - H_simulated exp(-j omega tau)|`,
relative to `|H_simulated|`, over the coherent frequencies of the band, for the delay `tau >= 0`
that suits it best; error without the delay counts too, by a weight that is lowered until the drive
can do it. F(1) = 1 leaves poses as they are. It is feed-forward alone: what disturbs the
joint meets the stiffness of the real drive, which *Actuator Reality Shaping* (Yamamori et al.,
arXiv 2607.02205) changes too by an additional feedback.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np
import yaml
from scipy.optimize import least_squares
from scipy.signal import lfilter

from pronk.arrays import Array, ComplexArray
from pronk.errors import PlanError, PronkError
from pronk.files import write_text
from pronk.identify.excitation.plan import SweepPlan, make_plan
from pronk.identify.excitation.signals import Chirp, Signal
from pronk.identify.logs.excitations import with_segments
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.export import profile_held
from pronk.identify.match.gains import MatchedGains
from pronk.identify.match.measured_joint import (
    DB,
    MeasuredJoint,
    logs_by_joint,
    measured_joints,
    merged,
    rms,
)
from pronk.identify.match.settings import MatchSettings
from pronk.identify.match.simulated import SimRequest, responses
from pronk.identify.simulators.mujoco import MujocoSimulator
from pronk.robots.robot import RobotSpec

SCHEMA = "pronk/shape/1"
MOST_ERROR = 0.25
"""Largest distance of the shaped response over that of the simulated joint: that of a delay of
10 ms at 4 Hz."""
TAIL_S = 0.5
"""Rest after a shaped signal, in which the filter comes to rest [s]."""
_DAMP = 0.1
"""Weight of the filter's gain [neper] between the band and half the command rate, in units of the
relative error: it holds the filter near 1 where nothing is compared."""
_LATE = (1.0, 0.5, 0.2, 0.1)
"""Weights of the relative error with the delay counted as an error, against that without. A large
one takes more torque; the first with which the drive can do what it must is taken."""
_MOST_DELAY_S = 0.1
_STARTS = (-0.5, 0.0, 0.5)
"""First values of the poles' coefficient a1 / (1 + a2)."""

Coefficients = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Prefilter:
    """The filter of one joint's commands."""

    numerator: Coefficients
    """b0, b1, b2; commands are filtered about the pose or as they are, F(1) being 1."""
    denominator: Coefficients
    """1, a1, a2."""
    delay_s: float
    """How much later the shaped joint responds than the simulated one [s]."""
    before_db: float
    after_db: float
    """Magnitude of the measured response over the simulated one, root mean square, and the same of
    the shaped one, as computed [dB]."""
    before_error: float
    after_error: float
    """Distance of the measured response from the simulated one over its magnitude, delay included,
    root mean square, and the same of the shaped one, as computed."""
    peak_db: float
    peak_hz: float
    """Largest gain of the filter up to half the command rate [dB], and where it is [Hz]."""
    amplitude: float
    """Of the command at which the joint was measured [rad]."""

    def response(self, omega: Array, rate_hz: float) -> ComplexArray:
        """Response of the filter at some frequencies [rad/s]."""
        return _response(self.numerator, self.denominator, omega, rate_hz)

    def apply(self, command: Array) -> Array:
        """Filter commands [rad] of shape (ticks,), at rest before the first."""
        first = command[:1]
        return np.asarray(first + lfilter(self.numerator, self.denominator, command - first))


def _response(
    numerator: Sequence[float], denominator: Sequence[float], omega: Array, rate_hz: float
) -> ComplexArray:
    z = np.exp(-1j * omega / rate_hz)
    return np.asarray(np.polyval(numerator[::-1], z) / np.polyval(denominator[::-1], z))


@dataclass(frozen=True, kw_only=True)
class Shape:
    """Filters of a robot's joints, and what they rest on: the content of `shape.yaml`."""

    robot: str
    rate_hz: float
    """Rate of the commands."""
    simulator: str
    """Profile of the simulated joint."""
    gains: Mapping[str, tuple[float, float]]
    """Stiffness and damping of each simulated joint [N m/rad, N m s/rad]."""
    joints: Mapping[str, Prefilter]
    logs: Mapping[str, str]
    """File name to SHA-256."""
    virtual: bool


@dataclass(frozen=True, kw_only=True)
class Shaped(Signal):
    """A chirp that passes a prefilter; its amplitude is that of the chirp before it."""

    kind = "chirp"

    signal: Chirp = field(default_factory=Chirp)
    prefilter: Prefilter

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest excited frequency [Hz]."""
        return self.signal.band_hz

    def requested(self, rate_hz: float) -> Array:
        """The offsets before the filter [rad], shape (ticks,)."""
        raw = replace(self.signal, amplitude=self.amplitude).samples(rate_hz)
        return np.pad(raw, (0, round(TAIL_S * rate_hz)))

    def _samples(self, rate_hz: float) -> Array:
        out = self.prefilter.apply(self.requested(rate_hz))
        out[-1] = 0.0
        return out

    def frequency(self, rate_hz: float = 50.0) -> Array:
        """Instantaneous frequency at the ticks [Hz], shape (ticks,)."""
        tail = np.full(round(TAIL_S * rate_hz), np.nan)
        return np.append(self.signal.frequency(rate_hz), tail)


def goals_of(
    logs: Sequence[JointLog], robot: RobotSpec, gains: MatchedGains
) -> dict[str, tuple[MeasuredJoint, ComplexArray]]:
    """Each joint's measured response of the largest amplitude, and the simulated one, (inside,).

    The simulated joint has the gains, the dry friction and the delay of `gains`, and its response
    goes through the estimator of the log. PronkError if these are of another robot or lack a joint.
    """
    if gains.robot != robot.name:
        raise PronkError(f"the gains are those of {gains.robot}, not of {robot.name}.")
    known, settings = profile_held(gains).robot(robot), MatchSettings()
    logs, out = [with_segments(log) for log in logs], {}
    with MujocoSimulator(known, threads=settings.threads) as rigs:
        for name, sources in logs_by_joint(logs, known).items():
            if name not in gains.joints:
                raise PronkError(
                    f"{name} was excited, and there are no gains of the simulated joint; give "
                    f"--sim-gains {name}=STIFFNESS,DAMPING."
                )
            joint = gains.joints[name]
            goal = merged([measured_joints(log, name, known, settings) for log in sources])[0]
            friction = None if np.isnan(joint.frictionloss) else joint.frictionloss
            request = SimRequest(
                goal, joint.stiffness, joint.damping, frictionloss=friction, delay=joint.delay_s
            )
            out[name] = goal, responses(rigs, [request])[0]
    return out


def shaped_plan(
    goal: MeasuredJoint, simulated: ComplexArray, robot: RobotSpec, on_drive: tuple[float, float]
) -> tuple[Prefilter, SweepPlan]:
    """Find a joint's filter, and the sweep with shaped commands that would verify it.

    `on_drive` are the gains on the real drive; the sweep has the amplitude of the measured one.
    PlanError if no filter brings the joint near the simulated one, or with every one that does a
    limit of the drive or joint could be exceeded.
    """
    stiffness, damping = ({goal.joint: value} for value in on_drive)
    refused = ""
    for late in _LATE:
        found = prefilter(goal, simulated, robot.policy_rate_hz, late)
        if found.after_error >= min(found.before_error, MOST_ERROR):
            refused = refused or (
                f"{goal.joint} responds otherwise than the simulated joint by "
                f"{100.0 * found.before_error:.0f} % and, with the filter that suits it best, by "
                f"{100.0 * found.after_error:.0f} %; expected less, and at most "
                f"{100.0 * MOST_ERROR:.0f} %"
            )
            continue
        plan = make_plan(
            robot,
            [goal.joint],
            Shaped(prefilter=found),
            amplitudes=[found.amplitude],
            stiffness=stiffness,
            damping=damping,
        )
        try:
            plan.check()
        except PlanError as error:
            refused = f"with filtered commands, {error}"
            continue
        return found, plan
    raise PlanError(f"{refused.rstrip('.')}; match the simulated joint to this drive instead.")


def prefilter(
    goal: MeasuredJoint, simulated: ComplexArray, rate_hz: float, late: float
) -> Prefilter:
    """Find the filter with which a measured joint responds like a simulated one.

    `late` is the weight of the error with the delay counted, against that without.
    """
    omega, measured = goal.omega, goal.measured.response[goal.fit_mask]
    above = np.linspace(omega[-1], np.pi * rate_hz, 20)[1:]

    def parts(x: Array) -> tuple[Coefficients, Coefficients]:
        # The triangle of stable poles: |a2| < 1 and |a1| < 1 + a2.
        a2 = float(np.tanh(x[3]))
        a1 = float(np.tanh(x[2])) * (1.0 + a2)
        b0 = 1.0 + a1 + a2 - x[0] - x[1]
        return (float(b0), float(x[0]), float(x[1])), (1.0, a1, a2)

    def gain(x: Array, at: Array) -> ComplexArray:
        return _response(*parts(x), at, rate_hz)

    def residual(x: Array) -> Array:
        shaped = gain(x, omega) * measured / simulated
        errors = np.append(shaped * np.exp(1j * omega * x[4]) - 1.0, late * (shaped - 1.0))
        errors /= np.sqrt(len(omega))
        loud = _DAMP * np.log(np.maximum(np.abs(gain(x, above)), 1e-9)) / np.sqrt(len(above))
        return np.concatenate([errors.real, errors.imag, loud])

    bounds = ([-50.0] * 2 + [-6.0] * 2 + [0.0], [50.0] * 2 + [6.0] * 2 + [_MOST_DELAY_S])
    tries = [
        least_squares(residual, [0.0, 0.0, pole, 0.0, 0.01], bounds=bounds) for pole in _STARTS
    ]
    best = min(tries, key=lambda one: float(one.cost)).x
    numerator, denominator = parts(best)
    every = np.linspace(0.0, np.pi * rate_hz, 500)
    loudness = np.abs(gain(best, every))
    peak = int(np.argmax(loudness))
    ratio = measured / simulated
    shaped = ratio * gain(best, omega)
    return Prefilter(
        numerator=numerator,
        denominator=denominator,
        delay_s=float(best[4]),
        before_db=rms(DB * np.log(np.abs(ratio))),
        after_db=rms(DB * np.log(np.abs(shaped))),
        before_error=rms(ratio - 1.0),
        after_error=rms(shaped - 1.0),
        peak_db=float(DB * np.log(loudness[peak])),
        peak_hz=float(every[peak] / (2.0 * np.pi)),
        amplitude=goal.measured.amplitude,
    )


def distance(goal: MeasuredJoint, simulated: ComplexArray) -> tuple[float, float, float]:
    """How far a measured response is from a simulated one.

    Root mean squares of the magnitude [dB] and of the distance over the magnitude, delay included,
    and how much later it responds [s].
    """
    ratio = goal.measured.response[goal.fit_mask] / simulated
    phase = np.unwrap(np.angle(ratio))
    late = -float(phase @ goal.omega / (goal.omega @ goal.omega))
    return rms(DB * np.log(np.abs(ratio))), rms(ratio - 1.0), late


def as_requested(log: JointLog, signals: Mapping[str, Shaped], robot: RobotSpec) -> JointLog:
    """A log of shaped excitations with the commands before the filter in place of those sent."""
    command, rate = log.command.copy(), robot.policy_rate_hz
    half = 0.5 * float(np.median(np.diff(log.time)))
    for segment in log.segments:
        (name,) = segment.joints
        raw = replace(signals[name], amplitude=segment.amplitude).requested(rate)
        tick = np.floor((log.time - segment.start + half) * rate).astype(np.int64)
        inside = (tick >= 0) & (log.time <= segment.stop)
        offset = np.append(raw, 0.0)[np.minimum(tick[inside], len(raw))]
        joint = robot.joint(name)
        command[inside, log.column(name)] = joint.default_position + joint.original[1] * offset
    return replace(log, command=command)


def save(path: Path, shape: Shape) -> None:
    """Write `shape.yaml`, whole or not at all."""
    body = {"schema": SCHEMA, **msgspec.to_builtins(shape)}
    write_text(path, yaml.safe_dump(body, sort_keys=False, width=1000, default_flow_style=None))
