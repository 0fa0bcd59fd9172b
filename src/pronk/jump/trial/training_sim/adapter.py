"""All that the evaluation needs of `pronk.jump.train`: the environment, and the policies.

A checkpoint runs in PyTorch on the device of the simulation; an exported policy runs in ONNX
Runtime, the robots spread over the processor's cores.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers.metrics_manager import MetricsTermCfg
from tensordict import TensorDict
from torch import Tensor

from pronk.errors import ArtefactError
from pronk.files import sha256
from pronk.jump.train.devices import device_facts
from pronk.jump.train.gains import TrainingGains
from pronk.jump.train.phases import TASKS
from pronk.jump.train.provenance import RunFolder
from pronk.jump.train.rl import checkpoint
from pronk.jump.train.rl.export import versions
from pronk.jump.train.rl.networks import EstimatorActor
from pronk.jump.train.tasks import load_task
from pronk.jump.train.tasks.jump_env_cfg import without_randomization
from pronk.jump.train.tasks.jump_rl_cfg import jump_rl_cfg
from pronk.jump.trial.training_sim.evaluation import Evaluation, Plan
from pronk.jump.trial.training_sim.run import TERM, Estimate, Policy, StepListener, evaluate_policy
from pronk.policy.contract import check
from pronk.policy.observation import JOINTS, MEASURED_SIZE
from pronk.policy.runtime import Inference, load_policy
from pronk.policy.runtime import Policy as ExportedPolicy
from pronk.robots import load_robot


def evaluation_cfg(
    cfg: ManagerBasedRlEnvCfg, plan: Plan, randomization: str = "full"
) -> ManagerBasedRlEnvCfg:
    """Make an environment of training one to evaluate in; changes `cfg` and returns it.

    It has no time-out, no rewards, and the step listener. Randomization `full` is as in training.
    `noise` is the nominal body and gains, undisturbed, with noise, timing (D1) and command delay
    drawn as in training: the closest to the paper's figures, of one robot measured several times.
    With `none` only starts and times are drawn.
    """
    if randomization != "full":
        without_randomization(cfg, noise=randomization == "noise")
    cfg.scene.num_envs = plan.size
    cfg.rewards = {}
    cfg.curriculum = {}
    cfg.terminations = {name: t for name, t in cfg.terminations.items() if not t.time_out}
    cfg.metrics = {TERM: MetricsTermCfg(func=StepListener, per_substep=True)}
    return cfg


def evaluate(
    subject: Subject,
    gains: TrainingGains,
    plan: Plan,
    *,
    device: str,
    randomization: str = "full",
    before: Mapping[str, float] | None = None,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> Evaluation:
    """Build the simulator on a device, `cpu` or `cuda:0`, and evaluate in it.

    `before` has speed errors to compare with; `randomization` is as of `evaluation_cfg`.
    """
    progress("building", 0.0)
    task = load_task(subject.robot)
    cfg = task.env_cfg(task.robot, gains, iterations=TASKS["all"], seed=plan.seed)
    env = ManagerBasedRlEnv(cfg=evaluation_cfg(cfg, plan, randomization), device=device)
    progress("building", 1.0)
    with closing(env):
        found = evaluate_policy(
            subject.act,
            env,
            plan,
            estimate=subject.estimate,
            progress=partial(progress, "walking and jumping"),
        )
    about = {
        "policy": subject.about,
        "gains": {"name": gains.name, "sha256": gains.sha256, "virtual": gains.virtual},
        "randomization": randomization,
        "device": device_facts(device.partition(":")[0], 1),
        "versions": versions(),
    }
    return replace(found, about=about, before=before or {})


# ---- the policy under evaluation ----


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A policy under evaluation."""

    act: Policy
    estimate: Estimate
    jump: bool
    """Whether it has the jump input."""
    robot: str
    """The robot that it is trained for, by name or path."""
    about: dict[str, Any]
    """File, hash, and provenance."""

    def knows(self, gains: TrainingGains) -> bool:
        """Whether it was trained with these nominal gains."""
        same = bool(self.about.get("gains") == gains.name)
        return same and (gains.name == "naive" or self.about.get("gains_sha256") == gains.sha256)


def load_subject(path: Path, device: str) -> Subject:
    """Read `policy.onnx`, a checkpoint, or the last checkpoint of the folder of a run."""
    if path.suffix == ".onnx":
        return _exported(path, device)
    found = RunFolder(path).checkpoint() if path.is_dir() else path
    state = checkpoint.read(found)
    actor = blank_actor()
    try:
        actor.load_state_dict(state["actor_state_dict"])
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1].strip()
        raise ArtefactError(
            f"{found}: its actor is not that of this pronk ({reason}); train again."
        ) from error
    actor = actor.to(device).eval()
    run = RunFolder(found.parent)
    provenance = run.read() if run.provenance.is_file() else {}
    settings, gains = provenance.get("settings", {}), provenance.get("gains", {})
    about = {
        "file": str(found),
        "sha256": sha256(found),
        "iteration": state["iter"],
        "gains": gains.get("name"),
        "gains_sha256": gains.get("sha256"),
        "settings": settings,
    }
    return Subject(
        act=actor,
        estimate=actor.estimate,
        jump=checkpoint.jumps(state),
        robot=settings.get("robot", "mini_cheetah"),
        about=about,
    )


def blank_actor() -> EstimatorActor:
    """The actor as it is trained, with random weights."""
    cfg = jump_rl_cfg(iterations=1).actor
    sizes = {"measured": MEASURED_SIZE, "jump": 1}
    blank = TensorDict({k: torch.zeros(1, n) for k, n in sizes.items()}, batch_size=[1])
    return EstimatorActor(
        blank,
        {"actor": [*sizes]},
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
        check(contract, load_robot(contract.robot))
    except ArtefactError as error:
        raise ArtefactError(f"{path}: {error}") from None
    about = {
        "file": str(path),
        "sha256": policy.sha256,
        **{name: getattr(contract, name) for name in ("gains", "gains_sha256", "virtual")},
        **{name: dict(getattr(contract, name)) for name in ("provenance", "versions")},
    }
    runner = _Exported(policy, device)
    return Subject(
        act=runner.act,
        estimate=runner.estimate,
        jump=contract.jump,
        robot=contract.robot,
        about=about,
    )


class _Exported:
    """An exported policy that acts for many robots at once."""

    def __init__(self, policy: ExportedPolicy, device: str) -> None:
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
