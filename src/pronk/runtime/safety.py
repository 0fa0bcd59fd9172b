"""The safety filter: limits, rules and the memory from one tick to the next.

Everything is a pure function. The rules take arrays with any leading shape (...,) and joints last;
their order is the order of `Reason`: the first that faults gives the reason. A command passes
unchanged, or its target is moved into what all limits allow at once, or it is replaced by damping.
Gains are never changed: another stiffness is another robot.

A fault damps for at least one second. `released` clears a fault; a latched one needs an operator's
reset.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from pronk.actuator.model import voltage_limits, winding_loss
from pronk.errors import RobotError
from pronk.links.machine import Command, State
from pronk.robots.robot import Robot


class FilterAction(IntEnum):
    """What is done with a command, from nothing to all."""

    PASS = 0
    """Sent as it is."""
    LIMIT = 1
    """Sent with its target moved."""
    HOLD = 2
    """The last one is sent again."""
    DAMP = 3
    """The joints are damped, for a second at least and until somebody asks to stand again."""
    LATCH = 4
    """The joints are damped until a person has said that the fault is mended."""


class Reason(IntEnum):
    """Why. Those up to `POWER` move the target, or hold; the others damp."""

    NONE = 0
    OLD_STATE = 1
    POSITION = 2
    CHANGE = 3
    TORQUE = 4
    POWER = 5
    STATE_NOT_FINITE = 6
    COMMAND_NOT_FINITE = 7
    GAINS = 8
    CLOCK = 9
    EXPIRED = 10
    NO_STATE = 11
    STATE_LOST = 12
    LAG = 13
    OVERRUN = 14
    TILT = 15
    SPEED = 16
    TEMPERATURE = 17
    IMPOSSIBLE = 18
    DEAD_MAN = 19
    ENDED = 20
    LINK = 21
    OVERLOAD = 22

    @property
    def text(self) -> str:
        """The reason in one line."""
        return TEXTS[self]


TEXTS: dict[Reason, str] = {
    Reason.NONE: "nothing to object to",
    Reason.OLD_STATE: "the newest state is older than 20 ms; the last target is held",
    Reason.POSITION: "the target would drive a joint out of its limits; it was moved back",
    Reason.CHANGE: "the target jumps too far in one tick; it was slowed down",
    Reason.TORQUE: "the target asks for more torque than the drive may give; it was moved back",
    Reason.POWER: "the targets ask for more power than the battery may give; they were moved back",
    Reason.STATE_NOT_FINITE: "the state holds something that is not a number",
    Reason.COMMAND_NOT_FINITE: "the command holds something that is not a number",
    Reason.GAINS: "the command's gains are negative or beyond what the drives take",
    Reason.CLOCK: "a state or command is stamped in the future; the clocks disagree",
    Reason.EXPIRED: "the newest command has expired; is the policy's process alive?",
    Reason.NO_STATE: "no state for 50 ms",
    Reason.STATE_LOST: "no state for 100 ms; the link or the robot's program has stopped",
    Reason.LAG: "the command answers a state more than three policy steps old",
    Reason.OVERRUN: "a joint is beyond its mechanical limits; its encoder may have slipped",
    Reason.TILT: "the trunk is tilted too far",
    Reason.SPEED: "a joint turns faster than it can",
    Reason.TEMPERATURE: "a motor is too hot",
    Reason.IMPOSSIBLE: "no target meets all limits at once",
    Reason.DEAD_MAN: "the dead-man button is not held",
    Reason.ENDED: "the program that the operator sits at has gone",
    Reason.LINK: "the link reports a fault",
    Reason.OVERLOAD: "a joint's measured torque is beyond its limit",
}


Array = NDArray[np.float64]

_ARRAYS = ("low", "high", "speed", "torque", "stall", "no_load", "loss")


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Of one robot. Arrays have the shape (joints,), in file order."""

    joints: tuple[str, ...]
    low: Array
    """Mechanical [rad]."""
    high: Array
    """Mechanical [rad]."""
    speed: Array
    """Fastest that a joint may be seen to turn [rad/s]."""
    torque: Array
    """Largest that a command may ask for [N m]."""
    stall: Array
    """Torque at standstill with the nominal bus voltage across the winding [N m]."""
    no_load: Array
    """Speed at which nothing is left of it [rad/s]."""
    loss: Array
    """Winding loss of each joint, per square of its torque [W / (N m)^2]."""
    measured_torque: float = math.inf
    """Largest measured torque of any joint, as a multiple of `torque`; infinite where it is not
    checked: a policy's landings exceed it for some milliseconds."""
    stiffness: float = 100.0
    """Largest that a command may set; five times what any legged robot of this size runs
    [N m/rad]."""
    damping: float = 5.0
    """Largest that a command may set: the largest that the drives can encode (their protocol's
    range is 0 to 5) [N m s/rad]."""
    margin: float = 0.05
    """Kept between targets and the mechanical limits [rad]."""
    overrun: float = 0.15
    """A joint this far beyond its mechanical limit is a fault: an encoder that slipped. A Go2's
    calves rest 0.1 beyond when it lies folded [rad]."""
    horizon_s: float = 0.02
    """One policy step: a joint that would leave its limits in it is not driven further out [s]."""
    change: float = 1.0
    """Largest change of a target from one tick of the servo to the next [rad]. The largest steps
    of a jumping policy, 1.9 rad, arrive one tick late."""
    power_w: float = 5000.0
    """Largest bus power that a command may ask for, of what the drives can give at their speeds:
    winding losses counted, nothing recovered [W]. Twelve standing drives at their effort limits
    would take 4.4 kW."""
    tilt: float = 0.8
    """Largest angle of the trunk's z axis from the vertical [rad]; infinite for a hung robot."""
    temperature: float = 80.0
    """Of any motor, where it is measured [deg C]."""
    hold_s: float = 0.02
    """With a state older than this the last target is held [s]."""
    damp_s: float = 0.05
    """With a state older than this the joints are damped [s]."""
    latch_s: float = 0.1
    """With a state older than this they stay so until a person says otherwise [s]."""
    future_s: float = 0.005
    """A state or command stamped this far ahead is of another clock [s]."""
    expiry_s: float = 0.05
    """Longest that any command is repeated, whatever it says of itself [s]."""
    lag: int = 30
    """Most states between the newest and the one that a command answers: three policy steps at
    500 Hz."""

    def __post_init__(self) -> None:
        """Refuse limits that limit nothing.

        Raises:
            RobotError: One sentence that names the field.
        """
        for name in _ARRAYS:
            values = getattr(self, name)
            if np.shape(values) != (len(self.joints),) or not np.isfinite(values).all():
                raise RobotError(
                    f"Limits.{name} is {values}; expected {len(self.joints)} finite numbers."
                )
        if not (self.high - self.low > 2.0 * self.margin).all():
            raise RobotError("Limits.margin leaves no room between low and high; make it smaller.")
        for field in fields(self)[1 + len(_ARRAYS) :]:
            value = getattr(self, field.name)
            if not value > 0 or (
                math.isinf(value) and field.name not in ("tilt", "measured_torque")
            ):
                raise RobotError(f"Limits.{field.name} is {value}; it must be positive.")
        if not self.hold_s <= self.damp_s <= self.latch_s:
            raise RobotError(
                f"ages {self.hold_s}, {self.damp_s}, {self.latch_s} s to hold, damp and latch; "
                "they must not fall."
            )

    @classmethod
    def of(cls, robot: Robot, **changed: float) -> Limits:
        """The robot's own: ranges, effort limits, speeds a fifth above the no-load speed (impacts).

        Args:
            robot: The robot.
            changed: Other values for the scalar fields.
        """
        drives = [joint.drive for joint in robot.joints]
        loss = [
            winding_loss(
                1.0,
                gear_ratio=drive.gear_ratio,
                torque_constant=drive.torque_constant,
                stall_torque=drive.stall_torque,
                bus_voltage=drive.bus_voltage,
            )
            for drive in drives
        ]
        return cls(
            joints=robot.joint_names,
            low=np.array([joint.range[0] for joint in robot.joints]),
            high=np.array([joint.range[1] for joint in robot.joints]),
            speed=np.array([1.2 * drive.no_load_speed for drive in drives]),
            torque=np.array([drive.effort_limit for drive in drives]),
            stall=np.array([drive.stall_torque for drive in drives]),
            no_load=np.array([drive.no_load_speed for drive in drives]),
            loss=np.array(loss, dtype=float),
            **changed,  # type: ignore[arg-type]
        )


Mask = NDArray[np.bool_] | np.bool_

_SLACK = 1e-9
"""Rounding that a limit forgives, relative to it."""
_ABSURD = 1e6
"""No measured or requested number of a robot is as large, in any unit used here."""
_NO_STIFFNESS = 1e-9
"""Stiffness below which a target moves nothing [N m/rad]."""


@dataclass(frozen=True, kw_only=True)
class SafetyInput:
    """Input of the rules. Scalars have shape (...,)."""

    position: Array
    """Measured [rad]. (..., n)"""
    velocity: Array
    """Measured [rad/s]. (..., n)"""
    torque: Array
    """Measured [N m]; NaN where it is not. (..., n)"""
    orientation: Array
    """Trunk to world, unit quaternion w, x, y, z. (..., 4)"""
    gyro: Array
    """[rad/s] (..., 3)"""
    temperature: Array
    """Of the motors [deg C]; NaN where it is not measured. (..., n)"""
    state_age: Array
    """Since the newest state was measured [s]."""
    target: Array
    """Requested position [rad]. (..., n)"""
    stiffness: Array
    """[N m/rad] (..., n)"""
    damping: Array
    """[N m s/rad] (..., n)"""
    command_age: Array
    """Since the command was made [s]."""
    valid_for: Array
    """How long its maker lets it be repeated [s]."""
    lag: Array
    """States between the newest and the one that it answers; 0 where it answers none."""
    last: Array
    """The target sent a tick ago, or the measured position after damping [rad]. (..., n)"""
    held: Mask
    """Whether the dead-man button is held."""


@dataclass(frozen=True, kw_only=True)
class SafetyResult:
    """What comes of it."""

    level: NDArray[np.int64]
    """A `FilterAction`. (...,)"""
    reason: NDArray[np.int64]
    """A `Reason`. (...,)"""
    target: Array
    """To be sent where the level is below `DAMP` [rad]. (..., n)"""


def apply_rules(given: SafetyInput, limits: Limits) -> SafetyResult:
    """Every rule, in order."""
    n = given.position.shape[-1]
    numbers, fine = _clean(
        np.concatenate(
            [
                *(given.position, given.velocity, given.orientation, given.gyro),
                *(given.target, given.stiffness, given.damping, given.last),
            ],
            axis=-1,
        )
    )
    q, v, quaternion = numbers[..., :n], numbers[..., n : 2 * n], numbers[..., 2 * n : 2 * n + 4]
    measured = 2 * n + 7
    target, kp, kd, last = (
        numbers[..., measured + k * n : measured + (k + 1) * n] for k in range(4)
    )
    w, x, y, z = (quaternion[..., k] for k in range(4))
    square = w * w + x * x + y * y + z * z
    # The trunk's z axis against the world's: the last entry of the rotation matrix.
    upright = 1.0 - 2.0 * (x * x + y * y) / np.maximum(square, 0.5)
    hold = given.state_age > limits.hold_s
    target = np.where(hold[..., None], last, target)
    fitted, why, possible = fit(q, v, target, last, kp, kd, limits)

    faults: tuple[tuple[Reason, FilterAction, Mask], ...] = (
        (
            # A quaternion far from unit length is no attitude, whatever its numbers.
            Reason.STATE_NOT_FINITE,
            FilterAction.LATCH,
            ~fine[..., :measured].all(axis=-1)
            | (np.abs(square - 1.0) > 0.1)
            | np.isnan(given.state_age),
        ),
        (
            Reason.COMMAND_NOT_FINITE,
            FilterAction.LATCH,
            ~fine[..., measured:].all(axis=-1)
            | np.isnan(given.command_age)
            | np.isnan(given.valid_for),
        ),
        (
            Reason.GAINS,
            FilterAction.LATCH,
            ((kp < 0.0) | (kp > limits.stiffness) | (kd < 0.0) | (kd > limits.damping)).any(
                axis=-1
            ),
        ),
        (
            Reason.CLOCK,
            FilterAction.LATCH,
            np.minimum(given.state_age, given.command_age) < -limits.future_s,
        ),
        (
            Reason.EXPIRED,
            FilterAction.LATCH,
            given.command_age > np.minimum(given.valid_for, limits.expiry_s),
        ),
        (Reason.STATE_LOST, FilterAction.LATCH, given.state_age > limits.latch_s),
        (Reason.NO_STATE, FilterAction.DAMP, given.state_age > limits.damp_s),
        (Reason.LAG, FilterAction.LATCH, given.lag > limits.lag),
        (
            Reason.OVERRUN,
            FilterAction.LATCH,
            ((q < limits.low - limits.overrun) | (q > limits.high + limits.overrun)).any(axis=-1),
        ),
        (Reason.TILT, FilterAction.LATCH, upright < math.cos(min(limits.tilt, math.pi)) - _SLACK),
        (Reason.SPEED, FilterAction.LATCH, (np.abs(v) > limits.speed).any(axis=-1)),
        # Not measured is NaN, and NaN is not hot.
        (
            Reason.TEMPERATURE,
            FilterAction.LATCH,
            (given.temperature > limits.temperature).any(axis=-1),
        ),
        # Last of the measurements: the others say more about why nothing fits.
        (Reason.IMPOSSIBLE, FilterAction.LATCH, ~possible),
        (Reason.DEAD_MAN, FilterAction.DAMP, ~given.held),
        (
            Reason.OVERLOAD,
            FilterAction.LATCH,
            (np.abs(given.torque) > limits.torque * limits.measured_torque).any(axis=-1),
        ),
    )
    found = np.stack([met for _, _, met in faults], axis=-1)
    first = found.argmax(axis=-1)
    faulted = found.any(axis=-1)
    moved = why > 0
    level = np.where(
        hold, FilterAction.HOLD, np.where(moved, FilterAction.LIMIT, FilterAction.PASS)
    )
    reason = np.where(hold, Reason.OLD_STATE, why)
    return SafetyResult(
        level=np.where(faulted, np.array([how for _, how, _ in faults])[first], level),
        reason=np.where(faulted, np.array([what for what, _, _ in faults])[first], reason),
        target=fitted,
    )


def fit(
    q: Array, v: Array, target: Array, last: Array, kp: Array, kd: Array, limits: Limits
) -> tuple[Array, NDArray[np.int64], Mask]:
    """Move targets into all limits at once.

    Each limit leaves an interval for each joint's target: within the mechanical limits by a
    margin (and no further out than the joint is, if it would leave them within the horizon), near
    the last target, and where `kp (target - q) - kd v` stays within the torque. In what is common
    to them the nearest to the requested target is taken. If the bus would have to give too much
    power there, all torques are scaled down by one factor, the solution of a quadratic equation.

    Args:
        q: Measured positions [rad]. (..., n)
        v: Measured speeds [rad/s]. (..., n)
        target: SafetyInput [rad]. (..., n)
        last: Sent a tick ago [rad]. (..., n)
        kp: Stiffness, not negative [N m/rad]. (..., n)
        kd: Damping, not negative [N m s/rad]. (..., n)
        limits: The limits.

    Returns:
        Targets (..., n); the limit that moved them, as a `Reason`, the last one that did, or 0
        (...,); and whether there is such a target at all (...,).
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
        (Reason.POSITION, floor, ceiling),
        (Reason.CHANGE, last - limits.change, last + limits.change),
        (Reason.TORQUE, rest - reach, rest + reach),
    )
    low = np.maximum(np.maximum(intervals[0][1], intervals[1][1]), intervals[2][1])
    high = np.minimum(np.minimum(intervals[0][2], intervals[1][2]), intervals[2][2])
    fitted = np.minimum(np.maximum(target, low), high)
    possible = (low <= high).all(axis=-1)
    why = np.zeros(q.shape[:-1], dtype=np.int64)
    if (fitted != target).any():
        for name, bottom, top in intervals:
            out = ((target < bottom) | (target > top)).any(axis=-1)
            why = np.where(out, name, why)
    possible &= (stiff | (kd * np.abs(v) <= limits.torque)).all(axis=-1)

    given = _given(q, v, fitted, kp, kd, limits)
    work, loss = _work_and_loss(v, given, limits)
    much = work + loss > limits.power_w
    if not much.any():
        return fitted, why, possible
    # Both vanish together, and then there is nothing to scale.
    root = np.sqrt(work * work + 4.0 * loss * limits.power_w)
    share = np.where(much, 2.0 * limits.power_w / np.where(much, work + root, 1.0), 1.0)
    scaled = q + (given * share[..., None] + kd * v) / divisor
    scaled = np.minimum(np.maximum(scaled, low), high)
    fitted = np.where(much[..., None] & stiff, scaled, fitted)
    why = np.where(much, Reason.POWER, why)
    possible &= power(q, v, fitted, kp, kd, limits) <= limits.power_w * (1.0 + _SLACK)
    return fitted, why, possible


def power(q: Array, v: Array, target: Array, kp: Array, kd: Array, limits: Limits) -> Array:
    """Bus power that targets ask for: work done on the joints and winding losses [W]. (...,).

    Of torques that the drives can give at the joints' speeds with the nominal bus voltage; what
    braking joints give back is not counted.
    """
    work, loss = _work_and_loss(v, _given(q, v, target, kp, kd, limits), limits)
    return work + loss


def _given(q: Array, v: Array, target: Array, kp: Array, kd: Array, limits: Limits) -> Array:
    """The torque requested, as far as back-EMF leaves voltage for it [N m]. (..., n)."""
    low, high = voltage_limits(v, limits.stall, limits.no_load)
    return np.minimum(np.maximum(kp * (target - q) - kd * v, low), high)


def _work_and_loss(v: Array, torque: Array, limits: Limits) -> tuple[Array, Array]:
    work: Array = np.maximum(torque * v, 0.0).sum(axis=-1)
    loss: Array = (torque * torque * limits.loss).sum(axis=-1)
    return work, loss


def _clean(values: Array) -> tuple[Array, NDArray[np.bool_]]:
    """The values with zeros for what is no number of a robot, and where they are fine."""
    fine = np.abs(values) < _ABSURD  # false for NaN too
    return np.where(fine, values, 0.0), np.asarray(fine)


LEAST_DAMPING_S = 1.0
"""Shortest time that a fault damps [s]."""


@dataclass(frozen=True, kw_only=True)
class FilterState:
    """What the filter knows of the ticks before."""

    last: Array | None = None
    """The target sent a tick ago [rad], (joints,); None after damping."""
    level: FilterAction = FilterAction.PASS
    """`DAMP` or `LATCH` while a fault lasts."""
    reason: Reason = Reason.NONE
    """Of the fault that lasts."""
    since: float = 0.0
    """When it began [s]."""

    @property
    def faulted(self) -> bool:
        """Whether a fault lasts."""
        return self.level >= FilterAction.DAMP


@dataclass(frozen=True, kw_only=True)
class FilterDecision:
    """What the filter made of a command."""

    level: FilterAction
    reason: Reason
    detail: str = ""
    """Which joint and which numbers, for a new fault."""

    @property
    def text(self) -> str:
        """One line."""
        return f"{self.reason.text} ({self.detail})" if self.detail else self.reason.text


def filtered(
    state: State,
    command: Command,
    memory: FilterState,
    limits: Limits,
    t: float,
    *,
    held: bool = True,
    earlier: Sequence[State] = (),
) -> tuple[Command | None, FilterDecision, FilterState]:
    """Apply the rules to one command.

    Args:
        state: The newest.
        command: Requested.
        memory: From the tick before.
        limits: The limits.
        t: Now, on the machine's clock [s].
        held: Whether the dead-man button is held.
        earlier: Other states since the tick before; a fault in any of them counts.

    Returns:
        The command to send, None for damping; why; and the memory for the next tick.
    """
    n = len(limits.joints)
    states = (*earlier, state)
    rows = (len(states),)
    position = _stacked([each.position for each in states], n)
    last = position[-1] if memory.last is None else memory.last

    def alike(values: object, count: int) -> Array:
        return np.broadcast_to(_numbers(values, count), (*rows, count))

    result = apply_rules(
        SafetyInput(
            position=position,
            velocity=_stacked([each.velocity for each in states], n),
            torque=_stacked([each.torque for each in states], n),
            orientation=_stacked([each.orientation for each in states], 4),
            gyro=_stacked([each.gyro for each in states], 3),
            # Temperatures that are not measured are NaN, and NaN is below every limit.
            temperature=_stacked([each.temperature for each in states], n),
            state_age=np.full(rows, t - state.time),
            target=alike(command.position, n),
            stiffness=alike(command.stiffness, n),
            damping=alike(command.damping, n),
            command_age=np.full(rows, t - command.made),
            valid_for=np.full(rows, float(command.valid_for)),
            lag=np.full(
                rows, state.sequence - command.state_sequence if command.state_sequence >= 0 else 0
            ),
            last=np.broadcast_to(last, (*rows, n)),
            held=np.full(rows, held),
        ),
        limits,
    )
    # The worst of the states decides; the newest if none is worse.
    row = int(np.argmax(result.level >= FilterAction.DAMP)) if len(states) > 1 else 0
    if result.level[row] < FilterAction.DAMP:
        row = -1
    level, reason = FilterAction(int(result.level[row])), Reason(int(result.reason[row]))
    if memory.faulted:
        # A fault can only become worse.
        if level is FilterAction.LATCH and memory.level is FilterAction.DAMP:
            memory = replace(memory, level=level, reason=reason)
        lasting = FilterDecision(level=memory.level, reason=memory.reason)
        return None, lasting, replace(memory, last=None)
    if level >= FilterAction.DAMP:
        numbers = detail(reason, states[row], command, limits, t)
        decision = FilterDecision(level=level, reason=reason, detail=numbers)
        return None, decision, FilterState(level=level, reason=reason, since=t)
    target = result.target[-1]
    sent = replace(command, position=target)
    return sent, FilterDecision(level=level, reason=reason), FilterState(last=target)


def fault(memory: FilterState, level: FilterAction, reason: Reason, t: float) -> FilterState:
    """The memory with a fault that somebody else found; one that lasts is kept if it is as bad."""
    if memory.level >= level:
        return memory
    return FilterState(level=level, reason=reason, since=memory.since if memory.faulted else t)


def released(memory: FilterState, t: float, *, mended: bool = False) -> FilterState:
    """Forget a fault, if it may be forgotten.

    Args:
        memory: With or without a fault.
        t: Now [s].
        mended: A person's word that the cause is gone; a latched fault needs it.
    """
    if not memory.faulted or t - memory.since < LEAST_DAMPING_S:
        return memory
    return FilterState() if mended or memory.level is FilterAction.DAMP else memory


def detail(reason: Reason, state: State, command: Command, limits: Limits, t: float) -> str:
    """The numbers behind a fault, as far as they say more than its line."""
    q, v = np.asarray(state.position), np.asarray(state.velocity)
    if reason is Reason.SPEED:
        i = int(np.argmax(np.abs(v) - limits.speed))
        return f"{limits.joints[i]} {v[i]:.1f} of {limits.speed[i]:.1f} rad/s"
    if reason is Reason.OVERLOAD:
        excess = np.abs(state.torque) - limits.torque * limits.measured_torque
        i = int(np.nanargmax(excess))
        return f"{limits.joints[i]} {state.torque[i]:.1f} of {limits.torque[i]:.1f} N m"
    if reason is Reason.OVERRUN:
        i = int(np.argmax(np.maximum(limits.low - q, q - limits.high)))
        return f"{limits.joints[i]} {q[i]:.2f}, of {limits.low[i]:.2f} to {limits.high[i]:.2f} rad"
    if reason is Reason.TEMPERATURE and state.temperature is not None:
        i = int(np.nanargmax(state.temperature))
        return f"{limits.joints[i]} {state.temperature[i]:.0f} of {limits.temperature:.0f} deg C"
    if reason is Reason.TILT:
        return f"{tilt(state.orientation):.2f} of {limits.tilt:.2f} rad"
    if reason is Reason.EXPIRED:
        return f"{1e3 * (t - command.made):.0f} ms old"
    if reason in (Reason.NO_STATE, Reason.STATE_LOST):
        return f"{1e3 * (t - state.time):.0f} ms old"
    if reason is Reason.LAG:
        return f"{state.sequence - command.state_sequence} states"
    return ""


def tilt(orientation: Array) -> float:
    """Angle of the trunk's z axis from the vertical [rad].

    Args:
        orientation: Trunk to world, quaternion w, x, y, z. (4,)
    """
    _, x, y, _ = np.asarray(orientation) / np.linalg.norm(orientation)
    return float(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))


def _stacked(rows: Sequence[object], count: int) -> Array:
    return np.stack([_numbers(values, count) for values in rows])


def _numbers(values: object, count: int) -> Array:
    """The values as numbers; all NaN if they are not `count` numbers."""
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        return np.full(count, np.nan)
    return array if array.shape == (count,) else np.full(count, np.nan)
