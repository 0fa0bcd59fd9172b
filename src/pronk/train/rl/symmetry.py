"""Left-right symmetry: mirror images of observations and actions, for data augmentation.

The robot is its own mirror image in the plane of its trunk's x and z axes. In the mirror image
vectors change the sign of y, angular velocities those of x and z; right and left legs change
places; hip_roll (about x) changes sign, hip_pitch and knee (about y) do not. rsl_rl's symmetry
extension trains on both sides (Mittal et al. 2024):

    EstimatorPpoCfg(symmetry_cfg={
        "data_augmentation_func": "pronk.train.rl.symmetry:with_mirror_image",
        "use_data_augmentation": True,
    })
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from pronk.errors import PronkError
from pronk.policy.observation import ESTIMATE, MEASURED
from pronk.robots.legged import Legged
from pronk.train.mdp.commands import motion_command
from pronk.train.mdp.observations import CRITIC, CRITIC_JUMP

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
_FEET = (
    "contact",
    "foot_contact",
    "foot_force",
    "foot_height",
    "shank_length",
    "stiffness",
    "damping",
)
"""Quantities by leg; stiffness and damping are those of one joint group after the other."""


class Mirror:
    """Mirror image of a vector of named parts: mirrored[i] = sign[i] * original[source[i]].

    Applied twice it is the identity. A part longer than its quantity is a history of it.
    """

    def __init__(
        self, parts: Mapping[str, int], body: Legged, device: torch.device | str = "cpu"
    ) -> None:
        """Prepare for parts given by name and size, in order.

        Raises:
            PronkError: A part has no whole number of samples.
        """
        source: list[int] = []
        signs: list[float] = []
        for name, size in parts.items():
            indices, factors = _mirrored(name, body)
            if size % len(indices):
                raise PronkError(
                    f"{name} has {size} numbers; expected a multiple of {len(indices)}."
                )
            for _ in range(size // len(indices)):
                start = len(source)
                source += [start + i for i in indices]
                signs += factors
        self._source = torch.tensor(source, device=device)
        self._sign = torch.tensor(signs, device=device)

    def __call__(self, x: Tensor) -> Tensor:
        """The mirror image of (..., size)."""
        return x[..., self._source] * self._sign


def _mirrored(name: str, body: Legged) -> tuple[list[int], list[float]]:
    """Source and sign of one sample of a quantity; unchanged unless it is listed above."""
    other_leg = [body.legs.index(leg[0] + {"R": "L", "L": "R"}[leg[1]]) for leg in body.legs]
    if name in _SIGNS:
        return [0, 1, 2], list(_SIGNS[name])
    if name in _FEET:
        return other_leg, [1.0] * len(other_leg)
    if name in _JOINTS:
        joints = body.leg_joints
        indices = [leg * len(joints) + i for leg in other_leg for i in range(len(joints))]
        signs = [-1.0 if joint == "hip_roll" else 1.0 for _ in body.legs for joint in joints]
        return indices, signs
    return [0], [1.0]


def with_mirror_image(
    env: Any, obs: TensorDict | None, actions: Tensor | None
) -> tuple[TensorDict | None, Tensor | None]:
    """A batch, then its mirror image, for rsl_rl's symmetry extension.

    Args:
        env: The environment, whose command term has the robot's dimensions.
        obs: Groups of observations, each (N, size), or None.
        actions: (N, 12), or None.

    Returns:
        The same with 2 N rows; None stays None.

    Raises:
        PronkError: There is a group without a layout in `GROUPS`.
    """
    body = motion_command(env.unwrapped).body
    both = None
    if obs is not None:
        groups = {
            name: torch.cat([group, _mirror(name, body, group.device)(group)])
            for name, group in obs.to_dict().items()
        }
        both = TensorDict(groups, batch_size=[2 * obs.batch_size[0]], device=obs.device)
    if actions is not None:
        mirror = _mirror("action", body, actions.device)
        actions = torch.cat([actions, mirror(actions)])
    return both, actions


_MIRRORS: dict[tuple[str, tuple[str, ...], torch.device], Mirror] = {}


def _mirror(group: str, body: Legged, device: torch.device) -> Mirror:
    if group not in GROUPS:
        raise PronkError(
            f"the observation group {group!r} has no known layout; expected one of "
            f"{', '.join(GROUPS)}."
        )
    key = (group, body.legs, device)
    if key not in _MIRRORS:
        _MIRRORS[key] = Mirror(GROUPS[group], body, device)
    return _MIRRORS[key]
