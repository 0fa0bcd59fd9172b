"""Supervision of sensors: a moving robot is believed, and each spoiled source is found in time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from pronk.deploy.bench.faults import NO_VOLTAGE, SENSOR_FAULTS, SWAPPED, spoiled
from pronk.deploy.runtime.limits import Limits
from pronk.deploy.runtime.reasons import FilterAction, Reason
from pronk.deploy.runtime.safety import SafetyFilter
from pronk.deploy.runtime.supervision import SensorHistory
from pronk.robots.machine import Command, State
from virtual_robot import KD, KP, POSE, ROBOT, rolled, still

DT = 0.002
BEGINS = 0.5
LIMITS = Limits.of(ROBOT)


def moving(seconds: float, seed: int = 0) -> Iterator[State]:
    """A trunk that rolls by 0.1 rad at 2 Hz and joints that swing at 2.5 Hz, each by its own."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.0, 2.0 * math.pi, 12)
    w = 2.0 * math.pi * 2.0
    u = 2.0 * math.pi * 2.5
    for k in range(round(seconds / DT)):
        t = k * DT
        roll = 0.1 * math.sin(w * t)
        gyro = np.array([0.1 * w * math.cos(w * t), 0.0, 0.0])
        force = 9.81 * np.array([0.0, math.sin(roll), math.cos(roll)])
        measured = roll + 2e-5 * rng.standard_normal()
        yield still(
            time=t,
            sequence=k,
            position=POSE + 0.15 * np.sin(u * t + phase) + 1e-4 * rng.standard_normal(12),
            velocity=0.15 * u * np.cos(u * t + phase) + 0.02 * rng.standard_normal(12),
            gyro=gyro + 1e-3 * rng.standard_normal(3),
            accelerometer=force + 0.02 * rng.standard_normal(3),
            orientation=rolled(measured),
        )


def targeted(position: np.ndarray, t: float) -> Command:
    return Command(position=position, stiffness=KP, damping=KD, made=t, valid_for=0.05)


def judged(
    states: Iterator[State], *, limits: Limits = LIMITS, swing: float = 0.2
) -> tuple[Reason, float]:
    """Why a filter first damps whose command swings like the joints, and when [s]."""
    safety = SafetyFilter(limits=limits)
    for state in states:
        target = POSE + swing * math.sin(2.0 * math.pi * 2.5 * state.time)
        sent, decision = safety.judge([state], targeted(target, state.time), state.time)
        if sent is None:
            assert decision.reason.level >= FilterAction.DAMP
            return decision.reason, state.time
    return Reason.NONE, math.nan


def spoil(change: Callable[[State, State], State]) -> Iterator[State]:
    """States of a moving robot, spoiled from `BEGINS` on."""
    sound = None
    for state in moving(2.0):
        if state.time < BEGINS or sound is None:
            sound = state
        yield state if sound is state else change(sound, state)


def late(state: State, pause: float) -> State:
    """Arrived at the end of a pause that comes every 0.3 s."""
    begun = 0.3 * math.floor(state.time / 0.3)
    passed = state.time - begun
    time = begun + pause + 1e-3 * passed if passed < pause else state.time
    return replace(state, time=time)


def slow(state: State) -> State:
    """Ten states come 40 ms apart, as from a virtual robot on a busy computer."""
    return replace(state, time=state.time + 20.0 * min(max(state.time - 1.0, 0.0), 0.02))


def test_a_moving_robot_is_believed_with_lost_states_bursts_and_slow_ones() -> None:
    rng = np.random.default_rng(1)
    for states in (
        moving(4.0),
        (state for state in moving(4.0) if rng.random() >= 0.3),
        (late(state, 0.02) for state in moving(4.0)),
        (late(state, 0.045) for state in moving(4.0)),
        map(slow, moving(2.0)),
    ):
        assert judged(states)[0] is Reason.NONE


def striding(seconds: float) -> Iterator[State]:
    """A joint that moves by 0.36 rad in 24 ms, between two rests and in one stride, every 0.3 s."""
    largest = 2400.0
    for state in moving(seconds):
        phase = math.fmod(state.time, 0.3)
        half = 0.012
        speed = largest * max(0.0, half - abs(phase - half))
        if phase < half:
            travelled = 0.5 * largest * phase**2
        else:
            travelled = largest * half**2 - 0.5 * largest * max(0.0, 2.0 * half - phase) ** 2
        stride = math.floor(state.time / 0.3)
        position = state.position.copy()
        velocity = state.velocity.copy()
        position[2] += travelled + largest * half**2 * stride
        velocity[2] += speed
        yield replace(state, position=position, velocity=velocity)


def without_strides(states: Iterator[State]) -> Iterator[State]:
    """The states between strides alone: 24 ms in a row are lost."""
    for state in states:
        if not 1e-4 < math.fmod(state.time, 0.3) < 0.024 - 1e-4:
            yield state


@pytest.mark.parametrize("is_lossy", [False, True])
def test_what_a_joint_does_while_states_are_lost_is_no_contradiction(is_lossy: bool) -> None:
    states = striding(1.0)
    largest = 0.0
    history = SensorHistory(12)
    for state in without_strides(states) if is_lossy else states:
        history.observe(state)
        largest = max(largest, float(history.encoder.max()))
    assert largest < 0.03


def test_a_jump_of_an_encoder_after_lost_states_is_found() -> None:
    def jumping() -> Iterator[State]:
        for state in moving(1.0):
            position = state.position.copy()
            position[2] += 1.0 if state.time > BEGINS else 0.0
            if not BEGINS - 0.01 < state.time < BEGINS + 0.014:
                yield replace(state, position=position)

    reason, when = judged(jumping())
    assert reason is Reason.ENCODER
    assert when - BEGINS <= 0.016


def test_equal_speeds_across_lost_states_do_not_make_a_joint_constant() -> None:
    history = SensorHistory(12)
    position = POSE.copy()
    for k in (0, 1, 2, 25, 26):
        position = position + 0.1
        history.observe(still(time=k * DT, sequence=k, position=position, velocity=np.ones(12)))
    assert history.constant_s.max() < LIMITS.sensors.repeat_s


SLOW = "encoder-drifts-with-velocity"


@pytest.mark.parametrize("fault", sorted(set(SENSOR_FAULTS) - {*SWAPPED, *NO_VOLTAGE, SLOW}))
def test_a_faulty_sensor_is_found(fault: str) -> None:
    reason, when = judged(spoil(lambda sound, state: spoiled(fault, sound, state)))
    imu = fault.split("-")[0] in ("imu", "attitude", "gyro", "accelerometer")
    if fault == "attitude-stuck":
        expected = {Reason.ATTITUDE}
    else:
        expected = {Reason.REPEATED, Reason.ATTITUDE} if imu else {Reason.ENCODER}
    assert reason in expected
    assert reason.level is FilterAction.LATCH
    assert when - BEGINS <= (0.05 if fault.endswith("repeats") else 0.1)


def stopped(sound: State, state: State) -> State:
    """A joint's encoder is constant, and its velocity nearly zero."""
    position = state.position.copy()
    velocity = state.velocity.copy()
    position[3] = sound.position[3]
    velocity[3] = 0.01
    return replace(state, position=position, velocity=velocity)


def drifting(_: State, state: State) -> State:
    return replace(state, gyro=state.gyro + 1.5)


def lying(_: State, state: State) -> State:
    x, y, z = state.accelerometer
    return replace(state, accelerometer=np.array([x, z, y]))


def creeping(_: State, state: State) -> State:
    """An encoder drifts by 0.5 rad/s; its velocity does not."""
    drift = np.where(np.arange(12) == 2, 0.5 * (state.time - BEGINS), 0.0)
    return replace(state, position=state.position + drift)


@pytest.mark.parametrize(
    ("change", "reason", "within"),
    [
        (creeping, Reason.ENCODER, 0.1),
        (stopped, Reason.ENCODER, 0.1),  # by the others' motion
        (drifting, Reason.ATTITUDE, 0.1),
        (lying, Reason.ATTITUDE, 1.0),
    ],
)
def test_a_sensor_that_others_contradict_is_found(
    change: Callable[[State, State], State], reason: Reason, within: float
) -> None:
    found_reason, when = judged(spoil(change), swing=0.0)
    assert found_reason is reason
    assert when - BEGINS <= within


def test_on_a_stand_other_legs_may_be_clamped_and_no_inertial_unit_is_needed() -> None:
    hung = replace(LIMITS, operating=replace(LIMITS.operating, tilt=math.inf))
    still = np.zeros(3)
    assert judged(spoil(stopped), swing=0.0, limits=hung)[0] is Reason.NONE
    states = (replace(state, gyro=still, accelerometer=still) for state in moving(1.0))
    assert judged(states, limits=hung)[0] is Reason.NONE


@pytest.mark.parametrize("speed", [0.0, 6.0])
def test_a_joint_that_its_full_torque_does_not_move_is_blocked(speed: float) -> None:
    safety = SafetyFilter(limits=LIMITS)
    for state in moving(0.28):
        position = state.position.copy()
        velocity = state.velocity.copy()
        position[4] = POSE[4] + speed * (state.time - 0.1)
        velocity[4] = speed + 0.01 * state.gyro[1]
        far = POSE.copy()
        far[4] = position[4] + 2.0 * ROBOT.joints[4].drive.effort_limit / KP[4]
        state = replace(state, position=position, velocity=velocity)
        sent, decision = safety.judge([state], targeted(far, state.time), state.time)
        if sent is None:
            break
    if speed == 0.0:
        assert decision.reason is Reason.CLIPPED
        assert 0.0 < state.time - safety.limits.blocked.blocked_s <= 0.02
    else:
        assert sent is not None, decision


def test_old_states_are_held_for_a_tenth_of_any_second() -> None:
    safety = SafetyFilter(limits=LIMITS)
    states = list(moving(3.0))
    for k in range(20, len(states)):
        t = k * DT
        # 30 ms old for 60 ms in each half second, then for good.
        old = t % 0.5 < 0.06 if t < 1.6 else True
        _, decision = safety.judge([states[k - 15] if old else states[k]], targeted(POSE, t), t)
        if decision.level >= FilterAction.DAMP:
            break
    assert decision.reason is Reason.HELD
    assert 0.5 < t < 1.1


# --- Clocks and the stream of states --------------------------------------------------------------

CLOCKS: dict[str, Callable[[float], float | None]] = {
    "none": lambda t: None,
    "right": lambda t: 1000.0 + t,
    "stuck": lambda t: 1.0,
    "1000 times too fast": lambda t: 1e3 * t,
    "1000 times too slow": lambda t: 1e-3 * t,
    "jumps by 10 s": lambda t: t + 10.0 * (math.floor(t / 0.1) % 2),
    "backwards": lambda t: -t,
}


@pytest.mark.parametrize("clock", CLOCKS)
def test_a_frozen_unit_is_found_whatever_the_robots_own_time_says(clock: str) -> None:
    def timed() -> Iterator[State]:
        for state in spoil(lambda sound, state: spoiled("imu-repeats", sound, state)):
            yield replace(state, robot_time=CLOCKS[clock](state.time))

    reason, when = judged(timed())
    assert reason is Reason.REPEATED
    assert when - BEGINS <= 0.05


@pytest.mark.parametrize("clock", CLOCKS)
def test_a_robots_clock_that_disagrees_with_arrival_is_a_fault(clock: str) -> None:
    states = (replace(state, robot_time=CLOCKS[clock](state.time)) for state in moving(4.0))
    reason, when = judged(states)
    if clock in ("none", "right"):
        assert reason is Reason.NONE
    else:
        assert reason is Reason.ROBOT_CLOCK
        assert when <= 2.0


@pytest.mark.parametrize("seed", range(5))
def test_a_right_clock_and_arrivals_of_a_busy_computer_give_no_alarm(seed: int) -> None:
    """States arrive late by up to 45 ms, together with those that were sent meanwhile."""
    rng = np.random.default_rng(seed)
    arrival = 0.0
    arrived = []
    for state in moving(6.0, seed):
        pause = 0.045 * rng.random() if rng.random() < 0.02 else 0.0
        arrival = max(arrival + 1e-6, state.time + pause)
        drifting_time = 5.0 + 1.001 * state.time
        arrived.append(replace(state, time=arrival, robot_time=drifting_time))
    assert judged(iter(arrived))[0] is Reason.NONE


def test_states_that_are_never_compared_are_a_fault() -> None:
    # Times of arrival that go back every 20 ms, so that nothing is ever compared for long.
    states = (
        replace(state, time=state.time - 0.004 * (state.sequence // 10), sequence=state.sequence)
        for state in moving(1.0)
    )
    safety = SafetyFilter(limits=LIMITS)
    for state in states:
        safety.sensors.observe(state)
    assert safety.sensors.restarts > LIMITS.sensors.restarts


def test_an_overtaken_state_changes_nothing() -> None:
    states = list(moving(1.0))
    for k in range(50, 450, 50):
        states[k], states[k + 1] = states[k + 1], states[k]
    assert judged(iter(states))[0] is Reason.NONE


# --- Bus voltage and numbers ----------------------------------------------------------------------


@pytest.mark.parametrize(("volts", "found"), [(0.0, True), (6.0, True), (20.0, False)])
def test_a_low_bus_voltage_is_found(volts: float, found: bool) -> None:
    reason, when = judged(spoil(lambda _, state: replace(state, bus_voltage=volts)))
    assert reason is (Reason.BUS_VOLTAGE if found else Reason.NONE)
    if found:
        assert when - BEGINS <= 0.1


def test_a_voltage_that_the_wire_lacks_or_that_sags_for_a_moment_is_no_fault() -> None:
    missing = (replace(state, bus_voltage=math.nan) for state in moving(1.0))
    assert judged(missing)[0] is Reason.NONE
    sagging = (
        replace(state, bus_voltage=10.0 if state.time % 0.2 < 0.05 else 24.0)
        for state in moving(1.0)
    )
    assert judged(sagging)[0] is Reason.NONE


def test_one_accelerometer_reading_that_is_no_number_is_a_fault_and_poisons_no_mean() -> None:
    def once(state: State, k: int) -> State:
        return replace(state, accelerometer=np.full(3, math.nan)) if k == 100 else state

    assert judged(once(state, k) for k, state in enumerate(moving(1.0)))[0] is (
        Reason.STATE_NOT_FINITE
    )
    safety = SafetyFilter(limits=LIMITS)
    for k, state in enumerate(moving(1.0)):
        safety.sensors.observe(once(state, k))
    assert np.isfinite(safety.sensors.force).all()
    assert safety.sensors.lean < 0.2


@pytest.mark.parametrize("drift", [0.0, 0.1])
def test_a_fast_joint_whose_states_arrive_in_bursts_does_not_drift(drift: float) -> None:
    """Nine of ten states arrive 0.85 periods after the one before, the tenth late.

    The second time the position drifts by 0.1 rad a second, which is found.
    """
    history = SensorHistory(12)
    period = 0.002
    base = still()
    largest = 0.0
    for k in range(5000):
        t = k * period
        arrival = period * (k - 0.15 * (k % 10))
        # Half a second of 2 rad/s one way, and back: a step of 1 rad is monotone in a window.
        velocity = np.full(12, 2.0 if t % 1.0 < 0.5 else -2.0)
        position = base.position + 2.0 * (0.5 - abs(t % 1.0 - 0.5)) + drift * t
        state = replace(base, time=arrival, sequence=k, position=position, velocity=velocity)
        history.observe(state)
        largest = max(largest, float(history.slow_drift.max()))
    assert (largest > LIMITS.sensors.drift) is (drift > 0.0)


def test_a_count_that_jumps_does_not_make_joints_drift() -> None:
    """The robot's count of states jumps by 1,000 once, with no pause."""
    history = SensorHistory(12)
    base = still()
    for k in range(3000):
        t = 0.002 * k
        velocity = np.full(12, 2.0 if t % 1.0 < 0.5 else -2.0)
        position = base.position + 2.0 * (0.5 - abs(t % 1.0 - 0.5))
        sequence = k if k < 1000 else k + 1000
        state = replace(base, time=t, sequence=sequence, position=position, velocity=velocity)
        history.observe(state)
        assert history.slow_drift.max() < LIMITS.sensors.drift, k
