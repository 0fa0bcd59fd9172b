"""Genesis: `control_dofs_position` (law IF), or torques (E), the chain written as a URDF.

Genesis gives joints of a URDF an armature of 0.1 kg m^2 and gains of its own; all are set here.
It computes on the processor in double precision; compiling takes minutes the first time.
"""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pronk.arrays import Array
from pronk.identify.simulators.engines.engine import Drives, EngineSimulator
from pronk.identify.simulators.engines.links import Links
from pronk.identify.simulators.engines.pybullet import urdf
from pronk.robots.drive_law import DriveLaw


class Genesis(EngineSimulator):
    """Laws explicit (`control_dofs_force`) and implicit_damping."""

    extra, module, package = "", "genesis", "genesis-world"
    laws = dry = ("explicit", "implicit_damping")

    def simulate(self, links: Links, drives: Drives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`."""
        gs: Any = self.engine
        gs.init(backend=gs.cpu, precision="64", logging_level="error")
        try:
            gravity = tuple(links.gravity.tolist())
            none = {"enable_collision": False, "enable_joint_limit": False}
            scene = gs.Scene(
                sim_options=gs.options.SimOptions(dt=self.robot.timestep_s, gravity=gravity),
                rigid_options=gs.options.RigidOptions(**none),
                show_viewer=False,
            )
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "chain.urdf"
                file.write_text(urdf(links, 0.0 * drives.armature), encoding="utf-8")
                shape = gs.morphs.URDF(file=str(file), fixed=True, merge_fixed_links=False)
                chain = scene.add_entity(shape)
                scene.build()
            order = [chain.get_joint(name).dofs_idx_local[0] for name in links.joints]
            explicit = self.law.kind == "explicit"
            active = 0.0 if explicit else 1.0
            chain.set_dofs_armature(drives.armature, order)
            chain.set_dofs_damping(drives.viscous_damping, order)
            chain.set_dofs_frictionloss(drives.frictionloss, order)
            chain.set_dofs_kp(active * drives.stiffness, order)
            chain.set_dofs_kv(active * drives.damping, order)
            chain.set_dofs_force_range(-drives.effort_limit, drives.effort_limit, order)
            chain.set_dofs_position(start, order)
            out = np.empty(command.shape)
            for row, target in zip(out, command, strict=True):
                row[:] = chain.get_dofs_position(order).numpy()
                if explicit:
                    speed = chain.get_dofs_velocity(order).numpy()
                    chain.control_dofs_force(drives.torque(target, row, speed), order)
                else:
                    chain.control_dofs_position(target, order)
                scene.step()
            return out
        finally:
            gs.destroy()


drive = partial(Genesis, law=DriveLaw(kind="implicit_damping"))
"""Drives of `control_dofs_position`."""
