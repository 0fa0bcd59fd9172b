"""Left-right symmetry: mirror images of observations and actions, for data augmentation.

The robot is its own mirror image in the plane of its trunk's x and z axes. In the mirror image
vectors change the sign of y, angular velocities those of x and z; right and left legs change
places; hip_roll (about x) changes sign, hip_pitch and knee (about y) do not. rsl_rl's symmetry
extension trains on both sides (Mittal et al. 2024).

A real robot is not its own mirror image: its right and left joints have different gains. The mirror
image of a sample belongs to the robot with left and right gains exchanged, and `mirrored` exchanges
them in what the critic sees, so the sample is a true one of that other robot. It belongs to the
robots that are trained for only if those are as likely as their mirror images. By group that holds,
because all joints of a group are drawn alike. By joint `events.randomize_drives` makes every second
robot the mirror image of the measured one. So the policy is trained for the measured robot and its
mirror image alike, without being told which of them it is, and does not learn to limp on one side;
what it could gain by knowing the weaker leg, it does not.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from pronk.errors import PronkError
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.mdp.observations import CRITIC, CRITIC_JUMP
from pronk.policy.observation import ESTIMATE, MEASURED
from pronk.robots.legged import HIP_ROLL, Legged

GROUPS: Mapping[str, Mapping[str, int]] = {
    "measured": {name: len(part) for name, part in MEASURED.items()},
    "jump": {"jump": 1},
    "critic": CRITIC,
    "critic_jump": CRITIC_JUMP,
    "estimator_target": ESTIMATE,
    "action": {"action": 12},
}
"""Parts of every group of observations, and of the action, in order, and their sizes."""

_SIGNS = {
    "angular_velocity": (-1.0, 1.0, -1.0),
    "projected_gravity": (1.0, -1.0, 1.0),
    "linear_velocity": (1.0, -1.0, 1.0),
    "command": (1.0, -1.0, -1.0),
}
"""Factors of the components of vectors, in the trunk's frame."""
_JOINTS = ("joint_position", "joint_velocity", "action")
"""Quantities by joint."""
_CONTACTS = ("contact", "foot_contact", "foot_force", "foot_height")
_LEGS = (*_CONTACTS, "shank_length", "stiffness", "damping")
"""Quantities by leg; stiffness and damping are those of one joint group after the other."""


def mirrored(group: str, x: Tensor, body: Legged) -> Tensor:
    """Return the mirror image of a group; applied twice it is the identity.

    Args:
        group: Name of a group of `GROUPS`.
        x: Its numbers, (..., size).
        body: The robot, of which legs and joints are read.

    Raises:
        PronkError: A group whose layout is not known.
    """
    if group not in GROUPS:
        raise PronkError(
            f"the observation group {group!r} has no known layout; expected one of "
            f"{', '.join(GROUPS)}."
        )
    opposite = tuple(body.legs.index(body.opposite[leg]) for leg in body.legs)
    source, sign = _mirror(group, opposite, len(body.leg_joints), x.device)
    return x[..., source] * sign


@lru_cache
def _mirror(
    group: str, leg_indices: tuple[int, ...], joints_per_leg: int, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return index and sign of the original's number that each number of the image is.

    Args:
        group: Name of a group of `GROUPS`.
        leg_indices: Index of the leg on the other side of each leg.
        joints_per_leg: Number of joints of a leg.
        device: Device of the tensors.
    """
    joint_indices = []
    joint_signs = []
    for leg_index in leg_indices:
        for number in range(joints_per_leg):
            joint_indices.append(leg_index * joints_per_leg + number)
            joint_signs.append(-1.0 if number == HIP_ROLL else 1.0)
    sources: list[int] = []
    signs: list[float] = []
    for name, size in GROUPS[group].items():
        quantity_indices = [0]
        quantity_signs = [1.0]
        if name in _SIGNS:
            quantity_indices = [0, 1, 2]
            quantity_signs = list(_SIGNS[name])
        elif name in _LEGS:
            quantity_indices = list(leg_indices)
            quantity_signs = [1.0] * len(leg_indices)
        elif name in _JOINTS:
            quantity_indices = joint_indices
            quantity_signs = joint_signs
        # A part longer than its quantity is a history of it, or one for each joint group.
        for _ in range(size // len(quantity_indices)):
            start = len(sources)
            sources += [start + index for index in quantity_indices]
            signs += quantity_signs
    return torch.tensor(sources, device=device), torch.tensor(signs, device=device)


def with_mirror_image(
    env: Any, obs: TensorDict | None, actions: Tensor | None
) -> tuple[TensorDict | None, Tensor | None]:
    """Append its mirror image to a batch, for rsl_rl's symmetry extension.

    Args:
        env: The environment.
        obs: Groups of observations, (N, size) each, or None.
        actions: Actions, (N, 12), or None.

    Returns:
        The batch, then its mirror image, 2 N rows; None stays None.
    """
    body = motion_command(env.unwrapped).body
    if obs is not None:
        groups = {}
        for name, x in obs.to_dict().items():
            groups[name] = torch.cat([x, mirrored(name, x, body)])
        obs = TensorDict(groups, batch_size=[2 * obs.batch_size[0]], device=obs.device)
    if actions is not None:
        actions = torch.cat([actions, mirrored("action", actions, body)])
    return obs, actions
