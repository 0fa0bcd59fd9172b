"""One pass through an evaluation plan: environment, commands, recording, and the policy itself.

Trunk and contacts are recorded at every physics step, on the device, by a metrics term of mjlab.
mjlab's contacts lag its positions by one physics step there, so each position is kept until its
contacts are known. A checkpoint runs in PyTorch on the device of the simulation; an exported policy
runs in ONNX Runtime, the robots spread over the processor's cores.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers.metrics_manager import MetricsTermCfg
from tensordict import TensorDict
from torch import Tensor

from pronk.errors import ArtefactError, PronkError
from pronk.evaluation.jumps import steps
from pronk.evaluation.training_sim.evaluation import NEVER, Plan
from pronk.files import sha256
from pronk.policy.contract import check
from pronk.policy.layout import ESTIMATE, JOINTS, MEASURED_SIZE
from pronk.policy.runtime import Inference, load_policy
from pronk.policy.runtime import Policy as ExportedPolicy
from pronk.robots import load_robot
from pronk.train.gains import TrainingGains
from pronk.train.mdp.commands import motion_command
from pronk.train.provenance import RunFolder
from pronk.train.rl import checkpoint
from pronk.train.rl.networks import EstimatorActor
from pronk.train.tasks.jump_env_cfg import without_randomization
from pronk.train.tasks.jump_rl_cfg import jump_rl_cfg

Policy = Callable[[TensorDict], Tensor]
"""Observation groups to actions (N, 12)."""
Estimate = Callable[[TensorDict], tuple[Tensor, Tensor]]
"""Observation groups to contact probabilities (N, 4) and trunk velocity [m/s] (N, 3)."""

TERM = "evaluation"
"""The metrics term's name."""

RANDOMIZATIONS = ("full", "noise", "none")
"""What differs between robots. `full`: as in training. `noise`: the nominal body and gains,
undisturbed, with noise, timing (D1) and command delay drawn as in training; the closest to the
paper's figures, of one robot measured several times. `none`: only starts and times are drawn."""


class StepListener:
    """A metrics term that calls a listener after every physics step."""

    def __init__(self, cfg: MetricsTermCfg, env: ManagerBasedRlEnv) -> None:
        self.listener: Callable[[], None] | None = None
        self._nothing = torch.zeros(env.num_envs, device=env.device)

    def __call__(self, env: ManagerBasedRlEnv) -> Tensor:
        """Call the listener; the metric itself is zero. (N,)."""
        if self.listener is not None:
            self.listener()
        return self._nothing


def evaluation_cfg(
    cfg: ManagerBasedRlEnvCfg, plan: Plan, randomization: str = "full"
) -> ManagerBasedRlEnvCfg:
    """Make an environment of training one to evaluate in; changes `cfg` and returns it.

    As many robots as the plan has, no time-out, no rewards, and the step listener.
    """
    if randomization != "full":
        without_randomization(cfg, noise=randomization == "noise")
    cfg.scene.num_envs = plan.size
    cfg.rewards = {}
    cfg.curriculum = {}
    cfg.terminations = {name: t for name, t in cfg.terminations.items() if not t.time_out}
    cfg.metrics = {TERM: MetricsTermCfg(func=StepListener, per_substep=True)}
    return cfg


class Recording:
    """Trunk and contacts of the robots of one command, at every physics step."""

    def __init__(self, robots: slice, samples: int, device: torch.device | str) -> None:
        """Reserve memory: 58 bytes a robot and sample."""
        shape = (samples, robots.stop - robots.start)
        self._robots = robots
        self.state = torch.zeros(*shape, 13, device=device)
        """Position [m], quaternion w x y z and velocity [m/s] in the world's frame, angular
        velocity in the trunk's [rad/s]. (T, n, 13)"""
        self.feet = torch.zeros(*shape, 4, dtype=torch.bool, device=device)
        """On the ground. (T, n, 4)"""
        self.other = torch.zeros(*shape, dtype=torch.bool, device=device)
        """Something but a foot touches the ground. (T, n)"""

    def add(self, k: int, state: Tensor, feet: Tensor, other: Tensor) -> None:
        """Record sample `k` of all robots of the environment."""
        if k < len(self.state):
            self.state[k] = state[self._robots]
            self.feet[k] = feet[self._robots]
            self.other[k] = other[self._robots]


class Run:
    """A plan under way in an environment."""

    def __init__(self, env: ManagerBasedRlEnv, plan: Plan) -> None:
        """Prepare.

        Raises:
            PronkError: The environment was not built with `evaluation_cfg` for this plan.
        """
        terms = getattr(env.metrics_manager, "cfg", None) or {}
        if TERM not in terms or env.num_envs != plan.size:
            raise PronkError(
                f"the environment has {env.num_envs} robots and "
                f"{'an' if TERM in terms else 'no'} evaluation term; this plan needs one built "
                f"with evaluation_cfg for {plan.size} robots."
            )
        self._listener: StepListener = terms[TERM].func
        self._env, self._plan = env, plan
        self._motion = motion_command(env)
        self.dt = dt = env.physics_dt
        device, count = env.device, plan.robots
        self._command = torch.tensor(plan.commands(), dtype=torch.float32, device=device)
        self._times = {k: torch.tensor(v, device=device) for k, v in plan.times(dt).items()}
        self._walking = steps(plan.settle_s, dt), steps(plan.walk_s, dt)
        lengths = [plan.walk_s] * len(plan.walks) + [plan.jump_seconds] * len(plan.jumps)
        self.recordings = tuple(
            Recording(slice(i * count, (i + 1) * count), steps(length, dt), device)
            for i, length in enumerate(lengths)
        )
        """One for each command."""
        self.sample = 0
        """Number of the sample that comes next."""
        self._alive = torch.ones(plan.size, dtype=torch.bool, device=device)
        self.fell_at = torch.full((plan.size,), NEVER, dtype=torch.int64, device=device)
        """Sample at which a robot was found fallen; `NEVER` for one that stands at the end."""
        self.on = torch.full_like(self.fell_at, NEVER)
        """Sample at which the policy first read the jump input; `NEVER` before."""
        self.non_finite = torch.zeros_like(self._alive)
        """Fallen because its physics diverged."""
        self.estimates = torch.zeros(5, dtype=torch.float64, device=device)
        """Of the walking robots' estimator: sums of squared velocity errors by axis [m^2/s^2], of
        the share of right contacts, and the count of policy steps."""
        self._state = self._read()

    def go(
        self, policy: Policy, estimate: Estimate | None, progress: Callable[[float], None]
    ) -> Self:
        """Simulate the whole plan; `estimate` is the policy's estimator, if it is evaluated."""
        # Not inference mode, which would leave the environment with read-only tensors.
        with torch.no_grad():
            before, self._motion.scripted = self._motion.scripted, True
            self._listener.listener = self._record
            try:
                self._steps(policy, estimate, progress)
            finally:
                self._listener.listener = None
                self._motion.scripted = before
        return self

    def _steps(
        self, policy: Policy, estimate: Estimate | None, progress: Callable[[float], None]
    ) -> None:
        env, end = self._env, steps(self._plan.seconds, self.dt)
        self._set_commands(0)
        obs, _ = env.reset(seed=self._plan.seed)
        self._state = self._read()
        while (now := self.sample) < end:
            progress(now / end)
            rises = self._motion.jump & (self.on == NEVER)
            self.on = torch.where(rises, now, self.on)
            groups = TensorDict(obs, batch_size=[env.num_envs])
            if estimate is not None and self._walking[0] <= now < self._walking[1]:
                self._compare(estimate(groups), groups["estimator_target"])
            actions = policy(groups)
            # Read at the end of the step, by the next observation. Its length varies (D1).
            self._set_commands(now + env.cfg.decimation)
            obs, _, fallen, _, _ = env.step(actions)
            falls = self._alive & fallen
            self.fell_at = torch.where(falls, self.sample, self.fell_at)
            self.non_finite |= falls & env.termination_manager.get_term("non_finite")
            self._alive &= ~fallen
        progress(1.0)

    def _set_commands(self, sample: int) -> None:
        """Set the commands that hold at a sample."""
        when = self._times
        moving = (when["start"] <= sample) & (sample < when["stop"])
        self._motion.velocity.copy_(torch.where(moving[:, None], self._command, 0.0))
        self._motion.jump.copy_((when["on"] <= sample) & (sample < when["off"]))

    def _compare(self, estimate: tuple[Tensor, Tensor], target: Tensor) -> None:
        """Add the estimator's errors on walking robots that stand.

        `target` has the true contacts (0 or 1) and velocity [m/s]. (N, 7)
        """
        contact, velocity = torch.split(target, list(ESTIMATE.values()), dim=-1)
        squares = (estimate[1] - velocity).square()
        right = ((estimate[0] > 0.5) == (contact > 0.5)).float().mean(dim=-1, keepdim=True)
        new = torch.cat([squares, right, torch.ones_like(right)], dim=-1)[: self._plan.walkers]
        counts = self._alive[: self._plan.walkers] & torch.isfinite(new).all(dim=-1)
        self.estimates += torch.where(counts[:, None], new, 0.0).double().sum(dim=0)

    def _record(self) -> None:
        """Record a physics step: the contacts now known belong to the state before it."""
        feet, limbs = (self._env.scene[name].data.found > 0 for name in ("feet", "limbs"))
        for recording in self.recordings:
            recording.add(self.sample, self._state, feet, limbs.any(dim=-1))
        self.sample += 1
        self._state = self._read()

    def _read(self) -> Tensor:
        """The trunk's state, as of `Recording.state`. (N, 13)."""
        data = self._env.sim.data
        return torch.cat([data.qpos[:, :7], data.qvel[:, :6]], dim=-1)


# ---- the policy under evaluation ----


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A policy under evaluation."""

    act: Policy
    estimate: Estimate | None
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
    """Read `policy.onnx`, a checkpoint, or the last checkpoint of the folder of a run.

    Raises:
        ArtefactError: Missing, damaged, or none of these.
    """
    if path.suffix == ".onnx":
        return _exported(path, device)
    found = RunFolder(path).checkpoint() if path.is_dir() else path
    state = checkpoint.widen_checkpoint(checkpoint.read(found))
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
