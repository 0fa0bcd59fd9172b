"""What the robots did in the last policy step: measured once, used by every reward.

mjlab's derived quantities (feet, forces) lag positions by one physics step here, as everywhere in
its rewards.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from mjlab.utils.lab_api.math import quat_apply_inverse
from torch import Tensor

from pronk.robots.mini_cheetah import constants

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


@dataclass
class Motion:
    """One step of N robots."""

    position: Tensor
    """Joint positions [rad]. (N, 12)"""
    velocity: Tensor
    """Joint velocities [rad/s]. (N, 12)"""
    height: Tensor
    """Trunk over ground [m]. (N,)"""
    velocity_world: Tensor
    """Velocity of the trunk, world frame [m/s]. (N, 3)"""
    velocity_trunk: Tensor
    """The same in the trunk's frame [m/s]. (N, 3)"""
    angular_velocity: Tensor
    """In the trunk's frame [rad/s]. (N, 3)"""
    gravity: Tensor
    """Direction of gravity in the trunk's frame; (0, 0, -1) upright. (N, 3)"""
    contact: Tensor
    """Feet on the ground, bool. (N, 4)"""
    force: Tensor
    """Magnitude of the ground's force on each foot [N]. (N, 4)"""
    foot_height: Tensor
    """Lowest point of each foot over ground [m]. (N, 4)"""
    foot_velocity: Tensor
    """World frame [m/s]. (N, 4, 3)"""
    foot_velocity_change: Tensor
    """Since the step before [m/s]. (N, 4, 3)"""
    touching: Tensor
    """How many of trunk, thighs and shanks touch the ground. (N,)"""
    torque: Tensor
    """On the joints, as the drives gave it [N m]. (N, 12)"""
    torque_change: Tensor
    """Since the step before [N m]. (N, 12)"""

    def forget(self, env_ids: Tensor) -> None:
        """Robots that start anew have no step before.

        Args:
            env_ids: Which, shape (n,).
        """
        self.foot_velocity[env_ids] = 0.0
        self.torque[env_ids] = 0.0


def measure_motion(env: ManagerBasedRlEnv, feet: list[int], before: Motion | None) -> Motion:
    """Measure the step just simulated.

    Args:
        env: The environment; the robot is the only thing in it that moves.
        feet: Indices of the robot's foot sites.
        before: The step before; None at the very first.
    """
    data = env.scene["robot"].data
    ground = env.scene["feet"].data
    qpos, qvel = env.sim.data.qpos, env.sim.data.qvel
    orientation = qpos[:, 3:7]
    velocity = qvel[:, :3].clone()  # of a free joint: of the body's origin, in the world's frame
    foot_velocity = data.site_lin_vel_w[:, feet]
    torque = data.actuator_force
    return Motion(
        position=qpos[:, 7:].clone(),
        velocity=qvel[:, 6:].clone(),
        height=qpos[:, 2].clone(),
        velocity_world=velocity,
        velocity_trunk=quat_apply_inverse(orientation, velocity),
        angular_velocity=qvel[:, 3:6].clone(),
        gravity=direction_of_gravity(orientation),
        contact=ground.found > 0,
        force=torch.linalg.vector_norm(ground.force, dim=-1),
        foot_height=data.data.site_xpos[:, data.indexing.site_ids[feet], 2] - constants.FOOT_RADIUS,
        foot_velocity=foot_velocity,
        foot_velocity_change=foot_velocity - (before.foot_velocity if before else 0.0),
        touching=(env.scene["limbs"].data.found > 0).sum(dim=-1).float(),
        torque=torque,
        torque_change=torque - (before.torque if before else 0.0),
    )


def direction_of_gravity(orientation: Tensor) -> Tensor:
    """Down, in the trunk's frame: minus the last row of the rotation matrix.

    Args:
        orientation: Unit quaternions (w, x, y, z) of the trunk. (N, 4)

    Returns:
        Unit vectors. (N, 3)
    """
    w, x, y, z = orientation.unbind(dim=-1)
    return torch.stack(
        (2.0 * (w * y - x * z), -2.0 * (y * z + w * x), 2.0 * (x * x + y * y) - 1.0), dim=-1
    )
