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


def through(
    seed: int = 0, after: float = 0.0, **faults: float
) -> tuple[FaultChannel[int], list[float], list[int]]:
    """4,000 messages 0, 1, 2 ... put in each millisecond; when which came out."""
    channel = FaultChannel[int](ChannelFaults(**faults), after=after, seed=seed)
    out = []
    for k in range(4000):
        channel.put(k, k * 1e-3)
        out += [(k * 1e-3, item) for item in channel.due(k * 1e-3)]
    out += [(math.inf, item) for item in channel.due(math.inf)]
    return channel, [when for when, _ in out], [item for _, item in out]


def test_without_faults_everything_passes_at_once() -> None:
    _, times, items = through()
    assert items == list(range(4000))
    assert times == [k * 1e-3 for k in range(4000)]


def test_lost_and_doubled() -> None:
    channel, _, items = through(loss=0.3)
    assert channel.counts["lost"] == 4000 - len(items)
    # Four standard deviations of a binomial.
    assert abs(channel.counts["lost"] / 4000 - 0.3) < 4 * math.sqrt(0.21 / 4000)
    assert items == sorted(items)
    channel, _, items = through(duplicate=0.1)
    assert len(items) == 4000 + channel.counts["duplicated"]
    assert 300 < channel.counts["duplicated"] < 500
    assert set(items) == set(range(4000))


def test_reordering_swaps_neighbours_and_loses_nothing() -> None:
    channel, _, items = through(reorder=0.1)
    # The last message may still wait for one that never comes.
    assert set(items) >= set(range(3999))
    swaps = sum(b < a for a, b in itertools.pairwise(items))
    assert swaps == channel.counts["reordered"] - (len(items) < 4000)
    assert all(abs(place - item) <= 1 for place, item in enumerate(items))


@pytest.mark.parametrize(
    ("jitter", "mean", "within"), [(0.0, 5.5e-3, 0.51e-3), (4e-3, 9.5e-3, 0.3e-3)]
)
def test_delay_and_jitter(jitter: float, mean: float, within: float) -> None:
    _, times, items = through(delay=5e-3, jitter=jitter)
    late = np.array([t - item * 1e-3 for t, item in zip(times, items, strict=True) if t < math.inf])
    assert late.min() >= 5e-3 - 1e-9
    # The mean of what comes on top, and half a look of a millisecond.
    assert abs(late.mean() - mean) < within
    assert sorted(items) == list(range(4000))


def test_faults_begin_at_their_time() -> None:
    channel, _, items = through(loss=1.0, after=2.0)
    assert items == list(range(2000))
    assert channel.counts["lost"] == 2000


def test_same_seed_same_faults_and_one_more_changes_no_other() -> None:
    one = through(loss=0.3, jitter=1e-3, seed=5)[1:]
    assert one == through(loss=0.3, jitter=1e-3, seed=5)[1:]
    assert one != through(loss=0.3, jitter=1e-3, seed=6)[1:]
    assert set(through(loss=0.3, jitter=1e-3, duplicate=0.5, nan=0.5, seed=5)[2]) == set(one[1])


def test_corruption_strikes_as_often_as_specified() -> None:
    channel = FaultChannel[int](ChannelFaults(flip=0.25), after=1.0, seed=0)
    assert not any(channel.strikes("flip", 0.5) for _ in range(100))
    struck = sum(channel.strikes("flip", 1.5) for _ in range(4000))
    assert 890 < struck < 1110
    assert channel.counts == {"flip": struck}
    assert not any(channel.strikes("nan", 1.5) for _ in range(100))
    assert {channel.pick(3) for _ in range(100)} == {0, 1, 2}


@given(st.binary(min_size=1), st.data())
def test_a_flipped_bit_is_one_bit(data: bytes, draw: st.DataObject) -> None:
    bit = draw.draw(st.integers(0, 8 * len(data) - 1))
    changed = flip_bit(data, bit)
    assert int.from_bytes(data, "little") ^ int.from_bytes(changed, "little") == 1 << bit


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
    "word",
    ["los=0.3", "motor.loss=0.3", "loss=a", "loss", "delay=nan", "delay=inf", "freeze=3"],
)
def test_wrong_words_are_named(word: str) -> None:
    with pytest.raises(HardwareError, match=word):
        parse_faults(f"after=1,{word}")


@pytest.mark.parametrize("text", ["loss=1.5", "loss=-0.1", "delay=-1ms"])
def test_impossible_values_are_named(text: str) -> None:
    with pytest.raises(HardwareError, match=text.partition("=")[0]):
        parse_faults(text)
