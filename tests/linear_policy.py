"""A policy that is linear in its input: it moves a robot for which no policy was trained."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from pronk import robots
from pronk.arrays import Array
from pronk.policy.contract import METADATA_KEY, Contract, measured_layout, to_json
from pronk.policy.observation import ESTIMATE, JOINTS, MEASURED, MEASURED_SIZE
from pronk.robots.robot import RobotSpec


def write_linear(
    path: Path, contract: Contract, measured: Array, jump: Array | None = None
) -> Path:
    """Write the ONNX of `action = measured @ input + jump @ jump input`; contacts 1, velocity 0.

    Args:
        path: The file.
        contract: The contract of the policy.
        measured: Weights of the measured input, shape (MEASURED_SIZE, JOINTS).
        jump: Weights of the jump input, shape (JOINTS,), of a contract with a jump input.
    """
    from onnx import TensorProto, helper, numpy_helper, save

    weights = {
        "no_velocity": np.zeros((MEASURED_SIZE, ESTIMATE["linear_velocity"])),
        "no_contact": np.zeros((MEASURED_SIZE, ESTIMATE["contact"])),
        "one": np.ones((1, 1)),
        "linear": measured,
    }
    inputs = {"measured": MEASURED_SIZE}
    nodes = [
        helper.make_node("MatMul", ["measured", "no_velocity"], ["linear_velocity"]),
        helper.make_node("MatMul", ["measured", "no_contact"], ["zero_contact"]),
        helper.make_node("Add", ["zero_contact", "one"], ["contact"]),
    ]
    if jump is None:
        nodes.append(helper.make_node("MatMul", ["measured", "linear"], ["action"]))
    else:
        weights["jump_weights"] = jump[None]
        inputs["jump"] = 1
        nodes.append(helper.make_node("MatMul", ["measured", "linear"], ["measured_action"]))
        nodes.append(helper.make_node("MatMul", ["jump", "jump_weights"], ["jump_action"]))
        nodes.append(helper.make_node("Add", ["measured_action", "jump_action"], ["action"]))

    def values(sizes: dict[str, int]) -> list[Any]:
        infos = []
        for name, size in sizes.items():
            infos.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size]))
        return infos

    initializers = []
    for name, array in weights.items():
        initializers.append(numpy_helper.from_array(array.astype(np.float32), name))
    outputs = {"action": JOINTS, **ESTIMATE}
    graph = helper.make_graph(nodes, "linear", values(inputs), values(outputs), initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, {METADATA_KEY: to_json(contract)})
    save(model, str(path))
    return path


def stiff_go2(folder: Path) -> Path:
    """Copy the Go2 with the stiffness of Unitree's stand example, 60 N m/rad, and return its file.

    With that of the policies of others, 20 N m/rad, it sits on its rear legs without a policy.
    """
    shipped = Path(robots.__file__).parent / "go2"
    shutil.copytree(shipped, folder, dirs_exist_ok=True)
    text = (shipped / "robot.yaml").read_text(encoding="utf-8")
    text = text.replace("stiffness: 20.0", "stiffness: 60.0").replace(
        "damping: 0.5", "damping: 2.0"
    )
    (folder / "robot.yaml").write_text(text, encoding="utf-8")
    return folder


def write_swaying(path: Path, robot: RobotSpec) -> Path:
    """Write a policy whose command squats, sways and pitches the trunk on four standing feet.

    Forward, left and yaw command of 1 bend the legs, roll the hips and tilt fore and aft, each by
    0.15 rad a joint (knees: twice that) about the default pose.
    """
    joints = robot.joints
    forward, left, yaw = MEASURED["command"]
    weights = np.zeros((MEASURED_SIZE, JOINTS))
    for column, joint in enumerate(joints):
        bend = {"hip_roll": 0.0, "hip_pitch": 0.15, "knee": -0.3}[joint.group]
        weights[forward, column] = bend
        if joint.group == "hip_roll":
            weights[left, column] = 0.15
        # Front and rear legs bend in opposite directions, which tilts the trunk.
        weights[yaw, column] = bend if joint.name.startswith("F") else -bend
    contract = Contract(
        robot=robot.name,
        joint_names=robot.joint_names,
        default_position=tuple(joint.default_position for joint in joints),
        action_scale=(1.0,) * JOINTS,
        stiffness=tuple(joint.stiffness for joint in joints),
        damping=tuple(joint.damping for joint in joints),
        gains="naive",
        gains_sha256="",
        virtual=True,
        observation=measured_layout(robot.policy_rate_hz),
        policy_rate_hz=robot.policy_rate_hz,
        timestep_s=robot.timestep_s,
        decimation=robot.decimation,
        delay_range_s=(0.0, 0.01),
        command_ranges={"vx": (-1.0, 1.0), "vy": (-1.0, 1.0), "yaw_rate": (-1.0, 1.0)},
        jump=False,
        lift_off_velocity=None,
    )
    return write_linear(path, contract, weights)
