"""Processes that do work beside this one, and end with it."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from typing import TypeVar

from pronk.errors import PronkError

J = TypeVar("J")
R = TypeVar("R")

_SET_PARENT_DEATH_SIGNAL = 1
"""PR_SET_PDEATHSIG of prctl(2)."""


def die_with_parent(number: int = signal.SIGKILL) -> None:
    """Have the system send this process a signal when its parent ends, however that ends.

    Linux only; the parent is the thread that started this process.
    """
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None, use_errno=True).prctl(_SET_PARENT_DEATH_SIGNAL, int(number))
    parent = multiprocessing.parent_process()
    if parent is not None and parent.pid != os.getppid():  # It ended before.
        os.kill(os.getpid(), number)


@contextmanager
def pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of processes that die with this one; a fork of a program with threads hangs.

    At the end they are killed: the executor itself waits for each of them, so for ever for one that
    was stopped, or killed while it held the lock of the queue.
    """
    before, context = multiprocessing.active_children(), multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context, initializer=die_with_parent) as own:
        try:
            yield own
        finally:
            for process in multiprocessing.active_children():
                if process not in before:
                    process.kill()


def in_processes(
    work: Callable[[J], R],
    jobs: Sequence[J],
    *,
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> list[R]:
    """Do every job, in this process or in several; `work` is a function of a module."""
    if processes < 1:
        raise PronkError(f"{processes} processes; expected 1 or more.")
    done: list[R] = []
    with ExitStack() as stack:
        run: Callable[..., Iterator[R]] = map
        if processes > 1 and len(jobs) > 1:
            run = stack.enter_context(pool(min(processes, len(jobs)))).map
        try:
            for result in run(work, jobs):
                done.append(result)
                if progress is not None:
                    progress(len(done) / len(jobs))
        except BrokenProcessPool:
            raise PronkError(
                "one of the processes was killed, most likely for want of memory; "
                "give fewer files, joints or processes at a time."
            ) from None
    return done
