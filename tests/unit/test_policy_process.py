"""The policy's process: warm-ups, and what its steps write, with the shipped policy."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pronk
from pronk.deploy.links.realtime import Pace
from pronk.deploy.runtime.memory import Shared
from pronk.deploy.runtime.modes import Mode
from pronk.deploy.runtime.plan import Link, RunPlan
from pronk.deploy.runtime.policy_process import LEAD_S, PolicyProcess, standing, warm_up_until
from pronk.deploy.runtime.records import OPERATOR, put_state, state_dtype
from pronk.policy.rollout import measurement
from pronk.policy.runtime import load_policy
from pronk.policy.script import STILL
from pronk.robots.machine import State

pytest.importorskip("onnxruntime")

POLICY = Path(pronk.__file__).parents[2] / "policies" / "matched" / "policy.onnx"
WAY = (Mode.DAMP, Mode.STAND, Mode.STAND, *(Mode.POLICY,) * 8, Mode.HALT, Mode.SIT)
"""Modes of successive steps."""
DECIDED = ("observation", "action", "target", "contact", "linear_velocity", "command", "jump")


@contextmanager
def running() -> Iterator[PolicyProcess]:
    shared = Shared()
    try:
        plan = RunPlan(link=Link(robot="mini_cheetah"), policy=POLICY)
        yield PolicyProcess(plan, shared, load_policy(POLICY))
    finally:
        shared.close()


def states(count: int) -> list[State]:
    """Of a robot that moves a little."""
    still = standing(load_policy(POLICY).start_position)
    rng = np.random.default_rng(3)
    made_states = []
    for k in range(count):
        state = replace(
            still,
            sequence=k,
            position=still.position + 0.1 * rng.standard_normal(12),
            velocity=rng.standard_normal(12),
            gyro=rng.standard_normal(3),
        )
        made_states.append(state)
    return made_states


def publish(process: PolicyProcess, state: State, mode: Mode, mode_count: int) -> None:
    """What servo and operator write before a step."""
    record = np.zeros((), dtype=state_dtype(12))
    put_state(record, state)
    record["mode"] = mode
    record["mode_count"] = mode_count
    process.shared.state.write(record)
    operator = np.zeros((), dtype=OPERATOR)
    operator["command"] = (1.0, -0.3, 99.0)
    operator["jump"] = state.sequence % 3 == 0
    process.shared.operator.write(operator)


def decided(process: PolicyProcess, warm_ups: int, states_seen: list[State]) -> list[bytes]:
    """Every bit that the steps of `WAY` wrote, with so many warm-ups before each."""
    pace = Pace(50.0)
    mode_count = 0
    decisions = []
    for k, (state, mode) in enumerate(zip(states_seen, WAY, strict=True)):
        if k > 0 and mode is not WAY[k - 1]:
            mode_count += 1
        publish(process, state, mode, mode_count)
        if warm_ups:
            for _ in range(warm_ups + k):
                process.warm_up()
        process.step(pace)
        action = process.shared.actions.read()
        (step,) = process.shared.steps.take()
        assert action is not None
        assert action["sequence"] == k
        assert action["state_sequence"] == k
        # Within what it was trained for, and only where the policy is live.
        expected = (0.0, 0.0, 0.0)
        if mode is Mode.POLICY:
            _, fastest_turn = process.policy.contract.command_ranges["yaw_rate"]
            expected = (1.0, -0.3, fastest_turn)
        np.testing.assert_allclose(step["command"], expected)
        decision = action["position"].tobytes()
        for name in DECIDED:
            decision += step[name].tobytes()
        decisions.append(decision)
    assert process.figures()["network"]["n"] == len(WAY)
    return decisions


def test_warm_ups_change_no_bit_of_what_is_decided() -> None:
    states_seen = states(len(WAY))
    with running() as plain, running() as warm:
        expected = decided(plain, 0, states_seen)
        assert decided(warm, 1, states_seen) == expected
    assert len(set(expected)) == len(expected)
    # That would have been seen: with the policy itself instead of its sibling it is another.
    with running() as spoilt:
        spoilt.warm_up = lambda: spoilt.policy.step(measurement(states_seen[0]), STILL)  # type: ignore[assignment,method-assign]
        assert decided(spoilt, 1, states_seen) != expected


def test_a_state_that_is_not_finite_gives_no_action_and_one_event() -> None:
    spoilt = replace(states(1)[0], velocity=np.full(12, np.nan))
    with running() as process:
        for _ in range(3):
            publish(process, spoilt, Mode.POLICY, 1)
            process.step(Pace(50.0))
        assert process.shared.actions.read() is None
        (last_error,) = process.shared.policy_events.take()
        assert b"velocity" in bytes(last_error["text"])
        # The next good state gives an action.
        publish(process, states(1)[0], Mode.POLICY, 1)
        process.step(Pace(50.0))
        assert process.shared.actions.read() is not None


@pytest.mark.parametrize("took", [0.0, 3e-4, 3e-3])
def test_warm_ups_lie_in_the_last_two_milliseconds(took: float) -> None:
    begun: list[float] = []

    def act() -> None:
        begun.append(time.monotonic())
        time.sleep(took)

    fewest = 1 if took > LEAD_S else 2
    largest_count = 0
    for _ in range(50):
        begun.clear()
        deadline = time.monotonic() + 5e-3
        count = warm_up_until(deadline, act)
        assert time.monotonic() >= deadline
        assert count == len(begun)
        assert all(deadline - LEAD_S <= when < deadline for when in begun)
        largest_count = max(largest_count, count)
        if largest_count >= fewest:
            break
    if took > LEAD_S:
        # One that takes longer than the remaining time is not done a second time.
        assert largest_count == 1
    else:
        assert largest_count >= 2
    # None for a deadline that has passed, or with less time than the first one needs.
    for seconds in (-1.0, 5e-4):
        assert warm_up_until(time.monotonic() + seconds, pytest.fail) == 0  # type: ignore[arg-type]
