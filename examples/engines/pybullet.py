"""PyBullet with explicit torques (law E), the chain written as a URDF.

    pip install pybullet
    pronk match LOGS --robot ROBOT --simulator examples/engines/pybullet.py:torque

PyBullet has no armature: that of one joint is added to its link's inertia, which is the same thing.
In a chain it would also turn with the parents, so chains take none. Passive damping is an
explicit torque (`DriveLaw.passive_damping`). Dry friction is that of a velocity motor, which holds
a joint at rest.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pybullet

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.engine import EngineDrives, EngineSimulator
from pronk.identify.simulators.links import Links, urdf
from pronk.robots.robot import RobotSpec

MAX_SPEED = 1e4
"""Above every speed of a joint [rad/s]; PyBullet clips at 100 by default."""


class PyBullet(EngineSimulator):
    """Law explicit."""

    package = "pybullet"
    friction_laws = ("explicit",)

    def simulate(self, links: Links, drives: EngineDrives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`; PronkError for a chain with armature."""
        if len(links.joints) > 1 and drives.armature.any():
            raise PronkError(
                f"pybullet has no armature; the {len(links.joints)} joints of the chain "
                f"{', '.join(links.joints)} need 0, or another engine."
            )
        client = pybullet.connect(pybullet.DIRECT)
        try:
            return self._stepped(client, links, drives, command, start)
        finally:
            pybullet.disconnect(physicsClientId=client)

    def _stepped(
        self, client: int, links: Links, drives: EngineDrives, command: Array, start: Array
    ) -> Array:
        """Build a chain in a client and step it; see `EngineSimulator.simulate`."""
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "chain.urdf"
            file.write_text(urdf(links, drives.armature), encoding="utf-8")
            chain = pybullet.loadURDF(
                str(file),
                useFixedBase=True,
                flags=pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_MAINTAIN_LINK_ORDER,
                physicsClientId=client,
            )
        pybullet.setGravity(*links.gravity, physicsClientId=client)
        pybullet.setTimeStep(self.robot.timestep_s, physicsClientId=client)
        indices = range(pybullet.getNumJoints(chain, physicsClientId=client))
        # PyBullet has an order of its own: `order[k]` is the link of its joint k.
        order = []
        for index in indices:
            name = pybullet.getJointInfo(chain, index, physicsClientId=client)[1].decode()
            link = links.joints.index(name)
            order.append(link)
            pybullet.resetJointState(chain, index, start[link], 0.0, physicsClientId=client)
            pybullet.changeDynamics(
                chain,
                index,
                maxJointVelocity=MAX_SPEED,
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                physicsClientId=client,
            )
        # A velocity motor of speed 0 is dry friction: each joint has one with a force of its own.
        pybullet.setJointMotorControlArray(
            chain,
            indices,
            pybullet.VELOCITY_CONTROL,
            forces=drives.frictionloss[order],
            physicsClientId=client,
        )
        positions = np.empty(command.shape)
        speed = np.zeros(len(order))
        for step, target in enumerate(command):
            states = pybullet.getJointStates(chain, indices, physicsClientId=client)
            for link, state in zip(order, states, strict=True):
                positions[step, link] = state[0]
                speed[link] = state[1]
            torque = drives.torque(target, positions[step], speed)
            torque -= drives.viscous_damping * speed
            pybullet.setJointMotorControlArray(
                chain,
                indices,
                pybullet.TORQUE_CONTROL,
                forces=torque[order],
                physicsClientId=client,
            )
            pybullet.stepSimulation(physicsClientId=client)
        return positions


def torque(robot: RobotSpec) -> PyBullet:
    """Make joints with explicit torques."""
    return PyBullet(robot)
