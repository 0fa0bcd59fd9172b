"""Parameter dataclasses whose annotations hold bounds, and their reader.

A field is `Annotated[float, Meta(ge=LOW, le=HIGH)]`, or a tuple of those.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, fields
from functools import cache
from typing import Any, TypeVar, get_args, get_type_hints

import msgspec

from pronk.errors import RobotError

T = TypeVar("T", bound="Bounded")


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


@cache
def _bounds(kind: Any) -> dict[str, tuple[float, float]]:
    """Lowest and highest value by field; of a tuple, of each part."""
    found = {}
    for name, hint in _hints(kind).items():
        first, *rest = get_args(hint) or (hint,)
        for meta in (*get_args(first), *rest):
            if isinstance(meta, msgspec.Meta) and meta.ge is not None:
                found[name] = (meta.ge, math.inf if meta.le is None else meta.le)
    return found


class Bounded:
    """Base of a parameter dataclass."""

    def __post_init__(self) -> None:
        """Refuse values out of their bounds, and NaN; name the field."""
        kind: Any = type(self)
        for name, (low, high) in _bounds(kind).items():
            value = getattr(self, name)
            for part in value if isinstance(value, tuple) else (value,):
                if not low <= part <= high:
                    raise RobotError(f"{name} is {part:g}; expected {low:g} to {high:g}.")


def plain(error: msgspec.ValidationError) -> str:
    """Put msgspec's message into plain words."""
    text = str(error)[0].lower() + str(error)[1:]
    names = {"float": "a number", "int": "a whole number", "array": "a list", "str": "a text"}
    for kind, words in {**names, "object": "a mapping"}.items():
        text = text.replace(f"`{kind}`", words)
    return text


def read(kind: type[T], where: str, entry: Any, without: tuple[str, ...] = ()) -> T:
    """Build a parameter class from a mapping of its fields, except those in `without`.

    RobotErrors name `where` and the field that is missing, unknown, of another type or out of its
    bounds.
    """
    if not isinstance(entry, Mapping):
        raise RobotError(f"{where} is {entry!r}; expected a mapping of its fields.")
    known = {part.name: part for part in fields(kind) if part.name not in without}  # type: ignore[arg-type]
    for name in entry:
        if name not in known:
            raise RobotError(f"{where}.{name} is unknown; the fields are {', '.join(known)}.")
    values: dict[str, Any] = {}
    hints = get_type_hints(kind, include_extras=True)
    for name, part in known.items():
        if name in entry:
            try:
                values[name] = msgspec.convert(entry[name], hints[name])
            except msgspec.ValidationError as error:
                raise RobotError(f"{where}.{name} is {entry[name]!r}; {plain(error)}.") from None
        elif part.default is MISSING:
            raise RobotError(f"{where}.{name} is missing.")
    try:
        return kind(**values)
    except RobotError as error:
        raise RobotError(f"{where}.{error}") from None
