"""Motion of the robots in the last policy step, measured once and used by every reward.

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


@dataclass(kw_only=True)
class JointMotion:
    """Joints of N robots in one step, (N, J)."""

    position: Tensor
    """Angles [rad]."""
    velocity: Tensor
    """Speeds [rad/s]."""
    torque: Tensor
    """Torques as the drives gave them [N m]."""
    torque_change: Tensor
    """Change of the torques since the step before [N m]."""


@dataclass(kw_only=True)
class TrunkMotion:
    """Trunks of N robots in one step; W is the world's frame, T the trunk's."""

    height: Tensor
    """Height over ground [m]. (N,)"""
    velocity_world: Tensor
    """Velocity in W [m/s]. (N, 3)"""
    velocity_heading: Tensor
    """Horizontal velocity, forward and left of the heading [m/s]. (N, 2)

    With the trunk's own axes, upward motion of a pitched trunk would count as forward motion.
    """
    angular_velocity: Tensor
    """Angular velocity in T [rad/s]. (N, 3)"""
    gravity: Tensor
    """Direction of gravity in T, (0, 0, -1) upright. (N, 3)"""
    heading: Tensor
    """Unit vector of the horizontal part of T's x axis, in W. (N, 2)"""


@dataclass(kw_only=True)
class LegMotion:
    """The L legs of N robots in one step; W is the world's frame."""

    contact: Tensor
    """Whether each foot is on the ground, bool. (N, L)"""
    force: Tensor
    """Magnitude of the ground's force on each foot [N]. (N, L)"""
    foot_position: Tensor
    """Horizontal position of each foot in W [m]. (N, L, 2)"""
    foot_height: Tensor
    """Lowest point of each foot over ground [m]. (N, L)"""
    foot_velocity: Tensor
    """Velocity of each foot in W [m/s]. (N, L, 3)"""
    foot_velocity_change: Tensor
    """Change of that velocity since the step before [m/s]. (N, L, 3)"""
    knee_height: Tensor
    """Height of each knee's axis over ground [m]. (N, L)"""
    length: Tensor
    """Distance from hip pitch axis to foot, with shanks of nominal length [m]. (N, L)"""


@dataclass(kw_only=True)
class StepMotion:
    """Motion of N robots in one step."""

    joints: JointMotion
    trunk: TrunkMotion
    legs: LegMotion
    non_foot_contacts: Tensor
    """Number of parts other than feet on the ground. (N,)"""

    def reset(self, env_ids: Tensor) -> None:
        """Leave robots that start a new episode, env_ids (n,), without a step before."""
        self.legs.foot_velocity[env_ids] = 0.0
        self.joints.torque[env_ids] = 0.0


def other_side(leg: str) -> str:
    """Return the leg on the other side, as HL for HR."""
    return leg[0] + ("L" if leg[1] == "R" else "R")


def mirror_joints(body: Legged) -> dict[str, str]:
    """Return the joint on the other side by the name of each joint."""
    mirror = {}
    for leg in body.legs:
        for joint in body.leg_joints:
            mirror[f"{leg}_{joint}"] = f"{other_side(leg)}_{joint}"
    return mirror


def leg_length(body: Legged, knee: Tensor) -> Tensor:
    """Compute the distance from the axis of the hip pitch to the foot's centre [m].

    Args:
        body: Dimensions of the robot.
        knee: Angle of the knee [rad], 0 for a straight leg; any shape.
    """
    thigh = body.thigh_length
    shank = body.shank_length
    return (thigh**2 + shank**2 + 2.0 * thigh * shank * torch.cos(knee)).sqrt()


def standing_leg(body: Legged) -> float:
    """Compute the length of a leg in the default pose [m]."""
    return float(leg_length(body, torch.tensor(body.default_position["knee"]).double()))


def measure_motion(
    env: ManagerBasedRlEnv, body: Legged, feet: Tensor, before: StepMotion | None
) -> StepMotion:
    """Measure the step just simulated.

    Args:
        env: The environment.
        body: Dimensions of the robot.
        feet: Ids of the foot sites in the model, (L,).
        before: Motion in the step before; None where there is none.
    """
    robot = env.scene["robot"].data
    physics = env.sim.data
    ground = env.scene["feet"].data
    # Copies: a reset writes to the state before `StepMotion.reset` is called.
    qpos = physics.qpos.clone()
    qvel = physics.qvel.clone()
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
    limb_contacts = env.scene["limbs"].data.found > 0
    return StepMotion(
        joints=JointMotion(
            position=qpos[:, 7:],
            velocity=qvel[:, 6:],
            torque=torque,
            torque_change=torque - (before.joints.torque if before else 0.0),
        ),
        trunk=TrunkMotion(
            height=qpos[:, 2],
            velocity_world=velocity,
            velocity_heading=torch.stack((forward, left), dim=-1),
            angular_velocity=qvel[:, 3:6],
            gravity=quat_apply_inverse(qpos[:, 3:7], robot.gravity_vec_w),
            heading=heading,
        ),
        legs=LegMotion(
            contact=ground.found > 0,
            force=torch.linalg.vector_norm(ground.force, dim=-1),
            foot_position=foot[..., :2],
            foot_height=foot[..., 2] - body.foot_radius,
            foot_velocity=foot_velocity,
            foot_velocity_change=foot_velocity - (before.legs.foot_velocity if before else 0.0),
            knee_height=physics.xpos[:, shanks, 2],
            length=leg_length(body, knees),
        ),
        non_foot_contacts=limb_contacts.sum(dim=-1, dtype=torch.float32),
    )
