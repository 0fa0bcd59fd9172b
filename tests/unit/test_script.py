"""The script of a run and the names of commands."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pronk.errors import PronkError
from pronk.evaluation.protocol import PAPER_COMMANDS, RATES, Case, parse_case, parse_cases
from pronk.runtime.script import STILL, Script

COMMAND = (2.0, 0.0, 0.5)


def script(**changes: Any) -> Script:
    kept: dict[str, Any] = {"command": COMMAND}
    return Script(**(kept | changes))


def test_the_whole_script_by_hand() -> None:
    made = script()
    assert (made.start, made.on, made.off, made.stop, made.seconds) == (1.0, 3.5, 4.0, 4.5, 7.5)
    expected = [
        (0.0, STILL, False),
        (0.98, STILL, False),
        (1.0, COMMAND, False),
        (3.48, COMMAND, False),
        (3.5, COMMAND, True),
        (3.98, COMMAND, True),
        (4.0, COMMAND, False),
        (4.48, COMMAND, False),
        (4.5, STILL, False),
        (7.4, STILL, False),
    ]
    assert [(t, *made.commanded(t)) for t, _, _ in expected] == expected


def test_times_are_met_despite_rounding() -> None:
    for ticks in range(26):
        made = script(run_s=2.5 + ticks / 50)
        commanded = [made.commanded(k / 50) for k in range(round(made.seconds * 50))]
        jumps = [k for k, (_, jump) in enumerate(commanded) if jump]
        assert jumps == list(range(175 + ticks, 200 + ticks))
        assert [k for k, (command, _) in enumerate(commanded) if command != STILL] == list(
            range(50, 225 + ticks)
        )


@pytest.mark.parametrize(
    ("text", "name", "command"),
    [
        ("1,0,0", "forward 1", (1.0, 0.0, 0.0)),
        ("0, -1", "side -1", (0.0, -1.0, 0.0)),
        ("2.25,0", RATES.name, (2.25, 0.0, 0.0)),
        ("1.5,0.5,-1", "1.5,0.5,-1", (1.5, 0.5, -1.0)),
    ],
)
def test_commands_are_read(text: str, name: str, command: tuple[float, ...]) -> None:
    assert parse_case(text) == Case(name=name, command=command)  # type: ignore[arg-type]


def test_paper_stands_for_five_commands() -> None:
    assert parse_cases(["paper", "2.25,0"]) == (*PAPER_COMMANDS, RATES)
    assert parse_cases([]) == ()


@pytest.mark.parametrize("text", ["", "1", "1,2,3,4", "fast", "1,nan", "inf,0"])
def test_bad_commands_are_refused(text: str) -> None:
    with pytest.raises(PronkError, match="command"):
        parse_case(text)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"stand_s": -1.0}, "Script.stand_s"),
        ({"stop_s": math.inf}, "Script.stop_s"),
        ({"run_s": math.nan}, "Script.run_s"),
        ({"command": (1.0, math.nan, 0.0)}, "command"),
    ],
)
def test_impossible_scripts_are_refused(changes: dict[str, Any], what: str) -> None:
    with pytest.raises(PronkError, match=what):
        script(**changes)
