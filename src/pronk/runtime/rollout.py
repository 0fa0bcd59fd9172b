"""Run a policy on a machine, real or virtual, under commands that a source gives.

    flown = run_policy(machine, policy, robot, script.commanded, seconds=script.seconds)

On every tick of the policy's clock it reads the machine's newest state, makes the measurement of
it, asks the source what is wanted, and sends the policy's joint targets with the gains that are
set on the robot's own drives, whatever gains the policy was trained with: that is how the paper's
robot runs.

How it takes over: the machine stands in its default pose, held by its drives (as after
`Machine.connect`); the history of the policy is filled with the first sample and its past actions
count as zero, which is how every episode of training begins.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pronk.errors import HardwareError
from pronk.links.machine import Command, Machine, State
from pronk.policy.contract import check
from pronk.policy.observation import Measurement
from pronk.policy.runtime import Policy
from pronk.robots.robot import Robot
from pronk.runtime.script import Commanded, Velocity

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Source = Callable[[float], Commanded]
"""The command at a time since the policy took over [s]."""

NEAR = 0.5
"""Furthest that a joint of a standing robot may be from its default position [rad]."""
UPRIGHT = math.cos(math.radians(30.0))
"""Least cosine of the tilt of a standing robot."""


def projected_gravity(orientation: Array) -> Array:
    """Unit vector of gravity in the trunk's frame, R^T (0, 0, -1). (3,).

    Args:
        orientation: Trunk to world, unit quaternion w, x, y, z. (4,)
    """
    w, x, y, z = orientation.tolist()
    return np.array([-2.0 * (x * z - w * y), -2.0 * (y * z + w * x), -1.0 + 2.0 * (x * x + y * y)])


def measurement(state: State) -> Measurement:
    """What a policy reads of a state."""
    return Measurement(
        angular_velocity=state.gyro,
        projected_gravity=projected_gravity(state.orientation),
        position=state.position,
        velocity=state.velocity,
    )


def hold(robot: Robot, position: Array | None = None) -> Command:
    """The command that holds a pose with the gains of the robot's own drives.

    Args:
        robot: Whose.
        position: Joint positions [rad], (joints,); None for the default pose.
    """
    default = np.array([joint.default_position for joint in robot.joints])
    return Command(
        position=default if position is None else position,
        stiffness=np.array([joint.stiffness for joint in robot.joints]),
        damping=np.array([joint.damping for joint in robot.joints]),
    )


def check_standing(robot: Robot, state: State) -> None:
    """See that a policy can take over.

    Raises:
        HardwareError: The robot does not stand in its default pose; the sentence names what.
    """
    for joint, position in zip(robot.joints, state.position, strict=True):
        if not abs(position - joint.default_position) <= NEAR:
            raise HardwareError(
                f"{joint.name} is at {position:.2f} rad; a policy takes over a robot that stands, "
                f"with this joint within {NEAR:g} rad of {joint.default_position:g}."
            )
    upright = -float(projected_gravity(state.orientation)[2])
    if not upright >= UPRIGHT:
        tilt = math.degrees(math.acos(min(1.0, max(-1.0, upright))))
        raise HardwareError(
            f"the trunk is tilted by {tilt:.0f} degrees; a policy takes over a robot that stands, "
            "tilted by 30 degrees at most."
        )


@dataclass(frozen=True, kw_only=True)
class Tick:
    """One decision."""

    time: float
    """When it was made, on the machine's clock [s]."""
    since: float
    """The same, since the policy took over [s]."""
    command: Velocity
    """Commanded: forward, left [m/s], yaw rate [rad/s]."""
    jump: bool
    state: State
    """What it answers."""
    action: Array
    """As the network gave it. (12,)"""
    target: Array
    """Joint position targets that were sent [rad]. (12,)"""
    contact: Array
    """Estimated probability that each foot touches the ground. (4,)"""
    linear_velocity: Array
    """Estimated, of the trunk in its frame [m/s]. (3,)"""


class PolicyRunner:
    """A policy at the stick of one robot: a state in, a command out."""

    def __init__(self, policy: Policy, robot: Robot) -> None:
        """Check that the policy is for this robot, and forget its past.

        Raises:
            ArtefactError: Its contract does not fit; the sentence names the field.
        """
        check(policy.contract, robot)
        self.policy = policy
        self.robot = robot
        self._hold = hold(robot)
        self.reset()

    def reset(self) -> None:
        """Begin anew: the next state is taken for the whole past."""
        self.policy.reset()
        self._sequence = 0
        self._began: float | None = None

    def decide(self, state: State, commanded: Commanded, now: float) -> tuple[Command, Tick]:
        """One policy step; call it at `policy.contract.policy_rate_hz`.

        Args:
            state: The newest.
            commanded: Velocity command and jump input.
            now: The machine's clock [s].

        Returns:
            What to send, and the record of it.

        Raises:
            ArtefactError: Something is not finite, or a policy without jump is commanded to jump.
        """
        if self._began is None:
            self._began = now
        velocity, jump = commanded
        target = self.policy.step(measurement(state), velocity, jump)
        inference = self.policy.inference
        assert inference is not None
        command = Command(
            position=target,
            stiffness=self._hold.stiffness,
            damping=self._hold.damping,
            sequence=self._sequence,
            state_sequence=state.sequence,
            made=now,
        )
        self._sequence += 1
        tick = Tick(
            time=now,
            since=now - self._began,
            command=velocity,
            jump=jump,
            state=state,
            action=inference.action[0].astype(float),
            target=target,
            contact=inference.contact[0].astype(float),
            linear_velocity=inference.linear_velocity[0].astype(float),
        )
        return command, tick


def ticks(
    machine: Machine, policy: Policy, robot: Robot, source: Source, *, seconds: float = math.inf
) -> Iterator[Tick]:
    """Run a policy on a connected, standing machine; gives each tick after its command is sent.

    The next step of the machine's clock waits until the caller asks for the next tick, so a live
    viewer sits in the loop. Whoever stops asking leaves the last targets in force: damp or close
    the machine then. Ticks that a real machine's clock has already passed are left out.

    Args:
        machine: Connected, in its default pose.
        policy: Whose contract fits the robot.
        robot: What the machine is.
        source: The command, by the time since the first tick [s].
        seconds: Time to run [s]; endless if infinite.

    Raises:
        ArtefactError: The contract does not fit, before anything is sent; or a number is not
            finite.
        HardwareError: The robot does not stand.
    """
    runner = PolicyRunner(policy, robot)
    rate = policy.contract.policy_rate_hz
    check_standing(robot, machine.latest())
    began, count = machine.now(), 0
    while count < seconds * rate - 1e-9:
        now = machine.now()
        command, tick = runner.decide(machine.latest(), source(count / rate), now)
        machine.send(command)
        yield tick
        count = max(count + 1, math.ceil((machine.now() - began) * rate - 1e-6))
        machine.wait(began + count / rate)


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """What a policy decided in one run: one row for each tick, T of them."""

    began: float
    """When the policy took over, on the machine's clock [s]."""
    time: Array
    """Of each decision, since then [s]. (T,)"""
    command: Array
    """Commanded: forward, left [m/s], yaw rate [rad/s]. (T, 3)"""
    jump: Mask
    """(T,)"""
    state_sequence: NDArray[np.int64]
    """`State.sequence` of the state that each decision answers. (T,)"""
    state_time: Array
    """Its timestamp, on the machine's clock [s]. (T,)"""
    angular_velocity: Array
    """Measured, trunk's frame [rad/s]. (T, 3)"""
    projected_gravity: Array
    """Measured, trunk's frame. (T, 3)"""
    position: Array
    """Of the joints, measured [rad]. (T, 12)"""
    velocity: Array
    """Of the joints, measured [rad/s]. (T, 12)"""
    action: Array
    """As the network gave it. (T, 12)"""
    target: Array
    """Joint position targets [rad]. (T, 12)"""
    contact: Array
    """Estimated probability that each foot touches the ground. (T, 4)"""
    linear_velocity: Array
    """Estimated, of the trunk in its frame [m/s]. (T, 3)"""

    @classmethod
    def of(cls, taken: Iterable[Tick]) -> Self:
        """Put ticks together.

        Raises:
            HardwareError: There are none.
        """
        rows = list(taken)
        if not rows:
            raise HardwareError("the policy made no decision; let it run for one tick or more.")
        states = [row.state for row in rows]

        def stack(values: Iterable[object]) -> Array:
            return np.array(list(values), dtype=float)

        return cls(
            began=rows[0].time - rows[0].since,
            time=stack(row.since for row in rows),
            command=stack(row.command for row in rows),
            jump=np.array([row.jump for row in rows], dtype=bool),
            state_sequence=np.array([state.sequence for state in states], dtype=np.int64),
            state_time=stack(state.time for state in states),
            angular_velocity=stack(state.gyro for state in states),
            projected_gravity=stack(projected_gravity(state.orientation) for state in states),
            position=stack(state.position for state in states),
            velocity=stack(state.velocity for state in states),
            action=stack(row.action for row in rows),
            target=stack(row.target for row in rows),
            contact=stack(row.contact for row in rows),
            linear_velocity=stack(row.linear_velocity for row in rows),
        )


def run_policy(
    machine: Machine,
    policy: Policy,
    robot: Robot,
    source: Source,
    *,
    seconds: float,
    watch: Callable[[Tick], None] | None = None,
) -> Rollout:
    """Run a policy on a connected, standing machine and return what it decided.

    Args:
        machine: Connected, in its default pose; left connected, the last targets in force.
        policy: Whose contract fits the robot.
        robot: What the machine is.
        source: The command, by the time since the policy took over [s].
        seconds: Time to run [s].
        watch: Called with every tick.

    Raises:
        ArtefactError: As `ticks`.
        HardwareError: As `ticks`.
    """
    taken = []
    for tick in ticks(machine, policy, robot, source, seconds=seconds):
        if watch is not None:
            watch(tick)
        taken.append(tick)
    return Rollout.of(taken)
