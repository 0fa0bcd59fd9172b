"""PyBullet with explicit torques (law E), the chain written as a URDF.

PyBullet has no armature: that of one joint is added to its link's inertia, which is the same thing.
In a chain it would also turn with the parents, so chains take none. Passive damping is an
explicit torque (`DriveLaw.passive_damping`). Dry friction is that of a velocity motor, which holds
a joint at rest.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.engines.engine import Drives, EngineSimulator
from pronk.identify.simulators.engines.links import Links

_MAX_SPEED = 1e4  # above every speed of a joint [rad/s]; PyBullet clips at 100 by default


class PyBullet(EngineSimulator):
    """Law explicit."""

    extra, module, package = "pybullet", "pybullet", "pybullet"
    dry = ("explicit",)

    def simulate(self, links: Links, drives: Drives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`; PronkError for a chain with armature."""
        if len(links.joints) > 1 and drives.armature.any():
            raise PronkError(
                f"pybullet has no armature; the {len(links.joints)} joints of the chain "
                f"{', '.join(links.joints)} need 0, or one of the other engines."
            )
        bullet = self.engine
        client = {"physicsClientId": bullet.connect(bullet.DIRECT)}
        try:
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "chain.urdf"
                file.write_text(urdf(links, drives.armature), encoding="utf-8")
                flags = bullet.URDF_USE_INERTIA_FROM_FILE | bullet.URDF_MAINTAIN_LINK_ORDER
                chain = bullet.loadURDF(str(file), useFixedBase=True, flags=flags, **client)
            bullet.setGravity(*links.gravity, **client)
            bullet.setTimeStep(self.robot.timestep_s, **client)
            index = range(bullet.getNumJoints(chain, **client))
            names = [bullet.getJointInfo(chain, i, **client)[1].decode() for i in index]
            order = [links.joints.index(name) for name in names]
            free = {"linearDamping": 0.0, "angularDamping": 0.0, "jointDamping": 0.0, **client}
            for i, row in enumerate(order):
                bullet.resetJointState(chain, i, start[row], 0.0, **client)
                bullet.changeDynamics(chain, i, maxJointVelocity=_MAX_SPEED, **free)
            control = bullet.setJointMotorControlArray
            # A velocity motor of speed 0 is dry friction: every joint has one with another force.
            dry = drives.frictionloss[order]
            control(chain, index, bullet.VELOCITY_CONTROL, forces=dry, **client)
            out, speed = np.empty(command.shape), np.zeros(len(order))
            for row, target in zip(out, command, strict=True):
                states = bullet.getJointStates(chain, index, **client)
                row[order] = [state[0] for state in states]
                speed[order] = [state[1] for state in states]
                torque = drives.torque(target, row, speed) - drives.viscous_damping * speed
                control(chain, index, bullet.TORQUE_CONTROL, forces=torque[order], **client)
                bullet.stepSimulation(**client)
            return out
        finally:
            bullet.disconnect(**client)


def urdf(links: Links, armature: Array) -> str:
    """Write a chain as URDF, armature [kg m^2] added to the links' inertia."""

    def vector(values: Array) -> str:
        return " ".join(repr(float(value)) for value in values)

    parts = [
        '<robot name="chain"><link name="base"><inertial><mass value="1"/>'
        '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
    ]
    for i, (name, up) in enumerate(zip(links.joints, links.parent, strict=True)):
        # About all axes, as PyBullet refuses moments of no real body; one hinge turns about one.
        moments = links.inertia[i] + armature[i] * np.eye(3)
        entries = " ".join(
            f"i{'xyz'[a]}{'xyz'[b]}='{float(moments[a, b])!r}'"
            for a in range(3)
            for b in range(a, 3)
        )
        parent = f"{links.joints[up]} link" if up >= 0 else "base"
        parts.append(
            f'<link name="{name} link"><inertial><origin xyz="{vector(links.centre[i])}"/>'
            f'<mass value="{float(links.mass[i])!r}"/>'
            f"<inertia {entries}/></inertial></link>"
            f'<joint name="{name}" type="continuous"><parent link="{parent}"/>'
            f'<child link="{name} link"/><origin xyz="{vector(links.offset[i])}"/>'
            f'<axis xyz="{vector(links.axis[i])}"/></joint>'
        )
    return "".join([*parts, "</robot>"])
