"""Motion of the robots in the last policy step: measured once, used by every reward.

Derived quantities (feet, forces) lag positions by one physics step, as in all rewards of mjlab.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from mjlab.entity.data import compute_velocity_from_cvel
from mjlab.utils.lab_api.math import quat_apply, quat_apply_inverse
from torch import Tensor

from pronk.robots.legged import Legged

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


@dataclass
class Motion:
    """One step of N robots with L legs and J joints; W is the world's frame, T the trunk's."""

    position: Tensor  # of the joints [rad], (N, J)
    velocity: Tensor  # of the joints [rad/s], (N, J)
    height: Tensor  # trunk over ground [m], (N,)
    velocity_world: Tensor  # of the trunk, in W [m/s], (N, 3)
    # Its horizontal part, forward and left of the heading [m/s], (N, 2). With the trunk's own axes,
    # upward motion of a pitched trunk would count as forward motion.
    velocity_heading: Tensor
    angular_velocity: Tensor  # of the trunk, in T [rad/s], (N, 3)
    gravity: Tensor  # its direction in T, (0, 0, -1) upright, (N, 3)
    heading: Tensor  # unit vector of the horizontal part of T's x axis, in W, (N, 2)
    contact: Tensor  # feet on the ground, bool, (N, L)
    force: Tensor  # magnitude of the ground's force on each foot [N], (N, L)
    foot_position: Tensor  # horizontal, in W [m], (N, L, 2)
    foot_height: Tensor  # lowest point of each foot over ground [m], (N, L)
    knee_height: Tensor  # axes of the knees over ground [m], (N, L)
    leg_length: Tensor  # from hip pitch axis to foot, shanks of nominal length [m], (N, L)
    foot_velocity: Tensor  # in W [m/s], (N, L, 3)
    foot_velocity_change: Tensor  # since the step before [m/s], (N, L, 3)
    non_foot_contacts: Tensor  # number of parts other than feet on the ground, (N,)
    torque: Tensor  # on the joints, as the drives gave it [N m], (N, J)
    torque_change: Tensor  # since the step before [N m], (N, J)

    def reset(self, env_ids: Tensor) -> None:
        """Robots that start a new episode have no step before; env_ids (n,)."""
        self.foot_velocity[env_ids] = 0.0
        self.torque[env_ids] = 0.0


def leg_length(body: Legged, knee: Tensor) -> Tensor:
    """From the axis of the hip pitch to the foot's centre, in the leg's plane [m].

    `knee` is its angle [rad], 0 for a straight leg; any shape.
    """
    thigh, shank = body.thigh_length, body.shank_length
    return (thigh**2 + shank**2 + 2.0 * thigh * shank * torch.cos(knee)).sqrt()


def standing_leg(body: Legged) -> float:
    """Length of a leg in the default pose [m]."""
    return float(leg_length(body, torch.tensor(body.default_position["knee"]).double()))


def measure_motion(
    env: ManagerBasedRlEnv, body: Legged, feet: Tensor, before: Motion | None
) -> Motion:
    """Measure the step just simulated; `feet` are the foot sites' ids in the model, (L,)."""
    robot, physics = env.scene["robot"].data, env.sim.data
    ground = env.scene["feet"].data
    # Copies: a reset writes to the state before `Motion.reset` is called.
    qpos, qvel = physics.qpos.clone(), physics.qvel.clone()
    velocity = qvel[:, :3]  # of a free joint: of the body's origin, in the world's frame
    ahead = quat_apply(qpos[:, 3:7], robot.forward_vec_b)[:, :2]
    heading = torch.nn.functional.normalize(ahead, dim=-1)
    forward = (velocity[:, :2] * heading).sum(dim=-1)
    left = velocity[:, 1] * heading[:, 0] - velocity[:, 0] * heading[:, 1]
    foot = physics.site_xpos[:, feet]
    com = physics.subtree_com[:, robot.indexing.root_body_id].unsqueeze(1)
    shanks = env.sim.model.site_bodyid[feet]
    foot_velocity = compute_velocity_from_cvel(foot, com, physics.cvel[:, shanks])[..., :3]
    torque = robot.actuator_force
    # A free joint has seven positions; the knee has its place among the joints of each leg.
    knees = qpos[:, 7 + body.leg_joints.index("knee") :: len(body.leg_joints)]
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
        foot_height=foot[..., 2] - body.foot_radius,
        knee_height=physics.xpos[:, shanks, 2],
        leg_length=leg_length(body, knees),
        foot_velocity=foot_velocity,
        foot_velocity_change=foot_velocity - (before.foot_velocity if before else 0.0),
        non_foot_contacts=(env.scene["limbs"].data.found > 0).sum(dim=-1, dtype=torch.float32),
        torque=torque,
        torque_change=torque - (before.torque if before else 0.0),
    )
