"""The simulator that gains hold for, and what is known of it without running it."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version

from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec


@dataclass(frozen=True, kw_only=True)
class SimulatorInfo:
    """The simulator that gains hold for. In another one the same numbers give another joint."""

    profile: str = ""
    """A name in `profiles.yaml`; empty for a simulator without one."""
    engine: str = "mujoco"
    """Name of the physics engine."""
    version: str = ""
    """Version of the engine."""
    timestep_s: float = 0.005
    """Physics step [s]."""
    decimation: int = 4
    """Physics steps for which a command of the policy is held."""
    integrator: str = "implicitfast"
    """Integrator of the engine, in its own words."""
    actuator: str = "dc_motor_pd"
    """The engine's drive. The default is an explicit PD on position and velocity at the start of
    each physics step, clipped by the torque-speed curve (mjlab's DcMotorActuator)."""
    law: str = "explicit"
    """`DriveLaw.kind` of the drive."""
    iterations: int = 1
    """`DriveLaw.iterations` of the drive."""

    @property
    def drive_law(self) -> DriveLaw:
        """How stiffness and damping act over a step."""
        return DriveLaw(kind=self.law, iterations=self.iterations)  # type: ignore[arg-type]


def mujoco_info(robot: RobotSpec) -> SimulatorInfo:
    """Describe the training simulator of a robot."""
    return SimulatorInfo(
        profile="mjlab",
        version=version("mujoco"),
        timestep_s=robot.timestep_s,
        decimation=robot.decimation,
    )
