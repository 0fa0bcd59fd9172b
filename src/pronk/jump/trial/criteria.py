"""The acceptance criteria of a policy, on the virtual robot and in the training simulator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from pronk.jump.trial.jumps import RISE
from pronk.jump.trial.protocol import TABLE_III
from pronk.jump.trial.results import Results
from pronk.jump.trial.training_sim.evaluation import Evaluation

Sense = Literal["<=", ">="]

GAPS = {"forward 2": 0.60, "back 2": 0.55, "side -1": 0.40, "side +1": 0.40}
"""[m]; the paper's are 0.55, 0.50, 0.40 (R3)."""
HEIGHT = 0.45
"""Of the best command [m]: the paper's physical limit (R5)."""
SUCCESS = 0.95
"""Share of jumps that land well."""
JUMPS = 20
"""With each command: what the criteria are meant for."""
WALKS = ("forward 2", "back 2", "left 1", "right 1")
"""Those at 3 m/s are only reported."""
DISTANCE = {"forward 1": 0.7, "forward 2": 1.1, "side -1": 0.65, "side +1": 0.65, "back 2": 1.1}
"""[m]"""
LIFT_OFF_VELOCITY = 2.5
"""Desired [m/s]."""
COST = 1.10
"""Largest growth of the speed error by the jump phases."""


@dataclass(frozen=True)
class Check:
    """A number beside its limit."""

    what: str
    value: float
    sense: Sense
    limit: float
    unit: str = ""

    @property
    def passed(self) -> bool:
        """Whether the number keeps the limit; NaN does not."""
        return self.value <= self.limit if self.sense == "<=" else self.value >= self.limit

    def row(self) -> dict[str, Any]:
        """Return the check as JSON has it."""
        return {**asdict(self), "passed": self.passed}


def trial_checks(trial: Results) -> list[Check]:
    """Check the first policy of a trial: the paper's matched column, and more."""
    first, found, paper = trial.subjects[0].name, [], TABLE_III["height", "matched"]
    cells = [cell for cell in trial.cells if cell.policy == first]
    for cell in cells:
        name = cell.case
        for figure in ("height", "distance") if name in paper else ():
            own, (mean, std) = cell.figures[figure], TABLE_III[figure, "matched"][name]
            found.append(Check(f"{name}: {figure}", own.mean, ">=", mean, "m"))
            found.append(Check(f"{name}: {figure}, std", own.std, "<=", std, "m"))
        if name in GAPS:
            found.append(Check(f"{name}: gap", cell.figures["gap"].mean, ">=", GAPS[name], "m"))
        found.append(Check(f"{name}: success", cell.success, ">=", SUCCESS))
    if any(cell.case in paper for cell in cells):
        best = max((c.figures["height"].mean for c in cells if c.found), default=math.nan)
        found.append(Check("best: height", best, ">=", HEIGHT, "m"))
    return found


def cost_of_jumping(before: Mapping[str, float], after: Mapping[str, float]) -> float:
    """Mean speed error of `WALKS` after the jump phases over that before; NaN if one is missing.

    `before` and `after` are mean speed errors by walk [m/s], of the policy that only walks and of
    the one that jumps.
    """
    sums = [math.fsum(errors.get(name, math.nan) for name in WALKS) for errors in (before, after)]
    return sums[1] / sums[0] if sums[0] else math.nan


def evaluation_checks(evaluation: Evaluation) -> list[Check]:
    """Check every criterion that belongs to the commands of an evaluation."""
    rows: list[tuple[Any, ...]] = []
    for walk in evaluation.walks:
        name, still = walk.name, walk["speed_error_averaged"].mean
        if name in WALKS:
            rows.append((f"{name}: speed error", walk["speed_error"].mean, "<=", 0.15, "m/s"))
            rows.append((f"{name}: falls", walk["fell"].mean, "<=", 0.005))
        elif name in ("yaw 2", "yaw -2"):
            rows.append((f"{name}: yaw rate error", walk["yaw_error"].mean, "<=", 0.2, "rad/s"))
        elif name == "stand":
            rows.append((f"{name}: speed", still, "<=", 0.05, "m/s"))
    for jump in evaluation.jumps:
        off = abs(jump["lift_off_velocity"].mean - LIFT_OFF_VELOCITY)
        own = [
            ("height", jump["height"].mean, ">=", HEIGHT, "m"),
            ("std of height", jump["height"].std, "<=", 0.03, "m"),
            ("distance", jump["distance"].mean, ">=", DISTANCE.get(jump.name), "m"),
            ("upright", jump["upright"].mean, ">=", 0.99),
            # Flights of the gait before and after do not count.
            ("one high flight", jump["single"].mean, ">=", 0.95),
            (f"lift-off velocity off {LIFT_OFF_VELOCITY:g}", off, "<=", 0.3, "m/s"),
            ("lift-off after, 95th percentile", jump["delay"].p95, "<=", 0.3, "s"),
        ]
        rows += [(f"jump {jump.name}: {row[0]}", *row[1:]) for row in own if row[3] is not None]
    for when, results in (("walking", evaluation.walks), ("around jumps", evaluation.jumps)):
        if results:
            # No flight has height 0.
            highest = (result["uncommanded"].most for result in results)
            value = max((one for one in highest if not math.isnan(one)), default=0.0)
            rows.append((f"flight without a jump input, {when}", value, "<=", RISE, "m"))
    if estimator := evaluation.estimator:
        rows.append(("velocity RMSE", estimator["velocity"], "<=", 0.15, "m/s"))
        rows.append(("contacts right", estimator["contacts_right"], ">=", 0.95))
    if evaluation.before:
        cost = cost_of_jumping(evaluation.before, evaluation.speed_errors())
        rows.append(("speed error over that before jumping", cost, "<=", COST))
    return [Check(*row) for row in rows]
