"""Sections that `python -m benchmarks study` writes: also of a study that is not finished."""

from __future__ import annotations

import math
from pathlib import Path

from benchmarks.study import study
from pronk.jump.study.config import StudyConfig, load_study
from pronk.jump.study.study_results import (
    OTHER_ROBOT,
    OWN_ROBOT,
    ComparedArms,
    OutcomeCell,
    StudyResults,
    save_study,
)

ROOT = Path(__file__).parents[2]
STUDY = ROOT / "examples" / "studies" / "match_worth" / "study.yaml"
PLACES = (0.5, 1.0, 1.5)
"""Points of a series of conditions."""
MOST_WORDS = 900
"""Most words of a page of docs (tests/unit/test_docs.py)."""


def results_of(config: StudyConfig, finished: tuple[str, ...]) -> StudyResults:
    """Return results of a study of which some arms are finished, all with the same numbers."""
    robots = [name for name, robot in config.robots.items() if robot.conditions is None]
    points = [f"tolerance: torque {place:g}" for place in PLACES]
    cells = []
    missing = []
    for arm in config.arms:
        for robot in (*robots, *points):
            is_point = robot in points
            if arm not in finished:
                missing += [f"{arm}, seed {seed}, on {robot}" for seed in config.seed_numbers]
            for outcome in config.outcomes:
                has_value = arm in finished
                cells.append(
                    OutcomeCell(
                        arm=arm,
                        robot=robot,
                        series="torque [1]" if is_point else "",
                        place=PLACES[points.index(robot)] if is_point else None,
                        outcome=outcome,
                        value=0.9 if has_value else math.nan,
                        low=0.8 if has_value else math.nan,
                        high=1.0 if has_value else math.nan,
                        by_seed={"1": 0.9, "2": 0.9} if has_value else {},
                        jumps=100 if has_value else 0,
                    )
                )
    comparisons = []
    for name, comparison in config.comparisons.items():
        has_value = set(comparison.arms) <= set(finished)
        words = (OWN_ROBOT, OTHER_ROBOT) if comparison.own else comparison.sides
        comparisons.append(
            ComparedArms(
                name=name,
                outcome=comparison.outcome,
                arm=words[0],
                against=words[1],
                robots=comparison.robots or tuple(comparison.own.values()),
                value=0.1 if has_value else math.nan,
                low=0.05 if has_value else math.nan,
                high=0.15 if has_value else math.nan,
                seeds=tuple(5 if arm in finished else 0 for arm in comparison.arms),
                counted_arms=comparison.arms,
                primary=comparison.primary,
            )
        )
    return StudyResults(
        title=config.title,
        robot="mini_cheetah",
        arms=tuple(config.arms),
        robots=(*robots, *points),
        outcomes=config.outcomes,
        commands=("forward 1",),
        jumps=10,
        robot_jumps={**dict.fromkeys(robots, 10), **dict.fromkeys(points, 2)},
        trial_seed=0,
        cells=tuple(cells),
        comparisons=tuple(comparisons),
        missing=tuple(missing),
        versions={"pronk": "0.1.0", "sources": "0123456789ab and ba9876543210"},
    )


def written_page(results: StudyResults, tmp_path: Path) -> str:
    """Write the pages of a study; return the one with the questions."""
    pages = []
    for name in ("match-worth.md", "evidence.md"):
        pages.append(tmp_path / name)
    source = ROOT / "docs" / "match-worth.md"
    pages[0].write_text(source.read_text(encoding="utf-8"), encoding="utf-8")
    pages[1].write_text("<!-- the study -->\n<!-- end of the study -->\n", encoding="utf-8")
    save_study(tmp_path / "study.json", results)
    study(tmp_path, docs=pages[0], evidence=pages[1], keep=tmp_path / "kept" / "results.json")
    assert (tmp_path / "kept" / "results.json").is_file()
    return pages[0].read_text(encoding="utf-8")


def test_a_study_in_parts_is_written_with_what_is_missing_by_arm(tmp_path: Path) -> None:
    """The first 15 of 40 trainings: the names of all missing trials are more than a page takes."""
    config = load_study(STUDY)
    finished = ("nominal", "joint", "joint to weak")
    results = results_of(config, finished)
    page = written_page(results, tmp_path)
    assert len(page.split()) <= MOST_WORDS
    trials = len(results.robots) * len(config.seed_numbers)
    for arm in config.arms:
        assert (f"{arm} {trials}" in page) == (arm not in finished), arm
    # A question whose arms are not there has no number.
    assert "- %" not in page
    assert "+10.0 (+5.0 to +15.0) %" in page
    assert results.mixed_versions in page
    assert "2 on 3 of the 9 robots" in page


def test_a_finished_study_has_no_word_of_missing_trials(tmp_path: Path) -> None:
    config = load_study(STUDY)
    page = written_page(results_of(config, tuple(config.arms)), tmp_path)
    assert len(page.split()) <= MOST_WORDS
    assert "missing" not in page.partition("<!-- the study -->")[2]
