"""Profiles: the frameworks that gains can be matched for, without any of them installed.

A profile is a drive law (`pronk.robots.drive_law`) with the step, the delays and the joint friction
of one framework. MuJoCo computes all of them. Frameworks with the same law, step and friction need
the same gains.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal, cast, get_args

from pronk.errors import PronkError
from pronk.files import converted, read_yaml
from pronk.identify.simulators.info import SimulatorInfo
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import Joint, RobotSpec

Friction = Literal["N m", "coefficient", "none"]
FILE = Path(__file__).with_name("profiles.yaml")
_NO_CURVE = 1e4
"""No-load speed of a drive whose torque does not depend on its speed [rad/s]."""


@dataclass(frozen=True, kw_only=True)
class Profile:
    """The joint of one framework."""

    framework: str
    """Framework, and the actuator of it that the profile holds for."""
    engine: str
    """Physics engine of the framework."""
    integrator: str
    """Integrator of the engine, in its own words."""
    actuator: str
    """The framework's drive, by its own name."""
    law: Literal["explicit", "implicit_damping", "implicit"]
    """`DriveLaw.kind` of the drive."""
    iterations: int = 1
    """`DriveLaw.iterations` of the drive."""
    passive_damping: Literal["implicit", "explicit"] = "implicit"
    """`DriveLaw.passive_damping` of the joints."""
    timestep_s: float
    """Physics step [s]."""
    decimation: int
    """Physics steps a command as the framework's tasks have it; a match takes the robot's."""
    delay: Literal["steps", "none"]
    """Delay of a command that can be set: whole physics steps, or none."""
    friction: Friction
    """Dry friction of a joint: a torque, PhysX's coefficient of the joint's constraint force, or
    not there. Only a torque is matched."""
    speed_curve: bool = False
    """True if the torque-speed line of the motor limits the torque, not the effort limit alone."""
    source: str
    """Where timestep, decimation and iterations come from."""
    name: str = ""
    """Name of the profile in its file."""

    def __post_init__(self) -> None:
        """Refuse an impossible step or law, and friction of an unknown kind."""
        if not 1e-5 <= self.timestep_s <= 0.05:
            raise PronkError(
                f"profile {self.name}: timestep_s {self.timestep_s:g}; expected 1e-5 to 0.05 s."
            )
        if self.friction not in get_args(Friction):
            raise PronkError(
                f"profile {self.name}: friction {self.friction!r}; expected "
                f"{', '.join(get_args(Friction))}."
            )
        # An impossible law is refused where it is made.
        DriveLaw(kind=self.law, iterations=self.iterations, passive_damping=self.passive_damping)

    @property
    def drive_law(self) -> DriveLaw:
        """How stiffness, damping and passive damping act over a step."""
        return DriveLaw(
            kind=self.law, iterations=self.iterations, passive_damping=self.passive_damping
        )

    @property
    def info(self) -> SimulatorInfo:
        """The simulator that gains hold for which are matched for the profile."""
        return SimulatorInfo(
            profile=self.name,
            engine=self.engine,
            timestep_s=self.timestep_s,
            decimation=self.decimation,
            integrator=self.integrator,
            actuator=self.actuator,
            law=self.law,
            iterations=self.iterations,
        )

    def joint(self, joint: Joint) -> Joint:
        """Return a joint with the limits and the friction that the framework has."""
        drive = joint.drive
        if not self.speed_curve:
            drive = replace(drive, stall_torque=drive.effort_limit, no_load_speed=_NO_CURVE)
        if self.friction != "N m":
            drive = replace(drive, frictionloss=0.0, stribeck_speed=0.0)
        return replace(joint, drive=drive)

    def robot(self, robot: RobotSpec) -> RobotSpec:
        """Return a robot as the framework simulates it, commanded at the robot's own rate.

        Raises:
            PronkError: The period of the robot's commands is no multiple of the timestep.
        """
        ticks = 1.0 / (robot.policy_rate_hz * self.timestep_s)
        if round(ticks) < 1 or abs(ticks - round(ticks)) > 1e-6:
            raise PronkError(
                f"profile {self.name}: {robot.name} is commanded at {robot.policy_rate_hz:g} Hz, "
                f"which is {ticks:.4g} steps of {1000.0 * self.timestep_s:g} ms; expected a whole "
                f"number, as {self.name},timestep_s=VALUE gives."
            )
        return replace(
            robot,
            timestep_s=self.timestep_s,
            decimation=round(ticks),
            law=self.drive_law,
            joints=tuple(self.joint(joint) for joint in robot.joints),
        )


@cache
def load_profiles() -> Mapping[str, Profile]:
    """Read all profiles by name, in the order of their file."""
    profiles = {}
    for name, fields in read_yaml(FILE).items():
        profiles[name] = converted({**fields, "name": name}, Profile, FILE)
    return profiles


def profile(text: str) -> Profile:
    """Return a profile by its name, with some settings changed.

    Args:
        text: NAME, or NAME,timestep_s=S,iterations=N,friction=none with any of these settings.

    Raises:
        PronkError: The name or a setting is unknown, or a value is out of range.
    """
    name, *settings = text.split(",")
    profiles = load_profiles()
    if name not in profiles:
        raise PronkError(f"profile {name!r}; expected one of {', '.join(profiles)}.")
    chosen = profiles[name]
    for setting in settings:
        key, _, value = setting.partition("=")
        try:
            if key == "timestep_s":
                chosen = replace(chosen, timestep_s=float(value))
            elif key == "iterations":
                chosen = replace(chosen, iterations=int(value))
            elif key == "friction":
                chosen = replace(chosen, friction=cast(Friction, value))
            else:
                raise PronkError(
                    f"profile {text}: setting {key!r}; expected timestep_s, iterations, friction."
                )
        except ValueError:
            raise PronkError(f"profile {text}: {key} {value!r}; expected a number.") from None
    return chosen


def profile_of(info: SimulatorInfo) -> Profile:
    """Return the profile that gains hold for, with the step and the iterations of the gains.

    Raises:
        PronkError: There is no profile of that simulator.
    """
    name = info.profile
    if not name:
        name = "mjlab" if info.engine == "mujoco" else info.engine
    return profile(f"{name},timestep_s={info.timestep_s!r},iterations={info.iterations}")
