"""A robot of files in a study: its tasks follow what the files say, wherever they lie."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

pytest.importorskip("onnxruntime")
import pronk.robots
from command_line import refused
from hopper import write_hopper
from pronk.jump.study.config import load_study
from pronk.jump.study.study import plan_study, study_tasks
from pronk.jump.study.tasks import StudyTask
from pronk.jump.study.trainings import TrainingArm, TrainingPlace, training_tasks
from pronk.jump.train.settings import TrainSettings
from pronk.robots import load_robot
from study_cases import write_study

SHIPPED = Path(pronk.robots.__file__).parent / "mini_cheetah"
MASS = ('mass="6.607999999999999"', 'mass="7.608"')
GAINS = ("stiffness: 17.0", "stiffness: 18.0")


def robot_in(folder: Path) -> Path:
    """Copy the Mini Cheetah with a task of its own to a folder; return its robot.yaml."""
    shutil.copytree(SHIPPED, folder)
    (folder / "env_cfgs.py").write_text("from pronk.jump.train.tasks import jump_env_cfg\n")
    return folder / "robot.yaml"


def change(path: Path, old: str, new: str) -> None:
    """Replace a text in a file, which has to have it."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def training_of(robot: str, root: Path) -> StudyTask:
    """Return the task of a training of a robot."""
    settings = TrainSettings(task="all", out=root, gains="naive", robot=robot)
    arm = TrainingArm(name="arm", settings=settings)
    (task,) = training_tasks([arm], [1], root, TrainingPlace(device="cpu"))
    return task


def trial_of(robot: str, folder: Path, root: Path) -> StudyTask:
    """Return the task of a trial of a finished policy on a robot."""
    folder.mkdir(exist_ok=True)
    policy = write_hopper(folder / "policy.onnx")
    path = write_study(
        folder / "study.yaml",
        arms={"hopper": {"policies": [str(policy)]}},
        training={"robot": robot},
    )
    plan = plan_study(load_study(path), folder, {})
    (task,) = study_tasks(plan, root, TrainingPlace(device="cpu"))
    return task


@pytest.mark.parametrize("kind", ["training", "trial"])
def test_a_study_of_a_robot_moves_to_another_folder(tmp_path: Path, kind: str) -> None:
    """As to another machine: the same robot under another path is the same task."""
    tasks = []
    for name in ("here", "there"):
        home = tmp_path / name
        home.mkdir()
        robot = str(robot_in(home / "robot"))
        root = home / "study"
        if kind == "training":
            tasks.append(training_of(robot, root))
        else:
            tasks.append(trial_of(robot, home, root))
        # All that the command reads is in the folder of the study, as a node of a cluster needs it.
        assert str(tmp_path) not in " ".join(tasks[-1].command)
        copy = tasks[-1].command[tasks[-1].command.index("--robot") + 1]
        assert load_robot(root / copy).joints == load_robot(robot).joints
        assert copy in tasks[-1].inputs
    here, there = tasks
    assert here.command == there.command
    assert here.key(tmp_path / "here" / "study") == there.key(tmp_path / "there" / "study")


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [("robot.yaml", *GAINS), ("mini_cheetah.xml", *MASS), ("env_cfgs.py", "\n", "\n\n")],
)
def test_a_changed_file_of_a_robot_is_another_task(
    tmp_path: Path, file: str, old: str, new: str
) -> None:
    """Name and path of the robot stay. What only training reads is nothing to a trial."""
    path = robot_in(tmp_path / "robot")
    root = tmp_path / "study"
    training = training_of(str(path), root)
    trial = trial_of(str(path), tmp_path / "files", root)
    change(path.with_name(file), old, new)
    changed_training = training_of(str(path), root)
    changed_trial = trial_of(str(path), tmp_path / "files", root)
    assert changed_training.key(root) != training.key(root)
    assert (changed_trial.key(root) == trial.key(root)) == (file == "env_cfgs.py")


@pytest.mark.parametrize("robot", ["mini_cheetah", "go2"])
def test_tasks_of_a_shipped_robot_have_its_name_alone(tmp_path: Path, robot: str) -> None:
    """Folders of their studies stay valid."""
    task = training_of(robot, tmp_path)
    assert task.inputs == ()
    assert task.settings["robot"] == robot
    trial = trial_of("mini_cheetah", tmp_path / "files", tmp_path / "study")
    assert "--robot" not in trial.command
    assert len(trial.inputs) == 3


def test_a_folder_and_a_model_without_a_file_are_robots_of_a_study(tmp_path: Path) -> None:
    path = robot_in(tmp_path / "robot")
    of_folder = training_of(str(path.parent), tmp_path / "study")
    assert of_folder.key(tmp_path / "study") == training_of(str(path), tmp_path / "study").key(
        tmp_path / "study"
    )
    of_model = training_of(str(path.with_name("mini_cheetah.xml")), tmp_path / "study")
    (robot,) = [file for file in of_model.inputs if file.endswith(".xml")]
    assert of_model.settings["robot"] == robot


@pytest.mark.parametrize(
    ("file", "old", "new", "named"),
    [
        ("mini_cheetah.xml", "_thigh_collision", "_thigh_cover", "FR_thigh_collision"),
        ("env_cfgs.py", "", "", "env_cfgs.py"),
    ],
)
def test_a_robot_that_cannot_be_trained_is_refused_before_anything_is_written(
    tmp_path: Path, file: str, old: str, new: str, named: str
) -> None:
    """Not by each of its trainings, twice."""
    path = robot_in(tmp_path / "robot")
    if old:
        change(path.with_name(file), old, new)
    else:
        path.with_name(file).unlink()
    out = tmp_path / "study"
    words = ("--gains", "naive", "--seeds", "1-2", "--device", "cpu", "--jobs", "1")
    assert named in refused("train", "all", "--robot", path, *words, "--out", out)
    study = write_study(
        tmp_path / "study.yaml",
        arms={"nominal": {"gains": "naive"}},
        training={"robot": str(path)},
    )
    assert named in refused("study", study, "--out", out, "--device", "cpu", "--jobs", "1")
    assert not out.exists()
