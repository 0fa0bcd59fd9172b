"""A robot as data: joints, drives, the gains on them, and the bench test of each joint."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pronk.errors import RobotError
from pronk.names import check_names
from pronk.robots.drive_law import EXPLICIT, DriveLaw
from pronk.robots.limits import OperatingLimits

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True, kw_only=True)
class Drive:
    """Motor, gearbox and inverter of one joint. Joint side unless the name contains motor."""

    gear_ratio: float
    """Motor revolutions per joint revolution."""
    rotor_inertia: float
    """Inertia of the rotor about its own axis, motor side [kg m^2]."""
    stall_torque: float
    """Torque at standstill with the full bus voltage across the winding [N m]."""
    no_load_speed: float
    """Speed at which back-EMF equals the bus voltage [rad/s]."""
    effort_limit: float
    """Largest torque that the inverter may command [N m]."""
    frictionloss: float
    """Dry (Coulomb) friction [N m]."""
    viscous_damping: float
    """Viscous friction [N m s/rad]."""
    bus_voltage: float
    """Nominal supply [V]."""
    resistance: float
    """Winding resistance, phase, motor side [ohm]."""
    torque_constant: float
    """Torque per ampere, motor side [N m/A]."""
    stribeck_speed: float = 0.0
    """Speed V of dry friction `F (1 - share (1 - exp(-(speed / V)^2)))`, whose share a match of
    whole chains fits [rad/s]; 0: the dry friction F does not depend on speed."""

    def __post_init__(self) -> None:
        """Refuse values that must be positive and are not, and negative friction."""
        positive = ("gear_ratio", "stall_torque", "no_load_speed", "effort_limit", "bus_voltage")
        least = ("rotor_inertia", "frictionloss", "viscous_damping", "stribeck_speed")
        for name in (*positive, *least):
            value = getattr(self, name)
            if not (value > 0.0 if name in positive else value >= 0.0):
                expected = "positive" if name in positive else "0 or more"
                raise RobotError(f"Drive.{name} is {value}; expected {expected}.")

    @property
    def armature(self) -> float:
        """Rotor inertia reflected through the gear, `rotor_inertia * gear_ratio**2` [kg m^2]."""
        return self.rotor_inertia * self.gear_ratio**2

    @property
    def motor(self) -> tuple[float, float]:
        """Constants of the gearless one-phase motor with this torque-speed line, joint side.

        `K = V / no_load_speed` [N m/A] = [V s/rad] and `R = K V / stall_torque` [ohm], so that
        `torque = K (V - K speed) / R`.
        """
        constant = self.bus_voltage / self.no_load_speed
        return constant, constant * self.bus_voltage / self.stall_torque


@dataclass(frozen=True, kw_only=True)
class Joint:
    """One actuated joint and how it is excited on the bench."""

    name: str
    """`LEG_JOINT`, for instance FR_hip_roll."""
    group: str
    """Joints that are built alike and share training gains, for instance hip_roll."""
    drive: Drive
    range: tuple[float, float]
    """Mechanical limits [rad]."""
    default_position: float
    """Position in the default pose, also the pose of the sweep [rad]."""
    folded_position: float | None = None
    """Position of a robot that lies with its feet under its hips, ready to rise [rad]; None for one
    that does not stand."""
    stiffness: float
    """Proportional gain on the real drive [N m/rad]."""
    damping: float
    """Derivative gain on the real drive [N m s/rad]."""
    band_hz: tuple[float, float]
    """Frequencies at which the match compares magnitudes [Hz]."""
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
    """Its name in the models of the robot's maker, for exports; empty if it is `name`."""

    @property
    def parameters(self) -> dict[str, float]:
        """Its own stiffness, damping, armature and frictionloss, as a simulator sets them."""
        drive = {"armature": self.drive.armature, "frictionloss": self.drive.frictionloss}
        return {"stiffness": self.stiffness, "damping": self.damping, **drive}

    @property
    def original(self) -> tuple[str, float]:
        """The joint to simulate in this one's place, and the sign between their coordinates."""
        return self.mirror or (self.name, 1.0)


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """A robot: joints in file order, timing, and a recipe for its MuJoCo model."""

    name: str
    joints: tuple[Joint, ...]
    build_spec: Callable[[], mujoco.MjSpec] = field(repr=False)
    """Builds a fresh, free-floating (or, for an arm, fixed) model without actuators."""
    base_body: str
    """Body that the bench holds still."""
    legs: tuple[str, ...] = ()
    """Prefixes of the joints of each leg, from the hip down; empty for a robot without legs."""
    source: str = ""
    """What `load_robot` reads it from: a shipped name or a path."""
    policy_rate_hz: float = 50.0
    timestep_s: float = 0.005
    """Physics step of the training simulator."""
    decimation: int = 4
    """Physics steps per policy step."""
    law: DriveLaw = EXPLICIT
    """How the simulator applies stiffness and damping."""
    grid_stiffness: tuple[float, float] = (13.0, 27.0)
    """Stiffness axis of the grid search [N m/rad] (paper F7)."""
    grid_damping: tuple[float, float] = (0.1, 0.7)
    """Damping axis of the grid search [N m s/rad] (paper F7)."""
    limits: OperatingLimits = field(default_factory=OperatingLimits)
    """Limits of its commands and measurements, for the safety filter of a deployment."""

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
        """The joint called `name`; a RobotError lists those there are."""
        for joint in self.joints:
            if joint.name == name:
                return joint
        raise RobotError(
            f"{self.name} has no joint {name!r}; its joints are {', '.join(self.joint_names)}."
        )

    def branches(self, names: Collection[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
        """Some joints by the chains that hold them; with the base fixed, these move independently.

        Yields the joint whose chain it is, the shortest with most of the joints that are left, and
        those of `names` that it holds.
        """
        left = [name for name in self.joint_names if name in names]
        while left:
            roots = [joint for joint in self.joints if left[0] in joint.chain]
            root = max(roots, key=lambda one: (len(set(one.chain) & set(left)), -len(one.chain)))
            yield root.name, tuple(name for name in left if name in root.chain)
            left = [name for name in left if name not in root.chain]

    def group(self, name: str) -> tuple[Joint, ...]:
        """The joints of one group, in file order; a RobotError lists the groups."""
        members = tuple(joint for joint in self.joints if joint.group == name)
        if not members:
            raise RobotError(
                f"{self.name} has no joint group {name!r}; its groups are {', '.join(self.groups)}."
            )
        return members
