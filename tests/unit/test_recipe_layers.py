"""Recipes of several files: precedence, the file that they are merged to, and what is refused."""

from __future__ import annotations

import hashlib
import tempfile
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from command_line import refused
from pronk.cli.main import parsed_command
from pronk.errors import PronkError
from pronk.jump.study.trainings import (
    TrainingArm,
    TrainingPlace,
    check_arm,
    training_tasks,
    training_words,
)
from pronk.jump.train.phases import PHASES, changed_phases
from pronk.jump.train.recipe import (
    SCHEMA,
    Recipe,
    load_recipe,
    load_recipes,
    merge_recipes,
    recipe_content,
    recipe_text,
)
from pronk.jump.train.settings import TrainSettings

EXAMPLES = Path(__file__).parents[2] / "examples" / "recipes"

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
SPANS = st.tuples(NUMBERS, NUMBERS)
PLAIN = st.builds(lambda value: dict.fromkeys(PHASES, (value, value)), NUMBERS)
BY_PHASE = st.dictionaries(st.sampled_from(list(PHASES)), SPANS, min_size=1)
TERMS = st.dictionaries(st.sampled_from(["hop", "slip", "no", "y", "1e3"]), PLAIN | BY_PHASE)
RECIPES = st.builds(
    Recipe,
    weights=TERMS,
    jump_scales=TERMS,
    jump=st.dictionaries(st.sampled_from(["late_s", "speed_added", "ready_s"]), NUMBERS),
    task=st.dictionaries(st.just("action_scale"), NUMBERS),
    source=st.sampled_from(["a/first.yaml", "b/zwei.yaml", "c/# three: 3.yaml"]),
    sha256=st.sampled_from(["0" * 64, "1e" * 32]),
)


def content(recipe: Recipe) -> Any:
    """What a recipe changes, with the order of its terms, in which new ones are added."""
    return (
        list(recipe.weights.items()),
        list(recipe.jump_scales.items()),
        list(recipe.jump.items()),
        list(recipe.task.items()),
    )


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"schema: {SCHEMA}\n{text}\n")
    return path


@given(RECIPES)
def test_an_empty_layer_changes_nothing(recipe: Recipe) -> None:
    empty = Recipe(source="empty.yaml")
    assert content(merge_recipes([recipe, empty])) == content(recipe)
    assert content(merge_recipes([empty, recipe])) == content(recipe)
    assert merge_recipes([recipe]) is recipe


@given(RECIPES, RECIPES, RECIPES)
def test_it_is_the_same_which_layers_are_merged_first(
    first: Recipe, second: Recipe, third: Recipe
) -> None:
    together = merge_recipes([first, second, third])
    front_first = merge_recipes([merge_recipes([first, second]), third])
    back_first = merge_recipes([first, merge_recipes([second, third])])
    for other in (front_first, back_first):
        assert content(other) == content(together)
        assert recipe_text(other) == recipe_text(together)
        assert other.sha256 == together.sha256


@given(RECIPES, RECIPES)
def test_the_last_layer_that_names_a_phase_decides(first: Recipe, second: Recipe) -> None:
    merged = merge_recipes([first, second])
    for section in ("weights", "jump_scales"):
        before, after, result = (
            {"weights": recipe.weights, "jump_scales": recipe.jump_scales}[section]
            for recipe in (first, second, merged)
        )
        assert set(result) == set(before) | set(after)
        for term in result:
            for phase in PHASES:
                expected = after.get(term, {}).get(phase, before.get(term, {}).get(phase))
                assert result[term].get(phase) == expected
    assert merged.jump == {**first.jump, **second.jump}


@given(RECIPES, RECIPES)
def test_the_merged_file_is_the_same_recipe(first: Recipe, second: Recipe) -> None:
    merged = merge_recipes([first, second])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recipe.yaml"
        path.write_text(recipe_text(merged), encoding="utf-8")
        again = load_recipe(path)
        alone = load_recipes([path])
    assert content(again) == content(merged)
    assert again.sha256 == merged.sha256
    assert again.record() == merged.record() == alone.record()
    names = [layer["file"] for layer in merged.record()["layers"]]
    assert names == [Path(first.source).name, Path(second.source).name]


def test_one_phase_of_a_term_is_changed_and_a_number_replaces_all(tmp_path: Path) -> None:
    base = written(tmp_path, "base.yaml", "rewards: {hop: {jump_a: 4, jump_b: [4, 12]}, slip: 0}")
    later = written(tmp_path, "later.yaml", "rewards: {hop: {jump_b: 5}, slip: {walk: -1}}")
    all_of_it = written(tmp_path, "all.yaml", "rewards: {hop: 3}")
    merged = load_recipes([base, later])
    assert merged.weights["hop"] == {"jump_a": (4.0, 4.0), "jump_b": (5.0, 5.0)}
    assert merged.removed == (), "slip has a weight in walk again"
    number = load_recipes([base, later, all_of_it])
    assert number.weights["hop"] == dict.fromkeys(PHASES, (3.0, 3.0))
    phases = changed_phases({"weights": load_recipes([all_of_it, base]).weights})
    assert phases["walk"].weights["hop"] == (3.0, 3.0)
    assert phases["jump_b"].weights["hop"] == (4.0, 12.0)


def test_what_is_kept_names_every_file_with_its_hash(tmp_path: Path) -> None:
    paths = [
        written(tmp_path, "one.yaml", "rewards: {hop: 1}"),
        written(tmp_path / "other", "two.yaml", "jump: {late_s: 0.2}"),
    ]
    record = load_recipes(paths).record()
    expected = []
    for path in paths:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        expected.append({"file": path.name, "sha256": digest})
    assert record["layers"] == expected
    # One file is recorded as before there were layers: its name and its own hash.
    single = load_recipes(paths[:1]).record()
    assert (single["file"], single["sha256"]) == ("one.yaml", expected[0]["sha256"])
    assert "layers" not in single
    # The same files elsewhere are the same recipe.
    moved = [
        written(tmp_path / "moved", "one.yaml", "rewards: {hop: 1}"),
        written(tmp_path / "moved", "two.yaml", "jump: {late_s: 0.2}"),
    ]
    assert load_recipes(moved).sha256 == load_recipes(paths).sha256
    assert load_recipes(paths[::-1]).sha256 != load_recipes(paths).sha256


@pytest.mark.parametrize(
    "text",
    [
        "rewards: {hop: {run: 3}}",
        "rewards: {hop: fast}",
        "jump_scales: {knees: .inf}",
        "weights: {hop: 1}",
        "layers: [{file: a.yaml}]",
    ],
)
def test_a_layer_that_is_no_recipe_is_named(tmp_path: Path, text: str) -> None:
    good = written(tmp_path, "good.yaml", "rewards: {hop: 1}")
    faulty = written(tmp_path, "wrong.yaml", text)
    for paths in ([good, faulty], [faulty, good]):
        with pytest.raises(PronkError) as refusal:
            load_recipes(paths)
        assert str(faulty) in str(refusal.value)
        assert str(good) not in str(refusal.value)


def test_the_options_of_a_run_are_its_files_in_their_order(tmp_path: Path) -> None:
    def stored(*names: str) -> Any:
        files = tuple(Path(name) for name in names)
        settings = TrainSettings(task="all", out=tmp_path, gains="naive", recipe=files).completed()
        values = parsed_command(training_words(settings))
        assert values["settings"].recipe == files
        return settings.stored_values()

    assert stored()["recipe"] is None
    assert stored("a.yaml")["recipe"] == "a.yaml", "as runs of earlier versions have it"
    assert stored("b.yaml", "a.yaml")["recipe"] == ["b.yaml", "a.yaml"]
    for names in ((), ("a.yaml",), ("b.yaml", "a.yaml")):
        files = tuple(Path(name) for name in names)
        resumed = TrainSettings(task="all", out=tmp_path, resume=True)
        assert resumed.resumed(stored(*names)).recipe == files
    other = TrainSettings(
        task="all", out=tmp_path, resume=True, recipe=(Path("a.yaml"), Path("b.yaml"))
    )
    with pytest.raises(PronkError, match=r"--recipe is a\.yaml, b\.yaml.* has b\.yaml, a\.yaml"):
        other.resumed(stored("b.yaml", "a.yaml"))
    with pytest.raises(PronkError, match="twice"):
        stored("a.yaml", "a.yaml")


def test_trainings_side_by_side_get_one_merged_file(tmp_path: Path) -> None:
    """The same that one training by itself keeps, so that their policies name the same hash."""
    paths = (EXAMPLES / "forward.yaml", EXAMPLES / "far.yaml")
    settings = TrainSettings(task="all", out=tmp_path, gains="naive", recipe=paths)
    arm = TrainingArm(name="far", settings=settings)
    check_arm(arm)
    root = tmp_path / "study"
    (task, other) = training_tasks([arm], [1, 2], root, TrainingPlace(device="cpu"))
    assert task.inputs == other.inputs
    (copy,) = task.inputs
    assert task.settings["recipe"] == copy
    assert task.command.count("--recipe") == 1
    merged = load_recipe(root / copy)
    assert merged.record() == load_recipes(paths).record()
    assert merged.weights["flight_distance"]["jump_b"] == (60.0, 57.0)
    assert merged.weights["liftoff_angle"]["jump_b"] == (4.0, 12.0)
    # Of one file there is a copy to the byte.
    single = TrainingArm(
        name="one",
        settings=TrainSettings(task="all", out=tmp_path, gains="naive", recipe=paths[:1]),
    )
    (task,) = training_tasks([single], [1], root, TrainingPlace(device="cpu"))
    (copy,) = task.inputs
    assert (root / copy).read_bytes() == paths[0].read_bytes()


def test_a_study_names_the_layer_of_an_arm_that_is_wrong(tmp_path: Path) -> None:
    written(tmp_path, "base.yaml", "rewards: {hop: 1}")
    written(tmp_path, "wrong.yaml", "rewards: {hop: {run: 3}}")
    study = tmp_path / "study.yaml"
    body = {
        "schema": "pronk/study/1",
        "title": "Layers",
        "training": {"options": "--recipe base.yaml"},
        "arms": {
            "base": {"gains": "naive"},
            "changed": {"gains": "naive", "options": "--recipe wrong.yaml"},
        },
    }
    study.write_text(yaml.safe_dump(body))
    text = refused("study", study, "--plan")
    for word in ("arms.changed", "wrong.yaml", "'run'"):
        assert word in text, word
    assert "base.yaml" not in text


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_a_run_and_a_study_keep_the_same_file(tmp_path: Path, layers: int) -> None:
    """Whatever the number of files, the copy has the hash that provenance and policy name."""
    texts = (
        "rewards: {hop: -2}  # \u00e4",
        "rewards: {hop: {jump_b: [-1, 0]}}",
        "jump: {late_s: 0.2}",
    )
    paths = []
    for number, text in enumerate(texts[:layers]):
        path = tmp_path / f"layer-{number}.yml"
        # Line ends of another system.
        path.write_bytes(f"schema: {SCHEMA}\r\n{text}\r\n".encode())
        paths.append(path)
    kept = recipe_content(paths)
    assert hashlib.sha256(kept).hexdigest() == load_recipes(paths).sha256
    settings = TrainSettings(task="all", out=tmp_path, gains="naive", recipe=tuple(paths))
    arm = TrainingArm(name="layers", settings=settings)
    (task,) = training_tasks([arm], [1], tmp_path / "study", TrainingPlace(device="cpu"))
    (copy,) = task.inputs
    assert (tmp_path / "study" / copy).read_bytes() == kept


def test_no_training_of_a_study_gets_a_file_that_is_no_recipe(tmp_path: Path) -> None:
    path = tmp_path / "gains.yaml"
    path.write_text("schema: pronk/gains/2\n")
    settings = TrainSettings(task="all", out=tmp_path, gains="naive", recipe=(path,))
    arm = TrainingArm(name="arm", settings=settings)
    with pytest.raises(PronkError, match=SCHEMA):
        training_tasks([arm], [1], tmp_path / "study", TrainingPlace(device="cpu"))
    assert not (tmp_path / "study").exists()
