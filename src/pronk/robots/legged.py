"""Dimensions of a robot with legs, read from its model."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np

from pronk.errors import RobotError
from pronk.robots import load_robot, robot_version


@dataclass(frozen=True, kw_only=True)
class Legged:
    """Dimensions of a robot with legs, of which the last two joints turn a thigh and a shank."""

    legs: tuple[str, ...]
    """Prefixes of the joints of each leg."""
    shanks: dict[str, str]
    """Body that carries the foot of each leg, by the prefix of the leg."""
    leg_joints: tuple[str, ...]
    """Joints of a leg from the hip down, without the prefix."""
    default_position: dict[str, float]
    """Position of each joint of a leg in the default pose [rad]."""
    thigh_length: float
    """Distance from the axis of the thigh's joint to the knee, in the plane of the leg [m]."""
    shank_length: float
    """Distance from the axis of the knee to the centre of the foot [m]."""
    foot_radius: float
    """Radius of the spherical foot [m]."""
    standing_height: float
    """Height of the base over the floor in the default pose [m]."""
    total_mass: float
    """Mass of the whole robot [kg]."""
    base_mass: float
    """Mass of the base [kg]."""


def legged(name: str | Path) -> Legged:
    """Read the dimensions of a robot from its first leg, whose foot is a sphere on the shank.

    Args:
        name: A robot, as of `load_robot`.

    Raises:
        RobotError: The robot has no legs, or its first leg has no such foot.
    """
    return _read_legged(*robot_version(name))


@lru_cache
def _read_legged(path: Path, _modified_ns: int, _model_modified_ns: int) -> Legged:
    """Read the dimensions once for each time of the last modification of the robot's files."""
    robot = load_robot(path)
    if not robot.legs:
        raise RobotError(f"{robot.name} has no legs; name them as `legs` in its robot.yaml.")
    leg = f"{robot.legs[0]}_"
    joints = [joint for joint in robot.joints if joint.name.startswith(leg)]
    model = robot.build_spec().compile()
    shank = model.joint(joints[-1].name).bodyid[0]
    is_sphere = model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
    feet = np.flatnonzero(is_sphere & (model.geom_bodyid == shank))
    if not len(feet):
        raise RobotError(f"{robot.name}: the leg {robot.legs[0]} has no sphere as its foot.")
    shanks = {}
    for prefix in robot.legs:
        last_joint = [joint for joint in robot.joint_names if joint.startswith(f"{prefix}_")][-1]
        shanks[prefix] = model.body(model.joint(last_joint).bodyid[0]).name
    base = model.body(robot.base_body)
    default_position = {}
    for joint in joints:
        default_position[joint.name.removeprefix(leg)] = joint.default_position
    return Legged(
        legs=robot.legs,
        shanks=shanks,
        leg_joints=tuple(default_position),
        default_position=default_position,
        thigh_length=float(-model.body_pos[shank, 2]),
        shank_length=float(-model.geom_pos[feet[-1], 2]),
        foot_radius=float(model.geom_size[feet[-1], 0]),
        standing_height=float(base.pos[2]),
        total_mass=float(np.sum(model.body_mass)),
        base_mass=float(base.mass[0]),
    )
