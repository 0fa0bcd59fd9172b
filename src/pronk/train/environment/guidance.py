"""A hand that leads a jump: what is added to a policy's joint targets until it jumps by itself.

A countermovement asks something else of twelve drives at every moment of a quarter of a second, and
an actor knows how late it is by the state of its legs alone: a policy that has not begun to fall
cannot learn to push. So at first each leg is led through one (`JumpSettings.countermovement`), its
foot below its hip, and a phase lets go little by little.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pronk.robots.mini_cheetah import constants as c
from pronk.train.environment.jump import JumpSettings
from pronk.train.environment.motion import STANDING_LEG

FALL = 0.75
"""Targets fall for this part of `fall_s`: legs follow them late, and give way under the robot. Led
for all of it, at +2 m/s, robots left the ground with .7 m/s instead of 1.05 (`tools/led_jumps.py`,
the shipped policy), backwards with 1.6 instead of 1.4."""
KICK = 1.0
"""How much straighter than the countermovement asks each knee is told to be at last [rad]; a knee
that turns with 18 rad/s takes half a radian for its damping alone. Without it robots left the
ground up to .1 m/s slower."""
KICK_S = 0.05
"""How long before the lift-off that begins [s]."""
_STEP = 1e-4
"""Of the difference that gives the joints' speed [s]."""


def leg_angles(length: Tensor) -> tuple[Tensor, Tensor]:
    """Hip pitch and knee [rad] of a leg whose foot is below its hip, the knee behind it.

    Args:
        length: From the axis of the hip pitch to the foot [m]; beyond a straight leg's as that.
    """
    thigh, shank = c.THIGH_LENGTH, c.SHANK_LENGTH
    cosine = (length.square() - thigh**2 - shank**2) / (2.0 * thigh * shank)
    knee = torch.arccos(cosine.clamp(-1.0, 1.0))
    return -torch.atan2(shank * knee.sin(), thigh + shank * knee.cos()), knee


def guidance(settings: JumpSettings, stiffness: Tensor, damping: Tensor, dt: float) -> Tensor:
    """What to add to joint targets that are for some time after a jump command [rad].

    A drive gives stiffness (target - q) - damping qdot, so a target lies beyond where its joint
    shall be by what the speed there asks for. What the push takes is left to the legs: they give
    way under the robot, and the further they do the harder they push. With the torque of an even
    push on top robots fell less deep, and left the ground slower.

    Args:
        settings: Of the jump.
        stiffness: Of the drives [N m/rad], shape (12,), leg by leg.
        damping: [N m s/rad], shape (12,).
        dt: Between two rows [s].

    Returns:
        Shape (rows + 1, 12): the first is for `dt` after the command, the last but one for the
        lift-off, and the last is zero.
    """
    led = replace(settings, fall_s=FALL * settings.fall_s)
    time = dt * torch.arange(1, round(led.prompt_s / dt) + 1, dtype=torch.float64)
    default = torch.tensor([c.DEFAULT_POSITION[name] for name in c.LEG_JOINTS]).double()

    def angles(at: Tensor) -> Tensor:
        pitch, knee = leg_angles(STANDING_LEG + led.countermovement(at))
        return torch.stack((torch.zeros_like(pitch), pitch, knee), dim=-1)

    pose, rate = angles(time), (angles(time + _STEP) - angles(time - _STEP)) / (2.0 * _STEP)
    pose[:, 2] -= KICK * (time > led.prompt_s - KICK_S + 0.5 * dt)
    offset, rate = (value.repeat(1, 4) for value in (pose - default, rate))
    added = offset + damping.double().cpu() * rate / stiffness.double().cpu()
    return torch.cat((added, torch.zeros_like(added[:1]))).float().to(stiffness.device)
