"""SAPIEN (PhysX 5, TGS): drives with a number of position iterations, or explicit torques.

PhysX computes in single precision. A link sleeps below a threshold of energy, which is set to 0
here. Law I of `pronk.robots.drive_law` holds for one joint; in a chain, PhysX solves joint by
joint.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from pronk.arrays import Array
from pronk.identify.simulators.engines.engine import Drives, EngineSimulator
from pronk.identify.simulators.engines.links import Links, along_x, principal, quaternion
from pronk.robots.drive_law import DriveLaw

_MAX_SPEED = 1e4  # above every speed of a joint [rad/s]; PhysX clips at 100 by default


class Sapien(EngineSimulator):
    """Laws explicit (`set_qf`), and implicit with 1 or more position iterations (the drive)."""

    extra, module, package = "physx", "sapien", "sapien"
    laws = ("explicit", "implicit")

    def simulate(self, links: Links, drives: Drives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`."""
        articulation, scene = self._articulation(links)
        explicit = self.law.kind == "explicit"
        articulation.set_solver_position_iterations(self.law.iterations)
        articulation.set_sleep_threshold(0.0)
        order = [links.joints.index(joint.name) for joint in articulation.active_joints]
        for joint, i in zip(articulation.active_joints, order, strict=True):
            joint.set_armature(np.full(1, drives.armature[i], np.float32))
            joint.set_max_velocity(_MAX_SPEED)
            joint.set_friction(0.0)
            # Passive damping is a drive too: PhysX takes both implicitly.
            active = 0.0 if explicit else 1.0
            gains = (
                active * drives.stiffness[i],
                active * drives.damping[i] + drives.viscous_damping[i],
            )
            joint.set_drive_properties(*gains, force_limit=drives.effort_limit[i])
        articulation.set_qpos(start[order].astype(np.float32))
        articulation.set_qvel(np.zeros(len(order), np.float32))
        out = np.empty(command.shape)
        speed = np.zeros(len(order))
        for row, target in zip(out, command, strict=True):
            row[order] = articulation.get_qpos()
            speed[order] = articulation.get_qvel()
            if explicit:
                articulation.set_qf(drives.torque(target, row, speed)[order].astype(np.float32))
            else:
                for joint, i in zip(articulation.active_joints, order, strict=True):
                    joint.set_drive_target(target[i])
            scene.step()
        return out

    def _articulation(self, links: Links) -> tuple[Any, Any]:
        """Build a chain in a scene of its own; returned too, as it must live on."""
        sapien = self.engine
        sapien.physx.set_scene_config(gravity=links.gravity.astype(np.float32), enable_tgs=True)
        scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
        scene.set_timestep(self.robot.timestep_s)
        builder = scene.create_articulation_builder()
        base = builder.create_link_builder()
        base.set_mass_and_inertia(1.0, sapien.Pose(), [1.0] * 3)
        made: list[Any] = []
        for i, up in enumerate(links.parent):
            link = builder.create_link_builder(made[up] if up >= 0 else base)
            moments, axes = principal(links.inertia[i])
            at = sapien.Pose(links.centre[i].tolist(), quaternion(axes).tolist())
            link.set_mass_and_inertia(links.mass[i], at, moments.tolist())
            turn = quaternion(along_x(links.axis[i])).tolist()
            link.set_joint_name(links.joints[i])
            link.set_joint_properties(
                "revolute_unwrapped",
                [[-np.inf, np.inf]],
                sapien.Pose(links.offset[i].tolist(), turn),
                sapien.Pose([0.0] * 3, turn),
            )
            made.append(link)
        articulation = builder.build(fix_root_link=True)
        for link in articulation.links:
            link.set_linear_damping(0.0)
            link.set_angular_damping(0.0)
            link.set_max_angular_velocity(_MAX_SPEED)
        return articulation, scene


drive = partial(Sapien, law=DriveLaw(kind="implicit", iterations=10))
"""Drives with SAPIEN's default number of position iterations."""
drive_of_isaaclab = partial(Sapien, law=DriveLaw(kind="implicit", iterations=4))
"""Drives with the 4 position iterations of Isaac Lab's robots."""
