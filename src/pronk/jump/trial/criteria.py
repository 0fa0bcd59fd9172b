"""The acceptance criteria of a policy, on the virtual robot and in the training simulator."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from pronk.jump.trial.jumps import RISE
from pronk.jump.trial.protocol import PAPER_ROBOT, TABLE_III
from pronk.jump.trial.results import TrialResults
from pronk.jump.trial.training_sim.evaluation import CommandResult, Evaluation

Sense = Literal["<=", ">="]

FALL_SHARE = 0.005
"""Largest share of walks with a fall in the training simulator [1]."""
CRITERIA_JUMPS = 20
"""Number of jumps with each command that the criteria are meant for."""
DISTANCE = {"forward 1": 0.7, "forward 2": 1.1, "side -1": 0.65, "side +1": 0.65, "back 2": 1.1}
"""Least mean distance of the Mini Cheetah's jumps in the training simulator, by command [m]."""
COST = 1.10
"""Largest growth of the speed error by the jump phases [1]."""


@dataclass(frozen=True, kw_only=True)
class Goals:
    """What a policy of one robot is to reach."""

    source: str
    """Where the numbers come from, in words."""
    paper: bool = False
    """Whether means and scatter of every command are to be those of the paper's Table III."""
    gaps: Mapping[str, float] = field(default_factory=dict)
    """Least mean gap by command [m]."""
    best_gap: float | None = None
    """Least mean gap of the best command [m]."""
    height: float
    """Least mean height of the best command [m]; in the training simulator, of each."""
    success: float = 0.95
    """Least share of jumps that land [1]."""
    each_command: bool = True
    """Whether that share holds for every command, or for all jumps together."""
    lift_off_velocity: float
    """Desired upward velocity at lift-off [m/s]."""
    lift_off_s: float = 0.3
    """Longest time from the jump input to the lift-off, 95th percentile [s]."""
    walks: tuple[str, ...]
    """Walks with a criterion; faster ones are only reported."""
    turns: tuple[str, ...]
    """Turns with a criterion."""
    speed_error: float
    """Largest mean error of the horizontal velocity, in a walk [m/s]."""
    yaw_error: float = 0.2
    """Largest mean error of the yaw rate, in a turn [rad/s]."""
    falls: float | None = None
    """Largest number of falls in all walks of the virtual robot; None where walks of the virtual
    robot have no criterion."""


GOALS: Mapping[str, Goals] = {
    PAPER_ROBOT: Goals(
        source="the paper's matched column, and more",
        paper=True,
        # The paper's gaps are 0.55, 0.50 and 0.40 m (R3).
        gaps={"forward 2": 0.60, "back 2": 0.55, "side -1": 0.40, "side +1": 0.40},
        # The paper's physical limit (R5).
        height=0.45,
        lift_off_velocity=2.5,
        walks=("forward 2", "back 2", "left 1", "right 1"),
        turns=("yaw 2", "yaw -2"),
        speed_error=0.15,
    ),
    "go2": Goals(
        source="goals of this project, since nothing is published",
        best_gap=0.75,
        height=0.45,
        each_command=False,
        lift_off_velocity=2.3,
        # Its training asks for .31 s, .03 s more than the Mini Cheetah's.
        lift_off_s=0.33,
        walks=("forward 2", "back 2", "left 0.8", "right 0.8", "side +0.8", "side -0.8"),
        turns=("yaw 2", "yaw -2", "turn +2", "turn -2"),
        speed_error=0.10,
        falls=0.0,
    ),
}
"""Goals by robot. A policy of another robot has no acceptance criteria."""


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
    """Check the first policy of a trial; nothing for a robot without goals."""
    goals = GOALS.get(trial.robot)
    if goals is None:
        return []
    cells = trial.cells_of(trial.subjects[0].name)
    paper_heights = TABLE_III["height", "matched"]
    checks = []
    best_height = math.nan
    best_gap = math.nan
    has_paper_command = False
    for cell in cells:
        name = cell.case
        if name in paper_heights:
            has_paper_command = True
        if goals.paper and name in paper_heights:
            for figure in ("height", "distance"):
                spread = cell.figures[figure]
                mean, std = TABLE_III[figure, "matched"][name]
                checks.append(Check(f"{name}: {figure}", spread.mean, ">=", mean, "m"))
                checks.append(Check(f"{name}: {figure}, std", spread.std, "<=", std, "m"))
        gap = cell.figures["gap"].mean
        if name in goals.gaps:
            checks.append(Check(f"{name}: gap", gap, ">=", goals.gaps[name], "m"))
        if goals.each_command:
            checks.append(Check(f"{name}: success", cell.success, ">=", goals.success))
        if cell.found:
            best_height = _larger(best_height, cell.figures["height"].mean)
            best_gap = _larger(best_gap, gap)
    if not goals.each_command:
        landed = sum(cell.succeeded for cell in cells)
        commanded = sum(cell.n for cell in cells)
        checks.append(Check("all: success", landed / commanded, ">=", goals.success))
    if has_paper_command:
        checks.append(Check("best: height", best_height, ">=", goals.height, "m"))
        if goals.best_gap is not None:
            checks.append(Check("best: gap", best_gap, ">=", goals.best_gap, "m"))
    return checks


def _larger(best: float, value: float) -> float:
    """Return the larger of two numbers, of which either may be NaN for none."""
    return value if math.isnan(best) or value > best else best


def walk_checks(walks: TrialResults) -> list[Check]:
    """Check the walks of the first policy on the virtual robot; nothing without goals for them."""
    goals = GOALS.get(walks.robot)
    if goals is None or goals.falls is None:
        return []
    cells = walks.cells_of(walks.subjects[0].name)
    checks = []
    for cell in cells:
        if cell.case in goals.walks:
            error = cell.figures["speed_error"].mean
            name = f"{cell.case}: speed error"
            checks.append(Check(name, error, "<=", goals.speed_error, "m/s"))
        if cell.case in goals.turns:
            error = cell.figures["yaw_error"].mean
            name = f"{cell.case}: yaw rate error"
            checks.append(Check(name, error, "<=", goals.yaw_error, "rad/s"))
    fallen = sum(cell.fell for cell in cells)
    checks.append(Check("all walks: falls", float(fallen), "<=", goals.falls))
    return checks


def cost_of_jumping(
    before: Mapping[str, float],
    after: Mapping[str, float],
    walks: Sequence[str] = GOALS[PAPER_ROBOT].walks,
) -> float:
    """Return the mean speed error of the walks after the jump phases over that before.

    Args:
        before: Mean speed errors by walk [m/s], of the policy that only walks.
        after: The same of the policy that jumps.
        walks: The walks that count.

    Returns:
        The ratio [1]; NaN if a walk is missing.
    """
    error_before = math.fsum(before.get(name, math.nan) for name in walks)
    error_after = math.fsum(after.get(name, math.nan) for name in walks)
    return error_after / error_before if error_before else math.nan


def evaluation_checks(evaluation: Evaluation) -> list[Check]:
    """Check every criterion that belongs to the commands of an evaluation.

    A robot without goals has none.
    """
    robot = str(evaluation.plan.get("robot", PAPER_ROBOT))
    goals = GOALS.get(robot)
    if goals is None:
        return []
    checks = []
    for walk in evaluation.walks:
        checks += _walk_checks(walk, goals)
    if goals.each_command:
        for jump in evaluation.jumps:
            checks += _jump_checks(jump, goals)
    elif evaluation.jumps:
        heights = [jump["height"].mean for jump in evaluation.jumps]
        upright = [jump["upright"].mean for jump in evaluation.jumps]
        share = math.fsum(upright) / len(upright)
        checks.append(Check("all jumps: upright", share, ">=", goals.success))
        best = math.nan
        for height in heights:
            best = _larger(best, height)
        checks.append(Check("best jump: height", best, ">=", goals.height, "m"))
        for jump in evaluation.jumps:
            name = f"jump {jump.name}: lift-off after, 95th percentile"
            checks.append(Check(name, jump["delay"].p95, "<=", goals.lift_off_s, "s"))
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
        walk_names = [walk.name for walk in evaluation.walks if walk.name in goals.walks]
        cost = cost_of_jumping(evaluation.before, evaluation.speed_errors(), walk_names)
        checks.append(Check("speed error over that before jumping", cost, "<=", COST))
    return checks


def _walk_checks(walk: CommandResult, goals: Goals) -> list[Check]:
    """Check one walk of an evaluation."""
    name = walk.name
    if name in goals.walks:
        error = walk["speed_error"].mean
        return [
            Check(f"{name}: speed error", error, "<=", goals.speed_error, "m/s"),
            Check(f"{name}: falls", walk["fell"].mean, "<=", FALL_SHARE),
        ]
    if name in goals.turns:
        error = walk["yaw_error"].mean
        return [Check(f"{name}: yaw rate error", error, "<=", goals.yaw_error, "rad/s")]
    if name == "stand":
        return [Check(f"{name}: speed", walk["speed_error_averaged"].mean, "<=", 0.05, "m/s")]
    return []


def _jump_checks(jump: CommandResult, goals: Goals) -> list[Check]:
    """Check one jump of an evaluation."""
    name = f"jump {jump.name}"
    wanted = goals.lift_off_velocity
    velocity_off = abs(jump["lift_off_velocity"].mean - wanted)
    checks = [
        Check(f"{name}: height", jump["height"].mean, ">=", goals.height, "m"),
        Check(f"{name}: std of height", jump["height"].std, "<=", 0.03, "m"),
    ]
    if goals.paper and jump.name in DISTANCE:
        distance = jump["distance"].mean
        checks.append(Check(f"{name}: distance", distance, ">=", DISTANCE[jump.name], "m"))
    checks += [
        Check(f"{name}: upright", jump["upright"].mean, ">=", 0.99),
        # Flights of the gait before and after do not count.
        Check(f"{name}: one high flight", jump["single"].mean, ">=", 0.95),
        Check(f"{name}: lift-off velocity off {wanted:g}", velocity_off, "<=", 0.3, "m/s"),
        Check(
            f"{name}: lift-off after, 95th percentile",
            jump["delay"].p95,
            "<=",
            goals.lift_off_s,
            "s",
        ),
    ]
    return checks
