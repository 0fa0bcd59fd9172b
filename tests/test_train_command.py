"""`pronk train`: what is refused before anything is built, and the folder of a run."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from pronk.cli import main as cli
from pronk.errors import ArtefactError, PronkError
from pronk.match import gains as gains_file
from pronk.train.runner import checkpoint, provenance
from pronk.train.runner.checkpoint import Checkpoint
from pronk.train.runner.devices import Devices, check_cuda_graphs, chosen, parse_gpu_ids
from pronk.train.runner.run_folder import RunFolder, plain
from pronk.train.runner.settings import TrainSettings, WatchSettings


def settings(**changes) -> TrainSettings:
    given = {
        "task": "all",
        "gains": "naive",
        "iterations": {"walk": 3, "jump_a": 2, "jump_b": 2},
        "envs": 16,
        "seed": 5,
        "device": "cpu",
    }
    return TrainSettings(**{**given, **changes})


def refused(capsys, *arguments: str | Path) -> str:
    """Run `pronk train`, which must end with one sentence; return it."""
    status = cli.run(["train", *map(str, arguments)])
    shown = capsys.readouterr()
    assert status == 2, shown
    assert shown.out == ""
    lines = shown.err.strip().splitlines()
    assert len(lines) == 1, shown.err
    return lines[0]


def walking_policy(path: Path, phase: str = "walk") -> Path:
    """A file that says it is a checkpoint of a phase."""
    checkpoint.save(path, Checkpoint(about={"phase": phase}, tree={"weights": np.zeros(3)}))
    return path


# --- Refused before anything is built ------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("fly", "--gains", "naive"), "walk|jump|all|train --help"),
        (("walk",), "--gains|gains.yaml|naive"),
        (("walk", "--gains", "nowhere.yaml"), "nowhere.yaml|no such file|pronk match"),
        (("walk", "--gains", "naive", "--phase", "run=3"), "no phase 'run'|walk"),
        (("walk", "--gains", "naive", "--phase", "jump_a=3"), "no phase 'jump_a'"),
        (("walk", "--gains", "naive", "--phase", "walk=0"), "0 iterations|1 or more"),
        (("walk", "--gains", "naive", "--phase", "walk"), "--phase 'walk'|walk=300"),
        (("walk", "--gains", "naive", "--phase", "walk=many"), "walk=many|walk=300"),
        (
            ("walk", "--gains", "naive", "--phase", "walk=3", "--phase", "walk=4"),
            "--phase walk|twice",
        ),
        (
            ("walk", "--gains", "a.yaml", "--ranges-from", "b.yaml"),
            "--ranges-from b.yaml|--gains naive",
        ),
        (("walk", "--gains", "naive", "--ranges-from", "b.yaml"), "b.yaml|no such file"),
        (("jump", "--gains", "naive"), "--init-checkpoint|pronk train all"),
        (
            ("walk", "--gains", "naive", "--init-checkpoint", "x"),
            "--init-checkpoint x|jump|random weights",
        ),
        (
            ("jump", "--gains", "naive", "--init-checkpoint", "nowhere"),
            "--init-checkpoint nowhere|phase walk is over",
        ),
        (("walk", "--gains", "naive", "--gpu-ids", "one"), "--gpu-ids 'one'|0,1|all"),
        (("walk", "--gains", "naive", "--gpu-ids", "0,0"), "--gpu-ids '0,0'|different"),
        (("walk", "--gains", "naive", "--gpu-ids", "0", "--device", "cpu"), "--gpu-ids 0|cpu"),
        (("walk", "--gains", "naive", "--device", "tpu"), "auto|cpu|cuda"),
        (("walk", "--gains", "naive", "--minutes", "0"), "minutes is 0|more than 0"),
        (("walk", "--gains", "naive", "--save-interval", "0"), "save interval is 0|1 or more"),
        (("walk", "--gains", "naive", "--logger", "csv"), "tensorboard|wandb|none"),
        (("walk", "--resume"), "--resume|holds no run"),
    ],
)
def test_refusals_say_what_is_wrong_and_leave_nothing(capsys, tmp_path, arguments, words):
    out = tmp_path / "run"
    said = refused(capsys, *arguments, "--out", out)
    for word in words.split("|"):
        assert word in said, (word, said)
    assert not out.exists()


def test_a_folder_that_is_not_empty_is_left_alone(capsys, tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    said = refused(capsys, "walk", "--gains", "naive", "--out", tmp_path)
    assert "thesis.txt" in said
    assert "--resume" in said
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]
    said = refused(capsys, "walk", "--gains", "naive", "--out", tmp_path / "thesis.txt")
    assert "is a file" in said


def test_gains_of_another_robot_are_refused(capsys, tmp_path):
    simulator = gains_file.SimulatorInfo(version="3.11.0")
    gains = gains_file.MatchedGains(robot="so101", simulator=simulator, joints={}, groups={})
    gains_file.save(tmp_path / "arm.yaml", gains)
    said = refused(capsys, "walk", "--gains", tmp_path / "arm.yaml", "--out", tmp_path / "run")
    assert "so101" in said
    assert "mini_cheetah" in said


def test_only_a_walking_policy_is_widened(capsys, tmp_path):
    arguments = ("jump", "--gains", "naive", "--out", tmp_path / "run", "--init-checkpoint")
    said = refused(capsys, *arguments, walking_policy(tmp_path / "a.pt", "jump_b"))
    assert "phase jump_b" in said
    damaged = tmp_path / "b.pt"
    damaged.write_bytes(b"\x80\x04\x95 pickled")
    assert "not a checkpoint" in refused(capsys, *arguments, damaged)
    unfinished = RunFolder(tmp_path / "unfinished")
    walking_policy(unfinished.checkpoints / "model_50.pt")
    assert "phase walk is over" in refused(capsys, *arguments, unfinished.path)


def test_without_the_extra_one_sentence_says_what_to_install(tmp_path):
    code = """
import sys
from importlib.machinery import PathFinder

class Core(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        hidden = name.partition(".")[0] in ("torch", "mjlab")
        return None if hidden else super().find_spec(name, path, target)

sys.meta_path = [Core if finder is PathFinder else finder for finder in sys.meta_path]
from pronk.cli import main as cli
sys.exit(cli.run(sys.argv[1:]))
"""
    words = ["train", "walk", "--gains", "naive", "--out", str(tmp_path / "run")]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1
    assert "torch, mjlab" in done.stderr
    assert 'pip install "pronk[train]"' in done.stderr
    assert not (tmp_path / "run").exists()


@pytest.mark.train
def test_a_gpu_that_is_not_there_is_refused(capsys, tmp_path):
    torch = pytest.importorskip("torch")
    if torch.cuda.device_count():
        pytest.skip("this machine has a GPU")
    for arguments in (("--device", "cuda"), ("--gpu-ids", "all")):
        said = refused(capsys, "walk", "--gains", "naive", "--out", tmp_path / "run", *arguments)
        assert "no GPU was found" in said
        assert "--device cpu" in said
    assert not (tmp_path / "run").exists()


# --- Resuming with other settings ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("walk",), "the task is walk|all"),
        (("all", "--seed", "6"), "seed is 6|5"),
        (("all", "--envs", "32"), "envs is 32|16"),
        (("all", "--ellipsoid"), "--ellipsoid is True|False"),
        (("all", "--phase", "jump_b=9"), "iterations of jump_b is 9|has 2"),
        (("jump", "--init-checkpoint", "walk.pt"), "the task is jump|all"),
    ],
)
def test_resuming_with_another_setting_names_it(capsys, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    walking_policy(Path("walk.pt"))
    RunFolder(Path("run")).write_config(settings(), {})
    said = refused(capsys, *arguments, "--out", "run", "--resume")
    for word in ("--resume", "leave it out", *words.split("|")):
        assert word in said, (word, said)


def test_resuming_with_other_gains_or_another_walk_is_refused(capsys, tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.write_config(settings(gains="matched", gains_sha256="0" * 64), {})
    said = refused(capsys, "all", "--gains", "naive", "--out", folder.path, "--resume")
    assert "--gains is naive, but the run in" in said
    start = walking_policy(tmp_path / "walk.pt")
    jump = {"jump_a": 1, "jump_b": 1}
    other = settings(task="jump", iterations=jump, start=str(start), start_sha256="1" * 64)
    folder.write_config(other, {})
    said = refused(capsys, "jump", "--init-checkpoint", start, "--out", folder.path, "--resume")
    assert "--init-checkpoint is" in said


@pytest.mark.parametrize("text", ["", "[1, 2", "schema: pronk/gains/1", "schema: {a: b"])
def test_a_damaged_configuration_is_not_resumed(capsys, tmp_path, text):
    folder = RunFolder(tmp_path / "run")
    folder.path.mkdir()
    folder.config.write_text(text)
    assert "config.yaml" in refused(capsys, "all", "--out", folder.path, "--resume")


def test_an_unknown_setting_is_not_resumed(capsys, tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.write_config(settings(), {})
    folder.config.write_text(folder.config.read_text().replace("envs:", "robots:"))
    said = refused(capsys, "all", "--out", folder.path, "--resume")
    assert "robots" in said
    assert "ellipsoid" in said


# --- Settings ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {"task": "swim"},
        {"gains": "guessed"},
        {"device": "tpu"},
        {"iterations": {"walk": 3, "jump_a": 2}},
        {"iterations": {"walk": 3, "jump_a": 2, "jump_b": 2, "jump_c": 1}},
        {"envs": 1},
        {"seed": -1},
        {"gpus": 2},
        {"gpus": 0, "device": "cuda"},
        {"start": "walk.pt"},
        {"task": "jump", "iterations": {"jump_a": 1, "jump_b": 1}},
    ],
)
def test_impossible_settings_are_refused(changes):
    with pytest.raises(PronkError):
        settings(**changes)


def test_settings_survive_the_configuration_file(tmp_path):
    folder = RunFolder(tmp_path / "run")
    for stored in (settings(), settings(gpus=2, device="cuda", ellipsoid=True, seed=7)):
        folder.write_config(stored, {"more": [1, 2]})
        assert folder.settings() == stored
    assert yaml.safe_load(folder.config.read_text())["more"] == [1, 2]


def test_what_a_task_trains():
    assert settings().phases == ("walk", "jump_a", "jump_b")
    assert settings().total_iterations == 7
    assert settings(task="walk", iterations={"walk": 4}).phases == ("walk",)
    with pytest.raises(PronkError, match="minutes"):
        WatchSettings(minutes=-1.0)


# --- Devices -------------------------------------------------------------------------------------


@pytest.mark.train
def test_together_takes_as_many_steps_as_in_sequence() -> None:
    pytest.importorskip("mjlab")
    from pronk.train.runner.request import Request, new_settings

    asked = {
        task: new_settings(Request(task=task, gains="naive", device="cpu"))[0]
        for task in ("all", "together")
    }
    assert asked["together"].phases == ("jump_a", "jump_b")
    assert asked["together"].total_iterations == asked["all"].total_iterations
    assert asked["together"].iterations["jump_b"] == asked["all"].iterations["jump_b"]


def test_gpus_are_chosen_among_the_visible_ones():
    # As CUDA_VISIBLE_DEVICES may have it: numbers out of order, or names.
    assert chosen(("3", "1"), None) == ("3",)
    assert chosen(("3", "1"), [1]) == ("1",)
    assert chosen(("3", "MIG-a"), "all") == ("3", "MIG-a")
    with pytest.raises(PronkError, match=r"shows 2 GPU\(s\), numbered 0 to 1"):
        chosen(("3", "1"), [0, 2])
    assert parse_gpu_ids(" 1, 0") == [1, 0]
    assert Devices(device="cuda", visible=("3", "1")).count == 2
    assert Devices(device="cpu").count == 1


@pytest.mark.train
def test_a_device_without_cuda_graphs_is_shouted_about():
    wp = pytest.importorskip("warp")
    without = SimpleNamespace(use_cuda_graph=False, wp_device=wp.get_device("cpu"))
    said = check_cuda_graphs(without)
    assert said is not None
    for word in ("WITHOUT CUDA GRAPHS", "12.4", "memory pools are off"):
        assert word in said
    assert check_cuda_graphs(SimpleNamespace(use_cuda_graph=True)) is None


def test_only_the_chosen_gpus_are_seen(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,1")
    Devices(device="cpu").claim()
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "3,1"
    Devices(device="cuda", visible=("1", "MIG-a")).claim()
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "1,MIG-a"


# --- The folder ----------------------------------------------------------------------------------


class Colour(StrEnum):
    RED = "red"


@dataclass
class Part:
    size: int
    law: object


def test_configuration_becomes_plain():
    value = {
        "law": abs,
        "part": Part(size=np.int64(3), law=partial(max, 1, key=abs)),
        "colour": Colour.RED,
        "range": (np.float32(0.5), None),
        "array": np.eye(2),
        3: {True},
        "all": slice(None),
        "object": object(),
    }
    made = plain(value)
    assert made == {
        "law": "builtins:abs",
        "part": {
            "size": 3,
            "law": {"partial": "builtins:max", "args": [1], "key": "builtins:abs"},
        },
        "colour": "red",
        "range": [0.5, None],
        "array": [[1.0, 0.0], [0.0, 1.0]],
        3: [True],
        "all": "slice(None, None, None)",
        "object": "builtins:object",
    }
    assert yaml.safe_load(yaml.safe_dump(made)) == made


def test_two_processes_do_not_train_in_one_folder(tmp_path):
    folder = RunFolder(tmp_path)
    with folder.locked(), pytest.raises(PronkError, match="another process"), folder.locked():
        pass
    with folder.locked():
        pass


# --- Provenance ----------------------------------------------------------------------------------


def test_provenance_is_read_back_and_changed_whole(tmp_path):
    path = tmp_path / "provenance.json"
    begun = provenance.begin(settings(gpus=2, device="cuda"), gains={"name": "naive"})
    provenance.write(path, begun)
    assert provenance.read(path) == begun
    assert begun["schema"] == "pronk/run/1"
    assert begun["seeds"] == [5, 6]
    with provenance.changed(path) as found:
        found["sessions"].append(provenance.session())
    session = provenance.read(path)["sessions"][0]
    assert session["versions"]["mujoco"].startswith("3.11")
    assert session["versions"]["python"] == sys.version.split()[0]
    with pytest.raises(KeyError), provenance.changed(path) as found:
        found["sessions"].pop() and found["nowhere"]
    assert len(provenance.read(path)["sessions"]) == 1
    for text in ("", "[]", '{"schema": "pronk/run/9"}'):
        path.write_text(text)
        with pytest.raises(ArtefactError):
            provenance.read(path)


def test_changed_versions_are_named(tmp_path):
    session = provenance.session()
    assert provenance.changed_versions({"sessions": [session]}) == []
    session["versions"]["mujoco"] = "2.0.0"
    changed = provenance.changed_versions({"sessions": [session]})
    assert changed == [f"mujoco was 2.0.0 and is {provenance.versions()['mujoco']}"]


def test_the_commit_is_pronks_own_or_none(tmp_path, monkeypatch):
    import pronk

    # An installed copy inside somebody else's repository is not in that repository's commit.
    package = tmp_path / "site-packages" / "pronk"
    package.mkdir(parents=True)
    shutil.copy(pronk.__file__, package)
    monkeypatch.setattr(pronk, "__file__", str(package / "__init__.py"))
    assert provenance.git_state() is None
    if shutil.which("git") is None:
        return
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c"]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "theirs"], check=True)
    assert provenance.git_state() is None
    subprocess.run([*git, "add", "-A"], check=True)
    subprocess.run([*git, "commit", "-q", "-m", "ours"], check=True)
    state = provenance.git_state()
    assert state is not None
    assert not state["changed"]
    (package / "__init__.py").write_text("changed")
    assert provenance.git_state() == {"commit": state["commit"], "changed": True}
    monkeypatch.setenv("PATH", "")
    assert provenance.git_state() is None


def test_provenance_is_strict_json(tmp_path):
    path = tmp_path / "provenance.json"
    with pytest.raises(ValueError, match="JSON"):
        provenance.write(path, {"seconds": float("nan")})
    assert not path.exists()
    provenance.write(path, {"seconds": 1.0})
    assert json.loads(path.read_text()) == {"seconds": 1.0}
