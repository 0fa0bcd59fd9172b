"""What the robots did in the last policy step: measured once, used by every reward.

mjlab's derived quantities (feet, forces) lag positions by one physics step here, as everywhere in
its rewards.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from mjlab.entity.data import compute_velocity_from_cvel
from mjlab.utils.lab_api.math import quat_apply, quat_apply_inverse
from torch import Tensor

from pronk.robots.legged import legged

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

BODY = legged("mini_cheetah")

KNEES = slice(7 + BODY.leg_joints.index("knee"), None, len(BODY.leg_joints))
"""Where a state's positions have the knees, after seven of the trunk."""


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
    velocity_heading: Tensor
    """Its horizontal part, forward and left of where the trunk heads [m/s]: with the trunk's own
    axes a robot that rears up as it leaps would move forward for going up. (N, 2)"""
    angular_velocity: Tensor
    """In the trunk's frame [rad/s]. (N, 3)"""
    gravity: Tensor
    """Direction of gravity in the trunk's frame; (0, 0, -1) upright. (N, 3)"""
    heading: Tensor
    """Unit vector of the horizontal part of the trunk's x axis, world frame. (N, 2)"""
    contact: Tensor
    """Feet on the ground, bool. (N, 4)"""
    force: Tensor
    """Magnitude of the ground's force on each foot [N]. (N, 4)"""
    foot_position: Tensor
    """Horizontal, world frame [m]. (N, 4, 2)"""
    foot_height: Tensor
    """Lowest point of each foot over ground [m]. (N, 4)"""
    knee_height: Tensor
    """Axes of the knees over ground [m]. (N, 4)"""
    leg_length: Tensor
    """From the axis of each hip pitch to the foot, shanks of nominal length [m]. (N, 4)"""
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


def leg_length(knee: Tensor) -> Tensor:
    """From the axis of the hip pitch to the foot's centre, in the leg's plane [m].

    Args:
        knee: Angle of the knee [rad], 0 for a straight leg; any shape.
    """
    thigh, shank = BODY.thigh_length, BODY.shank_length
    return (thigh**2 + shank**2 + 2.0 * thigh * shank * torch.cos(knee)).sqrt()


STANDING_LEG = float(leg_length(torch.tensor(BODY.default_position["knee"]).double()))
"""Length of a leg in the default pose [m]."""


def measure_motion(env: ManagerBasedRlEnv, feet: Tensor, before: Motion | None) -> Motion:
    """Measure the step just simulated.

    Args:
        env: The environment; the robot is the only thing in it that moves.
        feet: The foot sites' ids in the model. (4,)
        before: The step before; None at the very first.
    """
    robot, physics = env.scene["robot"].data, env.sim.data
    ground = env.scene["feet"].data
    # Copies: a reset writes to the state before the step's motion is forgotten.
    qpos, qvel = physics.qpos.clone(), physics.qvel.clone()
    velocity = qvel[:, :3]  # of a free joint: of the body's origin, in the world's frame
    ahead = quat_apply(qpos[:, 3:7], robot.forward_vec_b)[:, :2]
    heading = torch.nn.functional.normalize(ahead, dim=-1)
    forward = (velocity[:, :2] * heading).sum(dim=-1)
    left = velocity[:, 1] * heading[:, 0] - velocity[:, 0] * heading[:, 1]
    foot = physics.site_xpos[:, feet]
    com = physics.subtree_com[:, robot.indexing.root_body_id].unsqueeze(1)
    shanks = env.sim.model.site_bodyid[feet]
    shank_velocity = physics.cvel[:, shanks]
    foot_velocity = compute_velocity_from_cvel(foot, com, shank_velocity)[..., :3]
    torque = robot.actuator_force
    return Motion(
        position=qpos[:, 7:],
        velocity=qvel[:, 6:],
        height=qpos[:, 2],
        velocity_world=velocity,
        velocity_heading=torch.stack((forward, left), dim=-1),
        angular_velocity=qvel[:, 3:6],
        gravity=quat_apply_inverse(qpos[:, 3:7], robot.gravity_vec_w),
        heading=heading,
        contact=ground.found > 0,
        force=torch.linalg.vector_norm(ground.force, dim=-1),
        foot_position=foot[..., :2],
        foot_height=foot[..., 2] - BODY.foot_radius,
        knee_height=physics.xpos[:, shanks, 2],
        leg_length=leg_length(qpos[:, KNEES]),
        foot_velocity=foot_velocity,
        foot_velocity_change=foot_velocity - (before.foot_velocity if before else 0.0),
        touching=(env.scene["limbs"].data.found > 0).sum(dim=-1, dtype=torch.float32),
        torque=torque,
        torque_change=torque - (before.torque if before else 0.0),
    )
