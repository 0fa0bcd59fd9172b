"""Bad input to `pronk train`: one sentence, exit status 2, nothing written; devices and folders."""

from __future__ import annotations

import shutil
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("torch")
pytest.importorskip("mjlab")
import pronk.robots
from command_line import refused
from pronk.errors import PronkError
from pronk.jump.study.robot_inputs import robot_input
from pronk.jump.train import devices
from pronk.jump.train.gains import training_gains
from pronk.jump.train.phases import TASKS
from pronk.jump.train.provenance import RunFolder, new_record
from pronk.jump.train.rl.runner import stop_signals
from pronk.jump.train.run import run_training
from pronk.jump.train.settings import DrawSettings, TrainSettings
from pronk.jump.train.tasks import load_task
from pronk.robots import load_robot

pytestmark = pytest.mark.train
NAIVE = ("--gains", "naive")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("fly", *NAIVE), "walk|jump|all"),
        (("walk",), "--gains|gains.yaml|naive"),
        (("walk", "--gains", "nowhere.yaml"), "nowhere.yaml|no such file"),
        (("walk", *NAIVE, "--phase", "run=3"), "'run'|walk"),
        (("walk", *NAIVE, "--phase", "jump_a=3"), "'jump_a'"),
        (("jump", *NAIVE, "--phase", "walk=3"), "'walk'|jump_a, jump_b"),
        (("walk", *NAIVE, "--phase", "walk=0"), "0 iterations|1 or more"),
        (("walk", *NAIVE, "--phase", "walk"), "--phase 'walk'|walk=300"),
        (("walk", *NAIVE, "--phase", "walk=many"), "walk=many|walk=300"),
        (("walk", *NAIVE, "--phase", "walk=3", "--phase", "walk=4"), "--phase walk|twice"),
        (("walk", "--gains", "a.yaml", "--ranges-from", "b.yaml"), "b.yaml|--gains naive"),
        (("walk", *NAIVE, "--ranges-from", "b.yaml"), "b.yaml|no such file"),
        (("jump", *NAIVE), "--init-checkpoint|pronk train all"),
        (("walk", *NAIVE, "--init-checkpoint", "x"), "--init-checkpoint x|jump"),
        (("jump", *NAIVE, "--init-checkpoint", "nowhere"), "nowhere|phase walk is over"),
        (("walk", *NAIVE, "--gpu-ids", "0,0"), "--gpu-ids '0,0'|different"),
        (("walk", *NAIVE, "--gpu-ids", "0", "--device", "cpu"), "--gpu-ids 0|cpu"),
        (("walk", *NAIVE, "--hosts", "a,,b"), "'a,,b'|empty"),
        (("walk", *NAIVE, "--hosts", ""), "''|empty"),
        (("walk", *NAIVE, "--hosts", "a,b,A"), "'a,b,A'|twice"),
        (("walk", *NAIVE, "--hosts", "me@a"), "'me@a'|~/.ssh/config"),
        (("walk", *NAIVE, "--hosts", "a:22"), "'a:22'|~/.ssh/config"),
        (("walk", *NAIVE, "--hosts", "a;b"), "no host name"),
        (("walk", *NAIVE, "--hosts", "nowhere.invalid"), "nowhere.invalid|does not resolve"),
        (("walk", *NAIVE, "--hosts", "a,b", "--seeds", "1-2"), "--hosts|--cluster"),
        (("walk", *NAIVE, "--minutes", "0"), "minutes is 0|more than 0"),
        (("walk", *NAIVE, "--save-interval", "0"), "save-interval is 0|1 or more"),
        (("walk", *NAIVE, "--envs", "1"), "envs is 1|2 or more"),
        (("walk", *NAIVE, "--ellipsoid"), "ellipsoid|box"),
        (("walk", *NAIVE, "--ellipsoid", "--resume"), "holds no run"),
        (("walk", *NAIVE, "--ellipsoid", "--by-joint"), "--ellipsoid|--by-joint|one of them"),
        (("walk", *NAIVE, "--by-joint"), "--by-joint|--ranges-from"),
        (("walk", *NAIVE, "--weakest-drive", "0.1"), "--weakest-drive is 0.1|0.3 to 1"),
        (("walk", *NAIVE, "--weakest-drive", "nan"), "--weakest-drive is nan|0.3 to 1"),
        (("walk", *NAIVE, "--robot", "so101"), "so101|no training task|mini_cheetah"),
        (("walk", "--resume"), "holds no run|--resume"),
    ],
)
def test_bad_input(tmp_path: Path, arguments: tuple[str, ...], words: str) -> None:
    out = tmp_path / "run"
    text = refused("train", *arguments, "--out", out)
    for word in words.split("|"):
        assert word in text, (word, text)
    assert not out.exists()


def test_a_folder_that_is_not_empty_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("kept")
    text = refused("train", "walk", *NAIVE, "--out", tmp_path)
    assert "notes.txt" in text
    assert "--resume" in text
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    assert "is a file" in refused("train", "walk", *NAIVE, "--out", tmp_path / "notes.txt")


@pytest.mark.parametrize("content", ["", "[]", '{"schema": "pronk/run/1"}', "{"])
def test_damaged_provenance_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "provenance.json").write_text(content)
    with pytest.raises(PronkError):
        run_training(TrainSettings(task="walk", out=tmp_path, resume=True))


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("settings",), []),
        (("settings", "phase"), "walk=4"),
        (("settings", "envs"), "many"),
        (("settings", "task"), None),
        (("gains",), "matched"),
        (("gains", "sha256"), 5),
        (("recipe",), ["walk_speed.yaml"]),
        (("recipe",), {"sha256": "", "task": 0.5}),
        (("task", "contact_damping"), "soft"),
        (("finished",), "yes"),
        (("sessions",), [{}]),
        (("sessions",), {}),
    ],
)
def test_a_record_with_a_value_of_another_type_is_refused(
    tmp_path: Path, place: tuple[str, ...], value: Any
) -> None:
    settings = TrainSettings(task="walk", out=tmp_path, gains="naive").completed()
    gains = training_gains("naive", load_robot("mini_cheetah"))
    record = new_record(settings, gains, task={"contact_damping": 0.4})
    folder = RunFolder(tmp_path)
    folder.write(record)
    assert folder.read() == record
    target = record
    for name in place[:-1]:
        target = target[name]
    target[place[-1]] = value
    folder.write(record)
    text = refused("train", "walk", "--resume", "--out", tmp_path)
    assert "provenance.json" in text
    assert place[0] in text


def test_settings_of_a_run_return_when_it_is_resumed(tmp_path: Path) -> None:
    first = TrainSettings(task="all", out=tmp_path, gains="naive", phase=("walk=7",), seed=0)
    stored = first.completed().stored_values()
    again = TrainSettings(task="all", out=tmp_path, resume=True).resumed(stored)
    assert again.iterations == {**TASKS["all"], "walk": 7}
    assert (again.seed, again.envs, again.gains, again.robot) == (0, 4096, "naive", "mini_cheetah")
    changes: Any = (
        {"envs": 8},
        {"gains": "x.yaml"},
        {"draws": DrawSettings(ellipsoid=True)},
        {"phase": ("walk=8",)},
    )
    for changed in changes:
        with pytest.raises(PronkError, match="leave it out"):
            TrainSettings(task="all", out=tmp_path, resume=True, **changed).resumed(stored)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_ends_training_and_the_next_has_its_usual_effect(
    number: signal.Signals,
) -> None:
    before, runner = signal.getsignal(number), SimpleNamespace(stop_reason="")
    with stop_signals(runner):
        signal.raise_signal(number)
        assert (runner.stop_reason, signal.getsignal(number)) == (number.name, before)
    assert signal.getsignal(number) is before


# --- Devices -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gpu_ids", "visible"),
    [(None, ("4",)), ("0,2", ("4", "7")), ("all", ("4", "5", "7")), ("2", ("7",))],
)
def test_gpus_are_those_of_the_visible_ones(
    monkeypatch: pytest.MonkeyPatch, gpu_ids: str | None, visible: tuple[str, ...]
) -> None:
    monkeypatch.setattr(devices, "visible_gpus", lambda: ("4", "5", "7"))
    assert devices.find_devices("auto", gpu_ids) == visible


def test_missing_gpus_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "visible_gpus", lambda: ("0",))
    with pytest.raises(PronkError, match="1 visible"):
        devices.find_devices("cuda", "1")
    monkeypatch.setattr(devices, "visible_gpus", lambda: ())
    for requested, ids in (("cuda", None), ("auto", "0")):
        with pytest.raises(PronkError, match="no GPU"):
            devices.find_devices(requested, ids)
    assert devices.find_devices("auto") == ()


# --- Tasks of other robots -----------------------------------------------------------------------

ENV_CFGS = """
from pronk.jump.train.tasks.jump_env_cfg import jump_env_cfg

def env_cfg(robot, gains, **options):
    cfg = jump_env_cfg(robot, gains, **options)
    cfg.rewards["posture"].weight = -1.0
    return cfg
"""


def test_a_robot_with_its_own_task(tmp_path: Path) -> None:
    """`env_cfgs.py` beside the robot's file; the configuration of PPO is the shared one."""
    shipped = Path(pronk.robots.__file__).parent / "mini_cheetah"
    shutil.copytree(shipped, tmp_path, dirs_exist_ok=True)
    robot = str(tmp_path / "robot.yaml")
    (tmp_path / "env_cfgs.py").unlink()
    with pytest.raises(PronkError, match="no training task"):
        load_task(robot)
    (tmp_path / "env_cfgs.py").write_text(ENV_CFGS)
    task = load_task(robot)
    cfg = task.env_cfg(task.robot, training_gains("naive", task.robot), iterations=TASKS["all"])
    assert cfg.rewards["posture"].weight == -1.0
    assert task.rl_cfg(iterations=3).max_iterations == 3
    for text, words in (("def env_cfg(:", "cannot be imported"), ("x = 1", "no function")):
        (tmp_path / "env_cfgs.py").write_text(text)
        with pytest.raises(PronkError, match=words):
            load_task(robot)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        # mjlab's own pushes have this parameter.
        (
            'cfg.events["push"].params["velocity_range"] = {"x": (-0.5, 0.5)}',
            ["events['push']", "velocity_range", "yaw_rate"],
        ),
        ('del cfg.rewards["posture"].params["standing"]', ["rewards['posture']", "standing"]),
        ('cfg.terminations["fell"].func = "fall"', ["terminations['fell']", "str"]),
        ('cfg.rewards["height"].weight = 2.0', ["KeyError", "height", "line 6"]),
        (
            'cfg.rewards["posture"] = type(cfg.rewards["posture"])(func=broken, weight=1.0)',
            ["ZeroDivisionError", "line 10"],
        ),
    ],
)
def test_mistakes_in_the_task_of_a_robot_are_named_as_such(
    change: str, words: list[str], tmp_path: Path
) -> None:
    shipped = Path(pronk.robots.__file__).parent / "mini_cheetah"
    shutil.copytree(shipped, tmp_path / "robot")
    lines = ENV_CFGS.replace('cfg.rewards["posture"].weight = -1.0', change)
    (tmp_path / "robot" / "env_cfgs.py").write_text(
        f"{lines}\ndef broken(env):\n    return 1 / 0\n"
    )
    text = refused(
        *("train", "walk", *NAIVE, "--robot", tmp_path / "robot" / "robot.yaml"),
        *("--envs", "2", "--phase", "walk=1", "--device", "cpu", "--out", tmp_path / "run"),
    )
    for word in ["env_cfgs.py", *words]:
        assert word in text, (word, text)


def test_the_robot_of_a_run_in_a_study_is_found_from_any_folder(tmp_path: Path) -> None:
    """The run names the copy in the folder of the study, which `evaluate` and --resume look for."""
    shipped = Path(pronk.robots.__file__).parent / "mini_cheetah"
    shutil.copytree(shipped, tmp_path / "robot")
    (tmp_path / "robot" / "env_cfgs.py").write_text(ENV_CFGS)
    root = tmp_path / "study"
    copy = robot_input(root, str(tmp_path / "robot" / "robot.yaml"), is_trained=True)
    shutil.rmtree(tmp_path / "robot")
    folder = RunFolder(root / "trainings" / "arm" / "seed-1")
    task = load_task(folder.robot(copy.name))
    assert task.robot.joints == load_robot("mini_cheetah").joints
    assert folder.robot("go2") == "go2"
    assert folder.robot("nowhere.yaml") == "nowhere.yaml"
