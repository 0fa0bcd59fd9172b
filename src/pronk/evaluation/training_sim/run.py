"""One pass through an evaluation plan: the environment, the commands, and the recording.

Trunk and contacts are recorded at every physics step, on the device, by a metrics term of mjlab.
mjlab's contacts lag its positions by one physics step there, so each position is kept until its
contacts are known.
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
from pronk.evaluation.training_sim.plan import NEVER, Plan
from pronk.policy.layout import ESTIMATE
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


def evaluation_cfg(cfg: ManagerBasedRlEnvCfg, plan: Plan) -> ManagerBasedRlEnvCfg:
    """Make an environment of training one to evaluate in; changes `cfg` and returns it.

    As many robots as the plan has, no time-out, no rewards, and the step listener.

    Args:
        cfg: From `pronk.train.tasks.env_cfg`.
        plan: Of the evaluation.
    """
    cfg.scene.num_envs = plan.size
    cfg.rewards = {}
    cfg.curriculum = {}
    cfg.terminations = {name: t for name, t in cfg.terminations.items() if not t.time_out}
    cfg.metrics = {TERM: MetricsTermCfg(func=StepListener, per_substep=True)}
    return cfg


class Recording:
    """Trunk and contacts of the robots of one command, at every physics step."""

    def __init__(self, robots: slice, samples: int, device: torch.device | str) -> None:
        """Reserve memory: 58 bytes a robot and sample.

        Args:
            robots: Which of the environment's.
            samples: Length.
            device: Of the simulation.
        """
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

        Args:
            env: Built with `evaluation_cfg`.
            plan: Of the evaluation.

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
        """Simulate the whole plan.

        Args:
            policy: Under evaluation.
            estimate: Its estimator, if it is to be judged.
            progress: Called with the share done, 0 to 1.
        """
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
                self._compare(estimate(groups), groups["target"])
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

        Args:
            estimate: Contact probabilities (N, 4), velocity in the trunk's frame [m/s] (N, 3).
            target: The true ones, contacts (0 or 1) first. (N, 7)
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
