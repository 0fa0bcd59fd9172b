"""Checks of the states before anything moves. Every refusal is one sentence with its remedy.

The link checks when it connects that no other program writes to the robot;
`pronk.policy.contract.check` checks the policy against the robot.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain

import numpy as np

from pronk.deploy.runtime.limits import Limits
from pronk.deploy.runtime.rules import tilt
from pronk.policy.rollout import projected_gravity
from pronk.robots.machine import State
from pronk.robots.robot import RobotSpec

RATE_SHARE = 0.6
"""Least share of the states that must arrive: with a third lost, a robot still walks."""
GRAVITY = 9.81
GRAVITY_SLACK = 1.0
"""Of the median specific force of a robot at rest [m/s^2]."""
ATTITUDE_SLACK = 0.2
"""Between "up" by the accelerometer and by the attitude filter [rad]."""
NORM_SLACK = 0.02
"""Of the attitude's quaternion."""
REST_SPEED = 1.0
"""Fastest that a joint of a robot at rest may turn [rad/s]."""
BATTERY_SHARE = 0.85
"""Of the nominal bus voltage: a lithium battery is nearly empty there."""


def refusals(
    states: Sequence[State],
    robot: RobotSpec,
    limits: Limits,
    *,
    now: float,
    seconds: float,
    state_rate_hz: float = 500.0,
) -> tuple[str, ...]:
    """Why the robot must not move; empty if it may.

    `states` were received in the last `seconds` before `now`, oldest first, while nothing was sent;
    the robot sends `state_rate_hz` a second.
    """
    if len(states) < 2:
        return (
            f"{len(states)} states in {seconds:.1f} s; check the link, the network interface and "
            "that the robot's program runs.",
        )
    stream = _stream(states, limits, now, seconds, state_rate_hz)
    checks = (stream, _attitude(states, limits))
    return tuple(chain(*checks, _joints_and_battery(states, robot, limits)))


def _stream(
    states: Sequence[State], limits: Limits, now: float, seconds: float, expected: float
) -> Iterator[str]:
    rate = len(states) / seconds
    if rate < RATE_SHARE * expected:
        yield (
            f"{rate:.0f} states per second, expected {expected:.0f}; the link loses or delays too "
            "many, use a cable or another interface."
        )
    age = now - states[-1].time
    if age > limits.ages.hold_s:
        yield (
            f"the newest state is {1e3 * age:.0f} ms old, expected at most "
            f"{1e3 * limits.ages.hold_s:.0f}; the stream has stopped or is queued somewhere."
        )
    if age < -limits.ages.future_s:
        yield f"the newest state is {-1e3 * age:.0f} ms ahead of now; correct the link's clock."
    measured = np.array([np.concatenate((state.position, state.gyro)) for state in states])
    if seconds >= 0.1 and len(states) > 10 and (measured == measured[0]).all():
        yield (
            "no number changed in all states, not even the gyro's noise; the sensors or the "
            "program that reads them have stopped."
        )
    elif seconds >= 0.1 and len(states) > 10 and limits.trunk_is_free:
        for name in ("gyro", "accelerometer", "orientation"):
            values = np.array([getattr(state, name) for state in states])
            if (values == values[0]).all():
                yield f"the {name} did not change in all states; it has stopped, restart the robot."
    for name in ("position", "velocity", "gyro", "accelerometer", "orientation"):
        if not np.isfinite([getattr(state, name) for state in states]).all():
            yield f"the states' {name} holds something that is not a number; restart the robot."


def _attitude(states: Sequence[State], limits: Limits) -> Iterator[str]:
    quaternion = np.asarray(states[-1].orientation)
    norm = float(np.linalg.norm(quaternion))
    if not abs(norm - 1.0) <= NORM_SLACK:
        yield f"the attitude's quaternion has the length {norm:.3f}, expected 1; it is not set."
        return
    # The median, so that one knock does not decide.
    force = np.median([state.accelerometer for state in states], axis=0)
    size = float(np.linalg.norm(force))
    if not abs(size - GRAVITY) <= GRAVITY_SLACK:
        yield (
            f"the accelerometer reads {size:.2f} m/s^2 at rest, expected {GRAVITY}; check its unit "
            "and that the robot lies still."
        )
        return
    up = -projected_gravity(quaternion / norm)
    angle = float(np.arccos(np.clip(up @ force / size, -1.0, 1.0)))
    if angle > ATTITUDE_SLACK:
        yield (
            f"the attitude and gravity disagree by {angle:.2f} rad; check the order (w, x, y, z) "
            "and the axes of the attitude."
        )
    lean = tilt(quaternion)
    if lean > limits.operating.tilt:
        yield (
            f"the trunk is tilted by {lean:.2f} rad, expected at most "
            f"{limits.operating.tilt:.2f}; put the robot on its feet or its belly."
        )


def _joints_and_battery(states: Sequence[State], robot: RobotSpec, limits: Limits) -> Iterator[str]:
    last = states[-1]
    # Also of a sweep, whose own limit is tighter.
    overrun = robot.limits.overrun
    for i, joint in enumerate(robot.joints):
        q, v = float(last.position[i]), float(last.velocity[i])
        if not limits.joints.low[i] - overrun <= q <= limits.joints.high[i] + overrun:
            yield (
                f"{joint.name} is at {q:.2f} rad, outside {limits.joints.low[i]:.2f} to "
                f"{limits.joints.high[i]:.2f} rad; zero its encoder."
            )
        if not abs(v) <= REST_SPEED:
            yield f"{joint.name} turns at {v:.1f} rad/s; let the robot come to rest first."
    least = BATTERY_SHARE * max(joint.drive.bus_voltage for joint in robot.joints)
    volts = float(np.mean([state.bus_voltage for state in states]))
    # A link that does not carry the voltage gives 0 or NaN.
    if 0.0 < volts < least:
        yield f"the battery gives {volts:.1f} V, expected {least:.1f} V at least; charge it."
    hot = last.temperature
    for joint, degrees in zip(robot.joints, () if hot is None else hot, strict=hot is not None):
        if degrees > limits.operating.temperature:
            yield (
                f"the motor of {joint.name} has {degrees:.0f} deg C, expected "
                f"{limits.operating.temperature:.0f} at most; let it cool."
            )


def delay_objection(latency_s: float, count: int, trained: tuple[float, float]) -> str:
    """Why the policy must not start, from the latency measured while standing; "" if it may.

    The latency from a state to the command computed from it is this computer's part of the command
    delay; the drives add theirs, so the lower end of the training range is not compared.

    95 % of `count` steps were faster than `latency_s`; `trained` is the range of training [s].
    """
    if count < 10:
        return "the policy's process has sent no action yet; wait a moment or see the events."
    if latency_s > trained[1]:
        return (
            f"state to command takes {1e3 * latency_s:.1f} ms (95 % of {count} steps), more than "
            f"the {1e3 * trained[1]:.0f} ms that the policy was trained for; free the processor, "
            "grant real-time scheduling, or insist with --ignore-latency-check."
        )
    return ""
