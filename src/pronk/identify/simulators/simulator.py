"""The Simulator protocol: what an engine must offer so that its joints can be matched.

An engine implements `Simulator`; MuJoCo is one of them (`pronk.identify.simulators.mujoco`). The
match excites one joint at a time with many parameter sets, by `JointRigs`: those of MuJoCo are a
fast path, those of every other simulator call its `rollout`.
"""

from __future__ import annotations

import runpy
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self, runtime_checkable

import numpy as np

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.plugins import load_entry_point
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec

if TYPE_CHECKING:
    # It needs SciPy, which a simulator in another Python has not.
    from pronk.identify.simulators.command_trace import CommandTrace

Values = Mapping[str, Array]
"""Parameter name to values."""

PARAMETERS = ("stiffness", "damping", "armature", "frictionloss", "delay")
"""Parameters of a joint [N m/rad, N m s/rad, kg m^2, N m, s]; the gains must be settable."""
ENTRY_POINTS = "pronk.simulators"
"""Group of entry points that installed packages offer simulators in."""
CHUNK = 100
"""Simulations in flight at once: 100 x 5,000 steps x 3 commands are 12 MB."""


@dataclass(frozen=True, kw_only=True)
class SimulatorInfo:
    """The simulator that gains hold for. In another one the same numbers give another joint."""

    profile: str = ""
    """A name in `profiles.yaml`; empty for a simulator without one."""
    engine: str = "mujoco"
    version: str = ""
    timestep_s: float = 0.005
    decimation: int = 4
    integrator: str = "implicitfast"
    actuator: str = "dc_motor_pd"
    """Explicit PD on position and velocity at the start of each physics step, clipped by the
    torque-speed curve (mjlab's DcMotorActuator)."""
    law: str = "explicit"
    """`DriveLaw.kind`."""
    iterations: int = 1
    """`DriveLaw.iterations`."""

    @property
    def drive_law(self) -> DriveLaw:
        """How stiffness and damping act over a step."""
        return DriveLaw(kind=self.law, iterations=self.iterations)  # type: ignore[arg-type]


@runtime_checkable
class Simulator(Protocol):
    """Joints of a robot in some engine."""

    info: SimulatorInfo
    joints: tuple[str, ...]
    """Names of the J joints, in the order of the columns."""
    parameters: frozenset[str]
    """Which of `PARAMETERS` it can set."""

    def rollout(
        self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
    ) -> Array:
        """Simulate B runs from rest at the first command.

        Args:
            command: Target position during each physics step [rad], shape (B, T, J).
            values: Parameter name to values, each of shape (B, J), in the units of `PARAMETERS`;
                the robot's own where a name is missing.
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
    info: SimulatorInfo
    parameters: frozenset[str]
    """Which of `PARAMETERS` can be set."""
    steps: int = 0
    """Physics steps done so far."""

    @abstractmethod
    def run(
        self, traces: Sequence[CommandTrace], values: Values, steps: int
    ) -> Iterator[tuple[slice, Array]]:
        """Yield the excited joint's positions a chunk of simulations at a time.

        A joint that mirrors another is simulated as that other (`Joint.original`). Yields which
        simulations, and the original joint's position about the pose at the start of each step
        [rad], shape (chunk, steps). The array is reused: take what is needed first.

        Args:
            traces: Commands to joints of one original; one for all simulations, or one each.
            values: Parameter name to values of the excited joint, shape (b,): stiffness, damping,
                and armature and frictionloss where they are not the robot's.
            steps: Physics steps to simulate; a shorter command stays where it ends.
        """

    def play(self, trace: CommandTrace, values: Values) -> Array:
        """Position of a trace's joint at `trace.time` [rad], shape (b, steps); see `run`."""
        sign = self.robot.joint(trace.joint).original[1]
        centre = trace.pose[self.robot.joint_names.index(trace.joint)]
        out = np.empty((len(values["stiffness"]), len(trace.command)))
        for part, position in self.run([trace], values, len(trace.command)):
            out[part] = centre + sign * position
        return out


class RolloutRigs(JointRigs):
    """Rigs of any simulator, made from its `rollout`."""

    def __init__(self, simulator: Simulator, robot: RobotSpec) -> None:
        self.info = info = simulator.info
        self.robot = replace(robot, timestep_s=info.timestep_s, decimation=info.decimation)
        self.parameters = simulator.parameters
        self._simulator = simulator

    def close(self) -> None:
        """Close the simulator, if it can be closed."""
        if isinstance(self._simulator, Closing):
            self._simulator.close()

    def run(
        self, traces: Sequence[CommandTrace], values: Values, steps: int
    ) -> Iterator[tuple[slice, Array]]:
        """See `JointRigs.run`; PronkError if the simulator lacks the joint or a parameter."""
        names, engine = self._simulator.joints, self.info.engine
        original = self.robot.joint(self.robot.joint(traces[0].joint).original[0])
        if original.name not in names:
            raise PronkError(
                f"simulator {engine} has no joint {original.name!r}; its joints are "
                f"{', '.join(names)}."
            )
        if lacking := set(values) - self.parameters:
            raise PronkError(
                f"simulator {engine} cannot set {', '.join(sorted(lacking))}; it sets "
                f"{', '.join(sorted(self.parameters))}."
            )
        column, total = names.index(original.name), len(values["stiffness"])
        own = {n: np.full(total, v) for n, v in original.parameters.items() if n in self.parameters}
        values = {**own, **values}
        for begin in range(0, total, CHUNK):
            part = slice(begin, min(begin + CHUNK, total))
            command = np.empty((part.stop - begin, steps, len(names)))
            centre = np.empty((len(command), 1))
            for row, i in enumerate(range(begin, part.stop)):
                pose, offsets = traces[i if len(traces) > 1 else 0].excitation(self.robot, steps)
                at = dict(zip(original.chain, pose, strict=True))
                command[row] = [at.get(n, self.robot.joint(n).default_position) for n in names]
                command[row, :, column] += offsets
                centre[row] = at[original.name]
            drives = {name: value[part] for name, value in values.items()}
            position = excited(self._simulator, self.robot, original.name, command, drives)
            self.steps += len(command) * steps
            yield part, position - centre


def excited(
    simulator: Simulator, robot: RobotSpec, joint: str, command: Array, values: Values
) -> Array:
    """Positions of one joint while all others are held [rad], shape (B, T).

    The command to all joints has shape (B, T, J), values of the joint (B,); those of the others are
    the robot's own.
    """
    names, drives = simulator.joints, {}
    column = names.index(joint)
    for name, value in values.items():
        own = [robot.joint(one).parameters[name] for one in names]
        drives[name] = np.tile(own, (len(command), 1))
        drives[name][:, column] = value
    locked = tuple(name for name in names if name != joint)
    position = np.asarray(simulator.rollout(command, drives, locked=locked))
    if position.shape != command.shape:
        raise PronkError(
            f"the simulator's rollout returned shape {position.shape}; expected that of the "
            f"command, {command.shape} (runs, steps, joints)."
        )
    return np.asarray(position[..., column])


def factory(choice: str) -> Any:
    """The callable that a path or entry point names."""
    file, colon, name = choice.rpartition(":")
    if not (colon and file.endswith(".py")):
        known = entry_points(group=ENTRY_POINTS)
        if choice not in known.names:
            raise PronkError(
                f"simulator {choice!r}; expected FILE.py:NAME or one of "
                f"{', '.join(['mujoco', *sorted(known.names)])}."
            )
        return load_entry_point(known[choice])
    path = Path(file)
    if not path.is_file():
        raise PronkError(f"simulator {choice}: there is no file {path}.")
    # Not the name of the file, which may be that of the engine that it imports.
    module = f"simulator in {path.name}"
    try:
        members = runpy.run_path(file, run_name=module)
    except Exception as error:
        raise PronkError(
            f"simulator {choice}: {path} cannot be loaded ({type(error).__name__}: {error})."
        ) from error
    found = members.get(name)
    if not callable(found):
        types = [one for one in members.values() if isinstance(one, type)]
        offers = [one.__name__ for one in types if one.__module__ == module]
        raise PronkError(
            f"simulator {choice}: {path} has no {name!r} that can be called; its classes are "
            f"{', '.join(offers) or 'none'}."
        )
    return found
