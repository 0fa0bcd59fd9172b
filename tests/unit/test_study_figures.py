"""Figures of a study draw the numbers of its results: means, intervals, seeds and bands."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes

from pronk.jump.study.study_results import (
    ComparedArms,
    OutcomeCell,
    StudyResults,
    comparison_table,
    load_study_results,
    outcome_tables,
    save_study,
)
from pronk.report.study_figures import SEED_MARKER, arm_looks, draw_robots, draw_tolerance
from pronk.report.study_page import study_part, write_study_page
from pronk.report.style import render

TORQUE = "torque [times nominal]"
DELAY = "delay [s]"
POINTS = {TORQUE: (1.0, 0.5, 1.7), DELAY: (0.0, 0.02)}
"""Places of the series, not in their order."""
ARMS = ("nominal", "matched")


def known_cell(arm: str, robot: str, outcome: str, **changes: object) -> OutcomeCell:
    """Return a cell whose numbers follow from its place and its names."""
    value = 0.5 + 0.1 * ARMS.index(arm) + (0.2 if outcome == "height" else 0.0)
    fields: dict[str, object] = {
        "arm": arm,
        "robot": robot,
        "outcome": outcome,
        "value": value,
        "low": value - 0.15,
        "high": value + 0.05,
        "by_seed": {"1": value - 0.1, "2": value + 0.1, "3": None},
        "jumps": 10,
        **changes,
    }
    return OutcomeCell(**fields)  # type: ignore[arg-type]


@pytest.fixture
def results() -> StudyResults:
    """Two arms on two robots, and in two series; the second arm is not on the second robot."""
    cells = []
    robots = ["shipped", "weak"]
    for series, places in POINTS.items():
        robots += [f"t: {series} {place:g}" for place in places]
    for arm in ARMS:
        for outcome in ("landed", "height"):
            cells.append(known_cell(arm, "shipped", outcome))
            if arm == "nominal":
                cells.append(known_cell(arm, "weak", outcome, low=math.nan, high=math.nan))
            for series, places in POINTS.items():
                for place in places:
                    name = f"t: {series} {place:g}"
                    value = 0.3 + 0.2 * place
                    cells.append(
                        known_cell(
                            arm,
                            name,
                            outcome,
                            series=series,
                            place=place,
                            value=value,
                            low=value - 0.1,
                            high=value + 0.2,
                        )
                    )
    compared = ComparedArms(
        name="a match", outcome="landed", arm="matched", against="nominal", robots=("shipped",)
    )
    return StudyResults(
        title="Known",
        robot="mini_cheetah",
        arms=ARMS,
        robots=tuple(robots),
        outcomes=("landed", "height"),
        commands=("forward 1",),
        jumps=5,
        trial_seed=0,
        cells=tuple(cells),
        comparisons=(compared,),
    )


def marks(axes: Axes, marker: str) -> list[tuple[float, float]]:
    """Return the points of all lines of an axis that have a marker."""
    points = []
    for line in axes.lines:
        if line.get_marker() == marker:
            for x, y in np.asarray(line.get_xydata(), dtype=float):
                points.append((float(x), float(y)))
    return points


def test_robots_show_means_seeds_and_intervals(results: StudyResults) -> None:
    figure = draw_robots(results, results.outcomes)
    landed, height = figure.axes
    looks = arm_looks(ARMS)
    ((nominal_x, nominal_y), (weak_x, weak_y)) = marks(landed, looks["nominal"]["marker"])
    ((matched_x, matched_y),) = marks(landed, looks["matched"]["marker"])
    assert (nominal_y, weak_y, matched_y) == pytest.approx((50.0, 50.0, 60.0))
    assert nominal_x < 0.0 < matched_x < 0.5 < weak_x < 1.0
    seeds = marks(landed, SEED_MARKER)
    assert sorted(y for _, y in seeds) == pytest.approx([40, 40, 50, 60, 60, 70])
    intervals = []
    for collection in landed.collections:
        for segment in collection.get_segments():  # type: ignore[attr-defined]
            intervals.append(tuple(segment[:, 1]))
    # None of the weak robot, whose interval is not known.
    assert np.allclose(sorted(intervals), [(35.0, 55.0), (45.0, 65.0)])
    assert max(y for _, y in marks(height, looks["matched"]["marker"])) == pytest.approx(0.8)
    assert [label.get_text() for label in height.get_xticklabels()] == ["shipped", "weak"]


@pytest.mark.parametrize("arm_count", [1, 2, 8, 16])
def test_seeds_stand_beside_the_mark_of_their_arm_and_no_two_at_one_place(
    results: StudyResults, arm_count: int
) -> None:
    """Also seeds of one value, and seeds on the line of the interval."""
    arms = tuple(f"arm {number}" for number in range(arm_count))
    cells = []
    for arm in arms:
        for robot in ("shipped", "weak"):
            cells.append(
                OutcomeCell(
                    arm=arm,
                    robot=robot,
                    outcome="landed",
                    value=0.8,
                    low=0.6,
                    high=1.0,
                    by_seed={"1": 0.8, "2": 0.8, "3": 0.8, "4": None},
                    jumps=10,
                )
            )
    study = replace(results, arms=arms, cells=tuple(cells), outcomes=("landed",))
    (axes,) = draw_robots(study, study.outcomes).axes
    lines = []
    for collection in axes.collections:
        for segment in collection.get_segments():  # type: ignore[attr-defined]
            lines.append(segment[0, 0])
    seeds = [x for x, _ in marks(axes, SEED_MARKER)]
    assert len(lines) == 2 * arm_count
    assert len(seeds) == 3 * len(lines)
    # In the order of their places each mark is followed by its own seeds.
    owners = ["line" for _ in lines] + ["seed" for _ in seeds]
    in_order = sorted(zip(lines + seeds, owners, strict=True))
    assert [owner for _, owner in in_order] == ["line", "seed", "seed", "seed"] * len(lines)
    places = [place for place, _ in in_order]
    assert min(np.diff(places)) > 0.002
    for line in axes.lines:
        if line.get_marker() == SEED_MARKER:
            assert line.get_alpha() in (None, 1.0)


def test_a_share_has_no_axis_far_beyond_its_bounds(results: StudyResults) -> None:
    landed, _ = draw_robots(results, results.outcomes).axes
    low, high = landed.get_ylim()
    assert -5.0 <= low < 35.0
    assert 70.0 < high <= 105.0


def test_tolerance_has_a_row_an_outcome_a_column_a_series_and_a_line_an_arm(
    results: StudyResults,
) -> None:
    figure = draw_tolerance(results)
    grid = np.array(figure.axes).reshape(2, 2)
    assert [axes.get_xlabel() for axes in grid[-1]] == [TORQUE, DELAY]
    assert [axes.get_ylabel() for axes in grid[:, 0]] == ["landed [%]", "height [m]"]
    for axes in grid.flat:
        assert len(axes.lines) == len(ARMS)
        assert len(axes.collections) == len(ARMS)
    # In the order of the places, in percent.
    line = grid[0, 0].lines[0]
    assert np.allclose(line.get_xdata(), [0.5, 1.0, 1.7])
    assert np.allclose(line.get_ydata(), [40.0, 50.0, 64.0])
    band = grid[0, 0].collections[0].get_paths()[0].vertices
    at_half = band[band[:, 0] == 0.5][:, 1]
    assert (at_half.min(), at_half.max()) == pytest.approx((30.0, 60.0))
    legend = figure.legends[0]
    assert [text.get_text() for text in legend.get_texts()] == list(ARMS)


def test_arms_that_are_not_tried_in_series_have_no_line(results: StudyResults) -> None:
    kept = [cell for cell in results.cells if not cell.series or cell.arm == "matched"]
    figure = draw_tolerance(replace(results, cells=tuple(kept)))
    assert all(len(axes.lines) == 1 for axes in figure.axes)
    (line,) = figure.axes[0].lines
    # The colour of an arm is the same in both figures.
    assert line.get_color() == arm_looks(ARMS)["matched"]["color"]


def test_no_two_of_24_arms_look_alike() -> None:
    looks = arm_looks([str(number) for number in range(24)])
    seen = {(look["color"], look["marker"], str(look["linestyle"])) for look in looks.values()}
    assert len(seen) == 24


def test_the_same_results_give_the_same_file(results: StudyResults) -> None:
    assert render(draw_tolerance(results)) == render(draw_tolerance(results))


def test_tables_separate_robots_from_series(results: StudyResults) -> None:
    tables = outcome_tables(results)
    assert [len(table.rows) for table in tables] == [2, 2, 5, 5]
    by_robot = {row[0]: row[1:] for row in tables[0].rows}
    assert str(by_robot["shipped"][0]).startswith("50.0 (35.0 to 55.0)")
    assert by_robot["weak"][1] == "-"


def test_a_table_says_where_arms_have_values_of_unequal_shares(results: StudyResults) -> None:
    """The mean height of an arm that jumps with easy commands only is no mean over all of them."""

    def notes(counts: dict[str, tuple[int, int]]) -> str:
        cells = []
        for cell in results.cells:
            if cell.robot == "shipped" and cell.outcome == "height":
                with_value, jumps = counts[cell.arm]
                cell = replace(cell, jumps=jumps, jumps_with_value=with_value)
            cells.append(cell)
        table = outcome_tables(replace(results, cells=tuple(cells)))[1]
        return " ".join(table.notes)

    uneven = notes({"nominal": (3, 10), "matched": (10, 10)})
    assert "on shipped nominal 3 of 10, matched 10 of 10" in uneven
    # Commands without a value are those of all arms; arms may have other numbers of seeds.
    assert "of 10" not in notes({"nominal": (8, 10), "matched": (16, 20)})


def test_a_table_says_where_the_drives_did_not_hold_the_robot_up(results: StudyResults) -> None:
    """Such jumps are counted as not landed, but they say nothing about the policies."""
    cells = []
    for cell in results.cells:
        if cell.robot == "shipped":
            with_value = 10 if cell.outcome == "landed" else 6
            cell = replace(cell, jumps=10, jumps_with_value=with_value, jumps_not_standing=4)
        cells.append(cell)
    landed, height = outcome_tables(replace(results, cells=tuple(cells)))[:2]
    assert "8 of 20 on shipped" in " ".join(landed.notes)
    # A jump that did not happen has no height, so that none is counted as one of zero.
    assert "on shipped" not in " ".join(height.notes)


def test_tables_have_no_column_of_an_arm_that_is_not_tried_yet(results: StudyResults) -> None:
    nominal, matched = results.arms
    cells = []
    for cell in results.cells:
        if cell.arm == matched:
            cell = replace(cell, jumps=0, value=math.nan, low=math.nan, high=math.nan, by_seed={})
        cells.append(cell)
    partial = replace(results, cells=tuple(cells))
    assert results.tried_arms == (nominal, matched)
    assert partial.tried_arms == (nominal,)
    for table in outcome_tables(partial):
        assert [column.heading for column in table.columns] == ["robot", nominal]
    text = render(draw_robots(partial, partial.outcomes))
    assert text != render(draw_robots(results, results.outcomes))


def test_the_page_has_both_figures(results: StudyResults, tmp_path: Path) -> None:
    save_study(tmp_path / "study.json", results)
    assert load_study_results(tmp_path / "study.json").cells[0] == results.cells[0]
    part = study_part(tmp_path / "study.json")
    assert part.content["robots"]
    assert part.content["tolerance"]
    assert write_study_page(tmp_path).read_text().count("data:image/svg+xml") == 2


def test_a_page_of_one_of_everything_has_no_plural_of_it(
    results: StudyResults, tmp_path: Path
) -> None:
    """One arm, policy, robot, comparison, command, jump, seed; one trial that is missing."""
    cell = known_cell("nominal", "shipped", "landed", by_seed={"1": 0.5}, jumps=1)
    lone = replace(
        results,
        arms=("nominal",),
        robots=("shipped",),
        outcomes=("landed",),
        cells=(cell,),
        jumps=1,
        missing=("nominal, seed 2, on shipped",),
    )
    save_study(tmp_path / "study.json", lone)
    text = re.sub("<[^>]*>", " ", write_study_page(tmp_path).read_text().partition("<body")[2])
    summary = study_part(tmp_path / "study.json").summary
    for noun in ("arm", "policy", "robot", "comparison"):
        assert f"1 {noun}" in summary
    plurals = "arms|policies|robots|comparisons|trials|commands|jumps|seeds|outcomes"
    assert re.findall(rf"(?<![\d.,])1 (?:{plurals})\b", f"{text} {summary}") == []
    save_study(tmp_path / "study.json", results)
    assert "2 arms" in study_part(tmp_path / "study.json").summary


def test_primary_comparisons_come_first(results: StudyResults) -> None:
    (second,) = results.comparisons
    first = ComparedArms(
        name="asked", outcome="landed", arm="a", against="b", robots=("weak",), primary=True
    )
    changed = replace(results, comparisons=(second, first))
    assert [row[:2] for row in comparison_table(changed).rows] == [
        ("primary", "asked"),
        ("secondary", "a match"),
    ]


def test_tables_say_why_a_single_seed_has_no_interval(
    results: StudyResults, tmp_path: Path
) -> None:
    lone = {"low": math.nan, "high": math.nan, "by_seed": {"1": 0.4, "2": None}, "value": 0.4}
    changed = []
    for cell in results.cells:
        is_lone = (cell.arm, cell.robot) == ("matched", "shipped")
        changed.append(replace(cell, **lone) if is_lone else cell)
    few = replace(results, cells=tuple(changed))
    (table, *_) = outcome_tables(few)
    by_robot = {row[0]: row[1:] for row in table.rows}
    assert str(by_robot["shipped"][1]).startswith("40.0, 1 seed")
    (note,) = [note for note in table.notes if "n = 1" in note]
    assert "matched on shipped" in note
    assert "nominal" not in note
    for table in outcome_tables(results):
        assert not any("n = 1" in note for note in table.notes)
    save_study(tmp_path / "study.json", few)
    assert "n = 1" in write_study_page(tmp_path).read_text()
