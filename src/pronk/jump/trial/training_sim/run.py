"""Evaluate a policy in the training simulator: every command at once, many robots each.

    plan = EvaluationPlan(robot=robot, robots=1000)
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
from dataclasses import asdict, replace
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
from pronk.jump.trial.training_sim.evaluation import (
    NEVER,
    CommandResult,
    Evaluation,
    EvaluationPlan,
)
from pronk.jump.trial.walk import measure_walk, walk_script
from pronk.jump.virtual.capture import Capture
from pronk.policy.observation import ESTIMATE, JOINTS

Act = Callable[[TensorDict], Tensor]
"""Observation groups to actions (N, 12)."""
Estimate = Callable[[TensorDict], tuple[Tensor, Tensor]]
"""Observation groups to contact probabilities (N, 4) and trunk velocity [m/s] (N, 3)."""

TERM = "evaluation"
"""The metrics term's name."""


class StepListener:
    """A metrics term that calls a listener after every physics step."""

    def __init__(self, cfg: MetricsTermCfg, env: ManagerBasedRlEnv) -> None:
        """Begin without a listener."""
        self.listener: Callable[[], None] | None = None
        self._zero = torch.zeros(env.num_envs, device=env.device)

    def __call__(self, env: ManagerBasedRlEnv) -> Tensor:
        """Call the listener; the metric itself is zero. (N,)."""
        if self.listener is not None:
            self.listener()
        return self._zero


class EvaluationRun:
    """A plan under way in an environment."""

    def __init__(self, env: ManagerBasedRlEnv, plan: EvaluationPlan) -> None:
        """Prepare, with memory of `RECORDED_BYTES` a robot and sample.

        Args:
            env: The environment, built with `evaluation_cfg` for the plan.
            plan: The plan.

        Raises:
            PronkError: Another environment.
        """
        terms = getattr(env.metrics_manager, "cfg", None) or {}
        if TERM not in terms or env.num_envs != plan.size:
            term_text = "an" if TERM in terms else "no"
            raise PronkError(
                f"the environment has {env.num_envs} robots and {term_text} evaluation term; this "
                f"plan needs one built with evaluation_cfg for {plan.size} robots."
            )
        self._listener: StepListener = terms[TERM].func
        self._env = env
        self._plan = plan
        self._motion = motion_command(env)
        self.dt = env.physics_dt
        """Time between samples, a physics step [s]."""
        device = env.device
        self._command = torch.tensor(plan.commands(), dtype=torch.float32, device=device)
        self._times = {}
        for name, samples in plan.times(self.dt).items():
            self._times[name] = torch.tensor(samples, device=device)
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
        """Whether a robot is out because its physics diverged. (N,)"""
        # Of the walking robots' estimator: sums of squared velocity errors by axis [m^2/s^2], of
        # the share of right contacts, and the count of policy steps.
        self._estimates = torch.zeros(5, dtype=torch.float64, device=device)
        self._state = self._read()

    @torch.no_grad()  # inference mode would leave the environment with read-only tensors
    def go(self, act: Act, estimate: Estimate | None, progress: Callable[[float], None]) -> None:
        """Simulate the whole plan; arguments are those of `evaluate_policy`."""
        env = self._env
        plan = self._plan
        end = len(self._states)
        settled = round(plan.settle_s / self.dt)
        walk_end = round(plan.walk_s / self.dt)
        self._motion.scripted = True
        self._listener.listener = self._record
        self._set_commands(0)
        obs, _ = env.reset(seed=plan.seed)
        self._state = self._read()
        while self.sample < end:
            sample = self.sample
            progress(sample / end)
            rises = self._motion.jump & (self.on == NEVER)
            self.on = torch.where(rises, sample, self.on)
            groups = TensorDict(obs, batch_size=[env.num_envs])
            if estimate is not None and settled <= sample < walk_end:
                contact, velocity = estimate(groups)
                self._compare(contact, velocity, groups["estimator_target"])
            actions = act(groups)
            # Read at the end of the step, by the next observation. Its length varies (D1).
            self._set_commands(sample + env.cfg.decimation)
            obs, _, fallen, _, _ = env.step(actions)
            falls = self._alive & fallen
            self.fell_at = torch.where(falls, self.sample, self.fell_at)
            self.diverged |= falls & env.termination_manager.get_term("non_finite")
            self._alive &= ~fallen
            self._state[fallen] = math.nan
        progress(1.0)

    def _set_commands(self, sample: int) -> None:
        """Set the commands that hold at a sample."""
        times = self._times
        moving = (times["start"] <= sample) & (sample < times["stop"])
        self._motion.velocity.copy_(torch.where(moving[:, None], self._command, 0.0))
        self._motion.jump.copy_((times["on"] <= sample) & (sample < times["off"]))

    def _compare(self, contact: Tensor, velocity: Tensor, target: Tensor) -> None:
        """Add the estimator's errors on walking robots that stand.

        Args:
            contact: Estimated contact probabilities, (N, 4).
            velocity: Estimated velocity [m/s], (N, 3).
            target: True contacts (0 or 1) and velocity [m/s], (N, 7).
        """
        walkers = self._plan.walkers
        true_contact, true_velocity = torch.split(target, list(ESTIMATE.values()), dim=-1)
        squares = (velocity - true_velocity).square()
        right = ((contact > 0.5) == (true_contact > 0.5)).float().mean(dim=-1, keepdim=True)
        errors = torch.cat([squares, right, torch.ones_like(right)], dim=-1)[:walkers]
        counts = self._alive[:walkers] & torch.isfinite(errors).all(dim=-1)
        self._estimates += torch.where(counts[:, None], errors, 0.0).double().sum(dim=0)

    def _record(self) -> None:
        """Record a physics step: the contacts now known belong to the state before it."""
        if self.sample < len(self._states):
            scene = self._env.scene
            limb_contacts = scene["limbs"].data.found > 0
            self._states[self.sample] = self._state
            self._feet[self.sample] = scene["feet"].data.found > 0
            # A robot that has fallen lies on the ground.
            self._other[self.sample] = limb_contacts.any(dim=-1) | ~self._alive
        self.sample += 1
        self._state = self._read()

    def _read(self) -> Tensor:
        """Return the trunks' state. (N, 13)."""
        data = self._env.sim.data
        state = torch.cat([data.qpos[:, :7], data.qvel[:, :6]], dim=-1)
        return torch.where(self._alive[:, None], state, math.nan)

    def captures(self, index: int) -> Iterator[Capture]:
        """Yield the motion of the robots of one command, numbered through walks and jumps.

        What was not recorded, feet, joints and power, is NaN; which parts touch is not known.
        """
        plan = self._plan
        robots = slice(index * plan.robots, (index + 1) * plan.robots)
        seconds = plan.walk_s if index < len(plan.walks) else plan.jump_seconds
        count = round(seconds / self.dt)
        states = self._states[:count, robots].cpu().numpy()
        feet = self._feet[:count, robots].cpu().numpy()
        other = self._other[:count, robots].cpu().numpy()
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
                other_parts=np.full(count, ""),
                joint_position=joints,
                joint_velocity=joints,
                torque=joints,
                electrical_power=joints[:, 0],
                bus_voltage=joints[:, 0],
            )

    def estimator_errors(self) -> dict[str, float]:
        """Return the estimator's errors, as of `Evaluation`; empty if it was not evaluated."""
        forward, left, up, right, count = self._estimates.tolist()
        if not count:
            return {}
        return {
            "forward": math.sqrt(forward / count),
            "left": math.sqrt(left / count),
            "up": math.sqrt(up / count),
            "velocity": math.sqrt((forward + left + up) / count),
            "contacts_right": right / count,
        }


def evaluate_policy(
    act: Act,
    env: Any,
    plan: EvaluationPlan,
    *,
    estimate: Estimate | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Evaluation:
    """Run the whole plan in one batch and measure every robot.

    The random generators of the process are seeded with the plan's seed.

    Args:
        act: The policy.
        env: The environment, built with `evaluation_cfg` for the same plan, wrapped or not; it is
            of no other use afterwards.
        plan: The plan.
        estimate: The policy's estimator, if it is evaluated too.
        progress: Called with the fraction of the simulation that is over.

    Returns:
        The evaluation.

    Raises:
        PronkError: An environment that was not built for the plan.
    """
    begin = time.perf_counter()
    run = EvaluationRun(env.unwrapped, plan)
    run.go(act, estimate, progress)
    fell_at = run.fell_at.cpu().numpy()
    on = run.on.cpu().numpy()
    diverged = run.diverged.cpu().numpy()
    results = []
    for i, case in enumerate((*plan.walks, *plan.jumps)):
        robot_figures = []
        for k, capture in enumerate(run.captures(i)):
            robot = i * plan.robots + k
            if i < len(plan.walks):
                figures = _walk(capture, case, plan)
            else:
                figures = _jump(capture, case, plan, on=float(on[robot]) * run.dt)
            figures["fell"] = fell_at[robot] < NEVER
            figures["non_finite"] = diverged[robot]
            robot_figures.append(figures)
        spreads = {}
        for name in robot_figures[0]:
            spreads[name] = Spread.of([figures[name] for figures in robot_figures])
        results.append(CommandResult(name=case.name, command=case.command, figures=spreads))
    return Evaluation(
        walks=tuple(results[: len(plan.walks)]),
        jumps=tuple(results[len(plan.walks) :]),
        estimator=run.estimator_errors(),
        plan={
            "robot": plan.robot.name,
            "robots": plan.robots,
            "seed": plan.seed,
            "walks": plan.walks,
            "jumps": plan.jumps,
            "walk_s": plan.walk_s,
            "settle_s": plan.settle_s,
            "script": plan.script,
            "spread_s": plan.spread_s,
            "rules": plan.jump_rules,
        },
        seconds=time.perf_counter() - begin,
    )


def _walk(capture: Capture, case: Case, plan: EvaluationPlan) -> dict[str, Any]:
    """Return the figures of a robot that walks."""
    script = replace(walk_script(case.command, seconds=plan.walk_s), stand_s=0.0)
    walk = measure_walk(
        capture,
        script,
        plan.robot,
        began=0.0,
        rules=plan.jump_rules,
        settle_s=plan.settle_s,
    )
    figures: dict[str, Any] = asdict(walk)
    figures["uncommanded"] = walk.uncommanded - plan.jump_rules.standing_height
    settled = round(plan.settle_s / capture.dt)
    end = fallen_at(capture) - 1
    figures["drift"] = math.nan
    if settled <= end:
        x, y, _ = capture.position[end] - capture.position[settled]
        figures["drift"] = math.hypot(x, y)
    return figures


def _jump(capture: Capture, case: Case, plan: EvaluationPlan, *, on: float) -> dict[str, Any]:
    """Return the figures of a robot that jumps; its jump input rises at `on` [s]."""
    rules = plan.jump_rules
    script = replace(plan.script, command=case.command, run_s=on - plan.script.start)
    jump = measure_jump(capture, script, plan.robot, began=0.0, rules=rules)
    figures: dict[str, Any] = {}
    for name in flags_of(JumpFigures):
        flag = getattr(jump, name)
        if isinstance(flag, bool):  # A text has no mean.
            figures[name] = flag
    for name, figure in FIGURES.items():
        if not figure.joints:
            figures[name] = figure.value(jump)
    rise = sample_at(capture, on) if jump.standing else None
    uncommanded = uncommanded_height(capture, rise, rules)
    figures["uncommanded"] = uncommanded - rules.standing_height
    figures["single"] = float(jump.high_flights == 1.0) if jump.standing else math.nan
    return figures
