"""The file of a study: what it holds, and refusals in its words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from command_line import accepted, refused
from pronk.errors import PronkError
from pronk.jump.study.config import (
    ArmConfig,
    RandomizationConfig,
    RobotConfig,
    StudyConfig,
    TrialConfig,
    load_study,
)
from pronk.jump.study.trainings import arm_names, parse_seeds

GAINS = Path(__file__).parents[2] / "policies" / "gains.yaml"
POLICY = Path(__file__).parents[2] / "policies" / "matched" / "policy.onnx"
TORQUE = "joints.torque_scale"
BODY: dict[str, Any] = {
    "schema": "pronk/study/1",
    "title": "Two arms",
    "seeds": "1-3",
    "arms": {"nominal": {"gains": "naive"}, "matched": {"gains": str(GAINS)}},
    "robots": {
        "shipped": {},
        "weak": {"changes": [{"parameters": ["joints.torque_scale"], "factor": 0.7}]},
    },
    "outcomes": ["landed", "height"],
    "comparisons": {
        "a match": {"outcome": "landed", "arm": "matched", "against": "nominal"},
    },
    "trial": {"commands": ["paper"], "jumps": 4},
}


def written(tmp_path: Path, **changes: Any) -> Path:
    """Write the study with some sections changed."""
    path = tmp_path / "study.yaml"
    body = {**BODY, **changes}
    if "arms" in changes:
        body.pop("comparisons")  # They name arms that are not there.
    path.write_text(yaml.safe_dump(body, sort_keys=False))
    return path


@pytest.mark.parametrize(
    ("text", "seeds"),
    [("1-4", (1, 2, 3, 4)), ("7", (7,)), ("1,3, 5", (1, 3, 5)), ("0-1,9", (0, 1, 9))],
)
def test_seeds(text: str, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "4-1", "1-", "-1", "1,1", "1-3,2", "1.5", "0-99999999"])
def test_impossible_seeds_are_refused(text: str) -> None:
    with pytest.raises(PronkError, match="seeds"):
        parse_seeds(text)


def test_arms_are_named_after_their_gains(tmp_path: Path) -> None:
    assert arm_names(["naive", "a/gains.yaml"]) == ["naive", "gains"]
    assert arm_names(["a/gains.yaml", "b/gains.yaml"]) == ["a-gains", "b-gains"]
    with pytest.raises(PronkError, match="twice"):
        arm_names(["naive", "naive"])


def test_a_plan_counts_trainings_trials_and_jumps(tmp_path: Path) -> None:
    """1,080 iterations of 24 steps of 4,096 robots each; 6 policies, 2 robots, 5 commands."""
    out = tmp_path / "out"
    figures_file = tmp_path / "plan.json"
    words = ("study", written(tmp_path), "--plan", "--out", out, "--json", figures_file)
    text = accepted(*words)
    assert "matched less nominal" in text
    figures = json.loads(figures_file.read_text())
    assert figures["trainings"] == 6
    assert figures["env_steps"] == 6 * 1080 * 24 * 4096
    assert figures["trials"] == 12
    assert figures["jumps"] == 12 * 4 * 5
    assert list(figures["comparisons"]) == ["a match"]
    assert not out.exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"schema": "pronk/study/9"}, "schema|pronk/study/1"),
        ({"seeds": "4-1"}, "4-1"),
        ({"arms": {}}, "arms is empty"),
        ({"arms": {"a": {}}}, "arms.a|gains"),
        ({"arms": {"a": {"gain": "naive"}}}, "arms.a|gain"),
        ({"arms": {"a": {"gains": "nowhere.yaml"}}}, "arms.a|nowhere.yaml"),
        ({"arms": {"a": {"gains": "naive", "policies": ["x.onnx"]}}}, "arms.a|policies"),
        ({"arms": {"a": {"policies": ["x.onnx"]}}}, "arms.a|x.onnx"),
        ({"arms": {"a": {"policies": [str(POLICY), str(POLICY)]}}}, "arms.a|twice"),
        ({"arms": {"a": {"gains": "naive", "options": "--fly"}}}, "arms.a|--fly"),
        ({"arms": {"a": {"gains": "naive", "options": "--seed 4"}}}, "arms.a|--seed|seeds"),
        ({"arms": {"a": {"gains": "naive", "options": "--phase run=3"}}}, "arms.a|run"),
        (
            {"arms": {"a": {"gains": "naive", "randomization": {"stiffness": 0.3, "damping": 1}}}},
            "arms.a|damping",
        ),
        ({"robots": {}}, "robots is empty"),
        ({"robots": {"r": {"sim_params": "nowhere.yaml"}}}, "robots.r|nowhere.yaml"),
        ({"robots": {"r": {"size": 3}}}, "robots.r|size"),
        (
            {"robots": {"r": {"changes": [{"parameters": ["joints.power"], "factor": 2.0}]}}},
            "robots.r|power|torque_scale",
        ),
        (
            {
                "robots": {
                    "r": {"changes": [{"parameters": ["joints.torque_scale"], "factor": 90.0}]}
                }
            },
            "robots.r|torque_scale",
        ),
        # Trials of both would be in one folder, and one be read as the other.
        ({"robots": {"a b": {}, "a_b": {"jumps": 2}}}, "'a b'|'a_b'"),
        ({"robots": {"r": {"conditions": "nowhere"}}}, "robots.r|nowhere"),
        ({"outcomes": ["beauty"]}, "outcomes|beauty|landed"),
        ({"outcomes": []}, "outcomes is empty"),
        (
            {"comparisons": {"c": {"outcome": "landed", "arm": "x", "against": "nominal"}}},
            "comparisons.c.arm|'x'|nominal, matched",
        ),
        (
            {"comparisons": {"c": {"outcome": "landed", "arm": "nominal", "against": "nominal"}}},
            "comparisons.c|nominal",
        ),
        (
            {
                "comparisons": {
                    "c": {
                        "outcome": "landed",
                        "arm": "matched",
                        "against": "nominal",
                        "robots": ["x"],
                    }
                }
            },
            "comparisons.c.robots|'x'|shipped, weak",
        ),
        (
            {
                "comparisons": {
                    "c": {"outcome": "landed", "own": {"x": "shipped", "matched": "weak"}}
                }
            },
            "comparisons.c.own|'x'|nominal, matched",
        ),
        (
            {
                "comparisons": {
                    "c": {"outcome": "landed", "own": {"nominal": "s", "matched": "weak"}}
                }
            },
            "comparisons.c.own|'s'|shipped, weak",
        ),
        (
            {"comparisons": {"c": {"outcome": "landed", "own": {"matched": "weak"}}}},
            "comparisons.c|own|two robots",
        ),
        (
            {
                "comparisons": {
                    "c": {"outcome": "landed", "arm": "matched", "own": {"matched": "weak"}}
                }
            },
            "comparisons.c|own|against",
        ),
        ({"comparisons": {"c": {"outcome": "landed", "arm": "matched"}}}, "comparisons.c|against"),
        ({"robots": {"shipped": {"arms": ["x"]}}}, "robots.shipped.arms|'x'"),
        ({"robots": {"shipped": {"jumps": 0}}}, "robots.shipped|jumps is 0"),
        (
            {"robots": {"shipped": {"arms": ["matched"]}}},
            "comparisons.a match|no robot|nominal",
        ),
        ({"trial": {"jumps": 0}}, "trial.jumps|0"),
        ({"trial": {"commands": ["fast"]}}, "fast"),
        ({"training": {"task": "walk"}}, "training.task|walk"),
        ({"training": {"envs": 1}}, "arms.nominal|envs"),
        ({"training": {"robot": "so101"}}, "so101"),
        ({"trainings": {}}, "trainings"),
    ],
)
def test_impossible_studies_are_refused_in_the_words_of_the_file(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    out = tmp_path / "out"
    text = refused("study", written(tmp_path, **changes), "--plan", "--out", out)
    assert "study.yaml" in text
    for word in words.split("|"):
        assert word in text, (word, text)
    assert not out.exists()


def test_robots_have_jumps_and_arms_of_their_own(tmp_path: Path) -> None:
    """3 seeds of both arms do 4 jumps on one robot; 3 of one do 2 on each of the 26 conditions."""
    path = written(
        tmp_path,
        robots={
            "shipped": {},
            "tolerance": {"conditions": "tolerance", "jumps": 2, "arms": ["matched"]},
        },
    )
    figures_file = tmp_path / "plan.json"
    accepted("study", path, "--plan", "--json", figures_file)
    figures = json.loads(figures_file.read_text())
    conditions = len(figures["robots"]) - 1
    assert figures["trials"] == 6 + 3 * conditions
    assert figures["jumps"] == 5 * (6 * 4 + 3 * conditions * 2)


def test_a_plan_of_some_arms_counts_those_alone(tmp_path: Path) -> None:
    figures_file = tmp_path / "plan.json"
    path = written(tmp_path)
    accepted("study", path, "--plan", "--arms", "matched", "--json", figures_file)
    figures = json.loads(figures_file.read_text())
    assert (figures["trainings"], figures["trials"]) == (3, 6)
    accepted("study", path, "--plan", "--arms", "matched,nominal", "--json", figures_file)
    assert json.loads(figures_file.read_text())["trainings"] == 6
    text = refused("study", path, "--plan", "--arms", "x")
    for word in ("--arms", "'x'", "nominal, matched"):
        assert word in text


def test_the_walking_policy_of_an_arm_is_relative_to_the_file(tmp_path: Path) -> None:
    """Not to the folder in which the command is run."""
    arms = {"a": {"gains": "naive", "options": "--init-checkpoint walks/walk.pt"}}
    path = written(tmp_path, arms=arms, training={"task": "jump"})
    text = refused("study", path, "--device", "cpu", "--out", tmp_path / "out")
    assert str(tmp_path / "walks" / "walk.pt") in text


def test_the_study_of_the_examples_is_as_large_as_it_says() -> None:
    path = Path(__file__).parents[2] / "examples" / "studies" / "match_worth" / "study.yaml"
    config = load_study(path)
    assert len(config.arms) * len(config.seed_numbers) == 40
    primary = [comparison for comparison in config.comparisons.values() if comparison.primary]
    assert list(config.comparisons.values())[: len(primary)] == primary
    for robot in config.robots.values():
        assert robot.sim_params is not None
        assert (path.parent / robot.sim_params).is_file()


@pytest.mark.parametrize(
    ("name", "trainings"),
    [
        ("recipes.yaml", 16),
        ("go2/study.yaml", 16),
        ("contact.yaml", 10),
        ("flat.yaml", 10),
        ("back.yaml", 20),
        ("backwards.yaml", 10),
    ],
)
def test_a_study_of_recipes_is_balanced(name: str, trainings: int) -> None:
    """A comparison has all trainings, half on each side."""
    path = Path(__file__).parents[2] / "examples" / "studies" / name
    config = load_study(path)
    assert len(config.arms) * len(config.seed_numbers) == trainings
    for comparison in config.comparisons.values():
        sides = []
        for side in (comparison.arm, comparison.against):
            sides.append([side] if isinstance(side, str) else list(side))
        assert len(sides[0]) == len(sides[1])
        assert sorted(sides[0] + sides[1]) == sorted(config.arms)
    for arm in config.arms.values():
        assert (path.parent / arm.gains).is_file()


def test_configurations_are_checked_when_they_are_built() -> None:
    for build in (
        lambda: ArmConfig(),
        lambda: ArmConfig(gains="a.yaml", ranges_from="b.yaml"),
        lambda: RandomizationConfig(stiffness=-0.1, damping=0.1),
        lambda: RobotConfig(conditions="tolerance", changes=(None,)),  # type: ignore[arg-type]
        lambda: TrialConfig(commands=()),
        lambda: StudyConfig(schema="pronk/study/1", title="", arms={}),
    ):
        with pytest.raises(PronkError):
            build()


def test_a_set_of_conditions_is_a_robot_for_each(tmp_path: Path) -> None:
    robots = {"shipped": {}, "drawn": {"conditions": "bodies"}}
    text = accepted("study", written(tmp_path, robots=robots), "--plan")
    assert "drawn: body 3" in text
    assert load_study(written(tmp_path, robots=robots)).robots["drawn"].conditions == "bodies"


@pytest.mark.parametrize("content", ["", "[]", "schema: [", "a: 1\na: 2\n"])
def test_damaged_files_are_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "study.yaml"
    path.write_text(content)
    assert "study.yaml" in refused("study", path, "--plan")


def test_a_file_of_another_kind_is_named_by_its_schema(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text("schema: pronk/robot/1\nname: arm\n")
    text = refused("study", path, "--plan")
    assert "pronk/robot/1" in text
    assert "pronk/study/1" in text
