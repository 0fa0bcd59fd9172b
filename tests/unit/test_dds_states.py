"""Which of a Unitree robot's messages make states, and how these are numbered."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

pytest.importorskip("cyclonedds")

from pronk.links.dds.codec import encode_state, joint_map
from pronk.links.dds.state_decoder import StateDecoder
from pronk.links.machine import State
from pronk.robots import load_robot

JOINTS = joint_map(load_robot("mini_cheetah"))


def message(tick: int, *, value: float | None = None) -> bytes:
    """A message at a robot's time [ms]; its joints are at `value`, by default as many mrad."""
    angle = np.full(12, 1e-3 * (tick % 1000) if value is None else value)
    return encode_state(
        JOINTS,
        State(
            time=0.0,
            robot_time=tick / 1000.0,
            sequence=0,
            position=angle,
            velocity=np.zeros(12),
            torque=np.zeros(12),
            gyro=np.zeros(3),
            accelerometer=np.array([0.0, 0.0, 9.81]),
            bus_voltage=24.0,
        ),
    )


def taken(*ticks: int, every: float = 0.002) -> tuple[list[int], Counter[str]]:
    """Sequence numbers of the states made, and the counts, of messages that come regularly."""
    decoder = StateDecoder(JOINTS, Counter())
    states = [decoder.take(message(tick), 10.0 + every * k) for k, tick in enumerate(ticks)]
    return [state.sequence for state in states if state is not None], decoder.counts


def test_regular_states_are_numbered_one_by_one() -> None:
    assert taken(5000, 5002, 5004, 5006) == ([0, 1, 2, 3], Counter(states=4))


def test_a_jitter_of_the_robots_clock_of_a_millisecond_loses_nothing() -> None:
    assert taken(5000, 5001, 5004, 5005, 5008)[0] == [0, 1, 3, 3 + 1, 3 + 1 + 2]
    assert taken(5000, 5002, 5003, 5006)[0][:3] == [0, 1, 2]


def test_lost_states_are_missing_in_the_numbers() -> None:
    assert taken(5000, 5002, 5008, 5010)[0] == [0, 1, 4, 5]


def test_duplicates_and_latecomers_make_no_states() -> None:
    numbers, counts = taken(5000, 5002, 5002, 5006, 5004, 5008)
    assert numbers == [0, 1, 3, 4]
    assert counts == Counter({"states": 4, "out of order": 2})


def test_a_clock_that_starts_again_or_jumps_is_counted_and_loses_nothing() -> None:
    numbers, counts = taken(90_000, 90_002, 4, 6, 8000, 8002)
    assert numbers == [0, 1, 2, 3, 4, 5]
    assert counts == Counter({"states": 6, "clock jumps": 2})


def test_a_clock_passes_its_largest_number() -> None:
    most = 2**32
    assert taken(most - 4, most - 2, 0, 2)[0] == [0, 1, 2, 3]


def test_frozen_values_behind_a_live_clock_make_no_states() -> None:
    decoder = StateDecoder(JOINTS, Counter())
    made = [decoder.take(message(2 * k, value=0.5), 0.002 * k) for k in range(5)]
    assert made[0] is not None
    assert made[1:] == [None] * 4
    assert decoder.counts == Counter({"states": 1, "repeated": 4})
    alive = decoder.take(message(12, value=0.6), 0.012)
    assert alive is not None


def test_refused_messages_are_counted_and_keep_their_message() -> None:
    decoder = StateDecoder(JOINTS, Counter())
    broken = bytearray(message(2))
    broken[300] ^= 1
    assert decoder.take(bytes(broken), 0.0) is None
    assert decoder.take(message(4, value=float("nan")), 0.002) is None
    assert decoder.counts == Counter({"refused: checksum": 1, "refused: not finite": 1})
    assert decoder.last_error == "motor_state holds a number that is not finite"


def test_times_grow_even_where_messages_came_at_once() -> None:
    decoder = StateDecoder(JOINTS, Counter())
    times = [
        state.time for k in range(4) if (state := decoder.take(message(2 * k), 7.0)) is not None
    ]
    assert times == pytest.approx([7.0, 7.0 + 1e-6, 7.0 + 2e-6, 7.0 + 3e-6], abs=1e-8)
    assert (np.diff(times) > 0.0).all()


def test_a_virtual_robot_is_recognized() -> None:
    decoder = StateDecoder(JOINTS, Counter())
    assert not decoder.virtual
    decoder.take(message(2), 0.0)
    assert decoder.virtual
