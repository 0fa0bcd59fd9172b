"""The policy under evaluation: of a training run, or an exported one.

A checkpoint runs in PyTorch on the device of the simulation. An exported policy runs as it would
on the robot, in ONNX Runtime on the processor, so every step waits for it; the robots are
spread over its cores.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from pronk.errors import ArtefactError
from pronk.files import sha256
from pronk.policy.contract import check
from pronk.policy.layout import JOINTS, MEASURED_SIZE
from pronk.policy.runtime import Inference, Policy, load_policy
from pronk.robots import load_robot
from pronk.train.gains import TrainingGains
from pronk.train.phases import phase
from pronk.train.rl.actor import EstimatorActor
from pronk.train.runner import checkpoint
from pronk.train.runner.request import ROBOT
from pronk.train.runner.run_folder import RunFolder
from pronk.train.tasks import rl_cfg


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A policy under evaluation."""

    act: Callable[[TensorDict], Tensor]
    """Observation groups to actions (N, 12)."""
    estimate: Callable[[TensorDict], tuple[Tensor, Tensor]] | None
    """Observation groups to contact probabilities (N, 4) and trunk velocity [m/s] (N, 3)."""
    jump: bool
    """Whether it has the jump input."""
    about: dict[str, Any]
    """File, hash, and provenance."""

    def knows(self, gains: TrainingGains) -> bool:
        """Whether it was trained with these nominal gains."""
        same = bool(self.about.get("gains") == gains.name)
        return same and (gains.name == "naive" or self.about.get("gains_sha256") == gains.sha256)


def load_subject(path: Path, device: str) -> Subject:
    """Read a policy.

    Args:
        path: `policy.onnx`, a checkpoint, or the folder of a run (its last checkpoint).
        device: Of a checkpoint's networks.

    Raises:
        ArtefactError: Missing, damaged, or none of these.
    """
    if path.suffix == ".onnx":
        return _exported(path, device)
    found: Path | None = path
    if path.is_dir():
        found = checkpoint.latest(RunFolder(path).checkpoints)
        if found is None:
            raise ArtefactError(
                f"{path}: no checkpoints in it; expected the folder of a run, a checkpoint, or "
                "an exported policy.onnx."
            )
    return _trained(found or path, device)


def _trained(path: Path, device: str) -> Subject:
    stored = checkpoint.load(path)
    jump = phase(str(stored.about.get("phase"))).jump
    actor = blank_actor(jump=jump)
    try:
        actor.load_state_dict(stored.tree["algorithm"]["actor_state_dict"])
    except (KeyError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[-1].strip()
        raise ArtefactError(
            f"{path}: its actor is not that of this pronk ({reason}); train again."
        ) from error
    actor = actor.to(device).eval()
    about = {"file": str(path), "sha256": sha256(path), **stored.about}
    return Subject(act=actor, estimate=actor.estimate, jump=jump, about=about)


def blank_actor(*, jump: bool) -> EstimatorActor:
    """The actor as it is trained, with random weights.

    Args:
        jump: With the jump input.
    """
    cfg = rl_cfg(jump=jump).actor
    sizes = {"measured": MEASURED_SIZE, "jump": 1}
    blank = TensorDict({k: torch.zeros(1, n) for k, n in sizes.items()}, batch_size=[1])
    return EstimatorActor(
        blank,
        {"actor": [*sizes] if jump else ["measured"]},
        "actor",
        JOINTS,
        hidden_dims=cfg.hidden_dims,
        activation=cfg.activation,
        obs_normalization=cfg.obs_normalization,
        distribution_cfg=deepcopy(cfg.distribution_cfg),
    )


def _exported(path: Path, device: str) -> Subject:
    policy = load_policy(path)
    contract = policy.contract
    try:
        check(contract, load_robot(ROBOT))
    except ArtefactError as error:
        raise ArtefactError(f"{path}: {error}") from None
    about = {
        "file": str(path),
        "sha256": policy.sha256,
        "gains": contract.gains,
        "gains_sha256": contract.gains_sha256,
        "virtual": contract.virtual,
        "provenance": dict(contract.provenance),
        "versions": dict(contract.versions),
    }
    runner = _Exported(policy, device)
    return Subject(
        act=runner.act,
        estimate=runner.estimate,
        jump=contract.jump,
        about=about,
    )


class _Exported:
    """An exported policy that acts for many robots at once."""

    def __init__(self, policy: Policy, device: str) -> None:
        self._policy, self._device = policy, device
        self._workers = os.cpu_count() or 1
        self._pool = ThreadPoolExecutor(self._workers)
        self._last: Tensor | None = None
        self._inferred: list[Inference] = []

    def act(self, obs: TensorDict) -> Tensor:
        self._infer(obs)
        # The next observations may be written into the same tensor.
        self._last = None
        return self._joined("action")

    def estimate(self, obs: TensorDict) -> tuple[Tensor, Tensor]:
        self._infer(obs)
        return self._joined("contact"), self._joined("linear_velocity")

    def _infer(self, obs: TensorDict) -> None:
        """Run the network, unless it has just been run on these observations."""
        measured = obs["measured"]
        if measured is self._last:
            return
        jump = obs["jump"].cpu().numpy()
        if not self._policy.contract.jump:
            jump = np.zeros_like(jump)
        parts = [np.array_split(a, self._workers) for a in (measured.cpu().numpy(), jump)]
        rows = [(m, j) for m, j in zip(*parts, strict=True) if len(m)]
        self._inferred = list(self._pool.map(lambda row: self._policy.infer(*row), rows))
        self._last = measured

    def _joined(self, name: str) -> Tensor:
        whole = np.concatenate([getattr(part, name) for part in self._inferred])
        return torch.from_numpy(whole).to(self._device)
