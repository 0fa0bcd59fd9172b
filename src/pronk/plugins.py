"""Extensions that installed packages bring by entry points."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

from pronk.errors import PronkError


def load_entry_point(entry_point: EntryPoint) -> Any:
    """Import what an entry point names.

    Raises:
        PronkError: It cannot be imported; the message names the package to reinstall or remove.
    """
    try:
        return entry_point.load()
    except Exception as error:  # Code of another package may fail in any way.
        raise PronkError(
            f"{entry_point.value} of the entry points {entry_point.group} cannot be loaded "
            f"({type(error).__name__}: {error}); reinstall or remove its package."
        ) from error
