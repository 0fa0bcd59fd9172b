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
from scipy.ndimage import uniform_filter1d
from scipy.signal import get_window

from pronk.errors import LogError
from pronk.logs.joint_log import JointLog
from pronk.response.estimator import Estimator
from pronk.response.grid import Grid, held_mean, hold, interpolate
from pronk.response.periodic import combined
from pronk.response.response import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_SETTLE_S = 0.5
"""Dropped at the head of each step, a whole period at the least, and beside a ramp [s]."""
_MOST_BLOCKS = 4
"""Blocks that a step is read in: enough to see the scatter, few enough to hold several periods."""
_STEADY = 0.1
"""Largest deviation of a period of the command from the median one: ramps fall out."""
_FINE = 4
"""How much finer than the log the grid of a step is: its period seldom fits the ticks of the
command, and the images of a held command must not fold back onto the line."""
_SAME_HZ = 1e-6
"""Relative change of frequency that begins another step."""


@dataclass(frozen=True, kw_only=True)
class Steps:
    """What was read at each step of one question."""

    omega: Array
    """[rad/s], increasing, shape (f,)."""
    command: ComplexArray
    """At the excited frequency, per block, shape (b, f)."""
    position: ComplexArray
    """At the excited frequency, per block, shape (b, f)."""
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


def _steady(time: Array, command: Array, span: float, hz: float, rate_hz: float) -> tuple[int, int]:
    """First and one-past-last period of a step, counted from its start, that is steady."""
    settle = max(1, int(np.ceil(_SETTLE_S * hz)))
    periods = int(np.floor(span * hz + 0.01))
    if periods <= settle:
        return settle, periods
    samples = max(4, round(rate_hz / hz))
    grid = Grid(start=float(time[0]), rate_hz=samples * hz, count=samples * periods)
    turn = np.exp(-2j * np.pi * np.arange(samples) / samples)
    found = held_mean(time, command, grid).reshape(periods, samples) @ turn
    # Smoothed, or the images of a held command would make single periods look unlike.
    size = np.abs(uniform_filter1d(found, settle, mode="nearest"))
    even = np.flatnonzero(np.abs(size - np.median(size)) <= _STEADY * np.median(size))
    if len(even) == 0:
        return settle, settle
    end = int(even[-1]) + 1
    return int(even[0]) + settle, end if end == periods else end - settle


def read_steps(log: JointLog, joint: str, estimator: Estimator, rate_hz: float) -> Steps:
    """Read every step of one question inside the band.

    Args:
        log: One question (`JointLog.cut`) with its instantaneous frequency.
        joint: The excited joint.
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
    time, command, position = log.time, log.command[:, column], log.position[:, column]
    steps = []
    for first, stop in _runs(log.frequency):
        hz = float(log.frequency[first])
        if not estimator.min_hz - 1e-9 <= hz <= estimator.top_hz(rate_hz) + 1e-9:
            continue
        # The last sample's interval belongs to the step as well.
        span = float(time[stop - 1] - time[first]) + 1.0 / rate_hz
        inside = slice(first, min(stop + 3, len(time)))
        dropped, end = _steady(time[inside], command[inside], span, hz, rate_hz)
        steps.append((hz, inside, dropped, end - dropped))
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
    # Two periods a block where there are four, for the window below.
    blocks = max(2, min(periods // 2, _MOST_BLOCKS))
    rows = []
    for hz, inside, dropped, periods in sorted(steps, key=lambda step: step[0]):
        each = periods // blocks
        samples = round(_FINE * each * rate_hz / hz)
        grid = Grid(
            # The last whole blocks: the joint has settled longest.
            start=float(time[inside][0]) + (dropped + periods - blocks * each) / hz,
            rate_hz=samples * hz / each,
            count=samples * blocks,
        )
        u = held_mean(time[inside], command[inside], grid).reshape(blocks, samples)
        y = interpolate(time[inside], position[inside], grid).reshape(blocks, samples)
        # The held command has images that are not whole periods of a block; a window keeps them
        # out. It needs two periods to keep the mean out as well.
        window = get_window("hann", samples) if each >= 2 else np.ones(samples)
        turn = 2j * np.pi * each * np.arange(samples) / samples
        once, thrice = window * np.exp(-turn), window * np.exp(-3.0 * turn)
        omega = 2.0 * np.pi * hz
        seen = 3.0 * hz < rate_hz / 2.0
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
    parts: Sequence[JointLog], joint: str, amplitude: float, estimator: Estimator, rate_hz: float
) -> FrequencyResponse:
    """Response at the frequencies of sine steps, averaged over periods and questions.

    `repeats` holds one row per question if there are three or more, one per block of whole
    periods otherwise.

    Args:
        parts: The questions, one log each (`JointLog.cut`).
        joint: The excited joint.
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
