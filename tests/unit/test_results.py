"""Sums over jumps, their files, and the tables made of them."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pronk.errors import ArtefactError
from pronk.jump.trial import results, tables
from pronk.jump.trial.criteria import trial_checks
from pronk.jump.trial.jumps import FIGURES, JumpFigures, JumpRules
from pronk.jump.trial.protocol import PAPER_COMMANDS, PAPER_RATIOS, TABLE_III, Case
from pronk.jump.trial.results import Results, ratio_of_scatter
from report_cases import ROBOT, of_kind, row, subject

HEIGHTS = (0.40, 0.44, 0.48)
MISSED = JumpFigures(standing=True, fell=True, height=0.05, energy=1.0)


def figures(height: float) -> JumpFigures:
    """A jump with every figure known but the gap, most of them made of the height."""
    joints = tuple(height * i for i in range(12))
    kept: dict[str, Any] = {
        name: joints if figure.joints else height + i
        for i, (name, figure) in enumerate(FIGURES.items())
    }
    flags = {"standing": True, "found": True, "upright": True}
    kept |= {**flags, "height": height, "gap": math.nan, "distance": 2.0 * height}
    return JumpFigures(**kept)


def trial(
    heights: dict[str, tuple[float, ...]] | None = None, cases: tuple[Case, ...] = PAPER_COMMANDS
) -> Results:
    """One jump of each height, and one that failed, of every policy with every command."""
    heights = heights or {"matched": HEIGHTS, "naive": (0.36, 0.44, 0.52)}
    made = []
    for name, case in itertools.product(heights, cases):
        for i, each in enumerate([*map(figures, heights[name]), MISSED]):
            kept: Any = {"capture": "captures/a.npz" if i == 0 else "", "began": 0.125}
            one = row(name, case, i, each, **kept)
            made.append(replace(one, script=replace(one.script, run_s=2.5 + i / 50)))
    rest: Any = {"rules": asdict(JumpRules.of(ROBOT)), "timing": {"seconds": 1.0}}
    rest |= {"spread_s": 0.5, "mass": 12.0, "rows": tuple(made)}
    rest["subjects"] = tuple(
        subject(name, joint_names=[], stiffness=[], damping=[]) for name in heights
    )
    return of_kind(results.JUMPS, tuple(heights), cases=cases, **rest)


# --- Sums ---------------------------------------------------------------------------------------


def test_a_cell_by_hand() -> None:
    cell = trial().cell("matched", "forward 1")
    assert (cell.n, cell.standing, cell.found, cell.succeeded, cell.fell) == (4, 4, 3, 3, 1)
    assert cell.success == 0.75
    height = cell.figures["height"]
    # Only jumps that were found count: the fall of .05 m is not a height.
    assert (height.n, height.mean, height.std) == (3, pytest.approx(0.44), pytest.approx(0.04))
    assert (height.least, height.p50, height.most) == pytest.approx(HEIGHTS)
    assert cell.figures["gap"].n == 0
    assert math.isnan(cell.figures["gap"].mean)
    assert cell.joints["peak_torque"]["FR_knee"].most == pytest.approx(2 * 0.48)


def test_the_ratio_is_that_of_the_mean_scatter() -> None:
    found = {(ratio.figure, ratio.case): ratio for ratio in trial().ratios}
    for key, n in ((("height", "forward 1"), 3), (("distance", None), 15)):
        assert (found[key].value, found[key].n) == (pytest.approx(2.0), (n, n))
    assert (found["gap", None].policy, found["gap", None].other) == ("matched", "naive")
    assert math.isnan(found["gap", None].value)


def test_few_jumps_have_a_ratio_and_no_interval() -> None:
    few, enough = np.array([0.1, 0.2, 0.4, 0.7]), np.array([0.1, 0.2, 0.4, 0.7, 0.9])
    for own, others in (([few], [enough]), ([enough], [few]), ([enough, few], [enough, enough])):
        value, *ends = ratio_of_scatter(own, others, seed=0, resamples=200)
        assert 0.5 < value < 2.0
        assert all(map(math.isnan, ends))
    value, low, high = ratio_of_scatter([enough], [2.0 * enough], seed=0, resamples=200)
    assert 0.1 < low < value < high < 40.0
    same, some = np.full(5, 0.3), np.arange(5.0)
    for own, others in (([same], [some]), ([some[:1]], [some]), ([some], [some[:0]])):
        assert all(map(math.isnan, ratio_of_scatter(own, others, seed=0, resamples=20)))


def test_the_interval_covers_a_known_ratio() -> None:
    rng = np.random.default_rng(5)
    hits, trials = 0, 60
    for seed in range(trials):
        own = [rng.normal(size=25) for _ in range(3)]
        others = [2.0 * rng.normal(size=25) for _ in range(3)]
        value, low, high = ratio_of_scatter(own, others, seed=seed, resamples=300)
        assert low <= value <= high
        hits += low <= 2.0 <= high
    # 95 % expected; fewer than 80 % of 60 would happen once in a million times.
    assert hits >= 0.8 * trials


def test_the_paper_s_ratios_follow_from_its_table() -> None:
    for figure, ratio in PAPER_RATIOS.items():
        naive, matched = (
            sum(std for _, std in TABLE_III[figure, gains].values())
            for gains in ("naive", "matched")
        )
        assert naive / matched == pytest.approx(ratio, abs=5e-3)


# --- Files --------------------------------------------------------------------------------------


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    made = trial()
    assert results.save(tmp_path, made) == (tmp_path / "trials.csv", tmp_path / "summary.json")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["summary.json", "trials.csv"]
    loaded = results.load(tmp_path)
    # NaN is not equal to itself; the text of it is.
    for name in ("rows", "cells", "ratios"):
        assert repr(getattr(loaded, name)) == repr(getattr(made, name)), name
    for name in ("subjects", "cases", "script", "seed", "sim_params", "rules", "mass", "versions"):
        assert getattr(loaded, name) == getattr(made, name), name
    # The summary is strict JSON: null, not NaN.
    text = (tmp_path / "summary.json").read_text()
    body = json.loads(text, parse_constant=lambda name: pytest.fail(name))
    assert body["definitions"]["height"]["unit"] == "m"
    assert body["cells"][0]["figures"]["gap"]["mean"] is None
    table = list(csv.DictReader(io.StringIO((tmp_path / "trials.csv").read_text())))
    assert len(table) == len(made.rows) == 40
    first, missed = table[0], table[3]
    assert (first["height_m"], first["peak_torque_FR_knee_N_m"]) == ("0.4", "0.8")
    assert (first["success"], missed["success"], missed["fell"]) == ("1", "0", "1")
    assert missed["distance_m"] == missed["peak_torque_FR_knee_N_m"] == ""


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("pronk/trial/4", "pronk/trial/2", "pronk/trial/2"),
        ('"rows"', '"roses"', "damaged"),
        ('"height": 0.4', '"height": "tall"', "damaged"),
        ('"figures"', '"numbers"', "damaged"),
        ('"number": 3', '"number": null', "damaged"),
        ('"policy": "matched"', '"policy": "other"', "do not fit"),
        ("{", "", "cannot be read"),
        (None, "", "no such file"),
    ],
)
def test_a_damaged_trial_is_refused(tmp_path: Path, old: str | None, new: str, what: str) -> None:
    _, path = results.save(tmp_path, trial())
    if old is None:
        path.unlink()
    else:
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))
    with pytest.raises(ArtefactError, match=what) as caught:
        results.load(tmp_path)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)


# --- Tables -------------------------------------------------------------------------------------


def test_table_iii_stands_beside_ours() -> None:
    sheet = tables.table_iii(trial(), "distance")
    # In the paper's order, whichever was tried first.
    assert [column.split(",")[-1] for column in sheet.columns[1:3]] == [" naive", " matched"]
    assert [column.split(",")[0] for column in sheet.columns[3:]] == ["naive", "matched"]
    ours = ("0.880 +- 0.160 (3/4)", "0.880 +- 0.080 (3/4)")
    assert sheet.rows[1] == ("forward 2", "0.944 +- 0.030", "0.969 +- 0.026", *ours)
    assert sheet.rows[-1][1:] == ("+- 0.082", "+- 0.040", "+- 0.160", "+- 0.080")
    assert any("virtual" in note for note in sheet.notes)


def test_a_command_of_its_own_has_no_paper_and_no_cell_is_left_out() -> None:
    own = Case(name="1.5,0", command=(1.5, 0.0, 0.0))
    made = trial({"matched": ()}, cases=(own, PAPER_COMMANDS[0]))
    sheet = tables.table_iii(made, "height")
    assert [row[0] for row in sheet.rows[:2]] == ["1.5,0", "forward 1"]
    assert sheet.rows[0] == ("1.5,0", "-", "-", "- (0/1)")
    for each in tables.sheets(made):
        assert all(len(row) == len(each.columns) for row in each.rows), each.title


def test_criteria_by_hand() -> None:
    found = {check.what: check for check in trial_checks(trial())}
    assert found["forward 2: height"].passed  # .44 against .244
    for what in (
        "forward 2: height, std",  # .04 against .013
        "forward 2: distance",  # .88 against .969
        "forward 2: gap",  # not measured
        "forward 2: success",  # .75 against .95
        "best: height",  # .44 against .45
    ):
        assert not found[what].passed
    assert trial_checks(trial({"matched": (0.45, 0.46)}))[-1].passed
    # Five commands of height, its scatter, distance, its scatter and success; four gaps; the best.
    assert len(found) == 5 * 5 + 4 + 1
    few, many = (tables.criteria(trial({"matched": HEIGHTS * n})).notes for n in (1, 7))
    assert (len(few), len(many)) == (2, 1)


@pytest.mark.parametrize(
    ("naive", "parts"),
    [
        (tuple(0.44 + 0.4 * (h - 0.44) for h in HEIGHTS * 8), ("less", "does not repeat")),
        (tuple(0.44 + 4.0 * (h - 0.44) for h in HEIGHTS * 8), ("more, 4.00", "2.08 is below")),
        (tuple(0.44 + 1.3 * (h - 0.44) for h in HEIGHTS * 8), ("more, 1.30", "2.08 is above")),
        (HEIGHTS * 8, ("no clear difference", "does not repeat")),
        (HEIGHTS, ("fewer than 5 jumps", "undecided")),
        ((0.4,), ("could not be measured", "undecided")),
    ],
)
def test_the_verdict_is_one_sentence(naive: tuple[float, ...], parts: tuple[str, str]) -> None:
    made = trial({"matched": HEIGHTS * 8, "naive": naive})
    sentence = tables.verdict(made, "naive")
    assert all(part in sentence for part in (*parts, "on the virtual robot"))
    assert sentence.endswith(".")
    assert "nan" not in sentence
    cells = {row[0]: row[1] for row in tables.scatter(made).rows}
    assert ("too few" in cells["height"]) == ("fewer" in parts[0])
    assert cells["gap"] == "-"
