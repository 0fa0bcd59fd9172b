"""What the servo tells the operator, and how a deployment went, in words and figures."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from pronk.runtime.events import Notice
from pronk.runtime.reasons import Level
from pronk.runtime.records import EVENT, TEXT, event
from pronk.runtime.summary import Outcome


def notice(kind: str, text: str) -> Notice:
    return Notice(time=1.0, kind=kind, text=text, level=int(Level.PASS))


def delays(**changes: Any) -> dict[str, Any]:
    return {"state_to_command": {"n": 50, "p50_ms": 3.0, "p95_ms": 9.0} | changes}


def test_a_notice_is_what_the_servo_said() -> None:
    said = event(2.5, "fault", "the robot is tilted", level=Level.DAMP)
    # As it comes out of a ring.
    [record] = np.frombuffer(said.tobytes(), dtype=EVENT)
    assert Notice.of(record) == Notice(
        time=2.5, kind="fault", text="the robot is tilted", level=int(Level.DAMP)
    )
    [long] = np.frombuffer(event(0.0, "notice", "ä" * 2 * TEXT).tobytes(), dtype=EVENT)
    assert Notice.of(long).text == "?" * TEXT


def test_faults_and_refusals_are_told_apart() -> None:
    outcome = Outcome(
        notices=[notice("mode", "DAMP"), notice("refused", "lying"), notice("fault", "tilted")]
    )
    assert (outcome.faults, outcome.refusals) == (["tilted"], ["lying"])
    figures = json.loads(json.dumps(outcome.figures()))
    assert (figures["faults"], figures["refusals"]) == (["tilted"], ["lying"])
    assert figures["interrupted"] is False
    assert figures["trained_delay_s"] == [0.0, 0.0]
    assert Outcome().figures()["servo"] == {}


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
    assert says in Outcome(servo=servo, trained_delay_s=(0.0, 0.01)).delay_words()
