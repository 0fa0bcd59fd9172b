"""What a robot is asked in a trial, and when (paper E1): stand, accelerate, jump, stop.

Times count from the moment at which the policy takes over a standing robot:

    0 ... stand_s       zero command
    ... + run_s         the velocity command (at once, or by a ramp)
    ... + jump_s        the same with the jump input
    ... + keep_s        the same without it: the robot may still be in the air
    ... + stop_s        zero command (at once, or by the same ramp)
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from pronk.errors import PronkError
from pronk.policy import paper
from pronk.policy.contract import COMMANDS

Velocity = tuple[float, float, float]
"""Forward, left [m/s], yaw rate [rad/s], in the trunk's frame."""
Asked = tuple[Velocity, bool]
"""Velocity command and jump input."""

STILL: Velocity = (0.0, 0.0, 0.0)

_SLACK = 1e-9
"""Forgives the binary fractions of sums of times [s]."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A velocity at which the robot is told to jump."""

    name: str
    command: Velocity
    """Forward, left [m/s], yaw rate [rad/s], in the trunk's frame."""

    def __post_init__(self) -> None:
        """Refuse a command that is none.

        Raises:
            PronkError: Not three finite numbers.
        """
        if len(self.command) != 3 or not all(map(math.isfinite, self.command)):
            raise PronkError(
                f"command {self.command} of case {self.name!r}; expected three finite numbers: "
                f"{', '.join(COMMANDS)}."
            )


PAPER_COMMANDS = tuple(Case(name=name, command=told) for name, told in paper.JUMPS.items())
"""The paper's five."""

RATES = Case(name="forward 2.25", command=(2.25, 0.0, 0.0))
"""At which the paper draws roll and pitch rates (R7)."""


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


@dataclass(frozen=True, kw_only=True)
class Script:
    """What one robot is asked over time."""

    command: Velocity
    """Forward, left [m/s], yaw rate [rad/s], in the trunk's frame."""
    stand_s: float = 1.0
    """Before the robot is told to run [s]."""
    run_s: float = 2.5
    """From there to the jump input [s]."""
    jump_s: float = 0.5
    """Length of the jump input [s]; 0 for a robot that only runs."""
    keep_s: float = 0.5
    """From its end to the command to stop [s]."""
    stop_s: float = 3.0
    """From there to the end [s]: long enough to see whether the robot stays upright."""
    acceleration: float = math.inf
    """Of the command on its way up and down [m/s^2]; infinite: a step, as the policy was
    trained."""

    def __post_init__(self) -> None:
        """Refuse impossible times.

        Raises:
            PronkError: One sentence that names the field.
        """
        Case(name="script", command=self.command)
        for name in ("stand_s", "run_s", "jump_s", "keep_s", "stop_s"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise PronkError(f"Script.{name} is {value}; it must be finite, not negative.")
        if not self.acceleration > 0.0:
            raise PronkError(f"Script.acceleration is {self.acceleration}; it must be positive.")

    @property
    def start(self) -> float:
        """When the robot is told to run [s]."""
        return self.stand_s

    @property
    def on(self) -> float:
        """When the jump input rises [s]."""
        return self.start + self.run_s

    @property
    def off(self) -> float:
        """When it falls [s]."""
        return self.on + self.jump_s

    @property
    def stop(self) -> float:
        """When the robot is told to stop [s]."""
        return self.off + self.keep_s

    @property
    def seconds(self) -> float:
        """Length of the whole [s]."""
        return self.stop + self.stop_s

    def asked(self, t: float) -> Asked:
        """What is asked at a time.

        Args:
            t: Since the policy took over [s].

        Returns:
            The velocity command, and whether the jump input is on.
        """
        forward, left, yaw = self.command
        now = t + _SLACK
        share = self._share(now)
        return (share * forward, share * left, share * yaw), self.on <= now < self.off

    def _share(self, t: float) -> float:
        """Of the command, 0 to 1."""
        if not self.start <= t < self.seconds:
            return 0.0
        length = math.hypot(*self.command[:2]) / self.acceleration
        if length == 0.0:
            return float(t < self.stop)
        up = min(1.0, (min(t, self.stop) - self.start) / length)
        return max(0.0, up - max(0.0, t - self.stop) / length)
