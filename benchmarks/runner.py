"""What the benchmarks share: blocks of work in turn, paired ratios, tables."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import version

import numpy as np
from rich.table import Table
from rich.text import Text

Progress = Callable[[str, float], None]
"""Is given the stage and the share done, 0 to 1."""


def in_turn(blocks: Sequence[Callable[[], float]], repeats: int) -> list[list[float]]:
    """Run blocks in turn; the order is reversed in every second turn.

    Args:
        blocks: Each returns its time [s].
        repeats: Turns.

    Returns:
        Times of each block, turn by turn [s].
    """
    times: list[list[float]] = [[] for _ in blocks]
    for turn in range(repeats):
        order = range(len(blocks))
        for k in order if turn % 2 == 0 else reversed(order):
            times[k].append(blocks[k]())
    return times


def paired_ratio(ours: Sequence[float], peer: Sequence[float]) -> tuple[float, float, float]:
    """Ratio of two series of rates that were measured in turn: median, least, greatest.

    Neighbouring blocks are compared, so that a slow drift of the machine cancels.
    """
    each = np.asarray(ours) / np.asarray(peer)
    return float(np.median(each)), float(each.min()), float(each.max())


def spread(found: tuple[float, float, float], digits: int = 2) -> str:
    """Median, least and greatest as text."""
    middle, low, high = (f"{value:.{digits}f}" for value in found)
    return f"{middle} ({low} to {high})"


def machine(*packages: str) -> dict[str, str]:
    """The computer and the versions of packages."""
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": str(os.cpu_count()),
        "python": platform.python_version(),
        **{name: version(name) for name in packages},
    }


def table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[str]] = (), caption: str = ""
) -> Table:
    """A table whose first column is left-aligned."""
    made = Table(title=Text(title), caption=Text(caption) if caption else None)
    made.title_justify = made.caption_justify = "left"
    for k, column in enumerate(columns):
        made.add_column(Text(column), justify="right" if k else "left")
    for cells in rows:
        made.add_row(*map(Text, cells))
    return made
