"""The servo of a sweep on a clock that waits, and what it and its owner tell each other."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pronk.errors import HardwareError
from pronk.excitation.plan import SweepPlan, make_plan
from pronk.excitation.signals import Chirp
from pronk.links.machine import Command, State
from pronk.logs.joint_log import Segment
from pronk.logs.mcap_format import LogHeader
from pronk.logs.mcap_reader import read_mcap
from pronk.logs.mcap_writer import McapLogWriter
from pronk.robots import load_robot
from pronk.runtime.sweep.channel import Channel
from pronk.runtime.sweep.limits import Limits
from pronk.runtime.sweep.log_subprocess import LogApart
from pronk.runtime.sweep.record import record
from pronk.runtime.sweep.record_subprocess import Desk
from pronk.runtime.sweep.servo import Servo, Timing
from pronk.runtime.sweep.servo_process import Owner
from pronk.virtual.robot import VirtualRobot
from pronk.virtual.server import hold_of
from pronk.virtual.sim_params import load_sim_params

ROBOT = load_robot("mini_cheetah")
HOLD = hold_of(ROBOT)
PATIENT = Timing(valid_for_s=10.0, oldest_state_s=10.0)


@cache
def plan_of(joint: str) -> SweepPlan:
    signal = Chirp(length_s=1.0, start_hz=0.5, stop_hz=5.0)
    return make_plan(ROBOT, [joint], signal, amplitudes=(0.2,), repeats=1)


class Bench(VirtualRobot):
    """The virtual robot with something wrong from some time on, and a note of what was sent."""

    def __init__(self, wrong: str = "", after: float = np.inf) -> None:
        super().__init__(ROBOT, load_sim_params(None), legs=("FR",))
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


# --- What the two processes tell each other -----------------------------------------------------

HEADER = LogHeader(robot="mini_cheetah", joints=("FR_knee",))


@pytest.fixture
def ends() -> Iterator[tuple[Channel, Channel]]:
    """Both ends of a channel: the servo's, its owner's."""
    servo, owner = (Channel(end) for end in socket.socketpair())
    yield servo, owner
    for end in (servo, owner):
        end.finish(0.0)


def desk_at(channel: Channel, **told: Any) -> Desk:
    deaf = dict.fromkeys(("kill", "hand", "progress", "say", "begun"), lambda *_: None)
    return Desk(channel, **{**deaf, **told})


def test_nobody_waits_and_nothing_is_lost(ends: tuple[Channel, Channel]) -> None:
    near, far = ends
    said = [(k, np.full(100, float(k))) for k in range(2000)]
    # More than the system keeps; the one who should read does not yet.
    for number, values in said:
        near.put(number, values)
    heard: list[tuple[int, np.ndarray]] = []
    while len(heard) < len(said):
        near.take()
        heard += far.take()
    for (number, values), (known, sent) in zip(heard, said, strict=True):
        assert number == known
        np.testing.assert_array_equal(values, sent)
    assert not far.gone
    near.put("last")
    near.finish(1.0)
    assert far.take() == [("last",)]
    assert far.gone
    far.put("to nobody")
    assert far.take() == []


def test_a_log_apart_is_the_same_log(tmp_path: Path, ends: tuple[Channel, Channel]) -> None:
    servo, owner = ends
    segment = Segment(kind="chirp", joints=("FR_knee",), start=0.1, stop=0.3, amplitude=0.2)
    for name in ("at_once", "apart"):
        path = tmp_path / name
        with (
            LogApart(servo, path, HEADER) if name == "apart" else McapLogWriter(path, HEADER) as log
        ):
            for k in range(600):
                if k == 100:
                    assert log.segment(segment) == 0
                log.sample(1e-3 * k, [0.1 * k], [0.2 * k], [0.3], None, 1.0, 0)
    begun: list[Path] = []
    ending = threading.Thread(target=servo.finish, args=(60.0,))
    ending.start()
    desk_at(owner, begun=begun.append).attend()
    ending.join()
    assert begun == [tmp_path / "apart"]
    first, second = (read_mcap(tmp_path / name) for name in ("at_once", "apart"))
    assert first.complete
    assert second.complete
    assert first.segments == second.segments
    for name in ("time", "command", "position", "velocity"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_a_log_left_open_is_ended_with_the_reason(
    tmp_path: Path, ends: tuple[Channel, Channel]
) -> None:
    servo, owner = ends
    log = LogApart(servo, tmp_path / "x.mcap", HEADER)
    for k in range(3):
        log.sample(1e-3 * k, [0.0], [0.0])
    servo.finish(1.0)
    desk = desk_at(owner)
    desk.attend()
    with pytest.raises(HardwareError, match=r"killed \(signal 9\); only the robot's own") as raised:
        desk.outcome(-9)
    desk.end_log(raised.value)
    (note,) = read_mcap(tmp_path / "x.mcap").notes
    assert "HardwareError: the servo's process was killed" in note


def test_a_servo_that_is_stuck_is_killed(
    tmp_path: Path, ends: tuple[Channel, Channel], monkeypatch: pytest.MonkeyPatch
) -> None:
    servo, owner = ends
    monkeypatch.setattr("pronk.runtime.sweep.record_subprocess._SILENT_S", 0.01)
    desk = desk_at(owner, kill=lambda: servo.finish(0.0))
    LogApart(servo, tmp_path / "x.mcap", HEADER)
    desk.attend()
    with pytest.raises(
        HardwareError, match=r"said nothing for 0\.01 s and was killed \(signal 9\)"
    ):
        desk.outcome(-9)
    with pytest.raises(HardwareError, match="broke down"):
        desk_at(owner).outcome(1)


def test_a_log_that_cannot_be_written_is_said(
    tmp_path: Path, ends: tuple[Channel, Channel]
) -> None:
    servo, owner = ends
    # A log of that name cannot be begun, as on a full disk.
    (tmp_path / "x.mcap").mkdir()
    log = LogApart(servo, tmp_path / "x.mcap", HEADER)
    desk = desk_at(owner)
    with pytest.raises(HardwareError, match=r"the log cannot be written .*Is a directory"):
        desk.attend()
    # What comes while the servo damps does no harm.
    log.sample(0.0, [0.0], [0.0])
    servo.finish(1.0)
    desk.attend()


def test_the_servo_ends_when_its_owner_does(ends: tuple[Channel, Channel]) -> None:
    servo, owner = ends
    stuck = Owner(servo, 0.02)
    owner.put("here")
    stuck.check()
    time.sleep(0.03)
    with pytest.raises(HardwareError, match=r"was stuck for 0\.\d s, expected at most 0\.02 s"):
        stuck.check()
    patient = Owner(servo, 1e9)
    patient.check()
    owner.put("stop")
    with pytest.raises(KeyboardInterrupt):
        patient.check()
    owner.finish(0.0)
    with pytest.raises(HardwareError, match="the program that wrote the log ended"):
        patient.check()


def test_the_servo_may_be_told_to_end(ends: tuple[Channel, Channel]) -> None:
    servo = Owner(ends[0], 1e9)
    servo.told_to_end()
    with pytest.raises(HardwareError, match="told to end"):
        servo.check()


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (None, ""),
        (HardwareError("nobody is there"), "nobody is there"),
        (ZeroDivisionError("odd"), "ZeroDivisionError: odd"),
    ],
)
def test_hands_are_asked_at_the_desk(
    found: Exception | None, said: str, ends: tuple[Channel, Channel]
) -> None:
    asked: list[tuple[str, ...]] = []
    met = [""]

    def hand(joints: tuple[str, ...]) -> None:
        asked.append(joints)
        if found is not None:
            raise found

    def ask() -> None:
        try:
            owner.hand(("FR_knee",))
        except HardwareError as error:
            met.append(str(error))

    owner, desk = Owner(ends[0], 1e9), desk_at(ends[1], hand=hand)
    asking = threading.Thread(target=ask)
    asking.start()
    while asking.is_alive():
        desk.attend(seconds=0.001)
        owner.check()
    assert asked == [("FR_knee",)]
    assert met[-1] == said
