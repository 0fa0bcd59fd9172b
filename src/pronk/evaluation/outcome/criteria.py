"""The bars: what the first policy of a trial must show with each command."""

from __future__ import annotations

import math
from collections.abc import Iterator

from pronk.evaluation.criteria import Check
from pronk.evaluation.outcome.published import TABLE_III
from pronk.evaluation.result import Trial
from pronk.evaluation.summary import Cell

GAPS = {"forward 2": 0.60, "back 2": 0.55, "side -1": 0.40, "side +1": 0.40}
"""Bars [m]; the paper's are .55, .50, .40 (R3)."""
HEIGHT = 0.45
"""Bar of the best command [m]: what the paper calls the physical limit (R5)."""
SUCCESS = 0.95
"""Bar of the landing success."""
JUMPS = 20
"""With each command: what the bars are meant for."""


def checks(trial: Trial) -> list[Check]:
    """Every bar that the first policy must clear on the commands that were tried."""
    first = trial.subjects[0].name
    cells = [trial.cell(first, case.name) for case in trial.cases]
    found = [check for cell in cells for check in _checks(cell)]
    if any(cell.case in TABLE_III for cell in cells):
        best = max((c.figures["height"].mean for c in cells if c.found), default=math.nan)
        found.append(Check(what="best: height", value=best, sense=">=", bar=HEIGHT, unit="m"))
    return found


def _checks(cell: Cell) -> Iterator[Check]:
    paper = TABLE_III.get(cell.case)
    for figure in ("height", "distance") if paper else ():
        mean, std = getattr(paper, figure)["matched"]
        ours = cell.figures[figure]
        what = f"{cell.case}: {figure}"
        yield Check(what=what, value=ours.mean, sense=">=", bar=mean, unit="m")
        yield Check(what=f"{what}, std", value=ours.std, sense="<=", bar=std, unit="m")
    if cell.case in GAPS:
        yield Check(
            what=f"{cell.case}: gap",
            value=cell.figures["gap"].mean,
            sense=">=",
            bar=GAPS[cell.case],
            unit="m",
        )
    yield Check(what=f"{cell.case}: success", value=cell.success, sense=">=", bar=SUCCESS)
