"""The rules of the safety filter, for one command or for a million at once.

Everything here is a pure function of arrays with any leading shape (...,) and joints last. The
order of the rules is the order of `Reason`: the first that faults gives the reason.

What is asked goes through as it is, or with its target moved into what all limits allow at once,
or it is replaced by damping. Gains are never touched: another stiffness is another robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.runtime.limits import Limits
from pronk.runtime.reasons import Level, Reason

Array = NDArray[np.float64]
Mask = NDArray[np.bool_] | np.bool_

_SLACK = 1e-9
"""Rounding that a limit forgives, relative to it."""
_ABSURD = 1e6
"""No measured or asked number of a robot is as large, in any unit used here."""
_NO_STIFFNESS = 1e-9
"""Stiffness below which a target moves nothing [N m/rad]."""


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What the rules are asked about. Scalars have shape (...,)."""

    position: Array
    """Measured [rad]. (..., n)"""
    velocity: Array
    """Measured [rad/s]. (..., n)"""
    orientation: Array
    """Trunk to world, unit quaternion w, x, y, z. (..., 4)"""
    gyro: Array
    """[rad/s] (..., 3)"""
    temperature: Array
    """Of the motors [deg C]; NaN where it is not measured. (..., n)"""
    state_age: Array
    """Since the newest state was measured [s]."""
    target: Array
    """Asked [rad]. (..., n)"""
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
class Judged:
    """What comes of it."""

    level: NDArray[np.int64]
    """A `Level`. (...,)"""
    reason: NDArray[np.int64]
    """A `Reason`. (...,)"""
    target: Array
    """To be sent where the level is below `DAMP` [rad]. (..., n)"""


def judge(asked: Asked, limits: Limits) -> Judged:
    """Every rule, in order."""
    n = asked.position.shape[-1]
    numbers, fine = _clean(
        np.concatenate(
            [
                *(asked.position, asked.velocity, asked.orientation, asked.gyro),
                *(asked.target, asked.stiffness, asked.damping, asked.last),
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
    ages = asked.state_age + asked.command_age + asked.valid_for  # not a number if any is not
    hold = asked.state_age > limits.hold_s
    target = np.where(hold[..., None], last, target)
    fitted, why, possible = fit(q, v, target, last, kp, kd, limits)

    faults: tuple[tuple[Reason, Level, Mask], ...] = (
        (
            # A quaternion far from unit length is no attitude, whatever its numbers.
            Reason.STATE_NOT_FINITE,
            Level.LATCH,
            ~fine[..., :measured].all(axis=-1)
            | (np.abs(square - 1.0) > 0.1)
            | np.isnan(asked.state_age),
        ),
        (
            Reason.COMMAND_NOT_FINITE,
            Level.LATCH,
            ~fine[..., measured:].all(axis=-1) | np.isnan(ages),
        ),
        (
            Reason.GAINS,
            Level.LATCH,
            ((kp < 0.0) | (kp > limits.stiffness) | (kd < 0.0) | (kd > limits.damping)).any(
                axis=-1
            ),
        ),
        (
            Reason.CLOCK,
            Level.LATCH,
            np.minimum(asked.state_age, asked.command_age) < -limits.future_s,
        ),
        (
            Reason.EXPIRED,
            Level.LATCH,
            asked.command_age > np.minimum(asked.valid_for, limits.expiry_s),
        ),
        (Reason.STATE_LOST, Level.LATCH, asked.state_age > limits.latch_s),
        (Reason.NO_STATE, Level.DAMP, asked.state_age > limits.damp_s),
        (Reason.LAG, Level.LATCH, asked.lag > limits.lag),
        (
            Reason.OVERRUN,
            Level.LATCH,
            ((q < limits.low - limits.overrun) | (q > limits.high + limits.overrun)).any(axis=-1),
        ),
        (Reason.TILT, Level.LATCH, upright < math.cos(min(limits.tilt, math.pi)) - _SLACK),
        (Reason.SPEED, Level.LATCH, (np.abs(v) > limits.speed).any(axis=-1)),
        # Not measured is NaN, and NaN is not hot.
        (Reason.TEMPERATURE, Level.LATCH, (asked.temperature > limits.temperature).any(axis=-1)),
        # Last of the measurements: the others say more about why nothing fits.
        (Reason.IMPOSSIBLE, Level.LATCH, ~possible),
        (Reason.DEAD_MAN, Level.DAMP, ~asked.held),
    )
    found = np.stack([met for _, _, met in faults], axis=-1)
    first = found.argmax(axis=-1)
    faulted = found.any(axis=-1)
    moved = why > 0
    level = np.where(hold, Level.HOLD, np.where(moved, Level.LIMIT, Level.PASS))
    reason = np.where(hold, Reason.OLD_STATE, why)
    return Judged(
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
    to them the nearest to the asked target is taken. If the bus would have to give too much power
    there, all torques are scaled down by one factor, the solution of a quadratic equation.

    Args:
        q: Measured positions [rad]. (..., n)
        v: Measured speeds [rad/s]. (..., n)
        target: Asked [rad]. (..., n)
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
    """The torque asked, as far as back-EMF leaves voltage for it [N m]. (..., n)."""
    share = v / limits.no_load
    torque = kp * (target - q) - kd * v
    return np.minimum(
        np.maximum(torque, limits.stall * (-1.0 - share)), limits.stall * (1.0 - share)
    )


def _work_and_loss(v: Array, torque: Array, limits: Limits) -> tuple[Array, Array]:
    work: Array = np.maximum(torque * v, 0.0).sum(axis=-1)
    loss: Array = (torque * torque * limits.loss).sum(axis=-1)
    return work, loss


def _clean(values: Array) -> tuple[Array, NDArray[np.bool_]]:
    """The values with zeros for what is no number of a robot, and where they are fine."""
    fine = np.abs(values) < _ABSURD  # false for NaN too
    return np.where(fine, values, 0.0), np.asarray(fine)
