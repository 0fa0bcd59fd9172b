"""RobotSpec: a robot as data, with its joints, drives, gains, and the bench test of each joint."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from pronk.errors import RobotError
from pronk.names import check_names
from pronk.robots.drive_law import EXPLICIT, DriveLaw
from pronk.robots.limits import OperatingLimits

if TYPE_CHECKING:
    import mujoco

ServoKind = Literal["position", "velocity", "motor", "none"]
"""What drives a joint in a model: a position servo, a velocity servo, a motor whose command is a
force, or nothing."""


@dataclass(frozen=True, kw_only=True)
class Drive:
    """Motor, gearbox and inverter of one joint.

    Quantities are those at the joint, behind the gear, unless their text says motor side.
    """

    gear_ratio: float
    """Revolutions of the motor per revolution of the joint."""
    rotor_inertia: float
    """Inertia of the rotor about its axis, motor side [kg m^2]."""
    stall_torque: float
    """Torque at standstill with the full bus voltage across the winding, where the torque-speed
    line begins; the effort limit cuts the line off below it [N m]."""
    no_load_speed: float
    """Speed at which back-EMF equals the bus voltage [rad/s]."""
    effort_limit: float
    """Largest torque that the inverter may command [N m]."""
    frictionloss: float
    """Dry (Coulomb) friction [N m]."""
    viscous_damping: float
    """Viscous friction [N m s/rad]."""
    bus_voltage: float
    """Nominal voltage of the supply [V]."""
    resistance: float
    """Resistance of the winding of one phase, motor side [ohm]."""
    torque_constant: float
    """Torque per ampere, motor side [N m/A]."""
    stribeck_speed: float = 0.0
    """Speed V of dry friction `F (1 - share (1 - exp(-(speed / V)^2)))`, whose share a match of
    whole chains fits [rad/s]; 0 if the dry friction F does not depend on speed."""

    def __post_init__(self) -> None:
        """Refuse values that must be positive and are not, negative friction, and infinities."""
        positive = {
            "gear_ratio": self.gear_ratio,
            "stall_torque": self.stall_torque,
            "no_load_speed": self.no_load_speed,
            "effort_limit": self.effort_limit,
            "bus_voltage": self.bus_voltage,
            "resistance": self.resistance,
            "torque_constant": self.torque_constant,
        }
        for name, value in positive.items():
            if not 0.0 < value < math.inf:
                raise RobotError(f"Drive.{name} is {value}; expected positive and finite.")
        not_negative = {
            "rotor_inertia": self.rotor_inertia,
            "frictionloss": self.frictionloss,
            "viscous_damping": self.viscous_damping,
            "stribeck_speed": self.stribeck_speed,
        }
        for name, value in not_negative.items():
            if not 0.0 <= value < math.inf:
                raise RobotError(f"Drive.{name} is {value}; expected 0 or more, and finite.")

    @property
    def armature(self) -> float:
        """Rotor inertia at the joint, `rotor_inertia * gear_ratio**2` [kg m^2]."""
        return self.rotor_inertia * self.gear_ratio**2

    @property
    def corner_speed(self) -> float:
        """Speed up to which the drive gives its effort limit [rad/s].

        Beyond it the torque falls in a straight line to nothing at the no-load speed; 0 where it
        falls from standstill on.
        """
        return max(0.0, self.no_load_speed * (1.0 - self.effort_limit / self.stall_torque))

    @property
    def motor(self) -> tuple[float, float]:
        """Constants (K, R) of the gearless one-phase motor with this torque-speed line.

        `K = V / no_load_speed` [N m/A] = [V s/rad] and `R = K V / stall_torque` [ohm], so that
        `torque = K (V - K speed) / R`.
        """
        constant = self.bus_voltage / self.no_load_speed
        resistance = constant * self.bus_voltage / self.stall_torque
        return constant, resistance


@dataclass(frozen=True, kw_only=True)
class Joint:
    """One actuated joint and how it is excited on the bench."""

    name: str
    """Name of the joint, `LEG_JOINT` for a robot with legs, for instance FR_hip_roll."""
    group: str
    """Name of the joints that are built alike and share training gains, for instance hip_roll."""
    drive: Drive
    """Motor, gearbox and inverter."""
    range: tuple[float, float]
    """Lower and upper mechanical limit [rad]."""
    default_position: float
    """Position in the default pose, also the pose of the sweep [rad]."""
    folded_position: float | None = None
    """Position of a robot that lies with its feet under its hips, ready to rise [rad]; None for one
    that does not stand."""
    stiffness: float
    """Nominal stiffness, the proportional gain on the real drive [N m/rad]."""
    damping: float
    """Nominal damping, the derivative gain on the real drive [N m s/rad]."""
    band_hz: tuple[float, float]
    """Lowest and highest frequency at which the match compares magnitudes [Hz]."""
    servo: ServoKind = "position"
    """What the model has for this joint; gains of joints without a position servo are assumed."""
    clamped: tuple[str, ...] = ()
    """Joints fixed mechanically while this one is excited; the rest are held by their drives."""
    chain: tuple[str, ...] = ()
    """Joints that can move when this one is excited on a fixed base, itself too, root first."""
    mirror: tuple[str, float] | None = None
    """The joint whose mechanism this one mirrors and the sign between their coordinates.

    With a fixed base, `position(self | command) == sign * position(mirror | sign * command)`.
    None for the original of each family.
    """
    own_name: str = ""
    """Name of the joint in the models of the robot's maker, for exports; empty if it is `name`."""

    @property
    def parameters(self) -> dict[str, float]:
        """Nominal stiffness, damping, armature and frictionloss, as a simulator sets them."""
        return {
            "stiffness": self.stiffness,
            "damping": self.damping,
            "armature": self.drive.armature,
            "frictionloss": self.drive.frictionloss,
        }

    @property
    def original(self) -> tuple[str, float]:
        """Joint to simulate in place of this one, and the sign between their coordinates."""
        return self.mirror or (self.name, 1.0)


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """A robot: its joints, the timing of its commands, and a recipe for its MuJoCo model."""

    name: str
    """Name of the robot, which logs, gains and policies hold."""
    joints: tuple[Joint, ...]
    """Joints in the order of the model, which every file and table keeps."""
    build_spec: Callable[[], mujoco.MjSpec] = field(repr=False)
    """Function that builds a fresh model without actuators, free-floating or, for an arm, fixed."""
    base_body: str
    """Body that the bench holds still."""
    held_joints: tuple[str, ...] = ()
    """Joints of the model that stand still and are none of `joints`: slides, ball joints, followers
    and hinges that nothing drives."""
    held_reasons: Mapping[str, str] = field(default_factory=dict)
    """Why some of them are held, where their model says why."""
    legs: tuple[str, ...] = ()
    """Prefixes of the joints of each leg, from the hip down; empty for a robot without legs."""
    source: str = ""
    """What `load_robot` reads the robot from: a shipped name or a path."""
    policy_rate_hz: float = 50.0
    """Rate of the commands to the joints [Hz]."""
    timestep_s: float = 0.005
    """Physics step of the training simulator [s]."""
    decimation: int = 4
    """Physics steps per policy step."""
    law: DriveLaw = EXPLICIT
    """How the simulator applies stiffness and damping."""
    grid_stiffness: tuple[float, float] = (13.0, 27.0)
    """Stiffness axis of the grid search [N m/rad] (paper F7)."""
    grid_damping: tuple[float, float] = (0.1, 0.7)
    """Damping axis of the grid search [N m s/rad] (paper F7)."""
    limits: OperatingLimits = field(default_factory=OperatingLimits)
    """Limits of commands and measurements, for the safety filter of a deployment."""

    def __repr__(self) -> str:
        """Name the robot, the number of its joints and its timing."""
        return (
            f"<RobotSpec {self.name}: {len(self.joints)} joints, commands at "
            f"{self.policy_rate_hz:g} Hz, timestep {self.timestep_s:g} s>"
        )

    def __post_init__(self) -> None:
        """Check that names are unique and every reference resolves."""
        names = self.joint_names
        check_names((self.name, *names, *self.groups), self.source or "robot", RobotError)
        if len(set(names)) != len(names):
            raise RobotError(f"{self.name}: a joint is named twice in {', '.join(names)}.")
        for joint in self.joints:
            for other in (*joint.clamped, *joint.chain, joint.original[0]):
                self.joint(other)
        for leg in self.legs:
            if not any(name.startswith(f"{leg}_") for name in names):
                raise RobotError(f"{self.name}: the leg {leg!r} has no joint {leg}_*.")

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names in the order of every file and table."""
        return tuple(joint.name for joint in self.joints)

    @property
    def groups(self) -> tuple[str, ...]:
        """Joint groups in order of first appearance."""
        return tuple(dict.fromkeys(joint.group for joint in self.joints))

    def joint(self, name: str) -> Joint:
        """Return the joint of a name; a RobotError for an unknown one lists the joints."""
        for joint in self.joints:
            if joint.name == name:
                return joint
        if name in self.held_joints:
            reason = self.held_reasons.get(name, "its robot.yaml names it under `held`")
            raise RobotError(
                f"{name} of {self.name} is held at a position and not driven ({reason}). To drive "
                "a hinge to a position all the same, take it out of `held` in its robot.yaml, and "
                "state its drive, a group with its stiffness and damping, and its pose; the joints "
                f"that are driven are {', '.join(self.joint_names)}."
            )
        raise RobotError(
            f"{self.name} has no joint {name!r}; its joints are {', '.join(self.joint_names)}."
        )

    def branches(self, names: Collection[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
        """Divide some joints by the chains that hold them.

        With the base fixed the chains move independently. Each is the shortest of those that hold
        most of the joints that no earlier one holds.

        Args:
            names: Names of joints.

        Yields:
            The joint whose chain it is, and those of `names` that the chain holds.
        """
        remaining = [name for name in self.joint_names if name in names]
        while remaining:
            candidates = [joint for joint in self.joints if remaining[0] in joint.chain]
            best = candidates[0]
            for candidate in candidates[1:]:
                if _covers_more(candidate.chain, best.chain, remaining):
                    best = candidate
            yield best.name, tuple(name for name in remaining if name in best.chain)
            remaining = [name for name in remaining if name not in best.chain]

    def group(self, name: str) -> tuple[Joint, ...]:
        """Return the joints of one group; a RobotError for an unknown one lists the groups."""
        members = tuple(joint for joint in self.joints if joint.group == name)
        if not members:
            raise RobotError(
                f"{self.name} has no joint group {name!r}; its groups are {', '.join(self.groups)}."
            )
        return members


def _covers_more(chain: Collection[str], best: Collection[str], names: Collection[str]) -> bool:
    """Return whether a chain holds more joints than the best one, or as many and is shorter."""
    count = len(set(chain) & set(names))
    best_count = len(set(best) & set(names))
    return count > best_count or (count == best_count and len(chain) < len(best))
