"""Periodic excitations, read line by line: multisines and sine steps.

Whole periods need no window and leak nothing, so the transform of a period is exact at the lines
that were excited; the scatter from period to period is noise. After Pintelon and Schoukens,
*System Identification: A Frequency Domain Approach*, 2nd ed.

Sine steps are one frequency after another, each held for whole periods: every step is read at its
own frequency, and at three times it, after the joint has settled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import get_window

from pronk.arrays import Array, ComplexArray
from pronk.errors import LogError
from pronk.identify.logs.joint_log import Excitation
from pronk.identify.response.grid import Grid, grid_over, held_mean, hold, interpolate
from pronk.identify.response.h1 import H1Operator, Layout
from pronk.identify.response.response import Estimator, FrequencyResponse

_EXCITED = 0.02
"""Share of the largest line (amplitude) above which a line counts as excited: above what jitter of
a tenth of a sample leaves at silent lines, far below the tilt of pronk's multisines (0.07)."""
_SAME_PERIOD = 0.1
"""Largest RMS difference, as a share of the command, between periods that count as equal."""
_ENOUGH_REPEATS = 3
"""From so many excitations on, these are the unit of uncertainty; below, the period."""

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
class Spectra:
    """What was read at the lines of one excitation."""

    omega: Array
    """[rad/s], increasing, shape (f,)."""
    command: ComplexArray
    """Per period (or block of periods), shape (p, f)."""
    position: ComplexArray
    """Over the grid factor of each line (`grid.hold`), shape (p, f)."""
    third: Array = field(default_factory=lambda: np.empty(0))
    """Of steps: position at three times the frequency over that at it, shape (f,)."""


def multisine_operator(
    time: Array, command: Array, period_s: float, estimator: Estimator, rate_hz: float
) -> H1Operator:
    """`estimate_periodic` of one multisine as a matrix, for a fixed command.

    A segment lies over each period in which the command repeats the period before; ramps fall out
    by themselves, and the first steady period is dropped as the transient. Frequencies are the
    lines excited in them.
    """
    samples = max(round(period_s * rate_hz), 1)
    fine = samples / period_s
    whole = grid_over(time, fine)
    held = held_mean(time, command, whole.edges)
    first, stop = _steady_periods(held, samples)
    if stop - first < 3:
        raise LogError(
            f"a signal of period {period_s:g} s repeats itself {max(stop - first, 0)} times in "
            f"{time[-1] - time[0]:.2f} s; 3 equal periods are needed (1 to settle, 2 to compare)."
        )
    grid = Grid(
        start=whole.start + (first + 1) * period_s,
        rate_hz=fine,
        count=(stop - first - 1) * samples,
    )
    numbers = np.arange(1, samples // 2)
    hz = numbers * fine / samples
    numbers = numbers[(hz >= estimator.min_hz - 1e-9) & (hz <= estimator.top_hz(fine) + 1e-9)]
    if len(numbers) == 0:
        raise LogError(
            f"a signal of period {period_s:g} s has no line between {estimator.min_hz:g} and "
            f"{estimator.top_hz(fine):g} Hz."
        )
    where = Layout(
        grid=grid,
        starts=np.arange(0, grid.count, samples),
        window=np.full(samples, 1.0 / samples),
        bins=numbers,
    )
    u = where.spectra(held_mean(time, command, grid.edges))
    size = np.abs(u).mean(axis=0)
    excited = size >= _EXCITED * size.max()
    where = replace(where, bins=numbers[excited])
    return H1Operator(time=time, layout=where, command=u[:, excited])


def _steady_periods(command: Array, samples: int) -> tuple[int, int]:
    """First and one-past-last period of the longest run in which the command repeats itself."""
    whole = len(command) // samples
    periods = command[: whole * samples].reshape(whole, samples)
    size = float(np.sqrt(np.mean((periods - periods.mean()) ** 2))) if whole else 0.0
    best, first = (0, 0), 0
    for p in range(1, whole):
        change = float(np.sqrt(np.mean((periods[p] - periods[p - 1]) ** 2)))
        if change > _SAME_PERIOD * size:
            first = p
        if p + 1 - first > best[1] - best[0]:
            best = (first, p + 1)
    return best


def read_periods(excitation: Excitation, estimator: Estimator, rate_hz: float) -> Spectra:
    """Spectra of the steady periods of one multisine at its excited lines.

    `rate_hz` is about that of the analysis grid. LogError without three equal periods.
    """
    time = excitation.time
    period = excitation.segment.period_s
    if period is None:
        raise LogError(
            f"{excitation.source or 'log'}: the {excitation.segment.kind} of {excitation.joint} "
            "gives no period_s; name it, or call the segment `unknown` to have it averaged by "
            "segments."
        )
    found = multisine_operator(time, excitation.command, period, estimator, rate_hz)
    where, omega = found.layout, found.omega
    position = where.spectra(interpolate(time, excitation.position, where.grid))
    factor = hold(omega, where.grid.rate_hz)
    return Spectra(omega=omega, command=found.command, position=position / factor)


def _runs(frequency: Array) -> list[tuple[int, int]]:
    """First and one-past-last sample of each stretch of constant frequency."""
    known = np.isfinite(frequency) & (frequency > 0.0)
    filled = np.where(known, frequency, -1.0)
    new = np.flatnonzero(np.abs(np.diff(filled)) > _SAME_HZ * np.abs(filled[1:])) + 1
    edges = [0, *new.tolist(), len(filled)]
    return [(a, b) for a, b in pairwise(edges) if filled[a] > 0.0]


def _steady_step(
    time: Array, command: Array, span: float, hz: float, rate_hz: float
) -> tuple[int, int]:
    """First and one-past-last period of a step, counted from its start, that is steady."""
    settle = max(1, int(np.ceil(_SETTLE_S * hz)))
    periods = int(np.floor(span * hz + 0.01))
    if periods <= settle:
        return settle, periods
    samples = max(4, round(rate_hz / hz))
    grid = Grid(start=float(time[0]), rate_hz=samples * hz, count=samples * periods)
    turn = np.exp(-2j * np.pi * np.arange(samples) / samples)
    found = held_mean(time, command, grid.edges).reshape(periods, samples) @ turn
    # Smoothed, or the images of a held command would make single periods look unlike.
    size = np.abs(uniform_filter1d(found, settle, mode="nearest"))
    even = np.flatnonzero(np.abs(size - np.median(size)) <= _STEADY * np.median(size))
    if len(even) == 0:
        return settle, settle
    end = int(even[-1]) + 1
    return int(even[0]) + settle, end if end == periods else end - settle


def read_steps(excitation: Excitation, estimator: Estimator, rate_hz: float) -> Spectra:
    """Read every step of one excitation by sine steps inside the band.

    `rate_hz` is about that of the grid; each step takes a whole number of samples a period.
    LogError without a channel of the frequency or steps of three periods in the band.
    """
    where = excitation.source or "log"
    if excitation.frequency is None:
        raise LogError(
            f"{where}: sine steps without the channel of instantaneous frequency; give it, or call "
            "the segment `unknown` to have it averaged by segments."
        )
    time = excitation.time
    command = excitation.command
    position = excitation.position
    frequency = excitation.frequency
    steps = []
    for first, stop in _runs(frequency):
        hz = float(frequency[first])
        if not estimator.min_hz - 1e-9 <= hz <= estimator.top_hz(rate_hz) + 1e-9:
            continue
        # The last sample's interval belongs to the step as well.
        span = float(time[stop - 1] - time[first]) + 1.0 / rate_hz
        inside = slice(first, min(stop + 3, len(time)))
        dropped, end = _steady_step(time[inside], command[inside], span, hz, rate_hz)
        steps.append((hz, inside, dropped, end - dropped))
    if not steps:
        raise LogError(
            f"{where}: no sine step of {excitation.joint} between {estimator.min_hz:g} and "
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
        u = held_mean(time[inside], command[inside], grid.edges).reshape(blocks, samples)
        y = interpolate(time[inside], position[inside], grid).reshape(blocks, samples)
        # The held command has images that are not whole periods of a block; a window keeps them
        # out. It needs two periods to keep the mean out as well.
        window = get_window("hann", samples) if each >= 2 else np.ones(samples)
        turn = 2j * np.pi * each * np.arange(samples) / samples
        once, thrice = window * np.exp(-turn), window * np.exp(-3.0 * turn)
        factor = hold(2.0 * np.pi * np.array([hz]), grid.rate_hz)
        third = abs((y @ thrice).mean()) / abs((y @ once).mean())
        known = third if 3.0 * hz < rate_hz / 2.0 else float("nan")
        rows.append((hz, u @ once, y @ once / factor, known))
    lines_hz, commands, positions, thirds = map(np.array, zip(*rows, strict=True))
    return Spectra(
        omega=2.0 * np.pi * lines_hz, command=commands.T, position=positions.T, third=thirds
    )


def _h1(command: ComplexArray, position: ComplexArray) -> ComplexArray:
    cross = (np.conj(command) * position).sum(axis=0)
    return np.asarray(cross / (np.abs(command) ** 2).sum(axis=0))


def estimate_periodic(
    excitations: Sequence[Excitation], estimator: Estimator, rate_hz: float
) -> FrequencyResponse:
    """Response to multisines or sine steps, averaged over the periods of every excitation.

    `repeats` holds one row per excitation if there are three or more (other random phases are then
    part of the scatter), one per period (of steps, per block of periods) otherwise. LogError as of
    `read_periods` and `read_steps`, and for repeats of different frequencies.
    """
    segment = excitations[0].segment
    if segment.kind == "multisine":
        read = [read_periods(excitation, estimator, rate_hz) for excitation in excitations]
        length = float(segment.period_s or 0.0)
        window = f"whole periods of {length:g} s, ramps and the first steady period dropped"
    else:
        read = [read_steps(excitation, estimator, rate_hz) for excitation in excitations]
        length = float(2.0 * np.pi / read[0].omega[0])
        window = f"whole periods of each step, the first and at least {_SETTLE_S:g} s dropped"
    omega = read[0].omega
    if any(one.omega.shape != omega.shape or not np.allclose(one.omega, omega) for one in read):
        raise LogError(
            f"{excitations[0].source or 'log'}: the repeats of {excitations[0].joint} excite "
            "different frequencies; give them the same period, band and steps."
        )
    u = np.concatenate([one.command for one in read])
    y = np.concatenate([one.position for one in read])
    repeats = y / u
    if len(read) >= _ENOUGH_REPEATS:
        repeats = np.array([_h1(one.command, one.position) for one in read])
    power = (np.abs(u) ** 2).sum(axis=0) * (np.abs(y) ** 2).sum(axis=0)
    cross = np.abs((np.conj(u) * y).sum(axis=0)) ** 2
    return FrequencyResponse(
        joint=excitations[0].joint,
        amplitude=excitations[0].amplitude,
        omega=omega,
        response=_h1(u, y),
        coherence=np.clip(cross / np.maximum(power, np.finfo(np.float64).tiny), 0.0, 1.0),
        averages=np.full(len(omega), float(len(u))),
        repeats=repeats,
        estimator="periodic",
        window=window,
        segment_s=length,
        virtual=excitations[0].log.virtual,
        source=excitations[0].source,
    )
