"""Run a policy on a machine, real or virtual, under given commands.

Targets are sent with the gains of the robot's own drives, whatever gains the policy was trained
with, as on the paper's robot. The policy starts on a machine that stands in its default pose; its
history is filled with the first sample and its past actions are zero, as in training.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from pronk.arrays import Array
from pronk.errors import NotStandingError
from pronk.policy.contract import check
from pronk.policy.observation import Measurement
from pronk.policy.runtime import Policy
from pronk.policy.script import Commanded
from pronk.robots.machine import Command, Machine, State
from pronk.robots.robot import RobotSpec

Source = Callable[[float], Commanded]
"""The command at a time since the policy started [s]."""

MAX_STANDING_DEVIATION_RAD = 0.5
"""Largest distance of a standing robot's joint from its default position [rad]."""
MAX_STANDING_TILT_DEG = 30.0
"""Largest tilt of a standing robot's trunk [degrees]."""


def projected_gravity(orientation: Array) -> Array:
    """Return the unit vector of gravity in the trunk's frame, R^T (0, 0, -1), shape (3,).

    The orientation is trunk to world, a unit quaternion w, x, y, z.
    """
    w, x, y, z = orientation.tolist()
    return np.array([-2.0 * (x * z - w * y), -2.0 * (y * z + w * x), -1.0 + 2.0 * (x * x + y * y)])


def measurement(state: State) -> Measurement:
    """Return the policy's input from a state."""
    return Measurement(
        angular_velocity=state.gyro,
        projected_gravity=projected_gravity(state.orientation),
        position=state.position,
        velocity=state.velocity,
    )


def check_standing(robot: RobotSpec, state: State) -> None:
    """Check that a policy can start.

    Raises:
        NotStandingError: The robot does not stand in its default pose.
    """
    for joint, position in zip(robot.joints, state.position, strict=True):
        # NaN is not within the distance.
        if not abs(position - joint.default_position) <= MAX_STANDING_DEVIATION_RAD:
            raise NotStandingError(
                f"{joint.name} is at {position:.2f} rad; a policy starts on a robot that stands, "
                f"with this joint within {MAX_STANDING_DEVIATION_RAD:g} rad of "
                f"{joint.default_position:g}."
            )
    cosine = -float(projected_gravity(state.orientation)[2])
    if not cosine >= math.cos(math.radians(MAX_STANDING_TILT_DEG)):
        tilt_deg = math.degrees(math.acos(min(1.0, max(-1.0, cosine))))
        raise NotStandingError(
            f"the trunk is tilted by {tilt_deg:.0f} degrees; a policy starts on a robot that "
            f"stands, tilted by {MAX_STANDING_TILT_DEG:g} degrees at most."
        )


def ticks(
    machine: Machine, policy: Policy, robot: RobotSpec, source: Source, *, seconds: float = math.inf
) -> Iterator[float]:
    """Run a policy on a connected machine that stands in its default pose.

    The machine's clock waits between ticks until the caller takes the next one. A caller that stops
    leaves the latest targets in force and must damp or close the machine. Ticks that a real
    machine's clock has already passed are left out.

    Args:
        machine: The machine, connected.
        policy: The policy.
        robot: The robot, whose drives' gains are sent.
        source: Gives the command at a time since the policy started.
        seconds: How long the policy runs [s].

    Yields:
        After each command is sent, the time since the first tick [s].

    Raises:
        ArtefactError: The contract does not fit, before anything is sent; or a number is not
            finite.
        NotStandingError: The robot does not stand.
    """
    check(policy.contract, robot)
    policy.reset()
    stiffness = np.array([joint.stiffness for joint in robot.joints])
    damping = np.array([joint.damping for joint in robot.joints])
    rate_hz = policy.contract.policy_rate_hz
    check_standing(robot, machine.latest())
    begin = machine.now()
    tick = 0
    sequence = 0
    while tick < seconds * rate_hz - 1e-9:
        now = machine.now()
        state = machine.latest()
        velocity, jump = source(tick / rate_hz)
        command = Command(
            position=policy.step(measurement(state), velocity, jump),
            stiffness=stiffness,
            damping=damping,
            sequence=sequence,
            state_sequence=state.sequence,
            made=now,
        )
        machine.send(command)
        sequence += 1
        yield now - begin
        tick = max(tick + 1, math.ceil((machine.now() - begin) * rate_hz - 1e-6))
        machine.wait(begin + tick / rate_hz)
