"""The experiments on one joint of a simulator; all other joints are held at their pose.

- Steps of the command at successive instants. The step in which each begins to act gives the number
  of steps that the simulator holds a command for, and the whole steps of delay.
- Steps of many heights, up to the effort limit. How far the joint comes in the first step in which
  it moves is in proportion to the height, until the torque (or the command) is clipped.
- Chirps at three pairs of gains, and one with another armature where it can be set.
"""

from __future__ import annotations

import numpy as np

from pronk.arrays import Array, Mask
from pronk.errors import PronkError
from pronk.identify.simulators.links import links_of
from pronk.identify.simulators.probe.law_fit import AMPLITUDE, ProbeRuns, StepCount
from pronk.identify.simulators.probe.result import Clip
from pronk.identify.simulators.simulator import Simulator, Values, rollout_joint
from pronk.robots.robot import RobotSpec

_REST = 8
"""Steps before the command moves."""
_LONGEST_HOLD = 40
"""Longest hold that is looked for [steps]."""
_HALVINGS = 7
"""Most halvings of the gains until the simulator is stable."""
_HIGHEST_STEP = 3.0
"""Highest step of the command with which a limit of the torque is looked for [rad]."""
_CLIPPED_SLOPE = 0.3
"""Share of its greatest growth with the height of a step below which the motion is clipped."""
_MOST_TURNS = 0.5
"""Share of the steps in which the acceleration of a joint may turn; that of the chirps turns in a
fifth at most."""
_LEAST_GROWTH = 0.03
"""Growth of the motion from one height of a step to the next, over the largest motion, from which
on it is read. Less may be rounding: an engine in single precision has 1.5 rad to 1.2e-7, which is a
tenth of the motion in the first step of a small command."""
_DAMPED_SHARE = 0.3
"""What the drive itself takes from the motion of the second step, about, over that of the first."""
_MOST_SPEED = 0.6
"""Largest speed of the joint over the drive's no-load speed."""
_FEWEST_HEIGHTS = 6
"""Fewest heights of a step in which a limit is looked for."""
_SLOWER_RUNS = 3
"""Most repetitions of chirps with smaller amplitudes."""
_LEAST_CHANGE = 0.25
"""Smallest factor on the amplitude from one repetition to the next: faster motion diverges."""
SHORT_FIRST_STEP = 5.0
"""Motion after two steps over that after one from which on a command acts for less than a third of
the first one; it is 3 where it acts for all of it."""


class Bench:
    """The experiments on one joint of a simulator."""

    def __init__(self, simulator: Simulator, robot: RobotSpec, joint: str) -> None:
        self.armature_settable = "armature" in simulator.parameters
        self._simulator = simulator
        self._robot = robot
        self._joint = robot.joint(joint)
        self._step = simulator.info.timestep_s
        drive = self._joint.drive
        effort_limit = min(drive.effort_limit, drive.stall_torque)
        self.amplitude = min(AMPLITUDE, 0.3 * effort_limit / self._joint.stiffness)
        """Amplitude of the commands [rad]."""
        self._highest = min(_HIGHEST_STEP, 2.0 * effort_limit / self._joint.stiffness)

    def lower_amplitude(self, amplitude: float) -> None:
        """Take a smaller amplitude of the commands [rad], if it is smaller."""
        self.amplitude = min(self.amplitude, amplitude)

    def clip(self, share: float) -> Clip | None:
        """Look for a limit of the torque or of the command below the effort limit.

        Args:
            share: Share of the gains.

        Returns:
            The limit; None where there is none up to the effort limit.
        """
        clipped = self._clipped_height(share)
        if clipped is None:
            return None
        height, acting = clipped
        # A torque is clipped at twice the height with half the stiffness, a command at the same.
        other = self._clipped_height(0.5 * share)
        of_torque = other is None or other[0] > 1.4 * height
        return Clip(height=height, of_torque=of_torque, acting=acting)

    def _clipped_height(self, share: float) -> tuple[float, float] | None:
        """Find the height of a step from which on the joint goes no further.

        How far it comes in the first step is in proportion to the command that acts in it.

        Returns:
            The height [rad], and the share of its first step for which the command acts, about;
            None where the joint always goes further, until it is near its no-load speed.
        """
        heights = self._highest * np.geomspace(1e-3, 1.0, 24)
        length = _REST + 2 * _LONGEST_HOLD
        command = np.zeros((2 * len(heights) + 1, length))
        command[1:, _REST:] = np.concatenate([heights, -heights])[:, None]
        position = self._run(command, self._gains(np.full(len(command), share)))
        motion = position[1:] - position[:1]
        if not np.isfinite(motion).all():
            return None
        moved = np.abs(motion).max(axis=0) > 1e-6 * self._highest
        if not moved[:-1].any():
            return None
        first = int(moved.argmax())
        # Gravity adds to the torque to one side and takes from it to the other.
        both_sides = 0.5 * (motion[: len(heights)] - motion[len(heights) :])
        reach = both_sides[:, first]
        after_one, after_two = both_sides[len(heights) // 2, first : first + 2]
        acting = 1.0
        if after_two > SHORT_FIRST_STEP * after_one:
            # The delay leaves little of the first step; what the second one adds to the speed.
            reach = both_sides[:, first + 1] - 2.0 * reach
        elif after_one > 0.0:
            # Without damping after_two / after_one is 2 + 1 / acting; damping takes some of it.
            acting = min(1.0, 1.0 / max(after_two / after_one - 2.0 + _DAMPED_SHARE, 1.0))
        # Near its no-load speed a drive has less torque, which is no limit below the effort limit.
        speed = (both_sides[:, first + 1] - both_sides[:, first]) / self._step
        is_fast = np.abs(speed) > _MOST_SPEED * self._joint.drive.no_load_speed
        slow = int(is_fast.argmax()) if is_fast.any() else len(heights)
        if slow < _FEWEST_HEIGHTS:
            return None
        heights = heights[:slow]
        reach = reach[:slow]
        growth = np.diff(reach)
        slope = growth / np.diff(heights)
        is_readable = growth > _LEAST_GROWTH * np.abs(reach).max()
        if not is_readable.any():
            return None
        steepest = int(np.where(is_readable, slope, -np.inf).argmax())
        if slope[-1] > _CLIPPED_SLOPE * slope[steepest]:
            return None
        # Where the line of the steepest part reaches the height of the end.
        height = heights[steepest] + (reach[-1] - reach[steepest]) / slope[steepest]
        return float(height), acting

    def stable(self, share: float) -> bool:
        """Tell whether the joint follows chirps with a share of the gains.

        It does not where it goes far away, or is thrown to and fro from one step to the next.

        Raises:
            PronkError: The joint does not move at all.
        """
        position = self._run(self._chirp()[None], self._gains(np.array([share])))[0]
        motion = position - position[0]
        if not np.isfinite(motion).all() or np.abs(motion).max() >= 12.0 * self.amplitude:
            return False
        least_motion = 1e-3 * self.amplitude
        if np.ptp(motion) < least_motion:
            raise PronkError(
                f"{self._joint.name} does not move when it is commanded by {self.amplitude:.2g} "
                "rad; check the order of the simulator's joints."
            )
        # A limit of the torque keeps a joint near that would diverge without it: its acceleration
        # turns in each step.
        bend = np.diff(motion[len(motion) // 2 :], n=2)
        turns = (bend[1:] * bend[:-1] < 0.0) & (np.abs(bend[1:]) > least_motion)
        return bool(turns.mean() < _MOST_TURNS)

    def stable_share(self) -> float:
        """Find the largest share of the gains, a power of 1/2, with which the joint is stable."""
        for halvings in range(_HALVINGS + 1):
            share = 0.5**halvings
            if self.stable(share):
                return share
        raise PronkError(
            f"{self._joint.name} diverges, or swings from step to step, even with "
            f"1/{2**_HALVINGS} of {self._joint.stiffness:g} N m/rad and "
            f"{self._joint.damping:g} N m s/rad; check the units and the timestep."
        )

    def latency(self, share: float) -> tuple[int, int, int]:
        """Find the delay and the hold of commands with a share of the gains.

        Returns:
            Whole steps of delay, steps of a hold, and the instant of a hold's first step.
        """
        first_steps = np.arange(_REST, _REST + 2 * _LONGEST_HOLD)
        length = _REST + 4 * _LONGEST_HOLD
        command = np.zeros((len(first_steps) + 1, length))
        # Of smaller gains a larger step, which friction does not hold.
        height = self.amplitude * min(max(1.0 / share, 1.0), 5.0)
        command[1:] = height * (np.arange(length)[None] >= first_steps[:, None])
        position = self._run(command, self._gains(np.full(len(command), share)))
        distance = np.abs(position[1:] - position[:1])
        least_distance = max(1e-5 * self.amplitude, 4.0 * _resolution(position))
        if not (distance > least_distance).any(axis=1).all():
            raise PronkError(
                f"{self._joint.name} does not respond to a step of {height:.2g} rad within "
                f"{2 * _LONGEST_HOLD} steps."
            )
        delay, hold, phase = _first_responses(distance > least_distance)
        is_further = distance > 4.0 * least_distance
        if hold > 1 and is_further.any(axis=1).all():
            # A delay that leaves little of a step gives motions about as small as the least one,
            # of which rounding decides which are read. All commands of a hold give the same one.
            other_delay, other_hold, other_phase = _first_responses(is_further)
            if other_hold < hold:
                return other_delay, other_hold, other_phase
        return delay, hold, phase

    def chirps(
        self, share: float, hold: int, phase: int, steps: StepCount, last_step: int
    ) -> ProbeRuns:
        """Run chirps with three pairs of gains, and with another armature where it can be set.

        Args:
            share: Share of the gains.
            hold: Steps that the simulator holds a command for.
            phase: Instant of a hold's first step.
            steps: `ProbeRuns.steps`.
            last_step: `ProbeRuns.last_step`.
        """
        links = links_of(self._robot, self._joint.name)
        index = links.joints.index(self._joint.name)
        pose = np.array([self._robot.joint(name).default_position for name in links.joints])
        inertia = links.inertia_about(index, pose)
        stiffness = self._joint.stiffness * share * np.array([1.0, 1.0, 0.5])
        damping = self._joint.damping * share * np.array([1.0, 0.5, 0.5])
        armature_change = np.zeros(3)
        values = {}
        if self.armature_settable:
            stiffness = np.append(stiffness, stiffness[0])
            damping = np.append(damping, damping[0])
            armature = self._joint.drive.armature
            armature_change = np.append(armature_change, armature + 0.5 * inertia)
            values["armature"] = armature + armature_change
        values["stiffness"] = stiffness
        values["damping"] = damping
        runs = len(stiffness)
        command, position = self._slow_enough(values)
        step = np.arange(command.shape[1])
        read_step = np.maximum((step - phase) // hold * hold + phase, 0)
        held_command = command[0, np.minimum(read_step, step)] + self._joint.default_position
        pose[index] = 0.0
        gravity_at_zero = float(links.gravity_torque(pose)[index])
        pose[index] = 0.5 * np.pi
        gravity_at_quarter = float(links.gravity_torque(pose)[index])
        drive = self._joint.drive
        set_inertia = inertia + drive.armature
        set_values = np.array(
            [1.0, set_inertia, drive.viscous_damping, drive.frictionloss, 0.0, 1.0, 1.0]
        )
        return ProbeRuns(
            command=np.tile(held_command[:, None], (1, runs)),
            position=position.T,
            stiffness=stiffness,
            damping=damping,
            armature_change=armature_change,
            timestep=self._step,
            inertia=inertia,
            gravity=(gravity_at_zero, gravity_at_quarter),
            set_values=set_values,
            steps=steps,
            last_step=last_step,
        )

    def _slow_enough(self, values: Values) -> tuple[Array, Array]:
        """Run chirps whose motion is slow enough for the torque that they need.

        A drive near its no-load speed has less torque than its gains command, at resonance already
        with small commands.

        Args:
            values: Gains and armature of each run.

        Returns:
            Commands about the pose and positions [rad], shape (B, T).
        """
        runs = len(values["stiffness"])
        highest_speed = _MOST_SPEED * self._joint.drive.no_load_speed
        command = np.tile(self._chirp(), (runs, 1))
        position = self._run(command, values)
        for _ in range(_SLOWER_RUNS):
            with np.errstate(all="ignore"):
                speed = float(np.abs(np.diff(position, axis=1)).max()) / self._step
            if not speed > highest_speed:
                break
            self.lower_amplitude(self.amplitude * max(highest_speed / speed, _LEAST_CHANGE))
            command = np.tile(self._chirp(), (runs, 1))
            position = self._run(command, values)
        return command, position

    def _run(self, command: Array, values: Values) -> Array:
        """Return positions of the joint [rad], with commands about the pose, both (B, T)."""
        names = self._simulator.joints
        pose = np.array([self._robot.joint(name).default_position for name in names])
        full_command = np.tile(pose, (*command.shape, 1))
        full_command[..., names.index(self._joint.name)] += command
        with np.errstate(all="ignore"):
            try:
                return rollout_joint(
                    self._simulator, self._robot, self._joint.name, full_command, values
                )
            except (PronkError, KeyboardInterrupt):
                raise
            except Exception as error:
                # What is wrong is in the simulator, which is the user's.
                raise PronkError(
                    f"the simulator's rollout raised {type(error).__name__}: {error}; its command "
                    f"had the shape {full_command.shape} (runs, steps, joints) and the values were "
                    f"{', '.join(values)}."
                ) from error

    def _gains(self, share: Array) -> dict[str, Array]:
        """Return both gains at shares of the robot's, shape (B,)."""
        return {"stiffness": self._joint.stiffness * share, "damping": self._joint.damping * share}

    def _chirp(self) -> Array:
        """Return a command about the pose [rad], shape (T,): another value each step."""
        count = round(min(max(0.8 / self._step, 160.0), 400.0))
        time = self._step * np.arange(count - _REST)
        low_hz = 1.0 / time[-1]
        high_hz = min(25.0, 0.1 / self._step)
        phase = 2.0 * np.pi * (low_hz + (high_hz - low_hz) * time / (2.0 * time[-1])) * time
        return np.concatenate([np.zeros(_REST), self.amplitude * (np.sin(phase) + 0.3)])


def _resolution(position: Array) -> float:
    """Return the distance of two neighbouring numbers of the engine at the largest position [rad].

    Positions of an engine in single precision are numbers of that precision.
    """
    largest = np.abs(position).max()
    single = position.astype(np.float32)
    if np.array_equal(single, position):
        return float(np.spacing(np.float32(largest)))
    return float(np.spacing(largest))


def _first_responses(is_apart: Mask) -> tuple[int, int, int]:
    """Tell from the first motions after steps of the command when commands act.

    Args:
        is_apart: Whether the joint has moved, shape (runs, T). The command of run k moves in step
            `_REST + k`.

    Returns:
        What `Bench.latency` returns.
    """
    first_steps = _REST + np.arange(len(is_apart))
    # Position is read at the start of a step: it is apart one step after the command acts.
    acting_steps = is_apart.argmax(axis=1) - 1
    lateness = acting_steps - first_steps
    instants = np.unique(acting_steps)
    hold = 1
    if len(instants) > 1:
        hold = int(np.diff(instants).max())
    return int(lateness.min()), hold, int(first_steps[lateness.argmin()])
