"""Chains of hinges as numbers, from which any engine can build its own bodies.

Where all positions are zero, the frame of each link is parallel to the world's and stands at the
link's hinge. Joints then need no rotation, and inertias are those about the world's axes.

The module needs NumPy, and MuJoCo only where it reads a robot's model (`links_of`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pronk.arrays import Array
from pronk.errors import RobotError
from pronk.robots.robot import RobotSpec

_REST_ROUNDS = 4
"""Rounds of `position = target + gravity(position) / stiffness`, as in
`pronk.identify.simulators.mujoco`."""


@dataclass(frozen=True, kw_only=True)
class Links:
    """The n links that move when one joint is excited on a fixed base, parents first."""

    joints: tuple[str, ...]
    """Name of the joint that carries each link."""
    parent: tuple[int, ...]
    """Index of the parent of each link; -1 is the base."""
    offset: Array
    """Hinge of each link in the parent's frame [m], shape (n, 3)."""
    axis: Array
    """Axis of each hinge, a unit vector, shape (n, 3)."""
    mass: Array
    """Mass of each link [kg], shape (n,)."""
    centre: Array
    """Centre of mass of each link in its frame [m], shape (n, 3)."""
    inertia: Array
    """Inertia of each link about its centre of mass [kg m^2], shape (n, 3, 3)."""
    gravity: Array
    """Acceleration of gravity [m/s^2], shape (3,)."""

    def gravity_torque(self, position: Array) -> Array:
        """Compute the torque of gravity about each hinge.

        Args:
            position: Positions of the joints [rad], shape (n,).

        Returns:
            Torques [N m], shape (n,).
        """
        turn, hinge = self._frames(position)
        torque = np.zeros(len(self.joints))
        for joint in range(len(torque)):
            axis = turn[joint] @ self.axis[joint]
            for link in self._carried(joint):
                arm = hinge[link] + turn[link] @ self.centre[link] - hinge[joint]
                torque[joint] += axis @ np.cross(arm, self.mass[link] * self.gravity)
        return torque

    def inertia_about(self, joint: int, position: Array) -> float:
        """Compute the inertia of all that a joint carries, about its axis.

        Args:
            joint: Index of the joint.
            position: Positions of the joints [rad], shape (n,).

        Returns:
            The inertia without armature [kg m^2].
        """
        turn, hinge = self._frames(position)
        axis = turn[joint] @ self.axis[joint]
        total = 0.0
        for link in self._carried(joint):
            arm = np.cross(axis, hinge[link] + turn[link] @ self.centre[link] - hinge[joint])
            along = turn[link].T @ axis
            total += along @ self.inertia[link] @ along + self.mass[link] * arm @ arm
        return float(total)

    def rest(self, target: Array, stiffness: Array) -> Array:
        """Compute the positions at which gravity and the drives balance.

        Args:
            target: Target positions of the drives [rad], shape (n,).
            stiffness: Stiffness of the drives [N m/rad], shape (n,).

        Returns:
            Positions at rest [rad], shape (n,).
        """
        position = target
        for _ in range(_REST_ROUNDS):
            position = target + self.gravity_torque(position) / stiffness
        return position

    def _frames(self, position: Array) -> tuple[Array, Array]:
        """Return rotation matrices (n, 3, 3) and hinges (n, 3) [m] of the links in the world."""
        count = len(self.joints)
        turn = np.empty((count, 3, 3))
        hinge = np.empty((count, 3))
        for link, parent in enumerate(self.parent):
            parent_turn = np.eye(3)
            parent_hinge = np.zeros(3)
            if parent >= 0:
                parent_turn = turn[parent]
                parent_hinge = hinge[parent]
            hinge[link] = parent_hinge + parent_turn @ self.offset[link]
            turn[link] = parent_turn @ rotation(self.axis[link], float(position[link]))
        return turn, hinge

    def _carried(self, link: int) -> list[int]:
        """Return the index of a link and of all links that it carries."""
        carried = [link]
        for child, parent in enumerate(self.parent):
            if parent in carried:
                carried.append(child)
        return carried


@dataclass(frozen=True, kw_only=True)
class SentRobot(RobotSpec):
    """A robot without its MuJoCo model, in another Python (`pronk.identify.simulators.remote`)."""

    links: Mapping[str, Links] = field(repr=False)
    """Chain of each joint; joints whose chain cannot be written as `Links` are missing."""


def links_of(robot: RobotSpec, joint: str) -> Links:
    """Read the chain of a joint from its bench model as MuJoCo compiles it.

    Args:
        robot: The robot.
        joint: The joint that is excited; see `pronk.robots.model.bench_spec`.

    Raises:
        RobotError: A joint of the chain is no hinge, or a body has more than one.
    """
    unlike = RobotError(f"the chain of {joint} has joints that are no hinges, or two on a body.")
    if isinstance(robot, SentRobot):
        if joint not in robot.links:
            raise unlike
        return robot.links[joint]
    # Another Python, which gets robots as `SentRobot`, need not have MuJoCo.
    import mujoco

    from pronk.robots.model import bench_spec

    model = bench_spec(robot, joint).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    if np.any(model.jnt_type != mujoco.mjtJoint.mjJNT_HINGE) or np.any(model.body_jntnum > 1):
        raise unlike
    # A body belongs to the link of the nearest joint on its way to the base, its own included.
    link_of_body = [-1] * model.nbody
    for body in range(1, model.nbody):
        link = int(model.body_jntadr[body])
        if link < 0:
            link = link_of_body[model.body_parentid[body]]
        link_of_body[body] = link
    moving_bodies = [body for body in range(1, model.nbody) if link_of_body[body] >= 0]
    count = model.njnt
    hinge = np.array(data.xanchor)
    parent = [link_of_body[body] for body in model.body_parentid[model.jnt_bodyid]]
    offset = hinge.copy()
    for link in range(count):
        if parent[link] >= 0:
            offset[link] = hinge[link] - hinge[parent[link]]
    mass = np.zeros(count)
    moment = np.zeros((count, 3))
    for body in moving_bodies:
        link = link_of_body[body]
        mass[link] += model.body_mass[body]
        moment[link] += model.body_mass[body] * (data.xipos[body] - hinge[link])
    centre = moment / mass[:, None]
    inertia = np.zeros((count, 3, 3))
    for body in moving_bodies:
        link = link_of_body[body]
        axes = data.ximat[body].reshape(3, 3)
        arm = data.xipos[body] - hinge[link] - centre[link]
        inertia[link] += axes @ np.diag(model.body_inertia[body]) @ axes.T
        inertia[link] += model.body_mass[body] * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return Links(
        joints=tuple(model.joint(link).name for link in range(count)),
        parent=tuple(parent),
        offset=offset,
        axis=np.array(data.xaxis),
        mass=mass,
        centre=centre,
        inertia=inertia,
        gravity=np.array(model.opt.gravity),
    )


def rotation(axis: Array, angle: float) -> Array:
    """Return the matrix that turns by an angle [rad] about a unit vector (Rodrigues' formula)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def quaternion(matrix: Array) -> Array:
    """Return the unit quaternion (w, x, y, z) of a rotation matrix.

    It is the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix (*New method for
    extracting the quaternion from a rotation matrix*, 2000).
    """
    skew = np.array(
        [
            matrix[2, 1] - matrix[1, 2],
            matrix[0, 2] - matrix[2, 0],
            matrix[1, 0] - matrix[0, 1],
        ]
    )
    trace = np.trace(matrix)
    symmetric = np.zeros((4, 4))
    symmetric[0, 0] = trace
    symmetric[0, 1:] = skew
    symmetric[1:, 0] = skew
    symmetric[1:, 1:] = matrix + matrix.T - trace * np.eye(3)
    return np.asarray(np.linalg.eigh(symmetric)[1][:, -1])


def principal(inertia: Array) -> tuple[Array, Array]:
    """Return the principal moments of an inertia [kg m^2] and the rotation from their axes.

    Shapes (3,) and (3, 3).
    """
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return moments, axes


def along_x(axis: Array) -> Array:
    """Return a rotation that turns the x axis onto a unit vector, shape (3, 3)."""
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    return np.column_stack([axis, side, np.cross(axis, side)])


def urdf(links: Links, armature: Array) -> str:
    """Write a chain on a fixed base as URDF.

    Args:
        links: The chain.
        armature: Inertia that is added to each link [kg m^2], shape (n,). It is added about all
            axes, as engines refuse moments of no real body; a single hinge turns about one only.
    """
    parts = [
        '<robot name="chain"><link name="base"><inertial><mass value="1"/>'
        '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
    ]
    for link, name in enumerate(links.joints):
        moments = (links.inertia[link] + armature[link] * np.eye(3)).tolist()
        parent = "base"
        if links.parent[link] >= 0:
            parent = f"{links.joints[links.parent[link]]} link"
        parts.append(
            f'<link name="{name} link"><inertial><origin xyz="{_words(links.centre[link])}"/>'
            f'<mass value="{float(links.mass[link])!r}"/>'
            f"<inertia ixx='{moments[0][0]!r}' ixy='{moments[0][1]!r}' ixz='{moments[0][2]!r}' "
            f"iyy='{moments[1][1]!r}' iyz='{moments[1][2]!r}' izz='{moments[2][2]!r}'/>"
            "</inertial></link>"
            f'<joint name="{name}" type="continuous"><parent link="{parent}"/>'
            f'<child link="{name} link"/><origin xyz="{_words(links.offset[link])}"/>'
            f'<axis xyz="{_words(links.axis[link])}"/></joint>'
        )
    parts.append("</robot>")
    return "".join(parts)


def _words(values: Array) -> str:
    """Write numbers as words of an XML attribute."""
    return " ".join(repr(float(value)) for value in values)
