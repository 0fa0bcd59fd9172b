"""Robots of one size or another, of files: fingers of grams, arms, legs of fifty kilograms."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec

JOINT = "bend"
"""Name of the joint that moves the last link."""


@dataclass(frozen=True, kw_only=True)
class Size:
    """A chain of equal links, and the drive of each."""

    mass: float
    """Mass of a link, a slender rod [kg]."""
    length: float
    """Length of a link [m]."""
    stiffness: float
    """Stiffness of a drive [N m/rad]."""
    damping: float
    """Damping of a drive [N m s/rad]."""
    effort_limit: float
    """Effort limit of a drive [N m]."""
    armature: float = 0.0
    """Armature of a joint [kg m^2]."""
    frictionloss: float = 0.0
    """Dry friction of a joint [N m]."""
    links: int = 1
    """Number of links; the last joint is `JOINT`."""


SIZES = {
    "finger of 5 g": Size(
        mass=0.005, length=0.03, stiffness=0.05, damping=0.0006, effort_limit=0.1
    ),
    "finger that is damped far above critical": Size(
        mass=0.02, length=0.04, stiffness=3.0, damping=0.1, effort_limit=3.0, links=2
    ),
    "servo": Size(
        mass=0.06,
        length=0.1,
        stiffness=5.0,
        damping=0.12,
        effort_limit=3.0,
        armature=0.001,
        frictionloss=0.02,
    ),
    "wrist of a stiff arm": Size(
        mass=0.3, length=0.15, stiffness=2000.0, damping=200.0, effort_limit=300.0, links=2
    ),
    "knee without armature": Size(
        mass=1.5, length=0.35, stiffness=500.0, damping=40.0, effort_limit=1000.0, links=2
    ),
    "leg of 50 kg": Size(
        mass=50.0, length=0.9, stiffness=9000.0, damping=600.0, effort_limit=4000.0, armature=2.0
    ),
}
"""Robots from 5 g to 50 kg, by what they are like."""


def sized_robot(size: Size, folder: Path) -> RobotSpec:
    """Write a robot's model and robot.yaml into a folder, and load it."""
    names = [f"hold{index}" for index in range(1, size.links)] + [JOINT]
    moment = size.mass * size.length**2 / 12.0
    body = ""
    # From the last link to the first, which holds it.
    for index, name in reversed(list(enumerate(names))):
        # Axes that cross, so that links do not only swing in one plane.
        axis = "0 1 0" if index % 2 == 0 else "1 0 0"
        place = 0.0 if index == 0 else -size.length
        body = (
            f'<body name="{name} link" pos="0 0 {place}">'
            f'<joint name="{name}" axis="{axis}" range="-2.5 2.5" limited="true"/>'
            f'<inertial pos="0 0 {-0.5 * size.length}" mass="{size.mass}" '
            f'diaginertia="{moment} {moment} {0.1 * moment}"/>{body}</body>'
        )
    model = (
        '<mujoco model="sized"><compiler angle="radian"/><worldbody><body name="base">'
        f'<inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/>{body}</body></worldbody>'
        "</mujoco>"
    )
    (folder / "sized.xml").write_text(model)
    groups = ""
    poses = ""
    for name in names:
        groups += (
            f"  {name}: {{drive: motor, stiffness: {size.stiffness}, damping: {size.damping}, "
            "band_hz: [0.5, 15]}\n"
        )
        poses += f"    {name}: 0.3\n"
    (folder / "robot.yaml").write_text(
        "schema: pronk/robot/1\nname: sized\nmodel: sized.xml\ndrives:\n"
        f"  motor: {{effort_limit: {size.effort_limit}, stall_torque: {2 * size.effort_limit}, "
        f"no_load_speed: 60, armature: {size.armature}, frictionloss: {size.frictionloss}}}\n"
        f"groups:\n{groups}poses:\n  default:\n{poses}"
    )
    return load_robot(str(folder / "robot.yaml"))
