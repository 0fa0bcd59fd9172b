"""Genesis: `control_dofs_position` (law IF), or torques (E), the chain written as a URDF.

    python -m venv genesis && genesis/bin/pip install genesis-world
    pronk match LOGS --robot ROBOT --simulator examples/engines/genesis.py:drive \
        --simulator-python genesis/bin/python

Genesis gives joints of a URDF an armature of 0.1 kg m^2 and gains of its own; all are set here.
It computes on the processor in double precision; compiling takes minutes the first time.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import genesis
import numpy as np

from pronk.arrays import Array
from pronk.identify.simulators.engine import EngineDrives, EngineSimulator
from pronk.identify.simulators.links import Links, urdf
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec


class Genesis(EngineSimulator):
    """Laws explicit (`control_dofs_force`) and implicit_damping (`control_dofs_position`)."""

    package = "genesis-world"
    laws = ("explicit", "implicit_damping")
    friction_laws = ("explicit", "implicit_damping")

    def simulate(self, links: Links, drives: EngineDrives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`."""
        genesis.init(backend=genesis.cpu, precision="64", logging_level="error")
        try:
            scene, chain = self._scene(links)
            return self._stepped(scene, chain, links, drives, command, start)
        finally:
            genesis.destroy()

    def _scene(self, links: Links) -> tuple[Any, Any]:
        """Build a chain in a scene; returns both."""
        scene = genesis.Scene(
            sim_options=genesis.options.SimOptions(
                dt=self.robot.timestep_s, gravity=tuple(links.gravity.tolist())
            ),
            rigid_options=genesis.options.RigidOptions(
                enable_collision=False, enable_joint_limit=False
            ),
            show_viewer=False,
        )
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "chain.urdf"
            file.write_text(urdf(links, np.zeros(len(links.joints))), encoding="utf-8")
            shape = genesis.morphs.URDF(file=str(file), fixed=True, merge_fixed_links=False)
            chain = scene.add_entity(shape)
            scene.build()
        return scene, chain

    def _stepped(
        self,
        scene: Any,
        chain: Any,
        links: Links,
        drives: EngineDrives,
        command: Array,
        start: Array,
    ) -> Array:
        """Set the drives of a chain and step its scene; see `EngineSimulator.simulate`."""
        explicit = self.law.kind == "explicit"
        order = [chain.get_joint(name).dofs_idx_local[0] for name in links.joints]
        chain.set_dofs_armature(drives.armature, order)
        chain.set_dofs_damping(drives.viscous_damping, order)
        chain.set_dofs_frictionloss(drives.frictionloss, order)
        if explicit:
            chain.set_dofs_kp(np.zeros(len(order)), order)
            chain.set_dofs_kv(np.zeros(len(order)), order)
        else:
            chain.set_dofs_kp(drives.stiffness, order)
            chain.set_dofs_kv(drives.damping, order)
        chain.set_dofs_force_range(-drives.effort_limit, drives.effort_limit, order)
        chain.set_dofs_position(start, order)
        positions = np.empty(command.shape)
        for step, target in enumerate(command):
            positions[step] = chain.get_dofs_position(order).numpy()
            if explicit:
                speed = chain.get_dofs_velocity(order).numpy()
                chain.control_dofs_force(drives.torque(target, positions[step], speed), order)
            else:
                chain.control_dofs_position(target, order)
            scene.step()
        return positions


def drive(robot: RobotSpec) -> Genesis:
    """Make joints with drives of `control_dofs_position`."""
    return Genesis(robot, law=DriveLaw(kind="implicit_damping"))


def torque(robot: RobotSpec) -> Genesis:
    """Make joints with explicit torques."""
    return Genesis(robot, law=DriveLaw())
