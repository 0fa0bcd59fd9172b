"""A policy made by hand: it stands still, and extends its legs at the jump input."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pronk.policy.contract import METADATA_KEY, Contract, measured_layout, to_json
from pronk.policy.layout import ESTIMATE, JOINTS, MEASURED_SIZE
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
DEFAULT = np.array([joint.default_position for joint in ROBOT.joints])
STRAIGHT = np.tile([0.0, 0.65, -1.3], 4)
"""From the default pose towards straight legs [rad]."""


def contract(**changes: Any) -> Contract:
    kept: dict[str, Any] = {
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
        kept["lift_off_velocity"] = None
    return Contract(**(kept | changes))


def write_hopper(path: Path, strength: float = 1.0, **changes: Any) -> Path:
    """Write it as ONNX: action = jump * straight / scale; contacts all 1, velocity 0.

    Args:
        path: Where to.
        strength: Share of the way to straight legs.
        changes: Of the contract.
    """
    onnx = pytest.importorskip("onnx")
    helper, numpy_helper = onnx.helper, onnx.numpy_helper
    made = contract(**changes)
    action = (strength * STRAIGHT / np.array(made.action_scale))[None].astype(np.float32)
    weights = {
        "pick": np.eye(MEASURED_SIZE, 1, dtype=np.float32),
        "nothing": np.zeros((1, JOINTS), np.float32),
        "still": np.zeros((1, ESTIMATE["linear_velocity"]), np.float32),
        "on_ground": np.zeros((1, ESTIMATE["contact"]), np.float32),
        "one": np.ones((1, 1), np.float32),
        "straight": action,
    }
    nodes = [
        helper.make_node("MatMul", ["measured", "pick"], ["some"]),
        helper.make_node("MatMul", ["some", "nothing"], ["zero"]),
        helper.make_node("MatMul", ["some", "still"], ["linear_velocity"]),
        helper.make_node("MatMul", ["some", "on_ground"], ["none"]),
        helper.make_node("Add", ["none", "one"], ["contact"]),
    ]
    inputs = {"measured": MEASURED_SIZE}
    if made.jump:
        inputs["jump"] = 1
        nodes.append(helper.make_node("MatMul", ["jump", "straight"], ["thrown"]))
        nodes.append(helper.make_node("Add", ["zero", "thrown"], ["action"]))
    else:
        nodes.append(helper.make_node("Identity", ["zero"], ["action"]))

    def values(sizes: dict[str, int]) -> list[Any]:
        kind = onnx.TensorProto.FLOAT
        return [helper.make_tensor_value_info(n, kind, ["batch", s]) for n, s in sizes.items()]

    graph = helper.make_graph(
        nodes,
        "hopper",
        values(inputs),
        values({"action": JOINTS, **ESTIMATE}),
        [numpy_helper.from_array(value, name) for name, value in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, {METADATA_KEY: to_json(made)})
    onnx.save(model, str(path))
    return path
