"""`pronk record` beside other programs: it sends nothing, loses nothing, and gives the same gains.

All limits on time are wide, so that a busy computer is not taken for a fault.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dds_domain import own_domain
from deploy_runs import FRESH, free_port
from pronk.cli.sweep import record_wire
from pronk.deploy.links.address import Address
from pronk.deploy.runtime.limits import AgeLimits
from pronk.deploy.runtime.plan import Link
from pronk.errors import HardwareError
from pronk.identify.excitation.plan import make_plan
from pronk.identify.excitation.signals import Chirp
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.readers import read_log
from pronk.identify.match.drift import compare_values
from pronk.identify.match.gains import JointGains
from pronk.identify.match.match import match
from pronk.robots import load_robot

pytest.importorskip("lcm")
pytest.importorskip("cyclonedds")

from pronk.deploy.links.dds.link import COMMANDS, DdsNetwork, Participant
from pronk.deploy.links.dds.messages import LowCmd, LowState
from pronk.deploy.links.lcm.layouts import CHEETAH
from pronk.deploy.links.lcm.link import open_lcm, url_of

pytestmark = pytest.mark.live

PATIENT = AgeLimits(hold_s=20.0, damp_s=20.0, latch_s=20.0, expiry_s=20.0, lag=20000.0)
LONG_S = 300.0
ATTEMPTS = 3
"""Sweeps that are tried: on a busy computer the sweep's own checks may end one."""
PAUSE_S = 1.0
"""Time without a state after which the computer stood still, so that nothing is said of gains."""


def started(*words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "pronk.cli.main", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


@contextmanager
def virtual_robot(*words: str) -> Iterator[None]:
    running = started("simulate", *words)
    assert running.stdout is not None
    try:
        assert any(line.startswith("ready:") for line in running.stdout)
        yield
    finally:
        running.kill()
        running.communicate()


def swept_and_recorded(
    robot_name: str, joint: str, address: Address, out: Path
) -> tuple[JointLog, JointLog, dict[str, Any]]:
    """Sweep a joint while another process records; return both logs and the recorder's figures."""
    robot = load_robot(robot_name)
    chirp = Chirp(length_s=5.0, start_hz=0.3, stop_hz=8.0)
    plan = make_plan(robot, [joint], chirp, amplitudes=(0.2,), repeats=2, settle_s=1.0)
    recording = out / "recording.mcap"
    figures = out / "record.json"
    words = ("--wait", str(LONG_S), "--out", str(recording), "--json", str(figures))
    recorder = started("record", robot_name, "--link", str(address), *words)
    try:
        link = Link(robot=robot_name, address=address, fresh=FRESH)
        swept = record_wire(plan, out, link, ages=PATIENT, standby_s=5.0, operator_timeout_s=20.0)
        recorder.send_signal(signal.SIGINT)
        _, errors = recorder.communicate(timeout=LONG_S)
    finally:
        recorder.kill()
    assert recorder.returncode == 0, errors
    summary: dict[str, Any] = json.loads(figures.read_text())
    return read_log(swept["logs"][0], robot=robot), read_log(recording, robot=robot), summary


def assert_alike(sweep_gains: JointGains, recorded_gains: JointGains) -> None:
    """Gains within a few per cent; a busy computer disturbs both, as their intervals say."""
    for first, second in (
        (sweep_gains.stiffness, recorded_gains.stiffness),
        (sweep_gains.damping, recorded_gains.damping),
    ):
        interval, _ = compare_values(first, second, matters=1.0)
        difference = abs(second.value / first.value - 1.0)
        assert difference < max(0.05, interval / first.value)


def missed_share(sweep_log: JointLog, recorded: JointLog, joint: str) -> float:
    """Return the share of the commands of a sweep that its recording has not as they were sent."""
    sent = np.unique(sweep_log.command[:, sweep_log.column(joint)])
    heard = recorded.command[:, recorded.column(joint)]
    missed = [target for target in sent if np.abs(heard - target).min() > 1e-6]
    return len(missed) / len(sent)


@pytest.mark.parametrize(("robot_name", "scheme"), [("go2", "dds"), ("mini_cheetah", "lcm")])
def test_a_recorded_sweep_gives_the_gains_of_the_sweep(
    robot_name: str, scheme: str, tmp_path: Path
) -> None:
    joint = "FR_knee"
    robot = load_robot(robot_name)
    reason = ""
    for attempt in range(ATTEMPTS):
        place = {"port": free_port()} if scheme == "lcm" else {"domain": own_domain()}
        ((option, number),) = place.items()
        out = tmp_path / str(attempt)
        out.mkdir()
        words = (robot_name, "--link", scheme, f"--{option}", str(number), "--realtime")
        try:
            with virtual_robot(*words):
                sweep_log, recorded, summary = swept_and_recorded(
                    robot_name, joint, Address.parse(scheme, **place), out
                )
        except HardwareError as error:
            # The sweep's own supervision ends it where a busy computer stops robot or servo.
            reason = str(error)
            continue
        if summary["longest_gap_s"] >= PAUSE_S:
            reason = f"no state for {summary['longest_gap_s']:.1f} s"
            continue
        missed = missed_share(sweep_log, recorded, joint)
        # Nor has a recorder that did not run for a while received all; one that loses never does.
        if missed < 0.2 or attempt == ATTEMPTS - 1:
            break
        reason = f"{missed:.0%} of the commands missed"
    else:
        pytest.skip(f"this computer is too busy for a sweep in real time: {reason}")
    assert summary["virtual"]
    assert recorded.virtual
    assert recorded.origin.complete
    assert recorded.excited_joints == (joint,)
    column = recorded.column(joint)
    assert recorded.stiffness is not None
    assert recorded.stiffness[column] == pytest.approx(robot.joint(joint).stiffness, rel=1e-5)
    assert (recorded.torque is None) == (scheme == "lcm")
    # Commands as they were sent.
    assert missed < 0.2
    assert_alike(
        match([sweep_log], robot).gains.joints[joint],
        match([recorded], robot).gains.joints[joint],
    )


def test_nothing_is_sent_over_lcm_and_missing_commands_are_named(tmp_path: Path) -> None:
    port = free_port()
    channels: list[str] = []
    listener = open_lcm(url_of(port=port))
    listener.subscribe(".*", lambda channel, _: channels.append(channel)).set_queue_capacity(1000)
    out = tmp_path / "recording.mcap"
    words = ("--port", str(port), "--wait", "3", "--out", str(out))
    with virtual_robot("mini_cheetah", "--link", "lcm", "--port", str(port)):
        recorder = started("record", "mini_cheetah", "--link", "lcm", *words)
        while recorder.poll() is None:
            listener.handle_timeout(20)
        _, errors = recorder.communicate()
    assert recorder.returncode == 2
    assert "no command on spi_debug_cmd" in errors
    assert "no state" not in errors
    assert not out.exists()
    assert CHEETAH.joints.channel in channels
    assert CHEETAH.command.channel not in channels
    assert not [name for name in channels if "interface" in name]


def test_no_writer_is_opened_on_dds_and_missing_states_are_named(tmp_path: Path) -> None:
    domain = own_domain()
    participant = Participant(DdsNetwork(domain=domain))
    commands = participant.reader(COMMANDS, LowCmd)
    states = participant.writer("rt/lowstate", LowState)
    out = tmp_path / "recording.mcap"
    words = ("--domain", str(domain), "--wait", "6", "--out", str(out))
    recorder = started("record", "go2", "--link", "dds", *words)
    was_heard = False
    while recorder.poll() is None:
        # The recorder reads the states of this process, so that it has joined the domain.
        was_heard = was_heard or bool(states.get_matched_subscriptions())
        assert not commands.get_matched_publications()
        time.sleep(0.02)
    _, errors = recorder.communicate()
    assert was_heard
    assert recorder.returncode == 2
    assert "no state on rt/lowstate" in errors
    assert "no command on rt/lowcmd" in errors
    assert not out.exists()


def test_a_recording_ends_by_time(tmp_path: Path) -> None:
    """States and commands of two programs of the test, on DDS; the log has them all."""
    from pronk.deploy.links.dds.codec import encode_dds_command, encode_dds_state, joint_map
    from pronk.deploy.links.dds.link import RawSample
    from pronk.jump.virtual.robot import hold_of
    from pronk.robots.machine import State

    domain = own_domain()
    robot = load_robot("go2")
    joints = joint_map(robot)
    participant = Participant(DdsNetwork(domain=domain))
    states = participant.writer("rt/lowstate", LowState)
    commands = participant.writer(COMMANDS, LowCmd)
    out = tmp_path / "recording.mcap"
    figures = tmp_path / "record.json"
    words = ("--domain", str(domain), "--wait", str(LONG_S), "--seconds", "4", "--out", str(out))
    recorder = started("record", "go2", "--link", "dds", *words, "--json", str(figures))
    hold = hold_of(robot)
    while not states.get_matched_subscriptions() or not commands.get_matched_subscriptions():
        assert recorder.poll() is None
        time.sleep(0.02)
    tick = 0
    begun = time.monotonic()
    while recorder.poll() is None:
        tick += 1
        state = State(
            time=time.monotonic(),
            sequence=tick,
            position=hold.position + 1e-4 * tick,
            velocity=np.zeros(12),
            torque=np.full(12, 0.1),
            gyro=np.zeros(3),
            accelerometer=np.array([0.0, 0.0, 9.81]),
            bus_voltage=28.0,
            robot_time=time.monotonic() - begun,
        )
        states.write(RawSample(encode_dds_state(joints, state)))
        commands.write(RawSample(encode_dds_command(joints, hold)))
        time.sleep(0.005)
    _, errors = recorder.communicate()
    assert recorder.returncode == 0, errors
    summary = json.loads(figures.read_text())
    assert summary["seconds"] >= 3.5
    log = read_log(out, robot=robot)
    assert log.origin.complete
    assert log.stiffness == pytest.approx(hold.stiffness, rel=1e-5)
    np.testing.assert_allclose(log.command, np.tile(hold.position, (len(log.time), 1)), atol=1e-5)
    # Each state once, in order, none lost between the first and the last.
    steps = np.diff(log.position[:, 0]) / 1e-4
    np.testing.assert_allclose(steps, 1.0, atol=0.05)
