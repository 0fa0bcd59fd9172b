"""Walking as a part of a page: who fell, and how well velocities were kept (paper R4)."""

from __future__ import annotations

import numpy as np

from pronk.evaluation.published import in_paper_order
from pronk.evaluation.results import Results
from pronk.evaluation.tables import Sheet, spread
from pronk.evaluation.walk_metrics import SETTLE_S, WALK_FIGURES
from pronk.report import shell
from pronk.report.shell import Part
from pronk.report.trial.cells import Values, cells
from pronk.report.trial.extra import Block, part, place

PAPER_WALKS = ("forward 2", "back 2", "side -1", "side +1")
"""Velocities of the paper's R4."""
_SHOWN = (
    "lasted",
    "forward",
    "left",
    "yaw_rate",
    "speed_error",
    "speed_error_averaged",
    "yaw_error_averaged",
    "roll_rate_rms",
    "pitch_rate_rms",
    "power",
    "cost_of_transport",
)


def values(walks: Results, figure: str) -> Values:
    """One figure of every walk, by policy and command."""
    return {
        name: {
            case.name: np.array(
                [
                    getattr(row.figures, figure)
                    for row in walks.rows
                    if (row.policy, row.case) == (name, case.name)
                ],
                dtype=float,
            )
            for case in walks.cases
        }
        for name in in_paper_order(subject.name for subject in walks.subjects)
    }


def tables(walks: Results) -> tuple[Sheet, ...]:
    """One for each policy: figures by velocity."""
    return tuple(_table(walks, subject.name) for subject in walks.subjects)


def _table(walks: Results, policy: str) -> Sheet:
    own = [cell for cell in walks.cells if cell.policy == policy]
    counts = {
        "walks": [cell.n for cell in own],
        "fell": [cell.fell for cell in own],
        "non-foot contact": [cell.non_foot_contact for cell in own],
    }
    return Sheet(
        title=f"{policy}: mean ± standard deviation",
        columns=("figure", *(cell.case for cell in own)),
        rows=(
            *((name, *map(str, values)) for name, values in counts.items()),
            *(
                (
                    f"{name.replace('_', ' ')} [{WALK_FIGURES[name].unit}]",
                    *(spread(cell.figures[name], 2) for cell in own),
                )
                for name in _SHOWN
            ),
        ),
        notes=(
            "non-foot contact: walks in which something but a foot touched the ground. The first "
            f"{SETTLE_S:g} s after the command are left out; a walk that ended "
            "in a fall counts with what came before.",
        ),
    )


def walk_part(walks: Results, *, anchor: str, title: str = "Walking") -> Part:
    """The walks as a part of a page."""
    first = walks.subjects[0].name
    own = [cell for cell in walks.cells if cell.policy == first and cell.case in PAPER_WALKS] or [
        cell for cell in walks.cells if cell.policy == first
    ]
    fell, n = sum(cell.fell for cell in own), sum(cell.n for cell in own)
    where = place(walks)
    names = ", ".join(cell.case for cell in own)
    lines = [
        "The paper says that its robot walks stably at 2 m/s forward and backward and at 1 m/s "
        f"sideways (R4). Counted here: {names}, each for {walks.script.run_s:g} s.",
    ]
    shown = Block(
        anchor="errors",
        title="How well the velocities were kept",
        lines=(f"{WALK_FIGURES['speed_error_averaged'].says}: every walk, mean and spread.",),
        picture=shell.picture(
            cells([("speed error [m/s]", values(walks, "speed_error_averaged"), {})]),
            f"Speed error of every walk of the {where}, by command and policy",
        ),
        sheets=tables(walks),
    )
    return part(
        [shown],
        anchor=anchor,
        title=title,
        says=f"{first}, {where}: {fell} of {n} walks ended in a fall.",
        origin=walks,
        lines=lines,
        doubt=fell > 0,
        definitions=WALK_FIGURES.values(),
    )
