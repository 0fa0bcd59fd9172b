"""Real-time settings of the operating system, and pacing by absolute deadlines.

Nothing here is needed for a loop to be right, only for it to be on time; so what is not granted is
reported and the loop runs without it.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

_LOCK_NOW_AND_LATER = 3
"""MCL_CURRENT | MCL_FUTURE of mlockall(2)."""
_LEAST_CORES = 4
"""Fewest cores of which one can be given away."""


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """Settings requested by a process."""

    priority: int | None = None
    """Of SCHED_FIFO, 1 to 99; None for ordinary scheduling."""
    core: int | None = None
    """To run on and nowhere else, counted from the last one; None for any."""
    lock: bool = True
    """Keep its memory from being paged out."""


def enter(wanted: Wanted) -> tuple[str, ...]:
    """Request settings for this process; return one line for each reply.

    The garbage of what is loaded so far is collected and then left alone for good: a collection in
    the middle of a loop takes milliseconds.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    return (*_schedule(wanted.priority), *_pin(wanted.core), *_lock(wanted.lock))


def _schedule(priority: int | None) -> Iterator[str]:
    if priority is None:
        return
    may = "the loop may be late under load"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except AttributeError:
        yield f"real-time scheduling: this system has none; {may}"
    except PermissionError:
        yield (
            f"real-time scheduling: refused; {may} (grant it with `rtprio 60` for your user in "
            "/etc/security/limits.conf)"
        )
    except OSError as error:
        yield f"real-time scheduling: refused ({error.strerror}); {may}"
    else:
        yield f"real-time scheduling: SCHED_FIFO {priority}"


def _pin(core: int | None) -> Iterator[str]:
    if core is None:
        return
    try:
        cores = sorted(os.sched_getaffinity(0))
        mine = cores[-1 - core % len(cores)]
        if len(cores) < _LEAST_CORES:
            yield f"core of its own: {len(cores)} cores are too few to give one away"
            return
        os.sched_setaffinity(0, {mine})
    except AttributeError:
        yield "core of its own: this system does not pin processes"
    except OSError as error:
        yield f"core of its own: refused ({error.strerror})"
    else:
        yield f"core of its own: number {mine}"


def _lock(wanted: bool) -> Iterator[str]:
    if not wanted:
        return
    try:
        done = ctypes.CDLL(None, use_errno=True).mlockall(_LOCK_NOW_AND_LATER)
    except (OSError, AttributeError, TypeError):
        yield "memory: this system cannot lock it"
        return
    name = os.strerror(ctypes.get_errno() or errno.EPERM)
    yield (
        "memory: locked"
        if done == 0
        else (
            f"memory: not locked ({name}); a page fault may delay a tick (grant it with "
            "`memlock unlimited` for your user in /etc/security/limits.conf)"
        )
    )


def sleep_until(deadline: float) -> None:
    """Sleep to a time of CLOCK_MONOTONIC [s]; at once if it has passed."""
    left = deadline - time.monotonic()
    if left > 0.0:
        time.sleep(left)


class Pace:
    """Ticks at absolute deadlines.

    Lateness never adds up, and missed ticks are counted, not made up for.
    """

    def __init__(self, rate_hz: float, start: float | None = None) -> None:
        """Begin.

        Args:
            rate_hz: Ticks per second.
            start: Deadline of tick 0 on CLOCK_MONOTONIC [s]; now if left out.
        """
        self.rate_hz = rate_hz
        self.start = time.monotonic() if start is None else start
        self.tick = 0
        """Number of the next tick."""
        self.missed = 0
        """Ticks left out because they had passed."""

    @property
    def deadline(self) -> float:
        """Of the next tick [s]."""
        return self.start + self.tick / self.rate_hz

    def advance(self, now: float) -> None:
        """The tick is done; go to the next one that has not passed."""
        following = max(self.tick + 1, math.ceil((now - self.start) * self.rate_hz))
        self.missed += following - self.tick - 1
        self.tick = following


_PER_DECADE = 50
_LOWEST = 1e-7


class Histogram:
    """How long something took, in bins of 4.7 % width from 0.1 us to 10 s."""

    def __init__(self) -> None:
        self.counts = np.zeros(8 * _PER_DECADE + 1, dtype=np.int64)
        self.count = 0
        self.largest = 0.0
        """[s]"""

    def add(self, seconds: float) -> None:
        """Count one."""
        place = math.log10(max(seconds, _LOWEST) / _LOWEST) * _PER_DECADE
        self.counts[min(int(place), len(self.counts) - 1)] += 1
        self.count += 1
        self.largest = max(self.largest, seconds)

    def quantile(self, share: float) -> float:
        """Upper edge of the bin in which the given share of all lies [s]; NaN without any."""
        if not self.count:
            return math.nan
        rank = max(1, math.ceil(share * self.count - 1e-9))
        i = int(np.searchsorted(np.cumsum(self.counts), rank))
        return min(_LOWEST * math.pow(10.0, (i + 1) / _PER_DECADE), self.largest)

    def figures(self) -> dict[str, float | int]:
        """The usual quantiles [ms], the largest and the count."""
        return {
            "n": self.count,
            "p50_ms": 1e3 * self.quantile(0.5),
            "p95_ms": 1e3 * self.quantile(0.95),
            "p99_ms": 1e3 * self.quantile(0.99),
            "p99_9_ms": 1e3 * self.quantile(0.999),
            "max_ms": 1e3 * self.largest,
        }
