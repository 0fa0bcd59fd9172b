"""A constructed policy: it stands still, and extends its legs at the jump input."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from linear_policy import write_linear
from pronk.policy.contract import Contract, measured_layout
from pronk.policy.observation import JOINTS, MEASURED_SIZE
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
DEFAULT = np.array([joint.default_position for joint in ROBOT.joints])
STRAIGHT = np.tile([0.0, 0.65, -1.3], 4)
"""From the default pose towards straight legs [rad]."""


def contract(**changes: Any) -> Contract:
    fields: dict[str, Any] = {
        "robot": ROBOT.name,
        "joint_names": ROBOT.joint_names,
        "default_position": tuple(DEFAULT.tolist()),
        "action_scale": (0.5,) * JOINTS,
        "stiffness": (20.0, 17.5, 21.5) * 4,
        "damping": (0.45, 0.4, 0.55) * 4,
        "gains": "matched",
        "gains_sha256": "0f" * 32,
        "virtual": True,
        "observation": measured_layout(50.0),
        "policy_rate_hz": 50.0,
        "timestep_s": 0.005,
        "decimation": 4,
        "delay_range_s": (0.0, 0.01),
        "command_ranges": {"vx": (-3.0, 3.0), "vy": (-1.0, 1.0), "yaw_rate": (-2.0, 2.0)},
        "jump": True,
        "lift_off_velocity": 2.5,
    }
    if not changes.get("jump", True):
        fields["lift_off_velocity"] = None
    fields.update(changes)
    return Contract(**fields)


def write_hopper(path: Path, strength: float = 1.0, **changes: Any) -> Path:
    """Write it as ONNX: action = jump * strength * straight / scale; contacts 1, velocity 0."""
    pytest.importorskip("onnx")
    trained = contract(**changes)
    straight = strength * STRAIGHT / np.array(trained.action_scale)
    still = np.zeros((MEASURED_SIZE, JOINTS))
    return write_linear(path, trained, still, straight if trained.jump else None)
