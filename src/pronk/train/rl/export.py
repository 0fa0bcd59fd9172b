"""The policy leaves training: estimator and actor in one ONNX graph, the contract in its metadata.

    measured (batch, 105), jump (batch, 1; policies that jump only)
        -> action (batch, 12), contact (batch, 4; probability), linear_velocity (batch, 3)

All float32. The normalisation is part of the graph: what goes in is as measured.
"""

from __future__ import annotations

import copy
import importlib.util
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

import pronk
from pronk.files import written_whole
from pronk.policy.contract import COMMANDS, METADATA_KEY, Contract, measured_layout, to_json
from pronk.policy.layout import ESTIMATE, ESTIMATE_SIZE, MEASURED_SIZE
from pronk.policy.runtime import load_policy
from pronk.robots.robot import RobotSpec
from pronk.train.gains import TrainingGains
from pronk.train.rl.actor import EstimatorActor
from pronk.train.runner.provenance import versions

OPSET = 18
TOLERANCE = 1e-5
"""Largest difference between ONNX Runtime and PyTorch that `verify` should give."""


def contract_for(
    robot: RobotSpec,
    gains: TrainingGains,
    *,
    action_scale: float,
    delay_steps: tuple[int, int],
    command_limits: tuple[float, float, float],
    lift_off_velocity: float | None,
    provenance: Mapping[str, Any],
) -> Contract:
    """The contract of a policy that was trained on `robot` as the robot's constants have it.

    Args:
        robot: Which robot; its order of joints is that of the actions.
        gains: Nominal gains.
        action_scale: Position target per unit of action [rad].
        delay_steps: Smallest and largest command delay [physics steps].
        command_limits: Half-widths of the commands: forward, left [m/s], yaw rate [rad/s].
        lift_off_velocity: Wanted at lift-off [m/s]; None for a policy without jump input.
        provenance: Phases, iterations, seed, run; what JSON can hold.

    Raises:
        ArtefactError: The numbers contradict each other.
    """
    groups = [gains.groups[joint.group] for joint in robot.joints]
    low, high = delay_steps
    limits = zip(COMMANDS, command_limits, strict=True)
    return Contract(
        robot=robot.name,
        joint_names=robot.joint_names,
        default_position=tuple(joint.default_position for joint in robot.joints),
        action_scale=(action_scale,) * len(robot.joints),
        stiffness=tuple(group.stiffness for group in groups),
        damping=tuple(group.damping for group in groups),
        gains=gains.name,
        gains_sha256=gains.sha256,
        virtual=gains.virtual,
        observation=measured_layout(robot.policy_rate_hz),
        policy_rate_hz=robot.policy_rate_hz,
        timestep_s=robot.timestep_s,
        decimation=robot.decimation,
        delay_range_s=(low * robot.timestep_s, high * robot.timestep_s),
        command_ranges={name: (-half, half) for name, half in limits},
        jump=lift_off_velocity is not None,
        lift_off_velocity=lift_off_velocity,
        provenance=dict(provenance),
        versions={name: version for name, version in versions().items() if version is not None},
    )


def export_policy(actor: EstimatorActor, contract: Contract, path: Path) -> None:
    """Write `policy.onnx`, whole or not at all. The actor stays as it is, where it is.

    Args:
        actor: With or without jump input, as the contract says.
        contract: From `contract_for`.
        path: Where to.

    Raises:
        ValueError: Actor and contract disagree about the jump input.
    """
    import onnx

    if bool(actor.jump_size) != contract.jump:
        raise ValueError(f"actor with {actor.jump_size} jump inputs, contract with {contract.jump}")
    inputs = {"measured": MEASURED_SIZE} | ({"jump": 1} if contract.jump else {})
    outputs = ["action", *ESTIMATE]
    with written_whole(path) as aside:
        with warnings.catch_warnings():
            # The exporter that mjlab uses too; newer versions of torch say that another is newer.
            warnings.simplefilter("ignore", DeprecationWarning)
            torch.onnx.export(
                _Exported(actor),
                tuple(torch.zeros(2, size) for size in inputs.values()),
                aside,
                input_names=list(inputs),
                output_names=outputs,
                dynamic_axes={name: {0: "batch"} for name in (*inputs, *outputs)},
                opset_version=OPSET,
                dynamo=False,
            )
        model = onnx.load(aside)
        model.producer_name, model.producer_version = "pronk", pronk.__version__
        model.doc_string = (
            f"{contract.robot}: {'walks and jumps' if contract.jump else 'walks'}; trained with "
            f"{contract.gains} gains; the contract is JSON in the metadata under {METADATA_KEY}."
        )
        onnx.helper.set_model_props(model, {METADATA_KEY: to_json(contract)})
        onnx.checker.check_model(model)
        onnx.save(model, aside)


def verify(path: Path, actor: EstimatorActor, observations: Mapping[str, Tensor]) -> float | None:
    """How far an exported policy is from its actor.

    Both compute on the processor: a GPU may round matrix products to TF32.

    Args:
        path: From `export_policy`.
        actor: What was exported.
        observations: "measured" (N, 105) and, for a policy that jumps, "jump" (N, 1).

    Returns:
        Largest absolute difference over all outputs; None if ONNX Runtime is not installed.

    Raises:
        ArtefactError: The file cannot be run, or what goes in or comes out is not finite.
    """
    if importlib.util.find_spec("onnxruntime") is None:
        return None
    groups = {
        name: observations[name].detach().to("cpu", torch.float32)
        for name in ("measured", *(["jump"] if actor.jump_size else []))
    }
    found = load_policy(path).infer(*(group.numpy() for group in groups.values()))
    exported = _Exported(actor)
    with torch.no_grad():
        action = exported.head(exported.actor(groups))
        expected = torch.cat([action, *exported.actor.estimate(groups)], dim=-1)
    got = np.concatenate([found.action, found.contact, found.linear_velocity], axis=-1)
    return float((torch.from_numpy(got) - expected).abs().max())


class _Exported(nn.Module):
    """Estimate and action of one pass: the estimate is what the actor itself reads."""

    def __init__(self, actor: EstimatorActor) -> None:
        super().__init__()
        # The distribution holds tensors of the last update, which cannot be copied; needed is only
        # what it makes of the network's output without noise.
        distribution = actor.distribution
        assert distribution is not None, "PPO has trained it"
        self.head = distribution.as_deterministic_output_module()
        self.actor = copy.deepcopy(actor, {id(distribution): nn.Identity()})
        self.actor.distribution = None
        self.to("cpu", torch.float32).eval()

    def forward(self, measured: Tensor, *jump: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(N, 105) and, for policies that jump, (N, 1) to (N, 12), (N, 4), (N, 3)."""
        groups = dict(zip(("measured", "jump"), (measured, *jump), strict=False))
        latent = self.actor.get_latent(groups)
        contact = latent[:, : ESTIMATE["contact"]]
        velocity = latent[:, ESTIMATE["contact"] : ESTIMATE_SIZE]
        return self.head(self.actor.mlp(latent)), contact, velocity
