"""Evaluate a policy in the training simulator: every command at once, many robots each.

    plan = Plan(robots=1000)
    env = ManagerBasedRlEnv(evaluation_cfg(env_cfg(gains=gains), plan), device="cuda:0")
    evaluation = evaluate_policy(policy, env, plan, estimate=actor.estimate)
    write(Path("evaluation.json"), evaluation)

What is asked is in `evaluation.plan`, what is measured in `pronk.evaluation.jumps` and
`evaluation.walk`, what
is good enough in `evaluation.bars`, how it runs in `evaluation.run`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.evaluation.jumps import steps
from pronk.evaluation.training_sim import result
from pronk.evaluation.training_sim.bars import UNASKED_HEIGHT, checks
from pronk.evaluation.training_sim.plan import Plan
from pronk.evaluation.training_sim.result import (
    EstimatorResult,
    Evaluation,
    JumpResult,
    Spread,
    Unasked,
    WalkResult,
)
from pronk.evaluation.training_sim.run import Estimate, Policy, Run, evaluation_cfg
from pronk.evaluation.training_sim.walk import FIGURES

__all__ = ["evaluate_policy", "evaluation_cfg", "write"]

Figures = Mapping[str, NDArray[Any]]

_SPREADS = (
    "height",
    "distance",
    "along",
    "vertical",
    "horizontal",
    "delay",
    "duration",
    "flights",
    "long_flights",
    "high_flights",
)
"""Figures of a jump that are given as they are."""


def evaluate_policy(
    policy: Policy,
    env: Any,
    plan: Plan,
    *,
    waits: bool = True,
    estimate: Estimate | None = None,
    progress: Callable[[float], None] | None = None,
    about: Mapping[str, Any] | None = None,
    before: Mapping[str, float] | None = None,
) -> Evaluation:
    """Run the whole plan in one batch.

    Args:
        policy: What acts.
        env: Built with `evaluation_cfg` for the same plan, wrapped or not. It is reset, and the
            random generators of the process are seeded with the plan's seed.
        plan: What is asked.
        waits: Whether the jump input waits for the stride (`pronk.policy.stride`).
        estimate: The policy's estimator, to be judged as well.
        progress: Called with the share done, 0 to 1.
        about: Kept with the result: where policy and gains come from.
        before: Speed errors of the policy before the jump phases, `Evaluation.speed_errors`.

    Raises:
        PronkError: The environment was not built for this plan.
    """
    began = time.perf_counter()
    run = Run(env.unwrapped, plan, waits=waits).go(policy, estimate, progress or _silent)
    fell_at, on = run.fell_at.cpu().numpy(), run.flights.on.cpu().numpy()
    figures = {
        **run.flights.figures(plan.commands()[:, :2]),
        **run.speeds.figures(),
        "fell": fell_at <= steps(plan.walk_s, run.dt),
        "told": on < fell_at,
        "waited": (on - plan.times(run.dt)["on"]) * run.dt,
        "non_finite": run.non_finite.cpu().numpy(),
    }
    cases = [
        {name: values[first : first + plan.robots] for name, values in figures.items()}
        for first in range(0, plan.size, plan.robots)
    ]
    seen = {name: values[: plan.walkers] for name, values in run.estimates.sums().items()}
    names = (*plan.walks, *plan.jumps)
    results = [
        (_walk if i < len(plan.walks) else _jump)(case.name, case.command, part, plan)
        for i, (case, part) in enumerate(zip(names, cases, strict=True))
    ]
    return Evaluation(
        walks=tuple(r for r in results if isinstance(r, WalkResult)),
        jumps=tuple(r for r in results if isinstance(r, JumpResult)),
        estimator=_estimator(seen) if seen["count"].any() else None,
        plan=asdict(plan),
        seconds=time.perf_counter() - began,
        about=dict(about or {}),
        before=dict(before or {}),
    )


def write(path: Path, evaluation: Evaluation) -> None:
    """Write an evaluation and how it stands to the bars as JSON, whole or not at all."""
    result.save(path, evaluation, [check.row() for check in checks(evaluation)])


def _silent(share: float) -> None:
    """Nobody watches."""


def _walk(
    name: str, command: tuple[float, float, float], figures: Figures, plan: Plan
) -> WalkResult:
    forward, left, yaw = (Spread.of(axis).mean for axis in figures["velocity"].T)
    return WalkResult(
        name=name,
        command=command,
        robots=plan.robots,
        falls=float(figures["fell"].mean()),
        non_finite=float((figures["fell"] & figures["non_finite"]).mean()),
        velocity=(forward, left, yaw),
        drift=Spread.of(figures["drift"]),
        unasked=_unasked(figures["unasked"], plan),
        **{error: Spread.of(figures[error]) for error in FIGURES},
    )


def _jump(
    name: str, command: tuple[float, float, float], figures: Figures, plan: Plan
) -> JumpResult:
    told, found = figures["told"], figures["high_flights"] > 0
    single = figures["high_flights"][told] == 1
    kept = {key: np.where(told, figures[key], math.nan) for key in _SPREADS}
    return JumpResult(
        name=name,
        command=command,
        robots=plan.robots,
        told=int(told.sum()),
        found=float(found.mean()),
        upright=float((found & (figures["upright"] > 0.0)).mean()),
        non_finite=float(figures["non_finite"].mean()),
        single=float(single.mean()) if told.any() else 0.0,
        apex=Spread.of(figures["apex"] - plan.rules.standing_height),
        unasked=_unasked(figures["unasked"], plan),
        touched=float((figures["touched"] > 0.0).mean()),
        waited=float(figures["waited"][told].max()) if told.any() else math.nan,
        **{key: Spread.of(values) for key, values in kept.items()},
    )


def _unasked(highest: NDArray[Any], plan: Plan) -> Unasked:
    over = highest[np.isfinite(highest)] - plan.rules.standing_height
    return Unasked(
        share=len(over) / len(highest),
        highest=float(over.max()) if len(over) else math.nan,
        too_high=float((over > UNASKED_HEIGHT).sum() / len(highest)),
    )


def _estimator(sums: Figures) -> EstimatorResult:
    count = sums["count"].sum()
    squares = sums["squares"].sum(axis=0) / count
    forward, left, up = (math.sqrt(axis) for axis in squares)
    return EstimatorResult(
        rmse=(forward, left, up),
        rmse_vector=math.sqrt(squares.sum()),
        contacts_right=float(sums["right"].sum() / count),
    )
