"""Processes that do work beside this one, and end with it."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, TypeVar

from pronk.errors import PronkError

Job = TypeVar("Job")
Result = TypeVar("Result")

_SET_PARENT_DEATH_SIGNAL = 1
"""PR_SET_PDEATHSIG of prctl(2)."""
FEWER_INPUTS = "give fewer files or joints at a time"
"""What to do if memory was short, where no option says how many processes there are."""
FEWER_PROCESSES = "give fewer --processes"
"""The same where one does."""
_CRASHES = (signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGABRT)
"""Signals that a program causes by what it does itself; any other one was sent to it."""
_NOTICE_S = 5.0
"""Longest time until the system says how a process ended that is known to have ended [s]."""
_mark: list[Any] = []
"""In a process of a pool: what all its processes do, and the place of this process in it."""


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


def exit_words(exit_code: int, way_out: str) -> str:
    """Return how a process ended that was not to end, behind "the process".

    Args:
        exit_code: Its exit status, or the negative number of a signal.
        way_out: What the caller can do if memory was short, as a clause.
    """
    if exit_code >= 0:
        return f"ended with exit status {exit_code}"
    try:
        name = signal.Signals(-exit_code).name
    except ValueError:  # a real-time signal
        name = "a signal"
    if -exit_code in _CRASHES:
        return f"crashed by {name} (signal {-exit_code})"
    if -exit_code == signal.SIGKILL:
        return (
            f"was killed by {name} (signal {-exit_code}), which pronk did not send. Likely causes "
            "are that memory ran out, which the system's log then says (`journalctl -k`), or that "
            f"a person or a scheduler of jobs ended it. If memory was short, {way_out}"
        )
    return (
        f"was ended by {name} (signal {-exit_code}), which pronk did not send, likely by a person "
        "or a scheduler of jobs"
    )


class _RecordingContext(SpawnContext):
    """Starts processes by spawn, and keeps them, so that their exit statuses can be read."""

    def __init__(self) -> None:
        super().__init__()
        self.children: list[SpawnProcess] = []

    def Process(  # type: ignore[override]  # noqa: N802
        self, *, target: Callable[..., Any], args: tuple[Any, ...]
    ) -> SpawnProcess:
        """Make a process, as a pool requests one; the names are multiprocessing's."""
        child = SpawnProcess(target=target, args=args)
        self.children.append(child)
        return child


@contextmanager
def pool(
    processes: int, *, names: Sequence[str] = (), way_out: str = "free some and run it again"
) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of processes that die with this one.

    They are spawned, since the fork of a program with threads can hang. At the end they are killed:
    the executor itself waits for each of them, so for ever for one that was stopped, or that was
    killed while it held the lock of the queue.

    Args:
        processes: Number of processes.
        names: What each job is, in a few words, for the message of a process that was killed. One
            name is that of all jobs.
        way_out: What the caller can do if memory was short, as a clause.

    Raises:
        PronkError: A process ended in the midst of its work.
    """
    context = _RecordingContext()
    # Number of each process and, from 1, of the job that it does; 0 between jobs.
    marks = context.Array("q", 2 * processes, lock=False)
    begun = context.Value("q", 0)
    executor = ProcessPoolExecutor(
        processes, mp_context=context, initializer=_begin_process, initargs=(marks, begun)
    )
    # Have the executor start all processes before the thread that watches them, as it does if they
    # are forked. It else starts one with each job, and fails in several ways where one of them is
    # killed meanwhile: a queue is closed, or a dictionary changes while that thread reads it.
    executor._safe_to_dynamically_spawn_children = False  # type: ignore[attr-defined]
    with executor:
        try:
            yield executor
        except BrokenProcessPool as error:
            if error.__cause__ is not None:
                raise  # A job or a result could not be passed on; no process has ended.
            text = _ended_text(context.children, list(marks), names, way_out)
            raise PronkError(text) from None
        finally:
            for child in context.children:
                if child.is_alive():
                    child.kill()


def _begin_process(marks: Any, begun: Any) -> None:
    """Prepare a process of a pool.

    Args:
        marks: What all processes of the pool do.
        begun: How many have begun before.
    """
    die_with_parent()
    with begun.get_lock():
        place = begun.value
        begun.value += 1
    marks[2 * place] = os.getpid()
    _mark[:] = [marks, place]


def _do_job(work: Callable[[Job], Result], number: int, job: Job) -> Result:
    """Do a job in a process of a pool, which shows its number meanwhile."""
    marks, place = _mark
    marks[2 * place + 1] = number
    result = work(job)
    marks[2 * place + 1] = 0
    return result


def _ended_text(
    children: Sequence[SpawnProcess], marks: Sequence[int], names: Sequence[str], way_out: str
) -> str:
    """Return which process of a pool has ended, how, and in which job.

    Args:
        children: All processes; the executor ends the others by SIGTERM.
        marks: Number of each process, and of its job.
        names: What each job is.
        way_out: What the caller can do if memory was short.
    """
    codes: dict[int, int] = {}
    deadline = time.monotonic() + _NOTICE_S
    is_known = False
    while not is_known and time.monotonic() < deadline:
        time.sleep(0.01)
        for child in children:
            if child.pid is not None and child.exitcode is not None:
                codes[child.pid] = child.exitcode
        is_known = len(codes) == len(children)
        for code in codes.values():
            is_known = is_known or code not in (0, -signal.SIGTERM)
    jobs_by_process = dict(zip(marks[::2], marks[1::2], strict=True))
    texts = []
    for process, code in codes.items():
        if code in (0, -signal.SIGTERM):
            continue
        number = jobs_by_process.get(process, 0)
        job = ""
        if number:
            job = names[number - 1] if number <= len(names) else f"job {number}"
        elif len(names) == 1:
            job = names[0]
        place = f", at work on {job}," if job else ""
        texts.append(f"a process of this command{place} {exit_words(code, way_out)}.")
    if not texts:
        # Which of them was the first does not show: the executor ends the others alike.
        return (
            "a process of this command was ended before its work was done, likely by a person or "
            "a scheduler of jobs; run the command again."
        )
    return " ".join(texts)


def results_in_order(
    work: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    processes: int = 1,
    names: Sequence[str] = (),
    way_out: str = FEWER_INPUTS,
) -> Iterator[Result]:
    """Do every job, in this process or in several, and yield each result as soon as it is there.

    Args:
        work: A function of a module, so that other processes can import it.
        jobs: Its arguments, one for each call; the results come in this order.
        processes: How many jobs are done at a time.
        names: What each job is, in a few words, for the message of a process that was killed.
        way_out: What the caller can do if memory was short, as a clause.

    Raises:
        PronkError: The number of processes is impossible, or one of them was killed.
    """
    if processes < 1:
        raise PronkError(f"{processes} processes; expected 1 or more.")
    if processes == 1 or len(jobs) <= 1:
        yield from map(work, jobs)
        return
    count = min(processes, len(jobs))
    with pool(count, names=names, way_out=way_out) as executor:
        numbers = range(1, len(jobs) + 1)
        try:
            results = executor.map(partial(_do_job, work), numbers, jobs)
        except BrokenPipeError:
            # A process was killed while it was started.
            raise BrokenProcessPool from None
        yield from results


def in_processes(
    work: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    processes: int = 1,
    names: Sequence[str] = (),
    way_out: str = FEWER_INPUTS,
    progress: Callable[[float], None] | None = None,
) -> list[Result]:
    """Do every job, in this process or in several, and return the results in order.

    Args:
        work: A function of a module, so that other processes can import it.
        jobs: Its arguments, one for each call.
        processes: How many jobs are done at a time.
        names: What each job is, in a few words, for the message of a process that was killed.
        way_out: What the caller can do if memory was short, as a clause.
        progress: Called with the share that is done, 0 to 1.

    Raises:
        PronkError: The number of processes is impossible, or one of them was killed.
    """
    results = []
    in_order = results_in_order(work, jobs, processes=processes, names=names, way_out=way_out)
    for result in in_order:
        results.append(result)
        if progress is not None:
            progress(len(results) / len(jobs))
    return results
