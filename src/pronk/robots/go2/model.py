"""The Go2 as a MuJoCo model: dynamics from the constants, drawn without meshes.

Joint axes are Unitree's: hip_roll about +x, hip_pitch and knee about +y. At zero all legs hang
straight down; (0, 0.9, -1.8) has the thigh pointing back and down, the shank forward and down.
Only the feet and the trunk touch anything, and only what is not the robot.
"""

from __future__ import annotations

import math
from typing import Any

import mujoco

from pronk.robots.go2 import constants as c
from pronk.robots.inertia import Inertia

_SHELL = (0.80, 0.82, 0.84, 1.0)
_DARK = (0.16, 0.17, 0.19, 1.0)
_FOOT_FRICTION = (0.8, 0.02, 0.01)


def build_spec() -> mujoco.MjSpec:
    """The free robot: trunk with a free joint `root`, twelve hinges, no actuators, no floor."""
    spec = mujoco.MjSpec()
    spec.modelname = "go2"
    spec.compiler.degree = False
    trunk = spec.worldbody.add_body(name="trunk", pos=(0.0, 0.0, standing_height()))
    trunk.add_freejoint(name="root")
    _set_inertia(trunk, c.TRUNK)
    trunk.add_site(name="imu", size=(0.005, 0.005, 0.005), group=4)
    trunk.add_geom(
        name="trunk_collision", type=mujoco.mjtGeom.mjGEOM_BOX, size=c.TRUNK_HALF, **_collision()
    )
    _draw(trunk, mujoco.mjtGeom.mjGEOM_BOX, _SHELL, size=c.TRUNK_HALF)
    for leg in c.LEGS:
        _add_leg(trunk, leg)
    return spec


def standing_height() -> float:
    """Height of the trunk's origin over the floor in the default pose [m]."""
    pitch, knee = c.DEFAULT_POSITION["hip_pitch"], c.DEFAULT_POSITION["knee"]
    leg = c.THIGH_LENGTH * math.cos(pitch) + c.SHANK_LENGTH * math.cos(pitch + knee)
    return leg + c.FOOT_X * math.sin(pitch + knee) + c.FOOT_RADIUS


def _add_leg(trunk: Any, leg: str) -> None:
    front = 1.0 if leg[0] == "F" else -1.0
    side = 1.0 if leg[1] == "L" else -1.0
    hip = _add_link(
        trunk, leg, "hip", "hip_roll", (front * c.HIP_X, side * c.HIP_Y, 0.0), (1.0, 0.0, 0.0)
    )
    outwards = (0.0, side * c.ABAD_LENGTH, 0.0)
    _draw(hip, mujoco.mjtGeom.mjGEOM_CAPSULE, _DARK, fromto=(0, 0, 0, *outwards), size=(0.04, 0, 0))
    thigh = _add_link(hip, leg, "thigh", "hip_pitch", outwards, (0.0, 1.0, 0.0))
    down = (0.0, 0.0, -c.THIGH_LENGTH)
    _draw(thigh, mujoco.mjtGeom.mjGEOM_CAPSULE, _SHELL, fromto=(0, 0, 0, *down), size=(0.02, 0, 0))
    shank = _add_link(thigh, leg, "shank", "knee", down, (0.0, 1.0, 0.0))
    end = (c.FOOT_X, 0.0, -c.SHANK_LENGTH)
    _draw(shank, mujoco.mjtGeom.mjGEOM_CAPSULE, _DARK, fromto=(0, 0, 0, *end), size=(0.012, 0, 0))
    shank.add_geom(
        name=f"{leg}_foot_collision",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        pos=end,
        size=(c.FOOT_RADIUS, 0.0, 0.0),
        priority=1,
        friction=_FOOT_FRICTION,
        **_collision(),
    )
    shank.add_site(name=f"{leg}_foot", pos=end, size=(0.005, 0.005, 0.005), group=4)


def _add_link(parent: Any, leg: str, name: str, joint: str, pos: Any, axis: Any) -> Any:
    body = parent.add_body(name=f"{leg}_{name}", pos=pos)
    body.add_joint(
        name=f"{leg}_{joint}",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=axis,
        range=c.joint_range(leg, joint),
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
    )
    _set_inertia(body, c.link(leg, name))
    return body


def _set_inertia(body: Any, inertia: Inertia) -> None:
    body.mass = inertia.mass
    body.ipos = inertia.com
    body.fullinertia = inertia.products
    body.explicitinertial = True


def _draw(body: Any, kind: Any, rgba: Any, **shape: Any) -> None:
    body.add_geom(type=kind, group=2, contype=0, conaffinity=0, mass=0.0, rgba=rgba, **shape)


def _collision() -> dict[str, Any]:
    return {
        "group": 3,
        "contype": 0,
        "conaffinity": 1,
        "condim": 3,
        "mass": 0.0,
        "rgba": (0.9, 0.4, 0.1, 0.4),
    }
