"""What the servo tells the operator, and how a deployment went, in words and figures."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from pronk.runtime.ipc import EVENT, TEXT, Event, event
from pronk.runtime.run import RunSummary
from pronk.runtime.safety import FilterAction


def notice(kind: str, text: str) -> Event:
    return Event(time=1.0, kind=kind, text=text, level=int(FilterAction.PASS))


def delays(**changes: Any) -> dict[str, Any]:
    return {"state_to_command": {"n": 50, "p50_ms": 3.0, "p95_ms": 9.0} | changes}


def test_a_notice_is_what_the_servo_said() -> None:
    said = event(2.5, "fault", "the robot is tilted", level=FilterAction.DAMP)
    # As it comes out of a ring.
    [record] = np.frombuffer(said.tobytes(), dtype=EVENT)
    assert Event.of(record) == Event(
        time=2.5, kind="fault", text="the robot is tilted", level=int(FilterAction.DAMP)
    )
    [long] = np.frombuffer(event(0.0, "notice", "ä" * 2 * TEXT).tobytes(), dtype=EVENT)
    assert Event.of(long).text == "?" * TEXT


def test_faults_and_refusals_are_kept_apart() -> None:
    summary = RunSummary(
        events_seen=[notice("mode", "DAMP"), notice("refused", "lying"), notice("fault", "tilted")]
    )
    assert (summary.faults, summary.refusals) == (["tilted"], ["lying"])
    figures = json.loads(json.dumps(summary.figures()))
    assert (figures["faults"], figures["refusals"]) == (["tilted"], ["lying"])
    assert figures["interrupted"] is False
    assert figures["trained_delay_s"] == [0.0, 0.0]
    assert RunSummary().figures()["servo"] == {}


@pytest.mark.parametrize(
    ("servo", "says"),
    [
        ({}, "no delay was measured; the policy was trained for 0 to 10 ms."),
        (delays(n=0), "no delay was measured; the policy was trained for 0 to 10 ms."),
        (delays(), "3.0 ms (median), 9.0 ms (95 %), n = 50: within the 0 to 10 ms trained for"),
        (delays(p95_ms=10.0), "within the 0 to 10 ms"),
        (delays(p95_ms=10.1), "BEYOND the 0 to 10 ms"),
    ],
)
def test_the_delay_stands_beside_what_was_trained(servo: dict[str, Any], says: str) -> None:
    assert says in RunSummary(servo=servo, trained_delay_s=(0.0, 0.01)).delay_words()
