"""Export of a policy: estimator and actor in one ONNX graph, the contract in its metadata.

    measured (batch, 105), jump (batch, 1; policies that jump only)
        -> action (batch, 12), contact (batch, 4; probability), linear_velocity (batch, 3)

All float32. The normalization is part of the graph: the input is as measured.
"""

from __future__ import annotations

import copy
import platform
import warnings
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mjlab.envs import ManagerBasedRlEnvCfg
from torch import Tensor, nn

from pronk.files import written_whole
from pronk.jump.train.mdp import actions, commands
from pronk.jump.train.rl.networks import EstimatorActor
from pronk.policy.contract import COMMANDS, METADATA_KEY, Contract, measured_layout, to_json
from pronk.policy.observation import ESTIMATE, ESTIMATE_SIZE, MEASURED_SIZE
from pronk.policy.runtime import load_policy
from pronk.robots import load_robot
from pronk.version import VERSION

OPSET = 18
TOLERANCE = 1e-5
"""Largest difference between ONNX Runtime and PyTorch that `verify` should give."""


def package_versions() -> dict[str, str]:
    """Versions of the packages that a run is computed with."""
    modules = ("mjlab", "mujoco", "mujoco_warp", "warp", "torch", "rsl_rl", "numpy")
    packages = {"warp": "warp-lang", "rsl_rl": "rsl-rl-lib"}
    found = {"python": platform.python_version(), "pronk": VERSION}
    return found | {name: metadata.version(packages.get(name, name)) for name in modules}


def contract_for(
    cfg: ManagerBasedRlEnvCfg, *, jump: bool, provenance: Mapping[str, Any]
) -> Contract:
    """The contract of a policy that was trained in an environment, with or without jump input."""
    command, action = cfg.commands[commands.NAME], cfg.actions[actions.NAME]
    robot, gains = load_robot(command.robot), command.gains
    groups = [gains.groups[joint.group] for joint in robot.joints]
    low, high = (steps * robot.timestep_s for steps in action.delay_steps)
    limits = zip(COMMANDS, command.limits, strict=True)
    return Contract(
        robot=robot.name,
        joint_names=robot.joint_names,
        default_position=tuple(joint.default_position for joint in robot.joints),
        action_scale=(float(action.scale),) * len(robot.joints),
        stiffness=tuple(group.stiffness for group in groups),
        damping=tuple(group.damping for group in groups),
        gains=gains.name,
        # A contract has the hash of gains alone, not of the ranges about naive ones.
        gains_sha256=gains.sha256 if gains.name == "matched" else "",
        virtual=gains.virtual,
        observation=measured_layout(robot.policy_rate_hz),
        policy_rate_hz=robot.policy_rate_hz,
        timestep_s=robot.timestep_s,
        decimation=robot.decimation,
        delay_range_s=(low, high),
        command_ranges={name: (-limit, limit) for name, limit in limits},
        jump=jump,
        lift_off_velocity=command.settings.liftoff_velocity if jump else None,
        provenance=dict(provenance),
        versions=package_versions(),
    )


def export_policy(actor: EstimatorActor, contract: Contract, path: Path) -> None:
    """Write `policy.onnx`, whole or not at all; without jump input the actor's is zero."""
    import onnx

    inputs = {"measured": MEASURED_SIZE} | ({"jump": 1} if contract.jump else {})
    outputs = ["action", *ESTIMATE]
    with written_whole(path) as aside:
        with warnings.catch_warnings():
            # mjlab uses the same exporter; newer versions of torch announce another.
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
        model.producer_name, model.producer_version = "pronk", VERSION
        model.doc_string = (
            f"{contract.robot}: {'walks and jumps' if contract.jump else 'walks'}; trained with "
            f"{contract.gains} gains; the contract is JSON in the metadata under {METADATA_KEY}."
        )
        onnx.helper.set_model_props(model, {METADATA_KEY: to_json(contract)})
        onnx.checker.check_model(model)
        onnx.save(model, aside)


def verify(path: Path, actor: EstimatorActor, observations: Mapping[str, Tensor]) -> float:
    """Largest absolute difference of all outputs between an exported policy and its actor.

    Both compute on the CPU: a GPU may round matrix products to TF32. `observations` has "measured"
    (N, 105) and, for a policy that jumps, "jump" (N, 1).
    """
    policy = load_policy(path)
    names = ("measured", "jump") if policy.contract.jump else ("measured",)
    inputs = [observations[name].detach().to("cpu", torch.float32) for name in names]
    found = policy.infer(*(value.numpy() for value in inputs))
    with torch.no_grad():
        expected = torch.cat(_Exported(actor)(*inputs), dim=-1)
    got = np.concatenate([found.action, found.contact, found.linear_velocity], axis=-1)
    return float((torch.from_numpy(got) - expected).abs().max())


class _Exported(nn.Module):
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
        """(N, 105) and, for policies that jump, (N, 1) to (N, 12), (N, 4), (N, 3)."""
        if jump is None:
            jump = measured[:, :1].clamp(0.0, 0.0)  # zeros of the size of the batch
        latent = self.actor.get_latent({"measured": measured, "jump": jump})
        contact = latent[:, : ESTIMATE["contact"]]
        velocity = latent[:, ESTIMATE["contact"] : ESTIMATE_SIZE]
        return self.head(self.actor.mlp(latent)), contact, velocity
