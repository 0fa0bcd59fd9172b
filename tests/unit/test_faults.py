"""Faults of a link strike as specified, as often as specified, and the same way each time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from pronk.deploy.bench.faults import ChannelFaults, FaultChannel, Faults, parse_faults
from pronk.errors import PronkError

COUNT = 4000


@dataclass
class Passage:
    """What came out of a channel that was given messages 0, 1, 2 ... each millisecond."""

    counts: dict[str, int]
    times: list[float]
    items: list[int]


def pass_through(seed: int = 0, after: float = 0.0, **faults: float) -> Passage:
    channel = FaultChannel[int](ChannelFaults(**faults), after=after, seed=seed)
    times = []
    items = []
    for number in range(COUNT):
        now = number * 1e-3
        channel.put(number, now)
        for item in channel.due(now):
            times.append(now)
            items.append(item)
    for item in channel.due(math.inf):
        times.append(math.inf)
        items.append(item)
    return Passage(dict(channel.counts), times, items)


def test_without_faults_all_pass_at_once() -> None:
    passage = pass_through()
    assert passage.counts == {}
    assert passage.items == list(range(COUNT))
    np.testing.assert_array_equal(passage.times, np.arange(COUNT) * 1e-3)


def test_loss_strikes_as_often_as_specified() -> None:
    passage = pass_through(loss=0.3)
    lost = passage.counts["lost"]
    assert lost == COUNT - len(passage.items)
    # Four standard deviations of a binomial.
    assert abs(lost / COUNT - 0.3) < 4 * math.sqrt(0.21 / COUNT)
    assert passage.items == sorted(passage.items)


def test_duplicates_come_twice() -> None:
    passage = pass_through(duplicate=0.1)
    assert len(passage.items) == COUNT + passage.counts["duplicated"]
    assert 300 < passage.counts["duplicated"] < 500
    assert set(passage.items) == set(range(COUNT))


def test_faults_begin_when_specified() -> None:
    passage = pass_through(loss=1.0, after=2.0)
    assert passage.items == list(range(2000))
    assert passage.counts == {"lost": 2000}


def test_reordering_swaps_neighbours() -> None:
    passage = pass_through(reorder=0.1)
    items = np.array(passage.items)
    # The last message may still wait for one that never comes.
    assert set(passage.items) >= set(range(COUNT - 1))
    waiting = COUNT - len(items)
    assert np.count_nonzero(np.diff(items) < 0) == passage.counts["reordered"] - waiting
    assert np.abs(np.arange(len(items)) - items).max() <= 1


@pytest.mark.parametrize(
    ("jitter", "mean", "tolerance"), [(0.0, 5.5e-3, 0.51e-3), (4e-3, 9.5e-3, 0.3e-3)]
)
def test_delay_and_jitter(jitter: float, mean: float, tolerance: float) -> None:
    passage = pass_through(delay=5e-3, jitter=jitter)
    times = np.array(passage.times)
    lateness = (times - np.array(passage.items) * 1e-3)[np.isfinite(times)]
    assert lateness.min() >= 5e-3 - 1e-9
    # The mean of what comes on top, and half a poll of a millisecond.
    assert abs(lateness.mean() - mean) < tolerance
    assert sorted(passage.items) == list(range(COUNT))


def test_seeds_repeat_and_faults_are_independent() -> None:
    first = pass_through(loss=0.3, jitter=1e-3, seed=5)
    assert first == pass_through(loss=0.3, jitter=1e-3, seed=5)
    assert first != pass_through(loss=0.3, jitter=1e-3, seed=6)
    more_faults = pass_through(loss=0.3, jitter=1e-3, duplicate=0.5, nan=0.5, seed=5)
    assert set(more_faults.items) == set(first.items)


def test_corruption_strikes_as_often_as_specified() -> None:
    channel = FaultChannel[int](ChannelFaults(flip=0.25), after=1.0, seed=0)
    for _ in range(100):
        assert not channel.strikes("flip", 0.5)
    struck = 0
    for _ in range(COUNT):
        struck += channel.strikes("flip", 1.5)
    assert 890 < struck < 1110
    assert channel.counts == {"flip": struck}
    for _ in range(100):
        assert not channel.strikes("nan", 1.5)
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
        "motor.loss=0.3", ".loss=0.3", "loss=a", "loss", "delay=nan", "freeze=3",
    ):  # fmt: skip
        with pytest.raises(PronkError, match=f"fault '{word}'"):
            parse_faults(f"after=1,{word}")
    for name, value in (("loss", "1.5"), ("loss", "-0.1"), ("delay", "-1ms")):
        with pytest.raises(PronkError, match=name):
            parse_faults(f"{name}={value}")
