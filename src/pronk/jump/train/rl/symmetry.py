"""Left-right symmetry: mirror images of observations and actions, for data augmentation.

The robot is its own mirror image in the plane of its trunk's x and z axes. In the mirror image
vectors change the sign of y, angular velocities those of x and z; right and left legs change
places; hip_roll (about x) changes sign, hip_pitch and knee (about y) do not. rsl_rl's symmetry
extension trains on both sides (Mittal et al. 2024).
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
from pronk.robots.legged import Legged

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
"""Factors of vectors, in the trunk's frame."""
_JOINTS = ("joint_position", "joint_velocity", "action")
_CONTACTS = ("contact", "foot_contact", "foot_force", "foot_height")
_LEGS = (*_CONTACTS, "shank_length", "stiffness", "damping")
"""Quantities by leg; stiffness and damping are those of one joint group after the other."""


def mirrored(group: str, x: Tensor, body: Legged) -> Tensor:
    """The mirror image of (..., size) in a group of `GROUPS`; applied twice it is the identity."""
    if group not in GROUPS:
        raise PronkError(
            f"the observation group {group!r} has no known layout; expected one of "
            f"{', '.join(GROUPS)}."
        )
    source, sign = _mirror(group, body.legs, body.leg_joints, x.device)
    return x[..., source] * sign


@lru_cache
def _mirror(
    group: str, legs: tuple[str, ...], joints: tuple[str, ...], device: torch.device
) -> tuple[Tensor, Tensor]:
    """Index and sign of the number of the original that each number of the image is."""
    other_leg = [legs.index(leg[0] + {"R": "L", "L": "R"}[leg[1]]) for leg in legs]
    source: list[int] = []
    signs: list[float] = []
    for name, size in GROUPS[group].items():
        indices, factors = [0], [1.0]
        if name in _SIGNS:
            indices, factors = [0, 1, 2], list(_SIGNS[name])
        elif name in _LEGS:
            indices, factors = other_leg, [1.0] * len(legs)
        elif name in _JOINTS:
            indices = [leg * len(joints) + i for leg in other_leg for i in range(len(joints))]
            factors = [-1.0 if joint == "hip_roll" else 1.0 for _ in legs for joint in joints]
        # A part longer than its quantity is a history of it, or one for each joint group.
        for _ in range(size // len(indices)):
            start = len(source)
            source += [start + i for i in indices]
            signs += factors
    return torch.tensor(source, device=device), torch.tensor(signs, device=device)


def with_mirror_image(
    env: Any, obs: TensorDict | None, actions: Tensor | None
) -> tuple[TensorDict | None, Tensor | None]:
    """A batch, then its mirror image, for rsl_rl's symmetry extension; None stays None.

    N rows of groups of observations, (N, size) each, and of actions, (N, 12), become 2 N.
    """
    body = motion_command(env.unwrapped).body

    def both(group: str, x: Tensor) -> Tensor:
        return torch.cat([x, mirrored(group, x, body)])

    if obs is not None:
        groups = {name: both(name, x) for name, x in obs.to_dict().items()}
        obs = TensorDict(groups, batch_size=[2 * obs.batch_size[0]], device=obs.device)
    return obs, None if actions is None else both("action", actions)
