"""Measured timestamps: believed, and therefore examined.

A recorder that claims 50 Hz and runs at 49.85 is 0.36 s late after two minutes. Replaying rows at
the claimed rate hides that; here the stamps decide and the claim is checked against them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.errors import LogError

Array = NDArray[np.float64]

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds in each unit of time."""

PLAUSIBLE_HZ = (5.0, 50_000.0)
"""Rates outside are a wrong unit: below, nothing of a joint could be seen; above, no drive logs."""

RATE_TOLERANCE = 1e-3
"""Largest relative difference of the measured from a claimed rate. Crystals keep 1e-4; at 1e-3 a
20 s sweep slips by one 50 Hz tick from its end to its start."""

_GAP = 2.5
"""Intervals longer than this many typical ones are gaps: more than one sample is lost."""


@dataclass(frozen=True, kw_only=True)
class Timing:
    """What measured timestamps say of themselves."""

    samples: int
    duration_s: float
    rate_hz: float
    """Mean over the whole record."""
    typical_s: float
    """Median interval [s]."""
    jitter_s: float
    """Standard deviation of the intervals, gaps left out [s]."""
    drift_s: float
    """How far the stamps stray from a straight line, largest absolute value [s]."""
    gaps: tuple[tuple[float, float], ...] = ()
    """Start [s] and length [s] of each interval in which samples are missing."""
    duplicates: int = 0
    """Stamps that repeat the one before."""

    @property
    def lost(self) -> int:
        """Samples missing in the gaps, by the typical interval."""
        return sum(round(length / self.typical_s) - 1 for _, length in self.gaps)

    def words(self) -> str:
        """One line for a log's notes."""
        text = (
            f"{self.samples} samples at {self.rate_hz:.2f} Hz over {self.duration_s:.2f} s, "
            f"jitter {1e3 * self.jitter_s:.3f} ms, drift {1e3 * self.drift_s:.2f} ms"
        )
        if self.gaps:
            start, length = max(self.gaps, key=lambda gap: gap[1])
            text += (
                f", {len(self.gaps)} gaps with about {self.lost} samples lost (the longest "
                f"{length:.3f} s at {start:.3f} s)"
            )
        return text


def examine(time: Array) -> Timing:
    """Rate, jitter, drift, gaps and duplicates of timestamps.

    Args:
        time: Measured timestamps, not decreasing [s], shape (n,), n at least 2.
    """
    steps = np.diff(time)
    typical = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    gap = steps > _GAP * typical
    straight = np.polynomial.Polynomial.fit(np.arange(len(time)), time, 1)
    duration = float(time[-1] - time[0])
    return Timing(
        samples=len(time),
        duration_s=duration,
        rate_hz=(len(time) - 1) / duration if duration > 0.0 else float("inf"),
        typical_s=typical,
        jitter_s=float(np.std(steps[~gap])) if (~gap).any() else 0.0,
        drift_s=float(np.abs(time - straight(np.arange(len(time)))).max()),
        gaps=tuple((float(time[i]), float(steps[i])) for i in np.flatnonzero(gap)),
        duplicates=int((steps == 0.0).sum()),
    )


def check_increasing(time: Array, where: str, row: Callable[[int], str]) -> None:
    """Refuse timestamps that are not finite, repeat or go back.

    Args:
        time: Timestamps in any unit, shape (n,).
        where: File, for the message.
        row: Names a sample as the user finds it in the file, for instance `row 7`.

    Raises:
        LogError: Names the row.
    """
    if len(time) < 2:
        raise LogError(f"{where}: {len(time)} samples; a log needs at least 2.")
    if not np.isfinite(time).all():
        lost = row(int(np.argmin(np.isfinite(time))))
        raise LogError(f"{where}: the timestamp in {lost} is missing or not a number.")
    steps = np.diff(time)
    if (steps > 0.0).all():
        return
    i = int(np.argmin(steps > 0.0)) + 1
    if steps[i - 1] == 0.0:
        raise LogError(
            f"{where}: {row(i)} repeats the timestamp {time[i]:.9g} of the one before; timestamps "
            "must increase (drop_duplicates=True drops rows that repeat the one before in full)."
        )
    raise LogError(
        f"{where}: time goes back in {row(i)}, from {time[i - 1]:.9g} to {time[i]:.9g}; sort or "
        "split the file."
    )


def check_unit(time: Array, where: str, unit: str) -> None:
    """Refuse timestamps whose rate betrays another unit.

    Args:
        time: Increasing timestamps, already converted to what `unit` says [s], shape (n,).
        where: File, for the message.
        unit: Unit they were read in, one of `TIME_UNITS`.

    Raises:
        LogError: Names the likely unit.
    """
    rate = 1.0 / float(np.median(np.diff(time)))
    low, high = PLAUSIBLE_HZ
    if low <= rate <= high:
        return
    likely = [
        name
        for name, scale in TIME_UNITS.items()
        if name != unit and low <= rate * TIME_UNITS[unit] / scale <= high
    ]
    # Where several fit, the one nearest to the 500 Hz at which joints are usually logged.
    likely.sort(key=lambda name: abs(np.log(rate * TIME_UNITS[unit] / TIME_UNITS[name] / 500.0)))
    hint = (
        f"the timestamps are probably in {likely[0]} (time_unit={likely[0]!r})"
        if likely
        else "no unit of time makes sense of them"
    )
    raise LogError(
        f"{where}: read in {unit!r}, its samples come at {rate:.4g} Hz; expected {low:g} to "
        f"{high:g} Hz; {hint}."
    )


def check_claim(timing: Timing, where: str, claimed_hz: float) -> None:
    """Refuse a claimed rate that the stamps do not bear out.

    Raises:
        LogError: Gives both.
    """
    if not (np.isfinite(claimed_hz) and claimed_hz > 0.0):
        raise LogError(
            f"{where}: a rate of {claimed_hz} Hz is claimed; expected a positive number."
        )
    # Lost samples do not make the clock slow.
    measured = (timing.samples + timing.lost - 1) / timing.duration_s
    if abs(measured / claimed_hz - 1.0) > RATE_TOLERANCE:
        late = abs(timing.samples / claimed_hz - timing.samples / measured)
        raise LogError(
            f"{where}: {claimed_hz:g} Hz is claimed and {measured:.2f} Hz measured "
            f"({late:.2f} s apart by the end); leave the claim out, the measured stamps are used."
        )
