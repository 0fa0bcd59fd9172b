"""Frozen parameter dataclasses whose annotations hold bounds, `Annotated[float, Meta(ge=0.0)]`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from functools import cache
from typing import Any, TypeVar, get_type_hints

import msgspec
import numpy as np

from pronk.errors import RobotError

T = TypeVar("T", bound="Bounded")


class Bounded:
    """Base of a parameter dataclass."""

    def __post_init__(self) -> None:
        """Convert fields to their types; RobotError names a wrong type or a value out of bounds."""
        kind: Any = type(self)
        for name, hint in _hints(kind).items():
            value = getattr(self, name)
            try:
                object.__setattr__(self, name, msgspec.convert(_builtin(value), hint))
            except msgspec.ValidationError as error:
                raise RobotError(f"{name} is {value!r}: {error}.") from None


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _builtin(value: Any) -> Any:
    """Numbers of NumPy, also in tuples, as Python's own."""
    if isinstance(value, tuple):
        return tuple(map(_builtin, value))
    return value.item() if isinstance(value, np.generic) else value


def read(kind: type[T], where: str, entry: Any, without: tuple[str, ...] = ()) -> T:
    """Build one from a mapping of its fields, except those in `without`; RobotError names both."""
    if not isinstance(entry, Mapping):
        raise RobotError(f"{where} is {entry!r}; expected a mapping of its fields.")
    known = {part.name: part for part in fields(kind) if part.name not in without}  # type: ignore[arg-type]
    for name in entry:
        if name not in known:
            raise RobotError(f"{where}.{name} is unknown; the fields are {', '.join(known)}.")
    for name, part in known.items():
        if name not in entry and part.default is MISSING:
            raise RobotError(f"{where}.{name} is missing.")
    try:
        return kind(**entry)
    except RobotError as error:
        raise RobotError(f"{where}.{error}") from None
