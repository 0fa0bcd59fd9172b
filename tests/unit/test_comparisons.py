"""Comparisons of means of several arms: closed forms of a factorial design, and its example."""

from __future__ import annotations

import itertools
import json
import math
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from scipy.stats import t

from command_line import accepted, refused
from pronk.errors import PronkError
from pronk.jump.study.config import ComparisonConfig, load_study
from pronk.jump.study.study import Jumps, compared_arms
from pronk.jump.study.study_results import (
    ComparedArms,
    StudyResults,
    comparison_table,
    load_study_results,
    save_study,
)
from pronk.jump.trial.jumps import JumpRules, measure_jump
from pronk.jump.trial.protocol import PAPER_COMMANDS, parse_case
from pronk.report.study_page import comparison_sentence
from report_cases import ROBOT, SCRIPT, STANDING, jump_capture, row

STUDY = Path(__file__).parents[2] / "examples" / "studies" / "recipes.yaml"
FACTORS = ("landing", "level", "far", "height")
FORWARD = parse_case("2,0")
BACK = parse_case("-2,0")
SCATTER = 0.02
"""Difference of the two seeds of every arm [m]."""


def example_design() -> dict[str, tuple[str, ...]]:
    """The factors of each arm of the example, by the recipes among its options."""
    design = {}
    for name, arm in load_study(STUDY).arms.items():
        words = shlex.split(arm.options)
        assert set(words[::2]) <= {"--recipe"}
        design[name] = tuple(Path(word).stem for word in words[1::2])
    return design


def effects_of(factors: tuple[str, ...]) -> float:
    """Height of an arm [m]: each factor adds its own amount, and two of them together another."""
    amounts = {"landing": 0.01, "level": -0.02, "far": 0.04, "height": 0.08}
    height = 0.3 + sum(amounts[factor] for factor in factors)
    return height + (0.16 if {"landing", "far"} <= set(factors) else 0.0)


def factorial_jumps(design: dict[str, tuple[str, ...]]) -> Jumps:
    """Jumps of two seeds of each arm, alike within a seed; jumps back gain 1 m a factor."""
    capture = jump_capture(400, 1.0)
    figures = measure_jump(
        capture, SCRIPT, ROBOT, began=0.0, rules=JumpRules(standing_height=STANDING)
    )
    jumps: Jumps = {}
    for name, factors in design.items():
        by_seed: dict[int, list[Any]] = {}
        for seed, offset in ((1, 0.5 * SCATTER), (2, -0.5 * SCATTER)):
            by_seed[seed] = []
            for case, added in ((FORWARD, 0.0), (BACK, float(len(factors)))):
                changed = replace(figures, found=True, height=effects_of(factors) + offset + added)
                for number in range(3):
                    by_seed[seed].append(row(name, case, number, changed))
        jumps[name, "shipped"] = by_seed
    return jumps


def test_the_example_is_half_of_all_combinations_and_no_factor_hides_another() -> None:
    """Each factor is in half of the arms, each pair in a quarter, each three in an eighth."""
    design = example_design()
    config = load_study(STUDY)
    assert len(design) * len(config.seed_numbers) == 16
    assert len(set(design.values())) == len(design) == 8
    signs = []
    for factors in design.values():
        signs.append([1 if factor in factors else -1 for factor in FACTORS])
    for size in (1, 2, 3):
        for chosen in itertools.combinations(range(4), size):
            total = sum(math.prod(row_signs[i] for i in chosen) for row_signs in signs)
            assert total == 0, chosen
    # Only all four together are the same in every arm: a main effect and that of the other three.
    assert {math.prod(row_signs) for row_signs in signs} == {1}
    # All layers lie over one recipe, which was the default.
    assert config.training.options.split() == ["--recipe", "../recipes/former_default.yaml"]


def test_each_comparison_of_the_example_is_of_the_arms_with_a_factor_and_those_without() -> None:
    design = example_design()
    config = load_study(STUDY)
    seen = set()
    for comparison in config.comparisons.values():
        common = set(FACTORS)
        for arm in comparison.plus:
            common &= set(design[arm])
        (factor,) = common
        assert all(factor not in design[arm] for arm in comparison.minus)
        assert set(comparison.arms) == set(design)
        seen.add((factor, comparison.outcome, comparison.commands))
    for factor in FACTORS:
        assert (factor, "distance", ("2,0",)) in seen
        assert (factor, "landed", ()) in seen
    assert ("height", "height", ("-2,0",)) in seen
    # The plan prints what each is of.
    text = accepted("study", STUDY, "--plan")
    assert "distance, forward 2" in text
    assert "mean of" in text


def test_a_main_effect_is_exact_and_its_interval_that_of_all_arms_together() -> None:
    """Seeds that differ by d in all of 8 arms: standard error d / sqrt(8), 8 degrees of freedom."""
    design = example_design()
    jumps = factorial_jumps(design)
    main = {"landing": 0.01 + 0.08, "level": -0.02, "far": 0.04 + 0.08, "height": 0.08}
    expected_width = float(t.ppf(0.975, 8.0)) * SCATTER / math.sqrt(8.0)
    for factor in FACTORS:
        arms = tuple(name for name, factors in design.items() if factor in factors)
        arms_without = tuple(name for name in design if name not in arms)
        comparison = ComparisonConfig(
            outcome="height", arm=arms, against=arms_without, commands=("2,0",)
        )
        result = compared_arms(jumps, factor, comparison, ["shipped"])
        assert result.value == pytest.approx(main[factor])
        assert result.seeds == (2,) * 8
        for end in (result.low, result.high):
            assert abs(end - result.value) == pytest.approx(expected_width, rel=0.1)
        assert result.verdict == ("less" if factor == "level" else "more")


def test_commands_that_are_not_named_do_not_count() -> None:
    jumps = factorial_jumps({"a": (), "b": ("height",)})
    differences = {}
    for commands in ((), ("2,0",), ("-2,0", "2,0")):
        comparison = ComparisonConfig(outcome="height", arm="b", against=("a",), commands=commands)
        result = compared_arms(jumps, "c", comparison, ["shipped"])
        differences[commands] = result.value
        assert result.commands == tuple(parse_case(text).name for text in commands)
    assert differences["2,0",] == pytest.approx(0.08)
    assert differences[()] == differences["-2,0", "2,0"] == pytest.approx(0.58)


def test_one_arm_as_a_word_and_as_a_list_are_the_same_comparison() -> None:
    jumps = factorial_jumps({"a": (), "b": ("height",)})
    word = ComparisonConfig(outcome="height", arm="b", against="a")
    listed = ComparisonConfig(outcome="height", arm=("b",), against=("a",))
    first = compared_arms(jumps, "c", word, ["shipped"])
    assert compared_arms(jumps, "c", listed, ["shipped"]) == first
    assert (first.arm, first.against) == ("b", "a")
    assert first.value == pytest.approx(0.58)


@pytest.mark.parametrize("outcome", ["landed", "velocity_error"])
@pytest.mark.parametrize("beginning", ["", "a match, "])
@pytest.mark.parametrize("commands", [(), ("forward 2",)])
def test_a_comparison_named_after_its_outcome_says_it_once(
    outcome: str, beginning: str, commands: tuple[str, ...]
) -> None:
    comparison = ComparedArms(
        name=f"{beginning}{outcome}",
        outcome=outcome,
        arm="b",
        against="a",
        robots=("weak",),
        commands=commands,
    )
    words = outcome.replace("_", " ")
    sentence = comparison_sentence(comparison).replace("_", " ")
    assert sentence.count(words) == 1
    assert all(command in sentence for command in commands)
    other = comparison_sentence(replace(comparison, name="a match")).replace("_", " ")
    assert other.startswith("a match (")
    assert words in other


def test_tables_files_and_sentences_name_arms_and_commands(tmp_path: Path) -> None:
    jumps = factorial_jumps({"a": (), "b": ("height",), "c": ("far",)})
    comparison = ComparisonConfig(outcome="height", arm=("b", "c"), against="a", commands=("2,0",))
    compared = compared_arms(jumps, "more", comparison, ["shipped"])
    results = StudyResults(
        title="Known",
        robot="mini_cheetah",
        arms=("a", "b", "c"),
        robots=("shipped",),
        outcomes=("height",),
        commands=tuple(case.name for case in PAPER_COMMANDS),
        jumps=3,
        trial_seed=0,
        cells=(),
        comparisons=(compared,),
    )
    (cells,) = comparison_table(results).rows
    assert cells[2:4] == ("height [m], forward 2", "mean of b, c less a")
    assert "forward 2" in comparison_sentence(compared)
    assert "mean of b, c less a" in comparison_sentence(compared)
    save_study(tmp_path / "study.json", results)
    assert load_study_results(tmp_path / "study.json").comparisons == (compared,)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"arm": ["b", "c"], "against": ["a", "b"]}, "b|different"),
        ({"arm": ["b", "b"], "against": "a"}, "comparisons.c.arm|twice"),
        ({"arm": ["b", "x"], "against": "a"}, "comparisons.c.arm|'x'|a, b, c"),
        ({"arm": [], "against": "a"}, "comparisons.c|arm and against"),
        ({"arm": "b", "against": ["a"], "commands": ["3,0"]}, "comparisons.c.commands|forward 2"),
        ({"arm": "b", "against": ["a"], "commands": ["fast"]}, "comparisons.c.commands|fast"),
        ({"arm": ["b", "c"], "own": {"a": "r", "b": "s"}}, "comparisons.c|own"),
    ],
)
def test_impossible_comparisons_are_refused(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    body = {
        "schema": "pronk/study/1",
        "title": "Three arms",
        "arms": {name: {"gains": "naive"} for name in "abc"},
        "comparisons": {"c": {"outcome": "height", **changes}},
    }
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump(body))
    text = refused("study", path, "--plan")
    for word in words.split("|"):
        assert word in text, (word, text)


def test_an_arm_against_itself_is_refused() -> None:
    with pytest.raises(PronkError, match="both have a"):
        ComparisonConfig(outcome="height", arm="a", against="a")


def with_finished(jumps: Jumps, seeds_by_arm: dict[str, tuple[int, ...]]) -> Jumps:
    """The same jumps, of some arms those of some seeds alone."""
    finished = {}
    for (arm, robot), by_seed in jumps.items():
        seeds = seeds_by_arm.get(arm, tuple(by_seed))
        finished[arm, robot] = {seed: by_seed[seed] for seed in seeds}
    return finished


@pytest.mark.parametrize(
    ("seeds", "lone"), [({"b": (1,)}, ("b",)), ({"b": (2,), "a": (1,)}, ("b", "a"))]
)
def test_an_arm_with_one_seed_gives_a_value_and_the_reason_why_there_is_no_interval(
    tmp_path: Path, seeds: dict[str, tuple[int, ...]], lone: tuple[str, ...]
) -> None:
    """The scatter of that arm is unknown; it is not taken for none, also in a mean of arms."""
    design = {"a": (), "b": ("height",), "c": ("far",)}
    complete = factorial_jumps(design)
    jumps = with_finished(complete, seeds)
    comparison = ComparisonConfig(outcome="height", arm=("b", "c"), against="a", commands=("2,0",))
    full = compared_arms(complete, "all", comparison, ["shipped"])
    compared = compared_arms(jumps, "few", comparison, ["shipped"])
    assert full.verdict == "more"
    expected = 0.5 * (0.08 + 0.04)
    for arm, offset in (("b", 0.25), ("a", -0.5)):
        if arm in seeds:
            expected += offset * SCATTER * (1.0 if seeds[arm] == (1,) else -1.0)
    assert compared.value == pytest.approx(expected)
    assert math.isnan(compared.low)
    assert math.isnan(compared.high)
    # What has nothing to do with these arms keeps its interval.
    without = replace(comparison, arm="c", against="a")
    other = compared_arms(jumps, "other", without, ["shipped"])
    assert math.isfinite(other.low) == ("a" not in lone)
    results = StudyResults(
        title="Known",
        robot="mini_cheetah",
        arms=tuple(design),
        robots=("shipped",),
        outcomes=("height",),
        commands=("forward 2", "back 2"),
        jumps=3,
        trial_seed=0,
        cells=(),
        comparisons=(full, compared),
    )
    save_study(tmp_path / "study.json", results)
    loaded = load_study_results(tmp_path / "study.json")
    table = comparison_table(loaded)
    (row_of_few,) = [cells for cells in table.rows if "few" in cells]
    sentence = comparison_sentence(loaded.comparisons[1])
    for text in (str(row_of_few[-1]), sentence.split("no interval")[1]):
        for arm in design:
            assert (f" {arm} " in text.replace(",", " ")) == (arm in lone), (arm, text)
        assert "n = 1" in text
    assert any("n = 1" in note for note in table.notes)
    assert not any(
        "n = 1" in note for note in comparison_table(replace(loaded, comparisons=(full,))).notes
    )


def test_an_arm_without_any_seed_is_named() -> None:
    jumps = with_finished(factorial_jumps({"a": (), "b": ("height",)}), {"b": ()})
    comparison = ComparisonConfig(outcome="height", arm="b", against="a")
    compared = compared_arms(jumps, "none", comparison, ["shipped"])
    assert math.isnan(compared.value)
    assert compared.verdict.startswith("no value")
    assert compared.verdict.endswith(" b")


def test_results_without_the_names_of_arms_are_read_too(tmp_path: Path) -> None:
    """As an earlier pronk wrote them."""
    jumps = with_finished(factorial_jumps({"a": (), "b": ("height",)}), {"b": (1,)})
    comparison = ComparisonConfig(outcome="height", arm="b", against="a")
    compared = compared_arms(jumps, "old", comparison, ["shipped"])
    results = StudyResults(
        title="Known",
        robot="mini_cheetah",
        arms=("a", "b"),
        robots=("shipped",),
        outcomes=("height",),
        commands=("forward 2", "back 2"),
        jumps=3,
        trial_seed=0,
        cells=(),
        comparisons=(compared,),
    )
    path = tmp_path / "study.json"
    save_study(path, results)
    body = json.loads(path.read_text())
    del body["comparisons"][0]["counted_arms"]
    path.write_text(json.dumps(body))
    (old,) = load_study_results(path).comparisons
    assert old.value == compared.value
    assert "no interval" in old.verdict
