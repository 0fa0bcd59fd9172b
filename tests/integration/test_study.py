"""`pronk study` with finished policies: trials, table, page; and options of several trainings."""

from __future__ import annotations

import csv
import json
import math
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

pytest.importorskip("onnxruntime")
import pronk.robots
from command_line import accepted, invoke, refused
from hopper import write_hopper
from pronk.cli.main import parsed_command
from pronk.identify.match.gains import load_gains
from pronk.jump.study.config import RandomizationConfig
from pronk.jump.study.outcomes import OUTCOMES
from pronk.jump.study.study import randomized_gains, read_trial
from pronk.jump.study.study_results import load_study_results
from pronk.jump.study.tasks import StudyState
from pronk.jump.study.trainings import (
    SPREADS,
    spread_over_seeds,
    training_words,
    trainings_table,
)
from pronk.jump.train.settings import DrawSettings, TrainSettings
from pronk.jump.trial.condition_trial import run_conditions
from pronk.jump.trial.conditions import Condition
from pronk.jump.trial.protocol import parse_cases
from pronk.jump.trial.trial import TrialPlan, setup_of
from pronk.robots import load_robot
from study_cases import GAINS, POLICIES, cell_files, write_study

of_one_study = pytest.mark.xdist_group("study")
"""Mark of the tests that share `study`: one process has them all."""


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a study of two arms of one policy on two robots, with the study's file."""
    folder = tmp_path_factory.mktemp("study")
    path = write_study(
        folder / "study.yaml",
        arms={
            "nominal": {"policies": [str(POLICIES / "naive" / "policy.onnx")]},
            "matched": {"policies": [str(POLICIES / "matched" / "policy.onnx")]},
        },
        robots={
            "shipped": {},
            "weak": {"changes": [{"parameters": ["joints.torque_scale"], "factor": 0.7}]},
        },
        outcomes=["landed", "height", "energy"],
        comparisons={
            "a match": {
                "outcome": "height",
                "arm": "matched",
                "against": "nominal",
                "robots": ["shipped"],
            }
        },
    )
    accepted("study", path, "--out", folder / "out")
    return folder


@pytest.mark.slow
@of_one_study
def test_every_policy_jumps_on_every_robot(study: Path) -> None:
    results = load_study_results(study / "out" / "study.json")
    assert not results.missing
    assert len(results.cells) == 2 * 2 * 3
    with (study / "out" / "runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4
    assert set(OUTCOMES) <= set(rows[0])
    for row in rows:
        cell = results.cell(row["arm"], row["robot"], "landed")
        assert cell.value == float(row["landed"])
        assert (cell.seeds, cell.jumps, cell.jumps_with_value) == (1, 1, 1)
        height = results.cell(row["arm"], row["robot"], "height")
        assert height.jumps_with_value == int(row["height"] != "")
        assert cell.jumps_not_standing == int(row["fell"] == "")
    (comparison,) = results.comparisons
    heights = {row["arm"]: row["height"] for row in rows if row["robot"] == "shipped"}
    assert comparison.value == float(heights["matched"]) - float(heights["nominal"])
    assert comparison.seeds == (1, 1)
    assert math.isnan(comparison.low)
    for arm in ("matched", "nominal"):
        assert arm in comparison.verdict
    page = (study / "out" / "report.html").read_text()
    assert "a match" in page
    assert "virtual robot" in page


@pytest.mark.slow
@of_one_study
def test_its_trials_are_those_of_a_trial_by_itself(study: Path, tmp_path: Path) -> None:
    policy = POLICIES / "matched" / "policy.onnx"
    setup = setup_of(policy, tmp_path, processes=1)
    plan = TrialPlan(cases=parse_cases(["1,0"]), jumps=1)
    run_conditions([policy], [Condition(name="nominal")], plan, setup)
    (path,) = (tmp_path / "cells").glob("*.json")
    stored = cell_files(study / "out")
    assert path.read_bytes() in stored.values()
    (run,) = read_trial(study / "out" / "trials" / "matched" / "seed-1" / "shipped").rows
    assert OUTCOMES["height"].value(run) > 0.2


@pytest.mark.slow
@of_one_study
def test_run_again_it_does_nothing_and_a_new_robot_only(study: Path) -> None:
    out = study / "out"
    before = cell_files(out)
    assert "4 of 4 tasks were done before" in accepted("study", study / "study.yaml", "--out", out)
    assert cell_files(out) == before
    text = (study / "study.yaml").read_text()
    more = study / "more.yaml"
    more.write_text(text.replace("robots:\n", "robots:\n  second: {}\n", 1))
    assert "4 of 6 tasks were done before" in accepted("study", more, "--out", out)
    after = cell_files(out)
    for path, content in before.items():
        assert after[path] == content
    second = out / "trials" / "matched" / "seed-1" / "second"
    first = out / "trials" / "matched" / "seed-1" / "shipped"
    assert read_trial(second) == read_trial(first)


@pytest.mark.slow
@of_one_study
def test_a_policy_that_fails_is_named_and_the_rest_is_there(study: Path, tmp_path: Path) -> None:
    broken = tmp_path / "policy.onnx"
    broken.write_bytes(b"no policy")
    path = write_study(
        tmp_path / "study.yaml",
        arms={
            "broken": {"policies": [str(broken)]},
            "matched": {"policies": [str(POLICIES / "matched" / "policy.onnx")]},
        },
        comparisons={"c": {"outcome": "landed", "arm": "matched", "against": "broken"}},
    )
    command = invoke(["study", path, "--out", tmp_path / "out"])
    assert command.exit_code == 2
    assert "broken, seed 1, on shipped" in command.stderr
    results = load_study_results(tmp_path / "out" / "study.json")
    assert results.missing == ("broken, seed 1, on shipped",)
    assert results.cell("matched", "shipped", "landed").seeds == 1
    comparison = results.comparisons[0]
    assert math.isnan(comparison.value)
    assert "broken" in comparison.verdict


# --- Several trainings ---------------------------------------------------------------------------

# --- A folder that is there in part -------------------------------------------------------------

DAMAGES = {
    "whole": [],
    "no folder of cells": ["cells"],
    "robots alone": ["cells", "conditions.*"],
    "no table": ["conditions.csv"],
    "no summary": ["conditions.json"],
    "nothing": ["*"],
}
"""What a copy of a trial's folder lacks, by the name of the robot that is tried there."""
CUT = "a cell that is cut"
"""Robot whose file of jumps ends half way."""
HEAVY = ('mass="6.607999999999999"', 'mass="7.608"')
"""Mass of the Mini Cheetah's trunk in its model, and that of a heavier one [kg]."""
WITHOUT_JUMPS = {"no folder of cells", "robots alone", CUT}


@pytest.fixture(scope="module")
def whole_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a study of one policy that hops, on a robot for each damage of its copies."""
    folder = tmp_path_factory.mktemp("whole")
    path = write_study(
        folder / "study.yaml",
        arms={"hopper": {"policies": [str(write_hopper(folder / "policy.onnx"))]}},
        robots={name: {} for name in (*DAMAGES, CUT)},
        outcomes=["landed", "height"],
        trial={"commands": ["0,0"], "jumps": 1},
    )
    accepted("study", path, "--out", folder / "out")
    return folder


def trial_of(out: Path, robot: str) -> Path:
    """Return the folder of a robot's trial."""
    return out / "trials" / "hopper" / "seed-1" / robot.replace(" ", "_")


@pytest.fixture
def study_copy(whole_study: Path, tmp_path: Path) -> Path:
    """A copy of the folder of a finished study, to damage."""
    out = tmp_path / "copy"
    shutil.copytree(whole_study / "out", out)
    return out


def written_at(paths: Iterable[Path]) -> dict[Path, int]:
    """Return when files were last written [ns]."""
    return {path: path.stat().st_mtime_ns for path in paths}


@pytest.mark.slow
def test_a_copy_that_lacks_files_is_completed_and_says_which_trials(
    whole_study: Path, study_copy: Path, tmp_path: Path
) -> None:
    out = study_copy
    for robot, patterns in DAMAGES.items():
        for pattern in patterns:
            for path in list(trial_of(out, robot).glob(pattern)):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
    (cut,) = (trial_of(out, CUT) / "cells").glob("*.json")
    cut.write_bytes(cut.read_bytes()[:200])
    kept = []
    for robot in ("whole", "no table", "no summary"):
        (path,) = (trial_of(out, robot) / "cells").glob("*.json")
        kept.append(path)
    stamps = written_at(kept)

    figures = tmp_path / "figures.json"
    printed = accepted("study", whole_study / "study.yaml", "--out", out, "--json", figures)
    body = json.loads(figures.read_text())
    run_again = {name.partition(" on ")[2] for name in body["run_again"]}
    completed = {name.partition(" on ")[2] for name in body["completed"]}
    assert run_again == WITHOUT_JUMPS
    assert completed == {"no table", "no summary"}
    for name in (*body["run_again"], *body["completed"]):
        assert name in " ".join(printed.split())
    assert body["missing"] == []
    assert written_at(stamps) == stamps
    assert cell_files(out) == cell_files(whole_study / "out")
    for name in ("study.csv", "runs.csv"):
        assert (out / name).read_bytes() == (whole_study / "out" / name).read_bytes()
    # Nothing is left to do, and nothing to say.
    again = accepted("study", whole_study / "study.yaml", "--out", out)
    assert f"{len(DAMAGES) + 1} of {len(DAMAGES) + 1} tasks were done before" in again
    assert "run again" not in again


@pytest.mark.slow
def test_a_copy_without_the_state_keeps_the_jumps_that_it_has(
    whole_study: Path, study_copy: Path, tmp_path: Path
) -> None:
    out = study_copy
    (out / "state.json").unlink()
    shutil.rmtree(trial_of(out, "robots alone") / "cells")
    stamps = written_at((trial_of(out, "whole") / "cells").iterdir())
    study = yaml.safe_load((whole_study / "study.yaml").read_text())
    study["robots"] = {"whole": {}, "robots alone": {}}
    fewer = whole_study / "fewer.yaml"
    fewer.write_text(yaml.safe_dump(study))
    figures = tmp_path / "figures.json"
    accepted("study", fewer, "--out", out, "--json", figures)
    body = json.loads(figures.read_text())
    assert [name.partition(" on ")[2] for name in body["run_again"]] == ["robots alone"]
    assert [name.partition(" on ")[2] for name in body["completed"]] == ["whole"]
    assert written_at(stamps) == stamps
    assert cell_files(out) == cell_files(whole_study / "out")


@pytest.mark.slow
def test_trials_of_several_versions_are_named(whole_study: Path, study_copy: Path) -> None:
    """As in a study that goes on under another MuJoCo, or with a node that has another one."""
    (path,) = (trial_of(study_copy, "whole") / "cells").glob("*.json")
    body = json.loads(path.read_text())
    installed = body["versions"]["mujoco"]
    body["versions"]["mujoco"] = "2.0.0"
    path.write_text(json.dumps(body))
    command = invoke(["study", whole_study / "study.yaml", "--out", study_copy])
    assert command.exit_code == 0
    assert "2.0.0" in command.stderr
    results = load_study_results(study_copy / "study.json")
    for version in (installed, "2.0.0"):
        assert version in results.versions["mujoco"]
        assert version in results.mixed_versions
    assert results.mixed_versions in (study_copy / "report.html").read_text()
    assert not load_study_results(whole_study / "out" / "study.json").mixed_versions


@pytest.mark.slow
def test_trials_of_several_sources_are_named(whole_study: Path, study_copy: Path) -> None:
    """As in a study that goes on with another commit, whose version is the same."""
    results = load_study_results(study_copy / "study.json")
    present = results.versions["sources"]
    assert not results.mixed_versions
    state = StudyState(study_copy)
    name = "hopper, seed 1, on whole"
    state.set(name, replace(state.records[name], sources=("0123456789ab",)))
    command = invoke(["study", whole_study / "study.yaml", "--out", study_copy])
    assert command.exit_code == 0
    for sources in (present, "0123456789ab"):
        assert sources in command.stderr
    assert "done before" in command.output


@pytest.mark.slow
def test_a_robot_of_files_is_known_by_what_they_say(tmp_path: Path) -> None:
    """Its name alone kept the jumps of the robot that it was before."""
    shipped = Path(pronk.robots.__file__).parent / "mini_cheetah"
    printed = {}
    heights = {}
    for place in ("first", "moved", "heavier"):
        home = tmp_path / place
        shutil.copytree(shipped, home / "robot")
        if place != "first":
            shutil.copytree(tmp_path / "first" / "out", home / "out")
        if place == "heavier":
            model = home / "robot" / "mini_cheetah.xml"
            text = model.read_text()
            assert HEAVY[0] in text
            model.write_text(text.replace(*HEAVY))
        path = write_study(
            home / "study.yaml",
            arms={"hopper": {"policies": [str(write_hopper(home / "policy.onnx"))]}},
            training={"robot": "robot/robot.yaml"},
            outcomes=["height"],
            trial={"commands": ["0,0"], "jumps": 1},
        )
        printed[place] = accepted("study", path, "--out", home / "out")
        (cell,) = load_study_results(home / "out" / "study.json").cells
        heights[place] = cell.value
    assert "1 of 1 task was done before" in printed["moved"]
    assert "done before" not in printed["heavier"]
    assert heights["moved"] == heights["first"]
    assert heights["heavier"] != heights["first"]


NAIVE = ("--gains", "naive")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("all", "--seeds", "1-2"), "--gains"),
        (("all", *NAIVE, "--seeds", "2-1"), "2-1"),
        (("all", *NAIVE, "--seeds", "1-2", "--seed", "4"), "--seed|--seeds"),
        (("all", *NAIVE, *NAIVE), "naive|twice"),
        (("all", *NAIVE, "--gains", "nowhere.yaml"), "nowhere.yaml"),
        (("all", *NAIVE, "--seeds", "1", "--jobs", "0"), "--jobs is 0"),
        (("all", *NAIVE, "--jobs", "2", "--gpus", "all"), "--jobs|--per-gpu"),
        (("all", *NAIVE, "--gpus", "0,0"), "--gpus"),
        (("all", *NAIVE, "--gpus", "all", "--device", "cpu"), "--gpus all"),
        (("all", *NAIVE, "--per-gpu", "2", "--device", "cpu"), "--per-gpu|--jobs"),
        (("all", *NAIVE, "--seeds", "1", "--gpu-ids", "0"), "--gpu-ids|--gpus"),
        (("all", *NAIVE, "--seeds", "1", "--minutes", "3"), "--minutes"),
        (("all", *NAIVE, "--seeds", "1", "--resume"), "--resume"),
        (("all", *NAIVE, "--cluster", "http://x"), "--cluster 'http://x'|ray://HOST:PORT"),
        (("all", *NAIVE, "--cluster", "local", "--jobs", "2"), "--cluster|--jobs"),
        (("all", *NAIVE, "--seeds", "1", "--phase", "run=3"), "'run'"),
        (("jump", *NAIVE, "--seeds", "1-2"), "--init-checkpoint"),
        (("all", "--gains", str(GAINS), "--seeds", "1", "--ranges-from", "x"), "--ranges-from x"),
    ],
)
def test_bad_input_to_several_trainings(
    tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    pytest.importorskip("torch")
    pytest.importorskip("mjlab")
    out = tmp_path / "runs"
    text = refused("train", *arguments, "--out", out)
    for word in words.split("|"):
        assert word in text, (word, text)
    assert not out.exists()


def test_the_words_of_a_training_give_its_settings_again(tmp_path: Path) -> None:
    examples = (
        TrainSettings(task="all", out=tmp_path, gains="naive", seed=4),
        TrainSettings(
            task="all", out=tmp_path, gains="g.yaml", draws=DrawSettings(ellipsoid=True), envs=8
        ),
        TrainSettings(
            task="all",
            out=tmp_path,
            gains="g.yaml",
            draws=DrawSettings(by_joint=True, weakest_drive=0.7),
            recipe=(Path("r.yaml"), Path("s.yaml")),
        ),
        TrainSettings(
            task="all",
            out=tmp_path,
            gains="naive",
            ranges_from=Path("a.yaml"),
            phase=("walk=3", "jump_a=2"),
            allow_unmatched=True,
        ),
        TrainSettings(task="jump", out=tmp_path, gains="naive", init_checkpoint=Path("walk.pt")),
    )
    for settings in examples:
        completed = settings.completed()
        values = parsed_command(training_words(completed))
        stored = values["settings"].stored_values() | {"gains": values["gains"][0]}
        assert stored == completed.stored_values()
        assert len(values["gains"]) == 1


def test_the_spread_over_seeds_leaves_out_what_is_missing() -> None:
    runs = [{"reward": 1.0}, {"reward": None}, {"reward": 3.0}]
    assert spread_over_seeds(runs, "reward") == {
        "mean": 2.0,
        "std": pytest.approx(2.0**0.5),
        "min": 1.0,
        "max": 3.0,
        "n": 2,
    }
    assert spread_over_seeds([{"reward": None}], "reward")["mean"] is None


def test_an_arm_with_one_finished_training_is_named_as_without_spread() -> None:
    figures = {"reward": 3.0, "episode_steps": 4.0, "speed_range": 1.0}
    rates = {"steps_per_second": 100.0, "seconds": 5.0}
    arms = []
    for name, finished in (("whole", 2), ("lone", 1), ("failed", 0)):
        runs = []
        for seed in range(2):
            state = "done" if seed < finished else "failed"
            runs.append({"seed": seed, "state": state, **figures, **rates})
        done = runs[:finished]
        spreads = {
            figure: spread_over_seeds(done, figure) for figure in runs[0] if figure in SPREADS
        }
        arms.append({"name": name, "trainings": runs, "spread_over_seeds": spreads})
    table = trainings_table({"arms": arms})
    (note,) = [note for note in table.notes if "n = 1" in note]
    assert "lone" in note
    assert "whole" not in note
    assert "failed" not in note
    assert [row[1] for row in table.rows] == ["2/2", "1/2", "0/2"]


def test_randomization_is_about_the_gains_that_are_trained_with() -> None:
    gains = load_gains(GAINS)
    robot = load_robot("mini_cheetah")
    wide = RandomizationConfig(stiffness=0.3, damping=0.2)
    matched = randomized_gains(gains, wide, None)
    nominal = randomized_gains(gains, wide, robot)
    for name, group in gains.groups.items():
        assert matched.groups[name].stiffness == group.stiffness
        assert matched.groups[name].stiffness_range == pytest.approx(0.3 * group.stiffness)
        assert matched.groups[name].damping_range == pytest.approx(0.2 * group.damping)
        joint = robot.group(name)[0]
        assert nominal.groups[name].stiffness_range == pytest.approx(0.3 * joint.stiffness)
    assert json.dumps(sorted(nominal.groups)) == json.dumps(sorted(gains.groups))
