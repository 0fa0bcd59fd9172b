"""Order and axes of the joints of a quadruped, against those of the messages.

LCM and DDS have twelve joints: those of the front right leg, then of the front left, the rear right
and the rear left one; of each leg the joint about the trunk's x axis, then two about its y axis.
The messages do not name them, so a model with another order would move other legs than it reports.
"""

from __future__ import annotations

import numpy as np

from pronk.arrays import Array
from pronk.errors import HardwareError
from pronk.robots.model import model_at_zero
from pronk.robots.robot import RobotSpec

LEGS = ("front right", "front left", "rear right", "rear left")
"""Legs in the order of the messages."""
JOINTS_OF_LEG = 3
_LEAST_COSINE = 0.9
"""Least cosine of the angle between an axis and the one that is expected."""


def axis_signs(robot: RobotSpec) -> Array:
    """Return how the joints of a quadruped turn about the axes x, y, y of each leg.

    Args:
        robot: A robot with twelve joints.

    Returns:
        1 for a joint that turns about the axis, -1 for one that turns against it, shape (12,).

    Raises:
        HardwareError: The legs have another order than in the messages, or a joint has another
            axis.
    """
    model, data = model_at_zero(robot)
    base = model.body(robot.base_body).id
    to_trunk = data.xmat[base].reshape(3, 3).T
    legs = []
    signs = []
    for number, joint in enumerate(robot.joints):
        joint_id = model.joint(joint.name).id
        expected = min(number % JOINTS_OF_LEG, 1)
        component = float((to_trunk @ data.xaxis[joint_id])[expected])
        if abs(component) < _LEAST_COSINE:
            raise HardwareError(
                f"{joint.name} of {robot.name} does not turn about the trunk's {'xy'[expected]} "
                "axis, as the joint of its number in the messages does: in each leg one joint "
                "turns about x, then two about y; give the robot's own model."
            )
        signs.append(float(np.sign(component)))
        if number % JOINTS_OF_LEG == JOINTS_OF_LEG - 1:
            forward, left, _ = to_trunk @ (data.xanchor[joint_id] - data.xpos[base])
            legs.append(
                f"{'front' if forward > 0.0 else 'rear'} {'left' if left > 0.0 else 'right'}"
            )
    if tuple(legs) != LEGS:
        raise HardwareError(
            f"the legs of {robot.name} have the order {', '.join(legs)}, and those of the messages "
            f"{', '.join(LEGS)}: other legs would move than the ones that are named; put the legs "
            "of its model into that order."
        )
    return np.array(signs)
