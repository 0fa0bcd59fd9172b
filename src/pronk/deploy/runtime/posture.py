"""Posture of a robot with legs by the kinematics of its legs: height and slope of its trunk.

The feet are where the encoders say, and the lowest of them is on the ground if any is. No sensor of
contact is used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.robots.model import model_at_zero
from pronk.robots.robot import RobotSpec

COLLAPSED_SHARE = 0.1
"""Height of a collapsed trunk, as a share of the way from the folded to the default pose. The
lowest of walks and jumps of the Mini Cheetah is at 0.22 of it."""


@dataclass(frozen=True, kw_only=True)
class LegKinematics:
    """Geometry of legs of equally many hinges, in the trunk's frame with all joints at zero.

    Of k joints in each of m legs, from the trunk down.
    """

    joints: NDArray[np.intp]
    """Numbers of the joints, (k, m)."""
    crosses: Array
    """Matrices of the cross products with the axes of the joints, (k, m, 3, 3)."""
    anchors: Array
    """Points on the axes [m], (k, m, 3)."""
    feet: Array
    """Lowest points of the legs with the joints at zero: centres of the feet [m], (m, 3)."""
    radius: float
    """Radius of a foot [m]."""
    collapsed: float
    """Height of the trunk over the lowest foot below which it has collapsed [m]."""
    shank: float
    """Distance from the axis of the last joint to the foot [m]."""
    weight: float
    """Weight of the whole robot [N]."""

    def feet_at(self, position: Array) -> Array:
        """Return the centres of the feet in the trunk's frame [m], (m, 3); position (joints,)."""
        points = self.feet[:, :, None]
        angles = position[self.joints][:, :, None, None]
        sines = np.sin(angles)
        remainders = 1.0 - np.cos(angles)
        for k in range(len(self.joints) - 1, -1, -1):
            anchor = self.anchors[k][:, :, None]
            arm = points - anchor
            turned = self.crosses[k] @ arm
            points = anchor + arm + sines[k] * turned
            points = points + remainders[k] * (self.crosses[k] @ turned)
        return np.asarray(points[:, :, 0])

    def height(self, position: Array, orientation: Array) -> float:
        """Return the height of the trunk's origin over the lowest foot's sole [m].

        In flight it is that over the foot that reaches down farthest.

        Args:
            position: Joint positions [rad], (joints,).
            orientation: Attitude of the trunk, quaternion w, x, y, z, (4,).
        """
        depths = -(self.feet_at(position) @ upward(orientation))
        return float(depths.max()) + self.radius

    def ground_upward(self, position: Array) -> Array:
        """Return the normal of the plane through the feet, in the trunk's frame, (3,).

        It is where the ground's upward direction points if all feet stand on level ground.
        """
        feet = self.feet_at(position)
        centred = feet - feet.mean(axis=0)
        _, _, directions = np.linalg.svd(centred)
        normal = directions[-1]
        return np.asarray(normal if normal[2] > 0.0 else -normal)


def upward(orientation: Array) -> Array:
    """Return the world's upward direction in the trunk's frame, (3,); quaternion w, x, y, z."""
    w, x, y, z = np.asarray(orientation).tolist()
    return np.array(
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)], dtype=float
    )


def leg_kinematics(robot: RobotSpec) -> LegKinematics | None:
    """Read the geometry of a robot's legs.

    Args:
        robot: The robot.

    Returns:
        The geometry; None for a robot without legs, with legs of unequal numbers of joints, without
        a sphere at the end of each leg, or without a folded and a default pose.
    """
    numbers_of_legs = []
    for leg in robot.legs:
        of_leg = [i for i, name in enumerate(robot.joint_names) if name.startswith(f"{leg}_")]
        numbers_of_legs.append(of_leg)
    lengths = {len(of_leg) for of_leg in numbers_of_legs}
    folded = [joint.folded_position for joint in robot.joints]
    if len(lengths) != 1 or lengths == {0} or None in folded:
        return None
    model, data = model_at_zero(robot)
    base = model.body(robot.base_body).id
    to_trunk = data.xmat[base].reshape(3, 3).T
    origin = data.xpos[base]
    is_sphere = model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
    feet = []
    radii = []
    for of_leg in numbers_of_legs:
        shank_body = model.joint(robot.joint_names[of_leg[-1]]).bodyid[0]
        spheres = np.flatnonzero(is_sphere & (model.geom_bodyid == shank_body))
        if not len(spheres):
            return None
        feet.append(to_trunk @ (data.geom_xpos[spheres[-1]] - origin))
        radii.append(float(model.geom_size[spheres[-1], 0]))
    joints = np.array(numbers_of_legs, dtype=np.intp).T
    crosses = np.zeros((*joints.shape, 3, 3))
    anchors = np.zeros((*joints.shape, 3))
    for place, number in np.ndenumerate(joints):
        joint_id = model.joint(robot.joint_names[number]).id
        x, y, z = to_trunk @ data.xaxis[joint_id]
        crosses[place] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
        anchors[place] = to_trunk @ (data.xanchor[joint_id] - origin)
    legs = LegKinematics(
        joints=joints,
        crosses=crosses,
        anchors=anchors,
        feet=np.array(feet),
        radius=max(radii),
        collapsed=0.0,
        shank=float(np.linalg.norm(feet[0] - anchors[-1, 0])),
        weight=float(model.body_mass.sum()) * 9.81,
    )
    level = np.array([1.0, 0.0, 0.0, 0.0])
    standing = np.array([joint.default_position for joint in robot.joints])
    lowest = legs.height(np.array(folded, dtype=float), level)
    rise = legs.height(standing, level) - lowest
    if rise <= 0.0:
        return None
    return replace(legs, collapsed=lowest + COLLAPSED_SHARE * rise)
