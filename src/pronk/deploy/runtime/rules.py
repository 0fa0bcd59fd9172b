"""The rules of the safety filter: pure functions of the states, the command and the limits.

`apply_rules` takes arrays with any leading shape (...,) and joints last. Its faults have an order:
the first that is met gives the reason. A command passes unchanged, or its target is moved into the
range that all limits allow, or it is replaced by damping. Gains are never changed: a robot with
another stiffness is not the one that was matched.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.deploy.runtime.limits import Limits
from pronk.deploy.runtime.reasons import REASONS, Reason
from pronk.robots.motor import voltage_limits

Mask = NDArray[np.bool_] | np.bool_

_SLACK = 1e-9
"""Tolerance for rounding, relative to a limit."""
_ABSURD = 1e6
"""No measured or commanded number of a robot is as large, in any unit used here."""
_NO_STIFFNESS = 1e-9
"""Stiffness below which a target moves nothing [N m/rad]."""
_POWER_ROUNDS = 10
"""Largest number of times that torques are scaled to the power of all drives."""
_UNIT_SLACK = 0.1
"""Largest difference of a quaternion's square from 1 with which it is an attitude."""

# Plain numbers: members of an enumeration cost as much as a rule.
_ACTIONS = np.array([int(entry.action) for entry in REASONS])
_OLD_STATE = int(Reason.OLD_STATE)
_POSITION = int(Reason.POSITION)
_CHANGE = int(Reason.CHANGE)
_TORQUE = int(Reason.TORQUE)
_POWER = int(Reason.POWER)


@dataclass(frozen=True, kw_only=True)
class SafetyInput:
    """Input of the rules: states (...,), and a command that broadcasts to them, of n joints.

    Units and frames are those of `State` and `Command`; what is not measured is NaN.
    """

    position: Array
    """Measured positions [rad], (..., n)."""
    velocity: Array
    """Measured velocities [rad/s], (..., n)."""
    torque: Array
    """Measured torques [N m], (..., n)."""
    temperature: Array
    """Temperatures of the motors [deg C], (..., n)."""
    orientation: Array
    """Attitudes of the trunk, quaternions w, x, y, z, (..., 4)."""
    imu: Array
    """Angular velocities of the trunk [rad/s], then its specific forces [m/s^2], (..., 6)."""
    state_age: Array | float
    """Age of the newest state, positive for one in the past [s]."""
    target: Array
    """Joint targets of the command [rad], (..., n)."""
    stiffness: Array
    """Stiffness of the command [N m/rad], (..., n)."""
    damping: Array
    """Damping of the command [N m s/rad], (..., n)."""
    previous: Array
    """Target sent a tick ago, or the measured position after damping [rad], (..., n)."""
    command_age: Array | float
    """Age of the command [s]."""
    valid_for: Array | float
    """Time after which the command expires [s]."""
    lag: Array | float
    """States between the newest and the one that the command was computed from."""
    dead_man: Mask | bool
    """Whether the dead-man button is held."""


class SafetyResult(NamedTuple):
    """Output of the rules."""

    level: NDArray[np.int64]
    """`FilterAction`, (...,)."""
    reason: NDArray[np.int64]
    """`Reason`, (...,)."""
    target: Array
    """Joint targets, if they are sent [rad], (..., n)."""


def apply_rules(checked: SafetyInput, limits: Limits) -> SafetyResult:
    """Apply all rules to states and a command.

    Args:
        checked: States and command.
        limits: Limits that apply.

    Returns:
        What to do, why, and the target to send.
    """
    n = len(limits.joints.names)
    ages = limits.ages
    state_is_finite, state = _finite(
        checked.position, checked.velocity, checked.orientation, checked.imu
    )
    command_is_finite, command = _finite(checked.target, checked.stiffness, checked.damping)
    # What was sent is finite; the measured position after damping is a state's.
    previous_is_finite, previous = _finite(checked.previous)
    position = state[..., :n]
    velocity = state[..., n : 2 * n]
    quaternion = state[..., 2 * n : 2 * n + 4]
    target = command[..., :n]
    stiffness = command[..., n : 2 * n]
    damping = command[..., 2 * n :]
    state_age = np.asarray(checked.state_age)
    command_age = np.asarray(checked.command_age)

    lowest, highest = limits.far_targets
    is_far = ((target < lowest) | (target > highest)) & (stiffness > _NO_STIFFNESS)
    far_target = is_far.any(axis=-1)

    # The target: held if the state is old, then moved into all limits.
    hold = state_age > ages.hold_s
    if hold.any():
        target = np.where(hold[..., None], previous, target)
    limited, moved_by, possible = limit_targets(
        position, velocity, target, previous, stiffness, damping, limits
    )

    # The trunk's z axis against the world's: the last entry of the rotation matrix.
    square = (quaternion * quaternion).sum(axis=-1)
    sideways = quaternion[..., 1] ** 2 + quaternion[..., 2] ** 2
    upright = 1.0 - 2.0 * sideways / np.maximum(square, 0.5)
    least_upright = math.cos(min(limits.operating.tilt, math.pi)) - _SLACK
    # NaN, where a quantity is not measured, is within every limit.
    smallest, largest = limits.measured
    quantities = np.concatenate((position, velocity, checked.torque, checked.temperature), axis=-1)
    outside = (quantities < smallest) | (quantities > largest)
    beyond = np.asarray(outside.reshape(*position.shape[:-1], 4, n).any(axis=-1))
    gains = command[..., n:]
    bad_gains = ((gains < 0.0) | (gains > limits.gains)).any(axis=-1)
    # A quaternion far from unit length is no attitude.
    bad_state = ~state_is_finite | ~previous_is_finite | np.isnan(state_age)
    bad_state = bad_state | (np.abs(square - 1.0) > _UNIT_SLACK)
    bad_command = ~command_is_finite | np.isnan(command_age) | np.isnan(checked.valid_for)
    expiry = np.minimum(checked.valid_for, ages.expiry_s)

    # The order of the faults: the first that is met gives the reason.
    faults: tuple[tuple[Reason, Mask], ...] = (
        (Reason.STATE_NOT_FINITE, bad_state),
        (Reason.COMMAND_NOT_FINITE, bad_command),
        (Reason.GAINS, bad_gains),
        (Reason.FAR_TARGET, far_target),
        (Reason.CLOCK, np.minimum(state_age, command_age) < -ages.future_s),
        (Reason.EXPIRED, command_age > expiry),
        (Reason.STATE_LOST, state_age > ages.latch_s),
        (Reason.NO_STATE, state_age > ages.damp_s),
        (Reason.LAG, np.asarray(checked.lag > ages.lag)),
        (Reason.OVERRUN, beyond[..., 0]),
        (Reason.TILT, upright < least_upright),
        (Reason.SPEED, beyond[..., 1]),
        (Reason.TEMPERATURE, beyond[..., 3]),
        # After the measurements, which explain more.
        (Reason.IMPOSSIBLE, ~possible),
        (Reason.DEAD_MAN, np.logical_not(checked.dead_man)),
        (Reason.OVERLOAD, beyond[..., 2]),
    )
    is_fault = np.empty((*moved_by.shape, len(faults)), dtype=np.bool_)
    for column, (_, mask) in enumerate(faults):
        is_fault[..., column] = mask
    reason = np.where(hold, _OLD_STATE, moved_by) if hold.any() else moved_by
    if is_fault.any():
        order = np.array([int(fault_reason) for fault_reason, _ in faults])
        first = order[is_fault.argmax(axis=-1)]
        reason = np.where(is_fault.any(axis=-1), first, reason)
    return SafetyResult(level=_ACTIONS[reason], reason=reason, target=limited)


def _finite(*parts: Array) -> tuple[Mask, Array]:
    """Join parts; whether all numbers of a row are finite, and 0 for those that are not."""
    values = np.concatenate(parts, axis=-1)
    fine = np.abs(values) < _ABSURD  # false for NaN too
    return fine.all(axis=-1), (values if fine.all() else np.where(fine, values, 0.0))


def limit_targets(
    position: Array,
    velocity: Array,
    target: Array,
    previous: Array,
    stiffness: Array,
    damping: Array,
    limits: Limits,
) -> tuple[Array, NDArray[np.int64], Mask]:
    """Move targets into all limits at once.

    Each limit gives an interval for each joint's target. With `margin`, `horizon_s` and `change` of
    `OperatingLimits`, all positive, its `target_reach`, 0 or more, `low`, `high` and `torque` of
    `JointLimits`, and `ahead = position + velocity horizon_s`:

    - position: `floor <= target <= ceiling`, where `floor = low + margin - target_reach`, or, if
      `ahead` is below `low + margin`, `max(low + margin, position)`; and `ceiling = high - margin +
      target_reach`, or, if `ahead` is above `high - margin`, `min(high - margin, position)`. So a
      joint that leaves this range within the horizon is not driven further out.
    - change: `previous - change <= target <= previous + change`; with a `target_reach`, as far as
      the position interval is not beyond it, so that a joint that nears a limit is not driven on.
    - torque: `|stiffness (target - position) - damping velocity| <= torque`, which is
      `|target - (position + damping velocity / stiffness)| <= torque / stiffness`; a joint without
      stiffness has no such interval, and its damping alone must stay within the torque.

    The result is the point nearest to the target of the command in the intersection of the three.
    If the bus power there is larger than `OperatingLimits.power_w`, all torques are scaled by one
    factor, the solution of a quadratic equation. Towards no torque a target may then move by more
    than `change`: a change that makes torques smaller needs no limit, and one tick of a jump in
    which no target met both limits would let the robot fall.

    Args:
        position: Measured positions [rad], (..., n).
        velocity: Measured velocities [rad/s], (..., n).
        target: Targets of the command [rad], (..., n).
        previous: Targets sent a tick ago [rad], (..., n).
        stiffness: Stiffness of the command, not negative [N m/rad], (..., n).
        damping: Damping of the command, not negative [N m s/rad], (..., n).
        limits: Limits that apply.

    Returns:
        The targets (..., n); the limit that moved them, as a `Reason`, or 0 (...,); and whether any
        target is within all limits (...,).
    """
    joints = limits.joints
    operating = limits.operating
    is_stiff = stiffness > _NO_STIFFNESS
    divisor = np.where(is_stiff, stiffness, 1.0)
    lowest = joints.low + operating.margin
    highest = joints.high - operating.margin
    ahead = position + velocity * operating.horizon_s
    lowest_target = lowest - operating.target_reach
    highest_target = highest + operating.target_reach
    floor = np.where(ahead < lowest, np.maximum(lowest, position), lowest_target)
    ceiling = np.where(ahead > highest, np.minimum(highest, position), highest_target)
    without_torque = position + damping * velocity / divisor
    reach = np.where(is_stiff, joints.torque / divisor, np.inf)
    slowest = previous - operating.change
    fastest = previous + operating.change
    if operating.target_reach > 0.0:
        slowest = np.where(ahead > highest, np.minimum(slowest, ceiling), slowest)
        fastest = np.where(ahead < lowest, np.maximum(fastest, floor), fastest)
    least_torque = without_torque - reach
    largest_torque = without_torque + reach
    low, high = _intersection((floor, ceiling), (slowest, fastest), (least_torque, largest_torque))
    limited = np.minimum(np.maximum(target, low), high)
    torque_is_possible = is_stiff | (damping * np.abs(velocity) <= joints.torque)
    possible: Mask = ((low <= high) & torque_is_possible).all(axis=-1)
    moved_by = np.zeros(position.shape[:-1], dtype=np.int64)
    if (limited != target).any():
        intervals = (
            (_POSITION, floor, ceiling),
            (_CHANGE, slowest, fastest),
            (_TORQUE, least_torque, largest_torque),
        )
        # The last of them that the target lies outside of is the reason.
        for reason, bottom, top in intervals:
            is_outside = ((target < bottom) | (target > top)).any(axis=-1)
            moved_by = np.where(is_outside, reason, moved_by)

    torque, work, loss = _torque_and_power(position, velocity, limited, stiffness, damping, limits)
    excessive = work + loss > operating.power_w
    if not excessive.any():
        return limited, moved_by, possible
    moved_by = np.where(excessive, _POWER, moved_by)
    slowest = np.minimum(slowest, without_torque)
    fastest = np.maximum(fastest, without_torque)
    low, high = _intersection((floor, ceiling), (slowest, fastest), (least_torque, largest_torque))
    # A joint that turns faster than without load brakes, whatever its target, so that one round
    # may leave too much.
    for _ in range(_POWER_ROUNDS):
        # The share s of the torques solves s work + s^2 loss = power. Work and loss vanish
        # together, and then there is nothing to scale.
        root = np.sqrt(work * work + 4.0 * loss * operating.power_w)
        denominator = np.where(excessive, work + root, 1.0)
        share = np.where(excessive, 2.0 * operating.power_w / denominator, 1.0)
        scaled = position + (torque * share[..., None] + damping * velocity) / divisor
        scaled = np.minimum(np.maximum(scaled, low), high)
        limited = np.where(excessive[..., None] & is_stiff, scaled, limited)
        torque, work, loss = _torque_and_power(
            position, velocity, limited, stiffness, damping, limits
        )
        excessive = work + loss > operating.power_w * (1.0 + _SLACK)
        if not excessive.any():
            break
    possible &= ~excessive
    return limited, moved_by, possible


def _intersection(*intervals: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the lower and the upper ends of the intersection of intervals of targets [rad]."""
    low, high = intervals[0]
    for bottom, top in intervals[1:]:
        low = np.maximum(low, bottom)
        high = np.minimum(high, top)
    return low, high


def _torque_and_power(
    position: Array,
    velocity: Array,
    target: Array,
    stiffness: Array,
    damping: Array,
    limits: Limits,
) -> tuple[Array, Array, Array]:
    """Return the commanded torque, as far as back-EMF leaves voltage for it, and its power.

    The torque is in N m (..., n). The power is that done on the joints, nothing recovered from
    braking ones, and the winding losses [W], (...,) each.
    """
    low, high = voltage_limits(velocity, limits.joints.stall, limits.joints.no_load)
    wanted_torque = stiffness * (target - position) - damping * velocity
    torque = np.minimum(np.maximum(wanted_torque, low), high)
    work: Array = np.maximum(torque * velocity, 0.0).sum(axis=-1)
    loss: Array = (torque * torque * limits.joints.loss).sum(axis=-1)
    return torque, work, loss


def tilt(orientation: Array) -> float:
    """Return the angle of the trunk's z axis from the vertical [rad].

    `orientation` is trunk to world, a quaternion w, x, y, z. (4,)
    """
    _, x, y, _ = np.asarray(orientation) / np.linalg.norm(orientation)
    return float(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))
