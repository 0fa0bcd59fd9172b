"""The phases of training: walk, then jump with a strong hint, then with a weak one (P1, P2).

Phase 1 walks. The networks are then widened by the jump input, and in phase 2 half of the robots
are commanded to jump now and then. In 2a equal feet are rewarded strongly, which is what makes a
trot
leave the ground with all feet at once; in 2b a tenth of that is left (Table II).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from pronk.errors import PronkError
from pronk.train.mdp.commands import NAME, MotionCommandCfg, motion_command
from pronk.train.mdp.reward_sum import NAME as TABLE
from pronk.train.mdp.reward_sum import reward_sum
from pronk.train.mdp.reward_table import ROWS, JumpWeights, with_jump_weights

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg

_NO_JUMP = JumpWeights(
    dense=0.0,
    sparse=0.0,
    width=1.0,
    rise=0.0,
    reach=0.0,
    gap=0.0,
    countermovement=0.0,
    hop=0.0,
    collision=-ROWS["collision"].jump,
    knees=-ROWS["knees"].jump,
    landing=0.0,
)


@dataclass(frozen=True, kw_only=True)
class Phase:
    """One stretch of training with its own commands and rewards."""

    name: str
    iterations: int
    """PPO iterations."""
    jump: bool
    """Whether the networks read the jump input, and half of the robots get it."""
    weights: JumpWeights = _NO_JUMP
    final: JumpWeights | None = None
    """What they come to, evenly over the iterations; None: they stay."""
    entropy: float = 0.005
    """Coefficient of PPO's entropy bonus: how much exploring is worth."""
    noise: tuple[float, float] | None = None
    """Largest standard deviation of the network's actions, at first and at last; None: any."""
    led: tuple[float, float] = (0.0, 0.0)
    """Part of a countermovement's guidance that robots are given, at first and at last."""
    estimator_rate: float = 1e-3
    """Learning rate of the estimator."""

    @property
    def changes(self) -> bool:
        """Whether what `enter_phase` sets goes on changing while it lasts."""
        return self.final is not None or self.led[0] != self.led[1]

    @property
    def jump_fraction(self) -> float:
        """Part of the robots that get the jump input."""
        return 0.5 if self.jump else 0.0

    def __post_init__(self) -> None:
        """Refuse a phase of no iterations, noise of none, and more guidance than all of it."""
        if self.iterations < 1:
            raise PronkError(f"phase {self.name} has {self.iterations} iterations; 1 or more.")
        if not all(0.0 <= part <= 1.0 for part in self.led):
            raise PronkError(f"phase {self.name} leads by {self.led}; both must be 0 to 1.")
        if self.noise is not None and not all(limit > 0.0 for limit in self.noise):
            raise PronkError(f"phase {self.name} has noise {self.noise}; both must be positive.")

    def weights_at(self, done: float) -> JumpWeights:
        """The weights when a part of the phase is over.

        Args:
            done: That part, 0 to 1.
        """
        if self.final is None:
            return self.weights
        now = {}
        for name in (entry.name for entry in fields(JumpWeights)):
            first, last = getattr(self.weights, name), getattr(self.final, name)
            now[name] = float(np.interp(done, (0.0, 1.0), (first, last)))
        return JumpWeights(**now)

    def led_at(self, done: float) -> float:
        """Part of the guidance that is given when a part of the phase is over.

        It falls fast at first and slowly at last, when there is little noise left to learn with.

        Args:
            done: That part, 0 to 1.
        """
        first, last = self.led
        return last + (first - last) * (1.0 - done) ** 2

    def largest_noise(self, done: float) -> float:
        """Largest standard deviation of the network's actions; slow at first, fast in the end.

        The less noise, the less a policy may change in an iteration (PPO's step is bound in units
        of it): with the noise falling by as much every time, jumps grew no further from the middle
        of the phase on.

        Args:
            done: Part of the phase that is over, 0 to 1.
        """
        if self.noise is None:
            return math.inf
        first, last = self.noise
        return first * (last / first) ** done**2


_WEAK = JumpWeights(
    dense=0.002,
    sparse=16.0,
    width=0.8,
    rise=16.0,
    reach=28.0,
    gap=12.0,
    countermovement=60.0,
    hop=1.0,
    collision=5.0,
    knees=3.0,
    landing=0.0,
)
"""Of 2b, as it begins."""
PHASES: tuple[Phase, ...] = (
    Phase(name="walk", iterations=300, jump=False),
    # Jumping has to be found, and a countermovement at once: policies that had learned to push
    # without one never came to it. Hinted at by the trunk's velocity nothing was learned here:
    # seven of eight trainings found a jump 40 to 400 iterations into 2b, whose kernel said nothing
    # (width .3) of jumps as slow as theirs, and one none; what was found late was not done well by
    # the end. So robots are led at first, the hint is for each leg and goes on into 2b, and the
    # kernel narrows there.
    # The entropy bonus alone would drive the noise from .5 to 1.0 in 170 iterations.
    Phase(
        name="jump_a",
        iterations=220,
        jump=True,
        weights=replace(_WEAK, dense=0.02, width=1.0),
        noise=(0.65, 0.65),
        led=(1.0, 0.7),
    ),
    # And then done alike every time: an actor that explores on (its standard deviation .59 after
    # 560 iterations, .42 before the first jump) walks worse and scatters. Landing as it goes
    # backwards, a robot stands until its thighs are on the ground, a centimetre of way at 5 a
    # second: 6 of 20 such landings were well. Commanded for before there is a jump, it might teach
    # that
    # there be none, so it comes to cost more; 60, 40 and 100 made 280 of 300 landings well, of
    # three seeds, but the first fell to .11 m and lost .8 of 2.4 m/s. What jumps are worth falls:
    # with as much as at first walking came to be .18 m/s too fast, turning .2 rad/s too slow; led,
    # and with worth down to 10, 8, 22 and 9, it was within .1 m/s and .1 rad/s.
    Phase(
        name="jump_b",
        iterations=560,
        jump=True,
        weights=_WEAK,
        final=replace(
            _WEAK,
            sparse=12.0,
            width=0.25,
            rise=10.0,
            reach=28.0,
            gap=11.0,
            countermovement=0.0,
            collision=45.0,
            knees=30.0,
            landing=40.0,
        ),
        entropy=0.0,
        noise=(0.65, 0.2),
        # A small network and 2,048 robots: lift-offs earned .47 a second, and rising, after 62
        # iterations with all of the guidance, .09 where it was let go of by then.
        led=(0.7, 0.0),
        estimator_rate=3e-4,
    ),
)
"""The paper's phases. Its weights are 2.5 and 0.25 for dense and 250 for sparse, in `PAPER_UNIT`s
.125, .0125 and 12.5."""


def phase(name: str) -> Phase:
    """The phase called `name`.

    Raises:
        PronkError: There is none; the message lists those there are.
    """
    for candidate in PHASES:
        if candidate.name == name:
            return candidate
    raise PronkError(f"no phase {name!r}; the phases are {', '.join(p.name for p in PHASES)}.")


def with_iterations(iterations: Mapping[str, int]) -> tuple[Phase, ...]:
    """`PHASES` with other numbers of iterations.

    Args:
        iterations: By name of the phase; those left out keep theirs.

    Raises:
        PronkError: A name is unknown or a number is below 1.
    """
    for name in iterations:
        phase(name)
    return tuple(replace(p, iterations=iterations.get(p.name, p.iterations)) for p in PHASES)


def configure_phase(cfg: ManagerBasedRlEnvCfg, phase: Phase) -> None:
    """Set a phase in the configuration of an environment that is yet to be built."""
    command = cfg.commands[NAME]
    assert isinstance(command, MotionCommandCfg)
    command.width = phase.weights.width
    command.jump_fraction = phase.jump_fraction
    cfg.rewards[TABLE].params["rows"] = with_jump_weights(ROWS, phase.weights)


def enter_phase(env: ManagerBasedRlEnv, phase: Phase, done: float = 0.0) -> None:
    """Set a phase in a living environment.

    Args:
        env: Built from `pronk.train.tasks.env_cfg`.
        phase: Which.
        done: Part of it that is over, 0 to 1.
    """
    command, table = motion_command(env), reward_sum(env)
    weights = phase.weights_at(done)
    command.tracker.width = weights.width
    command.cfg.jump_fraction = phase.jump_fraction
    command.led = phase.led_at(done)
    table.set_rows(with_jump_weights(table.rows, weights))
