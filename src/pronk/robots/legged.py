"""Dimensions of a robot with legs of a hip, a thigh and a shank, read from its model."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pronk.robots import load_robot


@dataclass(frozen=True, kw_only=True)
class Legged:
    """Legs `LEG`, joints `LEG_JOINT`, bodies `LEG_hip`, `LEG_thigh`, `LEG_shank`."""

    legs: tuple[str, ...]
    leg_joints: tuple[str, ...]
    default_position: dict[str, float]
    """By joint of a leg [rad]."""
    thigh_length: float
    """hip_pitch axis to knee axis, in the plane of the leg [m]."""
    shank_length: float
    """Knee axis to the centre of the foot [m]."""
    foot_radius: float
    """[m]"""
    standing_height: float
    """Height of the base over the floor in the default pose [m]."""
    total_mass: float
    """[kg]"""
    base_mass: float
    """[kg]"""


@lru_cache
def legged(name: str) -> Legged:
    """Read the dimensions of a robot."""
    robot = load_robot(name)
    model = robot.build_spec().compile()
    legs = tuple(dict.fromkeys(joint.split("_", 1)[0] for joint in robot.joint_names))
    parts = tuple(dict.fromkeys(joint.split("_", 1)[1] for joint in robot.joint_names))
    foot = model.geom(f"{legs[0]}_foot_collision")
    return Legged(
        legs=legs,
        leg_joints=parts,
        default_position={
            part: robot.joint(f"{legs[0]}_{part}").default_position for part in parts
        },
        thigh_length=float(-model.body(f"{legs[0]}_shank").pos[2]),
        shank_length=float(-foot.pos[2]),
        foot_radius=float(foot.size[0]),
        standing_height=float(model.body(robot.base_body).pos[2]),
        total_mass=float(np.sum(model.body_mass)),
        base_mass=float(model.body(robot.base_body).mass[0]),
    )
