"""Unitree's `deploy.yaml`: how a network trained elsewhere is run, as unitree_rl_lab writes it.

A joint has two numbers there. Its place among the joints of the network is the order of
`default_joint_pos`, of the scales and of the actions; `joint_ids_map` gives, for each of those
places, its place in Unitree's messages, which is the order of `stiffness` and `damping`. A
`robot.yaml` of pronk for a robot of Unitree has its joints in the order of the messages.

An observation is a row of terms. Each term has its last samples one after the other, oldest first,
then comes the next term; with `use_gym_history` all terms of one sample come first, then the next
sample. A value is clipped, then scaled, or with `scale_first` the other way round.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from pronk.arrays import Array
from pronk.errors import ArtefactError
from pronk.files import read_yaml

VECTORS = ("base_ang_vel", "projected_gravity", "velocity_commands", "keyboard_velocity_commands")
"""Terms of three numbers."""
JOINT_TERMS = ("joint_pos", "joint_pos_rel", "joint_vel", "joint_vel_rel", "last_action")
"""Terms of one number a joint."""
COMMAND_TERMS = ("velocity_commands", "keyboard_velocity_commands")
"""Terms of the commanded velocity."""
RANGE_NAMES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
"""Components of the commanded velocity: forward, left [m/s], yaw rate [rad/s]."""
POSITION_ACTION = "JointPositionAction"
"""The one action that can be run: targets of joint positions."""
_SWITCHES = ("use_gym_history", "scale_first")
"""Entries of the observations that are no terms."""
_MAX_HISTORY = 1000
_MAX_NUMBER = 1e6
_WRITER = "unitree_rl_lab writes it into `params/` beside the policy"


@dataclass(frozen=True, kw_only=True)
class Term:
    """One term of an observation."""

    name: str
    """Name, of `VECTORS` or `JOINT_TERMS`."""
    scale: tuple[float, ...]
    """Factor of each number; its length is the width of the term."""
    clip: tuple[float, float]
    """Least and greatest value; infinite without a limit."""
    scale_first: bool
    """True if a value is scaled before it is clipped."""
    history_length: int
    """Samples in the observation, with the present one."""

    @property
    def size(self) -> int:
        """Numbers in the observation, all samples together."""
        return len(self.scale) * self.history_length


@dataclass(frozen=True, kw_only=True)
class DeployFile:
    """Content of a `deploy.yaml`, and two readings of it that no file says."""

    joint_ids: tuple[int, ...]
    """Place in the messages of each joint of the network."""
    step_s: float
    """Time between two actions [s]."""
    stiffness: tuple[float, ...]
    """Of the drives, in the order of the messages [N m/rad]."""
    damping: tuple[float, ...]
    """Of the drives, in the order of the messages [N m s/rad]."""
    default_position: tuple[float, ...]
    """Zero of the observed positions, in the order of the network [rad]."""
    action_scale: tuple[float, ...]
    """Target per action, in the order of the network [rad]."""
    action_offset: tuple[float, ...]
    """Target at action zero, in the order of the network [rad]."""
    action_clip: tuple[tuple[float, float], ...]
    """Least and greatest target, in the order of the network [rad]."""
    terms: tuple[Term, ...]
    """Terms of the observation, in order."""
    by_sample: bool
    """True if an observation has sample after sample, not term after term."""
    command_ranges: Mapping[str, tuple[float, float]]
    """Least and greatest command, by some of the names `RANGE_NAMES`; may be empty."""
    newest_first: bool = False
    """True if the newest sample of a history comes first."""
    gravity_sign: float = 1.0
    """Factor of the observed direction of gravity, which is (0, 0, -1) for an upright trunk."""

    @property
    def width(self) -> int:
        """Numbers in an observation."""
        return sum(term.size for term in self.terms)


class _TermEntry(msgspec.Struct):
    scale: float | list[float] | None = None
    clip: list[float] | None = None
    scale_first: bool | None = None
    history_length: int = 1


class _ActionEntry(msgspec.Struct):
    scale: float | list[float] | None = None
    offset: float | list[float] | None = None
    clip: list[Any] | None = None
    joint_ids: list[int] | None = None


class _DeployEntries(msgspec.Struct):
    joint_ids_map: list[int]
    step_dt: float
    stiffness: list[float]
    damping: list[float]
    default_joint_pos: list[float]
    actions: dict[str, _ActionEntry]
    observations: dict[str, Any]
    commands: dict[str, Any] | None = None


def read_deploy_yaml(path: Path) -> DeployFile:
    """Read a `deploy.yaml`.

    Raises:
        ArtefactError: It is missing, no such file, or describes what pronk cannot run; the message
            names the entry.
    """
    body = read_yaml(path, ArtefactError, _WRITER)
    try:
        entries = msgspec.convert(body, _DeployEntries)
    except msgspec.ValidationError as error:
        raise ArtefactError(
            f"{path}: {error}; expected Unitree's deploy.yaml with joint_ids_map, step_dt, "
            f"stiffness, damping, default_joint_pos, actions and observations; {_WRITER}."
        ) from None
    count = len(entries.joint_ids_map)
    if sorted(entries.joint_ids_map) != list(range(count)) or not count:
        raise ArtefactError(
            f"{path}: joint_ids_map is {entries.joint_ids_map}; expected each number from 0 to "
            f"{max(count - 1, 0)} once, the place of each joint of the network in the messages."
        )
    if not 0.0 < entries.step_dt <= 1.0:
        raise ArtefactError(f"{path}: step_dt is {entries.step_dt}; expected above 0, up to 1 s.")
    if list(entries.actions) != [POSITION_ACTION]:
        raise ArtefactError(
            f"{path}: the actions are {', '.join(entries.actions) or 'none'}; pronk runs "
            f"{POSITION_ACTION} alone."
        )
    action = entries.actions[POSITION_ACTION]
    if action.joint_ids is not None and action.joint_ids != list(range(count)):
        raise ArtefactError(
            f"{path}: actions.{POSITION_ACTION}.joint_ids is {action.joint_ids}; pronk runs "
            "policies that command every joint in their own order, joint_ids null."
        )
    place = f"{path}: actions.{POSITION_ACTION}"
    stiffness = _numbers(entries.stiffness, count, f"{path}: stiffness", 0.0)
    damping = _numbers(entries.damping, count, f"{path}: damping", 0.0)
    for name, gains in (("stiffness", stiffness), ("damping", damping)):
        if min(gains) < 0.0:
            raise ArtefactError(f"{path}: {name} is {list(gains)}; expected 0 or more.")
    return DeployFile(
        joint_ids=tuple(entries.joint_ids_map),
        step_s=entries.step_dt,
        stiffness=stiffness,
        damping=damping,
        default_position=_numbers(
            entries.default_joint_pos, count, f"{path}: default_joint_pos", 0.0
        ),
        action_scale=_numbers(action.scale, count, f"{place}.scale", 1.0),
        action_offset=_numbers(action.offset, count, f"{place}.offset", 0.0),
        action_clip=_action_clip(action.clip, count, f"{place}.clip"),
        terms=_terms(entries.observations, count, str(path)),
        by_sample=_switch(entries.observations, "use_gym_history", str(path)),
        command_ranges=_command_ranges(entries.commands, str(path)),
    )


def _numbers(
    values: float | Sequence[float] | None, count: int, place: str, default: float
) -> tuple[float, ...]:
    """Return one finite number a joint; a single number stands for all, None for a default."""
    if values is None:
        return (default,) * count
    numbers = (float(values),) * count if isinstance(values, int | float) else tuple(values)
    sized = len(numbers) == count
    if not sized or not all(abs(number) <= _MAX_NUMBER for number in numbers):
        raise ArtefactError(
            f"{place} has {len(numbers)} numbers, or one that is not finite; expected {count} "
            f"numbers up to {_MAX_NUMBER:g}."
        )
    return tuple(float(number) for number in numbers)


def _range(values: Any, place: str) -> tuple[float, float]:
    """Return the two ends of a range; None stands for no limit."""
    if values is None:
        return -math.inf, math.inf
    try:
        low, high = (float(value) for value in values)
    except (TypeError, ValueError):
        raise ArtefactError(f"{place} is {values!r}; expected two numbers.") from None
    if not low <= high:
        raise ArtefactError(f"{place} is {values!r}; expected the smaller number first.")
    return low, high


def _action_clip(values: Any, count: int, place: str) -> tuple[tuple[float, float], ...]:
    """Return the range of each target."""
    if values is None:
        return (_range(None, place),) * count
    if len(values) == 2 and not isinstance(values[0], list):
        return (_range(values, place),) * count
    if len(values) != count:
        raise ArtefactError(f"{place} has {len(values)} ranges; expected {count}.")
    return tuple(_range(value, place) for value in values)


def _switch(observations: Mapping[str, Any], name: str, source: str) -> bool:
    """Return an entry of the observations that is true or false; false where it is left out."""
    value = observations.get(name, False)
    if not isinstance(value, bool):
        raise ArtefactError(f"{source}: observations.{name} is {value!r}; expected true or false.")
    return value


def _terms(observations: Mapping[str, Any], count: int, source: str) -> tuple[Term, ...]:
    """Return the terms of an observation of a robot with some number of joints."""
    scale_first = _switch(observations, "scale_first", source)
    widths = {**dict.fromkeys(VECTORS, 3), **dict.fromkeys(JOINT_TERMS, count)}
    terms = []
    for name, body in observations.items():
        if name in _SWITCHES:
            continue
        place = f"{source}: observations.{name}"
        if name not in widths:
            raise ArtefactError(
                f"{place} cannot be computed from the sensors of a robot, or is a group of terms; "
                f"pronk knows {', '.join(widths)}."
            )
        try:
            entry = msgspec.convert(body, _TermEntry)
        except msgspec.ValidationError as error:
            raise ArtefactError(f"{place}: {error}.") from None
        if not 0 <= entry.history_length <= _MAX_HISTORY:
            raise ArtefactError(
                f"{place}.history_length is {entry.history_length}; expected up to {_MAX_HISTORY}."
            )
        term = Term(
            name=name,
            scale=_numbers(entry.scale, widths[name], f"{place}.scale", 1.0),
            clip=_range(entry.clip, f"{place}.clip"),
            scale_first=scale_first if entry.scale_first is None else entry.scale_first,
            history_length=max(1, entry.history_length),
        )
        terms.append(term)
    if not terms:
        raise ArtefactError(f"{source}: observations has no term.")
    if _switch(observations, "use_gym_history", source):
        lengths = {term.history_length for term in terms}
        if len(lengths) > 1:
            raise ArtefactError(
                f"{source}: with use_gym_history every term has the same history_length; these "
                f"have {sorted(lengths)}."
            )
    return tuple(terms)


def _command_ranges(commands: Any, source: str) -> dict[str, tuple[float, float]]:
    """Return the ranges of the commanded velocity that the file states."""
    ranges = {}
    entry = (commands or {}).get("base_velocity") or {}
    stated = entry.get("ranges") if isinstance(entry, dict) else None
    if isinstance(stated, dict):
        for name in RANGE_NAMES:
            if name in stated:
                place = f"{source}: commands.base_velocity.ranges.{name}"
                ranges[name] = _range(stated[name], place)
    return ranges


def shaped(values: ArrayLike, term: Term) -> Array:
    """Clip and scale one sample of a term."""
    scale = np.asarray(term.scale)
    lowest, highest = term.clip
    if term.scale_first:
        scaled_first: Array = np.clip(np.asarray(values) * scale, lowest, highest)
        return scaled_first
    clipped_first: Array = np.clip(np.asarray(values), lowest, highest) * scale
    return clipped_first
