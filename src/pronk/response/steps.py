"""Sine steps: one frequency after another, each held for whole periods.

The slowest question and the cleanest: every step is read at its own frequency, and at three times
it, after the first period has let the joint settle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.response.estimator import Estimator
from pronk.response.grid import Grid, held_mean, hold, interpolate
from pronk.response.periodic import combined
from pronk.response.response import FrequencyResponse
from pronk.sweep.log import SweepLog

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_SETTLE_S = 0.25
"""Dropped at the head of each step, and a whole period at the least [s]."""
_MOST_BLOCKS = 8
"""Blocks that a step is read in: enough to see the scatter."""
_SAME_HZ = 1e-6
"""Relative change of frequency that begins another step."""


@dataclass(frozen=True, kw_only=True)
class Steps:
    """What was read at each step of one question."""

    omega: Array
    """[rad/s], increasing, shape (f,)."""
    command: ComplexArray
    """At the frequency asked, per block, shape (b, f)."""
    position: ComplexArray
    """At the frequency asked, per block, shape (b, f)."""
    factor: ComplexArray
    """Grid factor of each step (`grid.hold`), shape (f,)."""
    third: Array
    """Position at three times the frequency over that at it, shape (f,); NaN above Nyquist."""


def _runs(frequency: Array) -> list[tuple[int, int]]:
    """First and one-past-last sample of each stretch of constant frequency."""
    known = np.isfinite(frequency) & (frequency > 0.0)
    filled = np.where(known, frequency, -1.0)
    new = np.flatnonzero(np.abs(np.diff(filled)) > _SAME_HZ * np.abs(filled[1:])) + 1
    edges = [0, *new.tolist(), len(filled)]
    return [(a, b) for a, b in pairwise(edges) if filled[a] > 0.0]


def read_steps(log: SweepLog, joint: str, estimator: Estimator, rate_hz: float) -> Steps:
    """Read every step of one question inside the band.

    Args:
        log: One question (`SweepLog.cut`) with its instantaneous frequency.
        joint: The joint asked.
        estimator: Gives the band.
        rate_hz: About the rate of the grid; each step takes a whole number of samples a period.

    Raises:
        LogError: No frequency channel, no step in the band, or steps of fewer than three periods.
    """
    where = log.source or "log"
    if log.frequency is None:
        raise LogError(
            f"{where}: sine steps without the channel of instantaneous frequency; give it, or call "
            "the segment `unknown` to have it averaged by segments."
        )
    column = log.column(joint)
    command, position = log.command[:, column], log.position[:, column]
    steps = []
    for first, stop in _runs(log.frequency):
        hz = float(log.frequency[first])
        if not estimator.min_hz - 1e-9 <= hz <= estimator.top_hz(rate_hz) + 1e-9:
            continue
        # The last sample's interval belongs to the step as well.
        span = float(log.time[stop - 1] - log.time[first]) + 1.0 / rate_hz
        dropped = max(1, int(np.ceil(_SETTLE_S * hz)))
        steps.append((hz, first, dropped, int(np.floor(span * hz + 0.01)) - dropped))
    if not steps:
        raise LogError(
            f"{where}: no sine step of {joint} between {estimator.min_hz:g} and "
            f"{estimator.top_hz(rate_hz):g} Hz."
        )
    hz, _, dropped, periods = min(steps, key=lambda step: step[3])
    if periods < 2:
        raise LogError(
            f"{where}: the step at {hz:g} Hz lasts {dropped + max(periods, 0)} periods; "
            f"{dropped + 2} are needed ({dropped} to settle, 2 to compare)."
        )
    blocks = min(periods, _MOST_BLOCKS)
    rows = []
    for hz, first, dropped, periods in sorted(steps):
        each = periods // blocks
        samples = max(4, round(each * rate_hz / hz))
        grid = Grid(
            start=float(log.time[first]) + dropped / hz,
            rate_hz=samples * hz / each,
            count=samples * blocks,
        )
        u = held_mean(log.time, command, grid).reshape(blocks, samples)
        y = interpolate(log.time, position, grid).reshape(blocks, samples)
        turn = 2j * np.pi * each * np.arange(samples) / samples
        once, thrice = np.exp(-turn) / samples, np.exp(-3.0 * turn) / samples
        omega = 2.0 * np.pi * hz
        seen = 3.0 * hz < grid.rate_hz / 2.0
        ratio = abs((y @ thrice).mean()) / abs((y @ once).mean()) if seen else float("nan")
        factor = hold(np.array([omega]), grid.rate_hz)[0]
        rows.append((omega, u @ once, y @ once, factor, ratio))
    omegas, us, ys, factors, thirds = zip(*rows, strict=True)
    return Steps(
        omega=np.array(omegas),
        command=np.stack(us, axis=1),
        position=np.stack(ys, axis=1),
        factor=np.array(factors),
        third=np.array(thirds),
    )


def estimate_steps(
    parts: Sequence[SweepLog], joint: str, amplitude: float, estimator: Estimator, rate_hz: float
) -> FrequencyResponse:
    """Response at the frequencies of sine steps, averaged over periods and questions.

    `repeats` holds one row per question if there are three or more, one per block of whole
    periods otherwise.

    Args:
        parts: The questions, one log each (`SweepLog.cut`).
        joint: The joint asked.
        amplitude: Peak of the command [rad].
        estimator: Gives the band.
        rate_hz: About the rate of the analysis grid.

    Raises:
        LogError: As `read_steps`, or questions with different frequencies.
    """
    read = [read_steps(part, joint, estimator, rate_hz) for part in parts]
    for other in read[1:]:
        if other.omega.shape != read[0].omega.shape or not np.allclose(other.omega, read[0].omega):
            raise LogError(
                f"{parts[0].source or 'log'}: the sine steps of {joint} ask different frequencies; "
                "repeat the same ones."
            )
    return combined(
        [r.command for r in read],
        [r.position for r in read],
        read[0].factor,
        omega=read[0].omega,
        joint=joint,
        amplitude=amplitude,
        window=f"whole periods of each step, the first and at least {_SETTLE_S:g} s dropped",
        segment_s=float(2.0 * np.pi / read[0].omega[0]),
        virtual=parts[0].virtual,
        source=parts[0].source,
    )
