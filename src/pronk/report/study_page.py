"""Page of a study: comparisons, outcomes of every arm on every robot, seed by seed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as MplFigure

from pronk.files import write_text
from pronk.jump.study.outcomes import OUTCOMES
from pronk.jump.study.study_results import (
    STUDY_FILE,
    ComparedArms,
    OutcomeCell,
    StudyResults,
    comparison_table,
    estimate_text,
    load_study_results,
    outcome_table,
    seed_table,
)
from pronk.report.page import Part, page
from pronk.report.style import drawing, key, legend, picture
from pronk.report.trial_figures import looks, offsets

PAGE = "report.html"


def draw_study(results: StudyResults) -> MplFigure:
    """Draw every outcome of every arm: a row an outcome; robots, and each series, are columns.

    Filled marks are means over seeds with 95 % intervals, small ones the means of single seeds.
    """
    columns: dict[str, list[OutcomeCell]] = {}
    for cell in results.cells:
        if cell.outcome == results.outcomes[0] and cell.arm == results.arms[0]:
            columns.setdefault(cell.series, []).append(cell)
    rows = len(results.outcomes)
    height = 2.2 * rows + 1.2
    with drawing(rows, len(columns), height=height, sharex="col", sharey="row") as drawn:
        figure, grid = drawn
        for column, (series, first_cells) in enumerate(columns.items()):
            robots = [cell.robot for cell in first_cells]
            places = np.arange(float(len(robots)))
            if series:
                places = np.array([cell.place or 0.0 for cell in first_cells])
                grid[-1, column].set_xlabel(series)
            else:
                grid[-1, column].set_xticks(places, robots, rotation=30, ha="right")
            for row, outcome in enumerate(results.outcomes):
                _draw_outcome(grid[row, column], results, outcome, robots, places)
                if column == 0:
                    grid[row, 0].set_ylabel(OUTCOMES[outcome].label)
        keys = []
        for arm, look in looks(list(results.arms)).items():
            keys.append(key(arm, linestyle="none", **look))
        legend(figure, keys)
    return figure


def _draw_outcome(
    axes: Axes, results: StudyResults, outcome: str, robots: Sequence[str], places: Any
) -> None:
    """Draw one outcome of all arms on some robots."""
    scale = OUTCOMES[outcome].scale
    step = float(np.min(np.diff(np.sort(places)))) if len(places) > 1 else 1.0
    shifts = offsets(len(results.arms), 0.5 * step)
    for shift, (arm, look) in zip(shifts, looks(list(results.arms)).items(), strict=True):
        for place, robot in zip(places, robots, strict=True):
            cell = results.cell(arm, robot, outcome)
            x = place + shift
            for value in cell.by_seed.values():
                if value is not None:
                    axes.plot(x, scale * value, ".", color=look["color"], alpha=0.5, markersize=4)
            if math.isfinite(cell.low):
                axes.vlines(x, scale * cell.low, scale * cell.high, color=look["color"])
            if math.isfinite(cell.value):
                axes.plot(x, scale * cell.value, linestyle="none", **look)


def comparison_sentence(comparison: ComparedArms) -> str:
    """Return what a comparison says, in one sentence."""
    definition = OUTCOMES[comparison.outcome]
    text = estimate_text(
        comparison.value, comparison.low, comparison.high, comparison.outcome, signed=True
    )
    outcome = comparison.outcome.replace("_", " ")
    return (
        f"{comparison.name}: {outcome} of {comparison.arm} less {comparison.against}, on "
        f"{', '.join(comparison.robots)}: {text} {definition.unit}, {comparison.verdict}."
    )


def study_part(path: Path) -> Part:
    """Make the part of the study in `path`, a `study.json`."""
    results = load_study_results(path)
    decided = 0
    for comparison in results.comparisons:
        decided += comparison.verdict in ("more", "less")
    policies = 0
    for arm in results.arms:
        cells = [cell for cell in results.cells if cell.arm == arm]
        policies += max((len(cell.by_seed) for cell in cells), default=0)
    summary = (
        f"{results.title}: {len(results.arms)} arms, {policies} policies, {len(results.robots)} "
        f"robots; {decided} of {len(results.comparisons)} comparisons with a clear difference."
    )
    seed_tables = [seed_table(results, outcome) for outcome in results.outcomes]
    content = {
        "results": results,
        "sentences": [comparison_sentence(comparison) for comparison in results.comparisons],
        "comparisons": comparison_table(results),
        "outcomes": [outcome_table(results, outcome) for outcome in results.outcomes],
        "seeds": seed_tables,
        "drawing": picture(draw_study(results)),
    }
    return Part(
        kind="study",
        title="Study",
        virtual=results.virtual,
        summary=summary,
        warning=bool(results.missing),
        content=content,
        figures={"comparisons": results.comparisons, "missing": results.missing},
    )


def write_study_page(folder: Path) -> Path:
    """Write the page of the study in a folder, `report.html`, and return its path."""
    part = replace(study_part(folder / STUDY_FILE), source=STUDY_FILE)
    path = folder / PAGE
    write_text(path, page(part.title, [part]))
    return path
