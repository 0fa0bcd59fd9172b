"""All that the evaluation needs of `pronk.jump.train`: the environment, and the policies.

A checkpoint runs in PyTorch on the device of the simulation; an exported policy runs in ONNX
Runtime, the robots spread over the processor's cores, a few of them at a time.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers.metrics_manager import MetricsTermCfg
from tensordict import TensorDict
from torch import Tensor

from pronk.errors import ArtefactError, PronkError
from pronk.files import sha256
from pronk.jump.train.devices import device_facts
from pronk.jump.train.gains import TrainingGains
from pronk.jump.train.mdp.actions import NAME as ACTION
from pronk.jump.train.phases import TASKS
from pronk.jump.train.provenance import RunFolder
from pronk.jump.train.recipe import (
    ACTION_SCALE,
    EARLIER_DEFAULTS,
    TASK_NUMBERS,
    check_task_number,
    recorded_task_numbers,
    set_task_number,
)
from pronk.jump.train.rl.checkpoint import read_checkpoint, uses_jump_input
from pronk.jump.train.rl.networks import EstimatorActor
from pronk.jump.train.settings import DrawSettings
from pronk.jump.train.tasks import load_task
from pronk.jump.train.tasks.jump_env_cfg import draw_weak_drives, without_randomization
from pronk.jump.train.tasks.jump_rl_cfg import jump_rl_cfg
from pronk.jump.train.versions import package_versions
from pronk.jump.trial.training_sim.evaluation import Evaluation, EvaluationPlan
from pronk.jump.trial.training_sim.run import TERM, Act, Estimate, StepListener, evaluate_policy
from pronk.policy.contract import Contract, check, policy_robot_name
from pronk.policy.observation import JOINTS, MEASURED_SIZE
from pronk.policy.runtime import Inference, Policy, load_policy
from pronk.robots import load_robot


def evaluation_cfg(
    cfg: ManagerBasedRlEnvCfg, plan: EvaluationPlan, randomization: str = "full"
) -> ManagerBasedRlEnvCfg:
    """Make an environment of training one to evaluate in, without time-out and rewards.

    Args:
        cfg: The configuration, which is changed and returned.
        plan: The plan, of which the number of robots is read.
        randomization: `full` is as in training. `noise` is the nominal body and gains, undisturbed,
            with noise, timing (D1) and command delay drawn as in training: the closest to the
            paper's figures, of one robot measured several times. With `none` only starts and times
            are drawn.
    """
    if randomization != "full":
        without_randomization(cfg, noise=randomization == "noise")
    cfg.scene.num_envs = plan.size
    cfg.rewards = {}
    cfg.curriculum = {}
    cfg.terminations = {name: term for name, term in cfg.terminations.items() if not term.time_out}
    cfg.metrics = {TERM: MetricsTermCfg(func=StepListener, per_substep=True)}
    return cfg


def run_evaluation(
    policy: EvaluatedPolicy,
    gains: TrainingGains,
    plan: EvaluationPlan,
    *,
    device: str,
    randomization: str = "full",
    before: Mapping[str, float] | None = None,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> Evaluation:
    """Build the simulator and evaluate a policy in it.

    Args:
        policy: The policy.
        gains: Gains of the simulated drives.
        plan: The plan.
        device: `cpu` or `cuda:0`.
        randomization: As of `evaluation_cfg`.
        before: Speed errors by walk to compare with [m/s].
        progress: Called with the name of a stage and the fraction of it that is over.

    Raises:
        PronkError: The robots need more memory than is free, or the policy records numbers of a
            task that the robot's cannot have.
    """
    progress("building", 0.0)
    task = load_task(policy.robot)
    draws = policy.draws
    cfg = task.env_cfg(
        task.robot,
        gains,
        iterations=TASKS["all"],
        gain_shape="ellipsoid" if draws.ellipsoid and not gains.joints else "box",
        seed=plan.seed,
    )
    if draws.weakest_drive not in (None, 1.0):
        draw_weak_drives(cfg, draws.weakest_drive)
    set_task_numbers(cfg, policy)
    action: Any = cfg.actions[ACTION]
    _check_memory(plan, cfg.sim.mujoco.timestep, device)
    env = ManagerBasedRlEnv(cfg=evaluation_cfg(cfg, plan, randomization), device=device)
    progress("building", 1.0)
    with closing(env):
        evaluation = evaluate_policy(
            policy.act,
            env,
            plan,
            estimate=policy.estimate,
            progress=partial(progress, "walking and jumping"),
        )
    about = {
        "policy": policy.about,
        "gains": {"name": gains.name, "sha256": gains.sha256, "virtual": gains.virtual},
        "randomization": randomization,
        "by_joint": bool(gains.joints),
        "action_scale": action.scale,
        "device": device_facts(device.partition(":")[0], 1),
        "versions": package_versions(),
    }
    return replace(evaluation, about=about, before=before or {})


def set_task_numbers(cfg: ManagerBasedRlEnvCfg, policy: EvaluatedPolicy) -> None:
    """Give an environment the numbers of the task that a policy was trained with.

    Raises:
        ArtefactError: The task of the robot cannot have one of them.
    """
    for name, value in policy.task_numbers.items():
        try:
            set_task_number(cfg, name, value)
        except PronkError as error:
            raise ArtefactError(f"{policy.about['file']}: {name}: {error}") from None


def _check_memory(plan: EvaluationPlan, dt: float, device: str) -> None:
    """Refuse more robots than fit in the memory that is free; nothing where that is not known."""
    available = available_memory() if device == "cpu" else float(torch.cuda.mem_get_info()[0])
    needed = plan.memory_bytes(dt)
    if needed > available:
        commands = plan.size // plan.robots
        fitting = int(plan.robots * available / needed)
        raise PronkError(
            f"--robots {plan.robots}: {plan.size:,} robots for {commands} commands need about "
            f"{needed / 2**30:.0f} GiB on {device}, where {available / 2**30:.1f} GiB are free; "
            f"give --robots {max(fitting, 1)} or fewer."
        )


def available_memory(meminfo: Path = Path("/proc/meminfo")) -> float:
    """Return the memory of this host that is free, or can be freed [bytes]; infinite if unknown.

    Args:
        meminfo: Linux's file.
    """
    try:
        text = meminfo.read_text(encoding="utf-8")
    except OSError:
        return math.inf
    match = re.search(r"^MemAvailable:\s*(\d+) kB", text, re.MULTILINE)
    return math.inf if match is None else 1024.0 * int(match.group(1))


# ---- the policy under evaluation ----


@dataclass(frozen=True, kw_only=True)
class EvaluatedPolicy:
    """A policy under evaluation."""

    act: Act
    """Observations to actions."""
    estimate: Estimate
    """Observations to the estimate."""
    jump: bool
    """Whether it has the jump input."""
    robot: str
    """The robot that it is trained for, by name or path."""
    about: dict[str, Any]
    """File, hash, and provenance."""
    draws: DrawSettings = field(default_factory=DrawSettings)
    """How it was trained to differ in its drives, as far as that is known."""
    task_numbers: Mapping[str, float]
    """The `TASK_NUMBERS` that it was trained with, by name; what is missing is as in the task."""

    def knows(self, gains: TrainingGains) -> bool:
        """Return whether it was trained with these nominal gains."""
        if self.about.get("gains") != gains.name:
            return False
        return gains.name == "naive" or self.about.get("gains_sha256") == gains.sha256


def load_evaluated_policy(path: Path, device: str, robot: str | None = None) -> EvaluatedPolicy:
    """Read a policy.

    Args:
        path: `policy.onnx`, a checkpoint, or the folder of a run, whose last checkpoint is read.
        device: Device of the simulation.
        robot: Name or path of the robot; that of the policy if None.

    Raises:
        ArtefactError: No such file, or one that is no policy of this pronk.
    """
    if path.suffix == ".onnx":
        return _exported_policy(path, device, robot)
    file = RunFolder(path).checkpoint() if path.is_dir() else path
    state = read_checkpoint(file)
    actor = blank_actor()
    try:
        actor.load_state_dict(state["actor_state_dict"])
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1].strip()
        raise ArtefactError(
            f"{file}: its actor is not that of this pronk ({reason}); train again."
        ) from error
    actor = actor.to(device).eval()
    run = RunFolder(file.parent)
    provenance = run.read() if run.provenance.is_file() else {}
    settings = provenance.get("settings", {})
    gains = provenance.get("gains", {})
    task_numbers = _task_numbers(recorded_task_numbers(provenance), run.provenance)
    about = {
        "file": str(file),
        "sha256": sha256(file),
        "iteration": state["iter"],
        "gains": gains.get("name"),
        "gains_sha256": gains.get("sha256"),
        "settings": settings,
    }
    return EvaluatedPolicy(
        act=actor,
        estimate=actor.estimate,
        jump=uses_jump_input(state),
        robot=robot or run.robot(settings.get("robot", "mini_cheetah")),
        about=about,
        draws=_draws_of(settings),
        task_numbers=task_numbers,
    )


def blank_actor() -> EstimatorActor:
    """Return the actor as it is trained, with random weights."""
    cfg = jump_rl_cfg(iterations=1).actor
    blank = TensorDict(
        {"measured": torch.zeros(1, MEASURED_SIZE), "jump": torch.zeros(1, 1)}, batch_size=[1]
    )
    return EstimatorActor(
        blank,
        {"actor": ["measured", "jump"]},
        "actor",
        JOINTS,
        hidden_dims=cfg.hidden_dims,
        activation=cfg.activation,
        obs_normalization=cfg.obs_normalization,
        distribution_cfg=deepcopy(cfg.distribution_cfg),
    )


def _exported_policy(path: Path, device: str, robot: str | None) -> EvaluatedPolicy:
    """Read an exported policy."""
    policy = load_policy(path)
    contract = policy.contract
    robot = robot or policy_robot_name(contract)
    try:
        check(contract, load_robot(robot))
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
    task_numbers = _task_numbers(contract.provenance, path)
    runner = _ParallelPolicy(policy, device)
    return EvaluatedPolicy(
        act=runner.act,
        estimate=runner.estimate,
        jump=contract.jump,
        robot=robot,
        about=about,
        draws=_draws_of(contract.provenance),
        task_numbers={**task_numbers, ACTION_SCALE: _common_scale(contract, path)},
    )


def _task_numbers(recorded: Mapping[str, Any], source: Path) -> dict[str, float]:
    """Return the numbers of the task that are recorded of a training.

    Args:
        recorded: What is recorded; other entries and those that are None are left out. What is
            missing is as in earlier versions.
        source: File that has it, for messages.

    Raises:
        ArtefactError: A number is impossible.
    """
    numbers = dict(EARLIER_DEFAULTS)
    for name in TASK_NUMBERS:
        value = recorded.get(name)
        if value is None:
            continue
        try:
            check_task_number(name, value)
        except PronkError as error:
            raise ArtefactError(f"{source}: {error} Train again.") from None
        numbers[name] = value
    return numbers


def _common_scale(contract: Contract, path: Path) -> float:
    """Return the scale of the actions, which the training simulator has for all joints alike."""
    scales = set(contract.action_scale)
    if len(scales) > 1:
        raise ArtefactError(
            f"{path}: action_scale is {', '.join(f'{scale:g}' for scale in sorted(scales))} rad; "
            "the training simulator has one scale for all joints."
        )
    return scales.pop()


def _draws_of(recorded: Mapping[str, Any]) -> DrawSettings:
    """Return how a policy was trained to differ in its drives, by settings or provenance."""
    return DrawSettings(
        ellipsoid=recorded.get("ellipsoid"),
        by_joint=recorded.get("by_joint"),
        weakest_drive=recorded.get("weakest_drive"),
    )


_MAX_WORKERS = 16
"""Most threads of an exported policy. All of them share the memory that `pronk.policy.runtime`
allows; one runs a thousand observations of pronk's own network in 25 ms."""


class _ParallelPolicy:
    """An exported policy that acts for many robots at once, on the cores of this host."""

    def __init__(self, policy: Policy, device: str) -> None:
        self._policy = policy
        self._device = device
        self._workers = min(os.cpu_count() or 1, _MAX_WORKERS)
        self._pool = ThreadPoolExecutor(self._workers)
        self._inferred_on: Tensor | None = None
        self._inferred: list[Inference] = []

    def act(self, obs: TensorDict) -> Tensor:
        """Return the actions, (N, 12)."""
        self._infer(obs)
        # The next observations may be written into the same tensor.
        self._inferred_on = None
        return self._tensor([inference.action for inference in self._inferred])

    def estimate(self, obs: TensorDict) -> tuple[Tensor, Tensor]:
        """Return contact probabilities (N, 4) and velocity [m/s] (N, 3)."""
        self._infer(obs)
        contact = self._tensor([inference.contact for inference in self._inferred])
        velocity = self._tensor([inference.linear_velocity for inference in self._inferred])
        return contact, velocity

    def _infer(self, obs: TensorDict) -> None:
        """Run the network, unless it has just been run on these observations."""
        measured = obs["measured"]
        if measured is self._inferred_on:
            return
        jump = obs["jump"].cpu().numpy()
        if not self._policy.contract.jump:
            jump = np.zeros_like(jump)
        measured_parts = np.array_split(measured.cpu().numpy(), self._workers)
        jump_parts = np.array_split(jump, self._workers)
        futures = []
        for measured_part, jump_part in zip(measured_parts, jump_parts, strict=True):
            if len(measured_part):
                futures.append(self._pool.submit(self._policy.infer, measured_part, jump_part))
        self._inferred = [future.result() for future in futures]
        self._inferred_on = measured

    def _tensor(self, parts: list[Any]) -> Tensor:
        """Join the parts of the robots on the simulation's device."""
        return torch.from_numpy(np.concatenate(parts)).to(self._device)
