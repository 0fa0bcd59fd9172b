"""Joint gains that the paper published (arXiv 2404.15096, Table I), to compare with."""

from __future__ import annotations

from dataclasses import dataclass

_LEGS = ("FR", "FL", "HR", "HL")
# Table I, columns FR, FL, HR, HL.
_STIFFNESS = {
    "hip_roll": (20.6, 18.1, 18.5, 21.0),
    "hip_pitch": (16.5, 17.7, 16.9, 18.9),
    "knee": (21.8, 22.0, 22.2, 21.8),
}
_DAMPING = {
    "hip_roll": (0.492, 0.516, 0.431, 0.49),
    "hip_pitch": (0.382, 0.406, 0.382, 0.431),
    "knee": (0.541, 0.523, 0.553, 0.553),
}
# Last column of Table I.
_TRAINING = {"hip_roll": (20.0, 0.45), "hip_pitch": (17.5, 0.4), "knee": (21.5, 0.55)}


@dataclass(frozen=True, kw_only=True)
class Published:
    """Gains that the paper gives for its robot: stiffness [N m/rad] and damping [N m s/rad]."""

    joints: dict[str, tuple[float, float]]
    training: dict[str, tuple[float, float]]
    """Of each joint group, as used in training."""
    stiffness_range: float = 2.0
    """Half-width of the randomization [N m/rad] (D3)."""
    damping_range: float = 0.05
    """Half-width of the randomization [N m s/rad] (D4)."""


def published(robot: str) -> Published | None:
    """Return the paper's gains of `robot`; None for another robot than the paper's."""
    if robot != "mini_cheetah":
        return None
    joints = {
        f"{leg}_{group}": (_STIFFNESS[group][i], _DAMPING[group][i])
        for i, leg in enumerate(_LEGS)
        for group in _STIFFNESS
    }
    return Published(joints=joints, training=dict(_TRAINING))
