"""The simulator that gains are matched for: MuJoCo, a framework's drive law in it, or another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from pronk.errors import PronkError
from pronk.identify.match.gains import JointGains
from pronk.identify.simulators.info import SimulatorInfo, mujoco_info
from pronk.identify.simulators.load import joint_rigs
from pronk.identify.simulators.profiles import Profile, load_profiles, profile
from pronk.identify.simulators.simulator import JointRigs
from pronk.identify.simulators.stability import require_stable
from pronk.robots.robot import RobotSpec


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """A robot in the simulator that its gains are matched for."""

    name: str
    """Name of the simulator as it was given."""
    robot: RobotSpec
    """The robot with the step and the drive law of the simulator."""
    framework: Profile | None = None
    """Framework whose drive law MuJoCo computes; None for MuJoCo itself and other simulators."""

    @property
    def uses_mujoco(self) -> bool:
        """True if MuJoCo computes the joint, by the drive law of `robot`."""
        return self.framework is not None or self.name == "mujoco"

    def open_rigs(self, threads: int, python: Path | None) -> JointRigs:
        """Open the joints of the robot, excited one at a time.

        Args:
            threads: Threads of MuJoCo.
            python: Interpreter in which another simulator runs; this one if None.

        Raises:
            PronkError: There is no such simulator, or it cannot be used here.
        """
        if self.framework is not None:
            return joint_rigs("mujoco", self.robot, threads=threads)
        return joint_rigs(self.name, self.robot, threads=threads, python=python)

    def require_mujoco(self) -> None:
        """Refuse simulators that move one joint at a time only.

        Raises:
            PronkError: The simulator is neither MuJoCo nor a framework, which MuJoCo computes.
        """
        if not self.uses_mujoco:
            raise PronkError(
                f"simulator {self.name}: several joints of these logs move at once, which only "
                "simulator mujoco matches; record one joint at a time."
            )

    def info(self, rigs: JointRigs | None = None) -> SimulatorInfo:
        """Describe the simulator that the gains hold for; that of MuJoCo without rigs."""
        if self.framework is not None:
            return replace(self.framework.info, decimation=self.robot.decimation)
        return mujoco_info(self.robot) if rigs is None else rigs.info

    def require_stable(self, gains: Mapping[str, JointGains]) -> None:
        """Refuse gains that are not stable at the step of a framework.

        Raises:
            PronkError: The message names a smaller step.
        """
        if self.framework is None:
            return
        drives = []
        for name, joint_gains in gains.items():
            drives.append(
                MatchedDrive(
                    joints=(name,),
                    stiffness=joint_gains.stiffness.value,
                    damping=joint_gains.damping.value,
                    armature=joint_gains.armature.value,
                )
            )
        require_stable(self.framework, self.robot, drives)


@dataclass(frozen=True, kw_only=True)
class MatchedDrive:
    """Drive of one matched joint, for the stability limit of a framework."""

    joints: tuple[str, ...]
    """Name of the joint, alone."""
    stiffness: float
    """Stiffness of the drive [N m/rad]."""
    damping: float
    """Damping of the drive [N m s/rad]."""
    armature: float
    """Rotor inertia at the joint [kg m^2]."""


def find_simulation(simulator: str, robot: RobotSpec) -> Simulation:
    """Find what a simulator's name means.

    Args:
        simulator: `mujoco`, a profile with or without settings, `FILE.py:NAME`, or the name of an
            installed simulator.
        robot: The robot.

    Raises:
        PronkError: A setting of a profile is not known or out of range.
    """
    if simulator.split(",")[0] in load_profiles():
        framework = profile(simulator)
        return Simulation(name=simulator, robot=framework.robot(robot), framework=framework)
    return Simulation(name=simulator, robot=robot)
