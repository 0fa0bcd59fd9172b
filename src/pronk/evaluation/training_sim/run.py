"""One pass through an evaluation plan: the environment, what it is told, and who listens.

Trunk and contacts are followed at every physics step, on the device: a metrics term of mjlab is
the ear. mjlab's contacts lag its positions by one physics step there, so each position is kept
until its contacts are known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Self

import torch
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers.metrics_manager import MetricsTermCfg
from tensordict import TensorDict
from torch import Tensor

from pronk.errors import PronkError
from pronk.evaluation.jumps import steps
from pronk.evaluation.training_sim.flight import FlightRecorder
from pronk.evaluation.training_sim.plan import NEVER, Plan
from pronk.evaluation.training_sim.walk import EstimatorRecorder, SpeedRecorder
from pronk.train.mdp.commands import motion_command
from pronk.train.mdp.randomization import Randomization

Policy = Callable[[TensorDict], Tensor]
"""Observation groups to actions (N, 12)."""
Estimate = Callable[[TensorDict], tuple[Tensor, Tensor]]
"""Observation groups to contact probabilities (N, 4) and trunk velocity [m/s] (N, 3)."""

TERM = "evaluation"
"""The metrics term's name."""

_PAPER = Randomization.paper()
RANDOMIZATIONS: Mapping[str, Randomization] = {
    "full": _PAPER,
    "noise": replace(
        _PAPER,
        friction=None,
        gains="off",
        shank_length=None,
        base_mass=(0.0, 0.0),
        bus_voltage=None,
        push_velocity=0.0,
        push_yaw_rate=0.0,
    ),
    "none": Randomization.none(),
}
"""What may differ in an evaluation. `full`: as in training, a thousand robots. `noise`: one robot a
thousand times: the nominal body and gains, undisturbed, with noise, timing (D1) and command delay
drawn as in training. It is the closest to the paper's figures, those of one robot measured several
times. `none`: the nominal robot with nothing drawn but where it starts and when it is told."""


class Ear:
    """A metrics term that calls a listener after every physics step."""

    def __init__(self, cfg: MetricsTermCfg, env: ManagerBasedRlEnv) -> None:
        self.listener: Callable[[], None] | None = None
        self._nothing = torch.zeros(env.num_envs, device=env.device)

    def __call__(self, env: ManagerBasedRlEnv) -> Tensor:
        """Let the listener hear; the metric itself is zero. (N,)."""
        if self.listener is not None:
            self.listener()
        return self._nothing


def evaluation_cfg(cfg: ManagerBasedRlEnvCfg, plan: Plan) -> ManagerBasedRlEnvCfg:
    """Make an environment of training one to evaluate in; changes `cfg` and returns it.

    As many robots as the plan has, no time-out, no rewards, and the ear.

    Args:
        cfg: From `pronk.train.tasks.env_cfg`.
        plan: What will be asked.
    """
    cfg.scene.num_envs = plan.size
    cfg.rewards = {}
    cfg.curriculum = {}
    cfg.terminations = {name: t for name, t in cfg.terminations.items() if not t.time_out}
    cfg.metrics = {TERM: MetricsTermCfg(func=Ear, per_substep=True)}
    return cfg


class Run:
    """A plan under way in an environment."""

    def __init__(self, env: ManagerBasedRlEnv, plan: Plan, *, waits: bool) -> None:
        """Prepare.

        Args:
            env: Where it happens.
            plan: What is asked.
            waits: Whether the jump input waits for the stride.

        Raises:
            PronkError: The environment was not built for this plan.
        """
        terms = getattr(env.metrics_manager, "cfg", None) or {}
        if TERM not in terms or env.num_envs != plan.size:
            raise PronkError(
                f"the environment has {env.num_envs} robots and "
                f"{'an' if TERM in terms else 'no'} evaluation term; this plan needs one built "
                f"with evaluation_cfg for {plan.size} robots."
            )
        self._ear: Ear = terms[TERM].func
        self._env, self._plan = env, plan
        self._motion = motion_command(env)
        self._waits = waits
        self.dt = dt = env.physics_dt
        device = env.device
        self._command = torch.tensor(plan.commands(), dtype=torch.float32, device=device)
        self._times = {k: torch.tensor(v, device=device) for k, v in plan.times(dt).items()}
        self._settle, self._walks_end = steps(plan.settle_s, dt), steps(plan.walk_s, dt)
        self.flights = FlightRecorder(plan.size, device=device, rules=plan.rules, dt=dt)
        self.speeds = SpeedRecorder(
            self._command,
            settle=self._settle,
            end=self._walks_end,
            average=steps(plan.average_s, dt),
        )
        self.estimates = EstimatorRecorder(plan.size, device)
        self._alive = torch.ones(plan.size, dtype=torch.bool, device=device)
        self.fell_at = torch.full((plan.size,), NEVER, dtype=torch.int64, device=device)
        """Sample at which a robot was found fallen; `NEVER` for one that stands at the end."""
        self.non_finite = torch.zeros_like(self._alive)
        """Fallen because its physics went wrong."""
        self._state = self._look()

    def go(
        self, policy: Policy, estimate: Estimate | None, progress: Callable[[float], None]
    ) -> Self:
        """Let everything happen.

        Args:
            policy: What acts.
            estimate: The policy's estimator, if it is to be judged.
            progress: Called with the share done, 0 to 1.
        """
        # Not inference mode: the environment would be left with tensors that nobody may write to.
        with torch.no_grad():
            motion = self._motion
            before = motion.scripted, motion.waits
            motion.scripted, motion.waits = True, self._waits
            self._ear.listener = self._hear
            try:
                self._steps(policy, estimate, progress)
            finally:
                self._ear.listener = None
                motion.scripted, motion.waits = before
        return self

    def _steps(
        self, policy: Policy, estimate: Estimate | None, progress: Callable[[float], None]
    ) -> None:
        env, end = self._env, steps(self._plan.seconds, self.dt)
        self._tell(0)
        obs, _ = env.reset(seed=self._plan.seed)
        self._state = self._look()
        while (now := self.flights.sample) < end:
            progress(now / end)
            self.flights.tell(self._motion.jump, now)
            groups = TensorDict(obs, batch_size=[env.num_envs])
            if estimate is not None and self._settle <= now < self._walks_end:
                self.estimates.add(estimate(groups), groups["target"], self._alive)
            actions = policy(groups)
            # Read at the end of the step, when the policy looks again. Its length varies (D1).
            self._tell(now + env.cfg.decimation)
            obs, _, fallen, _, _ = env.step(actions)
            self._count(fallen)
        progress(1.0)

    def _tell(self, sample: int) -> None:
        """Set the commands that hold at a sample."""
        when = self._times
        moving = (when["start"] <= sample) & (sample < when["stop"])
        jump = (when["on"] <= sample) & (sample < when["off"])
        self._motion.velocity.copy_(torch.where(moving[:, None], self._command, 0.0))
        (self._motion.asked if self._waits else self._motion.jump).copy_(jump)

    def _hear(self) -> None:
        """One physics step has passed; the contacts now known belong to the state before it."""
        feet, limbs = (
            (self._env.scene[name].data.found > 0).any(dim=-1) for name in ("feet", "limbs")
        )
        self.flights.add(self._state, ~feet, limbs, self._alive)
        self.speeds.add(self._state, self._alive)
        self._state = self._look()

    def _count(self, fallen: Tensor) -> None:
        """Robots that fell in the last policy step are out."""
        now = self._alive & fallen
        self.fell_at = torch.where(now, self.flights.sample, self.fell_at)
        self.non_finite |= now & self._env.termination_manager.get_term("non_finite")
        self._alive = self._alive & ~fallen

    def _look(self) -> Tensor:
        """The trunk as it is now, as `evaluation.flight.STATE` has it. (N, 13)."""
        data = self._env.sim.data
        return torch.cat([data.qpos[:, :7], data.qvel[:, :6]], dim=-1)
