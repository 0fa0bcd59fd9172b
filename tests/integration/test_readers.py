"""Log readers: round trips, real recordings, timestamps and plausibility."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pronk
from log_files import write_csv, write_npz
from pronk.errors import LogError, RobotError
from pronk.logs.checks import check_motion, check_rate, check_unit, examine, time_at_ends
from pronk.logs.joint_log import JointLog, Segment
from pronk.logs.mcap_log import write_mcap
from pronk.logs.readers import read_log, read_logs
from pronk.robots import load_robot

SHARED = Path(pronk.__file__).parents[3] / "shared"
SO101 = SHARED / "data" / "so101"
RECORDINGS = ("backlash_detection", "chirp_sweep", "multisine", "sinusoidal_sweep", "step_response")
recorded = pytest.mark.skipif(not SO101.is_dir(), reason="the shared recordings are not here")


def example(n: int = 500) -> JointLog:
    """Two joints of a leg at 500 Hz."""
    time = np.arange(n) / 500.0
    command = np.stack([0.2 * np.sin(6.0 * time), np.full(n, 0.5)], axis=1)
    return JointLog(
        robot="mini_cheetah",
        joints=("FR_hip_roll", "FR_knee"),
        time=time,
        command=command,
        position=0.9 * command,
        velocity=np.gradient(command, time, axis=0),
        torque=17.0 * 0.1 * command,
        frequency=np.full(n, 6.0 / (2.0 * np.pi)),
        segments=(
            Segment(
                kind="chirp",
                joints=("FR_hip_roll",),
                start=0.1,
                stop=0.9,
                amplitude=0.2,
                band_hz=(0.1, 25.0),
            ),
        ),
        pose=np.array([0.0, 0.5]),
    )


# --- real recordings ----------------------------------------------------------------------------


@recorded
@pytest.mark.parametrize("name", RECORDINGS)
def test_so101_recordings_run_at_49_85_hz(name: str) -> None:
    log = read_log(SO101 / name)
    assert log.robot == "so101"
    assert log.joints == load_robot("so101").joint_names
    assert log.rate_hz == pytest.approx(49.85, abs=0.005)
    assert log.velocity is not None
    assert log.torque is not None
    for segment in log.segments:
        assert segment.kind == "unknown"
        check_motion(log, segment.joints[0])


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
    scaled = read_log(SO101 / "multisine", scale={"gripper": 1.9})
    assert scaled.unit("gripper") == "rad"
    np.testing.assert_allclose(scaled.position[:, 5], 1.9 * log.position[:, 5])
    np.testing.assert_array_equal(scaled.position[:, :5], log.position[:, :5])
    np.testing.assert_array_equal(scaled.velocity, log.velocity)  # type: ignore[arg-type]


@recorded
def test_expectations_that_the_timestamps_contradict_are_refused() -> None:
    path = SO101 / "chirp_sweep"
    with pytest.raises(LogError, match=r"49\.85 Hz"):
        read_log(path, rate_hz=50.0)
    read_log(path, rate_hz=49.85)
    with pytest.raises(LogError, match="probably in us"):
        read_log(path, time_unit="s")
    with pytest.raises(RobotError, match="FR_hip_roll"):
        read_log(path, robot=load_robot("mini_cheetah"))


@recorded
def test_a_folder_of_recordings_is_read_whole() -> None:
    logs = read_logs([SO101])
    assert [Path(log.source).name for log in logs] == list(RECORDINGS)
    assert len({log.sha256 for log in logs}) == 5


@recorded
def test_sage_joints_can_be_renamed() -> None:
    log = read_log(SO101 / "multisine", joint_names=list("abcdef"))
    assert log.joints == tuple("abcdef")
    log = read_log(SO101 / "multisine", joint_names={"Jaw": "claw"})
    assert log.joints[0] == "Rotation"
    assert log.unit("claw") == "unknown"


def test_sage_command_is_the_one_in_force(tmp_path: Path) -> None:
    """States and commands on clocks of their own: the last command at or before each state."""
    states = "".join(
        f'STATE_MOTOR,{2000 * k + 500},"[0.{k:02d}, 1.0]","[0, 0]","[0, 0]"\n' for k in range(60)
    )
    controls = "".join(f'CONTROL,{20000 * k + 10000},"[{k}.0, 0.5]"\n' for k in range(6))
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


@pytest.mark.parametrize("kind", ["mcap", "npz", "csv"])
def test_round_trip(tmp_path: Path, kind: str) -> None:
    log = example()
    path = tmp_path / f"a.{kind}"
    {"mcap": write_mcap, "npz": write_npz, "csv": write_csv}[kind](path, log)
    back = read_log(path, unit=None if kind == "mcap" else "rad")
    for name in ("time", "command", "position", "velocity", "torque"):
        np.testing.assert_array_equal(getattr(back, name), getattr(log, name), err_msg=name)
    assert back.joints == log.joints
    if kind != "mcap":
        assert back.segments[0].amplitude == pytest.approx(0.2, rel=1e-3)
    else:
        assert back.segments == log.segments
        assert back.robot == log.robot
        np.testing.assert_array_equal(back.frequency, log.frequency)  # type: ignore[arg-type]


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
    rows = [["t_ms", " q ", "q_des", "remark"]]
    rows += [[repr(20.0 * k), repr(v), repr(v / 2.0), "x"] for k, v in enumerate(values)]
    text = "\r\n".join(delimiter.join(row) for row in rows)
    path.write_bytes(("\ufeff" * bom + text).encode())
    log = read_log(
        path,
        unit="deg",
        time_unit="ms",
        columns={"time": "t_ms", "position.FR_knee": "q", "command.FR_knee": "q_des"},
        robot=load_robot("mini_cheetah"),
    )
    np.testing.assert_allclose(log.position[:, 0], np.deg2rad(values), atol=1e-15)
    np.testing.assert_allclose(log.command[:, 0], np.deg2rad(values) / 2.0, atol=1e-15)
    np.testing.assert_allclose(log.time, 0.02 * np.arange(len(values)), atol=1e-12)
    assert log.robot == "mini_cheetah"


def test_npz_of_another_tool(tmp_path: Path) -> None:
    time = 100.0 + np.arange(300) / 200.0
    position = np.rad2deg(0.1 * np.sin(time))
    np.savez(tmp_path / "a.npz", time=time, command=position, position=position)
    with pytest.raises(LogError, match="radians or degrees"):
        read_log(tmp_path / "a.npz", joint_names=["FR_knee"])
    with pytest.raises(LogError, match="give joint_names"):
        read_log(tmp_path / "a.npz", unit="deg")
    log = read_log(tmp_path / "a.npz", unit="deg", joint_names=["FR_knee"])
    np.testing.assert_allclose(log.position[:, 0], 0.1 * np.sin(time), atol=1e-15)


def test_pace_recording_without_pytorch_gives_pytorchs_numbers(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    generator = torch.Generator().manual_seed(0)
    time = torch.arange(400, dtype=torch.float64) / 400.0
    command = torch.rand(400, 12, generator=generator)
    # A transposed view: strides that are not those of rows.
    position = torch.rand(12, 400, generator=generator, dtype=torch.float64).T
    path = tmp_path / "chirp_data.pt"
    torch.save({"time": time, "dof_pos": position, "des_dof_pos": command, "note": "x"}, path)
    log = read_log(path, robot=load_robot("mini_cheetah"))
    np.testing.assert_array_equal(log.position, position.numpy())
    np.testing.assert_array_equal(log.command, command.numpy().astype(float))
    assert log.joints == load_robot("mini_cheetah").joint_names
    with pytest.raises(LogError, match="give joint_names"):
        read_log(path)
    names = [f"j{i}" for i in range(12)]
    code = (
        "import sys; from pronk.logs.readers import read_log;"
        f"log = read_log({str(path)!r}, joint_names={names});"
        "print(log.joints[11], 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["j11", "False"]


def test_an_upper_case_ending_and_an_explicit_format(tmp_path: Path) -> None:
    for name, options in (("A.CSV", {}), ("a.txt", {"format": "csv"})):
        write_csv(tmp_path / name, example())
        assert len(read_log(tmp_path / name, unit="rad", **options).time) == 500


# --- timing -------------------------------------------------------------------------------------


def test_jitter_gaps_and_lost_samples_are_counted() -> None:
    rng = np.random.default_rng(0)
    time = np.arange(2000) / 500.0 + rng.normal(0.0, 50e-6, 2000)
    kept = np.delete(time, np.r_[300:310, 900:905])
    found = examine(kept)
    assert len(found.gaps) == 2
    assert found.lost == 15
    # Each interval has the jitter of two stamps.
    assert found.jitter_s == pytest.approx(50e-6 * np.sqrt(2.0), rel=0.1)
    assert found.gaps[0][0] == pytest.approx(299 / 500.0, abs=1e-3)
    # Lost samples do not make the clock slow.
    check_rate(found, "log", 500.0)


def test_a_perfect_clock_and_one_that_drifts() -> None:
    index = np.arange(1000)
    found = examine(index / 500.0)
    assert found.rate_hz == pytest.approx(500.0)
    assert found.jitter_s < 1e-12
    assert found.drift_s < 1e-9
    assert found.lost == 0
    assert 0.3e-3 < examine(index / 500.0 + 1e-3 * np.sin(np.pi * index / 999.0)).drift_s < 1e-3


@pytest.mark.parametrize(
    ("rate", "read_as", "written_in"),
    [
        (500.0, "s", "ms"),
        (500.0, "us", "s"),
        (1000.0, "ns", "us"),
        (49.85, "s", "us"),
    ],
)
def test_another_unit_of_time_is_recognized(rate: float, read_as: str, written_in: str) -> None:
    units = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
    numbers = np.arange(200) / rate / units[written_in]
    with pytest.raises(LogError, match=f"probably in {written_in} "):
        check_unit(numbers * units[read_as], "log", read_as)
    check_unit(numbers * units[written_in], "log", written_in)


def test_exact_duplicates_can_be_dropped_and_are_mentioned(tmp_path: Path) -> None:
    log = example(50)
    repeated = np.sort(np.r_[np.arange(50), 7, 7, 20])
    text = [",".join(("time", "position.a", "command.a"))]
    columns = np.stack([log.time, log.position[:, 0], log.command[:, 0]], axis=1)
    text += [",".join(map(repr, columns[i].tolist())) for i in repeated]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(text))
    with pytest.raises(LogError, match="row 10 repeats the timestamp"):
        read_log(path, unit="rad")
    back = read_log(path, unit="rad", drop_duplicates=True)
    np.testing.assert_array_equal(back.time, log.time)
    assert any(note.startswith("3 rows") for note in back.notes)
    # The same timestamp with another value is not a duplicate, and stays an error.
    text[9] = text[9].replace(",", ",1", 1)
    path.write_text("\n".join(text))
    with pytest.raises(LogError, match="repeats the timestamp"):
        read_log(path, unit="rad", drop_duplicates=True)


def test_an_epoch_clock_begins_at_zero(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{1_700_000_000_000_000 + 2000 * k},0.1,{0.01 * k}" for k in range(50)]
    path.write_text("\n".join(["time,position.a,command.a", *rows]))
    log = read_log(path, unit="rad", time_unit="us")
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
    check_motion(moved(0.8 * SWING, SWING), "FR_knee")
    assert time_at_ends(moved(0.8 * SWING, SWING), "FR_knee") == 0.0
    # A joint with a dead band (play operator) rests at every turn, which is not saturation.
    position = np.zeros(len(SWING))
    for k in range(1, len(SWING)):
        position[k] = np.clip(position[k - 1], SWING[k] - 0.1, SWING[k] + 0.1)
    assert time_at_ends(moved(position, SWING), "FR_knee") < 0.05


@pytest.mark.parametrize("limits", [(-0.05, 1.0), (-1.0, 0.1)])
def test_saturation_is_noted(tmp_path: Path, limits: tuple[float, float]) -> None:
    write_mcap(tmp_path / "a.mcap", moved(np.clip(SWING, *limits), SWING))
    assert any("FR_knee is saturated" in note for note in read_log(tmp_path / "a.mcap").notes)


@pytest.mark.parametrize(
    ("position", "command", "words"),
    [
        (np.zeros(4000), SWING, "did not move"),
        (np.where(SWING > 0.0, 0.0015, 0.0), SWING, "did not move"),
        (SWING, np.zeros(4000), "was not excited"),
    ],
)
def test_a_joint_without_motion_is_refused(
    position: np.ndarray, command: np.ndarray, words: str
) -> None:
    with pytest.raises(LogError, match=f"FR_knee {words}"):
        check_motion(moved(position, command), "FR_knee")


@pytest.mark.parametrize("offset", [0.0, 20.0])
def test_degrees_read_as_radians_are_refused(tmp_path: Path, offset: float) -> None:
    write_csv(
        tmp_path / "a.csv", moved(*[offset + (np.rad2deg(SWING) if not offset else SWING)] * 2)
    )
    with pytest.raises(LogError, match="probably in degrees"):
        read_log(tmp_path / "a.csv", unit="rad")
    assert np.ptp(read_log(tmp_path / "a.csv", unit="deg").position) < 0.6


def test_a_log_of_another_robot_is_refused(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", replace(example(), robot="so101"))
    with pytest.raises(LogError, match=r"so101.*mini_cheetah"):
        read_log(tmp_path / "a.mcap", robot=load_robot("mini_cheetah"))
