"""Frozen parameter dataclasses whose annotations hold bounds, `Annotated[float, Meta(ge=0.0)]`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, fields
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
        params_class: Any = type(self)
        for name, hint in _hints(params_class).items():
            value = getattr(self, name)
            try:
                converted = msgspec.convert(_builtin(value), hint)
            except msgspec.ValidationError as error:
                raise RobotError(f"{name} is {value!r}: {error}.") from None
            # The way to set a field of a frozen dataclass.
            object.__setattr__(self, name, converted)


@cache
def _hints(params_class: Any) -> dict[str, Any]:
    """Return the annotations of a class by field."""
    return get_type_hints(params_class, include_extras=True)


def _builtin(value: Any) -> Any:
    """Return numbers of NumPy, also in tuples, as Python's own."""
    if isinstance(value, tuple):
        return tuple(_builtin(entry) for entry in value)
    if isinstance(value, np.generic):
        return value.item()
    return value


def read_bounded(params_class: type[T], where: str, entry: Any, excluded: Sequence[str] = ()) -> T:
    """Build parameters from a mapping of their fields.

    Args:
        params_class: Class of the parameters.
        where: Place of the mapping in its file, for errors.
        entry: The mapping.
        excluded: Fields that the mapping may not have.

    Raises:
        RobotError: No mapping, an unknown or missing field, or a value out of bounds.
    """
    if not isinstance(entry, Mapping):
        raise RobotError(f"{where} is {entry!r}; expected a mapping of its fields.")
    allowed: dict[str, Field[Any]] = {}
    for field in fields(params_class):  # type: ignore[arg-type]
        if field.name not in excluded:
            allowed[field.name] = field
    for name in entry:
        if name not in allowed:
            raise RobotError(f"{where}.{name} is unknown; the fields are {', '.join(allowed)}.")
    for name, field in allowed.items():
        if name not in entry and field.default is MISSING:
            raise RobotError(f"{where}.{name} is missing.")
    try:
        return params_class(**entry)
    except RobotError as error:
        raise RobotError(f"{where}.{error}") from None
