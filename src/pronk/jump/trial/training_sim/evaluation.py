"""The commands of an evaluation in the training simulator, and its figures.

Walking robots have one velocity from the first sample on. Jumping robots do what the paper's robot
did (E1): stand, accelerate, jump while running, run on for a moment, stop. The jump input rises at
each robot's own time, so that it meets every phase of the gait.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.jump.trial.jumps import JumpRules
from pronk.jump.trial.protocol import PAPER_COMMANDS, Case, named
from pronk.jump.trial.results import Spread
from pronk.policy.script import STILL, Script
from pronk.robots.robot import RobotSpec

Samples = NDArray[np.int64]

NEVER = 2**30
"""A sample that does not come."""
SIMULATED_BYTES = 270_000
"""Memory of one robot in the simulator [bytes]: 14,000 robots took 3.7 GB on the CPU."""
RECORDED_BYTES = 58
"""Memory of one robot and sample of the recording [bytes]: 13 numbers, the state, contacts."""
WALKS = named(
    "forward 2",
    "back 2",
    "left 1",
    "right 1",
    "forward 3",
    "back 3",
    "yaw 2",
    "yaw -2",
    "stand",
)
"""Velocities to keep."""
ROBOT_WALKS: Mapping[str, tuple[Case, ...]] = {
    "go2": named("forward 2", "back 2", "left 0.8", "right 0.8", "yaw 2", "yaw -2", "stand"),
}
"""Velocities of robots with other ranges."""
JUMPS = PAPER_COMMANDS
"""Commands to jump with."""


@dataclass(frozen=True, kw_only=True)
class EvaluationPlan:
    """The commands of an evaluation, and their times."""

    robot: RobotSpec
    """The robot."""
    robots: int = 1000
    """Number of robots for each command."""
    seed: int = 0
    """Seed of noise, pushes, starts and the times of the jumps."""
    walks: tuple[Case, ...] = WALKS
    """Commands to walk with."""
    jumps: tuple[Case, ...] = JUMPS
    """Commands to jump with."""
    walk_s: float = 20.0
    """Duration of a walk [s]."""
    settle_s: float = 2.0
    """Time to accelerate, left out of the errors [s]."""
    script: Script = field(default_factory=lambda: Script(command=STILL))
    """Times of a jump; the command is each case's."""
    spread_s: float = 0.5
    """The jump input rises up to this much later, uniformly [s]."""
    rules: JumpRules | None = None
    """Definition of a jump; None for the robot's."""

    def __post_init__(self) -> None:
        """Raise `PronkError` for an empty plan."""
        if self.robots < 1:
            raise PronkError(f"{self.robots} robots for each command; expected 1 or more.")

    @property
    def jump_rules(self) -> JumpRules:
        """Definition of a jump: `rules`, or those of the robot."""
        return self.rules or JumpRules.of(self.robot)

    @property
    def size(self) -> int:
        """Number of robots in all: first those of each walk, then those of each jump."""
        return self.robots * (len(self.walks) + len(self.jumps))

    @property
    def walkers(self) -> int:
        """Number of robots that walk."""
        return self.robots * len(self.walks)

    @property
    def jump_seconds(self) -> float:
        """Time until the latest jump is measured [s]; a flight takes less than 1 s."""
        after = self.jump_rules.search_s + 1.0 + self.jump_rules.upright_s
        return self.script.on + self.spread_s + after if self.jumps else 0.0

    @property
    def seconds(self) -> float:
        """Simulated time [s]."""
        return max(self.walk_s if self.walks else 0.0, self.jump_seconds)

    def memory_bytes(self, dt: float) -> float:
        """Return the memory that simulator and recording need, with samples of `dt` [bytes]."""
        samples = round(self.seconds / dt)
        return self.size * (SIMULATED_BYTES + RECORDED_BYTES * samples)

    def commands(self) -> Array:
        """Return the velocity command of each robot. (N, 3)."""
        commands = [case.command for case in (*self.walks, *self.jumps)]
        return np.repeat(np.array(commands, dtype=float), self.robots, axis=0)

    def times(self, dt: float) -> dict[str, Samples]:
        """Return `start` and `stop` of the velocity command, `on` and `off` of the jump input.

        For each robot, in samples of `dt`, (N,); `NEVER` for what does not happen.
        """
        delays = np.random.default_rng(self.seed).random(self.size - self.walkers)
        on = np.full(self.size, NEVER)
        on[self.walkers :] = np.rint((self.script.on + self.spread_s * delays) / dt)
        jumping = on < NEVER
        off = np.where(jumping, on + round(self.script.jump_s / dt), NEVER)
        return {
            "start": np.where(jumping, round(self.script.start / dt), 0),
            "stop": np.where(jumping, off + round(self.script.keep_s / dt), NEVER),
            "on": on,
            "off": off,
        }


@dataclass(frozen=True, kw_only=True)
class CommandResult:
    """All robots of one command."""

    name: str
    """Name of the command."""
    command: tuple[float, float, float]
    """Forward, left [m/s], yaw rate [rad/s]."""
    figures: Mapping[str, Spread]
    """Each figure over the robots that have it; the mean of a flag is its share.

    Numbers of `pronk.jump.trial.jumps` and `walk`; `drift` from the end of settling to the end [m];
    `uncommanded`: the highest flight without a jump input, over standing height [m]. Flags: `fell`,
    `non_finite` (its physics diverged); of jumps `standing` (had not fallen when the jump input
    came), `found` (jumped), `upright` (and were so 2 s after touchdown), `non_foot_contact` (from
    the jump input to then), and of those standing `single` (made exactly one high flight)."""

    def __getitem__(self, name: str) -> Spread:
        """Return a figure; without values if no robot has it."""
        return self.figures.get(name, Spread())


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """The whole evaluation, and what it rests on."""

    walks: tuple[CommandResult, ...]
    """Results of the walks."""
    jumps: tuple[CommandResult, ...]
    """Results of the jumps."""
    estimator: Mapping[str, float]
    """Errors of the estimator over all walks, standing included: root mean square error of the
    velocity [m/s] by axis (`forward`, `left`, `up`) and of the vector (`velocity`), and the share
    of feet and policy steps at which the contact estimate is right (`contacts_right`). Empty
    without estimator or walks."""
    plan: Mapping[str, Any]
    """Fields of the plan."""
    seconds: float
    """Wall time [s]."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """The policy, gains, randomization, device and versions."""
    before: Mapping[str, float] = field(default_factory=dict)
    """Speed errors of the policy before the jump phases, by walk [m/s]; empty if not compared."""

    def speed_errors(self) -> dict[str, float]:
        """Return the mean speed error by walk [m/s]."""
        return {walk.name: walk["speed_error"].mean for walk in self.walks}
