"""What the paper published about the joints (arXiv 2404.15096, Table I), to draw beside ours.

Only the robot of the paper has such figures. They are shown and compared with, never fitted to.
"""

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
# Last column of Table I, and the randomization of the text (D3, D4).
_TRAINING = {"hip_roll": (20.0, 0.45), "hip_pitch": (17.5, 0.4), "knee": (21.5, 0.55)}
_STIFFNESS_RANGE, _DAMPING_RANGE = 2.0, 0.05


@dataclass(frozen=True, kw_only=True)
class Published:
    """Gains that the paper gives for one robot."""

    joints: dict[str, tuple[float, float]]
    """Stiffness [N m/rad] and damping [N m s/rad] of each joint."""
    training: dict[str, tuple[float, float]]
    """The same for each joint group, as used in training."""
    stiffness_range: float
    """Half-width of the randomization [N m/rad]."""
    damping_range: float
    """Half-width of the randomization [N m s/rad]."""


def published(robot: str) -> Published | None:
    """The paper's figures for `robot`, or None for a robot it does not treat."""
    if robot != "mini_cheetah":
        return None
    joints = {
        f"{leg}_{group}": (_STIFFNESS[group][i], _DAMPING[group][i])
        for i, leg in enumerate(_LEGS)
        for group in _STIFFNESS
    }
    return Published(
        joints=joints,
        training=dict(_TRAINING),
        stiffness_range=_STIFFNESS_RANGE,
        damping_range=_DAMPING_RANGE,
    )
