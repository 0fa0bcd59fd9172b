"""Sweeps by wire: the whole of it against a real `pronk simulate` process, in real time.

Patience is great throughout: a slow computer must not pass for a fault.
"""

from __future__ import annotations

import io
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from multiprocessing import active_children, get_context
from pathlib import Path

import numpy as np
import pytest

from pronk.cli import main as cli
from pronk.cli.console import Person
from pronk.cli.sweep import record_wire
from pronk.errors import HardwareError, LogError
from pronk.excitation.plan import SweepPlan, make_plan
from pronk.excitation.signals import Chirp
from pronk.links.address import Address
from pronk.links.lcm.codec import CHEETAH, decode_command, encode_command
from pronk.links.lcm.link import url_of
from pronk.links.link import Freshness
from pronk.links.machine import Command
from pronk.logs.joint_log import JointLog
from pronk.logs.mcap_log import read_mcap
from pronk.robots import RobotSpec, load_robot
from pronk.runtime.run import Recorded
from pronk.virtual.server import hold_of

pytestmark = pytest.mark.live

lcm = pytest.importorskip("lcm")

ROBOT = load_robot("mini_cheetah")
HOLD = hold_of(ROBOT)
PATIENT = {"hold_s": 10.0, "damp_s": 10.0, "latch_s": 10.0, "expiry_s": 10.0, "lag": 10000.0}
"""A busy computer must not look like a fault."""
DAMPED_S = 0.060
"""The bar: from a fault to damping on the wire."""
FRESH = Freshness(share=0.02, longest_gap_s=10.0)


@cache
def plan_of(joint: str) -> SweepPlan:
    # One that ends soon, and one that is always ended early.
    signal = Chirp(length_s=1.0 if joint == "FR_knee" else 20.0, start_hz=0.5, stop_hz=5.0)
    return make_plan(ROBOT, [joint], signal, amplitudes=(0.2,), repeats=1, settle_s=0.1)


def slow(limit: float) -> RobotSpec:
    """The robot with a lower no-load speed [rad/s]."""
    joints = (replace(j, drive=replace(j.drive, no_load_speed=limit)) for j in ROBOT.joints)
    return replace(ROBOT, joints=tuple(joints))


# --- Over LCM, two processes --------------------------------------------------------------------


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """Address of a virtual robot of its own."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        number = int(probe.getsockname()[1])
    code = "import sys; from pronk.cli.main import run; sys.exit(run(['simulate', *sys.argv[1:]]))"
    running = subprocess.Popen(
        [sys.executable, "-c", code, "--port", str(number)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert running.stdout is not None
    try:
        assert running.stdout.readline().startswith("ready: the virtual mini_cheetah")
        yield number
    finally:
        running.kill()
        running.communicate()


class Listener:
    """Records the commands on the wire."""

    def __init__(self, port: int) -> None:
        self.received: list[tuple[float, Command]] = []
        """Each with the time at which it came [s]."""
        self._lcm = lcm.LCM(url_of(port=port))
        self._lcm.subscribe(CHEETAH.command.channel, self._hear)
        self._open = True
        self._thread = threading.Thread(target=self._listen)

    def __enter__(self) -> Listener:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._open = False
        self._thread.join()

    @property
    def commanded(self) -> float:
        """When joints were last held, not damped [s]."""
        return max(
            (when for when, command in self.received if command.stiffness.any()), default=-1e9
        )

    def damped(self, fault: float) -> float:
        """When damping came after a fault, for a second, and nothing else since [s]."""
        first = min(when for when, c in self.received if when > fault and not c.stiffness.any())
        assert self.commanded < first
        assert self.received[-1][0] - first >= 0.95  # as far as this thread can tell
        return first

    def _hear(self, _: str, data: bytes) -> None:
        self.received.append((time.monotonic(), decode_command(CHEETAH, data)))

    def _listen(self) -> None:
        while self._open:
            self._lcm.handle_timeout(50)


def swept(robot: RobotSpec, plan: SweepPlan, out: Path, port: int) -> Recorded:
    address = Address.parse("lcm", port=port)
    plan = replace(plan, robot=robot)
    return record_wire(plan, out, address, limits=PATIENT, fresh=FRESH, real_time=True)


def await_(what: Callable[[], bool], seconds: float = 60.0) -> None:
    until = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < until
        time.sleep(0.05)


def written(path: Path) -> JointLog | None:
    """What can be read of a log that is being written; None before its first half second."""
    try:
        return read_mcap(path)
    except LogError:
        return None


def once_written(path: Path, what: Callable[[], None]) -> threading.Thread:
    """Do something once there are samples in a log."""

    def wait() -> None:
        await_(lambda: written(path) is not None)
        what()

    thread = threading.Thread(target=wait)
    thread.start()
    return thread


def test_a_knee_is_swept_over_lcm(port: int, tmp_path: Path) -> None:
    plan = plan_of("FR_knee")
    with Listener(port) as listener:
        recorded = swept(ROBOT, plan, tmp_path, port)
    assert recorded.virtual
    assert recorded.servo["n"] > 100
    assert [path.name for path in recorded.logs] == ["FR_knee.mcap"]
    log = read_mcap(recorded.logs[0])
    assert log.complete
    assert log.virtual
    assert log.metadata["link"] == f"lcm://?port={port}"
    # The spi messages carry no torque and no voltage; none is made up.
    assert log.metadata["torque"] == "absent"
    assert log.torque is None
    part = log.cut(log.segments[0])
    knee = log.column("FR_knee")
    travel = np.ptp(part.position, axis=0)
    assert 0.15 < travel[knee] < 1.0
    # The virtual robot's own bench held the others.
    assert np.delete(travel, knee).max() < 0.05
    assert log.segments[0].clamped == ("FR_hip_roll", "FR_hip_pitch")
    assert np.unique(part.command[:, knee]).size > 20
    # It is left damped.
    np.testing.assert_array_equal(listener.received[-1][1].stiffness, 0.0)


def test_a_breach_damps_and_keeps_a_log_that_reads(
    port: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Listener(port) as listener, pytest.raises(HardwareError, match="rad/s"):
        swept(slow(3.0), plan_of("FR_hip_roll"), tmp_path, port)
    log = read_mcap(tmp_path / "FR_hip_roll.mcap")
    assert not log.complete
    assert "rad/s" in log.notes[0]
    assert "FR_hip_roll.mcap" in capsys.readouterr().err
    np.testing.assert_array_equal(listener.received[-1][1].stiffness, 0.0)


def test_who_else_commands_later_ends_the_sweep(port: int, tmp_path: Path) -> None:
    other = lcm.LCM(url_of(port=port))
    path = tmp_path / "FR_hip_roll.mcap"
    foreign = encode_command(CHEETAH, replace(HOLD, position=HOLD.position + 0.01))
    late = once_written(path, lambda: other.publish(CHEETAH.command.channel, foreign))
    with pytest.raises(HardwareError, match="another program commands the joints"):
        swept(ROBOT, plan_of("FR_hip_roll"), tmp_path, port)
    late.join()
    log = read_mcap(path)
    assert not log.complete
    assert "another program" in log.notes[0]


def test_without_a_robot_there_is_no_log(tmp_path: Path) -> None:
    with pytest.raises(HardwareError, match="sent no state on spi_data"):
        swept(ROBOT, plan_of("FR_hip_roll"), tmp_path / "x", 7799)
    assert not (tmp_path / "x").exists()


# --- Faults, while a leg is held ----------------------------------------------------------------


def owner(out: Path, port: int) -> None:
    """A `pronk sweep` of its own."""
    swept(ROBOT, plan_of("FR_hip_roll"), out, port)


def test_a_command_that_is_killed_leaves_the_joints_damped_and_a_log(
    port: int, tmp_path: Path
) -> None:
    path = tmp_path / "FR_hip_roll.mcap"
    running = get_context("spawn").Process(target=owner, args=(tmp_path, port))
    with Listener(port) as listener:
        running.start()
        await_(lambda: bool((log := written(path)) and log.segments))
        killed = time.monotonic()
        running.kill()
        running.join()
        # The system frees its memory before the end is noticed: 15 ms if it is not busy.
        gone = time.monotonic()
        # The servo has no parent now; when it is silent it has ended.
        await_(lambda: time.monotonic() - listener.received[-1][0] > 0.2)
    assert listener.damped(killed) - gone < DAMPED_S
    log = read_mcap(path)
    assert not log.complete
    # The logger outlives the program that started it.
    assert killed - log.time[-1] < 0.7
    (segment,) = log.segments
    assert np.ptp(log.cut(segment).command[:, 0]) > 0.0


def test_a_servo_that_is_killed_is_said_and_the_log_ends(
    port: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "FR_hip_roll.mcap"

    def kill() -> None:
        (servo,) = (child for child in active_children() if child.name == "pronk servo")
        servo.kill()

    with Listener(port) as listener:
        killer = once_written(path, kill)
        with pytest.raises(HardwareError, match="servo's process was killed"):
            swept(ROBOT, plan_of("FR_hip_roll"), tmp_path, port)
        killer.join()
    log = read_mcap(path)
    assert not log.complete
    assert "servo's process was killed" in log.notes[0]
    # To the last of what it did.
    assert listener.commanded - log.time[-1] < 0.1
    assert "FR_hip_roll.mcap" in capsys.readouterr().err


def test_the_interrupt_key_damps_and_keeps_the_log(port: int, tmp_path: Path) -> None:
    path = tmp_path / "FR_hip_roll.mcap"
    pressed = []

    def press() -> None:
        pressed.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)

    with Listener(port) as listener:
        finger = once_written(path, press)
        with pytest.raises(KeyboardInterrupt):
            swept(ROBOT, plan_of("FR_hip_roll"), tmp_path, port)
        finger.join()
    assert listener.damped(pressed[0]) - pressed[0] < DAMPED_S
    log = read_mcap(path)
    assert not log.complete
    assert "interrupted" in log.notes[0]
    assert abs(log.time[-1] - listener.commanded) < 0.1
    assert not active_children()


# --- The person at a real bench -----------------------------------------------------------------


def test_a_person_clamps_joints_when_requested(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    reading, writing = os.pipe()
    person = Person()
    with os.fdopen(reading) as stdin, os.fdopen(writing, "w") as hand:
        monkeypatch.setattr(sys, "stdin", stdin)
        person(())
        assert capsys.readouterr().out == ""
        hand.write("\n")
        hand.flush()
        person(("FR_hip_roll", "FR_hip_pitch"))
        assert "fix FR_hip_roll, FR_hip_pitch mechanically" in capsys.readouterr().out
        person(("FR_hip_pitch", "FR_hip_roll"))
        assert capsys.readouterr().out == ""
        hand.write("\n")
        hand.flush()
        person(())
        assert "free FR_hip_roll, FR_hip_pitch" in capsys.readouterr().out
        hand.close()
        with pytest.raises(HardwareError, match="no person is there"):
            person(("FR_knee",))


def test_real_hardware_asks_for_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("yes\n"))
    words = ["sweep", "mini_cheetah", "--link", "lcm", "--interface", "lo", "--joints", "FR_knee"]
    assert cli.run([*words, "--out", str(tmp_path / "x")]) == 2
    output = capsys.readouterr()
    assert "A real mini_cheetah at lcm://lo is about to move" in output.out
    assert "nothing was moved" in output.err
    assert not (tmp_path / "x").exists()
