"""Multisines, read line by line.

Whole periods need no window and leak nothing, so the transform of a period is exact at the lines
that were excited. The scatter from period to period is noise; what stands at lines that were not
excited, above that noise, is nonlinear distortion (`distortion.py`). After Pintelon and Schoukens,
*System Identification: A Frequency Domain Approach*, 2nd ed.: best linear approximation, even and
odd detection lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.logs.joint_log import JointLog
from pronk.response.estimator import Estimator
from pronk.response.grid import Grid, analysis_rate, held_mean, hold, interpolate
from pronk.response.operator import H1Operator
from pronk.response.response import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_EXCITED = 0.02
"""Share of the largest line (amplitude) above which a line counts as excited: above what jitter of
a tenth of a sample leaves at silent lines, far below the tilt of pronk's multisines (0.07)."""
_SAME_PERIOD = 0.1
"""Largest RMS difference, as a share of the command, between periods that count as equal."""
_ENOUGH_REPEATS = 3
"""From so many questions on, the question is the unit of uncertainty; below, the period."""


@dataclass(frozen=True, kw_only=True)
class Periods:
    """Spectra of the steady periods of one question, transient dropped."""

    grid: Grid
    """Whole periods from the first that counts."""
    omega: Array
    """Every line in the band, excited or not [rad/s], shape (l,)."""
    lines: NDArray[np.intp]
    """Their numbers (1 is the inverse of the period), shape (l,)."""
    command: ComplexArray
    """Shape (p, l)."""
    position: ComplexArray
    """Shape (p, l)."""

    @property
    def excited(self) -> NDArray[np.bool_]:
        """Lines that the command holds, shape (l,)."""
        size = np.abs(self.command).mean(axis=0)
        return np.asarray(size >= _EXCITED * size.max())


def _steady(command: Array, samples: int) -> tuple[int, int]:
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


def steady_grid(
    time: Array, command: Array, period_s: float, *, rate_hz: float | None = None
) -> tuple[Grid, int]:
    """Grid over the periods that count, a whole number of samples each.

    They are those in which the command repeats the period before; ramps fall out by themselves,
    and the first steady period is dropped as the transient.

    Returns:
        The grid, and the number of samples in a period.

    Raises:
        LogError: Fewer than two periods are left.
    """
    rate = analysis_rate(time) if rate_hz is None else rate_hz
    samples = round(period_s * rate)
    fine = samples / period_s
    count = int(np.floor((time[-1] - time[0]) * fine + 0.01)) + 1
    held = held_mean(time, command, Grid(start=float(time[0]), rate_hz=fine, count=count))
    first, stop = _steady(held, max(samples, 1))
    if stop - first < 3:
        raise LogError(
            f"a periodic question of {period_s:g} s repeats itself {max(stop - first, 0)} times in "
            f"{time[-1] - time[0]:.2f} s; 3 equal periods are needed (1 to settle, 2 to compare)."
        )
    start = float(time[0]) + (first + 1) * period_s
    return Grid(start=start, rate_hz=fine, count=(stop - first - 1) * samples), samples


def _lines(grid: Grid, samples: int, estimator: Estimator) -> NDArray[np.intp]:
    spacing = grid.rate_hz / samples
    lines = np.arange(1, samples // 2)
    hz = lines * spacing
    top = estimator.top_hz(grid.rate_hz)
    return np.asarray(lines[(hz >= estimator.min_hz - 1e-9) & (hz <= top + 1e-9)])


def read_periods(
    log: JointLog, joint: str, estimator: Estimator, *, rate_hz: float | None = None
) -> Periods:
    """Spectra of the steady periods of one multisine.

    Args:
        log: One question (`JointLog.cut`), whose segment gives the period.
        joint: The excited joint.
        estimator: Gives the band.
        rate_hz: Rate of the analysis grid; about that of the timestamps if not given.

    Raises:
        LogError: The segment gives no period, or fewer than three equal periods.
    """
    period = log.segments[0].period_s
    if period is None:
        raise LogError(
            f"{log.source or 'log'}: the {log.segments[0].kind} of {joint} gives no period_s; "
            "name it, or call the segment `unknown` to have it averaged by segments."
        )
    column = log.column(joint)
    grid, samples = steady_grid(log.time, log.command[:, column], period, rate_hz=rate_hz)
    lines = _lines(grid, samples, estimator)

    def spectra(values: Array) -> ComplexArray:
        return np.asarray(np.fft.rfft(values.reshape(-1, samples), axis=1)[:, lines] / samples)

    return Periods(
        grid=grid,
        omega=np.asarray(2.0 * np.pi * lines * grid.rate_hz / samples),
        lines=lines,
        command=spectra(held_mean(log.time, log.command[:, column], grid)),
        position=spectra(interpolate(log.time, log.position[:, column], grid)),
    )


def _response(command: ComplexArray, position: ComplexArray) -> ComplexArray:
    """H1 over the first axis."""
    return np.asarray(
        (np.conj(command) * position).sum(axis=0) / (np.abs(command) ** 2).sum(axis=0)
    )


def combined(
    command: Sequence[ComplexArray],
    position: Sequence[ComplexArray],
    factor: ComplexArray,
    *,
    omega: Array,
    joint: str,
    amplitude: float,
    window: str,
    segment_s: float,
    virtual: bool,
    source: str,
) -> FrequencyResponse:
    """Response from the periods of every question.

    Args:
        command: Spectra of each question's periods, shape (p, f) each.
        position: The same of the position.
        factor: Grid factor (`grid.hold`), shape (f,).
        omega: And the rest: as in FrequencyResponse.
        joint: See there.
        amplitude: See there.
        window: See there.
        segment_s: See there.
        virtual: See there.
        source: See there.
    """
    u, y = np.concatenate(list(command)), np.concatenate(list(position))
    if len(command) >= _ENOUGH_REPEATS:
        repeats = np.array([_response(a, b) for a, b in zip(command, position, strict=True)])
    else:
        repeats = y / u
    power = (np.abs(u) ** 2).sum(axis=0) * (np.abs(y) ** 2).sum(axis=0)
    cross = np.abs((np.conj(u) * y).sum(axis=0)) ** 2
    return FrequencyResponse(
        joint=joint,
        amplitude=amplitude,
        omega=omega,
        response=_response(u, y) / factor,
        coherence=np.clip(cross / np.maximum(power, np.finfo(np.float64).tiny), 0.0, 1.0),
        averages=np.full(len(omega), float(len(u))),
        repeats=repeats / factor,
        estimator="periodic",
        window=window,
        segment_s=segment_s,
        virtual=virtual,
        source=source,
    )


def estimate_multisine(
    parts: Sequence[JointLog], joint: str, amplitude: float, estimator: Estimator, rate_hz: float
) -> FrequencyResponse:
    """Response at the lines of a multisine, averaged over periods and questions.

    `repeats` holds one row per question if there are three or more (other random phases are then
    part of the scatter), one per period otherwise.

    Args:
        parts: The questions, one log each (`JointLog.cut`).
        joint: The excited joint.
        amplitude: Peak of the command [rad].
        estimator: Gives the band.
        rate_hz: Rate of the analysis grid, adjusted to a whole number of samples a period.

    Raises:
        LogError: Too few periods, or questions with different lines.
    """
    read = [read_periods(part, joint, estimator, rate_hz=rate_hz) for part in parts]
    excited = read[0].excited
    for other in read[1:]:
        if len(other.excited) != len(excited) or not (other.excited == excited).all():
            raise LogError(
                f"{parts[0].source or 'log'}: the multisines of {joint} ask different lines; give "
                "repeats the same period and band."
            )
    omega = read[0].omega[excited]
    period = float(parts[0].segments[0].period_s or 0.0)
    return combined(
        [r.command[:, excited] for r in read],
        [r.position[:, excited] for r in read],
        hold(omega, read[0].grid.rate_hz),
        omega=omega,
        joint=joint,
        amplitude=amplitude,
        window=f"whole periods of {period:g} s, ramps and the first steady period dropped",
        segment_s=period,
        virtual=parts[0].virtual,
        source=parts[0].source,
    )


def multisine_operator(
    time: Array,
    command: Array,
    period_s: float,
    estimator: Estimator,
    *,
    rate_hz: float | None = None,
) -> H1Operator:
    """`estimate_multisine` of one question as a matrix, for a fixed command.

    Raises:
        LogError: Fewer than three equal periods.
    """
    grid, samples = steady_grid(time, command, period_s, rate_hz=rate_hz)
    lines = _lines(grid, samples, estimator)
    u = np.fft.rfft(held_mean(time, command, grid).reshape(-1, samples), axis=1)[:, lines] / samples
    size = np.abs(u).mean(axis=0)
    excited = size >= _EXCITED * size.max()
    lines, u = lines[excited], u[:, excited]
    omega = 2.0 * np.pi * lines * grid.rate_hz / samples
    kernel = np.exp(-2j * np.pi * np.outer(np.arange(samples), lines) / samples) / samples
    excitation = np.asarray((np.abs(u) ** 2).sum(axis=0))
    scale = np.conj(u) / (excitation * hold(omega, grid.rate_hz))
    return H1Operator(
        omega=np.asarray(omega),
        time=np.asarray(time, dtype=np.float64),
        grid=grid,
        weights=np.concatenate([kernel * row for row in scale]),
        excitation=excitation,
    )
