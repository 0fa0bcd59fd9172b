"""The commands that a command names next read a log as it was read."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

import pronk.robots
from chirp_logs import chirp_log
from command_line import accepted, refused
from hopper import write_hopper
from log_files import write_mcap
from pronk.errors import ArtefactError
from pronk.identify.match.gains import load_gains
from pronk.robots import load_robot


def following(text: str, begin: str) -> list[str]:
    """Words of the command of a "next:" line that begins so."""
    for line in text.splitlines():
        words = shlex.split(line) if line.strip().startswith("pronk ") else []
        if words[1:2] == [begin]:
            return words[1:]
    raise AssertionError(f"no {begin} in {text}")


def test_match_and_predict_keep_the_options_of_reading(tmp_path: Path) -> None:
    log = chirp_log(load_robot("mini_cheetah"), "FR_knee", (22.0, 0.55), (0.2,))
    column = log.column("FR_knee")
    table = np.column_stack(
        [1e3 * log.time, np.degrees(log.command[:, column]), np.degrees(log.position[:, column])]
    )
    for name in ("first.csv", "fresh log.csv"):
        np.savetxt(
            tmp_path / name, table, delimiter=",", comments="", header="when,wanted,had", fmt="%.9g"
        )
    columns = "time=when,command.FR_knee=wanted,position.FR_knee=had"
    reading = ("--unit", "deg", "--time-unit", "ms", "--columns", columns)
    said = accepted("response", tmp_path / "first.csv", "--robot", "mini_cheetah", *reading)
    match_words = following(said, "match")
    gains = tmp_path / "gains.yaml"
    match_words[match_words.index("--out") + 1] = str(gains)
    said = accepted(*match_words)
    predict_words = following(said, "predict")
    assert "default" in predict_words
    predict_words[predict_words.index("FRESH_LOG")] = str(tmp_path / "fresh log.csv")
    assert "FR_knee" in accepted(*predict_words)


def test_a_sweep_names_its_folder_in_one_word(tmp_path: Path) -> None:
    logs = tmp_path / "my logs"
    words = ("--joints", "FR_hip_roll", "--amplitude", "0.1", "--repeats", "1")
    said = accepted("sweep", "mini_cheetah", *words, "--out", logs)
    assert following(said, "response") == ["response", str(logs), "--robot", "mini_cheetah"]
    match_words = following(said, "match")
    assert match_words[-2:] == ["--out", str(logs / "gains.yaml")]


@pytest.mark.parametrize("framework", ["isaaclab-implicit", "drake"])
def test_a_match_for_a_framework_goes_on_with_its_gains(framework: str, tmp_path: Path) -> None:
    robot = load_robot("mini_cheetah")
    log = chirp_log(robot, "FR_knee", (22.0, 0.55), (0.2,), repeats=2, noise_rad=1e-4)
    path = tmp_path / "knee.mcap"
    write_mcap(path, log)
    out = tmp_path / "out" / "gains.yaml"
    said = accepted("match", path, "--robot", "mini_cheetah", "--for", framework, "--out", out)
    headline = said.splitlines()[0]
    matched = load_gains(tmp_path / "out" / framework / "gains.yaml").joints["FR_knee"]
    assert headline.startswith(framework)
    assert f"{matched.quality.error_db:.2f} dB" in headline
    assert f"{matched.quality.nominal_error_db:.2f} dB" in headline
    assert f"{framework}/match.html" in said.partition("open ")[2].split()[0]
    gains_file = str(tmp_path / "out" / framework / "gains.yaml")
    assert gains_file in following(said, "predict")
    export_words = following(said, "export")
    assert gains_file in export_words
    file = tmp_path / export_words[-1]
    accepted(*export_words[:-1], file)
    if file.suffix != ".py":  # An MJCF of a motor has these gains in units of its voltage.
        return
    numbers = [float(number) for number in re.findall(r"\d+\.?\d*", file.read_text())]
    assert pytest.approx(matched.stiffness.value, rel=2e-3) in numbers


def own_robot(folder: Path) -> Path:
    """Write the Mini Cheetah as the robot `hopping` of a user, with a task; return its file."""
    shutil.copytree(Path(pronk.robots.__file__).parent / "mini_cheetah", folder)
    path = folder / "robot.yaml"
    path.write_text(path.read_text().replace("name: mini_cheetah", "name: hopping"))
    task = "from pronk.jump.train.tasks.jump_env_cfg import jump_env_cfg as env_cfg\n"
    (folder / "env_cfgs.py").write_text(task)
    return path


def test_a_policy_of_a_robot_of_files_needs_the_files(tmp_path: Path) -> None:
    """A policy holds the name of its robot; each command says how to give its files."""
    robot = own_robot(tmp_path / "my robot")
    policy = write_hopper(tmp_path / "policy.onnx", robot="hopping")
    for command in ("trial", "play", "deploy"):
        said = refused(command, policy)
        assert "'hopping'" in said
        assert "--robot" in said
    one_jump = ("--jumps", "1", "--commands", "0,0", "--no-video", "--out", tmp_path / "out")
    said = accepted("trial", policy, "--robot", robot, *one_jump)
    assert following(said, "play") == ["play", str(policy), "--robot", str(robot)]


@pytest.mark.train
def test_a_training_names_its_robot_to_what_follows(tmp_path: Path) -> None:
    pytest.importorskip("mjlab")
    from pronk.jump.trial.training_sim.adapter import load_evaluated_policy

    robot = str(own_robot(tmp_path / "robot"))
    words = ("--gains", "naive", "--phase", "walk=1", "--envs", "2", "--device", "cpu")
    said = accepted("train", "walk", "--robot", robot, *words, "--out", tmp_path / "run")
    for command in ("evaluate", "train"):
        next_words = following(said, command)
        assert next_words[next_words.index("--robot") + 1] == robot
    policy = Path(following(said, "evaluate")[1])
    with pytest.raises(ArtefactError, match="--robot"):
        load_evaluated_policy(policy, "cpu")
    assert load_evaluated_policy(policy, "cpu", robot).robot == robot
