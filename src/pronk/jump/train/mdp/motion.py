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

from pronk.robots.legged import KNEE, Legged

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

    def tensors(self) -> list[Tensor]:
        """Return all tensors, always in the same order."""
        joints = self.joints
        trunk = self.trunk
        legs = self.legs
        return [
            joints.position,
            joints.velocity,
            joints.torque,
            joints.torque_change,
            trunk.height,
            trunk.velocity_world,
            trunk.velocity_heading,
            trunk.angular_velocity,
            trunk.gravity,
            trunk.heading,
            legs.contact,
            legs.force,
            legs.foot_position,
            legs.foot_height,
            legs.foot_velocity,
            legs.foot_velocity_change,
            legs.knee_height,
            legs.length,
            self.non_foot_contacts,
        ]

    def reset(self, robots: Tensor) -> None:
        """Leave robots that start a new episode, bool (N,), without a step before."""
        self.legs.foot_velocity.masked_fill_(robots[:, None, None], 0.0)
        self.joints.torque.masked_fill_(robots[:, None], 0.0)


def mirror_joints(body: Legged) -> dict[str, str]:
    """Return the joint on the other side by the name of each joint."""
    mirror = {}
    for leg in body.legs:
        for joint in body.leg_joints:
            mirror[f"{leg}_{joint}"] = f"{body.opposite[leg]}_{joint}"
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
    knee = body.default_position[body.leg_joints[KNEE]]
    return float(leg_length(body, torch.tensor(knee).double()))


@dataclass(kw_only=True)
class SimulatorState:
    """What the simulator computed in one step, of N robots with L legs, J joints and B bodies.

    The tensors are the simulator's own, which it writes to.
    """

    qpos: Tensor
    """Position and quaternion of the trunk, then joint angles. (N, 7 + J)"""
    qvel: Tensor
    """Velocity and angular velocity of the trunk, then joint speeds. (N, 6 + J)"""
    torque: Tensor
    """Torques of the drives [N m]. (N, J)"""
    sites: Tensor
    """Positions of all sites in the world's frame [m]. (N, sites, 3)"""
    bodies: Tensor
    """Positions of all bodies in the world's frame [m]. (N, B, 3)"""
    centre_of_mass: Tensor
    """Centre of mass of the robot in the world's frame [m]. (N, 3)"""
    body_velocity: Tensor
    """Angular and linear velocity of all bodies at the centre of mass. (N, B, 6)"""
    feet_found: Tensor
    """Number of contacts of each foot with the ground. (N, L)"""
    feet_force: Tensor
    """Force of the ground on each foot [N]. (N, L, 3)"""
    limbs_found: Tensor
    """Number of contacts of each other part with the ground. (N, parts)"""


def simulator_state(env: ManagerBasedRlEnv) -> SimulatorState:
    """Return what the simulator computed in the step just simulated."""
    robot = env.scene["robot"].data
    physics = env.sim.data
    ground = env.scene["feet"].data
    # mjlab's arrays are no tensors; an index makes them tensors without a copy.
    return SimulatorState(
        qpos=physics.qpos[:],
        qvel=physics.qvel[:],
        torque=robot.actuator_force,
        sites=physics.site_xpos[:],
        bodies=physics.xpos[:],
        centre_of_mass=physics.subtree_com[:, robot.indexing.root_body_id],
        body_velocity=physics.cvel[:],
        feet_found=ground.found,
        feet_force=ground.force,
        limbs_found=env.scene["limbs"].data.found,
    )


@dataclass(kw_only=True)
class RobotFrames:
    """What is needed of a robot's model to measure motion; unit vectors are of all robots."""

    body: Legged
    """Dimensions of the robot."""
    feet: Tensor
    """Ids of the foot sites in the model. (L,)"""
    shanks: Tensor
    """Ids of the bodies that the feet belong to. (L,)"""
    forward: Tensor
    """Direction that is ahead, in the trunk's frame. (N, 3)"""
    gravity: Tensor
    """Direction of gravity in the world's frame. (N, 3)"""


def measure_motion(
    state: SimulatorState, frames: RobotFrames, before: StepMotion | None
) -> StepMotion:
    """Measure the step just simulated.

    Args:
        state: What the simulator computed.
        frames: The robot's model.
        before: Motion in the step before; None where there is none.
    """
    body = frames.body
    feet = frames.feet
    shanks = frames.shanks
    # Copies: a reset writes to the state before `StepMotion.reset` is called.
    qpos = state.qpos.clone()
    qvel = state.qvel.clone()
    velocity = qvel[:, :3]  # of a free joint: of the body's origin, in the world's frame
    ahead = quat_apply(qpos[:, 3:7], frames.forward)[:, :2]
    heading = torch.nn.functional.normalize(ahead, dim=-1)
    forward = (velocity[:, :2] * heading).sum(dim=-1)
    left = velocity[:, 1] * heading[:, 0] - velocity[:, 0] * heading[:, 1]
    foot = state.sites[:, feet]
    centre = state.centre_of_mass.unsqueeze(1)
    foot_velocity = compute_velocity_from_cvel(foot, centre, state.body_velocity[:, shanks])[
        ..., :3
    ]
    torque = state.torque
    # A free joint has seven positions; the knee has its place among the joints of each leg.
    knees = qpos[:, 7 + KNEE :: len(body.leg_joints)]
    limb_contacts = state.limbs_found > 0
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
            gravity=quat_apply_inverse(qpos[:, 3:7], frames.gravity),
            heading=heading,
        ),
        legs=LegMotion(
            contact=state.feet_found > 0,
            force=torch.linalg.vector_norm(state.feet_force, dim=-1),
            foot_position=foot[..., :2],
            foot_height=foot[..., 2] - body.foot_radius,
            foot_velocity=foot_velocity,
            foot_velocity_change=foot_velocity - (before.legs.foot_velocity if before else 0.0),
            knee_height=state.bodies[:, shanks, 2],
            length=leg_length(body, knees),
        ),
        non_foot_contacts=limb_contacts.sum(dim=-1, dtype=torch.float32),
    )
