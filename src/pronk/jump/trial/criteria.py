"""The acceptance criteria of a policy, on the virtual robot and in the training simulator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pronk.jump.trial.jumps import RISE
from pronk.jump.trial.protocol import TABLE_III
from pronk.jump.trial.results import TrialResults
from pronk.jump.trial.training_sim.evaluation import CommandResult, Evaluation

Sense = Literal["<=", ">="]

# The paper's gaps are 0.55, 0.50 and 0.40 m (R3).
GAPS = {"forward 2": 0.60, "back 2": 0.55, "side -1": 0.40, "side +1": 0.40}
"""Least mean gap by command [m]."""
# The paper's physical limit (R5).
HEIGHT = 0.45
"""Least mean height of the best command [m]."""
SUCCESS = 0.95
"""Least share of jumps that land [1]."""
CRITERIA_JUMPS = 20
"""Number of jumps with each command that the criteria are meant for."""
WALKS = ("forward 2", "back 2", "left 1", "right 1")
"""Walks with a criterion; those at 3 m/s are only reported."""
TURNS = ("yaw 2", "yaw -2")
"""Turns with a criterion."""
DISTANCE = {"forward 1": 0.7, "forward 2": 1.1, "side -1": 0.65, "side +1": 0.65, "back 2": 1.1}
"""Least mean distance of jumps in the training simulator, by command [m]."""
LIFT_OFF_VELOCITY = 2.5
"""Desired upward velocity at lift-off [m/s]."""
COST = 1.10
"""Largest growth of the speed error by the jump phases [1]."""


@dataclass(frozen=True)
class Check:
    """A number beside its limit."""

    name: str
    """Name of the number, with its command."""
    value: float
    sense: Sense
    limit: float
    unit: str = ""

    @property
    def passed(self) -> bool:
        """Whether the number keeps the limit; NaN does not."""
        if self.sense == "<=":
            return self.value <= self.limit
        return self.value >= self.limit

    def row(self) -> dict[str, Any]:
        """Return the check as JSON has it."""
        return {
            "name": self.name,
            "value": self.value,
            "sense": self.sense,
            "limit": self.limit,
            "unit": self.unit,
            "passed": self.passed,
        }


def trial_checks(trial: TrialResults) -> list[Check]:
    """Check the first policy of a trial: the paper's matched column, and more."""
    policy = trial.subjects[0].name
    paper_heights = TABLE_III["height", "matched"]
    checks = []
    best_height = math.nan
    has_paper_command = False
    for cell in trial.cells:
        if cell.policy != policy:
            continue
        name = cell.case
        if name in paper_heights:
            has_paper_command = True
            for figure in ("height", "distance"):
                spread = cell.figures[figure]
                mean, std = TABLE_III[figure, "matched"][name]
                checks.append(Check(f"{name}: {figure}", spread.mean, ">=", mean, "m"))
                checks.append(Check(f"{name}: {figure}, std", spread.std, "<=", std, "m"))
        if name in GAPS:
            gap = cell.figures["gap"].mean
            checks.append(Check(f"{name}: gap", gap, ">=", GAPS[name], "m"))
        checks.append(Check(f"{name}: success", cell.success, ">=", SUCCESS))
        if cell.found:
            height = cell.figures["height"].mean
            best_height = height if math.isnan(best_height) else max(best_height, height)
    if has_paper_command:
        checks.append(Check("best: height", best_height, ">=", HEIGHT, "m"))
    return checks


def cost_of_jumping(before: Mapping[str, float], after: Mapping[str, float]) -> float:
    """Return the mean speed error of `WALKS` after the jump phases over that before.

    Args:
        before: Mean speed errors by walk [m/s], of the policy that only walks.
        after: The same of the policy that jumps.

    Returns:
        The ratio [1]; NaN if a walk is missing.
    """
    error_before = math.fsum(before.get(name, math.nan) for name in WALKS)
    error_after = math.fsum(after.get(name, math.nan) for name in WALKS)
    return error_after / error_before if error_before else math.nan


def evaluation_checks(evaluation: Evaluation) -> list[Check]:
    """Check every criterion that belongs to the commands of an evaluation."""
    checks = []
    for walk in evaluation.walks:
        checks += _walk_checks(walk)
    for jump in evaluation.jumps:
        checks += _jump_checks(jump)
    for moment, results in (("walking", evaluation.walks), ("around jumps", evaluation.jumps)):
        if results:
            flights = [result["uncommanded"].maximum for result in results]
            # Commands without such a flight have NaN; without any, its height is 0.
            highest = max((flight for flight in flights if not math.isnan(flight)), default=0.0)
            checks.append(Check(f"flight without a jump input, {moment}", highest, "<=", RISE, "m"))
    estimator = evaluation.estimator
    if estimator:
        checks.append(Check("velocity RMSE", estimator["velocity"], "<=", 0.15, "m/s"))
        checks.append(Check("contacts right", estimator["contacts_right"], ">=", 0.95))
    if evaluation.before:
        cost = cost_of_jumping(evaluation.before, evaluation.speed_errors())
        checks.append(Check("speed error over that before jumping", cost, "<=", COST))
    return checks


def _walk_checks(walk: CommandResult) -> list[Check]:
    """Check one walk of an evaluation."""
    name = walk.name
    if name in WALKS:
        return [
            Check(f"{name}: speed error", walk["speed_error"].mean, "<=", 0.15, "m/s"),
            Check(f"{name}: falls", walk["fell"].mean, "<=", 0.005),
        ]
    if name in TURNS:
        return [Check(f"{name}: yaw rate error", walk["yaw_error"].mean, "<=", 0.2, "rad/s")]
    if name == "stand":
        return [Check(f"{name}: speed", walk["speed_error_averaged"].mean, "<=", 0.05, "m/s")]
    return []


def _jump_checks(jump: CommandResult) -> list[Check]:
    """Check one jump of an evaluation."""
    name = f"jump {jump.name}"
    velocity_off = abs(jump["lift_off_velocity"].mean - LIFT_OFF_VELOCITY)
    checks = [
        Check(f"{name}: height", jump["height"].mean, ">=", HEIGHT, "m"),
        Check(f"{name}: std of height", jump["height"].std, "<=", 0.03, "m"),
    ]
    if jump.name in DISTANCE:
        distance = jump["distance"].mean
        checks.append(Check(f"{name}: distance", distance, ">=", DISTANCE[jump.name], "m"))
    checks += [
        Check(f"{name}: upright", jump["upright"].mean, ">=", 0.99),
        # Flights of the gait before and after do not count.
        Check(f"{name}: one high flight", jump["single"].mean, ">=", 0.95),
        Check(
            f"{name}: lift-off velocity off {LIFT_OFF_VELOCITY:g}", velocity_off, "<=", 0.3, "m/s"
        ),
        Check(f"{name}: lift-off after, 95th percentile", jump["delay"].p95, "<=", 0.3, "s"),
    ]
    return checks
