"""The safety filter: limits, rules, and the fault that lasts from one tick to the next.

`apply_rules` is a pure function of arrays with any leading shape (...,) and joints last. Its faults
have an order: the first that is met gives the reason. A command passes unchanged, or its target is
moved into the range that all limits allow, or it is replaced by damping. Gains are never changed: a
robot with another stiffness is not the one that was matched.

`SafetyFilter` judges the states and the command of a tick by these rules, and the states so far by
`Supervision`: whether they can all be true. A fault damps for at least one second; a latched fault
needs the operator's reset.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.deploy.runtime.supervision import Supervision
from pronk.errors import RobotError
from pronk.robots.machine import Command, State
from pronk.robots.motor import voltage_limits, winding_loss
from pronk.robots.robot import RobotSpec


class FilterAction(IntEnum):
    """What the filter does with a command, in order of severity."""

    PASS = 0
    """Sent unchanged."""
    LIMIT = 1
    """Sent with its target moved."""
    HOLD = 2
    """The last target is sent again."""
    DAMP = 3
    """The joints are damped for a second at least, until a request to stand."""
    LATCH = 4
    """The joints are damped until the operator resets the fault."""


class Reason(IntEnum):
    """Why the filter acted. Those up to `POWER` hold or move the target; the others are faults."""

    text: str
    """One line."""

    def __new__(cls, value: int, text: str = "") -> Reason:
        """Make a member with its text."""
        reason = int.__new__(cls, value)
        reason._value_, reason.text = value, text
        return reason

    @property
    def level(self) -> FilterAction:
        """What the filter does for this reason; a fault is latched unless it only damps."""
        return _NOT_LATCHED.get(self, FilterAction.LATCH)

    NONE = 0, "no limit met"
    OLD_STATE = 1, "the newest state is older than 20 ms; the last target is held"
    POSITION = 2, "the target would drive a joint beyond its limits; it was moved back"
    CHANGE = 3, "the target changes too much in one tick; it was slowed down"
    TORQUE = 4, "the target needs more torque than the drive may give; it was moved back"
    POWER = 5, "the targets need more power than the battery may give; they were moved back"
    STATE_NOT_FINITE = 6, "the state holds something that is not a number"
    COMMAND_NOT_FINITE = 7, "the command holds something that is not a number"
    GAINS = 8, "the command's gains are negative or beyond the range of the drives"
    CLOCK = 9, "a state or command is stamped in the future; the clocks disagree"
    EXPIRED = 10, "the newest command has expired; check the policy's process"
    NO_STATE = 11, "no state for 50 ms"
    STATE_LOST = 12, "no state for 100 ms; the link or the robot's program has stopped"
    LAG = 13, "the command was computed from a state more than three policy steps old"
    OVERRUN = 14, "a joint is beyond its mechanical limits; its encoder may have slipped"
    TILT = 15, "the trunk is tilted too far"
    SPEED = 16, "a joint turns faster than its limit"
    TEMPERATURE = 17, "a motor is too hot"
    IMPOSSIBLE = 18, "no target meets all limits at once"
    DEAD_MAN = 19, "the dead-man button is not held"
    ENDED = 20, "the operator's program has ended"
    LINK = 21, "the link reports a fault"
    OVERLOAD = 22, "a joint's measured torque is beyond its limit"
    REPEATED = 23, "a sensor of the trunk repeats its numbers; it or its program has stopped"
    ATTITUDE = 24, "attitude, gyro and accelerometer contradict each other"
    ENCODER = 25, "a joint's position and velocity contradict each other or its load"
    HELD = 26, "states were too old, and the last target held, for too much of a second"
    CLIPPED = 27, "a joint's target was beyond its torque for too long; the joint may be blocked"
    SWAPPED = 28, "another joint moved than the one that was swung; their encoders are swapped"
    STANDBY = 29, "the servo was silent for too long, and the standby process damped the joints"


_NOT_LATCHED = {
    Reason.NONE: FilterAction.PASS,
    Reason.OLD_STATE: FilterAction.HOLD,
    Reason.POSITION: FilterAction.LIMIT,
    Reason.CHANGE: FilterAction.LIMIT,
    Reason.TORQUE: FilterAction.LIMIT,
    Reason.POWER: FilterAction.LIMIT,
    Reason.NO_STATE: FilterAction.DAMP,
    Reason.DEAD_MAN: FilterAction.DAMP,
    Reason.ENDED: FilterAction.DAMP,
    Reason.HELD: FilterAction.DAMP,
}
# As plain numbers: members of an enumeration cost as much as a rule.
_LEVELS = np.array([int(reason.level) for reason in Reason])
_OLD_STATE, _POSITION, _CHANGE, _TORQUE, _POWER = range(Reason.OLD_STATE, Reason.POWER + 1)

_UNLIMITED = ("tilt", "measured_torque")
"""Limits that may be infinite."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of one robot. Arrays have the shape (joints,), in file order."""

    joints: tuple[str, ...]
    low: Array
    """Mechanical [rad]."""
    high: Array
    speed: Array
    """Largest measured speed [rad/s]."""
    torque: Array
    """Largest commanded torque [N m]."""
    stall: Array
    """Torque at standstill with the nominal bus voltage across the winding [N m]."""
    no_load: Array
    """Speed at which that torque is zero [rad/s]."""
    loss: Array
    """Winding loss per square of the joint's torque [W / (N m)^2]."""
    felt: Array
    """Change of the commanded torque that a joint shows by a bit at least [N m]."""
    measured_torque: float = math.inf
    """Largest measured torque of a joint, as a multiple of `torque`; infinite where it is not
    checked: a policy's landings exceed it for some milliseconds."""
    stiffness: float = 100.0
    """Largest of a command; five times that of any legged robot of this size [N m/rad]."""
    damping: float = 5.0
    """Largest of a command: the drives' protocol has the range 0 to 5 [N m s/rad]."""
    margin: float = 0.05
    """Between targets and the mechanical limits [rad]."""
    overrun: float = 0.15
    """Farther beyond its mechanical limit than this, a joint is a fault: its encoder has slipped. A
    Go2's calves rest 0.1 beyond when it lies folded [rad]."""
    horizon_s: float = 0.02
    """One policy step: a joint that would leave its limits in it is not driven further out [s]."""
    change: float = 1.0
    """Largest change of a target from one tick of the servo to the next [rad]. The largest steps
    of a jumping policy, 1.9 rad, arrive one tick late."""
    power_w: float = 5000.0
    """Largest bus power of a command, computed from the torques that the drives can give at their
    speeds, with winding losses and without recovery [W]. Twelve standing drives at their effort
    limits would take 4.4 kW."""
    tilt: float = 0.8
    """Largest angle of the trunk's z axis from the vertical [rad]; infinite for a hung robot."""
    temperature: float = 80.0
    """Of any motor, where it is measured [deg C]."""
    hold_s: float = 0.02
    """Age of the state from which the last target is held [s]."""
    damp_s: float = 0.05
    """Age of the state from which the joints are damped [s]."""
    latch_s: float = 0.1
    """Age of the state from which the fault is latched [s]."""
    future_s: float = 0.005
    """A state or command stamped farther ahead than this is of another clock [s]."""
    held_s: float = 0.1
    """Longest that targets are held in any second [s]."""
    clipped_s: float = 0.3
    """Longest that targets are limited by torque, twice the longest of a jumping policy [s]."""
    blocked_s: float = 0.2
    """Longest that the target of one joint is, in one direction, without its moving by `blocked`
    [s]. One take-off of 8,677 jumps took 0.146 s, all others 0.086 s at most."""
    blocked: float = 0.05
    """Motion that counts [rad]; most jumps limit a joint for 0.12 s, in which it moves by 0.7."""
    repeat_s: float = 0.04
    """Longest that attitude, gyro or accelerometer may repeat: an attitude of LCM may be 20 ms old.
    Also the time from which a constant position or velocity counts [s]."""
    attitude: float = 0.06
    """Between attitude and integral of the gyro; 1.7 times the largest of an hour [rad]."""
    turned: float = 0.03
    """Integral of the gyro from which the attitude must have moved too, by a quarter of it; the
    least is nine tenths [rad]."""
    upright: float = 0.5
    """Between the mean specific force and the attitude's vertical; twice the largest of an hour
    [rad]."""
    encoder: float = 0.18
    """Between position and integral of velocity; the largest is 0.13 with a third of the states
    lost, 0.01 with all of them [rad]."""
    moved: float = 0.005
    """Range of the integral of velocity at a constant position, or the reverse: three steps of an
    encoder of 12 bits [rad]."""
    others: float = 0.05
    """Sum of the displacements of other joints while one is constant for `repeat_s`; the largest is
    0.003, with encoders of 12 bits without noise [rad]."""
    expiry_s: float = 0.05
    """Longest that any command is repeated, whatever its own validity [s]."""
    lag: int = 30
    """Most states between the newest and the one that a command was computed from: three policy
    steps at 500 Hz."""

    def __post_init__(self) -> None:
        n = len(self.joints)
        for entry in fields(self)[1:]:
            value = getattr(self, entry.name)
            if entry.type == "Array":
                if np.shape(value) != (n,) or not np.isfinite(value).all():
                    raise RobotError(f"Limits.{entry.name} is {value}; expected {n} numbers.")
            elif not value > 0 or (math.isinf(value) and entry.name not in _UNLIMITED):
                raise RobotError(f"Limits.{entry.name} is {value}; it must be positive.")
        if not (self.high - self.low > 2.0 * self.margin).all():
            raise RobotError("Limits.margin leaves nothing between low and high; make it smaller.")
        if not self.hold_s <= self.damp_s <= self.latch_s:
            raise RobotError(
                f"ages {self.hold_s}, {self.damp_s}, {self.latch_s} s to hold, damp and latch; "
                "they must not fall."
            )

    @cached_property
    def measured(self) -> tuple[Array, Array]:
        """Least and largest position, velocity, torque and temperature. Each (4 joints,)."""
        torque, hot = self.torque * self.measured_torque, np.full_like(self.low, self.temperature)
        least = (self.low - self.overrun, -self.speed, -torque, np.full_like(hot, -np.inf))
        most = (self.high + self.overrun, self.speed, torque, hot)
        return np.concatenate(least), np.concatenate(most)

    @cached_property
    def gains(self) -> Array:
        """Largest stiffness and damping of a command. (2 joints,)."""
        return np.repeat([self.stiffness, self.damping], len(self.joints))

    @classmethod
    def of(cls, robot: RobotSpec, **changed: float) -> Limits:
        """The robot's ranges and effort limits, speeds 1.2 times the no-load speed (impacts).

        `changed` gives other values for the scalar fields.
        """
        drives = [joint.drive for joint in robot.joints]
        constants = ("gear_ratio", "torque_constant", "stall_torque", "bus_voltage")
        loss = [winding_loss(1.0, **{name: getattr(d, name) for name in constants}) for d in drives]
        low, high = np.array([joint.range for joint in robot.joints], dtype=float).T
        no_load = np.array([drive.no_load_speed for drive in drives])
        return cls(
            joints=robot.joint_names,
            low=low,
            high=high,
            speed=1.2 * no_load,
            torque=np.array([drive.effort_limit for drive in drives]),
            stall=np.array([drive.stall_torque for drive in drives]),
            no_load=no_load,
            loss=np.array(loss, dtype=float),
            # From one direction of slip to the other dry friction takes up twice its size; that
            # again for a drive whose friction is twice the nominal.
            felt=np.array([0.05 * d.effort_limit + 4.0 * d.frictionloss for d in drives]),
            **changed,  # type: ignore[arg-type]
        )


Mask = NDArray[np.bool_] | np.bool_

_SLACK = 1e-9
"""Tolerance for rounding, relative to a limit."""
_ABSURD = 1e6
"""No measured or commanded number of a robot is as large, in any unit used here."""
_NO_STIFFNESS = 1e-9
"""Stiffness below which a target moves nothing [N m/rad]."""


@dataclass(frozen=True, kw_only=True)
class SafetyInput:
    """Input of the rules: states (...,), and a command that broadcasts to them, of n joints.

    Units and frames as in `State` and `Command`; what is not measured is NaN. `position` to
    `temperature`, `target` to `last` are (..., n), `orientation` (..., 4), `gyro` (..., 3), the
    others (...,). Ages in seconds.
    """

    position: Array
    velocity: Array
    torque: Array
    temperature: Array
    orientation: Array
    gyro: Array
    state_age: Array | float
    target: Array
    stiffness: Array
    damping: Array
    last: Array
    """The target sent a tick ago, or the measured position after damping [rad]."""
    command_age: Array | float
    valid_for: Array | float
    lag: Array | float
    """States between the newest and the one that the command was computed from."""
    held: Mask | bool
    """Whether the dead-man button is held."""


class SafetyResult(NamedTuple):
    """Output of the rules: `FilterAction`, `Reason` (...,); the target if it is sent (..., n)."""

    level: NDArray[np.int64]
    reason: NDArray[np.int64]
    target: Array


def apply_rules(given: SafetyInput, limits: Limits) -> SafetyResult:
    """Apply all rules."""
    n = len(limits.joints)
    state_fine, seen = _finite(given.position, given.velocity, given.orientation, given.gyro)
    command_fine, wanted = _finite(given.target, given.stiffness, given.damping, given.last)
    q, v, quaternion = seen[..., :n], seen[..., n : 2 * n], seen[..., 2 * n : 2 * n + 4]
    target, kp, kd, last = (wanted[..., k * n : (k + 1) * n] for k in range(4))
    square = (quaternion * quaternion).sum(axis=-1)
    # The trunk's z axis against the world's: the last entry of the rotation matrix.
    sideways = quaternion[..., 1] ** 2 + quaternion[..., 2] ** 2
    upright = 1.0 - 2.0 * sideways / np.maximum(square, 0.5)
    state_age, command_age = np.asarray(given.state_age), np.asarray(given.command_age)
    hold = state_age > limits.hold_s
    if hold.any():
        target = np.where(hold[..., None], last, target)
    fitted, why, possible = fit(q, v, target, last, kp, kd, limits)

    # NaN, where a quantity is not measured, is within every limit.
    least, most = limits.measured
    quantities = np.concatenate((q, v, given.torque, given.temperature), axis=-1)
    outside = (quantities < least) | (quantities > most)
    beyond = np.asarray(outside.reshape(*q.shape[:-1], 4, n).any(axis=-1))
    gains = wanted[..., n : 3 * n]
    gains_wrong = ((gains < 0.0) | (gains > limits.gains)).any(axis=-1)
    # A quaternion far from unit length is no attitude.
    state_wrong = ~state_fine | np.isnan(state_age) | (np.abs(square - 1.0) > 0.1)
    command_wrong = ~command_fine | np.isnan(command_age) | np.isnan(given.valid_for)
    # The first that is met gives the reason.
    faults: tuple[tuple[Reason, Mask], ...] = (
        (Reason.STATE_NOT_FINITE, state_wrong),
        (Reason.COMMAND_NOT_FINITE, command_wrong),
        (Reason.GAINS, gains_wrong),
        (Reason.CLOCK, np.minimum(state_age, command_age) < -limits.future_s),
        (Reason.EXPIRED, command_age > np.minimum(given.valid_for, limits.expiry_s)),
        (Reason.STATE_LOST, state_age > limits.latch_s),
        (Reason.NO_STATE, state_age > limits.damp_s),
        (Reason.LAG, np.asarray(given.lag > limits.lag)),
        (Reason.OVERRUN, beyond[..., 0]),
        (Reason.TILT, upright < math.cos(min(limits.tilt, math.pi)) - _SLACK),
        (Reason.SPEED, beyond[..., 1]),
        (Reason.TEMPERATURE, beyond[..., 3]),
        # After the measurements, which explain more.
        (Reason.IMPOSSIBLE, ~possible),
        (Reason.DEAD_MAN, np.logical_not(given.held)),
        (Reason.OVERLOAD, beyond[..., 2]),
    )
    found = np.empty((*why.shape, len(faults)), dtype=np.bool_)
    for k, (_, met) in enumerate(faults):
        found[..., k] = met
    reason = np.where(hold, _OLD_STATE, why) if hold.any() else why
    if found.any():
        first = np.array([int(each) for each, _ in faults])[found.argmax(axis=-1)]
        reason = np.where(found.any(axis=-1), first, reason)
    return SafetyResult(level=_LEVELS[reason], reason=reason, target=fitted)


def _finite(*parts: Array) -> tuple[Mask, Array]:
    """Join parts; whether all numbers of a row are finite, and 0 for those that are not."""
    values = np.concatenate(parts, axis=-1)
    fine = np.abs(values) < _ABSURD  # false for NaN too
    return fine.all(axis=-1), (values if fine.all() else np.where(fine, values, 0.0))


def fit(
    q: Array, v: Array, target: Array, last: Array, kp: Array, kd: Array, limits: Limits
) -> tuple[Array, NDArray[np.int64], Mask]:
    """Move targets into all limits at once.

    Each limit gives an interval for each joint's target: within the mechanical limits by a margin
    (and no further out than the joint is, if it would leave them within the horizon), near the last
    target, and where `kp (target - q) - kd v` stays within the torque. The result is the point
    nearest to the given target in their intersection. If the bus power there is too large, all
    torques are scaled by one factor, the solution of a quadratic equation.

    Arguments (..., n) in rad and rad/s, gains not negative. Returns the targets (..., n); the limit
    that moved them, as a `Reason`, or 0 (...,); and whether any target is within all limits (...,).
    """
    stiff = kp > _NO_STIFFNESS
    divisor = np.where(stiff, kp, 1.0)
    soft, hard = limits.low + limits.margin, limits.high - limits.margin
    ahead = q + v * limits.horizon_s
    floor = np.where(ahead < soft, np.maximum(soft, q), soft)
    ceiling = np.where(ahead > hard, np.minimum(hard, q), hard)
    rest = q + kd * v / divisor
    reach = np.where(stiff, limits.torque / divisor, np.inf)
    intervals = (
        (_POSITION, floor, ceiling),
        (_CHANGE, last - limits.change, last + limits.change),
        (_TORQUE, rest - reach, rest + reach),
    )
    low = np.maximum(np.maximum(intervals[0][1], intervals[1][1]), intervals[2][1])
    high = np.minimum(np.minimum(intervals[0][2], intervals[1][2]), intervals[2][2])
    fitted = np.minimum(np.maximum(target, low), high)
    powerless = stiff | (kd * np.abs(v) <= limits.torque)
    possible: Mask = ((low <= high) & powerless).all(axis=-1)
    why = np.zeros(q.shape[:-1], dtype=np.int64)
    if (fitted != target).any():
        for name, bottom, top in intervals:
            why = np.where(((target < bottom) | (target > top)).any(axis=-1), name, why)

    given, work, loss = _torque_and_power(q, v, fitted, kp, kd, limits)
    much = work + loss > limits.power_w
    if not much.any():
        return fitted, why, possible
    # Both vanish together, and then there is nothing to scale.
    root = np.sqrt(work * work + 4.0 * loss * limits.power_w)
    share = np.where(much, 2.0 * limits.power_w / np.where(much, work + root, 1.0), 1.0)
    scaled = q + (given * share[..., None] + kd * v) / divisor
    scaled = np.minimum(np.maximum(scaled, low), high)
    fitted = np.where(much[..., None] & stiff, scaled, fitted)
    why = np.where(much, _POWER, why)
    _, work, loss = _torque_and_power(q, v, fitted, kp, kd, limits)
    possible &= work + loss <= limits.power_w * (1.0 + _SLACK)
    return fitted, why, possible


def _torque_and_power(
    q: Array, v: Array, target: Array, kp: Array, kd: Array, limits: Limits
) -> tuple[Array, Array, Array]:
    """The commanded torque, as far as back-EMF leaves voltage for it [N m] (..., n), and its power.

    That is the power done on the joints, nothing recovered from braking ones, and winding losses
    [W]. (...,) each.
    """
    low, high = voltage_limits(v, limits.stall, limits.no_load)
    torque = np.minimum(np.maximum(kp * (target - q) - kd * v, low), high)
    work: Array = np.maximum(torque * v, 0.0).sum(axis=-1)
    loss: Array = (torque * torque * limits.loss).sum(axis=-1)
    return torque, work, loss


_STUCK = 0.25
"""Least path of an attitude, as a share of the integral of the gyro."""
_ALL = 0.5
"""Share of a joint's limit that holds where all joints are constant."""
LAG_RATE_HZ = 500.0
"""States per second of which `Limits.lag` counts."""
LEAST_DAMPING_S = 1.0
"""Shortest time that a fault damps [s]."""


class Decision(NamedTuple):
    """Why the filter acts on a command; `detail` has joint and numbers of a new fault."""

    reason: Reason
    detail: str = ""

    @property
    def level(self) -> FilterAction:
        """What it does."""
        return self.reason.level

    @property
    def text(self) -> str:
        """One line."""
        return f"{self.reason.text} ({self.detail})" if self.detail else self.reason.text


@dataclass(kw_only=True)
class SafetyFilter:
    """Limits, and what lasts from one tick to the next. Times are on the machine's clock [s]."""

    limits: Limits
    state_rate_hz: float = LAG_RATE_HZ
    """States per second of the robot."""
    reason: Reason = Reason.NONE
    """Of the fault that lasts."""
    since: float = 0.0
    """When it began [s]."""
    last: Array | None = None
    """The target sent a tick ago [rad], (joints,); None after damping."""
    supervision: Supervision = field(init=False)
    """Of the states since the last damping."""
    _ticks: deque[tuple[float, float]] = field(init=False, default_factory=deque)
    """Time of ticks that held within the last second, and time since the tick before [s]."""
    _judged: float | None = None
    """Time of the last tick [s]; None after damping."""
    blocked: Array = field(init=False)
    """Time for which the target of each joint has been, without its moving [s]."""
    _pushed: Array | None = None
    """Direction in which each joint's target is limited by torque, or 0; None if none is."""
    _anchor: Array = field(init=False)
    """Where each of these joints has not moved from [rad]."""
    clipped: float = 0.0
    """Time for which targets have been limited by torque [s]."""

    def __post_init__(self) -> None:
        self.supervision = Supervision(len(self.limits.joints), self.state_rate_hz)
        self.blocked = self._anchor = np.zeros(len(self.limits.joints))

    @property
    def level(self) -> FilterAction:
        """`DAMP` or `LATCH` while a fault lasts, else `PASS`."""
        return self.reason.level

    @property
    def faulted(self) -> bool:
        """Whether a fault lasts."""
        return self.reason is not Reason.NONE

    def fault(self, reason: Reason, t: float) -> None:
        """Begin a fault, or make one more severe; one that is at least as severe stays."""
        if reason.level > self.level:
            self.since = self.since if self.faulted else t
            self.reason = reason

    def release(self, t: float, *, acknowledged: bool = False) -> None:
        """End a fault that has lasted long enough; a latched one only if `acknowledged`."""
        over = self.faulted and t - self.since >= LEAST_DAMPING_S
        if over and (acknowledged or self.level is FilterAction.DAMP):
            self.reason, self.last = Reason.NONE, None

    def damped(self) -> Decision:
        """Note a tick without a target; the next one is limited to near the measured position."""
        self.last = None
        self.supervision.begin()
        self._judged, self._pushed, self.clipped = None, None, 0.0
        return Decision(self.reason)

    def judge(
        self, states: Sequence[State], command: Command, t: float, *, held: bool = True
    ) -> tuple[Command | None, Decision]:
        """Apply the rules to one command; returns what to send, None for damping.

        `states` are those since the tick before, at least one, the newest last; a fault in any of
        them counts. `held` is the dead-man button.
        """
        result = apply_rules(self._input(states, command, t, held), self.limits)
        # A fault in any of the states decides; the newest if there is none.
        faulted = result.level >= int(FilterAction.DAMP)
        row = int(np.argmax(faulted)) if faulted.any() else -1
        found = Decision(Reason(int(result.reason[row])))
        if faulted.any():
            detail = _detail(found.reason, states[row], command, self.limits, t)
            found = found._replace(detail=detail)
        elif not self.faulted:
            wrong = self._supervise(states)
            found = wrong or self._persistent(found.reason, t, command, states[-1]) or found
        if self.faulted or found.level >= FilterAction.DAMP:
            detail = "" if self.faulted else found.detail
            self.fault(found.reason, t)
            return None, self.damped()._replace(detail=detail)
        self.last = result.target[-1]
        self.supervision.command(np.asarray(command.stiffness) * self.last)
        return replace(command, position=self.last), found

    def _supervise(self, states: Sequence[State]) -> Decision | None:
        """Supervise the new states; the first fault."""
        for state in states:
            self.supervision.observe(state)
            found = _contradiction(self.supervision, self.limits)
            if found is not None:
                return found
        return None

    def _persistent(
        self, reason: Reason, t: float, command: Command, state: State
    ) -> Decision | None:
        """Note a tick that holds or limits; a fault if it has been so for too long."""
        seconds, limits = 0.0 if self._judged is None else t - self._judged, self.limits
        self._judged = t
        while self._ticks and self._ticks[0][0] < t - 1.0:
            self._ticks.popleft()
        if reason is Reason.OLD_STATE:
            self._ticks.append((t, seconds))
            if (held := sum(each for _, each in self._ticks)) > limits.held_s:
                return Decision(Reason.HELD, f"{1e3 * held:.0f} ms")
        if reason is not Reason.TORQUE:
            self._pushed, self.clipped = None, 0.0
            return None
        self.clipped += seconds
        q = state.position
        torque = command.stiffness * (command.position - q) - command.damping * state.velocity
        pushed = np.where(np.abs(torque) > limits.torque, np.sign(torque), 0.0)
        before = np.zeros_like(pushed) if self._pushed is None else self._pushed
        fresh = (pushed != before) | (pushed == 0.0) | (np.abs(q - self._anchor) > limits.blocked)
        self._pushed, self._anchor = pushed, np.where(fresh, q, self._anchor)
        self.blocked = np.where(fresh, 0.0, self.blocked + seconds)
        i = int(np.argmax(self.blocked))
        if self.blocked[i] > limits.blocked_s:
            text = f"{limits.joints[i]}, for {1e3 * self.blocked[i]:.0f} ms without moving"
            return Decision(Reason.CLIPPED, text)
        if self.clipped > limits.clipped_s:
            return Decision(Reason.CLIPPED, f"{1e3 * self.clipped:.0f} ms")
        return None

    def _input(
        self, states: Sequence[State], command: Command, t: float, held: bool
    ) -> SafetyInput:
        n, newest = len(self.limits.joints), states[-1]
        sizes = dict.fromkeys(("position", "velocity", "torque", "temperature"), n)
        sizes |= {"orientation": 4, "gyro": 3}
        measured = {
            name: _rows([getattr(each, name) for each in states], size)
            for name, size in sizes.items()
        }
        return SafetyInput(
            **measured,
            state_age=t - newest.time,
            target=_rows([command.position], n),
            stiffness=_rows([command.stiffness], n),
            damping=_rows([command.damping], n),
            command_age=t - command.made,
            valid_for=float(command.valid_for),
            lag=(newest.sequence - command.state_sequence) * LAG_RATE_HZ / self.state_rate_hz
            if command.state_sequence >= 0
            else 0.0,
            last=measured["position"][-1:] if self.last is None else self.last[None],
            held=held,
        )


def _rows(rows: Sequence[object], count: int) -> Array:
    """Rows of numbers; a row that is not `count` numbers is all NaN. (rows, count)."""
    try:
        array = np.array(rows, dtype=float)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape == (len(rows), count):
        return array
    if len(rows) == 1 or all(row is None for row in rows):
        return np.full((len(rows), count), np.nan)
    return np.concatenate([_rows([row], count) for row in rows])


def _contradiction(seen: Supervision, limits: Limits) -> Decision | None:
    """What states say against each other, and the numbers; None if nothing."""
    joints, n = limits.joints, len(limits.joints)
    free = math.isfinite(limits.tilt)  # else the trunk is fixed, and may have no inertial unit
    if free:
        for name, seconds in seen.repeated.items():
            if seconds > limits.repeat_s:
                return Decision(Reason.REPEATED, f"{name}, for {1e3 * seconds:.0f} ms")
        path, turned = seen.paths
        if seen.attitude > limits.attitude:
            text = f"the gyro's integral is {seen.attitude:.2f} rad off"
            return Decision(Reason.ATTITUDE, text)
        if turned > limits.turned and path < _STUCK * turned:
            text = f"it is stuck while the gyro's integral is {turned:.2f} rad"
            return Decision(Reason.ATTITUDE, text)
        if seen.lean > limits.upright:
            text = f"the mean specific force is {seen.lean:.2f} rad off the vertical"
            return Decision(Reason.ATTITUDE, text)
    if (seen.encoder > limits.encoder).any():
        i = int(np.argmax(seen.encoder))
        return Decision(Reason.ENCODER, f"{joints[i]}, by {seen.encoder[i]:.2f} rad")
    constant = (seen.constant_s > limits.repeat_s).reshape(2, n)
    if not constant.any():
        return None
    both = constant.all(axis=0)
    alone = both & (seen.others > limits.others)
    if free and alone.any():
        i = int(np.argmax(alone))
        text = f"{joints[i]}, constant while others moved by {seen.others[i]:.2f} rad"
        return Decision(Reason.ENCODER, text)
    share = np.where(constant.all(axis=1), _ALL, 1.0)[:, None]
    excess = np.where(constant, seen.moved.reshape(2, n) / limits.moved, 0.0)
    if (excess > 1.0).any():
        kind, i = divmod(int(np.argmax(excess)), n)
        which = ("position", "velocity")[kind]
        return Decision(Reason.ENCODER, f"{joints[i]}, whose {which} is constant")
    unmoved = both & (seen.load > limits.felt * share.max())
    if not free:  # a robot on its stand may be simulated without some of its legs
        unmoved &= seen.live
    if unmoved.any():
        i = int(np.argmax(unmoved))
        text = f"{joints[i]}, constant while {seen.load[i]:.1f} N m were added"
        return Decision(Reason.ENCODER, text)
    return None


def _detail(reason: Reason, state: State, command: Command, limits: Limits, t: float) -> str:
    """The numbers behind a fault, where they add to its text."""
    q, v = np.asarray(state.position), np.asarray(state.velocity)
    if reason is Reason.SPEED:
        i = int(np.argmax(np.abs(v) - limits.speed))
        return f"{limits.joints[i]} {v[i]:.1f} of {limits.speed[i]:.1f} rad/s"
    if reason is Reason.OVERLOAD:
        i = int(np.nanargmax(np.abs(state.torque) - limits.torque * limits.measured_torque))
        return f"{limits.joints[i]} {state.torque[i]:.1f} of {limits.torque[i]:.1f} N m"
    if reason is Reason.OVERRUN:
        i = int(np.argmax(np.maximum(limits.low - q, q - limits.high)))
        return f"{limits.joints[i]} {q[i]:.2f}, of {limits.low[i]:.2f} to {limits.high[i]:.2f} rad"
    if reason is Reason.TEMPERATURE and state.temperature is not None:
        i = int(np.nanargmax(state.temperature))
        return f"{limits.joints[i]} {state.temperature[i]:.0f} of {limits.temperature:.0f} deg C"
    if reason is Reason.TILT:
        return f"{tilt(state.orientation):.2f} of {limits.tilt:.2f} rad"
    if reason in (Reason.EXPIRED, Reason.NO_STATE, Reason.STATE_LOST):
        since = command.made if reason is Reason.EXPIRED else state.time
        return f"{1e3 * (t - since):.0f} ms old"
    if reason is Reason.LAG:
        return f"{state.sequence - command.state_sequence} states"
    return ""


def tilt(orientation: Array) -> float:
    """Angle of the trunk's z axis from the vertical [rad].

    `orientation` is trunk to world, quaternion w, x, y, z. (4,)
    """
    _, x, y, _ = np.asarray(orientation) / np.linalg.norm(orientation)
    return float(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))
