"""Dimensions of a robot with legs, read from its model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np

from pronk.arrays import Array
from pronk.errors import RobotError
from pronk.robots import load_robot, robot_version
from pronk.robots.model import kinematics
from pronk.robots.robot import RobotSpec

HIP_ROLL = 0
"""Place among the joints of a leg of three of that about the trunk's x axis."""
HIP_PITCH = 1
"""Place of that which turns the thigh."""
KNEE = 2
"""Place of that which turns the shank."""


@dataclass(frozen=True, kw_only=True)
class Legged:
    """Dimensions of a robot with legs, of which the last two joints turn a thigh and a shank."""

    legs: tuple[str, ...]
    """Prefixes of the joints of each leg."""
    opposite: dict[str, str]
    """Leg on the other side of each leg; empty where left and right have not as many."""
    shanks: dict[str, str]
    """Body that carries the foot of each leg, by the prefix of the leg."""
    leg_joints: tuple[str, ...]
    """Joints of a leg from the hip down, without the prefix."""
    default_position: dict[str, float]
    """Position of each joint of the first leg in the default pose [rad]."""
    leg_poses: dict[str, dict[str, float]]
    """Position of each joint in the default pose [rad], by the prefix of the leg."""
    forward: float
    """Sign of the turn of a hip pitch that moves a foot below it forwards: 1 for an axis to the
    right, -1 for one to the left."""
    thigh_length: float
    """Distance from the axis of the thigh's joint to the knee, in the plane of the leg [m]."""
    shank_length: float
    """Distance from the axis of the knee to the centre of the foot [m]."""
    foot_radius: float
    """Radius of the spherical foot [m]."""
    standing_height: float
    """Height of the base over the floor that the lowest foot stands on in the default pose [m]."""
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
    model = robot.build_spec().compile()
    shanks = {}
    leg_poses = {}
    feet = []
    for leg in robot.legs:
        joints = [joint for joint in robot.joints if joint.name.startswith(f"{leg}_")]
        leg_poses[leg] = {
            joint.name.removeprefix(f"{leg}_"): joint.default_position for joint in joints
        }
        shank = model.joint(joints[-1].name).bodyid[0]
        shanks[leg] = model.body(shank).name
        is_sphere = model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
        spheres = np.flatnonzero(is_sphere & (model.geom_bodyid == shank))
        if not len(spheres):
            raise RobotError(f"{robot.name}: the leg {leg} has no sphere as its foot.")
        feet.append(int(spheres[-1]))
    base = model.body(robot.base_body)
    default_position = leg_poses[robot.legs[0]]
    first_shank = model.body(shanks[robot.legs[0]]).id
    return Legged(
        legs=robot.legs,
        opposite=opposite_legs(robot, model),
        shanks=shanks,
        leg_joints=tuple(default_position),
        default_position=default_position,
        leg_poses=leg_poses,
        forward=_forward(robot, model),
        thigh_length=float(-model.body_pos[first_shank, 2]),
        shank_length=float(-model.geom_pos[feet[0], 2]),
        foot_radius=float(model.geom_size[feet[0], 0]),
        standing_height=_standing_height(robot, model, feet),
        total_mass=float(np.sum(model.body_mass)),
        base_mass=float(base.mass[0]),
    )


def joints_of_leg(robot: RobotSpec, leg: str) -> tuple[str, ...]:
    """Return the joints of a leg in the order of the model, from the hip down."""
    return tuple(name for name in robot.joint_names if name.startswith(f"{leg}_"))


def hips(robot: RobotSpec, model: mujoco.MjModel) -> dict[str, Array]:
    """Return where the thigh of each leg is jointed to the hip, by the prefix of the leg.

    Args:
        robot: A robot with legs.
        model: Its compiled model.

    Returns:
        Places in the base's frame with all joints at zero, forwards, to the left and upwards from
        the base [m], (3,).
    """
    data, to_base = posed(robot, model, dict.fromkeys(robot.joint_names, 0.0))
    origin = data.xpos[model.body(robot.base_body).id]
    places = {}
    for leg in robot.legs:
        anchor = data.xanchor[model.joint(_thigh_joint(robot, leg)).id]
        places[leg] = to_base @ (anchor - origin)
    return places


def opposite_legs(robot: RobotSpec, model: mujoco.MjModel) -> dict[str, str]:
    """Return the leg on the other side of each leg, as HL for HR.

    It follows from where the hips are, whatever the legs are called: the foremost leg of the left
    is opposite to the foremost one of the right, and so on to the rear.

    Args:
        robot: A robot with legs.
        model: Its compiled model.

    Returns:
        The legs by prefix; empty where left and right have not as many.
    """
    places = hips(robot, model)
    middle = float(np.mean([place[1] for place in places.values()]))
    left_legs: list[str] = []
    right_legs: list[str] = []
    for leg in sorted(robot.legs, key=lambda leg: -places[leg][0]):
        side = left_legs if places[leg][1] > middle else right_legs
        side.append(leg)
    if len(left_legs) != len(right_legs):
        return {}
    opposite = {}
    for left_leg, right_leg in zip(left_legs, right_legs, strict=True):
        opposite[left_leg] = right_leg
        opposite[right_leg] = left_leg
    return opposite


def posed(
    robot: RobotSpec, model: mujoco.MjModel, position: Mapping[str, float]
) -> tuple[mujoco.MjData, Array]:
    """Put a robot into a pose.

    Args:
        robot: The robot.
        model: Its compiled model.
        position: Position of each joint [rad].

    Returns:
        The kinematics, and the axes of the base as rows, which turn the world's vectors into its
        frame, (3, 3).
    """
    data = kinematics(model, position)
    return data, data.xmat[model.body(robot.base_body).id].reshape(3, 3).T


def default_pose(robot: RobotSpec) -> dict[str, float]:
    """Return the position of each joint in the default pose [rad]."""
    return {joint.name: joint.default_position for joint in robot.joints}


def _forward(robot: RobotSpec, model: mujoco.MjModel) -> float:
    """Return the sign of the turn of the first thigh that moves a foot below it forwards."""
    data, to_base = posed(robot, model, dict.fromkeys(robot.joint_names, 0.0))
    axis = to_base @ data.xaxis[model.joint(_thigh_joint(robot, robot.legs[0])).id]
    return -1.0 if axis[1] > 0.0 else 1.0


def _thigh_joint(robot: RobotSpec, leg: str) -> str:
    """Return the joint that turns the thigh of a leg: the last but one, or the only one."""
    joints = joints_of_leg(robot, leg)
    return joints[-2] if len(joints) > 1 else joints[-1]


def _standing_height(robot: RobotSpec, model: mujoco.MjModel, feet: Sequence[int]) -> float:
    """Return the height of the base over the lowest point of its feet in the default pose [m].

    The height at which the model has its base is another one where the file has the robot above
    the floor, or its base at the origin as a URDF has it.
    """
    data, to_base = posed(robot, model, default_pose(robot))
    origin = data.xpos[model.body(robot.base_body).id]
    lowest = min(float((to_base @ (data.geom_xpos[foot] - origin))[2]) for foot in feet)
    return float(model.geom_size[feet[0], 0]) - lowest
