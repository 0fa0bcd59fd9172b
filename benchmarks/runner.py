"""Blocks of work in turn, paired ratios, and the output that the benchmarks share."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from multiprocessing import Pool
from typing import Any, TypeVar

import numpy as np
from rich.table import Table

from pronk.cli import console
from pronk.errors import PronkError

T = TypeVar("T")
R = TypeVar("R")
Progress = Callable[[str, float], None]
"""Called with the stage and the share done, 0 to 1."""


def in_turn(blocks: Sequence[Callable[[], float]], repeats: int) -> list[list[float]]:
    """Run blocks, each of which returns its time [s], in turn; every second turn backwards.

    Returns the times of each block, turn by turn [s].
    """
    times: list[list[float]] = [[] for _ in blocks]
    for turn in range(repeats):
        for k in range(len(blocks))[:: -1 if turn % 2 else 1]:
            times[k].append(blocks[k]())
    return times


def in_parallel(work: Callable[[T], R], items: Sequence[T], jobs: int) -> Iterator[R]:
    """Yield the results of a picklable function for each item as they are done, by processes.

    Raises:
        PronkError: `jobs` is less than 1.
    """
    if jobs < 1:
        raise PronkError(f"--jobs {jobs}; expected 1 or more.")
    with Pool(jobs) as pool:
        yield from pool.imap_unordered(work, items)


def paired_ratio(ours: Sequence[float], peer: Sequence[float]) -> tuple[float, float, float]:
    """Return the ratio of two series of rates measured in turn: median, least, greatest.

    Neighbouring blocks are compared, so that a slow drift of the machine cancels.
    """
    each = np.asarray(ours) / np.asarray(peer)
    return float(np.median(each)), float(each.min()), float(each.max())


def spread(found: tuple[float, float, float], digits: int = 2) -> str:
    """Format median, least and greatest."""
    middle, low, high = (f"{value:.{digits}f}" for value in found)
    return f"{middle} ({low} to {high})"


def machine(*packages: str) -> dict[str, str]:
    """Return the computer and the versions of packages."""
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": str(os.cpu_count()),
        "python": platform.python_version(),
        **{name: version(name) for name in packages},
    }


def finish(figures: dict[str, Any], *tables: Table) -> console.Outcome:
    """Print the tables of a benchmark."""
    for each in tables:
        console.show(each)
    return console.Outcome(figures=figures)
