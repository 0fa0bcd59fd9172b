"""What the simulators of other engines share: chains, drives, delays and the order of joints."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.engines.links import Links, links_of
from pronk.identify.simulators.simulator import SimulatorInfo
from pronk.robots.drive_law import DriveLaw
from pronk.robots.motor import voltage_limits
from pronk.robots.robot import RobotSpec


@dataclass(frozen=True, kw_only=True)
class Drives:
    """The drives of a chain; arrays of shape (n,) in the units of `Drive`."""

    stiffness: Array
    damping: Array
    viscous_damping: Array
    """Of the joint, passive: each engine treats it in its own way [N m s/rad]."""
    armature: Array
    frictionloss: Array
    """0 where the engine has none."""
    effort_limit: Array
    stall_torque: Array
    no_load_speed: Array

    def torque(self, command: Array, position: Array, speed: Array) -> Array:
        """The explicit law with the limits of the motor and its drive [N m], shape (n,)."""
        wanted = self.stiffness * (command - position) - self.damping * speed
        low, high = voltage_limits(speed, self.stall_torque, self.no_load_speed)
        low, high = np.maximum(low, -self.effort_limit), np.minimum(high, self.effort_limit)
        return np.asarray(np.clip(wanted, low, high))


class EngineSimulator(ABC):
    """Joints of a robot in another engine: a `Simulator` that builds each chain for each run.

    Explicit drives have the torque-speed line of the motor, the engines' own drives its effort
    limit only. Dry friction is there with `dry` laws.
    """

    extra: ClassVar[str]
    """Extra of pronk that installs the engine; empty if it has a Python of its own."""
    module: ClassVar[str]
    """What is imported to see that the engine is installed."""
    package: ClassVar[str]
    """Its package."""
    laws: ClassVar[tuple[str, ...]] = ("explicit",)
    """Kinds of `DriveLaw` that the engine has."""
    dry: ClassVar[tuple[str, ...]] = ()
    """Those with which its joints have dry friction in N m."""

    def __init__(self, robot: RobotSpec, *, law: DriveLaw | None = None) -> None:
        """Import the engine; PronkError if it is not installed, or has no such law.

        Without a law the drives have that of the robot.
        """
        self.robot, self.law, self.joints = robot, law or robot.law, robot.joint_names
        if self.law.kind not in self.laws:
            raise PronkError(
                f"{self.package} has no drives of law {self.law.kind}; expected one of "
                f"{', '.join(self.laws)}."
            )
        try:
            self.engine: Any = importlib.import_module(self.module)
        except ImportError as error:
            ours = f"pip install 'pronk[{self.extra}]', or " if self.extra else ""
            raise PronkError(
                f"{self.package} cannot be imported ({error}); {ours}name a Python that has it "
                "with --simulator-python."
            ) from None
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
        dry = ("frictionloss",) * (self.law.kind in self.dry)
        self.parameters = frozenset({"stiffness", "damping", "armature", "delay", *dry})
        self._links: dict[str, Links] = {}

    @abstractmethod
    def simulate(self, links: Links, drives: Drives, command: Array, start: Array) -> Array:
        """Simulate one run of a chain from rest at first positions [rad], shape (n,).

        The command is the target position during each step, what is returned the position at its
        start [rad], both of shape (T, n); NaN once the run diverged.
        """

    def rollout(
        self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
    ) -> Array:
        """Simulate B runs from rest at the first command; see `Simulator.rollout`."""
        if unknown := set(values) - self.parameters:
            raise PronkError(
                f"{self.package} sets {', '.join(sorted(self.parameters))}, not "
                f"{', '.join(sorted(unknown))}."
            )
        shape = (len(command), len(self.joints))
        delay = np.broadcast_to(values.get("delay", np.zeros(shape)), shape)
        held = delayed(command, delay / self.robot.timestep_s)
        out = np.repeat(command[:, :1], command.shape[1], axis=1)
        for root, _ in self.robot.branches(set(self.joints) - set(locked)):
            links = self._links.setdefault(root, links_of(self.robot, root))
            columns = [self.joints.index(name) for name in links.joints]
            for run in range(len(command)):
                drives = self._drives(links, columns, {n: v[run] for n, v in values.items()})
                track = held[run][:, columns]
                start = links.rest(track[0], drives.stiffness)
                out[run][:, columns] = self.simulate(links, drives, track, start)
        return out

    def _drives(self, links: Links, columns: list[int], values: Mapping[str, Array]) -> Drives:
        """The drives of a chain; those of the robot where a value is missing."""
        joints = [self.robot.joint(name) for name in links.joints]
        fields = ("viscous_damping", "effort_limit", "stall_torque", "no_load_speed")
        own = {n: np.array([getattr(joint.drive, n) for joint in joints]) for n in fields}
        for name in joints[0].parameters:
            own[name] = np.array([joint.parameters[name] for joint in joints])
            if name in values:
                own[name] = values[name][columns]
        own["frictionloss"] *= "frictionloss" in self.parameters
        return Drives(**own)


def delayed(command: Array, steps: Array) -> Array:
    """Commands later by numbers of steps, whole or not: their mean over each step.

    Shapes (B, T, J) and (B, J); before the first command, it holds.
    """
    whole = np.floor(steps).astype(np.int64)
    share = (steps - whole)[:, None]
    last = command.shape[1] - 1
    at = np.arange(last + 1)[None, :, None] - whole[:, None]
    late, later = (
        np.take_along_axis(command, np.clip(at - more, 0, last), axis=1) for more in (0, 1)
    )
    return np.asarray((1.0 - share) * late + share * later)
