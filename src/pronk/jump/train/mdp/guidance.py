"""Guidance of a jump: joint target offsets of a countermovement, added to the policy's targets.

A countermovement needs a different action of twelve drives at every moment of a quarter of a
second, and a policy that has not begun to fall cannot learn to push. So at first each leg is guided
through `JumpSettings.countermovement`, its foot below its hip, with the torque that it takes; the
phases of training then reduce the offsets to zero.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pronk.jump.train.mdp.jump import JumpSettings
from pronk.jump.train.mdp.motion import standing_leg
from pronk.robots.legged import HIP_PITCH, KNEE, Legged

GRAVITY = 9.81
"""[m/s^2]"""
_DIFFERENCE = 1e-4
"""Time step of the finite difference that gives joint velocities [s]."""


def leg_angles(body: Legged, leg: str, length: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the angles of a leg whose foot is below its hip, bent as in the default pose.

    Args:
        body: Dimensions of the robot.
        leg: Prefix of the leg: its knee bends to the side to which it is bent in the default pose.
        length: Distance from the axis of the hip pitch to the foot [m], at most that of a straight
            leg; any shape.

    Returns:
        Hip pitch and knee [rad].
    """
    thigh = body.thigh_length
    shank = body.shank_length
    cosine = (length.square() - thigh**2 - shank**2) / (2.0 * thigh * shank)
    knee = torch.arccos(cosine.clamp(-1.0, 1.0))
    pitch = -torch.atan2(shank * knee.sin(), thigh + shank * knee.cos())
    sign = 1.0 if body.leg_poses[leg][body.leg_joints[KNEE]] >= 0.0 else -1.0
    return sign * pitch, sign * knee


def guidance(
    body: Legged, settings: JumpSettings, stiffness: Tensor, damping: Tensor, dt: float
) -> Tensor:
    """Compute offsets of the joint targets in each policy step after a jump command [rad].

    A drive gives stiffness (target - q) - damping qdot, so a target lies beyond the joint's
    intended position by what torque and velocity need. Guided like that, a policy that only walks
    left the ground at all of the paper's five commands, with .9 to 1.7 m/s upwards.

    Args:
        body: Dimensions of the robot.
        settings: The countermovement.
        stiffness: Stiffness of the drives, leg by leg [N m/rad], (12,).
        damping: Damping of the drives, leg by leg [N m s/rad], (12,).
        dt: Duration of a policy step [s].

    Returns:
        The offsets, (steps + 1, 12): the last but one is for the step that ends with the lift-off,
        the last is zero.
    """
    # Each target is for the end of its step.
    time = dt * torch.arange(1, round(settings.prompt_s / dt) + 1, dtype=torch.float64)
    default = _default_angles(body)
    pose = _countermovement_angles(body, settings, time)
    later_pose = _countermovement_angles(body, settings, time + _DIFFERENCE)
    earlier_pose = _countermovement_angles(body, settings, time - _DIFFERENCE)
    upwards = torch.where(time < settings.fall_s, -settings.fall, settings.push)
    force = (0.25 * body.total_mass * (upwards + GRAVITY)).clamp_min(0.0)
    torque = torch.zeros_like(pose)
    # The force passes through the hip; the knee is beside it by the thigh's horizontal part.
    torque[:, :, 2] = force[:, None] * body.thigh_length * pose[:, :, 1].sin()
    offset = (pose - default).flatten(1)
    torque = torque.flatten(1)
    change = (later_pose - earlier_pose).flatten(1)
    damping_torque = damping.double().cpu() * change / (2.0 * _DIFFERENCE)
    added = offset + (torque + damping_torque) / stiffness.double().cpu()
    return torch.cat((added, torch.zeros_like(added[:1]))).float().to(stiffness.device)


def foot_sweep(body: Legged, settings: JumpSettings, dt: float) -> Tensor:
    """Compute offsets of the hip pitch that sweep a foot backwards, per speed [rad / (m/s)].

    A standing foot stays where it is while the trunk passes over it. The trunk is over the foot in
    the middle of the push, and the sweep begins with it: a foot is then ahead of its hip by half of
    the way of the push, and behind it by as much at the lift-off. To which side the knees bend is
    nothing to the sweep.

    Args:
        body: Dimensions of the robot.
        settings: The countermovement.
        dt: Duration of a policy step [s].

    Returns:
        The offsets at 1 m/s forwards, (steps + 1, 12), in the rows of `guidance`.
    """
    time = dt * torch.arange(1, round(settings.prompt_s / dt) + 1, dtype=torch.float64)
    push_s = settings.prompt_s - settings.fall_s
    middle = settings.fall_s + 0.5 * push_s
    ahead = (middle - time).clamp(-0.5 * push_s, 0.5 * push_s)  # at 1 m/s [m]
    length = standing_leg(body) + settings.countermovement(time)
    angles = torch.zeros(len(time), len(body.leg_joints), dtype=torch.float64)
    angles[:, HIP_PITCH] = body.forward * torch.atan(ahead / length)
    offsets = angles.repeat(1, len(body.legs))
    return torch.cat((offsets, torch.zeros_like(offsets[:1]))).float()


def _default_angles(body: Legged) -> Tensor:
    """Return the angles of the joints of each leg in the default pose [rad], (legs, 3)."""
    angles = []
    for leg in body.legs:
        angles.append([body.leg_poses[leg][joint] for joint in body.leg_joints])
    return torch.tensor(angles).double()


def _countermovement_angles(body: Legged, settings: JumpSettings, time: Tensor) -> Tensor:
    """Compute the angles of all legs at times after a jump command [rad], (n, legs, 3)."""
    length = standing_leg(body) + settings.countermovement(time)
    angles = []
    for leg in body.legs:
        pitch, knee = leg_angles(body, leg, length)
        angles.append(torch.stack((torch.zeros_like(pitch), pitch, knee), dim=-1))
    return torch.stack(angles, dim=1)
