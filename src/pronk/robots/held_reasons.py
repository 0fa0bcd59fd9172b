"""Which joints of a model stand still, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from pronk.robots.servos import JointServo
from pronk.robots.source_model import SourceModel

SMALLEST_RANGE = 0.02
"""Range of a hinge below which it is held: a sweep has no room [rad]."""


def held_reasons(source: SourceModel, servos: Sequence[JointServo]) -> dict[str, str]:
    """Tell which joints of a bare model are held at the pose.

    Args:
        source: The model.
        servos: What drives each joint.

    Returns:
        Name of the joint to the reason, in the words of a comment.
    """
    model = source.model
    has_actuators = any(servos[index].actuators for index in source.hinges)
    held_joints = {}
    for index, name in enumerate(source.joint_names):
        joint_type = mujoco.mjtJoint(model.jnt_type[index])
        servo = servos[index]
        if joint_type == mujoco.mjtJoint.mjJNT_FREE:
            if index != source.base_joint:
                held_joints[name] = "a body of its own"
        elif joint_type == mujoco.mjtJoint.mjJNT_SLIDE:
            low, high = model.jnt_range[index]
            held_joints[name] = "slide joint [m]"
            if model.jnt_limited[index]:
                held_joints[name] += f", range {low:.4g} to {high:.4g} m"
            if math.isfinite(servo.effort_limit):
                held_joints[name] += f", at most {servo.effort_limit:.4g} N"
        elif joint_type == mujoco.mjtJoint.mjJNT_BALL:
            held_joints[name] = "ball joint, a quaternion"
        elif name in source.mimics:
            held_joints[name] = f"follows {source.mimics[name]} in the URDF"
        elif model.jnt_limited[index] and np.ptp(model.jnt_range[index]) < SMALLEST_RANGE:
            turn_rad = np.ptp(model.jnt_range[index])
            held_joints[name] = f"hinge with a range of {turn_rad:.2g} rad, too little for a sweep"
        elif not source.has_mass(index):
            held_joints[name] = "hinge with no mass behind it [rad]"
        elif servo.servo_type == "velocity":
            held_joints[name] = (
                f"velocity servo {', '.join(servo.actuators)} of {servo.damping:.4g} N m s/rad, "
                "which holds no position [rad]"
            )
        elif has_actuators and not servo.actuators and not model.jnt_actfrclimited[index]:
            held_joints[name] = "hinge without an actuator [rad]"
    return held_joints
