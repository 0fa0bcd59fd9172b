"""Chains of hinges as numbers, from which every engine builds its own bodies.

Where all positions are zero, the frame of each link is parallel to the world's and stands at the
link's hinge. Joints then need no rotation, and inertias are those about the world's axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pronk.arrays import Array
from pronk.errors import RobotError
from pronk.robots.robot import RobotSpec

_SAG_ROUNDS = 4
"""Rounds of `q = target + gravity(q) / stiffness`, as in `pronk.identify.simulators.mujoco`."""


@dataclass(frozen=True, kw_only=True)
class Links:
    """What moves when one joint is excited: n links on a fixed base, parents first."""

    joints: tuple[str, ...]
    parent: tuple[int, ...]
    """Index of the parent link; -1 is the base."""
    offset: Array
    """Hinge, in the parent's frame [m], shape (n, 3)."""
    axis: Array
    """Unit vectors, shape (n, 3)."""
    mass: Array
    """[kg], shape (n,)."""
    centre: Array
    """Centre of mass [m], shape (n, 3)."""
    inertia: Array
    """About the centre of mass [kg m^2], shape (n, 3, 3)."""
    gravity: Array
    """[m/s^2], shape (3,)."""

    def _moved(self, position: Array) -> tuple[Array, Array]:
        """Rotations and hinges [m] of the links at positions, shapes (n, 3, 3) and (n, 3)."""
        count = len(self.joints)
        turn, hinge = np.empty((count, 3, 3)), np.empty((count, 3))
        for i, up in enumerate(self.parent):
            before = turn[up] if up >= 0 else np.eye(3)
            hinge[i] = (hinge[up] if up >= 0 else 0.0) + before @ self.offset[i]
            turn[i] = before @ rotation(self.axis[i], float(position[i]))
        return turn, hinge

    def _carried(self, link: int) -> list[int]:
        """A link and those that it carries."""
        out = [link]
        for i, up in enumerate(self.parent):
            if up in out:
                out.append(i)
        return out

    def gravity_torque(self, position: Array) -> Array:
        """Torque of gravity about each hinge at positions [rad], both of shape (n,) [N m]."""
        turn, hinge = self._moved(position)
        torque = np.zeros(len(self.joints))
        for j in range(len(torque)):
            for i in self._carried(j):
                arm = hinge[i] + turn[i] @ self.centre[i] - hinge[j]
                torque[j] += turn[j] @ self.axis[j] @ np.cross(arm, self.mass[i] * self.gravity)
        return torque

    def inertia_about(self, joint: int, position: Array) -> float:
        """Inertia of what a joint carries, about its axis, at positions [rad] [kg m^2]."""
        turn, hinge = self._moved(position)
        axis, total = turn[joint] @ self.axis[joint], 0.0
        for i in self._carried(joint):
            arm = np.cross(axis, hinge[i] + turn[i] @ self.centre[i] - hinge[joint])
            along = turn[i].T @ axis
            total += along @ self.inertia[i] @ along + self.mass[i] * arm @ arm
        return float(total)

    def rest(self, target: Array, stiffness: Array) -> Array:
        """Positions at rest under drives with a target [rad] and stiffness, shapes (n,)."""
        position = target
        for _ in range(_SAG_ROUNDS):
            position = target + self.gravity_torque(position) / stiffness
        return position


@dataclass(frozen=True, kw_only=True)
class SentRobot(RobotSpec):
    """A robot without its MuJoCo model, in another Python (`pronk.identify.simulators.remote`)."""

    links: Mapping[str, Links] = field(repr=False)
    """Chain of each joint; joints that have none as `Links` are missing."""


def rotation(axis: Array, angle: float) -> Array:
    """Matrix that turns by an angle [rad] about a unit vector (Rodrigues), shape (3, 3)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def quaternion(matrix: Array) -> Array:
    """Unit quaternion (w, x, y, z) of a rotation matrix.

    It is the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix (*New method for
    extracting the quaternion from a rotation matrix*, 2000).
    """
    m = matrix
    skew = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    k = np.zeros((4, 4))
    k[0, 0], k[0, 1:], k[1:, 0] = np.trace(m), skew, skew
    k[1:, 1:] = m + m.T - np.trace(m) * np.eye(3)
    return np.asarray(np.linalg.eigh(k)[1][:, -1])


def principal(inertia: Array) -> tuple[Array, Array]:
    """Principal moments [kg m^2] and the rotation from their axes, shapes (3,) and (3, 3)."""
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return moments, axes


def along_x(axis: Array) -> Array:
    """A rotation that turns the x axis onto a unit vector, shape (3, 3)."""
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    return np.column_stack([axis, side, np.cross(axis, side)])


def links_of(robot: RobotSpec, joint: str) -> Links:
    """Read the bench model of a joint, as MuJoCo compiles it; see `bench_spec`.

    A RobotError says that a joint of the chain is no hinge, or that a body has more than one.
    """
    unlike = RobotError(f"the chain of {joint} has joints that are no hinges, or two on a body.")
    if isinstance(robot, SentRobot):
        if joint not in robot.links:
            raise unlike
        return robot.links[joint]
    import mujoco

    from pronk.robots.model import bench_spec

    model = bench_spec(robot, joint).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    if np.any(model.jnt_type != mujoco.mjtJoint.mjJNT_HINGE) or np.any(model.body_jntnum > 1):
        raise unlike
    count, bodies = model.njnt, range(1, model.nbody)
    link = [-1] * model.nbody
    """Link that each body belongs to: the nearest one with a hinge, itself included."""
    for b in bodies:
        own = int(model.body_jntadr[b])
        link[b] = own if own >= 0 else link[model.body_parentid[b]]
    hinge = np.array(data.xanchor)
    parent = [link[up] for up in model.body_parentid[model.jnt_bodyid]]
    moving = [(b, link[b]) for b in bodies if link[b] >= 0]
    mass, moment, inertia = np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3, 3))
    for b, i in moving:
        mass[i] += model.body_mass[b]
        moment[i] += model.body_mass[b] * (data.xipos[b] - hinge[i])
    centre = moment / mass[:, None]
    for b, i in moving:
        axes = data.ximat[b].reshape(3, 3)
        arm = data.xipos[b] - hinge[i] - centre[i]
        inertia[i] += axes @ np.diag(model.body_inertia[b]) @ axes.T
        inertia[i] += model.body_mass[b] * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return Links(
        joints=tuple(model.joint(i).name for i in range(count)),
        parent=tuple(parent),
        offset=hinge - np.array([hinge[up] if up >= 0 else np.zeros(3) for up in parent]),
        axis=np.array(data.xaxis),
        mass=mass,
        centre=centre,
        inertia=inertia,
        gravity=np.array(model.opt.gravity),
    )
