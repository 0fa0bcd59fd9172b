"""What the paper published (arXiv 2404.15096), to compare with.

Its jumps (Table III and the gaps) are in `pronk.jump.trial.protocol`.
"""

from __future__ import annotations

import math

from pronk.jump.trial.protocol import PAPER_GAPS, TABLE_III

ROBOT = "mini_cheetah"
"""The paper's robot."""
TABLE_I = {
    "FR_hip_roll": (20.6, 0.492),
    "FL_hip_roll": (18.1, 0.516),
    "HR_hip_roll": (18.5, 0.431),
    "HL_hip_roll": (21.0, 0.490),
    "FR_hip_pitch": (16.5, 0.382),
    "FL_hip_pitch": (17.7, 0.406),
    "HR_hip_pitch": (16.9, 0.382),
    "HL_hip_pitch": (18.9, 0.431),
    "FR_knee": (21.8, 0.541),
    "FL_knee": (22.0, 0.523),
    "HR_knee": (22.2, 0.553),
    "HL_knee": (21.8, 0.553),
}
"""Matched stiffness [N m/rad] and damping [N m s/rad] of each joint of `ROBOT`."""
TRAINING = {"hip_roll": (20.0, 0.45), "hip_pitch": (17.5, 0.4), "knee": (21.5, 0.55)}
"""Last column of Table I: those of each joint group, as used in training."""
RANGES = (2.0, 0.05)
"""Half-widths of their randomization [N m/rad], [N m s/rad] (D3, D4)."""


def published_jumps(figure: str) -> dict[str, dict[str, tuple[float, float]]]:
    """Return mean and deviation of `height`, `distance` or `gap` [m] by policy and command."""
    if figure == "gap":
        gaps = {}
        for command, gap in PAPER_GAPS.items():
            gaps[command] = (gap, math.nan)
        return {"matched": gaps}
    return {
        "naive": dict(TABLE_III[figure, "naive"]),
        "matched": dict(TABLE_III[figure, "matched"]),
    }
