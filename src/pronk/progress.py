"""How a long piece of work reports how much of it is done."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called with the name of a stage and the share of the stage that is done, 0 to 1."""


def no_progress(stage: str, share: float) -> None:
    """Ignore the share of a stage that is done."""
