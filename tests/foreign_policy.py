"""Policies of others that tests write: a linear ONNX with Unitree's deploy.yaml beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pronk.arrays import Array

UNITREE_ORDER = (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8)
"""FL, FR, RL, RR among Unitree's messages, which have FR, FL, RR, RL."""
ISAACLAB_ORDER = (3, 0, 9, 6, 4, 1, 10, 7, 5, 2, 11, 8)
"""The same legs, all hips first, then all thighs, then all calves."""
POSE = (0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5)
"""Default pose of unitree_rl_lab's Go2 in `UNITREE_ORDER` [rad]."""
TERMS = {
    "base_ang_vel": 3,
    "projected_gravity": 3,
    "velocity_commands": 3,
    "joint_pos_rel": 12,
    "joint_vel_rel": 12,
    "last_action": 12,
}
"""Width of each term of `deploy_body`, in order."""
HISTORY = 5
WIDTH = HISTORY * sum(TERMS.values())


def deploy_body(**changes: Any) -> dict[str, Any]:
    """Return the content of a deploy.yaml of a stiffly standing Go2, with entries replaced."""
    observations: dict[str, Any] = {}
    for name, width in TERMS.items():
        observations[name] = {
            "params": {},
            "clip": [-100, 100],
            "scale": [1.0] * width,
            "history_length": HISTORY,
        }
    body: dict[str, Any] = {
        "joint_ids_map": list(UNITREE_ORDER),
        "step_dt": 0.02,
        "stiffness": [60.0] * 12,
        "damping": [2.0] * 12,
        "default_joint_pos": list(POSE),
        "commands": {
            "base_velocity": {
                "ranges": {"lin_vel_x": [-1.0, 1.0], "lin_vel_y": [-1.0, 1.0], "ang_vel_z": [-1, 1]}
            }
        },
        "actions": {
            "JointPositionAction": {
                "clip": None,
                "scale": [0.25] * 12,
                "offset": list(POSE),
                "joint_ids": None,
            }
        },
        "observations": observations,
    }
    body.update(changes)
    return body


def write_foreign(
    folder: Path, weights: Array | None = None, *, extra_inputs: int = 0, **changes: Any
) -> tuple[Path, Path]:
    """Write `policy.onnx`, whose action is the observation times some weights, and `deploy.yaml`.

    Args:
        folder: Where to.
        weights: Shape (numbers of an observation, actions); zeros if None.
        extra_inputs: Inputs beside the observation, as of a recurrent network.
        changes: Entries of the deploy.yaml.
    """
    from onnx import TensorProto, helper, numpy_helper, save

    matrix = np.zeros((WIDTH, 12)) if weights is None else weights
    width, actions = matrix.shape
    inputs = [helper.make_tensor_value_info("obs", TensorProto.FLOAT, [1, width])]
    for number in range(extra_inputs):
        memory = helper.make_tensor_value_info(f"memory_{number}", TensorProto.FLOAT, [1, 8])
        inputs.append(memory)
    output = helper.make_tensor_value_info("actions", TensorProto.FLOAT, [1, actions])
    node = helper.make_node("MatMul", ["obs", "weights"], ["actions"])
    initializer = numpy_helper.from_array(matrix.astype(np.float32), "weights")
    graph = helper.make_graph([node], "linear", inputs, [output], [initializer])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    save(model, str(folder / "policy.onnx"))
    (folder / "deploy.yaml").write_text(yaml.safe_dump(deploy_body(**changes), sort_keys=False))
    return folder / "policy.onnx", folder / "deploy.yaml"


def newest(term: str, number: int) -> int:
    """Return the place of one number of the newest sample of a term in an observation."""
    begin = 0
    for name, width in TERMS.items():
        if name == term:
            return begin + (HISTORY - 1) * width + number
        begin += HISTORY * width
    raise KeyError(term)
