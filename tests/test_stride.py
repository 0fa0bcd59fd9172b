"""When a jump input passes: with the stride, and not much later without one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pronk.policy.stride import MOST_S, StrideGate, apart

RATE = 50.0
PERIOD = 8.2
"""Of a stride, in policy steps: 0.164 s, as at 2 m/s."""
STEPS = 200
LAST = round(MOST_S * RATE)


def trot(phase: NDArray[np.float64], size: float = 0.5) -> NDArray[np.float64]:
    """Joint positions of robots that trot in place, FR and HL lifted first. (STEPS, robots, 12)."""
    bend = size * np.sin(2.0 * np.pi * (np.arange(STEPS)[:, None] / PERIOD + phase))
    joints = np.zeros((STEPS, len(phase), 12)) + [0.0, -0.8, 1.6] * 4
    for knee, sign in ((2, 1.0), (5, -1.0), (8, -1.0), (11, 1.0)):
        joints[:, :, knee] += sign * bend
    return joints


def passed(joints: NDArray[np.float64], asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The jump inputs of robots from step to step. (STEPS, robots)."""
    gate = StrideGate(np.zeros(joints.shape[1]), policy_rate_hz=RATE)
    return np.array([gate(now, wants) for now, wants in zip(joints, asked, strict=True)])


def test_how_far_the_legs_are_apart_by_hand() -> None:
    joints = np.arange(12.0)
    assert apart(joints) == (2 + 11) - (5 + 8)
    joints[[2, 11]] += [0.25, 0.5]
    assert apart(joints) == pytest.approx(0.75)
    assert apart(np.stack([joints, -joints])).tolist() == pytest.approx([0.75, -0.75])


def test_jumps_asked_for_at_any_moment_begin_at_one() -> None:
    """With strides that are no whole number of steps the moment is met to within one step."""
    random = np.random.default_rng(0)
    phase = random.random(300)
    joints = trot(phase)
    begins = random.integers(20, 60, 300)
    steps = np.arange(STEPS)[:, None]
    asked = (steps >= begins) & (steps < begins + 25)
    jumps = passed(joints, asked)
    first = jumps.argmax(axis=0)
    assert jumps.any(axis=0).all()
    since = (first + phase * PERIOD) % PERIOD  # after the legs have changed over
    assert since.max() < 1.0 + 1e-9
    assert 0.4 < since.mean() < 0.6
    wait = first - begins
    assert wait.min() >= 0
    assert wait.max() < PERIOD
    # Once on, it is what is asked for.
    assert (jumps == (asked & (steps >= first))).all()


def test_mirrored_robots_jump_half_a_stride_later() -> None:
    joints = trot(np.zeros(1))
    other = joints[:, :, [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]]
    asked = np.arange(STEPS)[:, None] >= 40
    first, second = (int(passed(j, asked).argmax()) for j in (joints, other))
    assert abs(second - first) == pytest.approx(PERIOD / 2.0, abs=1.0)


def test_who_has_no_stride_waits_no_longer_than_the_longest() -> None:
    joints = trot(np.zeros(2), size=0.0)
    asked = np.arange(STEPS)[:, None] >= np.array([10, 30])
    jumps = passed(joints, asked)
    assert jumps.argmax(axis=0).tolist() == [10 + LAST, 30 + LAST]
    assert jumps.sum() == jumps.shape[0] * 2 - 40 - 2 * LAST
    assert pytest.approx(MOST_S) == LAST / RATE


def test_who_lets_go_before_does_not_jump_and_the_next_press_waits_anew() -> None:
    joints = trot(np.zeros(1), size=0.0)
    steps = np.arange(STEPS)[:, None]
    asked = ((steps >= 10) & (steps < 10 + LAST)) | (steps >= 50)
    assert int(passed(joints, asked).argmax()) == 50 + LAST


def test_after_a_reset_the_first_sample_is_no_change_over() -> None:
    """It has no sample before it: a robot set down with its knees apart has made no step."""
    gate = StrideGate(np.zeros(2), policy_rate_hz=RATE)
    joints = trot(np.array([0.9, 0.9]))
    behind, ahead = joints[0], joints[2]
    assert (apart(behind) < 0.0).all()
    assert (apart(ahead) > 0.0).all()
    yes = np.array([True, True])
    assert not gate(behind, yes).any()
    gate.reset(np.array([1]))
    assert gate(ahead, yes).tolist() == [True, False]
    gate.reset()
    assert gate(ahead, yes).tolist() == [False, False]


def test_arrays_of_torch_pass_alike() -> None:
    torch = pytest.importorskip("torch")
    random = np.random.default_rng(1)
    joints = trot(random.random(40))
    asked = random.random((STEPS // 20, 40)).repeat(20, axis=0) < 0.5
    gate: Any = StrideGate(torch.zeros(40), policy_rate_hz=RATE)
    found = []
    for now, wants in zip(joints, asked, strict=True):
        found.append(gate(torch.tensor(now), torch.tensor(wants)).tolist())
    expected = passed(joints, asked)
    assert found == expected.tolist()
    assert 0 < expected.sum() < asked.sum()
