"""What the simulators of other engines share: chains, drives, delays and the order of joints."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np

from pronk.actuator.law import DriveLaw
from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.robots.robot import RobotSpec
from pronk.simulators.engines.links import Links, links_of
from pronk.simulators.simulator import SimulatorInfo


@dataclass(frozen=True, kw_only=True)
class Drives:
    """The drives of a chain; arrays of shape (n,)."""

    stiffness: Array
    """[N m/rad]."""
    damping: Array
    """[N m s/rad]."""
    viscous: Array
    """Passive damping of the joint, which the engine treats as it does [N m s/rad]."""
    armature: Array
    """[kg m^2]."""
    frictionloss: Array
    """Dry friction, 0 where the engine has none [N m]."""
    effort_limit: Array
    """[N m]."""
    stall_torque: Array
    """[N m]."""
    no_load_speed: Array
    """[rad/s]."""

    def torque(self, command: Array, position: Array, speed: Array) -> Array:
        """The explicit law with mjlab's limits (`pronk.robots.model`) [N m], shape (n,)."""
        wanted = self.stiffness * (command - position) - self.damping * speed
        share = speed / self.no_load_speed
        high = np.minimum(self.effort_limit, self.stall_torque * (1.0 - share))
        low = np.maximum(-self.effort_limit, -self.stall_torque * (1.0 + share))
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
        """Import the engine; without a law the drives have that of the robot.

        Raises:
            PronkError: It is not installed, or has no such law.
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
        """Simulate one run of a chain from rest.

        Args:
            links: The chain.
            drives: Its drives.
            command: Target position during each step [rad], shape (T, n).
            start: First positions [rad], shape (n,).

        Returns:
            Position at the start of each step [rad], shape (T, n); NaN once a run diverged.
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
        left = [name for name in self.joints if name not in locked]
        while left:
            # The shortest chain with most of the joints, as in MujocoSimulator.
            root = max(
                (joint for joint in self.robot.joints if left[0] in joint.chain),
                key=lambda joint: (len(set(joint.chain) & set(left)), -len(joint.chain)),
            )
            links = self._links.setdefault(root.name, links_of(self.robot, root.name))
            columns = [self.joints.index(name) for name in links.joints]
            for run in range(len(command)):
                drives = self._drives(links, columns, {n: v[run] for n, v in values.items()})
                track = held[run][:, columns]
                start = links.rest(track[0], drives.stiffness)
                out[run][:, columns] = self.simulate(links, drives, track, start)
            left = [name for name in left if name not in links.joints]
        return out

    def _drives(self, links: Links, columns: list[int], values: Mapping[str, Array]) -> Drives:
        """The drives of a chain; those of the robot where a value is missing."""
        joints = [self.robot.joint(name) for name in links.joints]

        def of(name: str, own: list[float]) -> Array:
            return np.array(values[name][columns] if name in values else own)

        dry = float("frictionloss" in self.parameters)
        limits = ("effort_limit", "stall_torque", "no_load_speed")
        return Drives(
            stiffness=of("stiffness", [joint.stiffness for joint in joints]),
            damping=of("damping", [joint.damping for joint in joints]),
            viscous=np.array([joint.drive.viscous_damping for joint in joints]),
            armature=of("armature", [joint.drive.armature for joint in joints]),
            frictionloss=dry * of("frictionloss", [joint.drive.frictionloss for joint in joints]),
            **{n: np.array([getattr(joint.drive, n) for joint in joints]) for n in limits},
        )


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
