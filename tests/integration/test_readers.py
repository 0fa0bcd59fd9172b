"""Log readers: round trips, real recordings, timestamps, plausibility, bags, and plugins."""

from __future__ import annotations

import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2.writer import Writer as RosWriter

import pronk
from command_line import accepted, invoke
from log_files import example, write_csv, write_mcap, write_npz
from pronk.errors import LogError, RobotError
from pronk.identify.logs.checks import (
    check_motion,
    check_rate,
    check_unit,
    examine_time,
    saturation_note,
)
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_log, read_logs, readers
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from pronk.testing import check_reader

SHARED = Path(pronk.__file__).parents[3] / "shared"
SO101 = SHARED / "data" / "so101"
RECORDINGS = ("backlash_detection", "chirp_sweep", "multisine", "sinusoidal_sweep", "step_response")
recorded = pytest.mark.skipif(not SO101.is_dir(), reason="the shared recordings are not here")


# --- real recordings ----------------------------------------------------------------------------


@recorded
def test_so101_recordings_run_at_49_85_hz() -> None:
    logs = read_logs([SO101])
    assert [Path(log.source).name for log in logs] == list(RECORDINGS)
    assert len({log.origin.sha256 for log in logs}) == 5
    for log in logs:
        assert log.robot == "so101"
        assert log.joints == load_robot("so101").joint_names
        assert log.rate_hz == pytest.approx(49.85, abs=0.005)
        assert log.velocity is not None
        assert log.torque is not None
        for joint in log.excited_joints:
            for excitation in log.excitations(joint):
                assert excitation.segment.kind == "unknown"
                check_motion(excitation)


@recorded
def test_so101_numbers_are_those_of_the_files() -> None:
    log = read_log(SO101 / "chirp_sweep", robot=load_robot("so101"))
    assert len(log.time) == 6000
    assert log.time[0] == pytest.approx(5.017034709453583e-6)
    np.testing.assert_allclose(
        log.command[0], [0.0, 0.129904, 0.629904, 0.0, -0.129904, 0.370096], atol=1e-12
    )
    assert log.position[0, 2] == pytest.approx(0.6987282488819095)
    # The elbow is centred on 0.5 rad; the encoder has 4096 steps a turn.
    assert log.pose is not None
    assert log.pose[log.column("elbow_flex")] == pytest.approx(0.5, abs=1e-4)
    step = np.diff(np.unique(log.position[:, 0])).min()
    assert step == pytest.approx(2.0 * np.pi / 4096, rel=1e-6)
    # Its joints move by one shifted chirp.
    assert any("correlate to 1.00" in note for note in log.notes)


@recorded
def test_the_jaw_is_no_angle_without_a_scale() -> None:
    log = read_log(SO101 / "multisine")
    assert log.unit("gripper") == "unknown"
    assert log.unit("shoulder_pan") == "rad"
    scaled = read_log(SO101 / "multisine", options=ReadOptions(scale={"gripper": 1.9}))
    assert scaled.unit("gripper") == "rad"
    np.testing.assert_allclose(scaled.position[:, 5], 1.9 * log.position[:, 5])
    np.testing.assert_array_equal(scaled.position[:, :5], log.position[:, :5])
    np.testing.assert_array_equal(scaled.velocity, log.velocity)  # type: ignore[arg-type]
    renamed = read_log(SO101 / "multisine", options=ReadOptions(joint_names={"Jaw": "claw"}))
    assert (renamed.joints[0], renamed.unit("claw")) == ("Rotation", "unknown")


@recorded
def test_expectations_that_the_timestamps_contradict_are_refused() -> None:
    path = SO101 / "chirp_sweep"
    with pytest.raises(LogError, match=r"49\.85 Hz"):
        read_log(path, options=ReadOptions(rate_hz=50.0))
    read_log(path, options=ReadOptions(rate_hz=49.85))
    with pytest.raises(LogError, match="probably in us"):
        read_log(path, options=ReadOptions(time_unit="s"))
    with pytest.raises(RobotError, match="FR_hip_roll"):
        read_log(path, robot=load_robot("mini_cheetah"))


def test_sage_command_is_the_one_in_force(tmp_path: Path) -> None:
    """States and commands on clocks of their own: the last command at or before each state."""
    states = ""
    for k in range(60):
        states += f'STATE_MOTOR,{2000 * k + 500},"[0.{k:02d}, 1.0]","[0, 0]","[0, 0]"\n'
    controls = ""
    for k in range(6):
        controls += f'CONTROL,{20000 * k + 10000},"[{k}.0, 0.5]"\n'
    files = {
        "joint_list.txt": "hip\nknee\n",
        "state_motor.csv": "type,timestamp,positions,velocities,torques\n" + states,
        "control.csv": "type,timestamp,positions\n" + controls,
        "event.csv": "type,timestamp,event\nE,0,ON\nE,20000,MOTION_START\nE,100000,DISABLE\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    log = read_log(tmp_path)
    assert log.robot == "unknown"
    assert log.time[0] == pytest.approx(0.0205)
    assert log.time[-1] == pytest.approx(0.0985)
    np.testing.assert_array_equal(log.command[:, 0], np.floor((log.time * 1e6 - 10000) / 20000))
    assert log.velocity is None  # All zero: not measured.
    assert any("5 states before the first command" in note for note in log.notes)


# --- round trips --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.npz", "a.csv", "A.CSV", "a.txt"])
def test_round_trip(tmp_path: Path, name: str) -> None:
    log = example()
    path = tmp_path / name
    if name == "a.npz":
        write_npz(path, log)
    else:
        write_csv(path, log)
    options = ReadOptions(unit="rad")
    if name == "a.txt":
        options = ReadOptions(unit="rad", format="csv")
    back = read_log(path, options=options)
    for quantity in ("time", "command", "position", "velocity", "torque"):
        np.testing.assert_array_equal(getattr(back, quantity), getattr(log, quantity))
    assert back.joints == log.joints
    assert back.segments[0].amplitude == np.ptp(log.command[:, 0]) / 2.0


@settings(max_examples=30, deadline=None)
@given(
    values=st.lists(st.floats(-12.0, 12.0), min_size=3, max_size=30),
    delimiter=st.sampled_from(",;\t"),
    bom=st.booleans(),
)
def test_csv_in_degrees_with_names_of_its_own(
    tmp_path_factory: pytest.TempPathFactory, values: list[float], delimiter: str, bom: bool
) -> None:
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    lines = [delimiter.join(("t_ms", " q ", "q_des", "remark"))]
    for k, value in enumerate(values):
        lines.append(delimiter.join((repr(20.0 * k), repr(value), repr(value / 2.0), "x")))
    text = "\r\n".join(lines)
    if bom:
        text = "\ufeff" + text
    path.write_bytes(text.encode())
    log = read_log(
        path,
        robot=load_robot("mini_cheetah"),
        options=ReadOptions(
            unit="deg",
            time_unit="ms",
            columns={"time": "t_ms", "position.FR_knee": "q", "command.FR_knee": "q_des"},
        ),
    )
    np.testing.assert_allclose(log.position[:, 0], np.deg2rad(values), atol=1e-15)
    np.testing.assert_allclose(log.command[:, 0], np.deg2rad(values) / 2.0, atol=1e-15)
    np.testing.assert_allclose(log.time, 0.02 * np.arange(len(values)), atol=1e-12)
    assert log.robot == "mini_cheetah"


def test_a_pace_recording_gives_the_numbers_of_pytorch(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    generator = torch.Generator().manual_seed(0)
    time = torch.arange(400, dtype=torch.float64) / 400.0
    command = torch.rand(400, 12, generator=generator)
    # A transposed view: strides that are not those of rows.
    position = torch.rand(12, 400, generator=generator, dtype=torch.float64).T
    path = tmp_path / "chirp_data.pt"
    torch.save({"time": time, "dof_pos": position, "des_dof_pos": command, "note": "x"}, path)
    log = read_log(
        path, robot=load_robot("mini_cheetah"), options=ReadOptions(joint_order="default")
    )
    np.testing.assert_array_equal(log.position, position.numpy())
    np.testing.assert_array_equal(log.command, command.numpy().astype(float))
    assert log.joints == load_robot("mini_cheetah").joint_names


def test_without_pytorch_a_pace_recording_is_refused_with_the_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with zipfile.ZipFile(tmp_path / "a.pt", "w") as archive:
        archive.writestr("archive/data.pkl", b"")
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(LogError, match=r"a\.pt.*pronk\[train\]"):
        read_log(tmp_path / "a.pt")


# --- timing -------------------------------------------------------------------------------------


def test_jitter_gaps_and_lost_samples_are_counted() -> None:
    rng = np.random.default_rng(0)
    time = np.arange(2000) / 500.0 + rng.normal(0.0, 50e-6, 2000)
    timing = examine_time(np.delete(time, np.r_[300:310, 900:905]))
    assert len(timing.gaps) == 2
    assert timing.lost == 15
    # Each interval has the jitter of two stamps.
    assert timing.jitter_s == pytest.approx(50e-6 * np.sqrt(2.0), rel=0.1)
    assert timing.gaps[0][0] == pytest.approx(299 / 500.0, abs=1e-3)
    # Lost samples do not make the clock slow.
    check_rate(timing, "log", 500.0)


def test_a_perfect_clock_and_one_that_drifts() -> None:
    index = np.arange(1000)
    perfect = examine_time(index / 500.0)
    assert perfect.rate_hz == pytest.approx(500.0)
    assert perfect.lost == 0
    assert max(perfect.jitter_s, perfect.drift_s) < 1e-9
    drifting = examine_time(index / 500.0 + 1e-3 * np.sin(np.pi * index / 999.0))
    assert 0.3e-3 < drifting.drift_s < 1e-3


@pytest.mark.parametrize(
    ("rate", "read_as", "written_in"),
    [(500.0, "s", "ms"), (500.0, "us", "s"), (1000.0, "ns", "us"), (49.85, "s", "us")],
)
def test_another_unit_of_time_is_recognized(rate: float, read_as: str, written_in: str) -> None:
    units = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
    numbers = np.arange(200) / rate / units[written_in]
    with pytest.raises(LogError, match=f"probably in {written_in} "):
        check_unit(numbers * units[read_as], "log", read_as)
    check_unit(numbers * units[written_in], "log", written_in)


def test_exact_duplicates_can_be_dropped_and_are_mentioned(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = []
    for k in sorted([*range(50), 7, 7, 20]):
        rows.append(f"{0.01 * k},{0.1 * (k % 3)},{0.1 * k}")
    path.write_text("\n".join(["time,position.a,command.a", *rows]))
    with pytest.raises(LogError, match="row 10 repeats the timestamp"):
        read_log(path, options=ReadOptions(unit="rad"))
    done = invoke(["response", path, "--unit", "rad", "--drop-duplicates"])
    assert "repeats the timestamp" not in done.stderr
    back = read_log(path, options=ReadOptions(unit="rad", drop_duplicates=True))
    np.testing.assert_allclose(back.time, 0.01 * np.arange(50))
    assert any(note.startswith("3 rows") for note in back.notes)
    # The same timestamp with another value is not a duplicate, and stays an error.
    rows[8] = f"{0.01 * 7},0.5,0.5"
    path.write_text("\n".join(["time,position.a,command.a", *rows]))
    for drop_duplicates in (False, True):
        options = ReadOptions(unit="rad", drop_duplicates=drop_duplicates)
        with pytest.raises(LogError, match="row 10 repeats the timestamp") as caught:
            read_log(path, options=options)
        # The option would not mend it, so it is not offered.
        assert "--drop-duplicates" not in str(caught.value)
        assert "loses data" in str(caught.value)


def test_a_duplicate_with_a_value_that_is_missing_twice_is_one(tmp_path: Path) -> None:
    time = np.sort(np.append(0.01 * np.arange(50), 0.07))
    index = np.round(time / 0.01)
    velocity = np.where(index == 7.0, np.nan, 0.0)[:, None]
    arrays = {"time": time, "position": 0.1 * index[:, None], "command": 0.1 * index[:, None]}
    np.savez(tmp_path / "a.npz", velocity=velocity, joints=np.array(["a"]), **arrays)
    with pytest.raises(LogError, match="--drop-duplicates"):
        read_log(tmp_path / "a.npz", options=ReadOptions(unit="rad"))
    # The value is missing still.
    options = ReadOptions(unit="rad", drop_duplicates=True)
    with pytest.raises(LogError, match="velocity of a is not finite"):
        read_log(tmp_path / "a.npz", options=options)


def test_an_epoch_clock_begins_at_zero(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{1_700_000_000_000_000 + 2000 * k},0.1,{0.01 * k}" for k in range(50)]
    path.write_text("\n".join(["time,position.a,command.a", *rows]))
    log = read_log(path, options=ReadOptions(unit="rad", time_unit="us"))
    assert log.time[0] == 0.0
    assert log.rate_hz == pytest.approx(500.0)
    assert any("made to begin at zero" in note for note in log.notes)


# --- motion -------------------------------------------------------------------------------------


def moved(position: np.ndarray, command: np.ndarray, rate: float = 200.0) -> JointLog:
    return JointLog(
        robot="mini_cheetah",
        joints=("FR_knee",),
        time=np.arange(len(command)) / rate,
        command=command[:, None],
        position=position[:, None],
    )


SWING = 0.25 * np.sin(2.0 * np.pi * np.cumsum(np.linspace(0.1, 8.0, 4000)) / 200.0)


def test_motion_that_passes() -> None:
    (excitation,) = moved(0.8 * SWING, SWING).excitations("FR_knee")
    check_motion(excitation)
    assert not saturation_note(moved(0.8 * SWING, SWING), "FR_knee")
    # A joint with a dead band (play operator) rests at every turn, which is not saturation.
    position = np.zeros(len(SWING))
    for k in range(1, len(SWING)):
        position[k] = np.clip(position[k - 1], SWING[k] - 0.1, SWING[k] + 0.1)
    assert not saturation_note(moved(position, SWING), "FR_knee")


@pytest.mark.parametrize("limits", [(-0.05, 1.0), (-1.0, 0.1)])
def test_saturation_is_noted(tmp_path: Path, limits: tuple[float, float]) -> None:
    write_mcap(tmp_path / "a.mcap", moved(np.clip(SWING, *limits), SWING))
    assert any("FR_knee is saturated" in note for note in read_log(tmp_path / "a.mcap").notes)


def test_saturation_is_noted_of_a_joint_that_moves_for_a_small_part_of_the_log() -> None:
    """In the log of a sweep of many joints each of them rests most of the time."""
    rest = np.zeros(11 * len(SWING))
    command = np.concatenate([rest, SWING])
    position = np.concatenate([rest, np.clip(SWING, -0.05, 1.0)])
    assert "is saturated" in saturation_note(moved(position, command), "FR_knee")
    assert not saturation_note(moved(0.8 * command, command), "FR_knee")


def test_angles_that_wrap_are_excitations_of_their_own_size(tmp_path: Path) -> None:
    turned = np.angle(np.exp(1j * (SWING + np.pi)))
    assert np.ptp(turned) > 6.0
    write_csv(tmp_path / "a.csv", moved(turned, turned))
    log = read_log(tmp_path / "a.csv", options=ReadOptions(unit="rad"))
    (excitation,) = log.excitations("FR_knee")
    assert excitation.amplitude == pytest.approx(0.25, rel=0.01)
    assert np.ptp(excitation.position) == pytest.approx(0.5, rel=0.01)
    assert any("wraps" in note for note in log.notes)


@pytest.mark.parametrize(
    ("position", "command", "words"),
    [
        (np.zeros(4000), SWING, "did not move"),
        (np.where(SWING > 0.0, 0.0015, 0.0), SWING, "did not move"),
        (SWING, np.zeros(4000), "was not excited"),
    ],
)
def test_no_motion_is_refused(position: np.ndarray, command: np.ndarray, words: str) -> None:
    with pytest.raises(LogError, match=f"FR_knee {words}"):
        check_motion(moved(position, command).excitations("FR_knee")[0])


@pytest.mark.parametrize("degrees", [np.rad2deg(SWING), 20.0 + SWING])
def test_degrees_read_as_radians_are_refused(tmp_path: Path, degrees: np.ndarray) -> None:
    write_csv(tmp_path / "a.csv", moved(degrees, degrees))
    with pytest.raises(LogError, match="probably in degrees"):
        read_log(tmp_path / "a.csv", options=ReadOptions(unit="rad"))
    assert np.ptp(read_log(tmp_path / "a.csv", options=ReadOptions(unit="deg")).position) < 0.6


@pytest.mark.parametrize("moves", [False, True])
def test_joints_that_the_model_holds_are_left_out(tmp_path: Path, moves: bool) -> None:
    """A gripper's slide in the log of an arm."""
    robot = replace(load_robot("mini_cheetah"), held_joints=("finger",))
    values = np.column_stack([SWING, 0.01 * np.ones(4000)])
    if moves:
        values[:, 1] += 0.1 * SWING
    time = np.arange(4000) / 200.0
    names = np.array(["FR_knee", "finger"])
    arrays = {"time": time, "command": values, "position": values, "velocity": values}
    np.savez(tmp_path / "a.npz", joints=names, **arrays)
    if moves:
        with pytest.raises(LogError, match="finger"):
            read_log(tmp_path / "a.npz", robot=robot, options=ReadOptions(unit="rad"))
        return
    log = read_log(tmp_path / "a.npz", robot=robot, options=ReadOptions(unit="rad"))
    assert log.joints == ("FR_knee",)
    assert log.velocity is not None
    np.testing.assert_array_equal(log.velocity[:, 0], SWING)
    assert any("finger" in note for note in log.notes)


def test_a_log_of_another_robot_is_refused(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", replace(example(), robot="so101"))
    with pytest.raises(LogError, match=r"so101.*mini_cheetah"):
        read_log(tmp_path / "a.mcap", robot=load_robot("mini_cheetah"))


# --- ROS 2 bags -----------------------------------------------------------------------------------

JOINT_STATE = """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def test_an_order_of_joints_is_never_assumed(tmp_path: Path) -> None:
    robot = load_robot("mini_cheetah")
    path = tmp_path / "a.npz"
    values = np.cumsum(np.random.default_rng(0).uniform(-0.01, 0.01, (300, 12)), axis=0)
    arrays = {"time": np.arange(300) / 200.0, "command": values, "position": values}
    file_order = (*robot.joint_names[3:6], *robot.joint_names[:3], *robot.joint_names[6:])

    def joints(order: object, stated_robot: RobotSpec | None = robot) -> tuple[str, ...]:
        options = ReadOptions(unit="rad", joint_order=order)
        return read_log(path, robot=stated_robot, options=options).joints

    np.savez(path, **arrays)  # type: ignore[arg-type]
    for stated_robot, proposal in ((None, "--robot"), (robot, ",".join(robot.joint_names))):
        with pytest.raises(LogError, match="--joint-order NAME") as caught:
            joints(None, stated_robot)
        assert proposal in str(caught.value)
    assert joints(file_order) == file_order
    assert joints(",".join(file_order)) == file_order
    assert joints("default") == robot.joint_names
    too_few = file_order[:3]
    named_twice = (*file_order[:11], file_order[0])
    unknown_joint = (*file_order[:11], "tail")
    for order in (too_few, named_twice, unknown_joint):
        with pytest.raises((LogError, RobotError), match=r"3 joint names|named twice|no joint"):
            joints(order)
    # Names in the file count; an order that contradicts them is refused.
    np.savez(path, **arrays, joints=np.array(file_order))  # type: ignore[arg-type]
    for order in (None, "default", file_order):
        assert joints(order) == file_order
    with pytest.raises(LogError, match="by the file"):
        joints(robot.joint_names)


def bag(
    path: Path,
    *,
    stamped: bool = True,
    command: str = "/joint_command",
    chunk_size: int = 1024 * 1024,
) -> None:
    """Two joints at 200 Hz, commands at 50 Hz, recorded by rosbag2 into MCAP."""
    with path.open("wb") as stream, RosWriter(stream, chunk_size=chunk_size) as writer:
        state = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        plain = writer.register_msgdef("std_msgs/msg/Float64MultiArray", "float64[] data\n")
        for k in range(400):
            nano = 100 * 10**9 + k * 5_000_000
            stamp = {"sec": 0, "nanosec": 0}
            if stamped:
                stamp = {"sec": nano // 10**9, "nanosec": nano % 10**9}
            message = {"header": {"stamp": stamp, "frame_id": ""}, "velocity": [], "effort": []}
            if k >= 8 and k % 4 == 0:
                values = [np.sin(0.1 * k), 2.0]
                if command == "/array":
                    writer.write_message(command, plain, {"data": values}, nano, nano)
                else:
                    order = {"name": ["hip", "knee"], "position": values[::-1]}
                    writer.write_message(command, state, message | order, nano, nano)
            states = {"name": ["knee", "hip"], "position": [np.sin(0.1 * k - 0.2), 2.1]}
            writer.write_message("/joint_states", state, message | states, nano, nano)


def test_a_bag_with_two_joint_state_topics(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    bag(path)
    log = read_log(path, options=ReadOptions(command_topic="/joint_command"))
    assert log.joints == ("knee", "hip")
    assert log.rate_hz == pytest.approx(200.0)
    # States before the first command are dropped; the command is the last at or before a state.
    assert len(log.time) == 392
    k = np.arange(8, 400)
    np.testing.assert_allclose(log.command[:, 0], np.sin(0.1 * (k - k % 4)))
    np.testing.assert_allclose(log.command[:, 1], 2.0)
    np.testing.assert_allclose(log.position[:, 0], np.sin(0.1 * k - 0.2))
    assert log.velocity is None
    assert any("8 states before the first command" in note for note in log.notes)


def test_what_is_left_of_a_bag_that_was_cut(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    bag(path, chunk_size=4096)
    whole = read_log(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    log = read_log(path)
    count = len(log.time)
    assert not log.origin.complete
    assert 50 < count < len(whole.time)
    np.testing.assert_array_equal(log.position, whole.position[:count])
    np.testing.assert_array_equal(log.command, whole.command[:count])


def test_a_bag_folder_and_commands_of_another_type(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    bag(tmp_path / "bag_0.mcap", stamped=False, command="/array")
    unnamed = ReadOptions(command_topic="/array", command_field="data")
    with pytest.raises(LogError, match="--joint-order NAME"):
        read_log(tmp_path, options=unnamed)
    with pytest.raises(LogError, match="lack hop"):
        read_log(tmp_path, options=replace(unnamed, joint_order=["knee", "hop"]))
    log = read_log(tmp_path, options=replace(unnamed, joint_order=["knee", "hip"]))
    k = np.arange(8, 400)
    np.testing.assert_allclose(log.command[:, 0], np.sin(0.1 * (k - k % 4)))
    assert any("times of reception" in note for note in log.notes)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"command_topic": "/elsewhere"}, "no commands on /elsewhere"),
        (
            {"measured_topic": "/imu", "command_topic": "/joint_command"},
            "no measured states on /imu",
        ),
        ({"command_topic": "/joint_command", "command_field": "velocity"}, "the 0 values"),
        ({"command_topic": "/joint_command", "command_field": "points.0"}, "no field 'points.0'"),
        ({"command_topic": "/joint_command", "command_field": "header"}, "not a list of numbers"),
    ],
)
def test_a_wrong_topic_or_field_lists_what_there_is(
    tmp_path: Path, options: dict[str, str], words: str
) -> None:
    path = tmp_path / "bag.mcap"
    bag(path)
    with pytest.raises(LogError, match=words) as caught:
        read_log(path, options=ReadOptions(**options))  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    if "topic" in words:
        assert "/joint_states (sensor_msgs/msg/JointState)" in str(caught.value)


# --- a format of another package ------------------------------------------------------------------

READER = '''
import hashlib

import numpy as np

from pronk.errors import LogError
from pronk.identify.logs.joint_log import JointLog, LogOrigin
from pronk.identify.logs.readers import Reader


def read_turns(path, robot, options):
    """Time; command; position: the angles of one joint in turns."""
    try:
        rows = [list(map(float, line.split(";"))) for line in path.read_text().splitlines()]
        time, command, position = np.array(rows).T
    except (OSError, ValueError) as error:
        raise LogError(f"{path}: no log in turns ({error}).") from None
    stated = options.reader_options
    scale = 2.0 * np.pi * float(stated.get("sign", "1"))
    return JointLog(
        robot="unknown" if robot is None else robot.name,
        joints=(stated.get("joint", "knee"),),
        time=time,
        command=scale * command[:, None],
        position=scale * position[:, None],
        origin=LogOrigin(
            source=str(path), sha256=hashlib.sha256(path.read_bytes()).hexdigest()
        ),
    )


TURNS = Reader(name="turns", suffixes=(".turns",), read=read_turns, options=("joint", "sign"))
'''


@pytest.fixture
def recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Install the reader as a package of its own and write a log of its format."""
    site = tmp_path / "site"
    info = site / "turns_reader-1.0.dist-info"
    info.mkdir(parents=True)
    (site / "turns_reader.py").write_text(READER)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: turns-reader\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[pronk.readers]\nturns = turns_reader:TURNS\n")
    monkeypatch.syspath_prepend(site)
    monkeypatch.delitem(sys.modules, "turns_reader", raising=False)
    time = np.arange(5000) / 500.0
    command = 0.04 * np.sin(2.0 * np.pi * (0.5 + 0.5 * time) * time)
    position = 0.95 * np.interp(time - 0.01, time, command)
    path = tmp_path / "chirp.turns"
    np.savetxt(path, np.stack([time, command, position], axis=1), delimiter=";", fmt="%.9f")
    return path


def test_a_reader_of_another_package_is_found_and_conforms(recording: Path) -> None:
    check_reader(readers()["turns"], recording)
    log = read_log(recording, options=ReadOptions(reader_options={"joint": "elbow", "sign": "-1"}))
    assert log.joints == ("elbow",)
    assert np.abs(log.command).max() == pytest.approx(2.0 * np.pi * 0.04, rel=1e-3)
    with pytest.raises(LogError, match="columns"):
        read_log(recording, options=ReadOptions(columns={"time": "t"}))
    options = ["--reader-option", "joint=elbow", "--reader-option", "sign=-1"]
    out = recording.with_name("out")
    assert "elbow" in accepted("response", recording, *options, "--out", out, "--no-plots")


def test_a_broken_package_leaves_the_other_formats(recording: Path) -> None:
    (recording.parent / "site" / "turns_reader.py").write_text("import no_such_module")
    with pytest.warns(UserWarning, match="turns_reader"):
        assert "turns" not in readers()
