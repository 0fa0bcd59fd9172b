"""The acceptance criteria of a policy, on the virtual robot and in the training simulator.

A criterion is a limit on a number of a summary: of a `Cell` of a trial, of a `CommandResult` of the
evaluation in the training simulator, or of the whole. A number that could not be measured fails.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from pronk.evaluation.jumps import RISE
from pronk.evaluation.protocol import TABLE_III
from pronk.evaluation.results import Results

if TYPE_CHECKING:
    from pronk.evaluation.training_sim.evaluation import CommandResult, Evaluation

Sense = Literal["<=", ">="]
Number = Callable[[Any], float]
"""From a summary."""


@dataclass(frozen=True, kw_only=True)
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


@dataclass(frozen=True)
class Criterion:
    """A limit on a number of a summary."""

    what: str
    number: Number
    sense: Sense
    limit: float
    unit: str = ""

    def check(self, summary: Any) -> Check:
        """Compare the summary's number with the limit."""
        kept = {name: getattr(self, name) for name in ("what", "sense", "limit", "unit")}
        return Check(value=float(self.number(summary)), **kept)


def mean(figure: str) -> Number:
    """Return a function that reads the mean of a figure from a summary."""
    return lambda summary: float(summary.figures[figure].mean)


def std(figure: str) -> Number:
    """Return a function that reads the standard deviation of a figure from a summary."""
    return lambda summary: float(summary.figures[figure].std)


def share(name: str) -> Number:
    """Return a function that reads a share of the robots from a summary."""
    return lambda summary: float(summary.shares[name])


# ---- trial on the virtual robot ----

GAPS = {"forward 2": 0.60, "back 2": 0.55, "side -1": 0.40, "side +1": 0.40}
"""[m]; the paper's are 0.55, 0.50, 0.40 (R3)."""
HEIGHT = 0.45
"""Of the best command [m]: the paper's physical limit (R5)."""
SUCCESS = 0.95
"""Share of jumps that land well."""
JUMPS = 20
"""With each command: what the criteria are meant for."""


def of_command(name: str) -> tuple[Criterion, ...]:
    """Return the criteria of one command of a trial: the paper's matched column, and more."""
    found = []
    for figure in ("height", "distance") if name in TABLE_III else ():
        average, deviation = getattr(TABLE_III[name], figure)["matched"]
        found.append(Criterion(f"{name}: {figure}", mean(figure), ">=", average, "m"))
        found.append(Criterion(f"{name}: {figure}, std", std(figure), "<=", deviation, "m"))
    if name in GAPS:
        found.append(Criterion(f"{name}: gap", mean("gap"), ">=", GAPS[name], "m"))
    return (*found, Criterion(f"{name}: success", lambda cell: cell.success, ">=", SUCCESS))


def trial_checks(trial: Results) -> list[Check]:
    """Check the first policy of a trial with every command that was run."""
    first = trial.subjects[0].name
    cells = [cell for cell in trial.cells if cell.policy == first]
    found = [criterion.check(cell) for cell in cells for criterion in of_command(cell.case)]
    if any(cell.case in TABLE_III for cell in cells):
        best = max((c.figures["height"].mean for c in cells if c.found), default=math.nan)
        found.append(Check(what="best: height", value=best, sense=">=", limit=HEIGHT, unit="m"))
    return found


# ---- evaluation in the training simulator ----

WALKS = ("forward 2", "back 2", "left 1", "right 1")
"""Those at 3 m/s are only reported."""
DISTANCE = {"forward 1": 0.7, "forward 2": 1.1, "side -1": 0.65, "side +1": 0.65, "back 2": 1.1}
"""[m]"""
LIFT_OFF_VELOCITY = 2.5
"""Desired [m/s]."""
COST = 1.10
"""Largest growth of the speed error by the jump phases."""

_OF_WALK = dict.fromkeys(
    WALKS,
    (
        Criterion("speed error", mean("speed_error"), "<=", 0.15, "m/s"),
        Criterion("falls", share("fell"), "<=", 0.005),
    ),
)
_TURN = Criterion("yaw rate error", mean("yaw_error"), "<=", 0.2, "rad/s")
_STAND = Criterion("speed", mean("speed_error_averaged"), "<=", 0.05, "m/s")
_OF_WALK |= {"yaw 2": (_TURN,), "yaw -2": (_TURN,), "stand": (_STAND,)}  # type: ignore[dict-item]
_JUMP = (
    Criterion("height", mean("height"), ">=", HEIGHT, "m"),
    Criterion("std of height", std("height"), "<=", 0.03, "m"),
    Criterion("upright", share("upright"), ">=", 0.99),
    # Flights of the gait before and after do not count.
    Criterion("one high flight", share("single"), ">=", 0.95),
    Criterion(
        f"lift-off velocity off {LIFT_OFF_VELOCITY:g}",
        lambda jump: abs(jump.figures["lift_off_velocity"].mean - LIFT_OFF_VELOCITY),
        "<=",
        0.3,
        "m/s",
    ),
    Criterion(
        "lift-off after, 95th percentile", lambda jump: jump.figures["delay"].p95, "<=", 0.3, "s"
    ),
)
_ESTIMATOR = (
    Criterion("velocity RMSE", lambda estimator: estimator.rmse_vector, "<=", 0.15, "m/s"),
    Criterion("contacts right", lambda estimator: estimator.contacts_right, ">=", 0.95),
)


def _highest(results: Iterable[CommandResult]) -> float:
    """Highest flight without a jump input, of any robot; no flight has height 0."""
    highest = (each.figures["uncommanded"].most for each in results)
    return max((one for one in highest if not math.isnan(one)), default=0.0)


def cost_of_jumping(before: Mapping[str, float], after: Mapping[str, float]) -> float:
    """Mean speed error of `WALKS` after the jump phases over that before; NaN if one is missing.

    `before` and `after` are mean speed errors by walk [m/s], of the policy that only walks and of
    the one that jumps.
    """
    sums = [math.fsum(errors.get(name, math.nan) for name in WALKS) for errors in (before, after)]
    return sums[1] / sums[0] if sums[0] else math.nan


def evaluation_checks(evaluation: Evaluation) -> list[Check]:
    """Check every criterion that belongs to the commands of an evaluation."""
    found: list[Check] = []
    for walk in evaluation.walks:
        for criterion in _OF_WALK.get(walk.name, ()):
            found.append(replace(criterion, what=f"{walk.name}: {criterion.what}").check(walk))
    for jump in evaluation.jumps:
        criteria = list(_JUMP)
        if jump.name in DISTANCE:
            far = Criterion("distance", mean("distance"), ">=", DISTANCE[jump.name], "m")
            criteria.insert(2, far)
        for criterion in criteria:
            found.append(replace(criterion, what=f"jump {jump.name}: {criterion.what}").check(jump))
    for when, results in (("walking", evaluation.walks), ("around jumps", evaluation.jumps)):
        if results:
            what = f"flight without a jump input, {when}"
            found.append(
                Check(what=what, value=_highest(results), sense="<=", limit=RISE, unit="m")
            )
    if evaluation.estimator is not None:
        found += [criterion.check(evaluation.estimator) for criterion in _ESTIMATOR]
    if evaluation.before:
        cost = cost_of_jumping(evaluation.before, evaluation.speed_errors())
        what = "speed error over that before jumping"
        found.append(Check(what=what, value=cost, sense="<=", limit=COST))
    return found
