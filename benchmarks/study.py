"""A study on the documentation's pages: figures, and sections that are written from its results.

    python -m benchmarks study runs/match_worth --docs docs/match-worth.md --keep results.json

`study.json`, which `pronk study` writes, is all that is read. The page gets the questions with
their answers and the figures; `--evidence` names a page for all tables.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import tyro

from benchmarks.runner import write_section
from pronk.cli import console
from pronk.errors import PronkError
from pronk.jump.study.study_results import (
    STUDY_FILE,
    StudyResults,
    comparison_table,
    load_study_results,
    outcome_table,
    outcome_tables,
)
from pronk.report.study_figures import draw_robots, draw_tolerance, has_robots, has_series
from pronk.report.study_page import comparison_sentence
from pronk.report.style import save_figure
from pronk.tables import Table, counted

SECTION = "the study"
"""Name of the sections of both pages."""
ROBOTS_FIGURE = "match-worth.svg"
TOLERANCE_FIGURE = "match-worth-tolerance.svg"


def markdown(table: Table) -> str:
    """Return a table in Markdown, with its title above and its notes below."""
    lines = [table.title, ""]
    headings = [column.title for column in table.columns]
    for row in (headings, ["---"] * len(headings), *table.text_rows()):
        lines.append("| " + " | ".join(text.replace("|", "\\|") for text in row) + " |")
    for note in table.notes:
        lines += ["", note]
    return "\n".join(lines)


def study_section(results: StudyResults, command: str, figures: str) -> str:
    """Return the section of a page: questions and answers, and the figures.

    Without figures the first outcome is a table; a page with both is too long.

    Args:
        results: The study.
        command: Command line that measured it.
        figures: Folder of the figures, relative to the page; empty without figures.
    """
    versions = ", ".join(f"{name} {version}" for name, version in results.versions.items())
    parts = [
        f"Measured by `{command}` on pronk's virtual robot: {_arms_text(results)}, "
        f"{len(results.commands)} commands, {_jumps_text(results)} with each of every policy on a "
        f"robot ({versions})."
    ]
    sentences = []
    for comparison in results.comparisons:
        if comparison.primary:
            sentences.append(f"- {comparison_sentence(comparison)}")
    if sentences:
        parts.append("\n".join(sentences))
    outcome = results.outcomes[0]
    if has_robots(results):
        if figures:
            words = f"{outcome.replace('_', ' ').capitalize()} by arm and robot, with intervals"
            parts.append(f"![{words}]({figures}/{ROBOTS_FIGURE})")
        else:
            parts.append(markdown(outcome_table(results, outcome)))
    if has_series(results) and figures:
        words = "Outcomes of each arm over torque, delay, friction and gain error, with intervals"
        parts.append(f"![{words}]({figures}/{TOLERANCE_FIGURE})")
    parts += _missing(results)
    return "\n\n".join(parts)


def evidence_section(results: StudyResults, command: str) -> str:
    """Return the section of the page of evidence: all comparisons and all tables."""
    parts = [f"Measured by `{command}`."]
    if results.comparisons:
        parts.append(markdown(comparison_table(results)))
    for table in outcome_tables(results):
        parts.append(markdown(table))
    parts += _missing(results)
    return "\n\n".join(parts)


def _arms_text(results: StudyResults) -> str:
    """Return the number of arms of which policies were tried, and of all if it is another one."""
    tried = len(results.tried_arms)
    if tried == len(results.arms):
        return counted(tried, "arm")
    return f"{tried} of {counted(len(results.arms), 'arm')}"


def _jumps_text(results: StudyResults) -> str:
    """Return the number of jumps with each command, and on how many robots it is another one."""
    counts: dict[int, int] = {}
    for jumps in results.robot_jumps.values():
        if jumps != results.jumps:
            counts[jumps] = counts.get(jumps, 0) + 1
    text = f"{results.jumps} jumps"
    if counts:
        exceptions = []
        for jumps, robots in counts.items():
            exceptions.append(f"{jumps} on {robots} of the {len(results.robots)} robots")
        text += f" ({', '.join(exceptions)})"
    return text


def _missing(results: StudyResults) -> list[str]:
    """Return sentences on what is missing, by arm, and on versions that are mixed, if there are."""
    parts = []
    if results.missing:
        by_arm = []
        for arm in results.arms:
            # Names of trials begin with those of their arm.
            count = sum(name.startswith(f"{arm}, seed ") for name in results.missing)
            if count:
                by_arm.append(f"{arm} {count}")
        parts.append(f"{counted(len(results.missing), 'trial')} missing: {', '.join(by_arm)}.")
    parts += results.failed
    if results.mixed_versions:
        parts.append(results.mixed_versions)
    return parts


def study(
    results: tyro.conf.Positional[Path],
    docs: Path | None = None,
    evidence: Path | None = None,
    keep: Path | None = None,
    command: str = "pronk study examples/studies/match_worth/study.yaml --gpus all",
) -> console.Outcome:
    """Write the sections and figures of pages from the results of a study.

    Args:
        results: study.json, or the folder of a study.
        docs: Page whose section of the study is written; its figures go to figures/ beside it.
        evidence: Page whose section of the study gets all tables.
        keep: File that the results are copied to, from which the figures can be drawn again.
        command: Command line that measured the study.
    """
    path = results / STUDY_FILE if results.is_dir() else results
    loaded = load_study_results(path)
    pages = [page for page in (docs, evidence) if page is not None]
    for page in pages:
        if not page.is_file():
            raise PronkError(f"{page}: no such page; expected one with a section of {SECTION}.")
    wrote = []
    section = study_section(loaded, command, "figures")
    if docs is not None:
        write_section(docs, SECTION, section)
        wrote.append(docs)
        folder = docs.parent / "figures"
        folder.mkdir(exist_ok=True)
        if has_robots(loaded):
            figure = draw_robots(loaded, loaded.outcomes[:1])
            wrote.append(save_figure(figure, folder / ROBOTS_FIGURE))
        if has_series(loaded):
            wrote.append(save_figure(draw_tolerance(loaded), folder / TOLERANCE_FIGURE))
    if evidence is not None:
        write_section(evidence, SECTION, evidence_section(loaded, command))
        wrote.append(evidence)
    if keep is not None and keep.resolve() != path.resolve():
        keep.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, keep)
        wrote.append(keep)
    console.say_verbatim(section)
    return console.Outcome(figures={"comparisons": loaded.comparisons}, wrote=wrote)
