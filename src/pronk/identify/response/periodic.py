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
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import get_window

from pronk.arrays import Array, ComplexArray
from pronk.errors import LogError
from pronk.identify.logs.joint_log import Excitation
from pronk.identify.response.grid import Grid, grid_over, held_mean, hold, interpolate
from pronk.identify.response.h1 import H1Operator, SegmentLayout
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
    """Spectra of one excitation at its lines."""

    omega: Array
    """Angular frequencies of the lines [rad/s], increasing, shape (f,)."""
    command: ComplexArray
    """Spectrum of the command in each period (or block of periods), shape (p, f)."""
    position: ComplexArray
    """Spectrum of the position, over the grid factor of each line (`grid.hold`), shape (p, f)."""
    third: Array = field(default_factory=lambda: np.empty(0))
    """Position at three times the frequency over the position at it, for steps, shape (f,)."""


def multisine_operator(
    time: Array, command: Array, period_s: float, estimator: Estimator, rate_hz: float
) -> H1Operator:
    """Return the estimate of one multisine as a linear map, for a fixed command.

    A segment lies over each period in which the command repeats the period before; ramps fall out
    by themselves, and the first steady period is dropped as the transient. Frequencies are the
    lines that are excited in these periods.

    Args:
        time: Timestamps [s], shape (n,).
        command: Command in force from each timestamp [rad], shape (n,).
        period_s: Period of the signal [s].
        estimator: The band.
        rate_hz: Rate of the analysis grid, about [Hz]; a period is whole samples.

    Raises:
        LogError: The signal does not repeat itself often enough, or has no line in the band.
    """
    samples = max(round(period_s * rate_hz), 1)
    rate = samples / period_s
    log_grid = grid_over(time, rate)
    held = held_mean(time, command, log_grid.edges)
    first, stop = _steady_periods(held, samples)
    if stop - first < 3:
        raise LogError(
            f"a signal of period {period_s:g} s repeats itself {max(stop - first, 0)} times in "
            f"{time[-1] - time[0]:.2f} s; 3 equal periods are needed (1 to settle, 2 to compare)."
        )
    grid = Grid(
        start=log_grid.start + (first + 1) * period_s,
        rate_hz=rate,
        count=(stop - first - 1) * samples,
    )
    numbers = np.arange(1, samples // 2)
    hz = numbers * rate / samples
    top_hz = estimator.top_hz(rate)
    numbers = numbers[(hz >= estimator.min_hz - 1e-9) & (hz <= top_hz + 1e-9)]
    if len(numbers) == 0:
        raise LogError(
            f"a signal of period {period_s:g} s has no line between {estimator.min_hz:g} and "
            f"{top_hz:g} Hz."
        )
    segments = SegmentLayout(
        grid=grid,
        starts=np.arange(0, grid.count, samples),
        window=np.full(samples, 1.0 / samples),
        bins=numbers,
    )
    spectra = segments.spectra(held_mean(time, command, grid.edges))
    amplitude = np.abs(spectra).mean(axis=0)
    excited = amplitude >= _EXCITED * amplitude.max()
    segments = replace(segments, bins=numbers[excited])
    return H1Operator(time=time, layout=segments, command=spectra[:, excited])


def _steady_periods(command: Array, samples: int) -> tuple[int, int]:
    """First and one-past-last period of the longest run in which the command repeats itself."""
    count = len(command) // samples
    if count == 0:
        return 0, 0
    periods = command[: count * samples].reshape(count, samples)
    deviation = float(np.sqrt(np.mean((periods - periods.mean()) ** 2)))
    longest = (0, 0)
    first = 0
    for period in range(1, count):
        change = float(np.sqrt(np.mean((periods[period] - periods[period - 1]) ** 2)))
        if change > _SAME_PERIOD * deviation:
            first = period
        if period + 1 - first > longest[1] - longest[0]:
            longest = (first, period + 1)
    return longest


def read_periods(excitation: Excitation, estimator: Estimator, rate_hz: float) -> Spectra:
    """Read the steady periods of one multisine at its excited lines.

    `rate_hz` is the rate of the analysis grid, about [Hz]. LogError without three equal periods.
    """
    time = excitation.time
    period = excitation.segment.period_s
    if period is None:
        raise LogError(
            f"{excitation.source or 'log'}: the {excitation.segment.kind} of {excitation.joint} "
            "gives no period_s; name it, or call the segment `unknown` to have it averaged by "
            "segments."
        )
    periods = multisine_operator(time, excitation.command, period, estimator, rate_hz)
    grid = periods.layout.grid
    position = periods.layout.spectra(interpolate(time, excitation.position, grid))
    factor = hold(periods.omega, grid.rate_hz)
    return Spectra(omega=periods.omega, command=periods.command, position=position / factor)


def _steps(frequency: Array) -> list[tuple[int, int]]:
    """First and one-past-last sample of each stretch of constant frequency."""
    excited = np.isfinite(frequency) & (frequency > 0.0)
    filled = np.where(excited, frequency, -1.0)
    changes = np.flatnonzero(np.abs(np.diff(filled)) > _SAME_HZ * np.abs(filled[1:])) + 1
    edges = [0, *changes.tolist(), len(filled)]
    return [(first, stop) for first, stop in pairwise(edges) if filled[first] > 0.0]


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
    spectrum = held_mean(time, command, grid.edges).reshape(periods, samples) @ turn
    # Smoothed, or the images of a held command would make single periods look unlike.
    amplitude = np.abs(uniform_filter1d(spectrum, settle, mode="nearest"))
    median = np.median(amplitude)
    steady = np.flatnonzero(np.abs(amplitude - median) <= _STEADY * median)
    if len(steady) == 0:
        return settle, settle
    first = int(steady[0]) + settle
    stop = int(steady[-1]) + 1
    if stop < periods:
        stop -= settle
    return first, stop


class _Step(NamedTuple):
    """One sine of an excitation by steps."""

    hz: float
    """Frequency [Hz]."""
    samples: slice
    """Samples of the step, and three more."""
    settling: int
    """Periods at its head that are dropped."""
    steady: int
    """Periods that are measured."""


def read_steps(excitation: Excitation, estimator: Estimator, rate_hz: float) -> Spectra:
    """Read every step of one excitation by sine steps inside the band.

    Args:
        excitation: The excitation.
        estimator: The band.
        rate_hz: Rate of the grid, about [Hz]; each step has whole samples in a period.

    Raises:
        LogError: The log has no channel of the frequency, or a step lasts too few periods.
    """
    source = excitation.source or "log"
    frequency = excitation.frequency
    if frequency is None:
        raise LogError(
            f"{source}: sine steps without the channel of instantaneous frequency; give it, or "
            "call the segment `unknown` to have it averaged by segments."
        )
    time = excitation.time
    command = excitation.command
    position = excitation.position
    top_hz = estimator.top_hz(rate_hz)
    steps = []
    for first, stop in _steps(frequency):
        hz = float(frequency[first])
        if not estimator.min_hz - 1e-9 <= hz <= top_hz + 1e-9:
            continue
        # The last sample's interval belongs to the step as well.
        span = float(time[stop - 1] - time[first]) + 1.0 / rate_hz
        samples = slice(first, min(stop + 3, len(time)))
        settling, steady_stop = _steady_step(time[samples], command[samples], span, hz, rate_hz)
        steps.append(_Step(hz, samples, settling, steady_stop - settling))
    if not steps:
        raise LogError(
            f"{source}: no sine step of {excitation.joint} between {estimator.min_hz:g} and "
            f"{top_hz:g} Hz."
        )
    shortest = min(steps, key=lambda step: step.steady)
    if shortest.steady < 2:
        raise LogError(
            f"{source}: the step at {shortest.hz:g} Hz lasts "
            f"{shortest.settling + max(shortest.steady, 0)} periods; {shortest.settling + 2} are "
            f"needed ({shortest.settling} to settle, 2 to compare)."
        )
    # Two periods a block where there are four, for the window below.
    blocks = max(2, min(shortest.steady // 2, _MOST_BLOCKS))
    steps.sort(key=lambda step: step.hz)
    command_rows = []
    position_rows = []
    third = []
    for step in steps:
        hz = step.hz
        step_time = time[step.samples]
        periods = step.steady // blocks
        count = round(_FINE * periods * rate_hz / hz)
        # The last whole blocks: the joint has settled longest.
        skipped = step.settling + step.steady - blocks * periods
        grid = Grid(
            start=float(step_time[0]) + skipped / hz,
            rate_hz=count * hz / periods,
            count=count * blocks,
        )
        step_command = held_mean(step_time, command[step.samples], grid.edges)
        step_position = interpolate(step_time, position[step.samples], grid)
        command_blocks = step_command.reshape(blocks, count)
        position_blocks = step_position.reshape(blocks, count)
        # The held command has images that are not whole periods of a block; a window keeps them
        # out. It needs two periods to keep the mean out as well.
        window = get_window("hann", count) if periods >= 2 else np.ones(count)
        phase = 2j * np.pi * periods * np.arange(count) / count
        at_frequency = window * np.exp(-phase)
        at_third = window * np.exp(-3.0 * phase)
        factor = hold(2.0 * np.pi * np.array([hz]), grid.rate_hz)
        command_rows.append(command_blocks @ at_frequency)
        position_rows.append(position_blocks @ at_frequency / factor)
        if 3.0 * hz < rate_hz / 2.0:
            harmonic = abs((position_blocks @ at_third).mean())
            third.append(harmonic / abs((position_blocks @ at_frequency).mean()))
        else:
            third.append(np.nan)
    return Spectra(
        omega=2.0 * np.pi * np.array([step.hz for step in steps]),
        command=np.array(command_rows).T,
        position=np.array(position_rows).T,
        third=np.array(third),
    )


def _h1(command: ComplexArray, position: ComplexArray) -> ComplexArray:
    """Return H1 over the periods, shapes (p, f) to (f,)."""
    cross = (np.conj(command) * position).sum(axis=0)
    return np.asarray(cross / (np.abs(command) ** 2).sum(axis=0))


def estimate_periodic(
    excitations: Sequence[Excitation], estimator: Estimator, rate_hz: float
) -> FrequencyResponse:
    """Estimate the response to multisines or sine steps over the periods of every excitation.

    `repeats` of the response has one row per excitation if there are three or more (other random
    phases are then part of the scatter), one per period (of steps, per block of periods) otherwise.

    Args:
        excitations: Repeats of one excitation.
        estimator: The band.
        rate_hz: Rate of the analysis grid, about [Hz].

    Raises:
        LogError: Periods are missing, as of `read_periods` and `read_steps`, or the repeats excite
            different frequencies.
    """
    first = excitations[0]
    if first.segment.kind == "multisine":
        spectra = [read_periods(excitation, estimator, rate_hz) for excitation in excitations]
        length = float(first.segment.period_s or 0.0)
        window = f"whole periods of {length:g} s, ramps and the first steady period dropped"
    else:
        spectra = [read_steps(excitation, estimator, rate_hz) for excitation in excitations]
        length = float(2.0 * np.pi / spectra[0].omega[0])
        window = f"whole periods of each step, the first and at least {_SETTLE_S:g} s dropped"
    omega = spectra[0].omega
    for repeat in spectra:
        if repeat.omega.shape != omega.shape or not np.allclose(repeat.omega, omega):
            raise LogError(
                f"{first.source or 'log'}: the repeats of {first.joint} excite different "
                "frequencies; give them the same period, band and steps."
            )
    command = np.concatenate([repeat.command for repeat in spectra])
    position = np.concatenate([repeat.position for repeat in spectra])
    repeats = position / command
    if len(spectra) >= _ENOUGH_REPEATS:
        repeats = np.array([_h1(repeat.command, repeat.position) for repeat in spectra])
    power = (np.abs(command) ** 2).sum(axis=0) * (np.abs(position) ** 2).sum(axis=0)
    cross = np.abs((np.conj(command) * position).sum(axis=0)) ** 2
    return FrequencyResponse(
        joint=first.joint,
        amplitude=first.amplitude,
        omega=omega,
        response=_h1(command, position),
        coherence=np.clip(cross / np.maximum(power, np.finfo(np.float64).tiny), 0.0, 1.0),
        averages=np.full(len(omega), float(len(command))),
        repeats=repeats,
        estimator="periodic",
        window=window,
        segment_s=length,
        virtual=first.log.virtual,
        source=first.source,
    )
