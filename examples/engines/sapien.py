"""SAPIEN (PhysX 5, TGS): drives with a number of position iterations, or explicit torques.

    pip install sapien
    pronk match LOGS --robot ROBOT --simulator examples/engines/sapien.py:drive

PhysX computes in single precision. A link sleeps below a threshold of energy, which is set to 0
here. Law I of `pronk.robots.drive_law` holds for one joint; in a chain, PhysX solves joint by
joint. SAPIEN's dry friction is no torque, so joints have none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import sapien

from pronk.arrays import Array
from pronk.identify.simulators.engine import EngineDrives, EngineSimulator
from pronk.identify.simulators.links import Links, along_x, principal, quaternion
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec

MAX_SPEED = 1e4
"""Above every speed of a joint [rad/s]; PhysX clips at 100 by default."""


class Sapien(EngineSimulator):
    """Laws explicit (`set_qf`), and implicit with 1 or more position iterations (the drive)."""

    package = "sapien"
    laws = ("explicit", "implicit")

    def simulate(self, links: Links, drives: EngineDrives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`."""
        explicit = self.law.kind == "explicit"
        # The scene must live as long as its articulation.
        articulation, scene = self._articulation(links)
        articulation.set_solver_position_iterations(self.law.iterations)
        articulation.set_sleep_threshold(0.0)
        joints = articulation.active_joints
        # SAPIEN has an order of its own: `order[k]` is the link of its joint k.
        order = [links.joints.index(joint.name) for joint in joints]
        for joint, link in zip(joints, order, strict=True):
            joint.set_armature(np.full(1, drives.armature[link], np.float32))
            joint.set_max_velocity(MAX_SPEED)
            joint.set_friction(0.0)
            # Passive damping is a drive too: PhysX takes both implicitly.
            stiffness = 0.0
            damping = drives.viscous_damping[link]
            if not explicit:
                stiffness = drives.stiffness[link]
                damping = drives.damping[link] + drives.viscous_damping[link]
            joint.set_drive_properties(stiffness, damping, force_limit=drives.effort_limit[link])
        articulation.set_qpos(start[order].astype(np.float32))
        articulation.set_qvel(np.zeros(len(order), np.float32))
        positions = np.empty(command.shape)
        speed = np.zeros(len(order))
        for step, target in enumerate(command):
            positions[step, order] = articulation.get_qpos()
            speed[order] = articulation.get_qvel()
            if explicit:
                torque = drives.torque(target, positions[step], speed)
                articulation.set_qf(torque[order].astype(np.float32))
            else:
                for joint, link in zip(joints, order, strict=True):
                    joint.set_drive_target(target[link])
            scene.step()
        return positions

    def _articulation(self, links: Links) -> tuple[Any, Any]:
        """Build a chain in a scene of its own; returns both."""
        sapien.physx.set_scene_config(gravity=links.gravity.astype(np.float32), enable_tgs=True)
        scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
        scene.set_timestep(self.robot.timestep_s)
        builder = scene.create_articulation_builder()
        base = builder.create_link_builder()
        base.set_mass_and_inertia(1.0, sapien.Pose(), [1.0] * 3)
        bodies: list[Any] = []
        for link, parent in enumerate(links.parent):
            body = builder.create_link_builder(bodies[parent] if parent >= 0 else base)
            moments, axes = principal(links.inertia[link])
            pose = sapien.Pose(links.centre[link].tolist(), quaternion(axes).tolist())
            body.set_mass_and_inertia(links.mass[link], pose, moments.tolist())
            turn = quaternion(along_x(links.axis[link])).tolist()
            body.set_joint_name(links.joints[link])
            body.set_joint_properties(
                "revolute_unwrapped",
                [[-np.inf, np.inf]],
                sapien.Pose(links.offset[link].tolist(), turn),
                sapien.Pose([0.0] * 3, turn),
            )
            bodies.append(body)
        articulation = builder.build(fix_root_link=True)
        for body in articulation.links:
            body.set_linear_damping(0.0)
            body.set_angular_damping(0.0)
            body.set_max_angular_velocity(MAX_SPEED)
        return articulation, scene


def drive(robot: RobotSpec) -> Sapien:
    """Make joints with drives of SAPIEN's default of 10 position iterations."""
    return Sapien(robot, law=DriveLaw(kind="implicit", iterations=10))


def isaaclab(robot: RobotSpec) -> Sapien:
    """Make joints with drives of the 4 position iterations of Isaac Lab's robots."""
    return Sapien(robot, law=DriveLaw(kind="implicit", iterations=4))


def torque(robot: RobotSpec) -> Sapien:
    """Make joints with explicit torques."""
    return Sapien(robot, law=DriveLaw())
