"""The script of one run (paper E1): stand, accelerate, jump, stop.

Times count from the moment at which the policy starts on a standing robot:

    0 ... stand_s       zero command
    ... + run_s         the velocity command
    ... + jump_s        the same with the jump input
    ... + keep_s        the same without it: the robot may still be in the air
    ... + stop_s        zero command
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from pronk.errors import PronkError
from pronk.policy.contract import COMMANDS

Velocity = tuple[float, float, float]
"""Forward, left [m/s], yaw rate [rad/s], in the trunk's frame."""
Commanded = tuple[Velocity, bool]
"""Velocity command and jump input."""
STILL: Velocity = (0.0, 0.0, 0.0)
PAPER_VELOCITIES: Mapping[str, Velocity] = {
    "forward 1": (1.0, 0.0, 0.0),
    "forward 2": (2.0, 0.0, 0.0),
    "side -1": (0.0, -1.0, 0.0),
    "side +1": (0.0, 1.0, 0.0),
    "back 2": (-2.0, 0.0, 0.0),
}
"""Velocity commands of the jumps of Table III of the paper, by name. Positive sideways is to the
left: the paper does not define the side, and its robot is symmetric."""

_SLACK = 1e-9
"""Tolerance for rounding in sums of times [s]."""


def parse_velocity(text: str) -> Velocity:
    """Read a velocity command such as `1,0` or `1,0,0`: forward, left [m/s], yaw rate [rad/s]."""
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) == 2:
        values.append(0.0)
    if len(values) != 3 or not all(map(math.isfinite, values)):
        raise PronkError(
            f"command {text!r}; expected two or three numbers between commas, forward and left "
            'velocity [m/s] and yaw rate [rad/s], as in "1,0,0".'
        )
    forward, left, yaw = values
    return forward, left, yaw


@dataclass(frozen=True, kw_only=True)
class Script:
    """The commands of one run."""

    command: Velocity
    """Forward, left [m/s], yaw rate [rad/s], in the trunk's frame."""
    stand_s: float = 1.0
    run_s: float = 2.5
    jump_s: float = 0.5
    """0 for no jump."""
    keep_s: float = 0.5
    stop_s: float = 3.0
    """Long enough to see whether the robot stays upright."""

    def __post_init__(self) -> None:
        if len(self.command) != 3 or not all(map(math.isfinite, self.command)):
            raise PronkError(
                f"command {self.command} of the script; expected three finite numbers: "
                f"{', '.join(COMMANDS)}."
            )
        for name in ("stand_s", "run_s", "jump_s", "keep_s", "stop_s"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise PronkError(f"Script.{name} is {value}; it must be finite, not negative.")

    @property
    def start(self) -> float:
        """Begin of the velocity command [s]."""
        return self.stand_s

    @property
    def on(self) -> float:
        """Rise of the jump input [s]."""
        return self.start + self.run_s

    @property
    def off(self) -> float:
        """Fall of the jump input [s]."""
        return self.on + self.jump_s

    @property
    def stop(self) -> float:
        """End of the velocity command [s]."""
        return self.off + self.keep_s

    @property
    def seconds(self) -> float:
        """Length of the script [s]."""
        return self.stop + self.stop_s

    def commanded(self, t: float) -> Commanded:
        """Velocity command and jump input at a time since the policy started [s]."""
        now = t + _SLACK
        moving = self.start <= now < self.stop
        return (self.command if moving else STILL), self.on <= now < self.off
