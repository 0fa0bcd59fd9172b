"""Recipes: what a training changes in its rewards and in what a good jump is, as data.

    schema: pronk/recipe/1
    rewards:                      # weights by term; 0 removes the term
      stray_foot: 0               # in all phases
      flight_distance: {jump_a: 28, jump_b: [28, 40]}   # in a phase; from its beginning to its end
    jump_scales:                  # factor of the weight in jump mode, likewise
      orientation: 1
    jump:                         # fields of `JumpSettings`, and `COMMAND_NUMBERS`
      late_s: 0.25
    task:                         # numbers of the task: `TASK_NUMBERS`
      action_scale: 0.42

What a recipe does not name stays as the task has it. `pronk train --recipe FILE` applies it to the
configuration of any robot's task, after the robot's own changes. Several files are layers of one
recipe: a later one takes precedence phase by phase in each term, and number by number in `jump`
and `task`.
The merged recipe has the same schema, and names its files:

    layers:
    - {file: forward.yaml, sha256: ...}
    - {file: landing.yaml, sha256: ...}
"""

from __future__ import annotations

import hashlib
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import yaml

from pronk.errors import ArtefactError, PronkError
from pronk.files import read_yaml, sha256
from pronk.jump.train.phases import NAME as PHASES_NAME
from pronk.jump.train.phases import PHASES, Span

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnvCfg

    from pronk.jump.train.mdp.jump import JumpSettings

SCHEMA = "pronk/recipe/1"
SPEED_ADDED = "speed_added"
"""Entry of `jump` that is no field of `JumpSettings`: how much faster than commanded a robot is
rewarded for in jump mode (`MotionCommandCfg.jump_speed_added`) [m/s]."""
GUIDANCE_SWEEP = "guidance_sweep"
"""Another one: `MotionCommandCfg.guidance_sweep`."""
BACKWARD_SHARE = "backward_share"
"""Another one: `MotionCommandCfg.backward_share`."""
SIDEWAYS_SHARE = "sideways_share"
"""Another one: `MotionCommandCfg.sideways_share`."""
ANGLE_VERTICAL = "angle_vertical"
"""Another one: vertical velocity of the desired lift-off, whose direction `rewards.liftoff_angle`
rewards [m/s]; the lower it is, the flatter are the lift-offs forwards that earn most."""
COMMAND_NUMBERS = (SPEED_ADDED, GUIDANCE_SWEEP, BACKWARD_SHARE, SIDEWAYS_SHARE, ANGLE_VERTICAL)
"""All entries of `jump` that are no fields of `JumpSettings`."""
_ANGLE_TERM = "liftoff_angle"
"""The term whose direction `ANGLE_VERTICAL` changes."""
ACTION_SCALE = "action_scale"
"""Entry of `task`: change of a joint target with an action of 1 [rad]. The noise of the actions, by
which a policy explores, is in units of it."""
CONTACT_DAMPING = "contact_damping"
"""Another one: smallest share of the damping of the feet on the ground that is drawn for a robot
(`events.randomize_contact`); 1 draws nothing."""
ROTOR_FREQUENCY = "rotor_frequency"
"""Another one: joints are measured on rotors behind belts or gears that give way. It is the lowest
natural frequency of a rotor while its link is held that is drawn (`events.randomize_rotors`)
[Hz]; with 0 joints are measured on their links."""
DECIMATION_SPREAD = "decimation_spread"
"""Another one: how many physics steps a policy step has more or less at most, a whole number; each
policy step draws its own. With 0 all policy steps are alike."""
SOFTEST_HZ = 10.0
"""Least `ROTOR_FREQUENCY`: at 10 Hz the belt of a knee of the Mini Cheetah is as soft as its drive,
25 N m/rad, and does not hold the robot up [Hz]."""
TASK_NUMBERS = (ACTION_SCALE, CONTACT_DAMPING, DECIMATION_SPREAD, ROTOR_FREQUENCY)
"""All entries of `task`."""
EARLIER_DEFAULTS = {CONTACT_DAMPING: 1.0, DECIMATION_SPREAD: 2.0, ROTOR_FREQUENCY: 0.0}
"""What runs and policies of before 30 November 2026 were trained with where they record nothing."""

_Value = float | dict[str, float | tuple[float, float]]
"""A number, or one by phase: a number, or its values at the beginning and at the end."""
Spans = Mapping[str, Mapping[str, Span]]
"""Values at the beginning and at the end of a phase, by term and phase."""


Section = Literal["rewards", "jump_scales", "jump", "task"]
"""Section of a file with names of terms or numbers."""


class RecipeLayer(msgspec.Struct, kw_only=True, frozen=True, forbid_unknown_fields=True):
    """A file that a merged recipe is made of."""

    file: str
    """Name without its folder."""
    sha256: str
    """Hash of the file."""


class _File(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """Content of a file."""

    schema: str
    rewards: dict[str, _Value] = {}
    jump_scales: dict[str, _Value] = {}
    jump: dict[str, float] = {}
    task: dict[str, float] = {}
    layers: tuple[RecipeLayer, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Changes of a task's rewards and of its definition of a good jump."""

    weights: Spans = field(default_factory=dict)
    """Weights of terms in the phases that are named."""
    jump_scales: Spans = field(default_factory=dict)
    """Factors of the weights in jump mode, likewise."""
    jump: Mapping[str, float] = field(default_factory=dict)
    """Fields of `JumpSettings`, and `COMMAND_NUMBERS`."""
    task: Mapping[str, float] = field(default_factory=dict)
    """`TASK_NUMBERS`."""
    source: str = ""
    """The file, or all files that were merged, for messages."""
    sha256: str = ""
    """Hash of the file; of a merged recipe that of its `recipe_text`."""
    layers: tuple[RecipeLayer, ...] = ()
    """The files of a merged recipe, the first one first; empty otherwise."""
    parts: tuple[Recipe, ...] = field(default=(), compare=False)
    """The recipes that were merged, for messages; empty if it was read from one file."""

    @property
    def removed(self) -> tuple[str, ...]:
        """Terms whose weight is 0 in all phases."""
        names = []
        for name, spans in self.weights.items():
            nothing = all(span == (0.0, 0.0) for span in spans.values())
            if nothing and len(spans) == len(PHASES):
                names.append(name)
        return tuple(names)

    @property
    def files(self) -> tuple[RecipeLayer, ...]:
        """All files that it is made of, with their hashes."""
        if self.layers:
            return self.layers
        return (RecipeLayer(file=Path(self.source).name, sha256=self.sha256),)

    def has_name(self, section: Section, name: str) -> bool:
        """Return whether a section names a term or a number."""
        names: dict[Section, Mapping[str, Any]] = {
            "rewards": self.weights,
            "jump_scales": self.jump_scales,
            "jump": self.jump,
            "task": self.task,
        }
        return name in names[section]

    def source_of(self, section: Section, name: str) -> str:
        """Return the file whose value of a term or a number holds: the last one that names it."""
        for part in reversed(self.parts):
            if part.has_name(section, name):
                return part.source
        return self.source

    def record(self) -> dict[str, Any]:
        """Return what the provenance of a run holds of the recipe."""
        record: dict[str, Any] = {
            "file": " + ".join(layer.file for layer in self.files),
            "sha256": self.sha256,
            "weights": _plain(self.weights),
            "jump_scales": _plain(self.jump_scales),
            "jump": dict(self.jump),
            "task": dict(self.task),
        }
        if self.layers:
            record["layers"] = [msgspec.to_builtins(layer) for layer in self.layers]
        return record


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
            f"{path}: {error}; expected sections rewards, jump_scales, jump and task, with "
            "numbers, or numbers by phase, as in {jump_a: 16, jump_b: [16, 10]}."
        ) from None
    return Recipe(
        weights=_spans(file.rewards, f"{path}: rewards"),
        jump_scales=_spans(file.jump_scales, f"{path}: jump_scales"),
        jump=_numbers(file.jump, f"{path}: jump"),
        task=_numbers(file.task, f"{path}: task"),
        source=str(path),
        sha256=sha256(path),
        layers=file.layers,
    )


def load_recipes(paths: Sequence[Path]) -> Recipe:
    """Read a recipe of one file or of several layers, the first one first.

    Raises:
        ArtefactError: A file is missing, or is no recipe.
    """
    return merge_recipes([load_recipe(path) for path in paths])


def merge_recipes(recipes: Sequence[Recipe]) -> Recipe:
    """Merge recipes; later ones take precedence in each phase of a term and in each number.

    Args:
        recipes: One or more. A single one is returned as it is.
    """
    if len(recipes) == 1:
        return recipes[0]
    weights: dict[str, dict[str, Span]] = {}
    jump_scales: dict[str, dict[str, Span]] = {}
    jump: dict[str, float] = {}
    task: dict[str, float] = {}
    layers: list[RecipeLayer] = []
    for recipe in recipes:
        _update_spans(weights, recipe.weights)
        _update_spans(jump_scales, recipe.jump_scales)
        jump.update(recipe.jump)
        task.update(recipe.task)
        layers += recipe.files
    merged = Recipe(
        weights=weights,
        jump_scales=jump_scales,
        jump=jump,
        task=task,
        source=", ".join(recipe.source for recipe in recipes),
        layers=tuple(layers),
        parts=tuple(recipes),
    )
    return replace(merged, sha256=hashlib.sha256(recipe_text(merged).encode()).hexdigest())


def _update_spans(spans: dict[str, dict[str, Span]], changes: Spans) -> None:
    """Take over values by term and phase; other phases of these terms stay."""
    for name, by_phase in changes.items():
        spans.setdefault(name, {}).update(by_phase)


def recipe_text(recipe: Recipe) -> str:
    """Return a merged recipe as the text of a file, which `load_recipe` reads.

    Files of the same names and content give the same text, wherever they lie.
    """
    body = {
        "schema": SCHEMA,
        "rewards": _file_values(recipe.weights),
        "jump_scales": _file_values(recipe.jump_scales),
        "jump": {name: _file_number(value) for name, value in recipe.jump.items()},
        "task": {name: _file_number(value) for name, value in recipe.task.items()},
        "layers": [_OneLineDict(msgspec.to_builtins(layer)) for layer in recipe.layers],
    }
    comment = (
        "# Merged by pronk train from the files in layers; a later one takes precedence in each\n"
        "# phase of a term. Leave layers out of a copy that you change.\n"
    )
    return comment + yaml.dump(
        body, Dumper=_RecipeDumper, sort_keys=False, width=10_000, allow_unicode=True
    )


def recipe_content(paths: Sequence[Path]) -> bytes:
    """Return the one file as which a recipe is kept: a single file as it is, layers merged.

    Its SHA-256 is that of the recipe that `load_recipes` reads from the same files.

    Raises:
        ArtefactError: A file is missing, or is no recipe.
    """
    recipe = load_recipes(paths)
    if len(paths) == 1:
        return paths[0].read_bytes()
    return recipe_text(recipe).encode()


class _OneLineDict(dict[str, Any]):
    """A dictionary on one line of YAML."""


class _RecipeDumper(yaml.SafeDumper):
    """Writer of recipes."""


def _represent_dict(dumper: yaml.SafeDumper, entry: _OneLineDict) -> yaml.Node:
    return dumper.represent_mapping("tag:yaml.org,2002:map", entry.items(), flow_style=True)


_RecipeDumper.add_representer(_OneLineDict, _represent_dict)


def _file_values(spans: Spans) -> dict[str, Any]:
    """Return values by term and phase as a file has them, phases in their order."""
    values: dict[str, Any] = {}
    for name, by_phase in spans.items():
        ordered = [by_phase[phase] for phase in PHASES if phase in by_phase]
        first = ordered[0] if ordered else (0.0, 0.0)
        if len(ordered) == len(PHASES) and set(ordered) == {(first[0], first[0])}:
            values[name] = _file_number(first[0])
            continue
        entry = _OneLineDict()
        for phase in PHASES:
            if phase in by_phase:
                start, end = by_phase[phase]
                numbers = [_file_number(start), _file_number(end)]
                entry[phase] = numbers[0] if start == end else numbers
        values[name] = entry
    return values


def _file_number(value: float) -> float:
    """Return a number as a file has it: 16 and not 16.0."""
    is_short = value.is_integer() and abs(value) < 2.0**53
    return int(value) if is_short else value


def apply_recipe(cfg: ManagerBasedRlEnvCfg, recipe: Recipe) -> None:
    """Change the configuration of an environment by a recipe.

    Args:
        cfg: Configuration of a task of pronk, which is changed.
        recipe: The recipe.

    Raises:
        ArtefactError: It names a term or a number that there is none of, or its numbers make no
            jump or no action.
    """
    from pronk.jump.train.tasks.reward_weights import candidate_terms

    candidates = candidate_terms()
    known = [*cfg.rewards, *candidates]
    sections: tuple[tuple[Section, Spans], ...] = (
        ("rewards", recipe.weights),
        ("jump_scales", recipe.jump_scales),
    )
    for section, names in sections:
        for name in names:
            if name not in known:
                raise ArtefactError(
                    f"{recipe.source_of(section, name)}: {section} has no term {name!r}; the terms "
                    f"are {', '.join(known)}."
                )
    for name in recipe.weights:
        if name in candidates and name not in cfg.rewards and name not in recipe.removed:
            cfg.rewards[name] = candidates[name]
    for name in recipe.jump_scales:
        if name not in cfg.rewards or not _has_jump_scale(cfg.rewards[name].func):
            scaled = [name for name, term in cfg.rewards.items() if _has_jump_scale(term.func)]
            raise ArtefactError(
                f"{recipe.source_of('jump_scales', name)}: the term {name!r} has no jump_scale "
                f"here; those that have one are {', '.join(scaled)}."
            )
    for name in recipe.removed:
        cfg.rewards.pop(name, None)
    _change_jump(cfg, recipe)
    _change_task(cfg, recipe)
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
    command.backward_share = settings.pop(BACKWARD_SHARE, command.backward_share)
    command.sideways_share = settings.pop(SIDEWAYS_SHARE, command.sideways_share)
    angle_vertical = settings.pop(ANGLE_VERTICAL, None)
    if angle_vertical is not None:
        _set_angle_vertical(cfg, recipe, angle_vertical)
    for name in (BACKWARD_SHARE, SIDEWAYS_SHARE):
        share = recipe.jump.get(name, 1.0)
        if not 0.0 <= share <= 1.0:
            raise ArtefactError(
                f"{recipe.source_of('jump', name)}: jump: {name} is {share:g}; expected a share "
                "from 0 to 1."
            )
    names = [entry.name for entry in fields(command.settings)]
    for name in settings:
        if name not in names:
            raise ArtefactError(
                f"{recipe.source_of('jump', name)}: jump has no number {name!r}; the numbers are "
                f"{', '.join([*names, *COMMAND_NUMBERS])}."
            )
    try:
        command.settings = replace(command.settings, **settings)
    except PronkError as error:
        source = _source_of_bad_jump(recipe, command.settings)
        raise ArtefactError(f"{source}: jump: {error}") from None


def _set_angle_vertical(cfg: ManagerBasedRlEnvCfg, recipe: Recipe, vertical: float) -> None:
    """Set the vertical velocity of the desired lift-off of the term `liftoff_angle`."""
    source = recipe.source_of("jump", ANGLE_VERTICAL)
    if not vertical > 0.0:
        raise ArtefactError(
            f"{source}: jump: {ANGLE_VERTICAL} is {vertical:g}; expected more than 0 m/s."
        )
    if _ANGLE_TERM not in cfg.rewards:
        raise ArtefactError(
            f"{source}: jump: {ANGLE_VERTICAL} goes with the term {_ANGLE_TERM!r}, which is "
            "removed; leave one of them out."
        )
    cfg.rewards[_ANGLE_TERM].params["vertical"] = vertical


def _change_task(cfg: ManagerBasedRlEnvCfg, recipe: Recipe) -> None:
    """Change the numbers of the task."""
    for name, value in recipe.task.items():
        source = recipe.source_of("task", name)
        try:
            check_task_number(name, value)
        except PronkError as error:
            raise ArtefactError(f"{source}: task: {error}") from None
        try:
            set_task_number(cfg, name, value)
        except PronkError as error:
            raise ArtefactError(f"{source}: task: {name}: {error}") from None


def set_task_number(cfg: ManagerBasedRlEnvCfg, name: str, value: float) -> None:
    """Change one of the `TASK_NUMBERS` of the configuration of an environment.

    Args:
        cfg: The configuration, which is changed.
        name: Name of the number.
        value: The number, which `check_task_number` accepts.

    Raises:
        PronkError: The task of this robot cannot have it.
    """
    from pronk.jump.train.mdp.actions import NAME, DelayedJointPositionActionCfg
    from pronk.jump.train.tasks.jump_env_cfg import (
        set_contact_damping,
        set_decimation_spread,
        set_rotor_frequency,
    )

    if name == ACTION_SCALE:
        action = cfg.actions[NAME]
        assert isinstance(action, DelayedJointPositionActionCfg)
        action.scale = value
    elif name == CONTACT_DAMPING:
        set_contact_damping(cfg, value)
    elif name == DECIMATION_SPREAD:
        set_decimation_spread(cfg, int(value))
    else:
        set_rotor_frequency(cfg, value)


def task_numbers(cfg: ManagerBasedRlEnvCfg) -> dict[str, float]:
    """Return the `TASK_NUMBERS` of the configuration of an environment by name."""
    from pronk.jump.train.mdp.actions import NAME
    from pronk.jump.train.tasks.jump_env_cfg import (
        contact_damping,
        decimation_spread,
        rotor_frequency,
    )

    return {
        ACTION_SCALE: float(cfg.actions[NAME].scale),
        CONTACT_DAMPING: contact_damping(cfg),
        DECIMATION_SPREAD: float(decimation_spread(cfg)),
        ROTOR_FREQUENCY: rotor_frequency(cfg),
    }


def recorded_task_numbers(record: Mapping[str, Any]) -> dict[str, float]:
    """Return the `TASK_NUMBERS` that a run began with, as far as its provenance has them.

    Args:
        record: The provenance. Runs of earlier versions recorded the numbers of their recipe alone.
    """
    recipe = record.get("recipe") or {}
    return {**EARLIER_DEFAULTS, **recipe.get("task", {}), **record.get("task", {})}


def check_task_number(name: str, value: object) -> None:
    """Refuse a number of `task` that is impossible, or a name that is none of them.

    Args:
        name: Its name.
        value: What a recipe has for it, or what a policy or a run has recorded.

    Raises:
        PronkError: No such number, or it is out of its range.
    """
    if name not in TASK_NUMBERS:
        raise PronkError(f"no number {name!r}; the numbers are {', '.join(TASK_NUMBERS)}.")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise PronkError(f"{name} is {value!r}; expected a number.")
    if name == ROTOR_FREQUENCY:
        if value != 0.0 and not SOFTEST_HZ <= value < math.inf:
            raise PronkError(
                f"{name} is {value:g}; expected {SOFTEST_HZ:g} Hz or more, or 0, with which joints "
                "are measured on their links."
            )
        return
    if name == DECIMATION_SPREAD:
        if not (0.0 <= value < math.inf and value == int(value)):
            raise PronkError(f"{name} is {value:g}; expected a whole number of physics steps.")
        return
    if not 0.0 < value < math.inf:
        raise PronkError(f"{name} is {value:g}; expected more than 0, and finite.")
    if name == CONTACT_DAMPING and value > 1.0:
        raise PronkError(f"{name} is {value:g}; expected a share up to 1.")


def _source_of_bad_jump(recipe: Recipe, settings: JumpSettings) -> str:
    """Return the file with which the numbers of a recipe ceased to make a jump.

    Numbers may be impossible together only, so each layer is added to those before it. One that a
    later layer mends is not meant.
    """
    source = ""
    numbers: dict[str, float] = {}
    for part in recipe.parts:
        numbers.update(part.jump)
        for name in COMMAND_NUMBERS:
            numbers.pop(name, None)
        try:
            replace(settings, **numbers)
        except PronkError:
            source = source or part.source
        else:
            source = ""
    return source or recipe.source


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
