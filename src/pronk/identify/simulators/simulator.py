"""The Simulator protocol: what an engine must offer so that its joints can be matched.

An engine implements `Simulator`; MuJoCo is one of them (`pronk.identify.simulators.mujoco`). The
match excites one joint at a time with many sets of parameters, by `JointRigs`: those of MuJoCo are
a fast path, those of every other simulator call its `rollout`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol, Self, runtime_checkable

import numpy as np

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.info import SimulatorInfo
from pronk.robots.robot import RobotSpec

if TYPE_CHECKING:
    # It needs SciPy, which a simulator in another Python has not.
    from pronk.identify.simulators.command_trace import CommandTrace

Values = Mapping[str, Array]
"""Name of a parameter to its values."""

SETTABLE_PARAMETERS = ("stiffness", "damping", "armature", "frictionloss", "delay")
"""Parameters of a joint that a simulator may let a match set [N m/rad, N m s/rad, kg m^2, N m, s];
stiffness and damping it must."""
CHUNK = 100
"""Simulations in flight at once: 100 x 5,000 steps x 3 commands are 12 MB."""


@runtime_checkable
class Simulator(Protocol):
    """Joints of a robot in some engine."""

    info: SimulatorInfo
    """The engine and its settings."""
    joints: tuple[str, ...]
    """Names of the J joints, in the order of the columns."""
    parameters: frozenset[str]
    """Which of `SETTABLE_PARAMETERS` it can set."""

    def rollout(
        self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
    ) -> Array:
        """Simulate B runs from rest at the first command.

        Args:
            command: Target position during each physics step [rad], shape (B, T, J).
            values: Name of a parameter to its values, each of shape (B, J), in the units of
                `SETTABLE_PARAMETERS`; those of the robot where a name is missing.
            locked: Joints that are held at their first command; their motion is not needed.

        Returns:
            Position at the start of each step [rad], shape (B, T, J); NaN where a run diverged.
        """


class Closing:
    """Something to be closed after use, also by a with statement."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Release threads and memory; nothing by default."""


class JointRigs(Closing, ABC):
    """The joints of a robot in one simulator, excited one at a time with many parameter sets."""

    robot: RobotSpec
    """The robot, with the timestep and decimation of the simulator."""
    info: SimulatorInfo
    """The engine and its settings."""
    parameters: frozenset[str]
    """Which of `SETTABLE_PARAMETERS` can be set."""
    sets_effort_limit: bool = False
    """True if the torque limit of a drive, `effort_limit` [N m], can be set too."""
    steps: int = 0
    """Physics steps done so far."""

    @abstractmethod
    def run(
        self, traces: Sequence[CommandTrace], values: Values, steps: int
    ) -> Iterator[tuple[slice, Array]]:
        """Simulate one joint with b sets of parameters, a chunk of simulations at a time.

        A joint that mirrors another is simulated as that other (`Joint.original`).

        Args:
            traces: Commands to joints of one original; one for all simulations, or one each.
            values: Name of a parameter to its values for the excited joint, each of shape (b,):
                stiffness, damping, and armature and frictionloss where they are not the robot's.
            steps: Physics steps to simulate; a shorter command stays where it ends.

        Yields:
            Which simulations the chunk holds, and the original joint's position about the pose at
            the start of each step [rad], shape (chunk, steps). The array is used again for the
            next chunk: copy what is needed first.
        """

    def play(self, trace: CommandTrace, values: Values) -> Array:
        """Simulate the response of a joint to one command with b sets of parameters.

        Args:
            trace: The command.
            values: Parameters of the joint, as in `run`.

        Returns:
            Position of the trace's joint at `trace.time` [rad], shape (b, steps).
        """
        sign = self.robot.joint(trace.joint).original[1]
        centre = trace.pose[self.robot.joint_names.index(trace.joint)]
        positions = np.empty((len(values["stiffness"]), len(trace.command)))
        for part, offsets in self.run([trace], values, len(trace.command)):
            positions[part] = centre + sign * offsets
        return positions


class RolloutRigs(JointRigs):
    """Rigs of any simulator, made from its `rollout`."""

    def __init__(self, simulator: Simulator, robot: RobotSpec) -> None:
        self.info = simulator.info
        self.robot = replace(
            robot, timestep_s=self.info.timestep_s, decimation=self.info.decimation
        )
        self.parameters = simulator.parameters
        self._simulator = simulator

    def close(self) -> None:
        """Close the simulator, if it can be closed."""
        if isinstance(self._simulator, Closing):
            self._simulator.close()

    def run(
        self, traces: Sequence[CommandTrace], values: Values, steps: int
    ) -> Iterator[tuple[slice, Array]]:
        """See `JointRigs.run`.

        Raises:
            PronkError: The simulator lacks the joint or a parameter.
        """
        names = self._simulator.joints
        original = self.robot.joint(self.robot.joint(traces[0].joint).original[0])
        if original.name not in names:
            raise PronkError(
                f"simulator {self.info.engine} has no joint {original.name!r}; its joints are "
                f"{', '.join(names)}."
            )
        lacking = set(values) - self.parameters
        if lacking:
            raise PronkError(
                f"simulator {self.info.engine} cannot set {', '.join(sorted(lacking))}; it sets "
                f"{', '.join(sorted(self.parameters))}."
            )
        column = names.index(original.name)
        total = len(values["stiffness"])
        all_values = dict(values)
        for name, value in original.parameters.items():
            if name in self.parameters and name not in values:
                all_values[name] = np.full(total, value)
        default_pose = [self.robot.joint(name).default_position for name in names]
        for begin in range(0, total, CHUNK):
            part = slice(begin, min(begin + CHUNK, total))
            count = part.stop - part.start
            command = np.empty((count, steps, len(names)))
            centre = np.empty((count, 1))
            for row in range(count):
                trace = traces[0] if len(traces) == 1 else traces[begin + row]
                pose, offsets = trace.excitation(self.robot, steps)
                command[row] = default_pose
                for name, position in zip(original.chain, pose, strict=True):
                    if name in names:
                        command[row, :, names.index(name)] = position
                centre[row] = pose[original.chain.index(original.name)]
                command[row, :, column] += offsets
            chunk_values = {name: array[part] for name, array in all_values.items()}
            positions = rollout_joint(
                self._simulator, self.robot, original.name, command, chunk_values
            )
            self.steps += count * steps
            yield part, positions - centre


def rollout_joint(
    simulator: Simulator, robot: RobotSpec, joint: str, command: Array, values: Values
) -> Array:
    """Simulate one joint while all others are held.

    Args:
        simulator: The simulator.
        robot: The robot, whose parameters the other joints have.
        joint: The joint that moves.
        command: Target positions of all joints of the simulator [rad], shape (B, T, J).
        values: Name of a parameter to its values for the joint, each of shape (B,).

    Returns:
        Positions of the joint [rad], shape (B, T).

    Raises:
        PronkError: The simulator returned another shape than that of the command.
    """
    names = simulator.joints
    column = names.index(joint)
    all_values = {}
    for parameter, joint_values in values.items():
        robot_values = [robot.joint(name).parameters[parameter] for name in names]
        all_values[parameter] = np.tile(robot_values, (len(command), 1))
        all_values[parameter][:, column] = joint_values
    locked = tuple(name for name in names if name != joint)
    positions = np.asarray(simulator.rollout(command, all_values, locked=locked))
    if positions.shape != command.shape:
        raise PronkError(
            f"the simulator's rollout returned shape {positions.shape}; expected that of the "
            f"command, {command.shape} (runs, steps, joints)."
        )
    return np.asarray(positions[..., column])
