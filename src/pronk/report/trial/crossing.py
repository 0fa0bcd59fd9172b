"""Crossing gaps and steps as a part of a page (paper R3, and beyond it)."""

from __future__ import annotations

import math

import numpy as np

from pronk.evaluation.crossing import Climb, climbs
from pronk.evaluation.results import Results, share_interval
from pronk.evaluation.tables import Sheet, number
from pronk.report import shell
from pronk.report.shell import Part
from pronk.report.trial.extra import Block, part, place
from pronk.report.trial.sweeps import Line, Panel, lines

PAPER_GAPS = {"forward 2": 0.55, "back 2": 0.50, "side -1": 0.40, "side +1": 0.40}
"""Widest gaps that the paper says its robot could cross, read off video (R3) [m]."""
_WORDS = {"gap": "gap", "up": "step up", "down": "step down"}


def line(climb: Climb) -> Line:
    """Share of crossed runs over the size, each with the lead that did best."""
    shares = [rung.crossed / rung.runs for rung in climb.rungs]
    ends = [share_interval(rung.crossed, rung.runs) for rung in climb.rungs]
    return Line(
        x=np.array([rung.size for rung in climb.rungs]),
        y=np.array(shares),
        low=np.array([low for low, _ in ends]),
        high=np.array([high for _, high in ends]),
    )


def panels(crossings: Results) -> list[Panel]:
    """A row for each kind of obstacle, a column for each command."""
    return [
        Panel(
            title=f"{_WORDS.get(kind, kind)}, {case.name}",
            x_label="size [m]",
            y_label="crossed [1]",
            lines={
                climb.policy: line(climb)
                for climb in climbs(crossings)
                if (climb.case, climb.kind) == (case.name, kind) and climb.rungs
            },
            marks=(PAPER_GAPS[case.name],) if kind == "gap" and case.name in PAPER_GAPS else (),
            share=True,
        )
        for kind in crossings.settings["kinds"]
        for case in crossings.cases
    ]


def table(crossings: Results) -> Sheet:
    """Largest sizes, and why larger ones were not crossed."""
    rows, reasons = [], []
    for climb in climbs(crossings):
        what = f"{climb.policy}: {_WORDS.get(climb.kind, climb.kind)}, {climb.case}"
        last = climb.rungs[-1] if climb.rungs else None
        paper = PAPER_GAPS.get(climb.case, math.nan) if climb.kind == "gap" else math.nan
        failed = last.size if last and last.size > climb.largest else math.nan
        sizes = (climb.largest, climb.ever, paper, failed)
        rows.append((what, *(number(size, 2) for size in sizes)))
        if last and math.isfinite(failed):
            counted = sorted(last.reasons.items(), key=lambda item: -item[1])
            why = "; ".join(f"{reason} ({count})" for reason, count in counted)
            reasons.append(f"{what}, {number(failed, 2)} m: {why}.")
    return Sheet(
        title="Largest obstacles [m]",
        columns=("policy: obstacle", "crossed", "ever crossed", "paper, from video", "failed at"),
        rows=tuple(rows),
        notes=(
            f"crossed: in {crossings.settings['enough']} or more of {crossings.settings['runs']} "
            "runs, as were all smaller ones. ever: in any run. The paper's gaps were judged "
            "from video of jumps over flat floor, not crossed.",
            *reasons,
        ),
    )


def crossing_part(
    crossings: Results, *, anchor: str, title: str = "Crossing gaps and steps"
) -> Part:
    """The crossings as a part of a page."""
    where, first = place(crossings), crossings.subjects[0].name
    own = [c for c in climbs(crossings) if c.policy == first and c.kind == "gap"]
    reached = ", ".join(f"{number(climb.largest, 2)} m ({climb.case})" for climb in own)
    drawn = Block(
        anchor="sizes",
        title="Growing, until it fails",
        lines=(
            "Real gaps and steps in the floor; somebody who sees the robot from outside has it "
            "jump. Share of runs that crossed, with the lead that did best.",
        ),
        picture=shell.picture(
            lines(
                panels(crossings),
                across=len(crossings.cases),
                mark="paper, hardware: widest gap, from video",
                bar="95 % interval",
                sharex="row",
            ),
            f"Share of runs in which the {where} crossed an obstacle, over its size",
        ),
        sheets=(table(crossings),),
    )
    return part(
        [drawn],
        anchor=anchor,
        title=title,
        says=f"{first}, {where}: gaps crossed {reached}." if own else f"{first}, {where}.",
        origin=crossings,
    )
