"""How many trainings run side by side on one GPU: by free memory and by the rates they reach.

Side by side, trainings share what a single one leaves idle (on an H200 under MPS: one of 4,096
robots 160,000 steps/s, three 97,000 each, four 87,000 each). The first training of each GPU shows
the memory that one needs, and each further one is added when the trainings before it have shown
their rate. A further one is refused when memory is short, or when the last one added less than
`LEAST_GAIN` to the rate of all together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

LEAST_GAIN = 0.03
"""Least growth of the rate of all trainings on a GPU for which another one is added [1]."""
MEMORY_MARGIN = 1.15
"""Memory that has to be free for another training, relative to what one has used [1]. The memory of
a training grows a little when the phase of jumps begins."""
SETTLE_S = 8.0
"""Time for which the same trainings have to step side by side until their rates count [s]: the
first iterations are slower."""


@dataclass(frozen=True, kw_only=True)
class RateReading:
    """What a training has written about its rate."""

    written_at: float
    """Unix time at which it was written [s]."""
    steps_per_second: float
    """Rate of the iteration that had just ended [steps/s]."""
    iteration_s: float
    """Duration of that iteration [s]."""
    is_last: bool
    """Whether that was the last iteration, so that the training steps no more."""


def settled_rates(readings: Sequence[RateReading], same_since: float) -> list[float]:
    """Return the rates of trainings side by side [steps/s]; empty unless all of them count.

    A training that steps no more leaves its share of the GPU to the others, and the rate of an
    iteration that began before another training ended was reached beside that one.

    Args:
        readings: What each training of a GPU has written last.
        same_since: Unix time from which these trainings, and no others, have stepped there [s].
    """
    rates = []
    for reading in readings:
        is_early = reading.written_at < same_since + max(SETTLE_S, reading.iteration_s)
        if reading.is_last or is_early:
            return []
        rates.append(reading.steps_per_second)
    return rates


@dataclass
class GpuRates:
    """What was measured of trainings side by side, on any GPU of this host."""

    totals: dict[int, float] = field(default_factory=dict)
    """Mean steps/s of all trainings on a GPU together, by their number."""
    notes: dict[int, int] = field(default_factory=dict)
    """How often that was measured, by the same number."""
    limit: int | None = None
    """Number of trainings on one GPU beyond which no more are started; None while not known."""
    reason: str = ""
    """Why that is the limit."""

    def note(self, rates: Sequence[float]) -> None:
        """Take note of the rates of trainings that run side by side [steps/s]."""
        total = math.fsum(rates)
        count = len(rates)
        self.notes[count] = self.notes.get(count, 0) + 1
        mean = self.totals.get(count, 0.0)
        self.totals[count] = mean + (total - mean) / self.notes[count]
        before = self.totals.get(count - 1)
        if self.limit is not None or before is None:
            return
        if self.totals[count] < (1.0 + LEAST_GAIN) * before:
            self.limit = max(count - 1, 1)
            self.reason = (
                f"{count} side by side reached {total:,.0f} steps/s, {count - 1} {before:,.0f}"
            )

    def note_memory(self, count: int, free_mib: float, needed_mib: float) -> None:
        """Take note of the memory that is free beside some trainings, and that one needs [MiB]."""
        if self.limit is None and free_mib < MEMORY_MARGIN * needed_mib:
            self.limit = max(count, 1)
            self.reason = (
                f"{free_mib / 1024.0:.1f} GiB are free beside {count}, and one needs "
                f"{needed_mib / 1024.0:.1f} GiB"
            )

    def may_add(self, count: int, are_settled: bool) -> bool:
        """Return whether another training may be started on a GPU.

        Args:
            count: Number of trainings that run there.
            are_settled: Whether all of them have shown their rate since the last one was added.
        """
        if count == 0:
            return True
        if self.limit is not None:
            return count < self.limit
        # Another GPU may have shown already that one more fits.
        return are_settled or count + 1 in self.totals


def packing_text(rates: GpuRates) -> str:
    """Return one sentence on how many trainings ran side by side and at which rate."""
    if not rates.totals:
        return ""
    count = max(rates.totals)
    total = rates.totals[count]
    text = (
        f"{count} side by side on a GPU: {total / count:,.0f} steps/s each, {total:,.0f} together"
    )
    if count == 1:
        text = f"1 training at a time on a GPU: {total:,.0f} steps/s"
    alone = rates.totals.get(1)
    if alone is not None and count > 1:
        text += f", against {alone:,.0f} alone"
    if rates.reason:
        text += f"; no more: {rates.reason}"
    return f"{text}."


def free_memory_mib(text: str) -> Mapping[str, float]:
    """Return the free memory of each GPU, by its number and by its UUID [MiB].

    Args:
        text: What `nvidia-smi` prints of index, uuid and memory.free, as CSV without heading and
            units.
    """
    free = {}
    for line in text.splitlines():
        words = [word.strip() for word in line.split(",")]
        if len(words) != 3:
            continue
        try:
            mebibytes = float(words[2])
        except ValueError:
            continue
        free[words[0]] = mebibytes
        free[words[1]] = mebibytes
    return free
