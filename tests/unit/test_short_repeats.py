"""Short excitations that repeat are told apart by the rest between them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from chirp_logs import chirp_log
from pronk.arrays import Array
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.segmentation import find_segments
from pronk.identify.match.match import match
from pronk.robots import load_robot

RATE_HZ = 200.0


def chirp(length_s: float, amplitude: float = 0.2, top_hz: float = 10.0) -> Array:
    time = np.arange(round(length_s * RATE_HZ)) / RATE_HZ
    turns = 0.2 * time + (top_hz - 0.2) * time**2 / (2.0 * length_s)
    return np.asarray(amplitude * np.sin(2.0 * np.pi * turns))


def rest(length_s: float, at: float = 0.0) -> Array:
    return np.full(round(length_s * RATE_HZ), at)


def found(*parts: Array) -> list[tuple[float, float]]:
    """Start and stop of the segments of a command that is made of parts."""
    command = np.concatenate(parts)
    time = 7.0 + np.arange(len(command)) / RATE_HZ
    segments = find_segments(time, command[:, None], ("knee",)).segments
    return [(segment.start - 7.0, segment.stop - 7.0) for segment in segments]


@pytest.mark.parametrize("length_s", [2.5, 4.0, 6.0, 7.9, 12.0])
@pytest.mark.parametrize("rest_s", [0.5, 0.8, 2.0])
def test_each_repeat_has_a_segment(length_s: float, rest_s: float) -> None:
    parts = [rest(1.0), chirp(length_s), rest(rest_s), chirp(length_s), rest(rest_s)]
    segments = found(*parts, chirp(length_s), rest(1.0))
    assert len(segments) == 3
    for number, (start, stop) in enumerate(segments):
        begins = 1.0 + number * (length_s + rest_s)
        assert begins - rest_s <= start <= begins + 0.02
        assert begins + length_s - 0.02 <= stop <= begins + length_s + rest_s + 1.0
    for (_, stop), (start, _) in itertools.pairwise(segments):
        assert start >= stop


def test_scaled_repeats_keep_their_amplitudes() -> None:
    command = np.concatenate([rest(1.0), chirp(4.0), rest(0.6), chirp(4.0, 0.1), rest(0.6)])
    time = np.arange(len(command)) / RATE_HZ
    segments = find_segments(time, command[:, None], ("knee",)).segments
    amplitudes = [segment.amplitude for segment in segments]
    assert amplitudes == pytest.approx([0.2, 0.1], rel=0.01)


def test_what_is_no_repeat_at_rest_stays_one_excitation() -> None:
    assert len(found(rest(1.0), chirp(4.0), rest(0.3), chirp(4.0), rest(1.0))) == 1
    assert len(found(rest(1.0), chirp(4.0), rest(1.0), chirp(4.0, top_hz=7.0), rest(1.0))) == 1
    assert len(found(rest(1.0), chirp(1.5), rest(1.0), chirp(1.5), rest(1.0))) == 1
    # A staircase of slow ramps is one signal, though all its steps are alike.
    stairs = [rest(1.0)]
    for step in range(4):
        stairs.append(np.linspace(0.1 * step, 0.1 * (step + 1), round(3.0 * RATE_HZ)))
        stairs.append(rest(1.0, at=0.1 * (step + 1)))
    assert len(found(*stairs, rest(1.0), chirp(4.0), rest(1.0))) == 1


def test_repeats_give_the_gains_of_the_joint() -> None:
    robot = load_robot("mini_cheetah")
    made = chirp_log(robot, "FR_knee", (22.0, 0.55), (0.2,), repeats=2, length_s=4.0, delay_s=0.004)
    bare = JointLog(
        robot=made.robot,
        joints=made.joints,
        time=made.time,
        command=made.command,
        position=made.position + 1e-4 * np.random.default_rng(2).normal(size=made.position.shape),
        stiffness=made.stiffness,
        damping=made.damping,
        units=made.units,
    )
    assert len(bare.segmented().segments) == 2
    gains = match([bare], robot).joints["FR_knee"].gains
    assert gains.stiffness.value == pytest.approx(22.0, rel=0.01)
    assert gains.damping.value == pytest.approx(0.55, rel=0.02)
    assert gains.delay_s.value == pytest.approx(0.004, abs=2e-4)
