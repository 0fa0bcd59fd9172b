"""A base class for simulators whose engine builds each chain of joints from numbers.

`examples/engines` has a subclass for each of SAPIEN, Drake, PyBullet, MJX, Newton, Genesis and
ovphysx. This module needs NumPy only, so that it also runs in another Python.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import ClassVar

import numpy as np

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.info import SimulatorInfo
from pronk.identify.simulators.links import Links, links_of
from pronk.robots.drive_law import DriveLaw
from pronk.robots.motor import voltage_limits
from pronk.robots.robot import RobotSpec


@dataclass(frozen=True, kw_only=True)
class EngineDrives:
    """The drives of a chain of n joints in one run; all arrays have shape (n,)."""

    stiffness: Array
    """Proportional gain of each drive [N m/rad]."""
    damping: Array
    """Derivative gain of each drive [N m s/rad]."""
    viscous_damping: Array
    """Passive damping of each joint, which each engine treats in its own way [N m s/rad]."""
    armature: Array
    """Rotor inertia at the joint [kg m^2]."""
    frictionloss: Array
    """Dry friction of each joint [N m]; 0 where the engine has none."""
    effort_limit: Array
    """Largest torque that each drive may command [N m]."""
    stall_torque: Array
    """Torque of each motor at standstill [N m]."""
    no_load_speed: Array
    """Speed of each motor without load [rad/s]."""

    def torque(self, command: Array, position: Array, speed: Array) -> Array:
        """Compute the torques of the explicit law within the limits of motor and drive.

        Args:
            command: Target positions [rad], shape (n,).
            position: Positions at the start of the step [rad], shape (n,).
            speed: Speeds at the start of the step [rad/s], shape (n,).

        Returns:
            Torques [N m], shape (n,).
        """
        unlimited = self.stiffness * (command - position) - self.damping * speed
        low, high = voltage_limits(speed, self.stall_torque, self.no_load_speed)
        low = np.maximum(low, -self.effort_limit)
        high = np.minimum(high, self.effort_limit)
        return np.asarray(np.clip(unlimited, low, high))


class EngineSimulator(ABC):
    """A `Simulator` that builds each chain anew for each run.

    A subclass names its engine and what it can do, and implements `simulate`. Explicit drives have
    the torque-speed line of the motor, the engines' own drives its effort limit only.
    """

    package: ClassVar[str]
    """Distribution package of the engine, whose version is reported."""
    laws: ClassVar[tuple[str, ...]] = ("explicit",)
    """Kinds of `DriveLaw` that the engine's drives can have."""
    friction_laws: ClassVar[tuple[str, ...]] = ()
    """Kinds of `DriveLaw` with which the engine's joints have dry friction in N m."""

    def __init__(self, robot: RobotSpec, *, law: DriveLaw | None = None) -> None:
        """Take the joints of a robot.

        Args:
            robot: The robot whose joints are simulated.
            law: Law of the drives; that of the robot if None.

        Raises:
            PronkError: The engine has no drives of this law.
        """
        self.robot = robot
        self.law = law or robot.law
        self.joints = robot.joint_names
        if self.law.kind not in self.laws:
            raise PronkError(
                f"{self.package} has no drives of law {self.law.kind}; expected one of "
                f"{', '.join(self.laws)}."
            )
        self.info = SimulatorInfo(
            engine=self.package,
            version=version(self.package),
            timestep_s=robot.timestep_s,
            decimation=robot.decimation,
            integrator=self.law.label,
            actuator=type(self).__name__,
            law=self.law.kind,
            iterations=self.law.iterations,
        )
        parameters = {"stiffness", "damping", "armature", "delay"}
        if self.law.kind in self.friction_laws:
            parameters.add("frictionloss")
        self.parameters = frozenset(parameters)
        self._links: dict[str, Links] = {}

    @abstractmethod
    def simulate(self, links: Links, drives: EngineDrives, command: Array, start: Array) -> Array:
        """Simulate one run of a chain of n joints from rest.

        Args:
            links: The bodies of the chain.
            drives: The drives of its joints, in the order of the links.
            command: Target position during each step [rad], shape (T, n).
            start: First positions [rad], shape (n,).

        Returns:
            Position at the start of each step [rad], shape (T, n); NaN once the run diverged.
        """

    def rollout(
        self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
    ) -> Array:
        """Simulate B runs from rest at the first command; see `Simulator.rollout`."""
        unknown = set(values) - self.parameters
        if unknown:
            raise PronkError(
                f"{self.package} sets {', '.join(sorted(self.parameters))}, not "
                f"{', '.join(sorted(unknown))}."
            )
        delayed_command = command
        if "delay" in values:
            delayed_command = delayed(command, values["delay"] / self.robot.timestep_s)
        position = np.repeat(command[:, :1], command.shape[1], axis=1)
        for root, _ in self.robot.branches(set(self.joints) - set(locked)):
            if root not in self._links:
                self._links[root] = links_of(self.robot, root)
            links = self._links[root]
            columns = [self.joints.index(name) for name in links.joints]
            for run in range(len(command)):
                run_values = {name: array[run, columns] for name, array in values.items()}
                drives = self._drives(links, run_values)
                run_command = delayed_command[run][:, columns]
                start = links.rest(run_command[0], drives.stiffness)
                position[run][:, columns] = self.simulate(links, drives, run_command, start)
        return position

    def _drives(self, links: Links, values: Mapping[str, Array]) -> EngineDrives:
        """Return the drives of a chain: those of the robot where a value is missing."""
        joints = [self.robot.joint(name) for name in links.joints]
        parameters = dict(values)
        for name in ("stiffness", "damping", "armature", "frictionloss"):
            if name not in parameters:
                parameters[name] = np.array([joint.parameters[name] for joint in joints])
        if "frictionloss" not in self.parameters:
            parameters["frictionloss"] = np.zeros(len(joints))
        return EngineDrives(
            stiffness=parameters["stiffness"],
            damping=parameters["damping"],
            viscous_damping=np.array([joint.drive.viscous_damping for joint in joints]),
            armature=parameters["armature"],
            frictionloss=parameters["frictionloss"],
            effort_limit=np.array([joint.drive.effort_limit for joint in joints]),
            stall_torque=np.array([joint.drive.stall_torque for joint in joints]),
            no_load_speed=np.array([joint.drive.no_load_speed for joint in joints]),
        )


def delayed(command: Array, steps: Array) -> Array:
    """Delay commands by numbers of steps that need not be whole.

    Args:
        command: Target position during each step [rad], shape (B, T, J).
        steps: Delay of each joint in each run, in steps, shape (B, J).

    Returns:
        The mean of the delayed command over each step [rad], shape (B, T, J). Before its first
        value arrives, the command stays at that value.
    """
    whole_steps = np.floor(steps).astype(np.int64)
    share = (steps - whole_steps)[:, None]
    last_step = command.shape[1] - 1
    index = np.arange(last_step + 1)[None, :, None] - whole_steps[:, None]
    arrived = np.take_along_axis(command, np.clip(index, 0, last_step), axis=1)
    before = np.take_along_axis(command, np.clip(index - 1, 0, last_step), axis=1)
    return np.asarray((1.0 - share) * arrived + share * before)
