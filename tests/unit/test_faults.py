"""Faults of a link strike as specified, as often as specified, and the same way each time."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from pronk.deploy.bench.faults import ChannelFaults, FaultChannel, Faults, parse_faults
from pronk.errors import PronkError

COUNT = 4000


def through(
    seed: int = 0, after: float = 0.0, **faults: float
) -> tuple[dict[str, int], list[float], list[int]]:
    """Put in messages 0, 1, 2 ... each millisecond: what struck, and when which came out."""
    channel = FaultChannel[int](ChannelFaults(**faults), after=after, seed=seed)
    out = []
    for k in range(COUNT):
        channel.put(k, k * 1e-3)
        out += [(k * 1e-3, item) for item in channel.due(k * 1e-3)]
    out += [(math.inf, item) for item in channel.due(math.inf)]
    return dict(channel.counts), [when for when, _ in out], [item for _, item in out]


def test_loss_duplicates_and_their_beginning() -> None:
    assert through() == ({}, [k * 1e-3 for k in range(COUNT)], list(range(COUNT)))
    counts, _, items = through(loss=0.3)
    assert counts["lost"] == COUNT - len(items)
    # Four standard deviations of a binomial.
    assert abs(counts["lost"] / COUNT - 0.3) < 4 * math.sqrt(0.21 / COUNT)
    assert items == sorted(items)
    counts, _, items = through(duplicate=0.1)
    assert len(items) == COUNT + counts["duplicated"]
    assert 300 < counts["duplicated"] < 500
    assert set(items) == set(range(COUNT))
    counts, _, items = through(loss=1.0, after=2.0)
    assert (items, counts) == (list(range(2000)), {"lost": 2000})


def test_reordering_swaps_neighbours() -> None:
    counts, _, items = through(reorder=0.1)
    # The last message may still wait for one that never comes.
    assert set(items) >= set(range(COUNT - 1))
    swaps = sum(b < a for a, b in itertools.pairwise(items))
    assert swaps == counts["reordered"] - (len(items) < COUNT)
    assert all(abs(place - item) <= 1 for place, item in enumerate(items))


def test_delay_and_jitter() -> None:
    # The mean of what comes on top, and half a poll of a millisecond.
    for jitter, mean, within in ((0.0, 5.5e-3, 0.51e-3), (4e-3, 9.5e-3, 0.3e-3)):
        _, times, items = through(delay=5e-3, jitter=jitter)
        pairs = zip(times, items, strict=True)
        late = np.array([time - item * 1e-3 for time, item in pairs if time < math.inf])
        assert late.min() >= 5e-3 - 1e-9
        assert abs(late.mean() - mean) < within
        assert sorted(items) == list(range(COUNT))


def test_seeds_repeat_and_faults_are_independent() -> None:
    one = through(loss=0.3, jitter=1e-3, seed=5)
    assert one == through(loss=0.3, jitter=1e-3, seed=5)
    assert one != through(loss=0.3, jitter=1e-3, seed=6)
    assert set(through(loss=0.3, jitter=1e-3, duplicate=0.5, nan=0.5, seed=5)[2]) == set(one[2])


def test_corruption_strikes_as_often_as_specified() -> None:
    channel = FaultChannel[int](ChannelFaults(flip=0.25), after=1.0, seed=0)
    assert not any(channel.strikes("flip", 0.5) for _ in range(100))
    struck = sum(channel.strikes("flip", 1.5) for _ in range(COUNT))
    assert 890 < struck < 1110
    assert channel.counts == {"flip": struck}
    assert not any(channel.strikes("nan", 1.5) for _ in range(100))
    assert {channel.pick(3) for _ in range(100)} == {0, 1, 2}


def test_specifications_are_parsed_or_refused() -> None:
    text = (
        "loss=0.3, state.delay=5ms,command.jitter=200us,state.loss=0.5,nan=0.01,"
        "freeze=3s:500ms,clock=5:-0.2,rival=4s,after=2"
    )
    assert parse_faults(text) == Faults(
        command=ChannelFaults(loss=0.3, jitter=200e-6, nan=0.01),
        state=ChannelFaults(loss=0.5, delay=5e-3, nan=0.01),
        freeze=(3.0, 0.5),
        clock=(5.0, -0.2),
        rival=4.0,
        after=2.0,
    )
    assert parse_faults("") == Faults()
    assert parse_faults("sensor=3s:gyro-zero") == Faults(sensor=("gyro-zero", 3.0))
    for word in (
        "sensor=3s", "sensor=3s:nose", "sensor=gyro-zero:3s", "sensor=x:gyro-zero", "los=0.3",
        "motor.loss=0.3", "loss=a", "loss", "delay=nan", "freeze=3",
    ):  # fmt: skip
        with pytest.raises(PronkError, match=f"fault '{word}'"):
            parse_faults(f"after=1,{word}")
    for name, value in (("loss", "1.5"), ("loss", "-0.1"), ("delay", "-1ms")):
        with pytest.raises(PronkError, match=name):
            parse_faults(f"{name}={value}")
