"""A hand that leads a jump: what is added to a policy's joint targets until it jumps by itself.

A countermovement asks something else of twelve drives at every moment of a quarter of a second, and
an actor knows how late it is by the state of its legs alone: a policy that has not begun to fall
cannot learn to push. So at first each leg is led through one (`JumpSettings.countermovement`), its
foot below its hip, with the torque that it takes on top, and a phase lets go little by little.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pronk.robots.legged import legged
from pronk.train.mdp.jump import JumpSettings
from pronk.train.mdp.motion import STANDING_LEG

BODY = legged("mini_cheetah")

GRAVITY = 9.81
"""[m/s^2]"""
_STEP = 1e-4
"""Of the difference that gives the joints' speed [s]."""


def leg_angles(length: Tensor) -> tuple[Tensor, Tensor]:
    """Hip pitch and knee [rad] of a leg whose foot is below its hip, the knee behind it.

    Args:
        length: From the axis of the hip pitch to the foot [m]; beyond a straight leg's as that.
    """
    thigh, shank = BODY.thigh_length, BODY.shank_length
    cosine = (length.square() - thigh**2 - shank**2) / (2.0 * thigh * shank)
    knee = torch.arccos(cosine.clamp(-1.0, 1.0))
    return -torch.atan2(shank * knee.sin(), thigh + shank * knee.cos()), knee


def guidance(
    settings: JumpSettings, stiffness: Tensor, damping: Tensor, mass: float, dt: float
) -> Tensor:
    """What to add to the joint targets in each policy step after a jump command [rad].

    A drive gives stiffness (target - q) - damping qdot, so a target lies beyond where its joint
    shall be by what torque and speed there ask for. Led like that, a policy that only walks left
    the ground at all of the paper's five commands, with .9 to 1.7 m/s upwards.

    Args:
        settings: Of the jump.
        stiffness: Of the drives [N m/rad], shape (12,), leg by leg.
        damping: [N m s/rad], shape (12,).
        mass: Of the robot [kg]; each leg bears a quarter.
        dt: Duration of a policy step [s].

    Returns:
        Shape (steps + 1, 12): the last but one is for the step that ends with the lift-off, the
        last is zero.
    """
    # Each target is for the end of its step.
    time = dt * torch.arange(1, round(settings.prompt_s / dt) + 1, dtype=torch.float64)
    default = torch.tensor([BODY.default_position[name] for name in BODY.leg_joints]).double()

    def angles(at: Tensor) -> Tensor:
        pitch, knee = leg_angles(STANDING_LEG + settings.countermovement(at))
        return torch.stack((torch.zeros_like(pitch), pitch, knee), dim=-1)

    pose, rate = angles(time), (angles(time + _STEP) - angles(time - _STEP)) / (2.0 * _STEP)
    upwards = torch.where(time < settings.fall_s, -settings.fall, settings.push)
    force = (0.25 * mass * (upwards + GRAVITY)).clamp_min(0.0)
    torque = torch.zeros_like(pose)
    # The force passes through the hip; the knee is behind it and would bend.
    torque[:, 2] = force * BODY.thigh_length * pose[:, 1].sin()
    offset, torque, rate = (value.repeat(1, 4) for value in (pose - default, torque, rate))
    added = offset + (torque + damping.double().cpu() * rate) / stiffness.double().cpu()
    return torch.cat((added, torch.zeros_like(added[:1]))).float().to(stiffness.device)
