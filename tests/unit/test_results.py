"""Sums over jumps, their files, and the tables made of them."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from pronk.errors import ArtefactError
from pronk.jump.trial import tables
from pronk.jump.trial.criteria import trial_checks, walk_checks
from pronk.jump.trial.jumps import (
    ApproachFigures,
    FlightFigures,
    JumpFigures,
    JumpRules,
    LoadFigures,
)
from pronk.jump.trial.protocol import PAPER_COMMANDS, PAPER_RATIOS, TABLE_III, Case
from pronk.jump.trial.results import (
    JUMPS,
    TrialResults,
    load_results,
    ratio_of_scatter,
    save_results,
)
from report_cases import ROBOT, crossings, of_kind, row, subject, walks

HEIGHTS = (0.40, 0.44, 0.48)
MISSED = JumpFigures(standing=True, fell=True, height=0.05, loads=LoadFigures(energy=1.0))


def jump(height: float) -> JumpFigures:
    """A jump with every figure known but the gap, most of them made of the height."""
    joints = tuple(height * index for index in range(12))
    return JumpFigures(
        standing=True,
        found=True,
        upright=True,
        height=height,
        flights=height + 1,
        high_flights=height + 2,
        flight=FlightFigures(
            apex_gain=height + 3,
            rise=height + 4,
            ballistic=height + 5,
            clearance=height + 6,
            clearance_half=height + 7,
            distance=2.0 * height,
            along=height + 8,
            distance_minima=height + 9,
            lift_off_velocity=height + 10,
            horizontal_velocity=height + 11,
            delay=height + 12,
            duration=height + 13,
        ),
        approach=ApproachFigures(speed=height + 14, cost_of_transport=height + 15),
        loads=LoadFigures(
            energy=height + 16, peak_torque=joints, peak_speed=joints, torque_margin=joints
        ),
    )


def trial(
    heights: dict[str, tuple[float, ...]] | None = None, cases: tuple[Case, ...] = PAPER_COMMANDS
) -> TrialResults:
    """One jump of each height, and one that failed, of every policy with every command."""
    if heights is None:
        heights = {"matched": HEIGHTS, "naive": (0.36, 0.44, 0.52)}
    rows = []
    for name, policy_heights in heights.items():
        for case in cases:
            jumps = [*map(jump, policy_heights), MISSED]
            for number, figures in enumerate(jumps):
                capture = "captures/a.npz" if number == 0 else ""
                run = row(name, case, number, figures, capture)
                script = replace(run.script, run_s=2.5 + number / 50)
                rows.append(replace(run, script=script, began=0.125))
    subjects = []
    for name in heights:
        subjects.append(subject(name, joint_names=[], stiffness=[], damping=[]))
    return of_kind(
        JUMPS,
        tuple(heights),
        cases=cases,
        subjects=tuple(subjects),
        rows=tuple(rows),
        rules=asdict(JumpRules.of(ROBOT)),
        timing={"seconds": 1.0},
        spread_s=0.5,
        mass=12.0,
    )


# --- Sums ---------------------------------------------------------------------------------------


def test_a_cell_by_hand() -> None:
    cell = trial().cell("matched", "forward 1")
    assert (cell.n, cell.standing, cell.found, cell.succeeded, cell.fell) == (4, 4, 3, 3, 1)
    assert cell.success == 0.75
    height = cell.figures["height"]
    # Only jumps that were found count: the fall of .05 m is not a height.
    assert height.n == 3
    assert height.mean == pytest.approx(0.44)
    assert height.std == pytest.approx(0.04)
    assert (height.minimum, height.p50, height.maximum) == pytest.approx(HEIGHTS)
    assert cell.figures["gap"].n == 0
    assert math.isnan(cell.figures["gap"].mean)
    assert cell.joints["peak_torque"]["FR_knee"].maximum == pytest.approx(2 * 0.48)


def landing_notes(*jumps: JumpFigures) -> str:
    """Return the notes below the landings of one policy's jumps with one command."""
    command = PAPER_COMMANDS[0]
    rows = []
    for number, figures in enumerate(jumps):
        rows.append(row("matched", command, number, figures))
    results = trial({"matched": (0.4,)}, (command,))
    return " ".join(tables.landings(replace(results, rows=tuple(rows))).notes)


@pytest.mark.parametrize(
    ("fell", "touch_press", "is_noted"),
    [
        (False, 1.4, True),
        # Not beyond its centre in some sample.
        (False, 0.6, False),
        # Another part than the shank of a pressed foot.
        (False, math.nan, False),
        (True, 1.4, False),
    ],
)
def test_touches_of_shanks_whose_feet_are_pressed_in_beyond_their_centre_are_noted(
    fell: bool, touch_press: float, is_noted: bool
) -> None:
    # In each of them a foot was pressed in deeply at some time.
    figures = replace(
        jump(0.4), non_foot_contact=True, fell=fell, foot_press=1.7, touch_press=touch_press
    )
    notes = landing_notes(figures)
    assert ("ground.stiffness" in notes) is is_noted
    assert ("1.4" in notes) is is_noted


def test_the_landings_say_what_touched_first_and_when() -> None:
    def touching(part: str, touch: float) -> JumpFigures:
        return replace(jump(0.4), non_foot_contact=True, touched_part=part, touch=touch)

    thigh = touching("RR_thigh", 0.09)
    trunk = touching("trunk", 0.76)
    notes = landing_notes(jump(0.4), trunk, thigh, thigh)
    assert "RR_thigh 2, trunk 1; 0.09 to 0.76 s after touchdown." in notes
    assert "negative" not in notes
    assert "trunk 1; 0.76 s after touchdown." in landing_notes(trunk)
    early = touching("RL_thigh+RR_thigh", -0.31)
    notes = landing_notes(early, trunk)
    assert "RL_thigh+RR_thigh 1, trunk 1; -0.31 to 0.76 s after touchdown" in notes
    assert "negative" in notes
    # Without a jump there is no touchdown.
    assert "1 jump without" in landing_notes(thigh, touching("trunk", math.nan))
    for figures in (jump(0.4), replace(jump(0.4), non_foot_contact=True)):
        assert "touched first" not in landing_notes(figures)


def test_the_ratio_is_that_of_the_mean_scatter() -> None:
    ratios = {}
    for ratio in trial().ratios:
        ratios[ratio.figure, ratio.case] = ratio
    height = ratios["height", "forward 1"]
    assert height.value == pytest.approx(2.0)
    assert height.n == (3, 3)
    distance = ratios["distance", None]
    assert distance.value == pytest.approx(2.0)
    assert distance.n == (15, 15)
    gap = ratios["gap", None]
    assert (gap.policy, gap.other) == ("matched", "naive")
    assert math.isnan(gap.value)


@pytest.mark.parametrize(("counts", "other_counts"), [([4], [5]), ([5], [4]), ([5, 4], [5, 5])])
def test_few_jumps_have_a_ratio_and_no_interval(counts: list[int], other_counts: list[int]) -> None:
    values = np.array([0.1, 0.2, 0.4, 0.7, 0.9])
    samples = []
    other_samples = []
    for count, other_count in zip(counts, other_counts, strict=True):
        samples.append(values[:count])
        other_samples.append(values[:other_count])
    value, low, high = ratio_of_scatter(samples, other_samples, seed=0, resamples=200)
    assert 0.5 < value < 2.0
    assert math.isnan(low)
    assert math.isnan(high)


def test_enough_jumps_have_an_interval() -> None:
    values = np.array([0.1, 0.2, 0.4, 0.7, 0.9])
    value, low, high = ratio_of_scatter([values], [2.0 * values], seed=0, resamples=200)
    assert 0.1 < low < value < high < 40.0


def test_without_scatter_or_with_one_jump_there_is_no_ratio() -> None:
    same = np.full(5, 0.3)
    some = np.arange(5.0)
    for sample, other in ((same, some), (some[:1], some), (some, some[:0])):
        ratio = ratio_of_scatter([sample], [other], seed=0, resamples=20)
        assert all(map(math.isnan, ratio))


def test_the_interval_covers_a_known_ratio() -> None:
    rng = np.random.default_rng(5)
    hits = 0
    for seed in range(60):
        samples = list(rng.normal(size=(3, 25)))
        other_samples = list(2.0 * rng.normal(size=(3, 25)))
        value, low, high = ratio_of_scatter(samples, other_samples, seed=seed, resamples=300)
        assert low <= value <= high
        if low <= 2.0 <= high:
            hits += 1
    # 95 % expected; fewer than 80 % of 60 would happen once in a million times.
    assert hits >= 0.8 * 60


def test_the_paper_s_ratios_follow_from_its_table() -> None:
    for figure, ratio in PAPER_RATIOS.items():
        summed_std = {"naive": 0.0, "matched": 0.0}
        for policy in summed_std:
            for _, std in TABLE_III[figure, policy].values():
                summed_std[policy] += std
        measured_ratio = summed_std["naive"] / summed_std["matched"]
        assert measured_ratio == pytest.approx(ratio, abs=5e-3)


# --- Files --------------------------------------------------------------------------------------


def test_a_saved_trial_is_loaded_as_it_was(tmp_path: Path) -> None:
    saved = trial()
    assert save_results(tmp_path, saved) == (tmp_path / "trials.csv", tmp_path / "summary.json")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["summary.json", "trials.csv"]
    loaded = load_results(tmp_path)
    # NaN is not equal to itself; the text of it is.
    for name in ("rows", "cells", "ratios"):
        assert repr(getattr(loaded, name)) == repr(getattr(saved, name)), name
    for name in ("subjects", "cases", "script", "seed", "sim_params", "rules", "mass", "versions"):
        assert getattr(loaded, name) == getattr(saved, name), name


@pytest.mark.parametrize("results", [walks(), crossings()])
def test_walks_and_crossings_are_loaded_as_they_were(results: TrialResults, tmp_path: Path) -> None:
    save_results(tmp_path, results)
    loaded = load_results(tmp_path, results.run_kind)
    assert repr((loaded.rows, loaded.cells)) == repr((results.rows, results.cells))


def test_a_trial_of_an_earlier_pronk_does_not_know_what_touched(tmp_path: Path) -> None:
    rows = []
    for run in trial().rows:
        changes = {"non_foot_contact": True, "touched_part": "trunk", "touch": 0.2}
        rows.append(replace(run, figures=replace(run.figures, **changes)))
    _, summary = save_results(tmp_path, replace(trial(), rows=tuple(rows)))
    assert load_results(tmp_path).rows[0].figures.touched_part == "trunk"
    body = json.loads(summary.read_text())
    for run in body["rows"]:
        for name in ("touched_part", "touch", "touch_press"):
            del run["figures"][name]
    summary.write_text(json.dumps(body))
    figures = load_results(tmp_path).rows[0].figures
    assert figures.non_foot_contact
    assert figures.touched_part == ""
    assert math.isnan(figures.touch)
    assert math.isnan(figures.touch_press)


def test_the_summary_is_strict_json(tmp_path: Path) -> None:
    save_results(tmp_path, trial())
    text = (tmp_path / "summary.json").read_text()
    body = json.loads(text, parse_constant=lambda name: pytest.fail(name))
    assert body["definitions"]["height"]["unit"] == "m"
    assert body["cells"][0]["figures"]["gap"]["mean"] is None


def test_the_table_has_every_figure_of_every_jump(tmp_path: Path) -> None:
    results = trial()
    save_results(tmp_path, results)
    table = list(csv.DictReader(io.StringIO((tmp_path / "trials.csv").read_text())))
    assert len(table) == len(results.rows) == 40
    assert table[0]["touched_part"] == table[0]["touch_s"] == ""
    landed = table[0]
    assert (landed["height_m"], landed["peak_torque_FR_knee_N_m"]) == ("0.4", "0.8")
    assert landed["success"] == "1"
    missed = table[3]
    assert (missed["success"], missed["fell"]) == ("0", "1")
    assert missed["distance_m"] == missed["peak_torque_FR_knee_N_m"] == ""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("pronk/trial/5", "pronk/trial/2", "pronk/trial/2"),
        ('"rows"', '"roses"', "damaged"),
        ('"height": 0.4', '"height": "tall"', "damaged"),
        ('"figures"', '"numbers"', "damaged"),
        ('"number": 3', '"number": null', "damaged"),
        ('"policy": "matched"', '"policy": "other"', "do not fit"),
        ("{", "", "cannot be read"),
        (None, "", "no such file"),
    ],
)
def test_a_damaged_trial_is_refused(
    tmp_path: Path, old: str | None, new: str, message: str
) -> None:
    _, path = save_results(tmp_path, trial())
    if old is None:
        path.unlink()
    else:
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))
    with pytest.raises(ArtefactError, match=message) as refusal:
        load_results(tmp_path)
    assert path.name in str(refusal.value)
    assert "\n" not in str(refusal.value)


# --- Tables -------------------------------------------------------------------------------------


def test_table_iii_stands_beside_ours() -> None:
    table = tables.paper_table(trial(), "distance")
    headings = [column.heading for column in table.columns]
    # In the paper's order, whichever was tried first.
    assert headings == [
        "command",
        "paper, naive",
        "paper, matched",
        "naive, virtual robot",
        "matched, virtual robot",
    ]
    assert table.rows[1] == (
        "forward 2",
        "0.944 +- 0.030",
        "0.969 +- 0.026",
        "0.880 +- 0.160 (3/4)",
        "0.880 +- 0.080 (3/4)",
    )
    assert table.rows[-1][1:] == ("+- 0.082", "+- 0.040", "+- 0.160", "+- 0.080")
    assert "virtual" in " ".join(table.notes)


def test_a_command_that_the_paper_has_not_and_a_policy_without_jumps_are_in_the_tables() -> None:
    sideways = Case(name="1.5,0", command=(1.5, 0.0, 0.0))
    results = trial({"matched": ()}, cases=(sideways, PAPER_COMMANDS[0]))
    table = tables.paper_table(results, "height")
    assert [cells[0] for cells in table.rows[:2]] == ["1.5,0", "forward 1"]
    assert table.rows[0] == ("1.5,0", "-", "-", "- (0/1)")
    titles = [table.title for table in tables.trial_tables(results)]
    assert titles[-1] == tables.DEFINITIONS


def test_no_table_shows_a_label_of_the_checklist() -> None:
    for table in tables.trial_tables(trial()):
        text = " ".join([table.title, *table.notes, *map(" ".join, table.text_rows())])
        for label in ("A16", "A17", "A21", "E2", "E5", "R2"):
            assert label not in text.split(), table.title
            assert f"({label}" not in text
            assert f"{label})" not in text


def test_the_tables_of_walks_and_crossings() -> None:
    walked = tables.walk_table(walks(), "naive")
    assert walked.rows[:2] == (("walks", 2), ("fell", 1))
    assert ("lasted [s]", "20.00 +- 0.00") in walked.rows
    crossed = tables.crossing_table(crossings())
    assert crossed.rows[0] == ("matched: gap, forward 2", 0.2, 0.2, 0.55, 0.4)
    assert "a foot was in the gap (5)" in crossed.notes[1]


def test_criteria_by_hand() -> None:
    checks = {check.name: check for check in trial_checks(trial())}
    assert checks["forward 2: height"].passed  # .44 against .244
    for failed in (
        "forward 2: height, std",  # .04 against .013
        "forward 2: distance",  # .88 against .969
        "forward 2: gap",  # not measured
        "forward 2: success",  # .75 against .95
        "best: height",  # .44 against .45
    ):
        assert not checks[failed].passed
    assert trial_checks(trial({"matched": (0.45, 0.46)}))[-1].passed
    # Five commands of height, its scatter, distance, its scatter and success; four gaps; the best.
    assert len(checks) == 5 * 5 + 4 + 1


def test_a_go2_has_its_own_criteria_and_no_column_of_the_paper() -> None:
    go2 = replace(trial(), robot="go2")
    checks = {check.name: check for check in trial_checks(go2)}
    assert set(checks) == {"all: success", "best: height", "best: gap"}
    assert checks["all: success"].value == pytest.approx(0.75)
    assert checks["best: height"].value == pytest.approx(0.44)
    assert (checks["best: height"].limit, checks["best: gap"].limit) == (0.45, 0.75)
    shown = tables.trial_tables(go2)
    assert not [table.title for table in shown if "paper" in table.title]
    for table in shown:
        headings = [column.heading for column in table.columns]
        assert not [heading for heading in headings if "paper" in heading]
        if table.title != tables.DEFINITIONS:
            assert not [note for note in table.notes if "paper" in note]
        assert {len(row) for row in table.rows} == {len(table.columns)}
    crossed = tables.crossing_table(replace(crossings(), robot="go2"))
    assert crossed.rows[0] == ("matched: gap, forward 2", 0.2, 0.2, 0.4)


def test_a_robot_without_goals_has_no_criteria() -> None:
    other = replace(trial(), robot="my_robot")
    assert trial_checks(other) == []
    titles = [table.title for table in tables.trial_tables(other)]
    assert not [title for title in titles if "criteria" in title.lower()]


def test_walks_of_a_go2_have_criteria() -> None:
    walked = replace(walks(), robot="go2")
    naive_first = replace(walked, subjects=tuple(reversed(walked.subjects)))
    assert naive_first.subjects[0].name == "naive"
    falls = walk_checks(naive_first)[-1]
    assert (falls.name, falls.value, falls.passed) == ("all walks: falls", 1.0, False)
    rows = []
    for run, error in zip(walked.rows, (0.10, 0.14, 0.0, 0.0), strict=True):
        rows.append(replace(run, figures=replace(run.figures, speed_error=error)))
    error_check, fall_check = walk_checks(replace(walked, rows=tuple(rows)))
    assert error_check.value == pytest.approx(0.12)
    assert (error_check.limit, error_check.passed) == (0.10, False)
    assert fall_check.passed
    assert walk_checks(walks()) == [], "the Mini Cheetah's have none on the virtual robot"


def test_criteria_of_few_jumps_say_so() -> None:
    assert len(tables.criteria_table(trial({"matched": HEIGHTS})).notes) == 2
    assert len(tables.criteria_table(trial({"matched": HEIGHTS * 7})).notes) == 1


def scaled(factor: float) -> tuple[float, ...]:
    """Heights that scatter so many times as much as those of the first policy."""
    heights = 0.44 + factor * (np.array(HEIGHTS * 8) - 0.44)
    return tuple(heights.tolist())


@pytest.mark.parametrize(
    ("naive", "parts"),
    [
        (scaled(0.4), ("less", "does not repeat")),
        (scaled(4.0), ("more, 4.00", "2.08 is below")),
        (scaled(1.3), ("more, 1.30", "2.08 is above")),
        (HEIGHTS * 8, ("no clear difference", "does not repeat")),
        (HEIGHTS, ("fewer than 5 jumps", "undecided")),
        ((0.4,), ("could not be measured", "undecided")),
    ],
)
def test_the_verdict_is_one_sentence(naive: tuple[float, ...], parts: tuple[str, str]) -> None:
    results = trial({"matched": HEIGHTS * 8, "naive": naive})
    sentence = tables.scatter_verdict(results, "naive")
    for part in (*parts, "on the virtual robot"):
        assert part in sentence
    assert sentence.endswith(".")
    assert "nan" not in sentence
    cells = {}
    for row_cells in tables.scatter_table(results, "naive").rows:
        cells[row_cells[0]] = row_cells[1]
    assert ("too few" in str(cells["height"])) == ("fewer" in parts[0])
    assert cells["gap"] == "-"
