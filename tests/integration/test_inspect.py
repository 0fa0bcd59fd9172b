"""The guess at a log: right or a question, written beside the log, read by every later command."""

from __future__ import annotations

import gzip
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from command_line import accepted, invoke, refused
from pronk.errors import LogError
from pronk.identify.logs.description import description_path, read_description
from pronk.identify.logs.inspection import LogGuess, inspect_log
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_log, read_logs
from pronk.robots import load_robot
from ros_bags import START_NS, Builder, Message, write_bag

GO2 = load_robot("go2")
TIME = np.arange(1500) / 100.0
COMMAND = 0.3 * np.sin(2.0 * np.pi * (0.3 * TIME + 0.1 * TIME**2))
POSITION = 0.9 * np.interp(TIME - 0.02, TIME, COMMAND)
VELOCITY = np.gradient(POSITION, TIME)
DEGREES = np.rad2deg(1.0)


def table(path: Path, columns: Mapping[str, np.ndarray], digits: int = 9) -> Path:
    """Write columns under their names."""
    names = ",".join(columns)
    values = np.stack(list(columns.values()), axis=1)
    np.savetxt(path, values, delimiter=",", header=names, comments="", fmt=f"%.{digits}f")
    return path


def guess(path: Path, robot: Any = None, **options: Any) -> LogGuess:
    return inspect_log(path, robot, ReadOptions(**options))


def assert_example(log: Any, joint: str) -> None:
    column = log.column(joint)
    np.testing.assert_allclose(log.time - log.time[0], TIME, atol=1e-6)
    np.testing.assert_allclose(log.command[:, column], COMMAND, atol=1e-6)
    np.testing.assert_allclose(log.position[:, column], POSITION, atol=1e-6)


NAMES: dict[str, tuple[dict[str, np.ndarray], str]] = {
    "plain": ({"time": TIME, "u": COMMAND, "q": POSITION}, "joint"),
    "milliseconds and degrees": (
        {"t_ms": 1e3 * TIME, "hip_des": DEGREES * COMMAND, "hip_act": DEGREES * POSITION},
        "hip",
    ),
    "degrees in brackets": (
        {
            "Time (us)": 1e6 * TIME,
            "Cmd knee [deg]": DEGREES * COMMAND,
            "Angle knee [deg]": DEGREES * POSITION,
        },
        "knee",
    ),
    "camel case": (
        {"timestamp": 1e9 * TIME + 1.7e18, "q3Des": COMMAND, "q3": POSITION, "dq3": VELOCITY},
        "joint3",
    ),
    "numbered": ({"time": TIME, "pos_des1": COMMAND, "pos_meas1": POSITION}, "joint1"),
    "dynamixel": (
        {
            "Time [s]": TIME,
            "Goal Position (deg)": DEGREES * COMMAND,
            "Present Position (deg)": DEGREES * POSITION,
            "Present Velocity (deg/s)": DEGREES * VELOCITY,
            "Present Current": VELOCITY,
        },
        "joint",
    ),
    "index": ({"": np.arange(1500), "t": TIME, "target": COMMAND, "position": POSITION}, "joint"),
    "more columns": (
        {
            "time": TIME,
            "elbow_joint_cmd": COMMAND,
            "elbow_joint_pos": POSITION,
            "elbow_joint_vel": VELOCITY,
            "elbow_joint_vel_cmd": 0.0 * TIME,
            "elbow_joint_torque": VELOCITY,
            "elbow_joint_torque_cmd": 0.0 * TIME,
            "elbow_joint_current": VELOCITY,
            "elbow_joint_temp": 0.0 * TIME + 30.0,
        },
        "elbow_joint",
    ),
    "pronk's own": (
        {"time": TIME, "command.knee": COMMAND, "position.knee": POSITION, "load": TIME},
        "knee",
    ),
}


@pytest.mark.parametrize("case", NAMES)
def test_names_say_what_columns_are(tmp_path: Path, case: str) -> None:
    columns, joint = NAMES[case]
    found = guess(table(tmp_path / "a.csv", columns))
    assert not found.questions
    assert found.log is not None
    assert found.log.excited_joints == (joint,)
    assert_example(found.log, joint)
    has_velocity = any(column.reading.startswith("velocity.") for column in found.columns)
    assert has_velocity == (found.log.velocity is not None)
    if found.log.velocity is not None:
        np.testing.assert_allclose(found.log.velocity[:, 0], VELOCITY, atol=1e-6)
    for column in found.columns:
        assert len(column.samples) == 3


UNCLEAR: dict[str, tuple[dict[str, np.ndarray], str]] = {
    "rad or deg": ({"time": TIME, "u": 5.0 * COMMAND, "q": 5.0 * POSITION}, "--unit"),
    "an offset of some degrees": (
        {"time": TIME, "u": 8.0 + COMMAND, "q": 8.0 + POSITION},
        "--unit",
    ),
    "rad and deg": ({"time": TIME, "u_deg": DEGREES * COMMAND, "q_rad": POSITION}, "deg"),
    "a torque called u": ({"time": TIME, "u": -40.0 * COMMAND, "q": POSITION}, "--columns"),
    "a torque against gravity called u": (
        {"time": TIME, "u": 1.6 * COMMAND, "q": POSITION},
        "--columns",
    ),
    "two positions": (
        {"time": TIME, "knee_cmd": COMMAND, "knee_pos": POSITION, "knee_enc": POSITION},
        "knee_enc",
    ),
    "no words": ({"time": TIME, "a": COMMAND, "b": POSITION}, "--columns"),
    "two times": ({"stamp": TIME, "t": TIME + 5.0, "u": COMMAND, "q": POSITION}, "--columns time="),
    "ten hertz": ({"time": 10.0 * TIME, "u": COMMAND, "q": POSITION}, "--time-unit"),
    "named in a unit that cannot be": ({"t_ms": TIME, "u": COMMAND, "q": POSITION}, "--time-unit"),
}


@pytest.mark.parametrize("case", UNCLEAR)
def test_what_cannot_be_told_is_asked_with_the_option(tmp_path: Path, case: str) -> None:
    columns, option = UNCLEAR[case]
    path = table(tmp_path / "a.csv", columns)
    found = guess(path)
    assert any(option in question for question in found.questions), found.questions
    sentence = refused("log", "inspect", path, "--yes")
    assert option in sentence
    assert [file.name for file in tmp_path.iterdir()] == ["a.csv"]
    # Without --yes the guess is shown, with what is open.
    assert option in accepted("log", "inspect", path)


@settings(max_examples=60, deadline=None)
@given(
    scale=st.sampled_from([1.0, DEGREES]),
    amplitude=st.floats(0.02, 1.5),
    offset=st.floats(-2.5, 2.5),
    time_scale=st.sampled_from([1.0, 1e3, 1e6, 1e9]),
    rate_hz=st.floats(20.0, 2000.0),
)
def test_a_unit_is_right_or_asked(
    tmp_path_factory: pytest.TempPathFactory,
    scale: float,
    amplitude: float,
    offset: float,
    time_scale: float,
    rate_hz: float,
) -> None:
    """Over chirps of 0.02 to 1.5 rad about any pose, in either unit, at any usual rate."""
    time = np.arange(300) / rate_hz
    command = offset + amplitude * np.sin(2.0 * np.pi * 3.0 * time / time[-1])
    path = table(
        tmp_path_factory.mktemp("guess") / "a.csv",
        {"time": time_scale * time, "cmd": scale * command, "pos": scale * command},
    )
    found = guess(path)
    if found.options.unit is not None:
        assert found.options.unit == ("rad" if scale == 1.0 else "deg")
    else:
        assert any("--unit" in question for question in found.questions)
    if found.options.time_unit is not None:
        assert found.options.time_unit == {1.0: "s", 1e3: "ms", 1e6: "us", 1e9: "ns"}[time_scale]
    else:
        assert any("--time-unit" in question for question in found.questions)


def test_one_joint_in_degrees_beside_one_in_radians_is_asked_with_the_option(
    tmp_path: Path,
) -> None:
    """The option that is named reads both joints as they moved; one unit for all is not asked."""
    columns = {
        "time": TIME,
        "hip_cmd": COMMAND,
        "hip_pos": POSITION,
        "knee_cmd": DEGREES * COMMAND,
        "knee_pos": DEGREES * POSITION,
    }
    path = table(tmp_path / "mixed.csv", columns)
    (question,) = guess(path).questions
    scale = question.split("--scale knee=")[1].split(",")[0]
    log = guess(path, unit="rad", scale={"knee": float(scale)}).log
    assert_example(log, "hip")
    assert log is not None
    knee_position = log.position[:, log.column("knee")]
    np.testing.assert_allclose(knee_position, POSITION, rtol=1e-4, atol=1e-6)

    for unit, factor in (("rad", 1.0), ("deg", DEGREES)):
        alike = {"time": TIME}
        for name in ("hip", "knee"):
            alike[f"{name}_cmd"] = factor * COMMAND
            alike[f"{name}_pos"] = factor * POSITION
        alike_guess = guess(table(tmp_path / f"{unit}.csv", alike))
        assert not alike_guess.questions
        assert alike_guess.options.unit == unit


def test_a_joint_out_of_its_range_in_either_unit_is_named_with_the_range(tmp_path: Path) -> None:
    """A knee with the other sign is out of its range in rad, and would hardly move in degrees."""
    columns = {"time": TIME, "FL_knee_cmd": 1.7 - COMMAND, "FL_knee_pos": 1.7 - POSITION}
    log_guess = guess(table(tmp_path / "sign.csv", columns), GO2)
    (question,) = log_guess.questions
    low, high = GO2.joint("FL_knee").range
    for word in ("FL_knee", f"{low:.3g}", f"{high:.3g}", "--unit"):
        assert word in question


def test_spikes_of_an_encoder_are_not_taken_for_degrees(tmp_path: Path) -> None:
    """Two samples in a thousand that are beyond the range of the joint leave the unit open."""
    spiked = POSITION - 1.7
    spiked[[300, 700, 1100]] += 5.0
    columns = {"time": TIME, "FL_knee_cmd": COMMAND - 1.7, "FL_knee_pos": spiked}
    log_guess = guess(table(tmp_path / "spikes.csv", columns), GO2)
    assert log_guess.options.unit != "deg"


def test_joints_are_those_of_the_robot_or_asked(tmp_path: Path) -> None:
    path = table(
        tmp_path / "a.csv", {"t": TIME, "FL_calf_cmd": COMMAND - 1.8, "FL_calf": POSITION - 1.8}
    )
    path.write_text(
        path.read_text().replace("FL_calf,", "FL_calf_pos,").replace("FL_calf\n", "FL_calf_pos\n")
    )
    found = guess(path, GO2)
    assert found.log is not None
    assert found.log.joints == ("FL_knee",)
    other = table(tmp_path / "b.csv", {"t": TIME, "k_cmd": COMMAND - 1.8, "k_pos": POSITION - 1.8})
    assert any("--joint-names k=" in question for question in guess(other, GO2).questions)
    named = guess(other, GO2, joint_names={"k": "RR_knee"})
    assert named.log is not None
    assert named.log.joints == ("RR_knee",)


def test_unknown_joints_are_asked_at_once_with_an_option_that_is_read(tmp_path: Path) -> None:
    columns = {"t": TIME}
    for motor in ("m1", "m2", "m3"):
        columns[f"{motor}_target"] = COMMAND
        columns[f"{motor}_angle"] = POSITION
    path = table(tmp_path / "motors.csv", columns)
    questions = [question for question in guess(path, GO2).questions if "--joint-names" in question]
    assert len(questions) == 1
    example = questions[0].split("--joint-names ")[1].split()[0]
    said = accepted(
        *(
            "log",
            "inspect",
            path,
            "--robot",
            "go2",
            "--unit",
            "rad",
            "--joint-names",
            example,
            "--yes",
        )
    )
    assert "wrote" in said
    log = read_log(path, robot=GO2)
    assert len(set(log.joints)) == 3
    assert set(log.joints) <= set(GO2.joint_names)
    # A range of the robot rules radians out.
    far = table(
        tmp_path / "c.csv",
        {"t": TIME, "FL_knee_cmd": 3.0 * COMMAND + 5.0, "FL_knee_pos": 3.0 * POSITION + 5.0},
    )
    assert guess(far, GO2).options.unit != "rad"


def test_every_later_command_reads_what_was_written(tmp_path: Path) -> None:
    columns = {"t_ms": 1e3 * TIME, "hip_des": DEGREES * COMMAND, "hip_act": DEGREES * POSITION}
    path = table(tmp_path / "chirp.csv", columns)
    sentence = refused("response", path, "--out", tmp_path / "out")
    assert "log inspect" in sentence
    shown = accepted("log", "inspect", path)
    assert "hip_act" in shown
    assert not description_path(path).exists()
    written = accepted("log", "inspect", path, "--yes")
    assert "chirp.log.yaml" in written
    body = yaml.safe_load((tmp_path / "chirp.log.yaml").read_text())
    assert body["unit"] == "deg"
    assert body["columns"]["position.hip"] == "hip_act"
    assert_example(read_log(path), "hip")
    assert "--unit deg" not in accepted("log", "inspect", path)
    described = accepted("response", path, "--out", tmp_path / "out", "--no-plots")
    words = ["--unit", "deg", "--time-unit", "ms", "--columns"]
    words += ["time=t_ms,command.hip=hip_des,position.hip=hip_act"]
    description_path(path).unlink()
    stated = accepted("response", path, "--out", tmp_path / "out", "--no-plots", *words)
    # The same responses; the next command repeats what was stated.
    assert "--columns" in stated.splitlines()[-1]
    rows = [line for line in described.splitlines() if "log.yaml" not in line]
    assert rows[:-1] == stated.splitlines()[:-1]


def test_stated_options_take_precedence(tmp_path: Path) -> None:
    columns = {"t": TIME, "hip_des": COMMAND, "hip_act": POSITION, "hip_other": 2.0 * POSITION}
    path = table(tmp_path / "chirp.csv", columns)
    written = {"time": "t", "command.hip": "hip_des", "position.hip": "hip_act"}
    body = {"schema": "pronk/log/1", "file": "chirp.csv", "unit": "deg", "columns": written}
    description_path(path).write_text(yaml.safe_dump(body))
    np.testing.assert_allclose(read_log(path).position[:, 0], POSITION / DEGREES, atol=1e-6)
    options = ReadOptions(unit="rad", columns={"position.hip": "hip_other"})
    log = read_log(path, options=options)
    np.testing.assert_allclose(log.position[:, 0], 2.0 * POSITION, atol=1e-6)
    np.testing.assert_allclose(log.command[:, 0], COMMAND, atol=1e-6)
    # An edit of the file counts for the guess as well.
    assert guess(path).options.unit == "deg"
    assert any("chirp.log.yaml" in note for note in log.notes)


@pytest.mark.parametrize(
    ("body", "word"),
    [
        ("schema: pronk/log/2\nfile: a.csv\n", "pronk/log/1"),
        ("schema: pronk/log/1\n", "file"),
        ("schema: pronk/log/1\nfile: other.csv\n", "other.csv"),
        ("schema: pronk/log/1\nfile: a.csv\nunits: rad\n", "units"),
        ("schema: pronk/log/1\nfile: a.csv\nunit: furlong\n", "rad, deg"),
        ("schema: pronk/log/1\nfile: a.csv\nunit: 3\n", "unit"),
        ("schema: pronk/log/1\nfile: a.csv\ncolumns: {time: T}\n", "'T'"),
        ("schema: pronk/log/1\nfile: a.csv\ncommand_topic: /x\n", "command_topic"),
        ("[", "YAML"),
        ("", "pronk/log/1"),
    ],
)
def test_a_damaged_description_is_one_sentence(tmp_path: Path, body: str, word: str) -> None:
    path = table(tmp_path / "a.csv", {"time": TIME, "command.k": COMMAND, "position.k": POSITION})
    description_path(path).write_text(body)
    with pytest.raises(LogError) as caught:
        read_log(path, options=ReadOptions(unit="rad") if "command_topic" in body else None)
    assert word in str(caught.value)
    assert str(caught.value).isprintable()


def test_a_description_belongs_to_one_file(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", {"time": TIME, "command.k": COMMAND, "position.k": POSITION})
    arrays = {"time": TIME, "command": DEGREES * COMMAND, "position": DEGREES * POSITION}
    np.savez(tmp_path / "a.npz", joints=np.array(["k"]), **arrays)
    accepted("log", "inspect", tmp_path / "a.npz", "--yes")
    assert_example(read_log(tmp_path / "a.npz"), "k")
    # The table beside it is not in degrees.
    assert read_description(path) is None
    assert_example(read_log(path, options=ReadOptions(unit="rad")), "k")
    packed = tmp_path / "b.csv.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    accepted("log", "inspect", packed, "--yes")
    assert description_path(packed).name == "b.log.yaml"
    assert_example(read_log(packed), "k")


def test_logs_of_a_folder_keep_their_descriptions_in_other_processes(tmp_path: Path) -> None:
    for name, factor in (("a", 1.0), ("b", DEGREES), ("c", 1.0), ("d", DEGREES)):
        columns = {"t": TIME, "cmd": factor * COMMAND, "pos": factor * POSITION}
        table(tmp_path / f"{name}.csv", columns)
    with pytest.raises(LogError, match="log inspect"):
        read_logs([tmp_path], processes=2)
    for name in "abcd":
        accepted("log", "inspect", tmp_path / f"{name}.csv", "--yes")
    for log in read_logs([tmp_path], processes=2):
        assert_example(log, "joint")


def test_a_bag_is_described_by_its_topics(tmp_path: Path) -> None:
    def build(builder: Builder) -> list[Message]:
        messages: list[Message] = []
        for k in range(len(TIME)):
            nano = START_NS + 10_000_000 * k
            kind = "std_msgs/msg/Float64MultiArray"
            messages.append(("/position/commands", kind, nano, builder.numbers([COMMAND[k]] * 2)))
            state = builder.joint_state(nano, ["b", "a"], [POSITION[k], POSITION[k]])
            messages.append(("/joint_states", "sensor_msgs/msg/JointState", nano + 1, state))
        return messages

    path = write_bag(tmp_path / "bag", build)
    assert any("--joint-order" in question for question in guess(path).questions)
    accepted("log", "inspect", path, "--joint-order", "a,b", "--yes")
    body = yaml.safe_load((tmp_path / "bag.log.yaml").read_text())
    assert body["measured_topic"] == "/joint_states"
    assert body["command_topic"] == "/position/commands"
    log = read_log(path)
    assert log.joints == ("b", "a")
    assert_example(log, "a")


def test_the_figures_of_a_guess_as_json(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", {"time": TIME, "u": COMMAND, "q": POSITION})
    done = invoke(["log", "inspect", path, "--json", tmp_path / "guess.json"])
    assert done.exit_code == 0
    body = yaml.safe_load((tmp_path / "guess.json").read_text())
    assert body["columns"] == {"time": "time", "u": "command.joint", "q": "position.joint"}
    assert body["unit"] == "rad"
    assert body["excited"] == ["joint"]
