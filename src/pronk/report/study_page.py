"""Page of a study: comparisons, outcomes of every arm on every robot, seed by seed."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from pronk.files import write_text
from pronk.jump.study.outcomes import OUTCOMES
from pronk.jump.study.study_results import (
    STUDY_FILE,
    ComparedArms,
    comparison_table,
    estimate_text,
    load_study_results,
    outcome_tables,
    seed_table,
)
from pronk.report.page import Part, page
from pronk.report.study_figures import draw_robots, draw_tolerance, has_robots, has_series
from pronk.report.style import picture
from pronk.tables import counted

PAGE = "report.html"


def comparison_sentence(comparison: ComparedArms) -> str:
    """Return what a comparison says, in one sentence."""
    definition = OUTCOMES[comparison.outcome]
    text = estimate_text(
        comparison.value, comparison.low, comparison.high, comparison.outcome, signed=True
    )
    name = comparison.name.replace("_", " ")
    if comparison.outcome.replace("_", " ") not in name:
        title = f"{name} ({comparison.outcome_words})"
    elif comparison.commands:
        title = f"{name} ({', '.join(comparison.commands)})"
    else:
        title = name
    compared = (
        f"{title}: {comparison.arm} less {comparison.against}, on {', '.join(comparison.robots)}"
    )
    if not math.isfinite(comparison.value):
        return f"{compared}: {comparison.verdict}."
    return f"{compared}: {text} {definition.unit}, {comparison.verdict}."


def study_part(path: Path) -> Part:
    """Make the part of the study in `path`, a `study.json`."""
    results = load_study_results(path)
    decided = 0
    for comparison in results.comparisons:
        decided += comparison.verdict in ("more", "less")
    policies = 0
    for arm in results.tried_arms:
        cells = [cell for cell in results.cells if cell.arm == arm]
        policies += max((len(cell.by_seed) for cell in cells), default=0)
    arms = counted(len(results.tried_arms), "arm")
    if len(results.tried_arms) < len(results.arms):
        arms = f"{len(results.tried_arms)} of {counted(len(results.arms), 'arm')}"
    summary = (
        f"{results.title}: {arms}, "
        f"{counted(policies, 'policy', 'policies')}, {counted(len(results.robots), 'robot')}"
    )
    if results.comparisons:
        comparisons = counted(len(results.comparisons), "comparison")
        summary += f"; {decided} of {comparisons} with a clear difference"
    summary += "."
    tables = outcome_tables(results)
    seed_tables = [seed_table(results, outcome) for outcome in results.outcomes]
    content = {
        "results": results,
        "sentences": [comparison_sentence(comparison) for comparison in results.comparisons],
        "comparisons": comparison_table(results),
        "outcomes": [table for table in tables if not table.is_detail],
        "series": [table for table in tables if table.is_detail],
        "seeds": seed_tables,
        "robots": picture(draw_robots(results, results.outcomes)) if has_robots(results) else "",
        "tolerance": picture(draw_tolerance(results)) if has_series(results) else "",
    }
    return Part(
        kind="study",
        title="Study",
        virtual=results.virtual,
        summary=summary,
        warning=bool(results.missing or results.mixed_versions),
        content=content,
        figures={"comparisons": results.comparisons, "missing": results.missing},
    )


def write_study_page(folder: Path) -> Path:
    """Write the page of the study in a folder, `report.html`, and return its path."""
    part = replace(study_part(folder / STUDY_FILE), source=STUDY_FILE)
    path = folder / PAGE
    write_text(path, page(part.title, [part]))
    return path
