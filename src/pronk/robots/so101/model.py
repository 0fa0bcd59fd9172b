"""The SO-101 arm as a MuJoCo model: chain and inertia from the CAD export, drawn without meshes."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from pronk.robots.inertia import Inertia
from pronk.robots.so101 import constants as c

_PRINT = (0.95, 0.75, 0.15, 1.0)
_SERVO = (0.10, 0.10, 0.11, 1.0)
_SERVO_HALF = (0.0226, 0.0124, 0.0175)  # STS3215 case, 45.2 x 24.7 x 35 mm


def build_spec() -> mujoco.MjSpec:
    """The arm on its fixed base: six hinges, no actuators, no floor, no contact."""
    spec = mujoco.MjSpec()
    spec.modelname = "so101"
    spec.compiler.degree = False
    body = spec.worldbody.add_body(name="base")
    _set_inertia(body, c.BASE)
    _draw(body, mujoco.mjtGeom.mjGEOM_BOX, pos=(0.02, 0, 0.02), size=(0.05, 0.045, 0.02))
    for index, link in enumerate(c.CHAIN):
        quat = np.array(link.quat)
        _draw_rod(body, link.pos)
        body = body.add_body(name=link.body, pos=link.pos, quat=quat / np.linalg.norm(quat))
        body.add_joint(
            name=link.joint,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=(0.0, 0.0, 1.0),
            range=link.range,
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            solimp_friction=c.FRICTION_IMPEDANCE,
        )
        _set_inertia(body, link.inertia)
        last = index == len(c.CHAIN) - 1
        if last:
            _draw_rod(body, (0.0, -0.07, 0.019))
        else:
            _draw(body, mujoco.mjtGeom.mjGEOM_BOX, size=_SERVO_HALF, rgba=_SERVO)
        if link.body == "gripper":
            _draw_rod(body, (0.0, 0.0, -0.09))
            body.add_site(name="tool", pos=(0.0, 0.0, -0.09), size=(0.004, 0.004, 0.004), group=4)
    return spec


def _set_inertia(body: Any, inertia: Inertia) -> None:
    body.mass = inertia.mass
    body.ipos = inertia.com
    body.fullinertia = inertia.products
    body.explicitinertial = True


def _draw_rod(body: Any, end: tuple[float, float, float]) -> None:
    ends = (0.0, 0.0, 0.0, *end)
    _draw(body, mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends, size=(0.013, 0.0, 0.0))


def _draw(body: Any, kind: Any, **shape: Any) -> None:
    shape.setdefault("rgba", _PRINT)
    body.add_geom(type=kind, group=2, contype=0, conaffinity=0, mass=0.0, **shape)
