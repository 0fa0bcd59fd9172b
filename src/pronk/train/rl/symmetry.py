"""Left and right: what the robot would see and do in the mirror.

The robot is its own mirror image in the plane of its trunk's x and z. Mirrored, vectors lose the
sign of y, turning rates those of x and z; right and left legs change places; hip_roll (about +x)
changes sign, hip_pitch and knee (about -y) do not. rsl_rl's symmetry extension learns from both
sides (Mittal et al. 2024):

    EstimatorPpoCfg(symmetry_cfg={
        "data_augmentation_func": "pronk.train.rl.symmetry:with_mirror_image",
        "use_data_augmentation": True,
    })

Held by a test: the mirrored roll-out of the robot in MuJoCo is the roll-out of the mirror image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from pronk.errors import PronkError
from pronk.policy.layout import ESTIMATE, MEASURED
from pronk.robots.legged import legged
from pronk.train.mdp.observations import CRITIC, CRITIC_JUMP

BODY = legged("mini_cheetah")

GROUPS: Mapping[str, Mapping[str, int]] = {
    "measured": {name: part.size for name, part in MEASURED.items()},
    "jump": {"jump": 1},
    "critic": CRITIC,
    "critic_jump": CRITIC_JUMP,
    "target": ESTIMATE,
}
"""Parts of every group of observations, in order, and their sizes."""

ACTION = {"action": len(BODY.legs) * len(BODY.leg_joints)}
"""Parts of the action."""


@dataclass(frozen=True)
class _Kind:
    """How a quantity is mirrored: mirrored[i] = sign[i] * original[source[i]]."""

    source: tuple[int, ...]
    sign: tuple[float, ...]


def _across(leg: str) -> int:
    """Where the leg on the other side stands."""
    return BODY.legs.index(leg[0] + {"R": "L", "L": "R"}[leg[1]])


_SCALAR = _Kind((0,), (1.0,))
_VECTOR = _Kind((0, 1, 2), (1.0, -1.0, 1.0))
_TURNING = _Kind((0, 1, 2), (-1.0, 1.0, -1.0))
_COMMAND = _Kind((0, 1, 2), (1.0, -1.0, -1.0))
_FEET = _Kind(tuple(_across(leg) for leg in BODY.legs), (1.0,) * len(BODY.legs))
_JOINTS = _Kind(
    tuple(
        _across(leg) * len(BODY.leg_joints) + i
        for leg in BODY.legs
        for i in range(len(BODY.leg_joints))
    ),
    tuple(-1.0 if joint == "hip_roll" else 1.0 for _ in BODY.legs for joint in BODY.leg_joints),
)

_KINDS: Mapping[str, _Kind] = {
    "angular_velocity": _TURNING,
    "projected_gravity": _VECTOR,
    "linear_velocity": _VECTOR,
    "command": _COMMAND,
    "joint_position": _JOINTS,
    "joint_velocity": _JOINTS,
    "action": _JOINTS,
    "contact": _FEET,
    "foot_contact": _FEET,
    "foot_force": _FEET,
    "foot_height": _FEET,
    "height": _SCALAR,
    "jump": _SCALAR,
    "mode": _SCALAR,
    "since": _SCALAR,
    "airborne": _SCALAR,
    "best": _SCALAR,
    "stroke": _SCALAR,
    "worth": _SCALAR,
    "lead": _SCALAR,
    "flown": _SCALAR,
    "farthest": _SCALAR,
    "jumper": _SCALAR,
    "jump_left": _SCALAR,
    "time_left": _SCALAR,
    "voltage": _SCALAR,
    "no_load": _SCALAR,
    "drop": _SCALAR,
    "friction": _SCALAR,
    "base_mass": _SCALAR,
    "delay": _SCALAR,
    "shank_length": _FEET,
    "stiffness": _FEET,
    "damping": _FEET,
}
"""Kind of every part. A part longer than its kind is a history of it."""


class Mirror:
    """Mirrors a vector made of named parts. Twice mirrored is the original."""

    def __init__(self, parts: Mapping[str, int], device: torch.device | str = "cpu") -> None:
        """Make ready.

        Args:
            parts: Size of each part, in order.
            device: Where the vectors will be.

        Raises:
            PronkError: It is not known how to mirror a part, or it has no whole number of samples.
        """
        source: list[int] = []
        sign: list[float] = []
        for name, size in parts.items():
            kind = _KINDS.get(name)
            if kind is None:
                raise PronkError(
                    f"it is not known how {name!r} looks in the mirror; known are"
                    f" {', '.join(_KINDS)}. Add it to pronk.train.rl.symmetry."
                )
            samples, rest = divmod(size, len(kind.source))
            if rest:
                raise PronkError(
                    f"{name} has {size} numbers; expected a multiple of {len(kind.source)}."
                )
            for _ in range(samples):
                start = len(source)
                source += [start + i for i in kind.source]
                sign += kind.sign
        self._source = torch.tensor(source, device=device)
        self._sign = torch.tensor(sign, device=device)

    def __call__(self, x: Tensor) -> Tensor:
        """The mirror image of (..., size)."""
        return x[..., self._source] * self._sign


def with_mirror_image(
    env: Any, obs: TensorDict | None, actions: Tensor | None
) -> tuple[TensorDict | None, Tensor | None]:
    """Data augmentation for rsl_rl's symmetry extension: a batch, then its mirror image.

    Args:
        env: Not used; the layout is pronk's.
        obs: Groups of observations, each (N, size), or None.
        actions: (N, 12), or None.

    Returns:
        The same with 2 N rows; None stays None.

    Raises:
        PronkError: There is a group that pronk does not know.
    """
    both = None
    if obs is not None:
        groups = {
            name: torch.cat([group, _mirror(name, group.device)(group)])
            for name, group in obs.to_dict().items()
        }
        both = TensorDict(groups, batch_size=[2 * obs.batch_size[0]], device=obs.device)
    if actions is not None:
        actions = torch.cat([actions, _mirror("action", actions.device)(actions)])
    return both, actions


@cache
def _mirror(group: str, device: torch.device) -> Mirror:
    parts = ACTION if group == "action" else GROUPS.get(group)
    if parts is None:
        raise PronkError(
            f"it is not known what the group {group!r} holds; known are {', '.join(GROUPS)}."
        )
    return Mirror(parts, device)
