"""One joint of a robot as a rigid body on a hinge, with a robot.yaml that a user would write.

A hinge whose neighbours are clamped has a constant inertia and a torque of gravity that is a sine
of its angle, so the joint of any robot is a few numbers. They come from a robot of the packages
(`robots.joints_of`) or are drawn. The model that pronk gets is an MJCF of one hinge with the same
numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

GRAVITY = 9.81
"""Of MuJoCo's default options [m/s^2]."""
LIGHTEST_KG = 0.005
HEAVIEST_KG = 50.0
NAME = "joint"
"""Name of the hinge in the model of a single joint."""


@dataclass(frozen=True, kw_only=True)
class RigidJoint:
    """A hinge with what moves about it."""

    robot: str
    """Robot that the numbers are of, and its joint."""
    mass: float
    """Mass of what moves [kg]."""
    link_inertia: float
    """Its inertia about the hinge [kg m^2]."""
    gravity_torque: float
    """Largest torque of gravity over a turn [N m]."""
    gravity_phase: float
    """Angle at which gravity pulls the joint by the largest torque towards negative angles [rad]:
    the torque of gravity is `-gravity_torque cos(q - gravity_phase)`."""
    armature: float
    """Rotor inertia at the joint [kg m^2]."""

    @property
    def inertia(self) -> float:
        """Inertia of link and rotor about the hinge [kg m^2]."""
        return self.link_inertia + self.armature

    def gravity_at(self, angle: float) -> float:
        """Return the torque of gravity at an angle [N m]."""
        return -self.gravity_torque * math.cos(angle - self.gravity_phase)

    def mjcf(self) -> str:
        """Write an MJCF of one hinge with these numbers."""
        # The hinge turns about -y, so that a positive angle lifts a body that lies along x.
        arm = self.gravity_torque / (self.mass * GRAVITY)
        about_centre = self.link_inertia - self.mass * arm**2
        # MuJoCo wants three inertias of which none is larger than the sum of the others.
        inertia = max(about_centre, 1e-9 * self.link_inertia)
        x = arm * math.cos(self.gravity_phase)
        z = -arm * math.sin(self.gravity_phase)
        return f"""\
<mujoco model="{self.robot}">
  <compiler angle="radian"/>
  <option gravity="0 0 -{GRAVITY}"/>
  <worldbody>
    <body name="link">
      <inertial pos="{x:.12g} 0 {z:.12g}" mass="{self.mass:.12g}"
        diaginertia="{inertia:.12g} {inertia:.12g} {inertia:.12g}"/>
      <joint name="{NAME}" axis="0 -1 0" range="-3 3" limited="true"/>
    </body>
  </worldbody>
</mujoco>
"""


@dataclass(frozen=True, kw_only=True)
class StatedDrive:
    """What the robot.yaml says of the drive of a joint."""

    stiffness: float
    """Gains that are set on the drive [N m/rad], [N m s/rad]."""
    damping: float
    effort_limit: float
    """Largest torque [N m]."""
    no_load_speed: float
    """Speed at which the drive has no torque [rad/s]."""
    band_hz: tuple[float, float]
    """Band of the joint's match [Hz]."""


def draw_joint(rng: np.random.Generator) -> RigidJoint:
    """Draw a joint whose link weighs from 5 g to 50 kg, uniform in the logarithm of the mass."""
    mass = float(np.exp(rng.uniform(math.log(LIGHTEST_KG), math.log(HEAVIEST_KG))))
    # 3 cm at 5 g and 0.65 m at 50 kg, as of bodies of one density.
    length = 0.03 * (mass / LIGHTEST_KG) ** (1.0 / 3.0) * rng.uniform(0.7, 1.5)
    arm = length * rng.uniform(0.3, 0.6)
    link_inertia = mass * (arm**2 + length**2 / 12.0)
    upright = rng.uniform(0.0, 1.0)  # cosine of the angle between the hinge and the horizontal
    return RigidJoint(
        robot="drawn",
        mass=mass,
        link_inertia=link_inertia,
        gravity_torque=mass * GRAVITY * arm * upright,
        gravity_phase=rng.uniform(-math.pi, math.pi),
        armature=draw_armature(rng, link_inertia),
    )


def draw_armature(rng: np.random.Generator, link_inertia: float) -> float:
    """Draw a rotor inertia of 5 % to twice the link's, uniform in the logarithm [kg m^2]."""
    return float(link_inertia * np.exp(rng.uniform(math.log(0.05), math.log(2.0))))


def write_robot(folder: Path, joint: RigidJoint, stated: StatedDrive) -> Path:
    """Write model and robot.yaml of a joint into a folder; return the path of the robot.yaml."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(joint.mjcf(), encoding="utf-8")
    path = folder / "robot.yaml"
    path.write_text(
        f"""\
schema: pronk/robot/1
name: {joint.robot}
model: model.xml
policy_rate_hz: 50.0
timestep_s: 0.005
decimation: 4
grid_stiffness: [{0.3 * stated.stiffness:.9e}, {3.0 * stated.stiffness:.9e}]
grid_damping: [{0.1 * stated.damping:.9e}, {4.0 * stated.damping:.9e}]
drives:
  drive:
    effort_limit: {stated.effort_limit:.9e}
    stall_torque: {4.0 * stated.effort_limit:.9e}
    no_load_speed: {stated.no_load_speed:.9e}
    armature: {joint.armature:.9e}
groups:
  {NAME}:
    drive: drive
    stiffness: {stated.stiffness:.9e}
    damping: {stated.damping:.9e}
    band_hz: [{stated.band_hz[0]:.6f}, {stated.band_hz[1]:.6f}]
poses:
  default:
    {NAME}: 0.0
""",
        encoding="utf-8",
    )
    return path
