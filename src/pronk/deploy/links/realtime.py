r"""Real-time settings, pacing by absolute deadlines, and signals of a terminal.

Ctrl-C, Ctrl-\, Ctrl-Z and the end of the terminal, as of an ssh connection, go to every process of
the foreground program. A process that moves a robot must damp the joints before it ends, so it
receives none of them: `terminal_blocked` while it starts, `leave` when it runs. The program that
started it receives them, and ends it in order: `Interrupts`.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any, Self

import numpy as np

_LOCK_NOW_AND_LATER = 3
"""MCL_CURRENT | MCL_FUTURE of mlockall(2)."""
_LEAST_CORES = 4
"""Smallest number of cores of which one can be reserved."""

TERMINAL = (signal.SIGINT, signal.SIGQUIT, signal.SIGTSTP, signal.SIGHUP)
r"""Ctrl-C, Ctrl-\, Ctrl-Z, and the terminal's end."""
ENDING = (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP, signal.SIGTERM)
"""Signals that end a program."""


@dataclass(frozen=True, kw_only=True)
class RealTimeSettings:
    """Settings that a process requests of the operating system."""

    priority: int | None = None
    """Priority of SCHED_FIFO, 1 to 99; None for ordinary scheduling."""
    core: int | None = None
    """The only core to run on, counted from the last; None for any."""
    lock: bool = True
    """Whether its memory is kept from being paged out."""


def enter(settings: RealTimeSettings) -> tuple[str, ...]:
    """Request settings for this process; return one line for each, granted or refused.

    Garbage collection stops for good: a collection in a loop takes milliseconds.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    lines = []
    if settings.priority is not None:
        lines.append(f"real-time scheduling: {_granted(_schedule, settings.priority)}")
    if settings.core is not None:
        lines.append(f"core of its own: {_granted(_pin, settings.core)}")
    if settings.lock:
        lines.append(f"memory: {_granted(_lock)}")
    return tuple(lines)


def _granted(request: Callable[..., str], *values: int) -> str:
    """Make a request of the operating system; return what was granted, or why it was refused."""
    try:
        return request(*values)
    except (AttributeError, TypeError):
        return "this system has no such setting; the loop may be late under load"
    except OSError as error:
        return (
            f"refused ({error.strerror}); the loop may be late under load (grant it with "
            "`rtprio 60` and `memlock unlimited` for your user in /etc/security/limits.conf)"
        )


def _schedule(priority: int) -> str:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    return f"SCHED_FIFO {priority}"


def _pin(core: int) -> str:
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < _LEAST_CORES:
        return f"{len(cores)} cores are too few to reserve one"
    reserved = cores[-1 - core % len(cores)]
    os.sched_setaffinity(0, {reserved})
    return f"number {reserved}"


def _lock() -> str:
    if ctypes.CDLL(None, use_errno=True).mlockall(_LOCK_NOW_AND_LATER):
        number = ctypes.get_errno() or errno.EPERM
        raise OSError(number, os.strerror(number))
    return "locked"


def sleep_until(deadline: float) -> None:
    """Sleep to a time of CLOCK_MONOTONIC [s]; return at once if it has passed."""
    # Even a sleep of 0 s gives the core away, and takes the timer slack of 50 us.
    remaining = deadline - time.monotonic()
    if remaining > 0.0:
        time.sleep(remaining)


class Pace:
    """Ticks at absolute deadlines: lateness does not accumulate, missed ticks are counted."""

    def __init__(self, rate_hz: float, start: float | None = None) -> None:
        """Begin with tick 0 due at `start` on CLOCK_MONOTONIC [s], by default now."""
        self.rate_hz = rate_hz
        self.start = time.monotonic() if start is None else start
        self.tick = 0
        """Number of the next tick."""
        self.missed = 0
        """Number of ticks that had passed before they could be run."""

    @property
    def deadline(self) -> float:
        """Time of the next tick [s]."""
        return self.start + self.tick / self.rate_hz

    def advance(self, now: float) -> None:
        """Go to the next tick that has not passed."""
        following = max(self.tick + 1, math.ceil((now - self.start) * self.rate_hz))
        self.missed += following - self.tick - 1
        self.tick = following


_BINS_PER_DECADE = 50
_SHORTEST_S = 1e-7


class Histogram:
    """Durations in bins of 4.7 % width from 0.1 us to 10 s."""

    def __init__(self) -> None:
        self.counts = np.zeros(8 * _BINS_PER_DECADE + 1, dtype=np.int64)
        self.count = 0
        self.largest = 0.0
        """Longest duration [s]."""

    def add(self, seconds: float) -> None:
        """Count a duration."""
        place = math.log10(max(seconds, _SHORTEST_S) / _SHORTEST_S) * _BINS_PER_DECADE
        self.counts[min(int(place), len(self.counts) - 1)] += 1
        self.count += 1
        self.largest = max(self.largest, seconds)

    def quantile(self, share: float) -> float:
        """Upper edge of the bin that holds a quantile [s]; NaN without any duration."""
        if not self.count:
            return math.nan
        rank = max(1, math.ceil(share * self.count - 1e-9))
        i = int(np.searchsorted(np.cumsum(self.counts), rank))
        return min(_SHORTEST_S * math.pow(10.0, (i + 1) / _BINS_PER_DECADE), self.largest)

    def figures(self) -> dict[str, float | int]:
        """Count, quantiles and maximum [ms]."""
        return {
            "n": self.count,
            "p50_ms": 1e3 * self.quantile(0.5),
            "p95_ms": 1e3 * self.quantile(0.95),
            "p99_ms": 1e3 * self.quantile(0.99),
            "p99_9_ms": 1e3 * self.quantile(0.999),
            "max_ms": 1e3 * self.largest,
        }


@contextmanager
def terminal_blocked() -> Iterator[None]:
    """Block the signals of the terminal, also in processes started meanwhile; pending ones wait."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, TERMINAL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def leave() -> None:
    """Leave the terminal's session and ignore its signals; PermissionError for a group leader."""
    os.setsid()
    for number in TERMINAL:
        signal.signal(number, signal.SIG_IGN)


class Interrupts:
    """Context that records signals that end the program; `check` raises them.

    Outside the main thread, where Python receives no signals, it records none.
    """

    def __init__(self) -> None:
        self.received = False
        """Whether a signal has come since the last check."""
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        """Begin to record."""
        if threading.current_thread() is threading.main_thread():
            for number in ENDING:
                before = signal.getsignal(number)
                # What is ignored, as by nohup, stays so.
                if before not in (signal.SIG_IGN, None):
                    self._before[number] = before
                    signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the earlier handlers, the first time."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal has come since the last check."""
        if self.received:
            self.received = False
            raise KeyboardInterrupt

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self.received = True
