"""Supervision of sensors: a moving robot is believed, and each spoiled source is found in time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from pronk.links.machine import Command, State
from pronk.runtime.safety import Decision, FilterAction, Limits, Reason, SafetyFilter
from pronk.virtual.faults import SENSOR_FAULTS, SWAPPED, spoiled
from virtual_robot import KD, KP, POSE, ROBOT, rolled, still

DT = 0.002
BEGINS = 0.5


def moving(seconds: float, seed: int = 0) -> Iterator[State]:
    """A trunk that rolls by 0.1 rad at 2 Hz and joints that swing at 2.5 Hz, each by its own."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.0, 2.0 * math.pi, 12)
    w, u = 2.0 * math.pi * 2.0, 2.0 * math.pi * 2.5
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


def judged(
    states: Iterator[State], *, limits: Limits | None = None, swing: float = 0.2
) -> tuple[Decision, float] | None:
    """The first damping of a filter whose command swings like the joints, and when."""
    safety = SafetyFilter(limits=limits or Limits.of(ROBOT))
    for state in states:
        wanted = POSE + swing * math.sin(2.0 * math.pi * 2.5 * state.time)
        command = Command(
            position=wanted, stiffness=KP, damping=KD, made=state.time, valid_for=0.05
        )
        sent, decision = safety.judge([state], command, state.time)
        if sent is None:
            return decision, state.time
    return None


def spoil(change: Callable[[State, State], State]) -> Iterator[State]:
    """States of a moving robot, spoiled from `BEGINS` on."""
    sound = None
    for state in moving(2.0):
        if state.time < BEGINS or sound is None:
            sound = state
            yield state
        else:
            yield change(sound, state)


def test_a_moving_robot_is_believed() -> None:
    assert judged(moving(4.0)) is None


def test_lost_states_and_bursts_are_believed() -> None:
    rng = np.random.default_rng(1)
    assert judged(state for state in moving(4.0) if rng.random() >= 0.3) is None

    def late(state: State, pause: float) -> State:
        """Arrived at the end of a pause that comes every 0.3 s."""
        begun = 0.3 * math.floor(state.time / 0.3)
        passed = state.time - begun
        time = begun + pause + 1e-3 * passed if passed < pause else state.time
        return replace(state, time=time)

    for pause in (0.02, 0.045):
        assert judged(late(state, pause) for state in moving(4.0)) is None


def test_a_robot_that_is_slow_for_a_while_is_believed() -> None:
    def slow(state: State) -> State:
        """Ten states come 40 ms apart, as from a virtual robot on a busy computer."""
        passed = min(max(state.time - 1.0, 0.0), 0.02)
        return replace(state, time=state.time + 20.0 * passed)

    assert judged(slow(state) for state in moving(2.0)) is None


@pytest.mark.parametrize("fault", sorted(set(SENSOR_FAULTS) - set(SWAPPED)))
def test_a_faulty_sensor_is_found(fault: str) -> None:
    found = judged(spoil(lambda sound, state: spoiled(fault, sound, state)))
    assert found is not None
    decision, when = found
    imu = fault.split("-")[0] in ("imu", "attitude", "gyro", "accelerometer")
    if fault == "attitude-stuck":
        expected = {Reason.ATTITUDE}
    else:
        expected = {Reason.REPEATED, Reason.ATTITUDE} if imu else {Reason.ENCODER}
    assert decision.reason in expected
    assert decision.level is FilterAction.LATCH
    assert when - BEGINS <= (0.05 if fault.endswith("repeats") else 0.1)


def test_a_slow_joint_that_stops_is_found_by_the_others_motion() -> None:
    def stopped(sound: State, state: State) -> State:
        q, v = state.position.copy(), state.velocity.copy()
        q[3], v[3] = sound.position[3], 0.01
        return replace(state, position=q, velocity=v)

    found = judged(spoil(stopped), swing=0.0)
    assert found is not None
    assert found[0].reason is Reason.ENCODER
    assert found[1] - BEGINS <= 0.1
    # On a stand the other legs may be clamped while one is excited.
    assert judged(spoil(stopped), swing=0.0, limits=Limits.of(ROBOT, tilt=math.inf)) is None


@pytest.mark.parametrize("speed", [0.0, 6.0])
def test_a_joint_that_its_full_torque_does_not_move_is_blocked(speed: float) -> None:
    safety = SafetyFilter(limits=Limits.of(ROBOT))
    sent = None
    for state in moving(0.28):
        q, v = state.position.copy(), state.velocity.copy()
        q[4], v[4] = POSE[4] + speed * (state.time - 0.1), speed + 0.01 * state.gyro[1]
        far = POSE.copy()
        far[4] = q[4] + 2.0 * ROBOT.joints[4].drive.effort_limit / KP[4]
        desired = Command(position=far, stiffness=KP, damping=KD, made=state.time, valid_for=0.05)
        state = replace(state, position=q, velocity=v)
        sent, decision = safety.judge([state], desired, state.time)
        if sent is None:
            break
    if speed == 0.0:
        assert decision.reason is Reason.CLIPPED
        assert 0.0 < state.time - safety.limits.blocked_s <= 0.02
    else:
        assert sent is not None, decision


def test_a_gyro_that_is_off_and_a_trunk_that_lies_are_found() -> None:
    def drifting(_: State, state: State) -> State:
        return replace(state, gyro=state.gyro + 1.5)

    def lying(_: State, state: State) -> State:
        x, y, z = state.accelerometer
        return replace(state, accelerometer=np.array([x, z, y]))

    for change, within in ((drifting, 0.1), (lying, 1.0)):
        found = judged(spoil(change))
        assert found is not None
        assert found[0].reason is Reason.ATTITUDE
        assert found[1] - BEGINS <= within


def test_a_hung_robot_needs_no_inertial_unit() -> None:
    still = np.zeros(3)
    states = (replace(state, gyro=still, accelerometer=still) for state in moving(1.0))
    assert judged(states, limits=Limits.of(ROBOT, tilt=math.inf)) is None


def test_old_states_are_held_for_a_tenth_of_any_second() -> None:
    safety = SafetyFilter(limits=Limits.of(ROBOT))
    states = list(moving(3.0))
    for k in range(20, len(states)):
        t = k * DT
        # 30 ms old for 60 ms in each half second, then for good.
        old = t % 0.5 < 0.06 if t < 1.6 else True
        state = states[k - 15] if old else states[k]
        desired = Command(position=POSE, stiffness=KP, damping=KD, made=t, valid_for=0.05)
        _, decision = safety.judge([state], desired, t)
        if decision.level >= FilterAction.DAMP:
            assert decision.reason is Reason.HELD
            break
    else:
        pytest.fail("the last target was held for more than a second")
    assert 0.5 < t < 1.1
