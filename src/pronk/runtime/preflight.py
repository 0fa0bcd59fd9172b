"""What must be so before anything moves. Every refusal is one sentence that says what to do.

That nobody else writes to the robot is the link's to find out, when it connects. The policy
against the robot is `pronk.policy.contract.check`. What the states say is here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pronk.links.machine import State
from pronk.robots.robot import Robot
from pronk.runtime.safety import Limits, tilt

Array = NDArray[np.float64]

STATE_RATE_HZ = 500.0
"""States per second of the robots that pronk knows."""
RATE_SHARE = 0.6
"""Least share of those that must arrive: a link may lose a third and the robot still walks."""
GRAVITY = 9.81
GRAVITY_SLACK = 1.0
"""Between the median specific force of a robot at rest and gravity [m/s^2]."""
ATTITUDE_SLACK = 0.2
"""Between "up" by the accelerometer and by the attitude filter [rad]."""
NORM_SLACK = 0.02
"""Of the attitude's quaternion."""
OVERRUN = 0.15
"""Farthest that a joint may rest beyond its range: a Go2's calves do when it lies folded [rad]."""
REST_SPEED = 1.0
"""Fastest that a joint of a robot at rest may turn [rad/s]."""
BATTERY_SHARE = 0.85
"""Of the nominal bus voltage: a lithium battery is nearly empty there."""


def refusals(
    states: Sequence[State],
    robot: Robot,
    limits: Limits,
    *,
    now: float,
    seconds: float,
    rate_hz: float = STATE_RATE_HZ,
) -> tuple[str, ...]:
    """Why the robot must not move; empty if it may.

    Args:
        states: Those met while nothing was sent, oldest first.
        robot: What it shall be.
        limits: Of the safety filter.
        now: On the same clock as the states [s].
        seconds: How long was looked.
        rate_hz: States per second expected.
    """
    if len(states) < 2:
        return (
            f"{len(states)} states in {seconds:.1f} s; check the link, the network interface and "
            "that the robot's program runs.",
        )
    return tuple(
        sentence
        for check in (
            _stream(states, limits, now, seconds, rate_hz),
            _numbers(states),
            _attitude(states, limits),
            _joints(states, robot, limits),
            _supply(states, robot, limits),
        )
        for sentence in check
    )


def _stream(
    states: Sequence[State], limits: Limits, now: float, seconds: float, rate_hz: float
) -> Iterator[str]:
    rate = len(states) / seconds
    if rate < RATE_SHARE * rate_hz:
        yield (
            f"{rate:.0f} states per second, expected {rate_hz:.0f}; the link loses or delays too "
            "many, use a cable or another interface."
        )
    age = now - states[-1].time
    if age > limits.hold_s:
        yield (
            f"the newest state is {1e3 * age:.0f} ms old, expected {1e3 * limits.hold_s:.0f} at "
            "most; the stream has stopped or is queued somewhere."
        )
    if age < -limits.future_s:
        yield f"the newest state is {-1e3 * age:.0f} ms ahead of now; mend the link's clock."
    positions = np.array([state.position for state in states])
    if seconds >= 0.1 and len(states) > 10 and (positions == positions[0]).all():
        gyro = np.array([state.gyro for state in states])
        if (gyro == gyro[0]).all():
            yield (
                "no number changed in all states, not even the gyro's noise; the sensors or the "
                "program that reads them have stopped."
            )


def _numbers(states: Sequence[State]) -> Iterator[str]:
    for name in ("position", "velocity", "gyro", "accelerometer", "orientation"):
        if not all(np.isfinite(getattr(state, name)).all() for state in states):
            yield f"the states' {name} holds something that is not a number; restart the robot."


def _attitude(states: Sequence[State], limits: Limits) -> Iterator[str]:
    quaternion = np.asarray(states[-1].orientation)
    norm = float(np.linalg.norm(quaternion))
    if not abs(norm - 1.0) <= NORM_SLACK:
        yield f"the attitude's quaternion has the length {norm:.3f}, expected 1; nobody fills it."
        return
    # The median, so that one knock on the table does not decide.
    force = np.median([state.accelerometer for state in states], axis=0)
    size = float(np.linalg.norm(force))
    if not abs(size - GRAVITY) <= GRAVITY_SLACK:
        yield (
            f"the accelerometer reads {size:.2f} m/s^2 at rest, expected {GRAVITY}; check its unit "
            "and that the robot lies still."
        )
        return
    w, x, y, z = quaternion / norm
    up = np.array([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)])
    angle = float(np.arccos(np.clip(up @ force / size, -1.0, 1.0)))
    if angle > ATTITUDE_SLACK:
        yield (
            f"the attitude and gravity disagree by {angle:.2f} rad; check the order (w, x, y, z) "
            "and the axes of the attitude."
        )
    lean = tilt(quaternion)
    if lean > limits.tilt:
        yield (
            f"the trunk is tilted by {lean:.2f} rad, expected {limits.tilt:.2f} at most; put the "
            "robot on its feet or its belly."
        )


def _joints(states: Sequence[State], robot: Robot, limits: Limits) -> Iterator[str]:
    last = states[-1]
    for i, joint in enumerate(robot.joints):
        q, v = float(last.position[i]), float(last.velocity[i])
        low, high = limits.low[i] - OVERRUN, limits.high[i] + OVERRUN
        if not low <= q <= high:
            yield (
                f"{joint.name} is at {q:.2f} rad, outside {limits.low[i]:.2f} to "
                f"{limits.high[i]:.2f} rad; zero its encoder."
            )
        if not abs(v) <= REST_SPEED:
            yield f"{joint.name} turns at {v:.1f} rad/s; let the robot come to rest first."


def _supply(states: Sequence[State], robot: Robot, limits: Limits) -> Iterator[str]:
    nominal = max(joint.drive.bus_voltage for joint in robot.joints)
    volts = float(np.mean([state.bus_voltage for state in states]))
    # A link that does not carry the voltage gives 0 or NaN.
    if 0.0 < volts < BATTERY_SHARE * nominal:
        yield (
            f"the battery gives {volts:.1f} V, expected {BATTERY_SHARE * nominal:.1f} V at least; "
            "charge it."
        )
    hot = states[-1].temperature
    if hot is None:
        return
    for joint, degrees in zip(robot.joints, hot, strict=True):
        if degrees > limits.temperature:
            yield (
                f"the motor of {joint.name} has {degrees:.0f} deg C, expected "
                f"{limits.temperature:.0f} at most; let it cool."
            )


def delay_objection(latency_s: float, count: int, trained: tuple[float, float]) -> str:
    """Why the policy must not take over, from the latency measured while standing; "" if it may.

    From the state that a policy step answers to its command on the wire is the part of the command
    delay that this computer adds; the drives add theirs, so the lower end of what was trained for
    is not compared.

    Args:
        latency_s: 95 % of the steps were faster [s].
        count: Of how many steps.
        trained: Command delays that the policy was trained for [s].
    """
    if count < 10:
        return "the policy's process has not answered yet; wait a moment or look at the events."
    if latency_s > trained[1]:
        return (
            f"state to command takes {1e3 * latency_s:.1f} ms (95 % of {count} steps), more than "
            f"the {1e3 * trained[1]:.0f} ms that the policy was trained for; free the processor, "
            "grant real-time scheduling, or insist with --ignore-latency-check."
        )
    return ""
