"""The command to a joint, at every physics step of the training simulator.

Commands are used as they were sent, at any rate. A command that is held between the ticks of a
clock is read at the ticks: the clock is fitted to the instants at which the logged command changes,
so that neither the jitter of the timestamps nor the interval between two samples moves a command.
The rate of the robot's policy plays no part. A command without such a clock changes where the log
has it change.

Where the ticks are a whole number of physics steps apart, the steps begin at the ticks. Otherwise a
command changes inside a step, and the step has the mean of the command over it: the torque of a
drive is linear in the command, so that the joint gets the same impulse. What is lost is the instant
of the change inside the step, which moves the motion by less than an eighth of a step squared over
the interval of the commands (`CommandTrace.uncertain_s`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.identify.logs.columns import command_index
from pronk.identify.logs.joint_log import Excitation
from pronk.identify.response.grid import held_mean
from pronk.robots.robot import RobotSpec

_FEWEST_CHANGES = 8
"""Fewest changes of a command that show a clock."""
_MOST_TICKS_APART = 3.5
"""Changes that are further apart, in ticks, do not tell the period of the clock."""
_WITHIN_SAMPLES = 0.6
"""Largest distance of a change from its tick, in intervals of the log, that a log which shows a
change at the next sample leaves: half an interval, and a tenth for jitter."""
_WITHIN_TICKS = 0.05
"""Largest distance of a change from its tick, in ticks, that counts as jitter of timestamps."""
_INLIERS = 95.0
"""Percentage of the changes that have to be as near to their ticks."""
_IN_SYNC = 0.1
"""Standard deviation of the changes from their ticks, in intervals of the log, below which the log
is in step with the commands: its timestamps are then the instants of the commands."""
_EARLIEST = 2.0
"""Percentile of the distances that counts as the earliest: some jitter must not decide."""
_SAME_STEP = 0.1
"""Share of a physics step by which a clock may drift over an excitation and still count as in step
with the simulator."""
_LONGEST_TICK_S = 0.05
"""Longest tick that a trace begins at [s]; the grid may reach so far beyond the samples."""
_REST_MARGIN_S = 0.04
"""Least time by which a rest before the first change is lengthened [s]."""
_REST_MULTIPLE_S = 0.1
"""The lengthened rest is a multiple of this [s]. Plans rest for multiples of it give or take one
tick: the margin keeps clear of those, so that repeats begin alike."""
_SAME = 3e-3
"""Root mean square difference of two commands over the amplitude below which they are the same:
chirps to 25 Hz that are 30 microseconds apart."""
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
    uncertain_s: tuple[float, float] = (0.0, 0.0)
    """How much earlier and later the commands may have been sent than the trace has them [s]."""

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
        size = float(np.sqrt(np.mean((command - command.mean()) ** 2)))
        difference = float(np.sqrt(np.mean((command - other_command) ** 2)))
        if difference > _SAME * size or abs(command[-1] - other_command[-1]) > 10.0 * _SAME * size:
            return False
        return bool(np.allclose(pose, other_pose, atol=1e-3))


@dataclass(frozen=True, kw_only=True, eq=False)
class CommandClock:
    """The clock that a held command changes by, as a log shows it."""

    period: float
    """Time between two ticks [s]."""
    phase: float
    """Instant of tick 0 [s]."""
    ticks: NDArray[np.int64]
    """Number of the tick of each change, increasing, shape (changes,)."""
    early: float = 0.0
    """How much earlier the ticks may have been: what the samples of the log leave open [s]."""
    late: float = 0.0
    """How much later the commands changed if the drive got them with the rows of the log [s]."""

    @property
    def instants(self) -> Array:
        """Instants of the changes [s], shape (changes,)."""
        return np.asarray(self.phase + self.period * self.ticks)


def command_clock(time: Array, changed: NDArray[np.int64]) -> CommandClock | None:
    """Find the clock of a command by the samples at which it changes.

    Args:
        time: Timestamps of the log [s], shape (n,).
        changed: Rows with another command than the row before, shape (changes,).

    Returns:
        The clock; None if the command changes at other instants too, or too seldom to tell.
    """
    if len(changed) < _FEWEST_CHANGES:
        return None
    seen = time[changed]
    apart = np.diff(seen)
    sample_s = float(np.median(np.diff(time)))
    period = float(np.median(apart))
    for _ in range(2):
        counts = np.round(apart / period)
        near = (counts > 0.0) & (counts < _MOST_TICKS_APART)
        if not near.any():
            return None
        period = float(apart[near].sum() / counts[near].sum())
    counts = np.round(apart / period).astype(np.int64)
    if counts.min() < 1:
        return None
    ticks = np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(counts)])
    period, phase = np.polyfit(ticks, seen, 1)
    distance = seen - phase - period * ticks
    allowed = _WITHIN_TICKS * period
    if period > 1.5 * sample_s:
        allowed = max(allowed, _WITHIN_SAMPLES * sample_s)
    if np.percentile(np.abs(distance), _INLIERS) > allowed:
        return None
    return _located(seen, ticks, float(period), sample_s)


def _located(seen: Array, ticks: NDArray[np.int64], period: float, sample_s: float) -> CommandClock:
    """Place a clock of known period by the instants [s] at which its ticks were seen.

    A log that is in step with the clock shows each change at its own instant. Otherwise it shows a
    change at the next sample: the ticks are then where the earliest changes are.
    """
    phases = seen - period * ticks
    phase = float(phases.mean())
    early = 0.0
    late = 0.0
    if period > 1.5 * sample_s and phases.std() > _IN_SYNC * sample_s:
        first, last = np.percentile(phases, [_EARLIEST, 100.0 - _EARLIEST])
        late = max(phase - float(first), 0.0)
        phase = float(first)
        early = max(sample_s - float(last - first), 0.0)
    return CommandClock(period=period, phase=phase, ticks=ticks, early=early, late=late)


def command_trace(excitation: Excitation, robot: RobotSpec) -> CommandTrace:
    """Read the command of one excitation at every physics step of the robot.

    Args:
        excitation: One excitation of one joint in a log.
        robot: The robot with the timestep of its simulator.

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
    timestep = robot.timestep_s
    changed = np.flatnonzero(np.diff(command) != 0.0) + 1
    sample_s = float(np.median(np.diff(time)))
    clock = command_clock(time, changed)
    whole_steps = 0
    sent = time
    values = command
    if clock is not None:
        whole_steps = _steps_of_a_tick(time[changed], clock, timestep)
    if clock is not None and whole_steps:
        clock = _located(time[changed], clock.ticks, whole_steps * timestep, sample_s)
    if clock is not None:
        values = np.concatenate([command[:1], command[changed]])
        start = _start(float(time[0]), clock)
        ticks_to_end = math.ceil((float(time[-1]) - start) / clock.period - 1e-6)
        stop = start + max(ticks_to_end, 1) * clock.period
        first = min(start, float(clock.instants[0]) - clock.period)
        sent = np.append(first, clock.instants)
        between = clock.period
        early = clock.early
        late = clock.late
    else:
        start = float(time[0])
        stop = float(time[-1])
        between = sample_s
        if len(changed) > 1:
            between = float(np.median(np.diff(time[changed])))
        # A command that rests over several rows may have changed at any time between two of them.
        early = sample_s if between > 1.5 * sample_s else 0.0
        late = 0.0
    count = max(math.ceil((stop - start) / timestep - 1e-6), 2)
    edges = np.asarray(start + timestep * np.arange(count + 1), dtype=np.float64)
    if whole_steps:
        steps = values[np.maximum(command_index(sent, edges[:-1] + 0.5 * timestep), 0)]
        inside_step = 0.0
    else:
        steps = held_mean(sent, values, edges)
        inside_step = min(timestep, between) ** 2 / (8.0 * between)
    return CommandTrace(
        joint=joint,
        start=start,
        timestep=timestep,
        command=steps,
        pose=_pose(excitation, robot),
        amplitude=excitation.amplitude,
        uncertain_s=(early + inside_step, late + inside_step),
    )


def _steps_of_a_tick(seen: Array, clock: CommandClock, timestep: float) -> int:
    """Count the physics steps of a tick; 0 unless the clock keeps step with the simulator.

    `seen` holds the instants at which the command was seen to change [s].
    """
    steps = round(clock.period / timestep)
    if steps == 0:
        return 0
    count = len(clock.ticks)
    drift = abs(clock.period - steps * timestep) * float(clock.ticks[-1])
    distance = seen - clock.phase - clock.period * clock.ticks
    # Standard deviation of the drift of a straight line that was fitted to the changes.
    unsure = float(distance.std()) * math.sqrt(12.0 / count)
    return steps if drift <= _SAME_STEP * timestep + 2.0 * unsure else 0


def _start(log_start: float, clock: CommandClock) -> float:
    """Choose the first instant of a trace, so that repeats begin alike [s].

    Whether the log caught the tick it began in is chance; a rest before the first change is
    therefore lengthened to a round one. A log that begins in motion begins at the nearest tick, if
    the ticks are not too far apart for that.
    """
    first = float(clock.instants[0])
    resting_ticks = round((first - log_start) / clock.period)
    if resting_ticks < 2:
        if clock.period > _LONGEST_TICK_S:
            return log_start
        return first - resting_ticks * clock.period
    rest = resting_ticks * clock.period + _REST_MARGIN_S
    return first - math.ceil(rest / _REST_MULTIPLE_S - 1e-6) * _REST_MULTIPLE_S


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
            unit = ""
            if abs(np.rad2deg(position) - default) <= _POSE_SLACK:
                unit = (
                    f" The log gives {np.rad2deg(position):.3f} degrees: if its angles are in "
                    "radians, read it with --unit rad."
                )
            raise LogError(
                f"{log.source or 'log'}: {name} was clamped at {position:.3f} rad while {joint} "
                f"was excited; the bench model of {robot.name} clamps it at {default:.3f} rad."
                f"{unit}"
            )
    return pose
