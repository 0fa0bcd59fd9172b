"""Bounds of what can exist, and the one sentence that refuses the rest."""

from __future__ import annotations

from collections.abc import Mapping

from pronk.errors import RobotError

Bounds = Mapping[str, tuple[float, float]]
"""Lowest and highest possible value by field; of a tuple, of each part."""


def check_bounds(values: object, bounds: Bounds) -> None:
    """See that fields lie within their bounds.

    Raises:
        RobotError: One does not, or is not a number; the sentence names it.
    """
    for name, (low, high) in bounds.items():
        value = getattr(values, name)
        for part in value if isinstance(value, tuple) else (value,):
            if not low <= part <= high:  # refuses NaN as well
                raise RobotError(f"{name} is {part:g}; expected {low:g} to {high:g}.")
