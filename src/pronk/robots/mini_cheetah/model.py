"""The Mini Cheetah Vision as a MuJoCo model: dynamics from the constants, drawn without meshes.

Joint axes (Cheetah-Software's convention): hip_roll turns about +x (positive lifts the left legs
outwards, tucks the right ones in), hip_pitch and knee about -y. At zero all legs hang straight
down; (0, -0.8, 1.6) has the thigh pointing back and down, the shank forward and down, the knee
bent backward and the foot under the hip.

Only the feet, thighs, shanks and the trunk touch anything, and only what is not the robot:
geoms have conaffinity 1 and contype 0, a floor has both.
"""

from __future__ import annotations

import math
from typing import Any

import mujoco

from pronk.robots.inertia import Inertia
from pronk.robots.mini_cheetah import constants as c

_SHELL = (0.16, 0.17, 0.19, 1.0)
_PLATE = (0.55, 0.57, 0.60, 1.0)
_MOTOR = (0.23, 0.24, 0.27, 1.0)
_CAP = (0.72, 0.74, 0.77, 1.0)
_LIMB = (0.80, 0.82, 0.84, 1.0)
_RUBBER = (0.04, 0.04, 0.045, 1.0)
_LENS = (0.02, 0.03, 0.08, 1.0)

_MOTOR_RADIUS = 0.047  # actuator module, 96 mm across and 40 mm deep (Katz, MIT thesis 2018)
_MOTOR_HALF = 0.02
_FOOT_FRICTION = (0.8, 0.02, 0.01)
"""Rubber on floor; training draws it anew (D2)."""

_X_AXIS = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)  # quaternion that turns a cylinder's z to x
_Y_AXIS = (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0)  # and to y


def build_spec() -> mujoco.MjSpec:
    """The free robot: trunk with a free joint `root`, twelve hinges, no actuators, no floor."""
    spec = mujoco.MjSpec()
    spec.modelname = "mini_cheetah"
    spec.compiler.degree = False
    trunk = spec.worldbody.add_body(name="trunk", pos=(0.0, 0.0, standing_height()))
    trunk.add_freejoint(name="root")
    _set_inertia(trunk, c.TRUNK)
    trunk.add_site(name="imu", size=(0.005, 0.005, 0.005), group=4)
    _draw_trunk(trunk)
    trunk.add_geom(
        name="trunk_collision",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(c.HIP_X + 0.01, 0.07, c.TRUNK_HEIGHT / 2),
        **_collision(),
    )
    for leg in c.LEGS:
        _add_leg(trunk, leg)
    return spec


def standing_height() -> float:
    """Height of the trunk's centre over the floor in the default pose [m]."""
    pitch, knee = c.DEFAULT_POSITION["hip_pitch"], c.DEFAULT_POSITION["knee"]
    leg = c.THIGH_LENGTH * math.cos(pitch) + c.SHANK_LENGTH * math.cos(pitch + knee)
    return leg + c.FOOT_RADIUS


def _add_leg(trunk: Any, leg: str) -> None:
    front = 1.0 if leg[0] == "F" else -1.0
    side = 1.0 if leg[1] == "L" else -1.0
    links = {name: link if side > 0.0 else link.mirrored() for name, link in c.LEFT_LINKS.items()}

    hip = trunk.add_body(name=f"{leg}_hip", pos=(front * c.HIP_X, side * c.HIP_Y, 0.0))
    _add_hinge(hip, leg, "hip_roll", (1.0, 0.0, 0.0))
    _set_inertia(hip, links["hip"])
    _draw_hip(hip, front, side)

    thigh = hip.add_body(name=f"{leg}_thigh", pos=(0.0, side * c.ABAD_LENGTH, 0.0))
    _add_hinge(thigh, leg, "hip_pitch", (0.0, -1.0, 0.0))
    _set_inertia(thigh, links["thigh"])
    _draw_thigh(thigh, side)
    thigh.add_geom(
        name=f"{leg}_thigh_collision",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=(0.0, 0.0, -0.03, 0.0, 0.0, -c.THIGH_LENGTH),
        size=(0.022, 0.0, 0.0),
        **_collision(),
    )

    shank = thigh.add_body(name=f"{leg}_shank", pos=(0.0, side * c.KNEE_Y, -c.THIGH_LENGTH))
    _add_hinge(shank, leg, "knee", (0.0, -1.0, 0.0))
    _set_inertia(shank, links["shank"])
    _draw_shank(shank)
    shank.add_geom(
        name=f"{leg}_shank_collision",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=(0.0, 0.0, -0.02, 0.0, 0.0, -c.SHANK_LENGTH + 0.03),
        size=(0.01, 0.0, 0.0),
        **_collision(),
    )
    shank.add_geom(
        name=f"{leg}_foot_collision",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        pos=(0.0, 0.0, -c.SHANK_LENGTH),
        size=(c.FOOT_RADIUS, 0.0, 0.0),
        priority=1,
        friction=_FOOT_FRICTION,
        **_collision(),
    )
    shank.add_site(
        name=f"{leg}_foot", pos=(0.0, 0.0, -c.SHANK_LENGTH), size=(0.005, 0.005, 0.005), group=4
    )


def _add_hinge(body: Any, leg: str, joint: str, axis: tuple[float, float, float]) -> None:
    body.add_joint(
        name=f"{leg}_{joint}",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=axis,
        range=c.RANGE[joint],
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
    )


def _set_inertia(body: Any, inertia: Inertia) -> None:
    body.mass = inertia.mass
    body.ipos = inertia.com
    body.fullinertia = inertia.products
    body.explicitinertial = True


def _collision() -> dict[str, Any]:
    return {
        "group": 3,
        "contype": 0,
        "conaffinity": 1,
        "condim": 3,
        "mass": 0.0,
        "rgba": (0.9, 0.4, 0.1, 0.4),
    }


# --- Drawing (geoms of group 2, without mass or contact) ----------------------------------------


def _box(body: Any, pos: Any, half: Any, rgba: Any, quat: Any = (1.0, 0.0, 0.0, 0.0)) -> None:
    _draw(body, mujoco.mjtGeom.mjGEOM_BOX, pos=pos, size=half, rgba=rgba, quat=quat)


def _disc(body: Any, pos: Any, radius: float, half: float, rgba: Any, axis: Any = _Y_AXIS) -> None:
    size = (radius, half, 0.0)
    _draw(body, mujoco.mjtGeom.mjGEOM_CYLINDER, pos=pos, size=size, rgba=rgba, quat=axis)


def _rod(body: Any, ends: Any, radius: float, rgba: Any) -> None:
    _draw(body, mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends, size=(radius, 0.0, 0.0), rgba=rgba)


def _draw(body: Any, kind: Any, **shape: Any) -> None:
    body.add_geom(type=kind, group=2, contype=0, conaffinity=0, mass=0.0, **shape)


def _draw_trunk(trunk: Any) -> None:
    long, wide, high = c.HIP_X - 0.085, 0.062, 0.036
    _box(trunk, (0.0, 0.0, 0.0), (long, wide + 0.012, high), _SHELL)
    _box(trunk, (0.0, 0.0, 0.0), (long, wide, high + 0.012), _SHELL)
    for y in (-wide, wide):
        for z in (-high, high):
            _rod(trunk, (-long, y, z, long, y, z), 0.012, _SHELL)
    for y in (-0.04, 0.04):  # handles along the back
        _rod(trunk, (-long + 0.02, y, 0.055, long - 0.02, y, 0.055), 0.005, _PLATE)
    for x in (-1.0, 1.0):
        _box(trunk, (x * (c.HIP_X - 0.083), 0.0, 0.0), (0.003, 0.098, 0.05), _PLATE)
        for y in (-c.HIP_Y, c.HIP_Y):
            motor_x = x * (c.HIP_X - 0.06)
            _disc(trunk, (motor_x, y, 0.0), _MOTOR_RADIUS, _MOTOR_HALF, _MOTOR, _X_AXIS)
    nose = c.HIP_X - 0.03  # camera head between the front legs, what makes it the Vision
    _box(trunk, (nose, 0.0, 0.0), (0.05, 0.038, 0.032), _SHELL)
    _rod(trunk, (nose + 0.045, -0.03, 0.02, nose + 0.045, 0.03, 0.02), 0.0125, _CAP)
    _rod(trunk, (nose + 0.045, -0.04, -0.015, nose + 0.045, 0.04, -0.015), 0.012, _MOTOR)
    for y in (-0.024, 0.0, 0.024):
        _disc(trunk, (nose + 0.0565, y, 0.02), 0.006, 0.002, _LENS, _X_AXIS)
    for y in (-0.03, 0.03):
        _disc(trunk, (nose + 0.0555, y, -0.015), 0.008, 0.002, _LENS, _X_AXIS)


def _draw_hip(hip: Any, front: float, side: float) -> None:
    _disc(hip, (-front * 0.032, 0.0, 0.0), 0.034, 0.008, _PLATE, _X_AXIS)
    _box(hip, (-front * 0.03, side * 0.02, 0.0), (0.01, 0.026, 0.03), _PLATE)
    _disc(hip, (0.0, side * 0.035, 0.0), _MOTOR_RADIUS - 0.001, _MOTOR_HALF - 0.002, _MOTOR)
    _disc(hip, (0.0, side * 0.014, 0.0), 0.034, 0.004, _CAP)


def _draw_thigh(thigh: Any, side: float) -> None:
    # Link in the plane of the leg, the knee's motor outside of it at the hip.
    _disc(thigh, (0.0, 0.0, 0.0), 0.045, 0.007, _LIMB)
    _disc(thigh, (0.0, side * 0.026, 0.0), _MOTOR_RADIUS, _MOTOR_HALF - 0.002, _MOTOR)
    _disc(thigh, (0.0, side * 0.045, 0.0), 0.036, 0.003, _CAP)
    for x in (-1.0, 1.0):
        ends = (x * 0.030, 0.0, -0.03, x * 0.012, 0.0, -c.THIGH_LENGTH)
        _rod(thigh, ends, 0.009, _LIMB)
    _box(thigh, (0.0, 0.0, -0.115), (0.019, 0.007, 0.085), _LIMB)
    _disc(thigh, (0.0, 0.0, -c.THIGH_LENGTH), 0.021, 0.012, _PLATE)


def _draw_shank(shank: Any) -> None:
    length = c.SHANK_LENGTH
    _disc(shank, (0.0, 0.0, 0.0), 0.016, 0.014, _MOTOR)
    _rod(shank, (0.0, 0.0, 0.0, 0.0, 0.0, -length * 0.5), 0.0105, _LIMB)
    _rod(shank, (0.0, 0.0, -length * 0.5, 0.0, 0.0, -length), 0.008, _LIMB)
    _rod(shank, (0.0, 0.0, -length + 0.03, 0.0, 0.0, -length), 0.012, _RUBBER)
    size = (c.FOOT_RADIUS, 0.0, 0.0)
    _draw(shank, mujoco.mjtGeom.mjGEOM_SPHERE, pos=(0.0, 0.0, -length), size=size, rgba=_RUBBER)
