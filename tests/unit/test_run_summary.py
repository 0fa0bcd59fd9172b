"""Events of a deployment, and its summary."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from pronk.runtime.ipc import EVENT, TEXT, Event, event
from pronk.runtime.run import RunSummary
from pronk.runtime.safety import FilterAction


def test_an_event_survives_the_ring() -> None:
    [record] = np.frombuffer(
        event(2.5, "fault", "the robot is tilted", level=FilterAction.DAMP).tobytes(), dtype=EVENT
    )
    assert Event.of(record) == Event(
        time=2.5, kind="fault", text="the robot is tilted", level="DAMP"
    )
    [long] = np.frombuffer(event(0.0, "notice", "ä" * 2 * TEXT).tobytes(), dtype=EVENT)
    assert Event.of(long).text == "?" * TEXT


def test_faults_and_refusals_are_kept_apart() -> None:
    texts = (("mode", "DAMP"), ("refused", "lying"), ("fault", "tilted"))
    seen = [Event(time=1.0, kind=k, text=t) for k, t in texts]
    figures = json.loads(json.dumps(RunSummary(events_seen=seen).figures()))
    assert (figures["faults"], figures["refusals"]) == (["tilted"], ["lying"])


@pytest.mark.parametrize(
    ("delay", "word"),
    [
        ({}, "no delay"),
        ({"n": 0}, "no delay"),
        ({"n": 50, "p50_ms": 3.0, "p95_ms": 10.0}, "within"),
        ({"n": 50, "p50_ms": 3.0, "p95_ms": 10.1}, "BEYOND"),
    ],
)
def test_the_delay_stands_beside_that_of_training(delay: dict[str, Any], word: str) -> None:
    summary = RunSummary(servo={"state_to_command": delay}, trained_delay_s=(0.0, 0.01))
    assert word in summary.delay_words()
