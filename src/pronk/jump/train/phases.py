"""The phases of training as a curriculum term on the step counter (paper P1, P2).

Phase 1 walks, with the jump input held at zero. In phase 2 half of the robots are commanded to jump
now and then. In 2a equal foot forces are rewarded strongly, which turns a trot into a jump with all
feet at once; in 2b a tenth of that is left (Table II). The networks have the jump input from the
beginning; its weights are zero until phase 2, since an input of zeros has no gradient: the blank
neuron of the paper's widening (N3).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from pronk.errors import PronkError

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers import CurriculumTermCfg

NAME = "phases"
"""The curriculum term's name in every environment."""
STEPS_PER_ITERATION = 24
"""Policy steps of every robot between two updates of PPO."""

Span = tuple[float, float]
"""Values at the beginning and at the end of a phase."""
Changes = Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]]
"""`weights` and `jump_scales` of a recipe: spans by term and phase."""


@dataclass(frozen=True, kw_only=True)
class Phase:
    """What changes from phase to phase; each value moves linearly unless said otherwise."""

    jump: bool
    """Whether half of the robots get the jump input."""
    weights: Mapping[str, Span] = field(default_factory=dict)
    """Weights of rewards by name; the others keep those of `reward_weights`."""
    jump_scales: Mapping[str, Span] = field(default_factory=dict)
    """Their factors in jump mode."""
    liftoff_std: Span = (1.0, 1.0)
    """Standard deviation of the lift-off kernel [m/s]; the paper's expression has 1."""
    guidance: Span = (0.0, 0.0)
    """Fraction of the countermovement's guidance; falls fast at first and slowly at last, when
    there is little noise left to learn with."""
    noise: Span = (math.inf, math.inf)
    """Largest standard deviation of the actions; falls slowly at first and fast at last: with
    little noise a policy changes little in an iteration (PPO bounds a step in units of it)."""
    entropy: float = 0.005
    """Coefficient of PPO's entropy bonus."""
    estimator_rate: float = 1e-3
    """Learning rate of the estimator."""

    def largest_noise(self, done: float) -> float:
        """Largest standard deviation of the actions when a fraction of the phase is over."""
        start, end = self.noise
        if math.isinf(start):
            return math.inf
        return start * (end / start) ** done**2


_JUMP_A = {
    "sparse_jump": (16.0, 16.0),
    "flight_distance": (40.0, 40.0),
    "countermovement": (60.0, 60.0),
    "liftoff_angle": (4.0, 4.0),
    "height_by_speed": (16.0, 16.0),
}

PHASES: Mapping[str, Phase] = {
    "walk": Phase(jump=False),
    # Jumping has to be found, and a countermovement with it: policies that had learned to push
    # without one never came to it. Rewarded by the trunk's velocity alone, seven of eight trainings
    # found a jump 40 to 400 iterations into 2b, and one none. The entropy bonus alone would raise
    # the noise from .5 to 1.0 in 170 iterations.
    "jump_a": Phase(jump=True, weights=_JUMP_A, noise=(0.65, 0.65), guidance=(1.0, 0.7)),
    # Then alike every time: with a standard deviation of .59 after 560 iterations (.42 before the
    # first jump) a policy walks worse and its jumps scatter. The penalties of low landings and of
    # thighs and knees on the ground grow: in force before there is a jump, they might prevent it.
    # Jumps earn less, and the commanded velocity twice as much outside jump mode: with as much as
    # at first walking came to be .18 m/s too fast and turning .2 rad/s too slow.
    "jump_b": Phase(
        jump=True,
        weights={
            "tracking_linear": (2.25, 4.5),
            "sparse_jump": (16.0, 8.0),
            "flight_distance": (40.0, 38.0),
            "countermovement": (60.0, 0.0),
            "liftoff_angle": (4.0, 12.0),
            "height_by_speed": (16.0, 10.0),
            "landing": (0.0, -40.0),
        },
        jump_scales={
            "tracking_linear": (1.0, 0.5),
            "collision": (1.0, 9.0),
            "knees": (1.0, 10.0),
        },
        liftoff_std=(0.8, 0.25),
        entropy=0.0,
        noise=(0.65, 0.2),
        guidance=(0.7, 0.0),
        estimator_rate=3e-4,
    ),
}
"""The phases by name, in order. The paper's weights are 2.5 and 0.25 for dense and 250 for sparse;
in `PAPER_UNIT`s .125, .0125 and 12.5."""

TASKS: Mapping[str, Mapping[str, int]] = {
    "walk": {"walk": 300, "jump_a": 0, "jump_b": 0},
    "jump": {"walk": 300, "jump_a": 220, "jump_b": 560},
    "all": {"walk": 300, "jump_a": 220, "jump_b": 560},
    # The paper's ablation: to walk and to jump at once, with as many iterations in all.
    "together": {"walk": 0, "jump_a": 520, "jump_b": 560},
}
"""Iterations of each phase, by task; a task whose walk is 0 begins with jump_a."""


def phase_at(iterations: Mapping[str, int], iteration: int) -> tuple[str, float]:
    """Find the phase of an iteration.

    Args:
        iterations: Iterations of each phase.
        iteration: Number of the iteration, counted from 0.

    Returns:
        The phase, and the fraction of it that is over before; 1 beyond the last iteration.

    Raises:
        PronkError: There is no phase with iterations.
    """
    phases = [name for name, count in iterations.items() if count > 0]
    if not phases:
        raise PronkError("all phases have 0 iterations; expected 1 or more for one of them.")
    for name in phases:
        if iteration < iterations[name]:
            return name, iteration / iterations[name]
        iteration -= iterations[name]
    return phases[-1], 1.0


def changed_phases(changes: Changes) -> dict[str, Phase]:
    """Return the phases with the weights and jump scales of a recipe.

    Args:
        changes: `weights` and `jump_scales`, each by term and phase.
    """
    phases = dict(PHASES)
    for section in ("weights", "jump_scales"):
        for term, spans in changes.get(section, {}).items():
            for name, (start, end) in spans.items():
                phase = phases[name]
                if section == "weights":
                    weights = {**phase.weights, term: (start, end)}
                    phases[name] = replace(phase, weights=weights)
                else:
                    scales = {**phase.jump_scales, term: (start, end)}
                    phases[name] = replace(phase, jump_scales=scales)
    return phases


class Curriculum:
    """Curriculum term: sets the rewards and the command term to the phase of the iteration.

    mjlab calls it whenever a robot resets, the runner at the beginning of every iteration.
    """

    def __init__(self, cfg: CurriculumTermCfg, env: ManagerBasedRlEnv) -> None:
        """Remember the rewards' weights and parameters without any phase."""
        self.iterations = {name: cfg.params[name] for name in PHASES}
        self.steps_per_iteration: int = cfg.params["steps_per_iteration"]
        self.phases = changed_phases(cfg.params.get("changes") or {})
        """The phases by name, with the changes of a recipe."""
        self._iteration = -1
        self._weights: dict[str, float] = {}
        self._params: dict[str, dict[str, Any]] = {}
        for name, term in env.cfg.rewards.items():
            self._weights[name] = term.weight
            self._params[name] = dict(term.params)

    def restart(self) -> None:
        """Set the phase again when next called, as a reward manager that was replaced needs it."""
        self._iteration = -1

    @property
    def total(self) -> int:
        """Number of iterations of all phases."""
        return sum(self.iterations.values())

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        env_ids: Any,
        walk: int,
        jump_a: int,
        jump_b: int,
        steps_per_iteration: int,
        changes: Changes | None = None,
    ) -> dict[str, float]:
        """Apply the phase.

        Args:
            env: The environment.
            env_ids: Robots that reset; all robots have one phase.
            walk: Iterations of that phase, read at the beginning.
            jump_a: The same.
            jump_b: The same.
            steps_per_iteration: Policy steps of an iteration, read at the beginning.
            changes: What a recipe changes, read at the beginning; see `changed_phases`.

        Returns:
            What is logged: number of the phase, and the fraction of it that is over.
        """
        iteration = env.common_step_counter // self.steps_per_iteration
        name, done = phase_at(self.iterations, iteration)
        if iteration != self._iteration:
            self._iteration = iteration
            self.apply(env, self.phases[name], done)
        return {"phase": float(list(PHASES).index(name)), "done": done}

    def apply(self, env: ManagerBasedRlEnv, phase: Phase, done: float) -> None:
        """Set a phase of which a fraction is over, whatever the step counter."""
        from pronk.jump.train.mdp.commands import motion_command

        for name, weight in self._weights.items():
            term = env.reward_manager.get_term_cfg(name)
            term.weight = weight
            if name in phase.weights:
                term.weight = _between(phase.weights[name], done)
            term.params.update(self._params[name])
            if "jump_scale" not in self._params[name]:
                # That of the phase before.
                term.params.pop("jump_scale", None)
            if name in phase.jump_scales:
                term.params["jump_scale"] = _between(phase.jump_scales[name], done)
        command = motion_command(env)
        command.state.set_liftoff_std(_between(phase.liftoff_std, done))
        command.cfg.jump_fraction = 0.5 if phase.jump else 0.0
        start, end = phase.guidance
        command.guidance_scale = end + (start - end) * (1.0 - done) ** 2


def curriculum(env: ManagerBasedRlEnv) -> Curriculum:
    """Return the curriculum term of an environment."""
    term = env.curriculum_manager.get_term_cfg(NAME).func
    assert isinstance(term, Curriculum)
    return term


def _between(span: Span, done: float) -> float:
    """Return the value of a phase of which a fraction is over."""
    start, end = span
    return start + (end - start) * done
