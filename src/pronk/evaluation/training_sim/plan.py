"""The commands of an evaluation in the training simulator, robot by robot.

Walking robots have one velocity from the first sample on. Jumping robots do what the paper's robot
did (E1): stand, accelerate, jump while running, run on for a moment, stop. The jump input rises at
each robot's own time, so that it meets every phase of the gait.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.evaluation.jumps import JumpRules, steps
from pronk.evaluation.protocol import PAPER_COMMANDS, Case

NEVER = 2**30
"""A sample that does not come."""
WALKS = (
    Case(name="forward 2", command=(2.0, 0.0, 0.0)),
    Case(name="back 2", command=(-2.0, 0.0, 0.0)),
    Case(name="left 1", command=(0.0, 1.0, 0.0)),
    Case(name="right 1", command=(0.0, -1.0, 0.0)),
    Case(name="forward 3", command=(3.0, 0.0, 0.0)),
    Case(name="back 3", command=(-3.0, 0.0, 0.0)),
    Case(name="yaw 2", command=(0.0, 0.0, 2.0)),
    Case(name="yaw -2", command=(0.0, 0.0, -2.0)),
    Case(name="stand", command=(0.0, 0.0, 0.0)),
)
"""Velocities to keep."""
JUMPS = PAPER_COMMANDS


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The whole evaluation."""

    robots: int = 1000
    """Robots for each command."""
    seed: int = 0
    """Of noise, pushes, starts and the times of the jumps."""
    walks: tuple[Case, ...] = WALKS
    jumps: tuple[Case, ...] = JUMPS
    walk_s: float = 20.0
    """Length of a walk [s]."""
    settle_s: float = 2.0
    """Time to accelerate, left out of the errors [s]."""
    average_s: float = 0.5
    """Window of the moving average, which takes the stride out of the velocity [s]."""
    stand_s: float = 1.0
    """Of a jumping robot, before the velocity command [s]."""
    run_s: float = 2.5
    """From there to the jump input, at least [s]."""
    spread_s: float = 0.5
    """The jump input rises up to this much later, uniformly [s]."""
    jump_s: float = 0.5
    """Its length [s]."""
    keep_s: float = 0.5
    """From its end to the zero command [s]."""
    rules: JumpRules = field(default_factory=JumpRules)

    def __post_init__(self) -> None:
        """Refuse an empty plan, or impossible times.

        Raises:
            PronkError: One sentence that names the field.
        """
        if self.robots < 1:
            raise PronkError(f"{self.robots} robots for each command; expected 1 or more.")
        if not self.walks and not self.jumps:
            raise PronkError("the evaluation has neither walks nor jumps; it needs one of them.")
        for name in ("walk_s", "average_s", "run_s", "jump_s"):
            if not getattr(self, name) > 0.0:
                raise PronkError(f"Plan.{name} is {getattr(self, name)}; it must be positive.")
        for name in ("settle_s", "stand_s", "spread_s", "keep_s"):
            if not getattr(self, name) >= 0.0:
                raise PronkError(f"Plan.{name} is {getattr(self, name)}; it must not be negative.")
        if self.walks and not self.average_s <= self.settle_s < self.walk_s:
            raise PronkError(
                f"walks of {self.walk_s:g} s, of which {self.settle_s:g} s to settle, with a "
                f"moving average of {self.average_s:g} s; settling must hold the average and end "
                "before the walk."
            )

    @property
    def size(self) -> int:
        """Robots in all: first those of each walk, then those of each jump."""
        return self.robots * (len(self.walks) + len(self.jumps))

    @property
    def walkers(self) -> int:
        """Robots that walk."""
        return self.robots * len(self.walks)

    @property
    def jump_seconds(self) -> float:
        """Time until the latest jump is judged [s]; a flight takes less than 1 s."""
        latest = self.stand_s + self.run_s + self.spread_s
        return latest + self.rules.search_s + 1.0 + self.rules.upright_s if self.jumps else 0.0

    @property
    def seconds(self) -> float:
        """Simulated time [s]."""
        return max(self.walk_s if self.walks else 0.0, self.jump_seconds)

    def commands(self) -> NDArray[np.float64]:
        """The velocity command of each robot. (N, 3)."""
        commands = [case.command for case in (*self.walks, *self.jumps)]
        return np.repeat(np.array(commands, dtype=float), self.robots, axis=0)

    def times(self, dt: float) -> dict[str, NDArray[np.int64]]:
        """Return the times of each robot's commands, in samples of `dt`; each of shape (N,).

        Returns:
            `start` and `stop` of the velocity command, `on` and `off` of the jump input; `NEVER`
            for what does not happen.
        """
        count = self.size - self.walkers
        rng = np.random.default_rng(self.seed)
        on = np.rint((self.stand_s + self.run_s + self.spread_s * rng.random(count)) / dt)
        off = on + steps(self.jump_s, dt)
        jumping = {
            "start": np.full(count, steps(self.stand_s, dt)),
            "stop": off + steps(self.keep_s, dt),
            "on": on,
            "off": off,
        }
        walking = {"start": 0, "stop": NEVER, "on": NEVER, "off": NEVER}
        return {
            name: np.concatenate([np.full(self.walkers, walking[name]), times]).astype(np.int64)
            for name, times in jumping.items()
        }
