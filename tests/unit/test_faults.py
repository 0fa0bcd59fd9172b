"""Faults of a link strike as specified, as often as specified, and the same way each time."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pronk.errors import HardwareError
from pronk.virtual.faults import ChannelFaults, FaultChannel, Faults, flip_bit, parse_faults


def through(faults: ChannelFaults, count: int = 4000, seed: int = 0, after: float = 0.0) -> tuple[
    FaultChannel[int], list[tuple[float, int]]
]:  # fmt: skip
    """Messages 0, 1, 2 ... put in each millisecond, and when which came out."""
    lane: FaultChannel[int] = FaultChannel(faults, after=after, seed=seed)
    out = []
    for k in range(count):
        lane.put(k, k * 1e-3)
        out += [(k * 1e-3, item) for item in lane.due(k * 1e-3)]
    out += [(math.inf, item) for item in lane.due(math.inf)]
    return lane, out


def test_without_faults_everything_passes_at_once() -> None:
    _, out = through(ChannelFaults(), 100)
    assert out == [(k * 1e-3, k) for k in range(100)]


def test_loss() -> None:
    lane, out = through(ChannelFaults(loss=0.3))
    assert lane.counts["lost"] == 4000 - len(out)
    # Four standard deviations of a binomial.
    assert abs(lane.counts["lost"] / 4000 - 0.3) < 4 * math.sqrt(0.21 / 4000)
    assert [item for _, item in out] == sorted(item for _, item in out)


def test_duplicates() -> None:
    lane, out = through(ChannelFaults(duplicate=0.1))
    items = [item for _, item in out]
    assert len(items) == 4000 + lane.counts["duplicated"]
    assert 300 < lane.counts["duplicated"] < 500
    assert set(items) == set(range(4000))


def test_reordering_swaps_neighbours_and_loses_nothing() -> None:
    lane, out = through(ChannelFaults(reorder=0.1))
    items = [item for _, item in out]
    # The last message may still wait for one that never comes.
    assert set(items) >= set(range(3999))
    swaps = sum(b < a for a, b in itertools.pairwise(items))
    assert swaps == lane.counts["reordered"] - (len(items) < 4000)
    assert all(abs(place - item) <= 1 for place, item in enumerate(items))


def test_delay_and_jitter() -> None:
    _, out = through(ChannelFaults(delay=5e-3))
    late = np.array([when - item * 1e-3 for when, item in out if when < math.inf])
    # Looked at once per millisecond.
    assert late.min() >= 5e-3 - 1e-9
    assert late.max() <= 6e-3 + 1e-9
    _, out = through(ChannelFaults(delay=5e-3, jitter=4e-3))
    late = np.array([when - item * 1e-3 for when, item in out if when < math.inf])
    assert late.min() >= 5e-3 - 1e-9
    # The mean of what comes on top, and half a look.
    assert abs(late.mean() - 9.5e-3) < 0.3e-3
    assert sorted(item for _, item in out) == list(range(4000))


def test_faults_begin_at_their_time() -> None:
    lane, out = through(ChannelFaults(loss=1.0), after=2.0)
    assert [item for _, item in out] == list(range(2000))
    assert lane.counts["lost"] == 2000


def test_same_seed_same_faults_and_one_more_changes_no_other() -> None:
    one = through(ChannelFaults(loss=0.3, jitter=1e-3), seed=5)[1]
    assert one == through(ChannelFaults(loss=0.3, jitter=1e-3), seed=5)[1]
    assert one != through(ChannelFaults(loss=0.3, jitter=1e-3), seed=6)[1]
    lost = {item for _, item in one}
    twice = through(ChannelFaults(loss=0.3, jitter=1e-3, duplicate=0.5, nan=0.5), seed=5)[1]
    assert {item for _, item in twice} == lost


def test_corruption_strikes_as_often_as_specified() -> None:
    lane: FaultChannel[int] = FaultChannel(ChannelFaults(flip=0.25), after=1.0, seed=0)
    assert not any(lane.strikes("flip", 0.5) for _ in range(100))
    struck = sum(lane.strikes("flip", 1.5) for _ in range(4000))
    assert 890 < struck < 1110
    assert lane.counts == {"flip": struck}
    assert not any(lane.strikes("nan", 1.5) for _ in range(100))
    assert {lane.pick(3) for _ in range(100)} == {0, 1, 2}


@given(st.binary(min_size=1), st.data())
def test_a_flipped_bit_is_one_bit(data: bytes, draw: st.DataObject) -> None:
    bit = draw.draw(st.integers(0, 8 * len(data) - 1))
    changed = flip_bit(data, bit)
    different = int.from_bytes(data, "little") ^ int.from_bytes(changed, "little")
    assert different == 1 << bit
    assert flip_bit(changed, bit) == data


def test_words_are_read() -> None:
    got = parse_faults(
        "loss=0.3, state.delay=5ms,command.jitter=200us,state.loss=0.5,nan=0.01,"
        "freeze=3s:500ms,clock=5:-0.2,rival=4s,after=2"
    )
    assert got == Faults(
        command=ChannelFaults(loss=0.3, jitter=200e-6, nan=0.01),
        state=ChannelFaults(loss=0.5, delay=5e-3, nan=0.01),
        freeze=(3.0, 0.5),
        clock=(5.0, -0.2),
        rival=4.0,
        after=2.0,
    )
    assert parse_faults("") == Faults()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("los=0.3", "fault 'los=0.3' is unknown; expected delay"),
        ("motor.loss=0.3", "fault 'motor.loss=0.3' is unknown"),
        ("loss=a", "fault 'loss=a': expected a number"),
        ("loss", "fault 'loss': expected a number"),
        ("delay=nan", "fault 'delay=nan': expected a number"),
        ("loss=1.5", "loss is 1.5; expected a probability"),
        ("delay=-1ms", "delay is -0.001 s; expected 0 or more"),
        ("freeze=3", "fault 'freeze=3' is unknown"),
    ],
)
def test_wrong_words_are_one_sentence(text: str, complaint: str) -> None:
    with pytest.raises(HardwareError) as met:
        parse_faults(text)
    assert complaint in str(met.value)
