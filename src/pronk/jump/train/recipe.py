"""Recipes: what a training changes in its rewards and in what a good jump is, as data.

    schema: pronk/recipe/1
    rewards:                      # weights by term; 0 removes the term
      stray_foot: 0               # in all phases
      flight_distance: {jump_a: 28, jump_b: [28, 40]}   # in a phase; from its beginning to its end
    jump_scales:                  # factor of the weight in jump mode, likewise
      orientation: 1
    jump:                         # fields of `JumpSettings`, `speed_added`, `guidance_sweep`
      late_s: 0.25

What a recipe does not name stays as the task has it. `pronk train --recipe FILE` applies it to the
configuration of any robot's task, after the robot's own changes.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from pronk.errors import ArtefactError, PronkError
from pronk.files import read_yaml, sha256
from pronk.jump.train.phases import NAME as PHASES_NAME
from pronk.jump.train.phases import PHASES, Span

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnvCfg

SCHEMA = "pronk/recipe/1"
SPEED_ADDED = "speed_added"
"""Entry of `jump` that is no field of `JumpSettings`: how much faster than commanded a robot is
rewarded for in jump mode (`MotionCommandCfg.jump_speed_added`) [m/s]."""
GUIDANCE_SWEEP = "guidance_sweep"
"""Another one: `MotionCommandCfg.guidance_sweep`."""

_Value = float | dict[str, float | tuple[float, float]]
"""A number, or one by phase: a number, or its values at the beginning and at the end."""
Spans = Mapping[str, Mapping[str, Span]]
"""Values at the beginning and at the end of a phase, by term and phase."""


class _File(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """Content of a file."""

    schema: str
    rewards: dict[str, _Value] = {}
    jump_scales: dict[str, _Value] = {}
    jump: dict[str, float] = {}


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Changes of a task's rewards and of its definition of a good jump."""

    weights: Spans = field(default_factory=dict)
    """Weights of terms in the phases that are named."""
    jump_scales: Spans = field(default_factory=dict)
    """Factors of the weights in jump mode, likewise."""
    jump: Mapping[str, float] = field(default_factory=dict)
    """Fields of `JumpSettings`, `SPEED_ADDED` and `GUIDANCE_SWEEP`."""
    source: str = ""
    """The file, for messages."""
    sha256: str = ""
    """Hash of the file."""

    @property
    def removed(self) -> tuple[str, ...]:
        """Terms whose weight is 0 in all phases."""
        names = []
        for name, spans in self.weights.items():
            nothing = all(span == (0.0, 0.0) for span in spans.values())
            if nothing and len(spans) == len(PHASES):
                names.append(name)
        return tuple(names)

    def record(self) -> dict[str, Any]:
        """Return what the provenance of a run holds of the recipe."""
        return {
            "file": Path(self.source).name,
            "sha256": self.sha256,
            "weights": _plain(self.weights),
            "jump_scales": _plain(self.jump_scales),
            "jump": dict(self.jump),
        }


def load_recipe(path: Path) -> Recipe:
    """Read a recipe; which terms there are is checked as it is applied.

    Raises:
        ArtefactError: The file is missing, or is no recipe.
    """
    body = read_yaml(path, ArtefactError, "give a recipe, as those in examples/recipes")
    schema = body.get("schema") if isinstance(body, dict) else None
    if schema != SCHEMA:
        raise ArtefactError(f"{path}: schema {schema!r}; expected {SCHEMA!r}.")
    try:
        file = msgspec.convert(body, _File)
    except msgspec.ValidationError as error:
        raise ArtefactError(
            f"{path}: {error}; expected sections rewards, jump_scales and jump, with numbers, or "
            "numbers by phase, as in {jump_a: 16, jump_b: [16, 10]}."
        ) from None
    return Recipe(
        weights=_spans(file.rewards, f"{path}: rewards"),
        jump_scales=_spans(file.jump_scales, f"{path}: jump_scales"),
        jump=_numbers(file.jump, f"{path}: jump"),
        source=str(path),
        sha256=sha256(path),
    )


def apply_recipe(cfg: ManagerBasedRlEnvCfg, recipe: Recipe) -> None:
    """Change the configuration of an environment by a recipe.

    Args:
        cfg: Configuration of a task of pronk, which is changed.
        recipe: The recipe.

    Raises:
        ArtefactError: It names a term or a number that there is none of, or its numbers make no
            jump.
    """
    from pronk.jump.train.tasks.reward_weights import candidate_terms

    candidates = candidate_terms()
    known = [*cfg.rewards, *candidates]
    for section, names in (("rewards", recipe.weights), ("jump_scales", recipe.jump_scales)):
        for name in names:
            if name not in known:
                raise ArtefactError(
                    f"{recipe.source}: {section} has no term {name!r}; the terms are "
                    f"{', '.join(known)}."
                )
    for name in recipe.weights:
        if name in candidates and name not in cfg.rewards and name not in recipe.removed:
            cfg.rewards[name] = candidates[name]
    for name in recipe.jump_scales:
        if name not in cfg.rewards or not _has_jump_scale(cfg.rewards[name].func):
            scaled = [name for name, term in cfg.rewards.items() if _has_jump_scale(term.func)]
            raise ArtefactError(
                f"{recipe.source}: the term {name!r} has no jump_scale here; those that have one "
                f"are {', '.join(scaled)}."
            )
    for name in recipe.removed:
        cfg.rewards.pop(name, None)
    _change_jump(cfg, recipe)
    changes = {"weights": _plain(recipe.weights), "jump_scales": _plain(recipe.jump_scales)}
    cfg.curriculum[PHASES_NAME].params["changes"] = changes


def _change_jump(cfg: ManagerBasedRlEnvCfg, recipe: Recipe) -> None:
    """Change the definition of a good jump."""
    from pronk.jump.train.mdp.commands import NAME, MotionCommandCfg

    command = cfg.commands[NAME]
    assert isinstance(command, MotionCommandCfg)
    settings: dict[str, float] = dict(recipe.jump)
    command.jump_speed_added = settings.pop(SPEED_ADDED, command.jump_speed_added)
    command.guidance_sweep = settings.pop(GUIDANCE_SWEEP, command.guidance_sweep)
    names = [entry.name for entry in fields(command.settings)]
    for name in settings:
        if name not in names:
            raise ArtefactError(
                f"{recipe.source}: jump has no number {name!r}; the numbers are "
                f"{', '.join([*names, SPEED_ADDED, GUIDANCE_SWEEP])}."
            )
    try:
        command.settings = replace(command.settings, **settings)
    except PronkError as error:
        raise ArtefactError(f"{recipe.source}: jump: {error}") from None


def _has_jump_scale(func: Callable[..., Any]) -> bool:
    """Return whether a term has a factor in jump mode."""
    return "jump_scale" in inspect.signature(func).parameters


def _spans(values: Mapping[str, _Value], place: str) -> Spans:
    """Return values by term and phase as spans; errors begin with `place`."""
    spans: dict[str, dict[str, Span]] = {}
    for name, value in values.items():
        by_phase = value if isinstance(value, dict) else dict.fromkeys(PHASES, value)
        spans[name] = {}
        for phase, entry in by_phase.items():
            if phase not in PHASES:
                raise ArtefactError(
                    f"{place}: {name} has no phase {phase!r}; the phases are {', '.join(PHASES)}."
                )
            start, end = entry if isinstance(entry, tuple) else (entry, entry)
            _check_number(start, f"{place}: {name}")
            _check_number(end, f"{place}: {name}")
            spans[name][phase] = (start, end)
    return spans


def _numbers(values: Mapping[str, float], place: str) -> Mapping[str, float]:
    """Return numbers after a check that they are finite."""
    for name, value in values.items():
        _check_number(value, f"{place}: {name}")
    return dict(values)


def _check_number(value: float, place: str) -> None:
    """Refuse a number that is not finite."""
    if not math.isfinite(value):
        raise ArtefactError(f"{place} is {value}; expected a finite number.")


def _plain(spans: Spans) -> dict[str, dict[str, list[float]]]:
    """Return spans as plain lists and dictionaries, for JSON and YAML."""
    plain: dict[str, dict[str, list[float]]] = {}
    for name, by_phase in spans.items():
        plain[name] = {phase: list(span) for phase, span in by_phase.items()}
    return plain
