"""Checks before a run. Every refusal is one sentence with its remedy.

`refusals` checks the states before anything moves. `delay_objection` checks the latency of the
policy later, when the robot stands and the policy is requested.

The link checks when it connects that no other program writes to the robot;
`pronk.policy.contract.check` checks the policy against the robot.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pronk.deploy.runtime.limits import Limits
from pronk.deploy.runtime.rules import tilt
from pronk.policy.rollout import projected_gravity
from pronk.robots.machine import State
from pronk.robots.robot import RobotSpec

RATE_SHARE = 0.6
"""Least share of the states that must arrive: with a third lost, a robot still walks."""
GRAVITY = 9.81
"""Specific force of a robot at rest [m/s^2]."""
GRAVITY_SLACK = 1.0
"""Largest difference of the median specific force of a robot at rest from it [m/s^2]."""
ATTITUDE_SLACK = 0.2
"""Largest angle between "up" by the accelerometer and by the attitude filter [rad]."""
NORM_SLACK = 0.02
"""Largest difference of the length of the attitude's quaternion from 1."""
REST_SPEED = 1.0
"""Fastest that a joint of a robot at rest may turn [rad/s]."""
CLOCK_SHARE = 0.3
"""Largest difference of the robot's clock and the times of arrival, as a share of the time of the
check: a pause of this computer of 0.1 s delays a state of half a second by 0.2 of it."""
BATTERY_SHARE = 0.85
"""Least share of the nominal bus voltage: a lithium battery is nearly empty there."""
_LIVE_S = 0.1
"""Time in which the sensors of a live robot change [s]."""
_LIVE_STATES = 10
"""Number of states in which the sensors of a live robot change."""


def refusals(
    states: Sequence[State],
    robot: RobotSpec,
    limits: Limits,
    *,
    now: float,
    seconds: float,
    state_rate_hz: float = 500.0,
) -> tuple[str, ...]:
    """Return why the robot must not move; empty if it may.

    Args:
        states: States of a robot to which nothing was sent, oldest first.
        robot: The robot.
        limits: Limits of the safety filter.
        now: Time of the check [s].
        seconds: Time before it in which the states were received [s].
        state_rate_hz: States that the robot sends per second.

    Returns:
        One sentence for each reason, with its remedy.
    """
    if len(states) < 2:
        return (
            f"{len(states)} states in {seconds:.1f} s; check the link, the network interface and "
            "that the robot's program runs.",
        )
    return (
        *_stream(states, limits, now, seconds, state_rate_hz),
        *_sensors(states, limits, seconds),
        *_attitude(states, limits),
        *_joints(states[-1], robot, limits),
        *_battery(states, robot),
        *_temperatures(states[-1], robot, limits),
    )


def _stream(
    states: Sequence[State], limits: Limits, now: float, seconds: float, expected: float
) -> Iterator[str]:
    """Check that enough states come, and that they are fresh."""
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
    oldest = states[0]
    newest = states[-1]
    if oldest.robot_time is not None and newest.robot_time is not None:
        arrived_s = newest.time - oldest.time
        stamped_s = newest.robot_time - oldest.robot_time
        if not abs(stamped_s - arrived_s) <= CLOCK_SHARE * seconds:
            yield (
                f"the robot's own clock advanced by {stamped_s:.3g} s while states arrived for "
                f"{arrived_s:.3g} s; it stands still, has jumped or counts in another unit, so "
                "correct it, or let the link leave `robot_time` out."
            )


def _sensors(states: Sequence[State], limits: Limits, seconds: float) -> Iterator[str]:
    """Check that the sensors are live and give numbers."""
    position = np.array([state.position for state in states])
    velocity = np.array([state.velocity for state in states])
    gyro = np.array([state.gyro for state in states])
    trunk = {
        "gyro": gyro,
        "accelerometer": np.array([state.accelerometer for state in states]),
        "orientation": np.array([state.orientation for state in states]),
    }
    if seconds >= _LIVE_S and len(states) > _LIVE_STATES:
        if (position == position[0]).all() and (gyro == gyro[0]).all():
            yield (
                "no number changed in all states, not even the gyro's noise; the sensors or the "
                "program that reads them have stopped."
            )
        elif limits.trunk_is_free:
            for name, values in trunk.items():
                if (values == values[0]).all():
                    yield (
                        f"the {name} did not change in all states; it has stopped, restart the "
                        "robot."
                    )
    measured = {"position": position, "velocity": velocity, **trunk}
    for name, values in measured.items():
        if not np.isfinite(values).all():
            yield f"the states' {name} holds something that is not a number; restart the robot."


def _attitude(states: Sequence[State], limits: Limits) -> Iterator[str]:
    """Check the attitude against gravity, and the tilt."""
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


def _joints(state: State, robot: RobotSpec, limits: Limits) -> Iterator[str]:
    """Check that every joint is in its range and at rest."""
    # Also of a sweep, whose own limit is tighter.
    overrun = robot.limits.overrun
    for i, joint in enumerate(robot.joints):
        position = float(state.position[i])
        velocity = float(state.velocity[i])
        low = limits.joints.low[i]
        high = limits.joints.high[i]
        if not low - overrun <= position <= high + overrun:
            yield (
                f"{joint.name} is at {position:.2f} rad, outside {low:.2f} to {high:.2f} rad; "
                "check that the robot and the layout of its messages are the ones that are named, "
                "then zero its encoder."
            )
        if not abs(velocity) <= REST_SPEED:
            yield f"{joint.name} turns at {velocity:.1f} rad/s; let the robot come to rest first."


def _battery(states: Sequence[State], robot: RobotSpec) -> Iterator[str]:
    """Check the voltage of the battery."""
    nominal = max(joint.drive.bus_voltage for joint in robot.joints)
    lowest = BATTERY_SHARE * nominal
    voltage = float(np.mean([state.bus_voltage for state in states]))
    # A link that does not carry the voltage gives NaN; 0 V is a measurement.
    if voltage < lowest:
        yield f"the battery gives {voltage:.1f} V, expected {lowest:.1f} V at least; charge it."


def _temperatures(state: State, robot: RobotSpec, limits: Limits) -> Iterator[str]:
    """Check the temperatures of the motors, where they are measured."""
    if state.temperature is None:
        return
    hottest = limits.operating.temperature
    for joint, degrees in zip(robot.joints, state.temperature, strict=True):
        if degrees > hottest:
            yield (
                f"the motor of {joint.name} has {degrees:.0f} deg C, expected {hottest:.0f} at "
                "most; let it cool."
            )


def delay_objection(latency_s: float, count: int, trained_delay_s: tuple[float, float]) -> str:
    """Return why the policy must not start, from the latency while standing; "" if it may.

    The latency from a state to the command computed from it is this computer's part of the command
    delay; the drives add theirs, so the lower end of the training range is not compared.

    Args:
        latency_s: Latency than which 95 % of the steps were faster [s].
        count: Number of steps.
        trained_delay_s: Range of training [s].
    """
    if count < 10:
        return "the policy's process has sent no action yet; wait a moment or see the events."
    longest_s = trained_delay_s[1]
    if latency_s > longest_s:
        return (
            f"state to command takes {1e3 * latency_s:.1f} ms (95 % of {count} steps), more than "
            f"the {1e3 * longest_s:.0f} ms that the policy was trained for; free the processor, "
            "grant real-time scheduling, or insist with --ignore-latency-check."
        )
    return ""
