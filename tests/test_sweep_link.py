"""Sweeps by wire: against a real `pronk twin` process in real time, and the servo without a clock.

Timing is relaxed throughout: a computer that runs tests side by side is busy, and what is tested
here is not that.
"""

from __future__ import annotations

import io
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pronk import cli
from pronk.commands.confirm import Person
from pronk.commands.sweep_wire import Recorded, record_wire
from pronk.errors import HardwareError
from pronk.hardware.lcm_codec import decode_command, encode_command
from pronk.hardware.lcm_layout import CHEETAH
from pronk.hardware.lcm_url import url_of
from pronk.hardware.links import Address
from pronk.hardware.machine import Command, State
from pronk.hardware.preflight import Freshness
from pronk.hardware.truth import load_truth
from pronk.hardware.twin import hold_of
from pronk.hardware.virtual import VirtualRobot
from pronk.robots import Robot, load_robot
from pronk.sweep.limits import Limits
from pronk.sweep.log import Segment
from pronk.sweep.log_apart import LogApart
from pronk.sweep.mcap_log import LogHeader, McapLogWriter, read_mcap
from pronk.sweep.plan import SweepPlan, make_plan
from pronk.sweep.record import record
from pronk.sweep.servo import Servo, Timing
from pronk.sweep.signals import Chirp

pytestmark = pytest.mark.live

lcm = pytest.importorskip("lcm")

ROBOT = load_robot("mini_cheetah")
HOLD = hold_of(ROBOT)
PATIENT = Timing(valid_for_s=10.0, oldest_state_s=10.0)
FRESH = Freshness(share=0.02, longest_gap_s=10.0)


@cache
def plan_of(joint: str) -> SweepPlan:
    # One that ends soon, and one that is always ended early.
    signal = Chirp(length_s=1.0 if joint == "FR_knee" else 20.0, start_hz=0.5, stop_hz=5.0)
    return make_plan(ROBOT, [joint], signal, amplitudes=(0.2,), repeats=1)


def narrow(joint: str, low: float, high: float) -> Robot:
    joints = (replace(j, range=(low, high)) if j.name == joint else j for j in ROBOT.joints)
    return replace(ROBOT, joints=tuple(joints))


# --- Over LCM, two processes --------------------------------------------------------------------


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """Where a virtual robot of its own is heard."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        number = int(probe.getsockname()[1])
    code = "import typer; from pronk.commands.twin import twin; typer.run(twin)"
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


class Ear:
    """The last command on the wire."""

    def __init__(self, port: int) -> None:
        self.last: Command | None = None
        self._lcm = lcm.LCM(url_of(port=port))
        self._lcm.subscribe(CHEETAH.command_channel, self._hear)
        self._open = True
        self._thread = threading.Thread(target=self._listen)

    def __enter__(self) -> Ear:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._open = False
        self._thread.join()

    def _hear(self, _: str, data: bytes) -> None:
        self.last = decode_command(CHEETAH, data)

    def _listen(self) -> None:
        while self._open:
            self._lcm.handle_timeout(50)


def swept(robot: Robot, plan: SweepPlan, out: Path, port: int, **options: object) -> Recorded:
    return record_wire(
        *(robot, plan, out, Address(kind="lcm", port=port)),
        timing=PATIENT,
        fresh=FRESH,
        **options,  # type: ignore[arg-type]
    )


def test_a_knee_is_asked_over_lcm(port: int, tmp_path: Path) -> None:
    plan = plan_of("FR_knee")
    with Ear(port) as ear:
        recorded = swept(ROBOT, plan, tmp_path, port)
    assert recorded.virtual
    assert recorded.servo["n"] > 100
    assert [path.name for path in recorded.logs] == ["FR_knee.mcap"]
    log = read_mcap(recorded.logs[0])
    assert log.complete
    assert log.virtual
    assert log.metadata["link"] == f"LCM, messages of cheetah, on loopback, port {port}"
    # The spi messages carry no torque and no voltage; none is made up.
    assert log.metadata["torque"] == "absent"
    assert log.torque is None
    part = log.cut(log.segments[0])
    knee = log.column("FR_knee")
    travel = np.ptp(part.position, axis=0)
    assert 0.15 < travel[knee] < 1.0
    # The twin's own bench held the others.
    assert np.delete(travel, knee).max() < 0.05
    assert log.segments[0].clamped == ("FR_hip_roll", "FR_hip_pitch")
    assert np.unique(part.command[:, knee]).size > 20
    # It is left damped.
    assert ear.last is not None
    np.testing.assert_array_equal(ear.last.stiffness, 0.0)


def test_a_breach_damps_and_keeps_a_log_that_reads(
    port: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # A damped leg lies far on the other side, where an earlier test may have left it.
    robot = narrow("FR_hip_roll", -0.09, 2.0)
    with (
        Ear(port) as ear,
        pytest.raises(HardwareError, match=r"FR_hip_roll is at .* outside -0\.09"),
    ):
        swept(robot, plan_of("FR_hip_roll"), tmp_path, port)
    log = read_mcap(tmp_path / "FR_hip_roll.mcap")
    assert not log.complete
    assert "outside -0.090 to 2.000 rad" in log.notes[0]
    assert log.position[:, 0].min() < -0.09
    assert "recorded until then of FR_hip_roll" in capsys.readouterr().err
    assert ear.last is not None
    np.testing.assert_array_equal(ear.last.stiffness, 0.0)


def test_who_else_commands_is_refused_before_and_ends_the_sweep_later(
    port: int, tmp_path: Path
) -> None:
    other = lcm.LCM(url_of(port=port))
    done = threading.Event()

    def command() -> None:
        while not done.wait(0.02):
            other.publish(CHEETAH.command_channel, encode_command(CHEETAH, HOLD))

    rival = threading.Thread(target=command)
    rival.start()
    try:
        with pytest.raises(HardwareError, match="someone else commands the joints"):
            swept(ROBOT, plan_of("FR_hip_roll"), tmp_path / "x", port)
    finally:
        done.set()
        rival.join()
    assert not (tmp_path / "x").exists()

    foreign = encode_command(CHEETAH, replace(HOLD, position=HOLD.position + 0.01))

    def progress(share: float) -> None:
        if share > 0.02:
            other.publish(CHEETAH.command_channel, foreign)

    with pytest.raises(HardwareError, match="another program commands the joints"):
        swept(ROBOT, plan_of("FR_hip_roll"), tmp_path, port, progress=progress)
    log = read_mcap(tmp_path / "FR_hip_roll.mcap")
    assert not log.complete
    assert "another program" in log.notes[0]


def test_nobody_there(tmp_path: Path) -> None:
    with pytest.raises(HardwareError, match="sent no state on spi_data"):
        swept(ROBOT, plan_of("FR_hip_roll"), tmp_path / "x", 7799)
    assert not (tmp_path / "x").exists()


# --- The servo, on a clock that waits -----------------------------------------------------------


class Bench(VirtualRobot):
    """The virtual robot with something wrong from some time on, and a note of what was sent."""

    def __init__(self, wrong: str = "", after: float = np.inf) -> None:
        super().__init__(ROBOT, load_truth(None), legs=("FR",))
        self.sent: list[Command] = []
        self._wrong, self._after = wrong, after
        self._kept: State | None = None
        # A person's hands and the drives meet in the real world only; here one waits.
        self._lock = threading.Lock()

    def clamp(self, joints: tuple[str, ...]) -> None:
        with self._lock:
            super().clamp(joints)

    def send(self, command: Command) -> None:
        self.sent.append(command)
        super().send(command)

    def latest(self) -> State:
        state = super().latest()
        if self._wrong == "silent" and self.now() >= self._after:
            self._kept = self._kept or state
            return self._kept
        return state

    def wait(self, until: float) -> list[State]:
        with self._lock:
            return self._waited(until)

    def _waited(self, until: float) -> list[State]:
        # A program that was kept from running: time passes, and nothing is done in it.
        if self._wrong == "stall" and until >= self._after:
            self._after = np.inf
            return super().wait(until + 0.25)
        states = super().wait(until)
        if until < self._after:
            return states
        if self._wrong == "silent":
            return []
        nan = np.full(12, np.nan)
        return [replace(state, position=nan) for state in states]


def test_every_servo_tick_writes_the_command_again_and_the_log_is_the_same(tmp_path: Path) -> None:
    plan, served, asked = plan_of("FR_knee"), Bench(), Bench()
    servo = Servo()
    (path,) = record(served, ROBOT, plan, tmp_path / "servo", servo=servo)
    (plain,) = record(asked, ROBOT, plan, tmp_path / "plain")
    # Ten times as often, for a second longer, and while hands are at the clamps.
    assert 0 <= len(served.sent) - 10 * (len(asked.sent) + 50) < 2000
    assert servo.missed == 0
    assert [c.sequence for c in served.sent] == list(range(1, len(served.sent) + 1))
    assert {c.valid_for for c in served.sent} == {0.1}
    # It takes hold softly, where the joints are.
    assert served.sent[0].stiffness[0] == pytest.approx(17.0 / 50)
    np.testing.assert_array_equal(served.sent[600].stiffness, plan.stiffness)
    logs = [read_mcap(path), read_mcap(plain)]
    parts = [log.cut(log.segments[0]) for log in logs]
    n = min(len(part.time) for part in parts)
    assert n > 700
    for name in ("command", "position"):
        first, second = (getattr(part, name)[:n] for part in parts)
        np.testing.assert_allclose(first, second, atol=0.02)


def test_a_state_that_stays_old_ends_it(tmp_path: Path) -> None:
    with pytest.raises(HardwareError, match=r"is 10[0-9] ms old, expected at most 100 ms"):
        record(Bench("silent", 4.5), ROBOT, plan_of("FR_knee"), tmp_path, servo=Servo())
    log = read_mcap(tmp_path / "FR_knee.mcap")
    assert not log.complete
    assert log.time[-1] == pytest.approx(4.5, abs=0.01)


def test_what_is_not_a_number_ends_it_and_is_not_logged(tmp_path: Path) -> None:
    with pytest.raises(HardwareError, match="FR_hip_roll is at nan rad"):
        record(Bench("nan", 4.5), ROBOT, plan_of("FR_knee"), tmp_path, servo=Servo())
    log = read_mcap(tmp_path / "FR_knee.mcap")
    assert not log.complete
    assert log.time[-1] == pytest.approx(4.5, abs=0.01)


def test_missed_ticks_are_left_out_and_the_question_keeps_its_time(tmp_path: Path) -> None:
    servo = Servo(PATIENT)
    plan = plan_of("FR_knee")
    (path,) = record(Bench("stall", 4.5), ROBOT, plan, tmp_path, servo=servo)
    assert 100 < servo.missed <= 130
    assert servo.figures()["max_ms"] == pytest.approx(250.0, rel=0.1)
    log = read_mcap(path)
    part = log.cut(log.segments[0])
    offsets = np.pad(plan.asks[0].offsets(50.0)[:, 0], (0, 30))
    tick = np.floor((part.time - log.segments[0].start) * 50.0 + 0.05).astype(int)
    wrong = np.abs(part.command[:, 2] - plan.pose[2] - offsets[tick]) > 1e-9
    # What was logged is what was sent: the command before the stall, for as long as it lasted.
    assert 100 < wrong.sum() <= 135
    assert np.ptp(part.command[wrong, 2]) == 0.0


def test_patience_is_a_time() -> None:
    with pytest.raises(HardwareError, match="oldest_state_s is 0"):
        Timing(oldest_state_s=0.0)


def test_limits_on_the_way_from_where_it_lies() -> None:
    limits = Limits.of(ROBOT, "absent")
    assert np.isinf(limits.torque).all()
    assert np.isfinite(Limits.of(ROBOT).torque).all()
    position = HOLD.position.copy()
    position[2] = limits.high[2] + 0.1
    wider = limits.from_where_it_lies(position)
    assert wider.high[2] == pytest.approx(limits.high[2] + 0.15)
    np.testing.assert_array_equal(wider.low, limits.low)
    np.testing.assert_array_equal(np.delete(wider.high, 2), np.delete(limits.high, 2))


# --- The log apart ------------------------------------------------------------------------------

HEADER = LogHeader(robot="mini_cheetah", joints=("FR_knee",))


def test_a_log_apart_is_the_same_log(tmp_path: Path) -> None:
    segment = Segment(kind="chirp", joints=("FR_knee",), start=0.1, stop=0.3, amplitude=0.2)
    for name in ("at_once", "apart"):
        inner = McapLogWriter(tmp_path / name, HEADER)
        with LogApart(inner) if name == "apart" else inner as log:
            for k in range(600):
                if k == 100:
                    assert log.segment(segment) == 0
                log.sample(1e-3 * k, [0.1 * k], [0.2 * k], [0.3], None, 1.0, 0)
    first, second = (read_mcap(tmp_path / name) for name in ("at_once", "apart"))
    assert first.complete
    assert second.complete
    assert first.segments == second.segments
    for name in ("time", "command", "position", "velocity"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_a_disk_that_is_full_is_said(tmp_path: Path) -> None:
    class Full(McapLogWriter):
        def sample(self, *_: object, **__: object) -> None:
            raise OSError(28, "No space left on device")

    def fill(log: LogApart) -> None:
        with log:
            for k in range(2000):
                log.sample(1e-3 * k, [0.0], [0.0])
                time.sleep(0.01)

    log = LogApart(Full(tmp_path / "x.mcap", HEADER))
    with pytest.raises(HardwareError, match="No space left"):
        fill(log)


# --- The person at a real bench -----------------------------------------------------------------


def test_a_person_is_asked_for_clamps_and_no_more_than_needed(
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
        with pytest.raises(HardwareError, match="nobody is there"):
            person(("FR_knee",))


def test_real_hardware_asks_for_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("yes\n"))
    words = ["sweep", "mini_cheetah", "--link", "lcm", "--interface", "lo", "--joints", "FR_knee"]
    assert cli.run([*words, "--out", str(tmp_path / "x")]) == 2
    told = capsys.readouterr()
    assert "A real mini_cheetah at LCM, messages of cheetah, on lo is about to move" in told.out
    assert "nothing was moved" in told.err
    assert not (tmp_path / "x").exists()


def test_addresses() -> None:
    assert str(Address(kind="dds", interface="eth0")) == "DDS on eth0"
    assert not Address(kind="dds", interface="eth0").local
    assert str(Address(kind="dds", domain=5)) == "DDS on loopback, domain 5"
    with pytest.raises(HardwareError, match="wires are lcm, dds"):
        Address(kind="can")
