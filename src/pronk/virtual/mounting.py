"""What carries the legs: a trunk on its stand on the bench, or free on the ground."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

from pronk.errors import RobotError
from pronk.robots.robot import Robot
from pronk.virtual.ground import Ground
from pronk.virtual.sim_params import SimParams

STAND_AXES = {"stand_roll": (1, 0, 0), "stand_pitch": (0, 1, 0), "stand_yaw": (0, 0, 1)}
"""Joints of a stand that gives a little, and their axes."""


def free_base(spec: Any, robot: Robot, ground: Ground) -> None:
    """Put a model's free trunk over the ground.

    Args:
        spec: mujoco.MjSpec to change.
        robot: Which body is the trunk.
        ground: Under it.

    Raises:
        RobotError: The robot's base is not free: an arm.
    """
    base = spec.body(robot.base_body)
    if [joint.type for joint in base.joints] != [mujoco.mjtJoint.mjJNT_FREE]:
        raise RobotError(
            f"{robot.name} has no legs to stand on; it can be simulated on the bench only."
        )
    # What is only drawn costs time in every step.
    for geom in [geom for geom in spec.geoms if not geom.contype and not geom.conaffinity]:
        spec.delete(geom)
    ground.add_to(spec)


def change_trunk(model: Any, body: int, sim_params: SimParams) -> None:
    """Make the trunk what it truly is.

    Args:
        model: mujoco.MjModel to change; constants derived from masses are left to the caller.
        body: Id of the trunk.
        sim_params: What it is.

    Raises:
        RobotError: No body could be like that.
    """
    trunk = sim_params.trunk
    mass = float(model.body_mass[body])
    if not mass + trunk.mass_offset > 0.0:
        raise RobotError(
            f"trunk.mass_offset is {trunk.mass_offset:g} kg; the trunk has {mass:.3g} kg, of which "
            "something must be left."
        )
    # MuJoCo's principal moments are sorted; those of the parameters are about x, y, z.
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    nearest = np.abs(axes.reshape(3, 3)).argmax(axis=0)
    moments = model.body_inertia[body] * np.array(trunk.inertia_scale)[nearest]
    if 2.0 * moments.max() > moments.sum():
        raise RobotError(
            f"trunk.inertia_scale is {list(trunk.inertia_scale)}; the principal moments would be "
            f"{', '.join(f'{m:.4g}' for m in moments)} kg m^2, of which the largest exceeds the "
            "sum of the others, as no body's does."
        )
    model.body_inertia[body] = moments * (1.0 + trunk.mass_offset / mass)
    model.body_mass[body] = mass + trunk.mass_offset
    model.body_ipos[body] += trunk.com_offset


def fix_base(spec: Any, robot: Robot, sim_params: SimParams) -> None:
    """Screw a model's trunk to its stand.

    Args:
        spec: mujoco.MjSpec to change.
        robot: Which body is the trunk.
        sim_params: How stiff the stand is.
    """
    base = spec.body(robot.base_body)
    for joint in list(base.joints):
        spec.delete(joint)
    if math.isfinite(sim_params.machine.stand_stiffness):
        for name, axis in STAND_AXES.items():
            base.add_joint(
                name=name,
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=axis,
                stiffness=[sim_params.machine.stand_stiffness, 0, 0],
                damping=[sim_params.machine.stand_damping, 0, 0],
            )
