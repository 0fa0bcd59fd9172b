"""Independent jobs on the cores there are, and their results in order.

Jobs carry all they need, so that a result depends on nothing else: neither on how many processes
there are nor on which of them does what when.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from pronk.errors import PronkError

J = TypeVar("J")
R = TypeVar("R")


def cores() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


def in_processes(
    work: Callable[[J], R],
    jobs: Sequence[J],
    *,
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> list[R]:
    """Do every job and return the results in the order of the jobs.

    Args:
        work: A function of a module, that other processes can import.
        jobs: What it is called with; they are pickled.
        processes: How many at once; with one, everything happens in this process.
        progress: Called with the share done, 0 to 1.

    Raises:
        PronkError: Fewer than one process, or one was killed; and what `work` raises.
    """
    if processes < 1:
        raise PronkError(f"{processes} processes; expected 1 or more.")
    tell = progress or _silent
    if processes == 1 or len(jobs) <= 1:
        done = []
        for job in jobs:
            done.append(work(job))
            tell(len(done) / len(jobs))
        return done
    # A fork of a process that has threads can deadlock.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(processes, len(jobs)), mp_context=context) as pool:
        futures: list[Future[R]] = [pool.submit(work, job) for job in jobs]
        try:
            for count, future in enumerate(as_completed(futures), start=1):
                future.result()
                tell(count / len(jobs))
        except BrokenProcessPool:
            raise PronkError(
                "one of the processes was killed, most likely for want of memory; "
                "try again with --processes 1."
            ) from None
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [future.result() for future in futures]


def _silent(share: float) -> None:
    """Do nothing."""
