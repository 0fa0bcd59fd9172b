"""The script of a run and the names of commands."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pronk.errors import PronkError
from pronk.jump.trial.protocol import PAPER_COMMANDS, RATES, Case, parse_cases
from pronk.policy.script import STILL, Script

COMMAND = (2.0, 0.0, 0.5)


def test_commands_over_time_by_hand_and_despite_rounding() -> None:
    script = Script(command=COMMAND)
    assert (script.start, script.on, script.off) == (1.0, 3.5, 4.0)
    assert (script.stop, script.seconds) == (4.5, 7.5)
    for ticks in range(26):
        script = Script(command=COMMAND, run_s=2.5 + ticks / 50)
        commands = []
        jump_ticks = []
        for tick in range(round(script.seconds * 50)):
            command, jump = script.commanded(tick / 50)
            commands.append(command)
            if jump:
                jump_ticks.append(tick)
        assert commands == [STILL] * 50 + [COMMAND] * (175 + ticks) + [STILL] * 150
        assert jump_ticks == list(range(175 + ticks, 200 + ticks))


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
    expected = Case(name=name, command=command)  # type: ignore[arg-type]
    assert parse_cases([text, "paper"]) == (expected, *PAPER_COMMANDS)


@pytest.mark.parametrize("text", ["", "1", "1,2,3,4", "fast", "1,nan", "inf,0"])
def test_bad_commands_are_refused(text: str) -> None:
    with pytest.raises(PronkError, match="command"):
        parse_cases([text])


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"stand_s": -1.0}, "Script.stand_s"),
        ({"stop_s": math.inf}, "Script.stop_s"),
        ({"run_s": math.nan}, "Script.run_s"),
        ({"command": (1.0, math.nan, 0.0)}, "command"),
    ],
)
def test_impossible_scripts_are_refused(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(PronkError, match=named):
        Script(**({"command": COMMAND} | changes))
