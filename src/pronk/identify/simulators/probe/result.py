"""What a probe finds of a joint: the law by which it moves, what acts, and what is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from pronk.robots.drive_law import DriveLaw

LARGE_RESIDUAL = 0.01
"""Share of the motion that a right answer leaves unexplained at most."""


@dataclass(frozen=True, kw_only=True)
class ActingLaw:
    """A law by which a joint moves."""

    drive: DriveLaw
    """Law of the engine's drive."""
    beside_explicit: bool = False
    """True if the drive acts beside an explicit torque of the same gains."""
    soft_friction: bool = False
    """True if dry friction is MuJoCo's soft constraint, in which a joint that is held creeps."""
    stale_position: int = 0
    """Age of the position from which the torque is computed [steps]."""
    stale_speed: int = 0
    """Age of the speed from which the torque is computed [steps]."""
    clip: float | None = None
    """Torque [N m] or command about the pose [rad] at which it is clipped below the effort limit;
    None where no limit was met."""

    @property
    def label(self) -> str:
        """Short name."""
        name = self.drive.label
        if self.beside_explicit:
            name = f"E, beside it {name}"
        if self.stale_position:
            name += f" of an old position (steps: {self.stale_position})"
        return name

    def moves_as(self, other: ActingLaw) -> bool:
        """Tell whether two laws are the same but for the kind of dry friction."""
        return replace(self, soft_friction=other.soft_friction) == other


@dataclass(frozen=True, kw_only=True)
class Clip:
    """A limit that was found in the response to steps of many heights."""

    height: float
    """Height of a step from which on the joint goes no further in its first step [rad]."""
    of_torque: bool
    """True if the torque is clipped, False if the command is."""
    acting: float
    """Share of its first step for which the command acts, about: the rest is delay."""


@dataclass(frozen=True, kw_only=True)
class ActingGains:
    """What acts of the gains that are set."""

    stiffness_factor: float
    """Stiffness that acts over the one that is set."""
    damping_factor: float
    """Damping that acts over the one that is set."""
    stable_share: float
    """Share of the gains at which the simulator is stable: 1, or less."""


@dataclass(frozen=True, kw_only=True)
class Probe:
    """What a joint responds like."""

    joint: str
    """Name of the joint."""
    law: ActingLaw
    """Law by which it moves."""
    gains: ActingGains
    """What acts of the gains that are set."""
    armature: float
    """Armature that acts [kg m^2]."""
    armature_applied: float | None
    """Share of a change of the armature that acts; None where it cannot be set."""
    viscous_damping: float
    """Passive damping that acts [N m s/rad]."""
    frictionloss: float
    """Dry friction that acts [N m]."""
    gravity: float
    """Share of gravity that acts."""
    delay_s: float
    """Delay of the command [s]."""
    hold: int
    """Steps that a command is held for."""
    residual: float
    """RMS of the motion that the answer does not explain, as a share of the motion."""
    complete: bool
    """False if the limit of integration steps ended the fits before all laws were fitted."""
    alike: tuple[ActingLaw, ...] = ()
    """Other laws that explain the motion as well."""
    faults: Mapping[str, str] = field(default_factory=dict)
    """What acts otherwise than it is set: a word for each, and a sentence."""

    @property
    def law_found(self) -> bool:
        """Whether the law explains the motion and all laws were fitted."""
        return self.complete and self.residual <= LARGE_RESIDUAL
