"""Hostile files: refused in one printable sentence, before memory or time is taken."""

from __future__ import annotations

import re
import resource
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import orjson
import pytest
import yaml

from command_line import accepted
from mutated_files import fuzz
from pronk.errors import ArtefactError, LogError, PronkError, RobotError
from pronk.files import SIZE_LIMIT, read_yaml, write_text
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.mcap import McapWriter
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import find_logs, read_log
from pronk.identify.logs.sweep_writer import HEADER, SAMPLE, SEGMENT, TOPICS
from pronk.identify.logs.sweep_writer import SCHEMA as SWEEP
from pronk.identify.match import gains
from pronk.identify.response.response import FrequencyResponse
from pronk.jump.trial import results
from pronk.jump.trial.training_sim.results import SCHEMA, load_speed_errors
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.names import check_names, file_name
from pronk.policy.contract import from_json
from pronk.robots import load_robot
from pronk.robots.bare import file_of_model, yaml_of_model
from pronk.robots.load import read_robot
from report_cases import CASES, joint_result, write_trial

GAINS = """
schema: pronk/gains/1
robot: r
virtual: false
simulator: {engine: mujoco, version: '3', timestep_s: 0.005}
joints:
  knee: {stiffness: 20.0, damping: 0.5, armature: 0.01}
groups: {}
"""
JOINT = "<mujoco><worldbody><body><joint name='j'/><geom size='.1'/></body></worldbody>{}</mujoco>"
BOMB = "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
for level in range(1, 30):
    BOMB += f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 10)}]\n"
YAML = {
    "alias bomb": BOMB,
    "deep flow": "[" * 100_000 + "]" * 100_000,
    "deep block": "".join(" " * i + "a:\n" for i in range(500)),
    "long integer": f"a: {'9' * 6000}",
    "sexagesimal": f"a: 1{':10' * 1300}",
    "large": "a: 1\n" * 200_000,
    "key twice": "a: 1\na: 2\n",
    "date": "a: 2001-13-45\n",
    "binary": "a: !!binary x\n",
    "object": "!!python/object/apply:os.system ['true']",
    "no text": "\xff\x00",
    "recursive": "&a [*a]",
}


@pytest.mark.parametrize("attack", YAML)
def test_a_hostile_yaml_file_is_refused_by_every_reader(tmp_path: Path, attack: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(YAML[attack], encoding="latin-1")
    before = resource.getrusage(resource.RUSAGE_SELF)
    for read in (gains.load_gains, read_robot, load_sim_params):
        with pytest.raises(PronkError) as error:
            read(path)
        assert str(error.value).isprintable()
        assert len(str(error.value)) < 500
    after = resource.getrusage(resource.RUSAGE_SELF)
    assert after.ru_maxrss - before.ru_maxrss < 100 << 10
    # Processor time, which other work on the machine does not take.
    assert after.ru_utime - before.ru_utime < 3.0


def test_anchors_and_merge_keys_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}\n")
    assert read_yaml(tmp_path / "a.yaml")["b"] == {"x": 1, "y": 3}


@pytest.mark.parametrize(
    "value", ["-1.0", "[1.0]", "stiff", ".nan", ".inf", "1.0e+30", "{}", "null", "0x" + "f" * 4000]
)
@pytest.mark.parametrize("field", ["stiffness: 20.0", "damping: 0.5", "armature: 0.01"])
def test_gains_that_cannot_be_are_refused(tmp_path: Path, field: str, value: str) -> None:
    path = tmp_path / "gains.yaml"
    path.write_text(GAINS)
    assert gains.load_gains(path).joints["knee"].stiffness.value == 20.0
    path.write_text(GAINS.replace(field, f"{field.split(':')[0]}: {value}"))
    with pytest.raises(ArtefactError):
        gains.load_gains(path)


@pytest.mark.parametrize(
    "name", ["FR\nknee", "..", "$", "a\0b", "a\x1b[31mred", "n" * 300, "", "a\u202eb", "-rf"]
)
def test_names_are_checked_where_they_are_read(tmp_path: Path, name: str) -> None:
    t = np.arange(1000) / 500.0
    arrays = {"time": t, "command": np.sin(t)[:, None], "position": np.sin(t)[:, None]}
    np.savez(tmp_path / "a.npz", joints=np.array([name]), **arrays)
    body = yaml.safe_load(GAINS)
    body["joints"] = {name: body["joints"]["knee"]}
    (tmp_path / "gains.yaml").write_text(yaml.safe_dump(body))
    with pytest.raises(LogError) as caught:
        read_log(tmp_path / "a.npz", options=ReadOptions(unit="rad"))
    with pytest.raises(ArtefactError) as other:
        gains.load_gains(tmp_path / "gains.yaml")
    with pytest.raises(ArtefactError):
        response(joint=name)
    with pytest.raises(LogError):
        JointLog(robot=name, joints=("knee",), **arrays)
    for error in (caught.value, other.value):
        assert str(error).isprintable()
        assert len(str(error)) < 600


def test_names_of_real_robots_pass() -> None:
    names = ["FR_calf_joint", "left hip 1", "arm.joint-2", "Gelenk_ä", "1", "go2/FR"]
    check_names(names, "n", RobotError)
    assert file_name("FR_knee") == "FR_knee"
    assert len({file_name(name) for name in ("a/b", "a%2Fb", "a_b", "ab")}) == 4


def test_files_of_namespaced_joints_stay_in_their_folder(tmp_path: Path) -> None:
    names = ("go2/knee", "x/../../../../evil")
    out = tmp_path / "a" / "b" / "out"
    t = np.arange(8000) / 500.0
    wave = 0.2 * np.sin(2.0 * np.pi * 0.5 * t**2)[:, None] * [1.0, 0.5]
    np.savez(tmp_path / "log.npz", time=t, command=wave, position=wave, joints=np.array(names))
    joints = "".join(f"<joint name='{name}'/>" for name in names)
    (tmp_path / "model.xml").write_text(JOINT.format("").replace("<joint name='j'/>", joints))
    before = set(tmp_path.parent.rglob("*"))
    robot = ("--robot", tmp_path / "model.xml")
    accepted("response", tmp_path / "log.npz", *robot, "--unit", "rad", "--out", out)
    new_files = set()
    for path in set(tmp_path.parent.rglob("*")) - before:
        if path.is_file():
            new_files.add(path)
    assert new_files == set(out.iterdir())
    assert len(list(out.glob("*.svg"))) == 2


def test_deep_json_is_refused(tmp_path: Path) -> None:
    deep = "[" * 10_000 + "]" * 10_000
    writer = McapWriter(tmp_path / "a.mcap", TOPICS)
    writer.put(HEADER, 0.0, orjson.Fragment(f'{{"schema": "pronk/sweep/1", "robot": {deep}}}'))
    writer.close()
    with pytest.raises(LogError):
        read_log(tmp_path / "a.mcap")
    with pytest.raises(ArtefactError):
        from_json(f'{{"robot": {deep}}}', source="a file")


def test_a_number_of_400_digits_is_refused(tmp_path: Path) -> None:
    walk = {"name": "a", "figures": {"speed_error": {"mean": 0.1}}}
    path = results.save_json(tmp_path / "a.json", SCHEMA, {"walks": [walk]})
    assert load_speed_errors(path) == {"a": 0.1}
    path.write_text(path.read_text().replace("0.1", "9" * 400))
    with pytest.raises(ArtefactError):
        load_speed_errors(path)


def test_a_robot_file_made_of_any_joint_names_can_be_read(tmp_path: Path) -> None:
    """Names that YAML takes for numbers, flags or syntax, and an armature without a point."""
    names = ("1", "no", "a: b, {c}", "go2/knee", "#x")
    body = "<body pos='{} 0 1'><joint name='{}' armature='1e-5'/><geom size='.1'/></body>"
    bodies = ""
    for i, name in enumerate(names):
        bodies += body.format(i, name)
    path = tmp_path / "robot.xml"
    path.write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    (tmp_path / "robot.yaml").write_text(yaml_of_model(path))
    assert load_robot(tmp_path / "robot.yaml").joint_names == names


def test_bombs_are_refused_and_the_error_names_the_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(SIZE_LIMIT, "16")
    names = ("time", "command", "position")
    for name, size in (("declared", 16 << 20), ("converted", 4 << 20)):
        zeros = dict.fromkeys(names, np.zeros(size, bool))
        np.savez_compressed(tmp_path / f"{name}.npz", **zeros)
    (tmp_path / "cells.csv").write_text("time,a\n" + "0,0\n" * 200_000)
    writer = McapWriter(tmp_path / "messages.mcap", TOPICS)
    for _ in range(60_000):
        writer.put("/sweep/end", 0.0, {})
    writer.close()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for path in sorted(tmp_path.iterdir()):
        with pytest.raises(LogError, match=SIZE_LIMIT):
            read_log(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 << 10
    monkeypatch.setenv(SIZE_LIMIT, "lots")
    with pytest.raises(PronkError, match=SIZE_LIMIT):
        read_log(tmp_path / "cells.csv")


def test_many_columns_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "wide.csv"
    path.write_text(",".join(map(str, range(100_000))) + "\n" + ",".join(["0"] * 100_000))
    with pytest.raises(LogError, match="columns"):
        read_log(path, options=ReadOptions(unit="rad"))


def response(**changed: object) -> FrequencyResponse:
    values = {name: np.ones(4) for name in ("response", "coherence", "averages")}
    about = {"joint": "knee", "amplitude": 0.1, "estimator": "H1", "window": "", "segment_s": 8.0}
    arrays = {"omega": np.arange(1.0, 5.0), "repeats": np.ones((2, 4), complex)}
    return FrequencyResponse(**about | values | arrays | changed)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "changed",
    [
        {"omega": np.arange(3.0)},
        {"omega": np.arange(4.0)[::-1]},
        {"omega": np.array(["a"] * 4)},
        {"omega": np.empty(0)},
        {"repeats": np.ones(4)},
        {"coherence": np.ones((4, 1))},
    ],
)
def test_a_damaged_response_is_refused(changed: dict[str, object]) -> None:
    assert response().joint == "knee"
    with pytest.raises(ArtefactError):
        response(**changed)


def test_logs_whose_names_end_like_those_of_pronk_are_found(tmp_path: Path) -> None:
    for name in ("FL_knee_rematch.npz", "match.npz", "a.response.npz", "fresh.prediction.npz"):
        (tmp_path / name).touch()
    assert [path.name for path in find_logs([tmp_path])] == ["FL_knee_rematch.npz"]


AXIS = (
    "<robot name='r'><link name='base'/><link name='leg'><inertial><mass value='1'/>"
    "<inertia ixx='.1' iyy='.1' izz='.1' ixy='0' ixz='0' iyz='0'/></inertial></link>"
    "<joint name='knee' type='revolute'><parent link='base'/><child link='leg'/>"
    "<axis xyz='{}'/><limit lower='-1' upper='1' effort='10' velocity='20'/></joint></robot>"
)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.urdf", AXIS.format("1e308 1 0"), "axis"),
        ("a.urdf", AXIS.format("0 1e-300 0"), "axis"),
    ],
)
def test_a_model_with_an_axis_of_no_direction_is_refused(
    tmp_path: Path, name: str, text: str, words: str
) -> None:
    (tmp_path / name).write_text(text)
    for read in (file_of_model, load_robot):
        with pytest.raises(RobotError, match=words):
            read(tmp_path / name)


def test_an_mcap_log_without_gains_is_read_and_one_with_a_segment_twice_is_not(
    tmp_path: Path,
) -> None:
    chirp = {"kind": "chirp", "joints": ["knee"], "start": 0.0, "stop": 0.02, "amplitude": 0.1}
    for times in (0, 2):
        file = McapWriter(tmp_path / f"{times}.mcap", TOPICS)
        file.put(HEADER, 0.0, {"schema": SWEEP, "robot": "r", "joints": ["knee"]})
        for _ in range(times):
            file.put(SEGMENT, 0.0, chirp)
        for k in range(20):
            file.put(SAMPLE, k / 500.0, {"t": k / 500.0, "command": [0.1], "position": [0.2]})
        file.close()
    assert read_log(tmp_path / "0.mcap").stiffness is None
    with pytest.raises(LogError, match="twice"):
        read_log(tmp_path / "2.mcap")


def test_a_fit_with_gains_of_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match="amplitude_gains"):
        replace(joint_result("knee").fit, amplitude_gains=np.ones(2))


def test_more_steps_than_a_float_holds_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text(JOINT.format(""))
    text = yaml_of_model(tmp_path / "a.xml")
    changed = re.sub(r"decimation: \d+", f"decimation: {'9' * 400}", text)
    assert changed != text
    (tmp_path / "robot.yaml").write_text(changed)
    with pytest.raises(RobotError, match="decimation"):
        read_robot(tmp_path / "robot.yaml")


def test_mutated_files_give_no_traceback_and_no_other_numbers() -> None:
    outcome = fuzz(count=400, seed=8)
    assert outcome.status == 0
    refused = 0
    for counts in outcome.figures["kinds"]:
        refused += counts["refused"]
    assert refused > 200


def test_arrays_of_an_npz_log_that_are_no_text_or_no_arrays_or_not_read(tmp_path: Path) -> None:
    t = np.arange(1000) / 500.0
    wave = np.sin(t)[:, None]
    path = tmp_path / "a.npz"
    np.savez(path, time=t, command=wave, position=wave, joints=np.array(["knee"]), velocities=wave)
    log = read_log(path, options=ReadOptions(unit="rad"))
    assert any("velocities" in note for note in log.notes)
    beyond = np.array([0x110000], np.uint32).view("<U1")
    np.savez(path, time=t, command=wave, position=wave, joints=beyond)
    with pytest.raises(LogError):
        read_log(path, options=ReadOptions(unit="rad"))
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("time", "command", "position"):
            archive.writestr(f"{name}.npy", b"no array")
    with pytest.raises(LogError):
        read_log(path, options=ReadOptions(unit="rad"))


def test_results_with_numbers_of_some_joints_are_refused(tmp_path: Path) -> None:
    trial = write_trial(tmp_path, ("matched",), CASES[:1])
    path = tmp_path / results.SUMMARY
    body = orjson.loads(path.read_bytes())
    body["rows"][0]["figures"]["loads"]["peak_torque"] = [1.0]
    path.write_bytes(orjson.dumps(body))
    assert trial.rows
    with pytest.raises(ArtefactError):
        results.load_results(tmp_path)


def test_a_folder_in_the_place_of_the_output_is_refused_in_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(PronkError, match="cannot be written"):
        write_text(tmp_path / "file" / "out.txt", "x")
