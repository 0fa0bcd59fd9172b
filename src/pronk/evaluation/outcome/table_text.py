"""Tables as text: a sheet, its single cells, and where its numbers come from.

A cell that could not be measured holds a dash.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from pronk.evaluation.outcome.published import Pair
from pronk.evaluation.result import Trial
from pronk.evaluation.summary import Cell, Ratio, Spread


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """A table of text, as the terminal and the page print it."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


def number(value: float, digits: int = 3) -> str:
    """A number; a dash where it is unknown."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def pair(values: Pair | None) -> str:
    """Mean and standard deviation of the paper; a dash where it has none."""
    return f"{values[0]:.3f} +- {values[1]:.3f}" if values else "-"


def spread(figure: Spread, digits: int = 3) -> str:
    """Mean and standard deviation; the value of one jump alone; a dash if none has the figure."""
    if not figure.n:
        return "-"
    mean = number(figure.mean, digits)
    return f"{mean} +- {number(figure.std, digits)}" if figure.n > 1 else mean


def counted(cell: Cell) -> str:
    """Jumps found of those asked."""
    return f"({cell.found}/{cell.n})"


def interval(ratio: Ratio) -> str:
    """A ratio and its interval; too few jumps have none."""
    if not math.isfinite(ratio.value):
        return "-"
    if not math.isfinite(ratio.low):
        return f"{ratio.value:.2f} (too few)"
    return f"{ratio.value:.2f} ({ratio.low:.2f} to {ratio.high:.2f})"


def place(trial: Trial) -> str:
    """Where it was measured, in words."""
    return "virtual robot" if trial.virtual else "robot"


def virtual_note(trial: Trial) -> str:
    """Where the numbers come from."""
    where = (
        "ours: pronk's virtual robot, not a real one" if trial.virtual else "ours: the real robot"
    )
    return (
        f"{where}; seed {trial.seed}, sim_params {str(trial.sim_params.get('sha256', '-'))[:12]}."
    )
