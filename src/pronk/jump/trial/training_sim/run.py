"""Evaluate a policy in the training simulator: every command at once, many robots each.

    plan = Plan(robot=robot, robots=1000)
    env = ManagerBasedRlEnv(evaluation_cfg(env_cfg(gains=gains), plan), device="cuda:0")
    evaluation = evaluate_policy(policy, env, plan, estimate=actor.estimate)

Trunk and contacts are recorded at every physics step, on the device, by a metrics term of mjlab.
mjlab's contacts lag its positions by one physics step there, so each position is kept until its
contacts are known.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers.metrics_manager import MetricsTermCfg
from tensordict import TensorDict
from torch import Tensor

from pronk.errors import PronkError
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.trial.jumps import (
    FIGURES,
    JumpFigures,
    fallen_at,
    flags_of,
    measure_jump,
    sample_at,
    uncommanded_height,
)
from pronk.jump.trial.protocol import Case
from pronk.jump.trial.results import Spread
from pronk.jump.trial.training_sim.evaluation import NEVER, CommandResult, Evaluation, Plan
from pronk.jump.trial.walk import measure_walk, walk_script
from pronk.jump.virtual.capture import Capture
from pronk.policy.observation import ESTIMATE, JOINTS

Policy = Callable[[TensorDict], Tensor]
"""Observation groups to actions (N, 12)."""
Estimate = Callable[[TensorDict], tuple[Tensor, Tensor]]
"""Observation groups to contact probabilities (N, 4) and trunk velocity [m/s] (N, 3)."""


TERM = "evaluation"
"""The metrics term's name."""


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


class Run:
    """A plan under way in an environment."""

    def __init__(self, env: ManagerBasedRlEnv, plan: Plan) -> None:
        """Prepare, with memory of 58 bytes a robot and sample."""
        terms = getattr(env.metrics_manager, "cfg", None) or {}
        if TERM not in terms or env.num_envs != plan.size:
            raise PronkError(
                f"the environment has {env.num_envs} robots and "
                f"{'an' if TERM in terms else 'no'} evaluation term; this plan needs one built "
                f"with evaluation_cfg for {plan.size} robots."
            )
        self._listener: StepListener = terms[TERM].func
        self._env, self._plan, self._motion = env, plan, motion_command(env)
        self.dt, device = env.physics_dt, env.device
        self._command = torch.tensor(plan.commands(), dtype=torch.float32, device=device)
        self._times = {k: torch.tensor(v, device=device) for k, v in plan.times(self.dt).items()}
        shape = (round(plan.seconds / self.dt), plan.size)
        # Position [m], quaternion w x y z and velocity [m/s] in the world's frame, angular velocity
        # in the trunk's [rad/s]; NaN once it has fallen, since mjlab resets it.
        self._states = torch.zeros(*shape, 13, device=device)
        self._feet = torch.zeros(*shape, 4, dtype=torch.bool, device=device)
        self._other = torch.zeros(*shape, dtype=torch.bool, device=device)
        self.sample = 0
        """Number of the sample that comes next."""
        self._alive = torch.ones(plan.size, dtype=torch.bool, device=device)
        self.fell_at = torch.full((plan.size,), NEVER, dtype=torch.int64, device=device)
        """Sample at which a robot was found fallen; `NEVER` for one that stands at the end. (N,)"""
        self.on = torch.full_like(self.fell_at, NEVER)
        """Sample at which the policy first read the jump input; `NEVER` without one. (N,)"""
        self.diverged = torch.zeros_like(self._alive)
        """Fallen because its physics diverged. (N,)"""
        self._estimates = torch.zeros(5, dtype=torch.float64, device=device)
        """Of the walking robots' estimator: sums of squared velocity errors by axis [m^2/s^2], of
        the share of right contacts, and the count of policy steps."""
        self._state = self._read()

    @torch.no_grad()  # inference mode would leave the environment with read-only tensors
    def go(
        self, policy: Policy, estimate: Estimate | None, progress: Callable[[float], None]
    ) -> None:
        """Simulate the whole plan; arguments are those of `evaluate_policy`."""
        env, plan, end = self._env, self._plan, len(self._states)
        self._motion.scripted, self._listener.listener = True, self._record
        first, last = (round(t / self.dt) for t in (plan.settle_s, plan.walk_s))
        self._set_commands(0)
        obs, _ = env.reset(seed=plan.seed)
        self._state = self._read()
        while (now := self.sample) < end:
            progress(now / end)
            rises = self._motion.jump & (self.on == NEVER)
            self.on = torch.where(rises, now, self.on)
            groups = TensorDict(obs, batch_size=[env.num_envs])
            if estimate is not None and first <= now < last:
                self._compare(estimate(groups), groups["estimator_target"])
            actions = policy(groups)
            # Read at the end of the step, by the next observation. Its length varies (D1).
            self._set_commands(now + env.cfg.decimation)
            obs, _, fallen, _, _ = env.step(actions)
            falls = self._alive & fallen
            self.fell_at = torch.where(falls, self.sample, self.fell_at)
            self.diverged |= falls & env.termination_manager.get_term("non_finite")
            self._alive &= ~fallen
            self._state[fallen] = math.nan
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
        self._estimates += torch.where(counts[:, None], new, 0.0).double().sum(dim=0)

    def _record(self) -> None:
        """Record a physics step: the contacts now known belong to the state before it."""
        if self.sample < len(self._states):
            feet, limbs = (self._env.scene[name].data.found > 0 for name in ("feet", "limbs"))
            self._states[self.sample], self._feet[self.sample] = self._state, feet
            # A robot that has fallen lies on the ground.
            self._other[self.sample] = limbs.any(dim=-1) | ~self._alive
        self.sample += 1
        self._state = self._read()

    def _read(self) -> Tensor:
        """The trunks' state. (N, 13)."""
        data = self._env.sim.data
        state = torch.cat([data.qpos[:, :7], data.qvel[:, :6]], dim=-1)
        return torch.where(self._alive[:, None], state, math.nan)

    def captures(self, index: int) -> Iterator[Capture]:
        """Yield the motion of the robots of one command, numbered through walks and jumps.

        What was not recorded, feet, joints and power, is NaN.
        """
        plan = self._plan
        own = slice(index * plan.robots, (index + 1) * plan.robots)
        seconds = plan.walk_s if index < len(plan.walks) else plan.jump_seconds
        count = round(seconds / self.dt)
        parts = (self._states, self._feet, self._other)
        states, feet, other = (part[:count, own].cpu().numpy() for part in parts)
        joints = np.broadcast_to(np.nan, (count, JOINTS))
        for i in range(plan.robots):
            state = states[:, i].astype(float)
            yield Capture(
                time=self.dt * np.arange(count),
                position=state[:, :3],
                orientation=state[:, 3:7],
                velocity=state[:, 7:10],
                angular_velocity=state[:, 10:],
                foot_position=np.broadcast_to(np.nan, (count, 4, 3)),
                contact=feet[:, i],
                other_contact=other[:, i],
                joint_position=joints,
                joint_velocity=joints,
                torque=joints,
                electrical_power=joints[:, 0],
                bus_voltage=joints[:, 0],
            )

    def estimator_errors(self) -> dict[str, float]:
        """Return the estimator's errors, as of `Evaluation`; empty if it was not evaluated."""
        *squares, right, count = self._estimates.tolist()
        if not count:
            return {}
        names = ("forward", "left", "up", "velocity")
        sums = zip(names, (*squares, sum(squares)), strict=True)
        errors = {name: math.sqrt(total / count) for name, total in sums}
        return errors | {"contacts_right": right / count}


def evaluate_policy(
    policy: Policy,
    env: Any,
    plan: Plan,
    *,
    estimate: Estimate | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Evaluation:
    """Run the whole plan in one batch and measure every robot.

    `env` was built with `evaluation_cfg` for the same plan, wrapped or not; it is of no other use
    afterwards. The random generators of the process are seeded with the plan's seed. `estimate` is
    the policy's estimator, if it is evaluated too.
    """
    began = time.perf_counter()
    run = Run(env.unwrapped, plan)
    run.go(policy, estimate, progress)
    facts = [part.cpu().numpy() for part in (run.fell_at, run.on, run.diverged)]
    results = []
    for i, case in enumerate((*plan.walks, *plan.jumps)):
        own = (part[i * plan.robots : (i + 1) * plan.robots] for part in facts)
        robots = []
        for capture, fell, on, diverged in zip(run.captures(i), *own, strict=True):
            if i < len(plan.walks):
                figures = _walk(capture, case, plan)
            else:
                figures = _jump(capture, case, plan, on=float(on) * run.dt)
            robots.append(figures | {"fell": fell < NEVER, "non_finite": diverged})
        spreads = {name: Spread.of([each[name] for each in robots]) for name in robots[0]}
        results.append(CommandResult(name=case.name, command=case.command, figures=spreads))
    return Evaluation(
        walks=tuple(results[: len(plan.walks)]),
        jumps=tuple(results[len(plan.walks) :]),
        estimator=run.estimator_errors(),
        plan=vars(plan) | {"robot": plan.robot.name, "rules": plan.jump_rules},
        seconds=time.perf_counter() - began,
    )


def _walk(capture: Capture, case: Case, plan: Plan) -> dict[str, float]:
    """The figures of a robot that walks."""
    script = replace(walk_script(case.command, seconds=plan.walk_s), stand_s=0.0)
    how: Any = {"began": 0.0, "rules": plan.jump_rules, "settle_s": plan.settle_s}
    found = measure_walk(capture, script, plan.robot, **how)
    first, last = round(plan.settle_s / capture.dt), fallen_at(capture) - 1
    x, y, _ = capture.position[last] - capture.position[min(first, last)]
    return vars(found) | {
        "uncommanded": found.uncommanded - plan.jump_rules.standing_height,
        "drift": math.hypot(x, y) if first <= last else math.nan,
    }


def _jump(capture: Capture, case: Case, plan: Plan, *, on: float) -> dict[str, float]:
    """The figures of a robot that jumps; its jump input rises at `on` [s]."""
    rules, run_s = plan.jump_rules, on - plan.script.start
    script = replace(plan.script, command=case.command, run_s=run_s)
    found = measure_jump(capture, script, plan.robot, began=0.0, rules=rules)
    rise = sample_at(capture, on) if found.standing else None
    figures = {name: getattr(found, name) for name in flags_of(JumpFigures)}
    for name, figure in FIGURES.items():
        if not figure.joints:
            figures[name] = figure.value(found)
    return figures | {
        "uncommanded": uncommanded_height(capture, rise, rules) - rules.standing_height,
        "single": float(found.high_flights == 1.0) if found.standing else math.nan,
    }
