"""The acceptance criteria of a policy, on the virtual robot and in the training simulator.

A criterion is a limit on a number of a summary: of a `Cell` of a trial, of a `CommandResult` of the
evaluation in the training simulator, or of the whole. A number that could not be measured fails.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

from pronk.evaluation.jumps import RISE
from pronk.evaluation.published import TABLE_III
from pronk.evaluation.results import Cell, Results

if TYPE_CHECKING:
    from pronk.evaluation.training_sim.evaluation import CommandResult, Evaluation

Sense = Literal["<=", ">="]


@dataclass(frozen=True, kw_only=True)
class Criterion:
    """A limit on a number of a summary."""

    what: str
    number: Callable[[Any], float]
    """From the summary."""
    sense: Sense
    limit: float
    unit: str = ""

    def check(self, summary: Any) -> Check:
        """Compare the summary's number with the limit."""
        value = float(self.number(summary))
        return Check(
            what=self.what, value=value, sense=self.sense, limit=self.limit, unit=self.unit
        )


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


def mean(figure: str) -> Callable[[Any], float]:
    """Return a function that reads the mean of a figure from a summary."""
    return lambda summary: float(summary.figures[figure].mean)


def std(figure: str) -> Callable[[Any], float]:
    """Return a function that reads the standard deviation of a figure from a summary."""
    return lambda summary: float(summary.figures[figure].std)


def _least(what: str, number: Callable[[Any], float], limit: float, unit: str = "") -> Criterion:
    return Criterion(what=what, number=number, sense=">=", limit=limit, unit=unit)


def _most(what: str, number: Callable[[Any], float], limit: float, unit: str = "") -> Criterion:
    return Criterion(what=what, number=number, sense="<=", limit=limit, unit=unit)


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
    if name in TABLE_III:
        for figure in ("height", "distance"):
            average, deviation = getattr(TABLE_III[name], figure)["matched"]
            found.append(_least(f"{name}: {figure}", mean(figure), average, "m"))
            found.append(_most(f"{name}: {figure}, std", std(figure), deviation, "m"))
    if name in GAPS:
        found.append(_least(f"{name}: gap", mean("gap"), GAPS[name], "m"))
    return (*found, _least(f"{name}: success", lambda cell: cell.success, SUCCESS))


def _best_height(cells: Sequence[Cell]) -> float:
    return max((c.figures["height"].mean for c in cells if c.found), default=math.nan)


BEST = _least("best: height", _best_height, HEIGHT, "m")


def trial_checks(trial: Results) -> list[Check]:
    """Check the first policy of a trial with every command that was run."""
    first = trial.subjects[0].name
    cells = [cell for cell in trial.cells if cell.policy == first]
    found = [criterion.check(cell) for cell in cells for criterion in of_command(cell.case)]
    if any(cell.case in TABLE_III for cell in cells):
        found.append(BEST.check(cells))
    return found


# ---- evaluation in the training simulator ----

WALKS = ("forward 2", "back 2", "left 1", "right 1")
"""Those at 3 m/s are only reported."""
TURNS = ("yaw 2", "yaw -2")
STAND = "stand"
DISTANCE = {
    "forward 1": 0.70,
    "forward 2": 1.10,
    "side -1": 0.65,
    "side +1": 0.65,
    "back 2": 1.10,
}
"""[m]"""
LIFT_OFF_VELOCITY = 2.5
"""Desired [m/s]."""
COST = 1.10
"""Largest growth of the speed error by the jump phases."""

_WALK = (
    _most("speed error", mean("speed_error"), 0.15, "m/s"),
    _most("falls", lambda walk: walk.shares["fell"], 0.005),
)
_TURN = (_most("yaw rate error", mean("yaw_error"), 0.2, "rad/s"),)
_STAND = (_most("speed", mean("speed_error_averaged"), 0.05, "m/s"),)
_JUMP = (
    _least("height", mean("height"), HEIGHT, "m"),
    _most("std of height", std("height"), 0.03, "m"),
)
_JUMP_MORE = (
    _least("upright", lambda jump: jump.shares["upright"], 0.99),
    # Flights of the gait before and after do not count.
    _least("one high flight", lambda jump: jump.shares["single"], 0.95),
    _most(
        f"lift-off velocity off {LIFT_OFF_VELOCITY:g}",
        lambda jump: abs(jump.figures["lift_off_velocity"].mean - LIFT_OFF_VELOCITY),
        0.3,
        "m/s",
    ),
    _most("lift-off after, 95th percentile", lambda jump: jump.figures["delay"].p95, 0.3, "s"),
)
_UNCOMMANDED = "flight without a jump input"


def _highest(results: Iterable[CommandResult]) -> float:
    """Highest flight without a jump input, of any robot; no flight has height 0."""
    highest = (each.figures["uncommanded"].most for each in results)
    return max((one for one in highest if not math.isnan(one)), default=0.0)


_WHOLE = (
    _most(f"{_UNCOMMANDED}, walking", lambda whole: _highest(whole.walks), RISE, "m"),
    _most(f"{_UNCOMMANDED}, around jumps", lambda whole: _highest(whole.jumps), RISE, "m"),
)
_ESTIMATOR = (
    _most("velocity RMSE", lambda estimator: estimator.rmse_vector, 0.15, "m/s"),
    _least("contacts right", lambda estimator: estimator.contacts_right, 0.95),
)
_COST = _most("speed error over that before jumping", lambda cost: cost, COST)


def cost_of_jumping(before: Mapping[str, float], after: Mapping[str, float]) -> float:
    """Mean speed error of `WALKS` after the jump phases over that before.

    Args:
        before: Mean speed error by walk, of the policy that only walks [m/s].
        after: The same of the policy that jumps.

    Returns:
        The ratio; NaN where one of them was not evaluated on a walk of `WALKS`.
    """
    sums = [math.fsum(errors.get(name, math.nan) for name in WALKS) for errors in (before, after)]
    return sums[1] / sums[0] if sums[0] else math.nan


def evaluation_checks(evaluation: Evaluation) -> list[Check]:
    """Check every criterion that belongs to the commands of an evaluation."""
    named: list[tuple[str, Iterable[Criterion], Any]] = []
    for walk in evaluation.walks:
        of_name = {**dict.fromkeys(WALKS, _WALK), **dict.fromkeys(TURNS, _TURN), STAND: _STAND}
        named.append((f"{walk.name}: ", of_name.get(walk.name, ()), walk))
    for jump in evaluation.jumps:
        own = [_least("distance", mean("distance"), DISTANCE[jump.name], "m")] * (
            jump.name in DISTANCE
        )
        named.append((f"jump {jump.name}: ", (*_JUMP, *own, *_JUMP_MORE), jump))
    flown = zip(_WHOLE, (evaluation.walks, evaluation.jumps), strict=True)
    named.append(("", [criterion for criterion, results in flown if results], evaluation))
    if evaluation.estimator is not None:
        named.append(("", _ESTIMATOR, evaluation.estimator))
    if evaluation.before:
        cost = cost_of_jumping(evaluation.before, evaluation.speed_errors())
        named.append(("", (_COST,), cost))
    checks = [(head, one.check(part)) for head, criteria, part in named for one in criteria]
    return [Check(**{**asdict(check), "what": head + check.what}) for head, check in checks]
