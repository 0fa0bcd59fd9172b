"""Blocks of work in turn, paired ratios, and the output that the benchmarks share."""

from __future__ import annotations

import json
import os
import platform
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from importlib.metadata import version
from itertools import chain, repeat
from multiprocessing import Pool
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pronk.cli import console
from pronk.errors import PronkError
from pronk.processes import pool
from pronk.tables import Table

T = TypeVar("T")
R = TypeVar("R")
Row = dict[str, Any]
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
    with Pool(jobs) as workers:
        yield from workers.imap_unordered(work, items)


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


def rows_of(work: Iterable[Callable[[], list[Row]]], jobs: int, out: Path | None) -> Iterator[Row]:
    """Do work in `jobs` processes; rows in the order of the work, each appended to `out` in JSON.

    `work` may be endless; what is under way when the caller has enough is lost.
    """
    under_way: deque[Future[list[Row]]] = deque()
    with pool(jobs) as workers:
        try:
            for call in chain(work, repeat(None)):
                if call is not None:
                    under_way.append(workers.submit(call))
                elif not under_way:
                    return
                if call is None or len(under_way) > 3 * jobs:
                    for row in under_way.popleft().result():
                        if out is not None:
                            with out.open("a", encoding="utf-8") as file:
                                file.write(json.dumps(row) + "\n")
                        yield row
        finally:
            workers.shutdown(wait=False, cancel_futures=True)


def rows_in(out: Path | None) -> list[Row]:
    """Rows that an earlier run has left in a file of `rows_of`."""
    if out is None or not out.exists():
        return []
    return [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]


def write_section(page: Path, name: str, text: str) -> None:
    """Replace what a page has between `<!-- NAME -->` and `<!-- end of NAME -->`.

    Args:
        page: A page of docs, whose other text is written by hand.
        name: Name of the section.
        text: Markdown of the section.

    Raises:
        PronkError: The page has no such section.
    """
    begin = f"<!-- {name} -->\n"
    end = f"<!-- end of {name} -->"
    written = page.read_text(encoding="utf-8")
    if begin not in written or end not in written:
        raise PronkError(f"{page} has no section {begin.strip()} ... {end}; it is not changed.")
    before, _, rest = written.partition(begin)
    _, _, after = rest.partition(end)
    page.write_text(f"{before}{begin}\n{text.strip()}\n\n{end}{after}", encoding="utf-8")
