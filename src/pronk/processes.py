"""Processes that do work beside this one, and end with it."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from typing import TypeVar

from pronk.errors import PronkError

Job = TypeVar("Job")
Result = TypeVar("Result")

_SET_PARENT_DEATH_SIGNAL = 1
"""PR_SET_PDEATHSIG of prctl(2)."""


def die_with_parent(number: int = signal.SIGKILL) -> None:
    """Have the system send this process a signal when its parent ends, however that ends.

    This works on Linux only. The parent is the thread that started this process.
    """
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None, use_errno=True).prctl(_SET_PARENT_DEATH_SIGNAL, int(number))
    parent = multiprocessing.parent_process()
    ended_already = parent is not None and parent.pid != os.getppid()
    if ended_already:
        os.kill(os.getpid(), number)


@contextmanager
def pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of processes that die with this one.

    They are spawned, since the fork of a program with threads can hang. At the end they are killed:
    the executor itself waits for each of them, so for ever for one that was stopped, or that was
    killed while it held the lock of the queue.
    """
    children_before = multiprocessing.active_children()
    executor = ProcessPoolExecutor(
        processes, mp_context=multiprocessing.get_context("spawn"), initializer=die_with_parent
    )
    with executor:
        try:
            yield executor
        finally:
            for child in multiprocessing.active_children():
                if child not in children_before:
                    child.kill()


def results_in_order(
    work: Callable[[Job], Result], jobs: Sequence[Job], *, processes: int = 1
) -> Iterator[Result]:
    """Do every job, in this process or in several, and yield each result as soon as it is there.

    Args:
        work: A function of a module, so that other processes can import it.
        jobs: Its arguments, one for each call; the results come in this order.
        processes: How many jobs are done at a time.

    Raises:
        PronkError: The number of processes is impossible, or one of them was killed.
    """
    if processes < 1:
        raise PronkError(f"{processes} processes; expected 1 or more.")
    if processes == 1 or len(jobs) <= 1:
        yield from map(work, jobs)
        return
    with pool(min(processes, len(jobs))) as executor:
        try:
            yield from executor.map(work, jobs)
        except BrokenProcessPool:
            raise PronkError(
                "one of the processes was killed, most likely for want of memory; "
                "give fewer files, joints or processes at a time."
            ) from None


def in_processes(
    work: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> list[Result]:
    """Do every job, in this process or in several, and return the results in order.

    Args:
        work: A function of a module, so that other processes can import it.
        jobs: Its arguments, one for each call.
        processes: How many jobs are done at a time.
        progress: Called with the share that is done, 0 to 1.

    Raises:
        PronkError: The number of processes is impossible, or one of them was killed.
    """
    results = []
    for result in results_in_order(work, jobs, processes=processes):
        results.append(result)
        if progress is not None:
            progress(len(results) / len(jobs))
    return results
