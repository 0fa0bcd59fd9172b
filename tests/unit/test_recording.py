"""Recordings of other programs' commands: what is read of them, and of a command on the wire."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chirp_logs import chirp_log
from pronk.errors import LogError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.readers import read_log
from pronk.identify.logs.recording import RecordingHeader, RecordingWriter
from pronk.identify.match.match import match
from pronk.report.motion import read_motion
from pronk.robots import load_robot

PENDULUM = load_robot(Path(__file__).resolve().parents[2] / "examples" / "pendulum")
(JOINT,) = PENDULUM.joint_names
GAINS = (17.0, 0.4)
HEADER = RecordingHeader(robot=PENDULUM.name, joints=(JOINT,), metadata={"link": "test"})
ONE = np.ones(1)


def chirps() -> JointLog:
    return chirp_log(PENDULUM, JOINT, (15.0, 0.5), (0.25,), repeats=2, noise_rad=2e-4, threads=1)


def write_recording(
    path: Path,
    log: JointLog,
    *,
    is_stamped: bool = True,
    torque: float = 0.0,
    end: bool = True,
    gains: tuple[float, float] = GAINS,
) -> None:
    """Write a log as another program's: stiffness ramped up before it, damping after it.

    States arrive late by up to 30 ms and commands by up to 20 ms, of senders whose clocks stand
    elsewhere and go by other rates; without stamps all arrive at once.
    """
    rng = np.random.default_rng(3)
    writer = RecordingWriter(path, HEADER)
    stiffness, damping = gains

    def arrival(instant: float, latest: float) -> float:
        # Most messages are quick, and some wait for a busy computer.
        late = latest * float(rng.random()) if rng.random() < 0.2 else 1e-4 * float(rng.random())
        return instant + (late if is_stamped else 0.0)

    def send(instant: float, position: float, share: float) -> None:
        sent = (1.0 + 2e-5) * instant + 5000.0 if is_stamped else None
        shift = torque / stiffness
        writer.command(
            arrival(instant, 0.02),
            sent,
            ((position - shift) * ONE, 0.0 * ONE),
            (share * stiffness * ONE, damping * ONE, torque * ONE),
        )

    def report(instant: float, position: float) -> None:
        sent = (1.0 - 3e-5) * instant - 70.0 if is_stamped else None
        writer.state(arrival(instant, 0.03), sent, position * ONE, 0.0 * ONE, 0.0 * ONE)

    first = float(log.time[0])
    last = float(log.time[-1])
    period = 1.0 / log.rate_hz
    for tick in range(500):
        instant = first - (500 - tick) * period
        send(instant, 0.5, tick / 500.0)
        report(instant, 0.5)
    for row in range(len(log.time)):
        # The command in force at a state was sent before it.
        send(float(log.time[row]) - 1e-4, float(log.command[row, 0]), 1.0)
        report(float(log.time[row]), float(log.position[row, 0]))
    for tick in range(500):
        send(last + (tick + 1) * period, 0.0, 0.0)
        report(last + (tick + 1) * period, -0.3)
    if end:
        writer.end()


def test_the_motion_of_a_recording_is_on_the_wall_clock(tmp_path: Path) -> None:
    log = chirps()
    path = tmp_path / "recording.mcap"
    # Messages arrive now, as they do while a robot is recorded.
    began_s = time.monotonic()
    write_recording(path, replace(log, time=log.time + began_s), is_stamped=False)
    os.utime(path, (0.0, 0.0))
    motion = read_motion(path, PENDULUM, lambda: read_log(path, robot=PENDULUM))
    assert motion.notes == ()
    assert motion.time_ns[0] / 1e9 == pytest.approx(time.time(), abs=60.0)


@pytest.mark.parametrize("is_stamped", [True, False])
def test_the_part_with_constant_gains_is_read(tmp_path: Path, is_stamped: bool) -> None:
    log = chirps()
    path = tmp_path / "recording.mcap"
    write_recording(path, log, is_stamped=is_stamped)
    read = read_log(path, robot=PENDULUM)
    assert read.stiffness == pytest.approx([GAINS[0]])
    assert read.damping == pytest.approx([GAINS[1]])
    assert read.origin.complete
    assert len(read.time) == pytest.approx(len(log.time), abs=3)
    middle = len(read.time) // 2
    elapsed = read.time[middle] - read.time[10]
    assert elapsed == pytest.approx(log.time[middle] - log.time[10], abs=1e-3)
    command = np.interp(read.time - read.time[5], log.time - log.time[5], log.command[:, 0])
    assert np.sqrt(np.mean((command - read.command[:, 0]) ** 2)) < 0.02
    assert read.excited_joints == (JOINT,)


def test_a_recording_gives_the_gains_of_the_log(tmp_path: Path) -> None:
    """Late messages, clocks that differ, and a torque beside the position."""
    log = chirps()
    path = tmp_path / "recording.mcap"
    write_recording(path, log, torque=0.5)
    read = read_log(path, robot=PENDULUM)
    assert any("torques" in note for note in read.notes)
    direct = match([log], PENDULUM, drive_gains={JOINT: GAINS}).gains.joints[JOINT]
    recorded = match([read], PENDULUM).gains.joints[JOINT]
    assert recorded.stiffness.value == pytest.approx(direct.stiffness.value, rel=0.01)
    assert recorded.damping.value == pytest.approx(direct.damping.value, rel=0.02)
    assert recorded.delay_s.value == pytest.approx(direct.delay_s.value, abs=1e-3)


def test_a_recorder_that_stood_still_and_a_clock_that_was_set(tmp_path: Path) -> None:
    """Times of sending count through a pause of the recorder, those of arrival where they jump."""
    path = tmp_path / "recording.mcap"
    for clock_set_s, recorder_pause_s in ((0.0, 5.0), (30.0, 0.0), (-30.0, 0.0)):
        writer = RecordingWriter(path, HEADER)
        for tick in range(6000):
            instant = 0.002 * tick
            paused = 4.0 < instant < 4.0 + recorder_pause_s
            arrived = 4.0 + recorder_pause_s if paused else instant + 1e-4
            sent = instant + (clock_set_s if instant > 7.0 else 0.0)
            position = 0.1 * np.sin(instant) * ONE
            drive = (17.0 * ONE, 0.4 * ONE, 0.0 * ONE)
            writer.command(arrived, sent, (position, 0.0 * ONE), drive)
            writer.state(arrived, sent, position, 0.0 * ONE, 0.0 * ONE)
        writer.end()
        log = read_log(path, robot=PENDULUM)
        assert len(log.time) == 6000
        np.testing.assert_allclose(np.diff(log.time), 0.002, atol=1e-4)
        np.testing.assert_allclose(log.command, log.position, atol=1e-3)


def test_a_recording_that_was_cut_is_read_to_there(tmp_path: Path) -> None:
    log = chirps()
    path = tmp_path / "recording.mcap"
    write_recording(path, log, end=False)
    cut = path.read_bytes()
    path.write_bytes(cut[: int(0.8 * len(cut))])
    read = read_log(path, robot=PENDULUM)
    assert not read.origin.complete
    assert len(read.time) > 0.5 * len(log.time)
    assert any("cut" in note for note in read.notes)


def test_what_cannot_be_matched_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    writer = RecordingWriter(path, HEADER)
    for tick in range(2000):
        instant = 0.002 * tick
        drive = ((17.0 + 0.01 * tick) * ONE, 0.4 * ONE, 0.0 * ONE)
        writer.command(instant, None, (0.0 * ONE, 0.0 * ONE), drive)
        writer.state(instant, None, 0.0 * ONE, 0.0 * ONE, 0.0 * ONE)
    writer.end()
    with pytest.raises(LogError, match="stiffness"):
        read_log(path, robot=PENDULUM)

    writer = RecordingWriter(path, HEADER)
    for tick in range(2000):
        writer.state(0.002 * tick, None, 0.0 * ONE, 0.0 * ONE, 0.0 * ONE)
    writer.end()
    with pytest.raises(LogError, match="commands"):
        read_log(path, robot=PENDULUM)

    writer = RecordingWriter(path, HEADER)
    for tick in range(2000):
        writer.state(0.002 * tick, None, np.zeros(2), np.zeros(2), np.zeros(2))
        writer.command(
            0.002 * tick, None, (0.0 * ONE, 0.0 * ONE), (17.0 * ONE, 0.4 * ONE, 0.0 * ONE)
        )
    writer.end()
    with pytest.raises(LogError, match="damaged"):
        read_log(path, robot=PENDULUM)


def test_a_low_cmd_is_read_as_it_was_sent() -> None:
    pytest.importorskip("cyclonedds")
    from pronk.deploy.links.dds.codec import POS_STOP, VEL_STOP, joint_map
    from pronk.deploy.links.dds.image import c_image_dtype, serialize_image
    from pronk.deploy.links.dds.listener import read_low_cmd
    from pronk.deploy.links.dds.messages import LowCmd

    rng = np.random.default_rng(4)
    joints = joint_map(load_robot("mini_cheetah"))
    record = np.zeros(1, dtype=c_image_dtype(LowCmd))
    motors = record["motor_cmd"][0, :12]
    motors["mode"] = 1
    for name in ("q", "dq", "tau"):
        motors[name] = rng.uniform(-1.0, 1.0, 12)
    for name in ("kp", "kd"):
        motors[name] = rng.uniform(0.5, 5.0, 12)
    motors["mode"][3] = 0
    motors["q"][4] = POS_STOP
    motors["dq"][5] = VEL_STOP
    command = read_low_cmd(joints, serialize_image(LowCmd, record))
    off = np.arange(12) == 3
    free = off | (np.arange(12) == 4)
    undamped = off | (np.arange(12) == 5)
    np.testing.assert_allclose(command.stiffness, np.where(free, 0.0, motors["kp"]))
    np.testing.assert_allclose(command.damping, np.where(undamped, 0.0, motors["kd"]))
    np.testing.assert_allclose(command.position, np.where(free, 0.0, joints.sign * motors["q"]))
    np.testing.assert_allclose(
        command.velocity, np.where(undamped, 0.0, joints.sign * motors["dq"])
    )
    np.testing.assert_allclose(command.torque, np.where(off, 0.0, joints.sign * motors["tau"]))


def test_an_lcm_command_is_read_as_it_was_sent() -> None:
    from pronk.deploy.links.lcm.layouts import CHEETAH, KNEE_RATIO, WTW
    from pronk.deploy.links.lcm.listener import read_lcm_command

    rng = np.random.default_rng(5)
    values = {name: rng.uniform(-1.0, 1.0, 12) for name in ("q_des", "qd_des", "tau_ff")}
    gains = rng.uniform(0.5, 5.0, 12)
    data = WTW.command.encode({**values, "kp": gains, "kd": 0.1 * gains})
    command = read_lcm_command(WTW, data)
    np.testing.assert_allclose(command.position, WTW.signs * values["q_des"], rtol=1e-6)
    np.testing.assert_allclose(command.velocity, WTW.signs * values["qd_des"], rtol=1e-6)
    np.testing.assert_allclose(command.torque, WTW.signs * values["tau_ff"], rtol=1e-6)
    np.testing.assert_allclose(command.stiffness, gains, rtol=1e-6)
    # A Mini Cheetah's robot reads no more, and its knees are stiffer than the wire says.
    data = CHEETAH.command.encode({"q_des": 1.0, "kp_joint": 5.0, "kd_joint": 0.2, "tau_ff": 3.0})
    command = read_lcm_command(CHEETAH, data)
    assert not command.torque.any()
    assert command.stiffness[0] == pytest.approx(5.0)
    assert command.stiffness[2] == pytest.approx(5.0 / KNEE_RATIO**2)
