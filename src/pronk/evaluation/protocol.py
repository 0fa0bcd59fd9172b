"""The commands of a trial: a name and a velocity each."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from pronk.errors import PronkError
from pronk.runtime.script import Velocity, check_velocity


@dataclass(frozen=True, kw_only=True)
class Case:
    """A velocity at which jumps are commanded."""

    name: str
    command: Velocity
    """Forward, left [m/s], yaw rate [rad/s], in the trunk's frame."""

    def __post_init__(self) -> None:
        """Refuse a command that is not three finite numbers.

        Raises:
            PronkError: Not three finite numbers.
        """
        check_velocity(self.command, f"case {self.name!r}")


PAPER_COMMANDS = (
    Case(name="forward 1", command=(1.0, 0.0, 0.0)),
    Case(name="forward 2", command=(2.0, 0.0, 0.0)),
    Case(name="side -1", command=(0.0, -1.0, 0.0)),
    Case(name="side +1", command=(0.0, 1.0, 0.0)),
    Case(name="back 2", command=(-2.0, 0.0, 0.0)),
)
"""The jumps of Table III of the paper. Positive sideways is to the left: the paper does not define
it, and its robot is symmetric."""

RATES = Case(name="forward 2.25", command=(2.25, 0.0, 0.0))
"""Of the paper's figure of roll and pitch rates (R7)."""


def parse_cases(texts: Iterable[str]) -> tuple[Case, ...]:
    """The cases of several commands, in their order; `paper` stands for the paper's five.

    Raises:
        PronkError: As `parse_case`.
    """
    return tuple(
        case
        for text in texts
        for case in (PAPER_COMMANDS if text.strip() == "paper" else (parse_case(text),))
    )


def parse_case(text: str) -> Case:
    """The case of a command written as `1,0,0`; one of the paper's keeps its name.

    Args:
        text: Forward and left [m/s] and, if it is not zero, yaw rate [rad/s], between commas.

    Raises:
        PronkError: Not two or three finite numbers.
    """
    try:
        values = [float(part) for part in text.split(",")]
        if len(values) not in (2, 3) or not all(map(math.isfinite, values)):
            raise ValueError
    except ValueError:
        raise PronkError(
            f"command {text!r}; expected two or three numbers between commas, forward and left "
            'velocity [m/s] and yaw rate [rad/s], as in "1,0,0".'
        ) from None
    forward, left, yaw = (*values, 0.0)[:3]
    command = (forward, left, yaw)
    known = [case for case in (*PAPER_COMMANDS, RATES) if case.command == command]
    return known[0] if known else Case(name=",".join(f"{v:g}" for v in command), command=command)
