"""Export of a policy: estimator and actor in one ONNX graph, the contract in its metadata.

    measured (batch, 105), jump (batch, 1; policies that jump only)
        -> action (batch, 12), contact (batch, 4; probability), linear_velocity (batch, 3)

All float32. The normalization is part of the graph: the input is as measured.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mjlab.envs import ManagerBasedRlEnvCfg
from torch import Tensor, nn

from pronk.files import written_whole
from pronk.jump.train.mdp import actions, commands
from pronk.jump.train.rl.networks import EstimatorActor
from pronk.jump.train.versions import package_versions
from pronk.policy.contract import COMMANDS, METADATA_KEY, Contract, measured_layout, to_json
from pronk.policy.observation import ESTIMATE, ESTIMATE_SIZE, MEASURED_SIZE
from pronk.policy.runtime import load_policy
from pronk.robots import load_robot
from pronk.version import VERSION

OPSET = 18
TOLERANCE = 1e-5
"""Largest difference between ONNX Runtime and PyTorch that `verify` should give."""


def contract_for(
    cfg: ManagerBasedRlEnvCfg, *, jump: bool, provenance: Mapping[str, Any]
) -> Contract:
    """Return the contract of a policy.

    Args:
        cfg: Configuration of the environment that it was trained in.
        jump: Whether the policy has the jump input.
        provenance: Entries on the training.
    """
    command = cfg.commands[commands.NAME]
    action = cfg.actions[actions.NAME]
    robot = load_robot(command.robot)
    gains = command.gains
    default_position = []
    stiffness = []
    damping = []
    for joint in robot.joints:
        joint_gains = gains.of(joint)
        default_position.append(joint.default_position)
        stiffness.append(joint_gains.stiffness)
        damping.append(joint_gains.damping)
    shortest_delay, longest_delay = action.delay_steps
    command_ranges = {}
    for name, limit in zip(COMMANDS, command.limits, strict=True):
        command_ranges[name] = (-limit, limit)
    return Contract(
        robot=robot.name,
        joint_names=robot.joint_names,
        default_position=tuple(default_position),
        action_scale=(float(action.scale),) * len(robot.joints),
        stiffness=tuple(stiffness),
        damping=tuple(damping),
        gains=gains.name,
        # A contract has the hash of gains alone, not of the ranges about nominal ones.
        gains_sha256=gains.sha256 if gains.name == "matched" else "",
        virtual=gains.virtual,
        observation=measured_layout(robot.policy_rate_hz),
        policy_rate_hz=robot.policy_rate_hz,
        timestep_s=robot.timestep_s,
        decimation=robot.decimation,
        delay_range_s=(shortest_delay * robot.timestep_s, longest_delay * robot.timestep_s),
        command_ranges=command_ranges,
        jump=jump,
        lift_off_velocity=command.settings.liftoff_velocity if jump else None,
        provenance=dict(provenance),
        versions=package_versions(),
    )


def export_policy(actor: EstimatorActor, contract: Contract, path: Path) -> None:
    """Write `policy.onnx`, whole or not at all.

    Args:
        actor: The actor; without jump input in the contract its jump input is zero.
        contract: The contract.
        path: The file.
    """
    import onnx

    inputs = {"measured": torch.zeros(2, MEASURED_SIZE)}
    does = "walks"
    if contract.jump:
        inputs["jump"] = torch.zeros(2, 1)
        does = "walks and jumps"
    outputs = ["action", *ESTIMATE]
    batch_axes = {name: {0: "batch"} for name in (*inputs, *outputs)}
    with written_whole(path) as temporary_path:
        with warnings.catch_warnings():
            # mjlab uses the same exporter; newer versions of torch announce another.
            warnings.simplefilter("ignore", DeprecationWarning)
            torch.onnx.export(
                _ExportedActor(actor),
                tuple(inputs.values()),
                temporary_path,
                input_names=list(inputs),
                output_names=outputs,
                dynamic_axes=batch_axes,
                opset_version=OPSET,
                dynamo=False,
            )
        model = onnx.load(temporary_path)
        model.producer_name = "pronk"
        model.producer_version = VERSION
        model.doc_string = (
            f"{contract.robot}: {does}; trained with {contract.gains} gains; the contract is JSON "
            f"in the metadata under {METADATA_KEY}."
        )
        onnx.helper.set_model_props(model, {METADATA_KEY: to_json(contract)})
        onnx.checker.check_model(model)
        onnx.save(model, temporary_path)


def verify(path: Path, actor: EstimatorActor, observations: Mapping[str, Tensor]) -> float:
    """Compare an exported policy with its actor.

    Both compute on the CPU: a GPU may round matrix products to TF32.

    Args:
        path: The exported policy.
        actor: The actor.
        observations: `measured` (N, 105) and, for a policy that jumps, `jump` (N, 1).

    Returns:
        Largest absolute difference of all outputs.
    """
    policy = load_policy(path)
    measured = observations["measured"].detach().to("cpu", torch.float32)
    exported = _ExportedActor(actor)
    with torch.no_grad():
        if policy.contract.jump:
            jump = observations["jump"].detach().to("cpu", torch.float32)
            inference = policy.infer(measured.numpy(), jump.numpy())
            expected = torch.cat(exported(measured, jump), dim=-1)
        else:
            inference = policy.infer(measured.numpy())
            expected = torch.cat(exported(measured), dim=-1)
    outputs = np.concatenate(
        [inference.action, inference.contact, inference.linear_velocity], axis=-1
    )
    return float((torch.from_numpy(outputs) - expected).abs().max())


class _ExportedActor(nn.Module):
    """Action and estimate in one pass: the estimate is the one that the actor reads."""

    def __init__(self, actor: EstimatorActor) -> None:
        super().__init__()
        # The distribution holds tensors of the last update, which cannot be copied; only its
        # deterministic output is needed.
        self.head = actor.distribution.as_deterministic_output_module()
        self.actor = copy.deepcopy(actor, {id(actor.distribution): nn.Identity()})
        self.actor.distribution = None
        self.to("cpu", torch.float32).eval()

    def forward(self, measured: Tensor, jump: Tensor | None = None) -> tuple[Tensor, ...]:
        """Return action (N, 12), contact (N, 4) and velocity (N, 3).

        Args:
            measured: The measured vector, (N, 105).
            jump: The jump input of policies that jump, (N, 1).
        """
        if jump is None:
            jump = measured[:, :1].clamp(0.0, 0.0)  # zeros of the size of the batch
        latent = self.actor.get_latent({"measured": measured, "jump": jump})
        contact = latent[:, : ESTIMATE["contact"]]
        velocity = latent[:, ESTIMATE["contact"] : ESTIMATE_SIZE]
        return self.head(self.actor.mlp(latent)), contact, velocity
