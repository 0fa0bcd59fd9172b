"""The command to a joint, at every physics step of the training simulator.

The simulator holds a policy's command for `decimation` physics steps. The jitter of the timestamps
(tens of microseconds) must not move a command by a whole step, so the instants at which the command
changes are fitted by the clock of the policy, and the command is read in the middle of each tick.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.identify.logs.columns import command_index
from pronk.identify.logs.joint_log import Excitation
from pronk.robots.robot import RobotSpec

_OFF_CLOCK = 0.25
"""Largest median distance of a change from the policy's clock, as a share of a tick, with which
the command is still taken for one held at the policy's rate."""
_SAME = 1e-6
"""Commands closer than this are the same [rad]: far below an encoder count."""
_POSE_SLACK = 0.05
"""How far a clamped joint may be from where the bench model clamps it [rad]."""


@dataclass(frozen=True, kw_only=True)
class CommandTrace:
    """One command to one joint, at every physics step of the training simulator."""

    joint: str
    """Name of the joint that is commanded."""
    start: float
    """Instant of the first step, on the clock of the log [s]."""
    timestep: float
    """Physics step [s]."""
    command: Array
    """Command in force during each step [rad], shape (steps,)."""
    pose: Array
    """Position that every joint of the robot is held at, robot's order [rad], shape (joints,)."""
    amplitude: float = float("nan")
    """Peak of the command about the pose [rad]."""
    policy_held: bool = True
    """True if the command was found to be held at the policy's rate."""

    @property
    def time(self) -> Array:
        """Start of each step, on the clock of the log [s], shape (steps,)."""
        return np.asarray(self.start + self.timestep * np.arange(len(self.command)))

    def excitation(self, robot: RobotSpec, steps: int | None = None) -> tuple[Array, Array]:
        """Mirror the command to the original joint, which is simulated in this one's place.

        Args:
            robot: The robot.
            steps: Physics steps; those of the command if None. A shorter command stays where it
                ends.

        Returns:
            The pose of the original joint's chain [rad], shape (chain,), and the command about it
            at each step [rad], shape (steps,).
        """
        joint = robot.joint(self.joint)
        original_name, sign = joint.original
        original = robot.joint(original_name)
        names = robot.joint_names
        pose = []
        # Chains of mirrored mechanisms run through the same kinds of joint in the same order.
        for name, original_link in zip(joint.chain, original.chain, strict=True):
            link_sign = robot.joint(name).original[1] * robot.joint(original_link).original[1]
            pose.append(link_sign * self.pose[names.index(name)])
        command = sign * (self.command[:steps] - self.pose[names.index(self.joint)])
        if steps is not None:
            command = np.pad(command, (0, steps - len(command)), mode="edge")
        return np.array(pose), command

    def same_as(self, other: CommandTrace, robot: RobotSpec) -> bool:
        """Tell whether both lead to the same simulation of the same original joint.

        Args:
            other: Another command, which may rest longer or shorter at its end.
            robot: The robot.
        """
        if robot.joint(self.joint).original[0] != robot.joint(other.joint).original[0]:
            return False
        steps = max(len(self.command), len(other.command))
        pose, command = self.excitation(robot, steps)
        other_pose, other_command = other.excitation(robot, steps)
        if np.abs(command - other_command).max() >= _SAME:
            return False
        return bool(np.allclose(pose, other_pose, atol=1e-3))


def policy_clock(time: Array, command: Array, tick: float) -> tuple[float, float]:
    """Find the phase of the clock on which a held command changes.

    Args:
        time: Timestamps [s], shape (n,).
        command: Command at the timestamps, shape (n,).
        tick: Period of the clock [s].

    Returns:
        An instant at which a tick begins [s], and the median distance of the changes from the
        ticks as a share of `tick` (0.25 is what changes at random instants give). A command that
        never changes begins at the first timestamp, at distance 0.
    """
    changes = time[1:][np.diff(command) != 0.0]
    if len(changes) == 0:
        return float(time[0]), 0.0
    # Circular mean: the phase that all changes share, whatever ticks lie between them.
    turns = np.exp(2j * np.pi * (changes - time[0]) / tick)
    phase = float(np.angle(turns.mean())) / (2.0 * np.pi) * tick
    distance = (changes - time[0] - phase) / tick
    distance -= np.round(distance)
    # Jitter must not split the first tick: let the clock begin at the change nearest the start.
    return float(time[0] + phase), float(np.median(np.abs(distance)))


def command_trace(excitation: Excitation, robot: RobotSpec) -> CommandTrace:
    """Read the command of one excitation at every physics step of the robot.

    Args:
        excitation: One excitation of one joint in a log.
        robot: The robot with the timestep and decimation of its simulator.

    Raises:
        LogError: The unit of the joint is not radians, or a joint that is clamped in the bench
            model stood elsewhere.
    """
    joint = excitation.joint
    unit = excitation.log.unit(joint)
    if unit != "rad":
        raise LogError(
            f"{excitation.source or 'log'}: {joint} is in unit {unit!r}; the simulator needs "
            "radians, so give --scale JOINT=RADIANS."
        )
    time = excitation.time
    command = excitation.command
    tick = robot.timestep_s * robot.decimation
    clock, distance = policy_clock(time, command, tick)
    on_clock = distance <= _OFF_CLOCK * 0.6
    start = time[0]
    period = robot.timestep_s
    if on_clock:
        # Begin with the tick in which the log begins, so that ticks and steps stay aligned.
        start = clock + np.floor((start - clock) / tick + 0.5) * tick
        period = tick
    count = int(np.ceil((time[-1] - start) / period))
    middle = start + (np.arange(count) + 0.5) * period
    steps = command[np.maximum(command_index(time, middle), 0)]
    if on_clock:
        early = _early_ticks(steps)
        start -= early * tick
        steps = np.repeat(np.pad(steps, (early, 0), mode="edge"), robot.decimation)
    return CommandTrace(
        joint=joint,
        start=float(start),
        timestep=robot.timestep_s,
        command=steps,
        pose=_pose(excitation, robot),
        amplitude=excitation.amplitude,
        policy_held=bool(on_clock),
    )


def _early_ticks(values: Array) -> int:
    """Count the ticks to begin before the log, so that repeats begin alike.

    Whether the log caught the tick it began in is chance; a rest before the first change is
    therefore lengthened to a multiple of five ticks. A log that begins in motion is not lengthened.
    """
    changes = np.nonzero(np.diff(values) != 0.0)[0]
    resting_ticks = len(values)
    if len(changes) > 0:
        resting_ticks = int(changes[0]) + 1
    if resting_ticks < 2:
        return 0
    # Plans rest for multiples of five ticks (0.1 s) give or take one: keep clear of those.
    lengthened = math.ceil((resting_ticks + 2) / 5) * 5
    return lengthened - resting_ticks


def _pose(excitation: Excitation, robot: RobotSpec) -> Array:
    """Return the pose of every joint; the default position of joints that the log lacks."""
    log = excitation.log
    joint = excitation.joint
    pose = np.array([robot_joint.default_position for robot_joint in robot.joints])
    logged = excitation.pose
    for index, name in enumerate(robot.joint_names):
        if name in log.joints and log.unit(name) == "rad":
            pose[index] = logged[log.column(name)]
    for name in robot.joint(joint).clamped:
        default = robot.joint(name).default_position
        position = pose[robot.joint_names.index(name)]
        if abs(position - default) > _POSE_SLACK:
            raise LogError(
                f"{log.source or 'log'}: {name} was clamped at {position:.3f} rad while {joint} "
                f"was excited; the bench model of {robot.name} clamps it at {default:.3f} rad."
            )
    return pose
