"""The Simulator protocol: what an engine must offer so that its joints can be matched.

An engine implements `Simulator`; MuJoCo is one of them (`pronk.simulators.mujoco`). The match works
on `JointRigs`, which excite one joint at a time with many gain pairs: MuJoCo has a fast path of its
own for that, every other simulator gets one by `RolloutRigs`.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from pronk import plugins
from pronk.errors import PronkError
from pronk.robots.robot import RobotSpec
from pronk.simulators.command_trace import CommandTrace, original_pose

Array = NDArray[np.float64]

PARAMETERS = ("stiffness", "damping", "armature", "frictionloss", "delay")
"""Parameters of a joint [N m/rad, N m s/rad, kg m^2, N m, s]; the gains must be settable."""
ENTRY_POINTS = "pronk.simulators"
"""Group of entry points that installed packages offer simulators in."""
CHUNK = 100
"""Simulations in flight at once: 100 x 5,000 steps x 3 commands are 12 MB."""


@dataclass(frozen=True, kw_only=True)
class SimulatorInfo:
    """The simulator that gains hold for. In another one the same numbers give another joint."""

    engine: str = "mujoco"
    version: str = ""
    timestep_s: float = 0.005
    decimation: int = 4
    integrator: str = "implicitfast"
    actuator: str = "dc_motor_pd"
    """Explicit PD on position and velocity at the start of each physics step, clipped by the
    torque-speed curve (mjlab's DcMotorActuator)."""


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


@dataclass
class Count:
    """Physics steps done and the wall time they took."""

    steps: int = 0
    seconds: float = 0.0


class JointRig(Protocol):
    """One joint excited with many parameter sets, the other joints held."""

    robot: RobotSpec

    def pose(self, trace: CommandTrace) -> Array:
        """Pose at which the joint's chain is held for a trace [rad], shape (chain,)."""

    def run(
        self,
        commands: Sequence[Array],
        poses: Sequence[Array],
        stiffness: Array,
        damping: Array,
        *,
        armature: Array | None = None,
        frictionloss: Array | None = None,
    ) -> Iterator[tuple[slice, Array]]:
        """Yield the excited joint's positions a chunk at a time.

        Args:
            commands: Command about the pose during each step [rad], each of shape (steps,); one
                for all simulations, or one each.
            poses: Pose of the chain [rad], each of shape (chain,); one for all or one each.
            stiffness: Of the excited joint [N m/rad], shape (b,).
            damping: Of the excited joint [N m s/rad], shape (b,).
            armature: Of the excited joint [kg m^2], shape (b,); the rig's own if not given.
            frictionloss: Of the excited joint [N m], shape (b,); the rig's own if not given.

        Yields:
            Which simulations, and the position about the pose at the start of each step [rad],
            shape (chunk, steps). The array is reused: take what is needed before going on.
        """


class JointRigs(Protocol):
    """The rigs of all joints of a robot in one simulator."""

    robot: RobotSpec
    info: SimulatorInfo
    parameters: frozenset[str]

    @property
    def count(self) -> Count:
        """Steps and seconds of all rigs together."""

    def rig(self, joint: str) -> JointRig:
        """The rig that is simulated for a joint: that of its mirrored original."""

    def without_armature(self) -> JointRigs:
        """The same rigs with no rotor inertia at the excited joint."""

    def close(self) -> None:
        """Release threads and memory."""

    def __enter__(self) -> Self:
        """Use the rigs in a with statement."""

    def __exit__(self, *error: object) -> None:
        """Close."""


class Closing:
    """Something to be closed after use, also by a with statement."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Release threads and memory; nothing by default."""


class RolloutRigs(Closing):
    """Rigs of any simulator, made from its `rollout`."""

    def __init__(
        self, simulator: Simulator, robot: RobotSpec, *, armature: float | None = None
    ) -> None:
        """Take a simulator, and the armature of the excited joint [kg m^2] instead of its own."""
        info = simulator.info
        self.robot = replace(robot, timestep_s=info.timestep_s, decimation=info.decimation)
        self.info = info
        self.parameters = simulator.parameters
        self.count = Count()
        self._simulator = simulator
        self._armature = armature

    def without_armature(self) -> RolloutRigs:
        """The same with no rotor inertia at the excited joint."""
        return RolloutRigs(self._simulator, self.robot, armature=0.0)

    def rig(self, joint: str) -> RolloutRig:
        """The rig of a joint's mirrored original; PronkError if the simulator lacks it."""
        original = self.robot.joint(joint).original[0]
        if original not in self._simulator.joints:
            raise PronkError(
                f"simulator {self.info.engine} has no joint {original!r}; its joints are "
                f"{', '.join(self._simulator.joints)}."
            )
        return RolloutRig(self._simulator, self.robot, original, self._armature, self.count)


@dataclass
class RolloutRig:
    """One joint of any simulator, the others held at the pose."""

    simulator: Simulator
    robot: RobotSpec
    joint: str
    """An original, not a mirror image."""
    armature: float | None = None
    """Instead of the simulator's own [kg m^2]."""
    count: Count = field(default_factory=Count)

    def pose(self, trace: CommandTrace) -> Array:
        """Pose of the joint's chain [rad], shape (chain,)."""
        return original_pose(trace, self.robot)

    def run(
        self,
        commands: Sequence[Array],
        poses: Sequence[Array],
        stiffness: Array,
        damping: Array,
        *,
        armature: Array | None = None,
        frictionloss: Array | None = None,
    ) -> Iterator[tuple[slice, Array]]:
        """Yield the excited joint's positions a chunk at a time; see `JointRig.run`."""
        names, can = self.simulator.joints, self.simulator.parameters
        column = names.index(self.joint)
        joints = [self.robot.joint(name) for name in names]
        chain = self.robot.joint(self.joint).chain or (self.joint,)
        if armature is None and self.armature is not None:
            armature = np.full(len(stiffness), self.armature)
        own = {
            "stiffness": [joint.stiffness for joint in joints],
            "damping": [joint.damping for joint in joints],
            "armature": [joint.drive.armature for joint in joints],
            "frictionloss": [joint.drive.frictionloss for joint in joints],
        }
        given = (stiffness, damping, armature, frictionloss)
        excited = {n: value for n, value in zip(own, given, strict=True) if value is not None}
        if lacking := set(excited) - can:
            raise PronkError(
                f"simulator {self.simulator.info.engine} cannot set "
                f"{', '.join(sorted(lacking))}; it sets {', '.join(sorted(can))}."
            )
        locked = tuple(name for name in names if name != self.joint)
        for begin in range(0, len(stiffness), CHUNK):
            part = slice(begin, min(begin + CHUNK, len(stiffness)))
            size = part.stop - part.start
            command = np.empty((size, len(commands[0]), len(names)))
            centre = np.empty((size, 1))
            for row, i in enumerate(range(part.start, part.stop)):
                pose = dict(zip(chain, poses[0 if len(poses) == 1 else i], strict=True))
                command[row] = [pose.get(j.name, j.default_position) for j in joints]
                command[row, :, column] += commands[0 if len(commands) == 1 else i]
                centre[row] = pose[self.joint]
            values = {name: np.tile(own[name], (size, 1)) for name in own if name in can}
            for name, array in excited.items():
                values[name][:, column] = array[part]
            before = time.perf_counter()
            position = np.asarray(
                self.simulator.rollout(command, values, locked=locked), dtype=np.float64
            )
            if position.shape != command.shape:
                raise PronkError(
                    f"the simulator's rollout returned shape {position.shape}; expected that of "
                    f"the command, {command.shape} (runs, steps, joints)."
                )
            self.count.seconds += time.perf_counter() - before
            self.count.steps += size * command.shape[1]
            yield part, position[:, :, column] - centre


def play(
    rig: JointRig,
    trace: CommandTrace,
    stiffness: Array,
    damping: Array,
    *,
    armature: Array | None = None,
    frictionloss: Array | None = None,
) -> Array:
    """Position of the joint of a trace, for many parameter sets.

    Returns:
        Position at the start of each step [rad], shape (b, steps), at `trace.time`.
    """
    sign, command = trace.mirrored(rig.robot)[1:]
    centre = trace.pose[rig.robot.joint_names.index(trace.joint)]
    out = np.empty((len(stiffness), len(command)))
    pose = rig.pose(trace)
    for part, position in rig.run(
        [command], [pose], stiffness, damping, armature=armature, frictionloss=frictionloss
    ):
        out[part] = centre + sign * position
    return out


def load_simulator(
    choice: str, robot: RobotSpec, *, threads: int = 2, device: str = "cpu"
) -> Simulator:
    """Make a simulator of a robot.

    Args:
        choice: `mujoco`, `FILE.py:NAME`, or the name of an entry point in `pronk.simulators`. What
            it names is called with the robot and returns a `Simulator`.
        robot: The robot.
        threads: Threads of MuJoCo.
        device: Where MuJoCo simulates large runs; see `pronk.simulators.mujoco.DEVICES`.

    Raises:
        PronkError: There is no such simulator, or it lacks what the protocol needs.
    """
    if choice == "mujoco":
        from pronk.simulators.mujoco import MujocoSimulator

        return MujocoSimulator(robot, threads=threads, device=device)
    if device != "cpu":
        raise PronkError(f"device {device!r} is for simulator mujoco; {choice} has its own.")
    simulator: Simulator = _factory(choice)(robot)
    members = ("info", "joints", "parameters", "rollout")
    if lacking := [name for name in members if not hasattr(simulator, name)]:
        raise PronkError(f"simulator {choice} has no {', '.join(lacking)}; see Simulator.")
    if not {"stiffness", "damping"} <= set(simulator.parameters):
        raise PronkError(
            f"simulator {choice} sets {', '.join(sorted(simulator.parameters)) or 'nothing'}; "
            "expected at least stiffness and damping."
        )
    return simulator


def joint_rigs(
    choice: str, robot: RobotSpec, *, threads: int = 2, device: str = "cpu"
) -> JointRigs:
    """Rigs of a robot's joints in a simulator; arguments and errors are `load_simulator`'s."""
    from pronk.simulators.mujoco import MujocoSimulator

    simulator = load_simulator(choice, robot, threads=threads, device=device)
    return simulator if isinstance(simulator, MujocoSimulator) else RolloutRigs(simulator, robot)


def _factory(choice: str) -> Any:
    """The callable that a path or entry point names."""
    file, colon, name = choice.rpartition(":")
    if not (colon and file.endswith(".py")):
        known = entry_points(group=ENTRY_POINTS)
        if choice not in known.names:
            raise PronkError(
                f"simulator {choice!r}; expected FILE.py:NAME or one of "
                f"{', '.join(['mujoco', *sorted(known.names)])}."
            )
        return plugins.load(known[choice])
    path = Path(file)
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise PronkError(f"simulator {choice}: there is no file {path}.")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise PronkError(
            f"simulator {choice}: {path} cannot be loaded ({type(error).__name__}: {error})."
        ) from error
    found = getattr(module, name, None)
    if not callable(found):
        own = [v for v in vars(module).values() if getattr(v, "__module__", "") == path.stem]
        offers = [v.__name__ for v in own if isinstance(v, type)]
        raise PronkError(
            f"simulator {choice}: {path} has no {name!r} that can be called; its classes are "
            f"{', '.join(offers) or 'none'}."
        )
    return found
