"""Parts of the runtime: shared memory, pacing, paths, state machine, pre-flight, operators, log."""

from __future__ import annotations

import math
import os
import pty
import struct
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from multiprocessing import get_context, shared_memory
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy_records import set_fields
from pronk.deploy.bench.faults import SWAPPED, spoiled
from pronk.deploy.links.realtime import Histogram, Pace
from pronk.deploy.runtime.deploy_log import is_deploy_log, read_deploy_log
from pronk.deploy.runtime.limits import Limits
from pronk.deploy.runtime.log import SCHEMA, TOPICS, DeployLogWriter
from pronk.deploy.runtime.memory import Mailbox, Ring, Shared, slots_dtype
from pronk.deploy.runtime.modes import Mode, OperatorRequest
from pronk.deploy.runtime.poses import RunTiming, folded_pose, minimum_jerk, stand_up
from pronk.deploy.runtime.preflight import delay_objection, refusals
from pronk.deploy.runtime.reasons import FilterAction, Reason
from pronk.deploy.runtime.records import (
    ACTIONS,
    STEP,
    TEXT_SIZE,
    TICK,
    Event,
    event_record,
    get_state,
    put_state,
)
from pronk.deploy.runtime.run import RunSummary
from pronk.deploy.runtime.safety import SafetyFilter
from pronk.deploy.runtime.state_machine import FIRST_ACTION_S, StateMachine
from pronk.deploy.runtime.teleop import (
    BenchOperator,
    Gamepad,
    Keyboard,
    Operator,
    OperatorCommand,
    ScriptedOperator,
    TimeLimit,
)
from pronk.errors import HardwareError, LogError, RobotError
from pronk.identify.logs.mcap import DamagedError, McapWriter, records
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.policy.script import Script
from pronk.robots import load_robot
from pronk.robots.machine import State
from virtual_robot import POSE, ROBOT, connected, rolled, still

LIMITS = Limits.of(ROBOT)
GO2 = load_robot("go2")
LYING = folded_pose(ROBOT)
state = partial(still, position=LYING)
RANGES = {"vx": (-2.0, 3.0), "vy": (-1.0, 1.0), "yaw_rate": (-2.0, 2.0)}
FORWARD = (1.0, 0.0, 0.0)


# --- Shared memory ------------------------------------------------------------------------------

PAIR = np.dtype([("a", "<i8"), ("b", "<f8", 100)])


def pair(number: int) -> np.ndarray:
    record = np.zeros((), dtype=PAIR)
    record["a"] = number
    record["b"] = number
    return record


def numbers(records: list[np.void]) -> list[int]:
    """Numbers of pairs that were taken from a ring."""
    return [int(record["a"]) for record in records]


@pytest.fixture
def memory() -> Iterator[np.ndarray]:
    dtype = slots_dtype(PAIR, 3)
    shared = shared_memory.SharedMemory(create=True, size=dtype.itemsize)
    yield np.ndarray((), dtype, shared.buf)
    shared.unlink()


def _write_many(memory: np.ndarray, count: int) -> None:
    for number in range(count):
        Mailbox(memory).write(pair(number))


def test_a_mailbox_never_gives_half_a_record(memory: np.ndarray) -> None:
    mailbox = Mailbox(memory)
    assert mailbox.read() is None
    writer = get_context("fork").Process(target=_write_many, args=(memory, 20_000))
    writer.start()
    newest = -1
    reads = 0
    while newest < 19_999:
        record = mailbox.read()
        if record is None:
            continue
        assert (record["b"] == record["a"]).all()
        assert record["a"] >= newest
        newest = int(record["a"])
        reads += 1
    writer.join()
    assert reads > 10


def test_a_half_written_slot_is_not_read(memory: np.ndarray) -> None:
    ring = Ring(memory)
    ring.put(pair(1))
    memory["slots"]["record"]["b"][2] += 1  # another record's slot
    assert numbers(ring.take()) == [1]
    ring.put(pair(2))
    memory["slots"]["record"]["b"][1, 40] += 1
    assert ring.take() == []


def test_a_full_ring_drops_the_new_and_counts_them(memory: np.ndarray) -> None:
    writer = Ring(memory)
    reader = Ring(memory)
    for number in range(3):
        assert writer.put(pair(number))
    for number in range(3, 5):
        assert not writer.put(pair(number))
    assert reader.dropped == 2
    assert numbers(reader.take(2)) == [0, 1]
    assert writer.put(pair(9))
    assert numbers(reader.take()) == [2, 9]
    assert reader.take() == []


def test_shared_memory_is_attached_by_name_and_removed_once() -> None:
    shared = Shared()
    other = Shared(shared.name)
    shared.events.put(event_record(2.5, "fault", "it is tilted", level=FilterAction.DAMP))
    shared.events.put(event_record(0.0, "notice", "ä" * 2 * TEXT_SIZE))
    short_record, long_record = other.events.take()
    expected = Event(time=2.5, kind="fault", text="it is tilted", level="DAMP")
    assert Event.of(short_record) == expected
    assert Event.of(long_record).text == "?" * TEXT_SIZE
    other.close()
    shared.close()
    shared.close()
    with pytest.raises(FileNotFoundError):
        Shared(shared.name)


@pytest.mark.parametrize("measured", [{}, {"temperature": np.arange(12.0), "robot_time": 5.0}])
def test_a_state_survives_the_way_through_memory(measured: dict[str, Any]) -> None:
    position = np.random.default_rng(0).standard_normal(12)
    before = state(time=3.0, sequence=7, position=position, **measured)
    record = np.zeros((), dtype=TICK)
    put_state(record, before)
    after = get_state(np.frombuffer(record.tobytes(), dtype=TICK)[0])
    for name, value in vars(before).items():
        np.testing.assert_array_equal(getattr(after, name), value)


# --- Pacing -------------------------------------------------------------------------------------


def test_a_pace_leaves_out_what_has_passed() -> None:
    pace = Pace(50.0, 100.0)
    assert pace.deadline == 100.0
    pace.advance(100.001)
    assert (pace.tick, pace.missed) == (1, 0)
    pace.advance(100.065)  # 20, 40 and 60 ms have passed
    assert (pace.tick, pace.missed) == (4, 2)
    assert pace.deadline == pytest.approx(100.08)


@given(st.lists(st.floats(1e-6, 1.0), min_size=1, max_size=300), st.floats(0.01, 1.0))
def test_quantiles_are_those_of_the_numbers_to_a_bin(values: list[float], share: float) -> None:
    histogram = Histogram()
    assert math.isnan(histogram.quantile(0.5))
    for value in values:
        histogram.add(value)
    exact = sorted(values)[max(1, math.ceil(share * len(values) - 1e-9)) - 1]
    assert exact * (1 - 1e-9) <= histogram.quantile(share) <= exact * 1.048
    assert histogram.figures()["n"] == len(values)
    assert histogram.quantile(1.0) == max(values)


# --- Paths --------------------------------------------------------------------------------------


def test_standing_up_begins_at_the_measured_pose_and_ends_at_the_default_pose() -> None:
    for share, expected in ((-1.0, 0.0), (0.0, 0.0), (0.5, 0.5), (1.0, 1.0), (2.0, 1.0)):
        assert minimum_jerk(share) == expected
    assert minimum_jerk(0.25) == pytest.approx(10 / 64 - 15 / 256 + 6 / 1024)
    measured = LYING + 0.2 * np.random.default_rng(1).standard_normal(12)
    path = stand_up(ROBOT, measured, 5.0, RunTiming(fold_s=1.0, rise_s=2.0, ramp_s=0.5))
    np.testing.assert_array_equal(path.target(5.0), measured)
    np.testing.assert_allclose(path.target(6.0), LYING)
    np.testing.assert_allclose(path.target(8.0), POSE)
    assert path.stiffness(5.0) == 0.0
    assert path.stiffness(5.25) == 0.5
    assert path.stiffness(5.5) == 1.0
    assert not path.done(7.99)
    assert path.done(8.0)
    # No jump anywhere: 1.875 times the mean speed at most.
    targets = np.array([path.target(5.0 + k / 500) for k in range(1501)])
    folding = np.abs(LYING - measured).max() / 1.0
    rising = np.abs(POSE - LYING).max() / 2.0
    fastest = np.abs(np.diff(targets, axis=0)).max() * 500
    assert fastest <= 1.875 * max(folding, rising) * 1.001
    with pytest.raises(RobotError, match="rise_s"):
        RunTiming(rise_s=-1.0)


@pytest.mark.parametrize(
    ("name", "thigh", "shank"), [("mini_cheetah", 0.209, 0.195), ("go2", 0.213, 0.213)]
)
def test_the_folded_pose_has_the_feet_under_the_hips(name: str, thigh: float, shank: float) -> None:
    robot = load_robot(name)
    pose = folded_pose(robot)
    limits = Limits.of(robot)
    pitch = pose[1]
    knee = pose[2]
    assert abs(knee) > abs(robot.joint("FR_knee").default_position)
    assert abs(thigh * math.sin(pitch) + shank * math.sin(pitch + knee)) < 0.03
    assert 0.09 < thigh * math.cos(pitch) + shank * math.cos(pitch + knee) < 0.16
    assert (limits.joints.low + limits.operating.margin < pose).all()
    assert (limits.joints.high - limits.operating.margin > pose).all()

    with pytest.raises(RobotError, match="so101"):
        folded_pose(load_robot("so101"))


# --- The state machine --------------------------------------------------------------------------


class Run:
    """A state machine on a clock of its own."""

    def __init__(self, *, check_s: float = 0.0, **times: float) -> None:
        self.machine = StateMachine(ROBOT, RunTiming(check_s=check_s, **times))
        self.safety = SafetyFilter(limits=LIMITS)
        self.t = 0.0
        self.action: Any = None
        self.objection = ""

    @property
    def mode(self) -> Mode:
        return self.machine.mode

    def tick(
        self, seconds: float = 0.0, request: OperatorRequest | None = None, q: np.ndarray = LYING
    ) -> Any:
        self.t += seconds
        if request is not None:
            self.machine.request(request)
        desired = self.machine.step(self.t, q, self.safety, self.action, self.objection)
        if self.safety.faulted:
            self.machine.faulted(self.t)
        return desired

    def give(self, target: np.ndarray, mode_count: int | None = None) -> None:
        action = np.zeros((), dtype=ACTIONS)
        if self.action is not None:
            action["sequence"] = self.action["sequence"] + 1
        action["state_sequence"] = 3
        action["mode_count"] = self.machine.mode_count if mode_count is None else mode_count
        action["position"] = target
        action["state_time"] = self.t
        action["made"] = self.t
        action["valid_for"] = 0.05
        self.action = action

    def standing(self) -> Run:
        self.machine.preflighted((), self.t)
        self.tick(0.0, OperatorRequest.STAND)
        self.tick(1.0)
        self.tick(2.5)
        assert self.mode is Mode.STAND
        return self


@pytest.mark.parametrize("swapped", ["", *SWAPPED])
def test_swapped_encoders_are_found_before_the_robot_rises(swapped: str) -> None:
    robot = connected(base="ground", capture_rate_hz=None)
    run = Run(check_s=0.15, damp_s=0.5, fold_s=0.5)
    run.machine.preflighted((), 0.0)
    run.machine.request(OperatorRequest.STAND)
    while run.t < 2.5 and run.mode is not Mode.FAULT:
        state = robot.wait(run.t + 0.002)[-1]
        seen = spoiled(swapped, state, state) if swapped else state
        command = run.tick(0.002, q=seen.position).command
        if command is None:
            robot.damp()
        else:
            robot.send(command)
    if swapped:
        assert run.safety.reason is Reason.SWAPPED
        assert run.mode is Mode.FAULT
    else:
        assert run.safety.reason is Reason.NONE
        assert run.mode is Mode.STAND


@pytest.mark.parametrize("swapped", ["", *SWAPPED])
def test_a_go2_stands_up_and_its_swapped_encoders_are_found(swapped: str) -> None:
    robot = VirtualRobot(GO2, load_sim_params(None, GO2), base="ground", capture_rate_hz=None)
    robot.connect()
    machine = StateMachine(GO2, RunTiming(damp_s=0.5))
    safety = SafetyFilter(limits=Limits.of(GO2))
    machine.preflighted((), 0.0)
    machine.request(OperatorRequest.STAND)
    t = 0.0
    while t < 12.0 and machine.mode not in (Mode.FAULT, Mode.POLICY):
        t += 0.002
        state = robot.wait(t)[-1]
        seen = spoiled(swapped, state, state) if swapped else state
        if machine.mode is Mode.STAND:
            machine.request(OperatorRequest.WALK)
        desired = machine.step(t, seen.position, safety, None)
        if safety.faulted:
            machine.faulted(t)
        if desired.command is None:
            robot.damp()
        else:
            robot.send(desired.command)
    if swapped:
        assert safety.reason is Reason.SWAPPED
        assert t < 6.0
    else:
        assert machine.mode is Mode.POLICY, machine.notice
        # The default pose without sag has the trunk at 0.29 m.
        assert robot.snapshot().position[0, 2] > 0.24


@pytest.mark.parametrize(
    ("pause_after", "pause_s", "reason"),
    [
        ("fold", 0.2, Reason.INTERRUPTED),  # one half swing but its begin
        ("fold", 1.3, Reason.INTERRUPTED),  # all swings
        ("rise", 0.7, Reason.ORIENTATION),  # all small motions
        ("rise", 0.59, Reason.ORIENTATION),  # all but their end
    ],
)
def test_a_check_without_measurements_is_not_passed(
    pause_after: str, pause_s: float, reason: Reason
) -> None:
    robot = connected(base="ground", capture_rate_hz=None)
    timing = RunTiming()
    run = Run(check_s=timing.check_s)
    swings_s = 2.0 * len(ROBOT.legs) * ROBOT.limits.stand.swing_s
    pause_at = timing.fold_s
    if pause_after == "rise":
        pause_at += swings_s + timing.rise_s
    run.machine.preflighted((), 0.0)
    requests = {
        Mode.DAMP: OperatorRequest.STAND,
        Mode.STAND: OperatorRequest.WALK,
        Mode.FAULT: OperatorRequest.RESET,
    }
    paused = False
    reasons = []
    while run.t < 25.0 and run.mode is not Mode.POLICY:
        mode = run.mode
        step_s = 0.002
        if not paused and run.mode is Mode.STAND and run.t - run.machine.since > pause_at:
            step_s = pause_s
            paused = True
        state = robot.wait(run.t + step_s)[-1]
        command = run.tick(step_s, requests[mode], q=state.position).command
        if run.mode is Mode.FAULT and mode is not Mode.FAULT:
            reasons.append(run.safety.reason)
        if command is None:
            robot.damp()
        else:
            robot.send(command)
    # Without a pause the next rise passes.
    assert reasons == [reason]
    assert run.mode is Mode.POLICY, run.machine.notice


def test_the_trunk_is_still_when_the_policy_may_begin() -> None:
    robot = connected(base="ground", capture_rate_hz=None)
    run = Run(check_s=0.15, damp_s=0.5, fold_s=0.5)
    run.machine.preflighted((), 0.0)
    run.machine.request(OperatorRequest.STAND)
    heights = []
    while run.t < 12.0 and run.mode is not Mode.POLICY:
        state = robot.wait(run.t + 0.002)[-1]
        heights.append(float(robot.snapshot().position[0, 2]))
        if run.mode is Mode.STAND:
            run.machine.request(OperatorRequest.WALK)
        command = run.tick(0.002, q=state.position).command
        if command is None:
            robot.damp()
        else:
            robot.send(command)
    assert run.mode is Mode.POLICY, run.machine.notice
    last = np.array(heights[-100:])
    assert np.ptp(last) < 0.003
    assert last[-1] > 0.22


def test_nothing_is_sent_before_and_without_the_checks() -> None:
    run = Run()
    for mode in (Mode.IDLE, Mode.PREFLIGHT, Mode.IDLE):
        run.machine.enter(mode, run.t)
        assert run.tick(5.0, OperatorRequest.STAND).command is None
        assert run.machine.silent
        run.machine.preflighted(("the battery is empty.",), run.t)
        assert run.mode is Mode.IDLE


def test_the_whole_course() -> None:
    run = Run(blend_s=0.4, halt_s=1.0, sit_s=1.5)
    run.machine.preflighted((), 0.0)
    assert run.tick().command is None
    assert not run.machine.silent
    run.tick(0.5, OperatorRequest.STAND)
    assert run.mode is Mode.DAMP, "it has not sunk yet"
    desired = run.tick(0.5)
    assert run.mode is Mode.STAND
    np.testing.assert_array_equal(desired.command.position, LYING)
    assert (desired.command.stiffness == 0.0).all()
    run.tick(2.0, OperatorRequest.WALK)
    assert run.mode is Mode.STAND, "it is not up yet"
    desired = run.tick(0.5)
    assert run.mode is Mode.POLICY
    np.testing.assert_allclose(desired.command.position, POSE)
    # An action for another mode is not followed; the first for this one is blended in.
    run.give(POSE + 0.4, mode_count=run.machine.mode_count - 1)
    np.testing.assert_allclose(run.tick(0.02).command.position, POSE)
    run.give(POSE + 0.4)
    assert run.tick(0.02).blend == 0.0
    run.give(POSE + 0.4)
    desired = run.tick(0.2)
    assert desired.blend == pytest.approx(0.5)
    np.testing.assert_allclose(desired.command.position, POSE + 0.2)
    assert (desired.command.made, desired.command.state_sequence) == (run.action["made"], 3)
    np.testing.assert_allclose(run.tick(0.2).command.position, POSE + 0.4)
    # Down: the policy first comes to a halt.
    desired = run.tick(0.0, OperatorRequest.SIT)
    assert (run.mode, desired.blend) == (Mode.HALT, 1.0)
    run.tick(1.0, q=POSE)
    desired = run.tick(0.0, q=POSE)
    assert run.mode is Mode.SIT
    np.testing.assert_array_equal(desired.command.position, POSE)
    np.testing.assert_allclose(run.tick(1.499, q=POSE).command.position, LYING, atol=1e-6)
    assert desired.stiffness == 1.0
    assert run.tick(0.001, q=POSE).command is None
    assert run.mode is Mode.DAMP


@pytest.mark.parametrize("request_", [OperatorRequest.DAMP, OperatorRequest.QUIT])
def test_damping_comes_at_once(request_: OperatorRequest) -> None:
    run = Run().standing()
    assert run.tick(0.0, request_).command is None
    assert run.mode is Mode.DAMP
    assert run.machine.quitting is (request_ is OperatorRequest.QUIT)


def test_a_robot_that_is_to_be_left_does_not_stand_up_again() -> None:
    run = Run(damp_s=0.1).standing()
    run.tick(0.0, OperatorRequest.QUIT)
    run.tick(0.01, OperatorRequest.STAND)
    assert run.tick(5.0).command is None
    assert (run.mode, run.machine.quitting) == (Mode.DAMP, True)
    # A fault meanwhile is not released either.
    run.safety.fault(Reason.DEAD_MAN, run.t)
    run.machine.faulted(run.t)
    run.machine.enter(Mode.FAULT, run.t)
    run.tick(5.0, OperatorRequest.STAND)
    assert (run.mode, run.machine.quitting) == (Mode.FAULT, True)


def test_a_policy_without_a_first_action_is_a_fault() -> None:
    run = Run().standing()
    run.tick(0.0, OperatorRequest.WALK)
    assert run.tick(FIRST_ACTION_S - 0.01).command is not None
    assert run.tick(0.02).command is None
    assert (run.safety.reason, run.mode) == (Reason.EXPIRED, Mode.FAULT)


@pytest.mark.parametrize("later", [0, 1])
def test_commanded_to_sit_at_once_the_policy_still_acts(later: int) -> None:
    run = Run(halt_s=1.0).standing()
    run.tick(0.0, OperatorRequest.WALK)
    walking = run.machine.mode_count
    run.give(POSE + 0.4, mode_count=walking - 1)
    run.tick(0.002, OperatorRequest.SIT)
    assert (run.mode, run.machine.mode_count) == (Mode.HALT, walking + 1)
    # Its actions are for the halt, or still for the walk before it.
    run.give(POSE + 0.4, mode_count=walking + later)
    assert run.tick(0.02).blend == 0.0
    for _ in range(20):
        run.give(POSE + 0.4, mode_count=walking + later)
        desired = run.tick(0.02)
        assert desired.command is not None
    assert desired.blend == pytest.approx(1.0)
    np.testing.assert_allclose(desired.command.position, POSE + 0.4)
    run.tick(1.0)
    assert (run.mode, run.safety.faulted) == (Mode.SIT, False)


def test_an_objection_keeps_the_policy_from_starting() -> None:
    run = Run().standing()
    run.objection = "too slow."
    run.tick(0.0, OperatorRequest.WALK)
    assert (run.mode, run.machine.notice) == (Mode.STAND, "too slow.")
    run.objection = ""
    run.tick(0.1, OperatorRequest.WALK)
    assert run.mode is Mode.POLICY


def test_a_latched_fault_needs_a_reset_and_another_its_second() -> None:
    run = Run().standing()
    run.safety.fault(Reason.TILT, run.t)
    run.tick()
    assert run.mode is Mode.FAULT
    run.tick(2.0, OperatorRequest.STAND)
    assert run.mode is Mode.FAULT
    assert "reset" in run.machine.notice
    run.tick(0.0, OperatorRequest.RESET)
    assert (run.mode, run.safety.faulted) == (Mode.DAMP, False)
    run = Run(damp_s=0.0).standing()
    run.safety.fault(Reason.DEAD_MAN, run.t)
    run.machine.faulted(run.t)
    run.tick(0.5, OperatorRequest.STAND)
    assert run.mode is Mode.FAULT
    run.tick(0.6)
    run.tick(0.01)
    assert run.mode is Mode.STAND


# --- Pre-flight ---------------------------------------------------------------------------------


def stream(**changes: Any) -> list[State]:
    """Half a second of a robot at rest, whose inertial unit is noisy."""
    rng = np.random.default_rng(0)
    states = []
    for k in range(250):
        noise = 1e-6 * rng.standard_normal(10)
        fields: dict[str, Any] = {"time": k / 500, "sequence": k, "gyro": 1e4 * noise[:3]}
        fields.update(changes)
        quiet = state(**fields)
        noisy = replace(
            quiet,
            accelerometer=quiet.accelerometer + noise[3:6],
            orientation=quiet.orientation + noise[6:],
        )
        states.append(noisy)
    return states


def refused(states: list[State], now: float = 0.5) -> tuple[str, ...]:
    """Why a robot with these states must not move."""
    return refusals(states, ROBOT, LIMITS, now=now, seconds=0.5)


def at(index: int, value: float, values: np.ndarray = LYING) -> np.ndarray:
    array = values.copy()
    array[index] = value
    return array


def stopped(name: str) -> list[State]:
    """A stream in which one source does not change."""
    states = stream()
    constant = {name: getattr(states[0], name)}
    return [replace(measured, **constant) for measured in states]


def test_a_robot_at_rest_may_move() -> None:
    assert refused(stream()) == ()
    # A voltage that is not a number is one that the link does not carry.
    assert refused(stream(temperature=np.full(12, 40.0), bus_voltage=math.nan)) == ()


LEANING = {"orientation": rolled(1.0), "accelerometer": 9.81 * np.array([0, 0.84147, 0.54030])}


@pytest.mark.parametrize(
    ("states", "now", "word"),
    [
        ([], 0.5, "0 states"),
        (stream()[::2], 0.5, "250 states per second"),
        (stream()[:1], 0.5, "1 states"),
        (stream(), 0.6, "ms old"),
        (stream(), 0.4, "ahead of now"),
        (stream(gyro=np.zeros(3)), 0.5, "no number changed"),
        (stream(velocity=at(0, math.nan)), 0.5, "velocity"),
        (stream(orientation=np.zeros(4)), 0.5, "quaternion"),
        (stream(accelerometer=np.array([0.0, 0.0, 1.0])), 0.5, "accelerometer"),
        (stream(accelerometer=np.array([0.0, 0.0, -9.81])), 0.5, "disagree"),
        (stream(orientation=rolled(0.5)), 0.5, "disagree"),
        (stream(**LEANING), 0.5, "tilted by 1.00"),
        (stream(position=at(2, 2.8)), 0.5, "FR_knee"),
        (stream(velocity=at(3, 2.0, np.zeros(12))), 0.5, "FL_hip_roll"),
        (stream(bus_voltage=18.0), 0.5, "18.0"),
        (stream(bus_voltage=0.0), 0.5, "0.0 V"),
        (stream(temperature=np.full(12, 90.0)), 0.5, "FR_hip_roll"),
        *((stopped(name), 0.5, name) for name in ("gyro", "accelerometer", "orientation")),
    ],
)
def test_a_robot_that_must_not_move_is_refused(states: list[State], now: float, word: str) -> None:
    sentences = refused(states, now)
    assert any(word in sentence for sentence in sentences), sentences
    assert not any("\n" in sentence for sentence in sentences)


def test_the_delay_must_be_within_the_training_range() -> None:
    assert delay_objection(0.004, 50, (0.0, 0.01)) == ""
    assert "12.0 ms" in delay_objection(0.012, 50, (0.0, 0.01))
    assert delay_objection(math.nan, 0, (0.0, 0.01))


# --- Operators ----------------------------------------------------------------------------------


def test_a_script_stands_walks_sits_and_leaves() -> None:
    script = Script(command=FORWARD, stand_s=1.0, run_s=1.0, jump_s=0.5, keep_s=0.5, stop_s=1.0)
    scripted = ScriptedOperator([script, replace(script, command=(0.0, -1.0, 0.0))])
    assert scripted.seconds == 10.0
    operator = TimeLimit(scripted, scripted.seconds)

    def requested(t: float, mode: Mode) -> OperatorRequest:
        return operator.command(t, mode).request

    none = OperatorRequest.NONE
    assert requested(0.0, Mode.PREFLIGHT) is none
    assert requested(0.0, Mode.DAMP) is OperatorRequest.STAND
    assert requested(0.1, Mode.DAMP) is none
    assert requested(1.0, Mode.STAND) is OperatorRequest.WALK
    still = (0.0, 0.0, 0.0)
    right = (0.0, -1.0, 0.0)
    for t, velocity, jump in (
        (0.0, still, False),
        (1.5, FORWARD, False),
        (2.2, FORWARD, True),
        (2.7, FORWARD, False),
        (4.5, still, False),
        (6.5, right, False),
        (7.2, right, True),
    ):
        command = operator.command(10.0 + t, Mode.POLICY)
        assert command == OperatorCommand(command=velocity, jump=jump, dead_man=True)
    sit = OperatorCommand(dead_man=True, request=OperatorRequest.SIT)
    assert operator.command(20.1, Mode.POLICY) == sit
    assert requested(20.2, Mode.POLICY) is none
    assert requested(20.3, Mode.POLICY) is none
    assert requested(22.0, Mode.SIT) is none
    assert requested(23.0, Mode.DAMP) is OperatorRequest.QUIT


@pytest.mark.parametrize("event_kind", ["fault", "refused", "notice"])
def test_a_script_ends_at_the_first_fault(event_kind: str) -> None:
    operator = TimeLimit(ScriptedOperator([Script(command=FORWARD)]), 0.5)
    operator.notified("mode", "STAND")
    assert operator.command(0.0, Mode.STAND).request is OperatorRequest.WALK
    operator.notified(event_kind, "no.")
    assert operator.command(0.1, Mode.STAND).request is OperatorRequest.QUIT


def test_no_clamping_is_lost_that_ends_while_a_request_is_read() -> None:
    operator = BenchOperator(lambda joints: None)
    clamped = 0

    def clamp_a_joint(frame: Any, event: str, argument: Any) -> Any:
        """Have a joint clamped before each line of the reading."""
        nonlocal clamped
        if frame.f_code is not BenchOperator.command.__code__:
            return None
        if event == "line":
            threads = set(threading.enumerate())
            operator.notified("clamp", "FR_knee")
            for thread in set(threading.enumerate()) - threads:
                thread.join()
            clamped += 1
        return clamp_a_joint

    traced = sys.gettrace()
    sys.settrace(clamp_a_joint)
    try:
        requests = [operator.command(0.0, Mode.SWEEP).request]
    finally:
        sys.settrace(traced)
    requests += [operator.command(0.0, Mode.SWEEP).request for _ in range(clamped)]
    assert clamped > 1
    assert requests.count(OperatorRequest.CLAMPED) == clamped


class Damping(Operator):
    """An operator who requests damping."""

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        return OperatorCommand(request=OperatorRequest.DAMP)


def test_after_its_time_a_run_still_ends_at_a_fault_and_damps_on_request() -> None:
    operator = TimeLimit(ScriptedOperator([Script(command=FORWARD, stand_s=0.0)]), 0.5)
    assert operator.command(5.0, Mode.POLICY).command == FORWARD
    assert operator.command(5.6, Mode.POLICY).request is OperatorRequest.SIT
    operator.notified("fault", "tilted.")
    assert operator.command(5.7, Mode.FAULT).request is OperatorRequest.QUIT
    command = TimeLimit(Damping(), 0.0).command(0.0, Mode.POLICY)
    assert command.request is OperatorRequest.DAMP


class Idle(Operator):
    """An operator who does nothing."""

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        return OperatorCommand()


def test_a_robot_that_stands_after_its_time_sits_down() -> None:
    operator = TimeLimit(Idle(), 5.0)
    for t, mode, request in (
        (0.0, Mode.POLICY, OperatorRequest.NONE),
        (4.0, Mode.FAULT, OperatorRequest.NONE),
        (4.9, Mode.STAND, OperatorRequest.NONE),
        (5.1, Mode.STAND, OperatorRequest.SIT),
        (5.2, Mode.STAND, OperatorRequest.NONE),
        (5.3, Mode.SIT, OperatorRequest.NONE),
        (7.0, Mode.DAMP, OperatorRequest.QUIT),
    ):
        assert operator.command(t, mode).request is request


def test_keys_of_a_terminal() -> None:
    master, slave = pty.openpty()
    keyboard = Keyboard(RANGES, slave)

    def pressed(keys: bytes, t: float) -> OperatorCommand:
        os.write(master, keys)
        return keyboard.command(t, Mode.POLICY)

    assert not keyboard.command(0.0, Mode.DAMP).dead_man
    command = pressed(b" wwwad", 1.0)
    assert command.dead_man
    assert command.command == (0.75, 0.0, 0.0)
    command = pressed(b"\n2jj", 1.1)
    assert command.jump
    assert command.request is OperatorRequest.WALK
    assert command.command[2] == pytest.approx(0.4)
    # Of keys that come together, those that stop the robot count, in whatever order.
    for keys, request in (
        (b"01", OperatorRequest.DAMP),
        (b"102", OperatorRequest.DAMP),
        (b"q1", OperatorRequest.QUIT),
        (b"0q", OperatorRequest.QUIT),
        (b"q0", OperatorRequest.QUIT),
        (b"01q2", OperatorRequest.QUIT),
        (b"12", OperatorRequest.WALK),
    ):
        assert pressed(keys, 1.15).request is request
    # The jump's press lasts half a second, the dead-man key four fifths.
    assert keyboard.command(1.61, Mode.POLICY).jump is False
    assert keyboard.command(1.79, Mode.POLICY).dead_man
    assert not keyboard.command(1.81, Mode.POLICY).dead_man
    assert pressed(b"s" * 40, 2.0).command[0] == RANGES["vx"][0]
    keyboard.notified("mode", "DAMP")
    assert keyboard.command(2.1, Mode.DAMP).command == (0.0, 0.0, 0.0)
    os.close(master)
    for _ in range(2):
        assert keyboard.command(3.0, Mode.POLICY) == OperatorCommand(request=OperatorRequest.QUIT)
    keyboard.close()
    os.close(slave)


def test_a_gamepad(tmp_path: Path) -> None:
    path = tmp_path / "js0"
    os.mkfifo(path)
    pad = Gamepad(path, RANGES)
    wire = os.open(path, os.O_WRONLY)

    def moved(t: float, *events: tuple[int, int, int]) -> OperatorCommand:
        for value, event_type, number in events:
            os.write(wire, struct.pack("<IhBB", 0, value, event_type, number))
        return pad.command(t, Mode.POLICY)

    # The initial state of the buttons is no press.
    command = moved(0.0, (0, 0x81, 4), (1, 0x81, 3))
    assert not command.dead_man
    assert command.request is OperatorRequest.NONE
    # The last is within the dead zone.
    command = moved(0.1, (1, 1, 4), (1, 1, 3), (-32767, 2, 1), (16384, 2, 0), (2000, 2, 3))
    assert command.dead_man
    assert command.request is OperatorRequest.WALK
    assert command.command == pytest.approx((3.0, -0.5, 0.0), abs=1e-3)
    # B damps, whatever is pressed right after it.
    assert moved(0.15, (1, 1, 1), (1, 1, 0)).request is OperatorRequest.DAMP
    assert moved(0.16, (1, 1, 0), (1, 1, 1), (1, 1, 9)).request is OperatorRequest.DAMP
    # BACK quits, whatever is pressed before it or after it.
    assert moved(0.17, (1, 1, 1), (1, 1, 6)).request is OperatorRequest.QUIT
    assert moved(0.18, (1, 1, 6), (1, 1, 1), (1, 1, 0)).request is OperatorRequest.QUIT
    # The jump input of a press, short or long, lasts as long as in training.
    assert moved(0.2, (1, 1, 5)).jump
    assert moved(0.68, (0, 1, 5)).jump
    assert not moved(0.72).jump
    assert moved(0.8, (1, 1, 5)).jump
    assert not moved(1.4).jump
    # So does one whose begin and end are read together.
    assert moved(2.0, (0, 1, 5), (1, 1, 5), (0, 1, 5)).jump
    assert moved(2.4).jump
    assert not moved(2.6).jump
    os.close(wire)
    command = moved(2.7)
    assert not command.dead_man, "unplugged"
    assert command.command == (0.0, 0.0, 0.0)
    pad.close()


def test_devices_that_are_not_there_are_refused(tmp_path: Path) -> None:
    with pytest.raises(HardwareError, match="js9"):
        Gamepad(tmp_path / "js9", RANGES)
    (tmp_path / "file").write_text("no device")
    for path in (tmp_path, tmp_path / "file"):
        with pytest.raises(HardwareError, match="no device"):
            Gamepad(path, RANGES)
    with (tmp_path / "no terminal").open("w") as file, pytest.raises(HardwareError, match="--scri"):
        Keyboard(RANGES, file.fileno())


# --- The log ------------------------------------------------------------------------------------

HEADER = {"robot": "mini_cheetah", "joints": list(ROBOT.joint_names)}


def record(number: int, **changes: Any) -> np.void:
    tick = np.zeros(1, dtype=TICK)[0]
    t = number / 500
    put_state(tick, state(time=t, sequence=number))
    tick["tick"] = number
    tick["deadline"] = t
    tick["begun"] = t + 1e-4
    tick["done"] = t + 4e-4
    tick["latency"] = np.nan
    tick["desired"] = POSE
    tick["sent"] = POSE
    set_fields(tick, **changes)
    return tick


def written(path: Path, ticks: int, flush_after: int = 1000) -> None:
    """A log of some ticks, flushed now and then."""
    writer = DeployLogWriter(path, HEADER)
    for k in range(ticks):
        writer.write(record(k))
        if k % flush_after == flush_after - 1:
            writer.flush()
    writer.end(complete=True, figures={})


def test_a_log_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    count = 600
    writer = DeployLogWriter(path, HEADER)
    writer.write(
        event_record(0.5, "fault", "tilted", reason=Reason.TILT, level=FilterAction.LATCH)[()]
    )
    ticks = []
    steps = np.zeros(count // 10, dtype=STEP)
    for k in range(count):
        tick = record(k, mode=Mode.POLICY, desired=POSE + k)
        if k % 10 == 0:
            tick["latency"] = k / 1e4
        if k >= 590:
            tick["sent"] = np.nan
            tick["damped"] = 1
        ticks.append(tick)
        writer.write(tick)
        if k % 10 == 0:
            step = steps[k // 10]
            set_fields(step, sequence=k // 10, begun=k / 500, action=k, live=1, jump=k > 300)
            writer.write(step)
        if k % 70 == 0:
            writer.flush()
    writer.end(complete=True, figures={"servo": {"ticks": count}})
    log = read_deploy_log(path)
    assert log.complete
    assert log.figures == {"servo": {"ticks": count}}
    assert log.joints == ROBOT.joint_names
    table = np.array(ticks)
    for name in vars(log.ticks):
        if name not in ("state", "action"):
            np.testing.assert_array_equal(getattr(log.ticks, name), table[name])
    np.testing.assert_array_equal(log.ticks.action.number, table["action"])
    np.testing.assert_array_equal(log.ticks.action.state_sequence, table["action_state"])
    for name in vars(log.ticks.state):
        np.testing.assert_array_equal(getattr(log.ticks.state, name), table[name])
    for name in vars(log.steps):
        if name != "network":
            np.testing.assert_array_equal(getattr(log.steps, name), steps[name])
    for name in vars(log.steps.network):
        np.testing.assert_array_equal(getattr(log.steps.network, name), steps[name])
    np.testing.assert_allclose(log.ticks.lateness, 1e-4, atol=1e-12)
    np.testing.assert_allclose(log.ticks.work, 3e-4, atol=1e-12)
    np.testing.assert_allclose(log.ticks.state_age, 1e-4, atol=1e-12)
    np.testing.assert_array_equal(log.ticks.damped, np.arange(count) >= 590)
    np.testing.assert_array_equal(log.ticks.state.time, np.arange(count) / 500)
    np.testing.assert_array_equal(log.steps.network.action, steps["action"])
    assert (log.steps.jump.dtype, log.steps.jump.sum()) == (bool, 29)
    [first] = log.events
    assert (first.kind, first.reason, first.level) == ("fault", "TILT", "LATCH")
    assert not log.virtual


@given(share=st.floats(0.0, 1.0))
def test_a_log_cut_anywhere_is_read_up_to_there_or_refused(
    share: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.getbasetemp() / "cut"
    folder.mkdir(exist_ok=True)
    complete = folder / "whole.mcap"
    cut = folder / "cut.mcap"
    if not complete.exists():
        written(complete, 60, flush_after=10)
    data = complete.read_bytes()
    cut.write_bytes(data[: int(share * len(data))])
    try:
        log = read_deploy_log(cut)
    except LogError:
        assert share < 0.9
        return
    count = len(log.ticks.tick)
    assert count in (10, 20, 30, 40, 50, 60)
    np.testing.assert_array_equal(log.ticks.tick, np.arange(count))
    assert log.complete or share < 1.0


def test_a_file_that_unpacks_to_too_much_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    written(path, 100)
    with path.open("rb") as file, pytest.raises(DamagedError, match="more than 0 MiB"):
        list(records(file, path.stat().st_size, 50_000))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("position", [0.0] * 11),
        ("sequence", 2**63),
        ("sequence", None),
        ("velocity", "fast"),
        ("time", {}),
    ],
)
def test_messages_of_another_kind_are_refused(name: str, value: Any, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = McapWriter(path, TOPICS)
    writer.put("/deploy/header", 0.0, {"schema": SCHEMA, **HEADER})
    tick = record(0)
    message = {field: tick[field].tolist() for field in TICK.names or ()}
    message[name] = value
    writer.put("/deploy/tick", 0.0, message)
    writer.close()
    with pytest.raises(LogError, match="messages"):
        read_deploy_log(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"joints": [*HEADER["joints"], "HR_"]},
        {"joints": HEADER["joints"][:-1]},
        {"joints": [*HEADER["joints"][:-1], HEADER["joints"][0]]},
        {"limits": {"joints": {"speed": [30.0] * 11}}},
        {"limits": {"operating": 3}},
        {"joints": "abcdefghijkl"},
        {"limits": {"operating": {"tilt": "0.8"}}},
        {"limits": {"ages": {"damp_s": [0.1]}}},
    ],
)
def test_headers_of_other_joints_are_refused(changes: dict[str, Any], tmp_path: Path) -> None:
    """They would give joints the numbers of others."""
    path = tmp_path / "run.mcap"
    writer = McapWriter(path, TOPICS)
    writer.put("/deploy/header", 0.0, {"schema": SCHEMA, **HEADER, **changes})
    tick = record(0)
    writer.put("/deploy/tick", 0.0, {field: tick[field].tolist() for field in TICK.names or ()})
    writer.close()
    with pytest.raises(LogError, match="header"):
        read_deploy_log(path)


def test_other_files_are_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    other.write_bytes(b"nothing")
    for path in (other, tmp_path / "none"):
        assert not is_deploy_log(path)
        with pytest.raises(LogError):
            read_deploy_log(path)
    with pytest.raises(LogError, match="cannot be written"):
        DeployLogWriter(tmp_path, HEADER)


# --- The summary --------------------------------------------------------------------------------


def test_the_delay_stands_beside_that_of_training() -> None:
    unmeasured = RunSummary(servo={"state_to_command": {}}, trained_delay_s=(0.0, 0.01))
    assert "no delay" in unmeasured.delay_words()
    for p95_ms, word in ((10.0, "within"), (10.1, "BEYOND")):
        delay = {"n": 50, "p50_ms": 3.0, "p95_ms": p95_ms}
        summary = RunSummary(servo={"state_to_command": delay}, trained_delay_s=(0.0, 0.01))
        assert word in summary.delay_words()
