"""Extensions of installed packages."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

from pronk.errors import PronkError


def load(point: EntryPoint) -> Any:
    """Import what an entry point names; PronkError if it cannot be imported."""
    try:
        return point.load()
    except Exception as error:  # Code of another package may fail in any way.
        raise PronkError(
            f"{point.value} of the entry points {point.group} cannot be loaded "
            f"({type(error).__name__}: {error}); reinstall or remove its package."
        ) from error
