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
from pronk.errors import HardwareError
from pronk.policy.contract import check
from pronk.policy.observation import Measurement
from pronk.policy.runtime import Policy
from pronk.policy.script import Commanded
from pronk.robots.machine import Command, Machine, State
from pronk.robots.robot import RobotSpec

Source = Callable[[float], Commanded]
"""The command at a time since the policy started [s]."""

NEAR = 0.5
"""Farthest that a joint of a standing robot may be from its default position [rad]."""
UPRIGHT = math.cos(math.radians(30.0))
"""Least cosine of the tilt of a standing robot."""


def projected_gravity(orientation: Array) -> Array:
    """Unit vector of gravity in the trunk's frame, R^T (0, 0, -1). (3,).

    `orientation` is trunk to world, unit quaternion w, x, y, z.
    """
    w, x, y, z = orientation.tolist()
    return np.array([-2.0 * (x * z - w * y), -2.0 * (y * z + w * x), -1.0 + 2.0 * (x * x + y * y)])


def measurement(state: State) -> Measurement:
    """The policy's input from a state."""
    return Measurement(
        angular_velocity=state.gyro,
        projected_gravity=projected_gravity(state.orientation),
        position=state.position,
        velocity=state.velocity,
    )


def check_standing(robot: RobotSpec, state: State) -> None:
    """Check that a policy can start.

    Raises:
        HardwareError: The robot does not stand in its default pose.
    """
    for joint, position in zip(robot.joints, state.position, strict=True):
        if not abs(position - joint.default_position) <= NEAR:
            raise HardwareError(
                f"{joint.name} is at {position:.2f} rad; a policy starts on a robot that stands, "
                f"with this joint within {NEAR:g} rad of {joint.default_position:g}."
            )
    upright = -float(projected_gravity(state.orientation)[2])
    if not upright >= UPRIGHT:
        tilt = math.degrees(math.acos(min(1.0, max(-1.0, upright))))
        raise HardwareError(
            f"the trunk is tilted by {tilt:.0f} degrees; a policy starts on a robot that stands, "
            "tilted by 30 degrees at most."
        )


def ticks(
    machine: Machine, policy: Policy, robot: RobotSpec, source: Source, *, seconds: float = math.inf
) -> Iterator[float]:
    """Run a policy on a connected machine that stands in its default pose.

    After each command is sent, yields the time since the first tick [s]. The machine's clock waits
    between ticks until the caller takes the next one. A caller that stops leaves the last targets
    in force and must damp or close the machine. Ticks that a real machine's clock has already
    passed are left out. The policy runs for `seconds`, with the commands of `source`.

    Raises:
        ArtefactError: The contract does not fit, before anything is sent; or a number is not
            finite.
        HardwareError: The robot does not stand.
    """
    check(policy.contract, robot)
    policy.reset()
    stiffness = np.array([joint.stiffness for joint in robot.joints])
    damping = np.array([joint.damping for joint in robot.joints])
    rate = policy.contract.policy_rate_hz
    check_standing(robot, machine.latest())
    began, count, sent = machine.now(), 0, 0
    while count < seconds * rate - 1e-9:
        now, state = machine.now(), machine.latest()
        command = Command(
            position=policy.step(measurement(state), *source(count / rate)),
            stiffness=stiffness,
            damping=damping,
            sequence=sent,
            state_sequence=state.sequence,
            made=now,
        )
        machine.send(command)
        sent += 1
        yield now - began
        count = max(count + 1, math.ceil((machine.now() - began) * rate - 1e-6))
        machine.wait(began + count / rate)
