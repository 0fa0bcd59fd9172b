"""The uniform analysis grid that measured timestamps are brought to.

The position is smooth, so it is read between the timestamps with a cubic spline. The command is a
staircase, so it is read as its mean over each grid interval: on a grid that falls on the timestamps
that is the zero-order hold exactly, and off it (jitter, drift) no step is moved in time.

Both have the same transform. With u(t) the staircase, its mean over [t, t + D] has the spectrum
`U(w) exp(+j w D/2) sinc(f D)`, sinc(x) = sin(pi x) / (pi x). Position over command on the grid is
therefore the response of the joint divided by that factor (`hold` below), up to what lies above
the Nyquist frequency of the grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline, make_interp_spline
from scipy.sparse.linalg import splu

from pronk.arrays import Array, ComplexArray
from pronk.errors import LogError

_REACH_S = 0.05
"""How far the grid may reach beyond the samples, which are then held [s]: two policy ticks."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Uniform instants `start + k / rate_hz`, k = 0..count-1."""

    start: float
    """First instant, on the clock of the log [s]."""
    rate_hz: float
    """Instants in a second [Hz]."""
    count: int
    """Number of instants."""

    @property
    def edges(self) -> Array:
        """The instants and the end of the last interval [s], shape (count + 1,)."""
        return np.asarray(self.start + np.arange(self.count + 1) / self.rate_hz)

    def within(self, time: Array) -> Array:
        """Return the instants, moved into the span of `time` at its ends [s], shape (count,)."""
        return np.clip(self.edges[:-1], time[0], time[-1])


def analysis_rate(times: Sequence[Array]) -> float:
    """Return the mean rate inside several stretches of timestamps, to four digits [Hz].

    Rounding gives repeats of one excitation the same grid although their jitter differs; the
    interpolation undoes the shift that it causes (5e-5 of the time at most).
    """
    span = 0.0
    intervals = 0
    for time in times:
        span += float(time[-1] - time[0])
        intervals += len(time) - 1
    return float(f"{intervals / span:.4g}")


def grid_over(time: Array, rate_hz: float | None = None) -> Grid:
    """Return the grid from the first timestamp [s] to the last; at their own rate if None."""
    rate = analysis_rate([time]) if rate_hz is None else rate_hz
    # A hundredth of an interval forgives the rounding of the rate and of the timestamps.
    count = int(np.floor((time[-1] - time[0]) * rate + 0.01)) + 1
    return Grid(start=float(time[0]), rate_hz=rate, count=count)


def held_mean(time: Array, command: Array, edges: Array) -> Array:
    """Average a command that is held from each timestamp to the next over intervals.

    Before the first timestamp the first command holds, after the last one the last.

    Args:
        time: Timestamps of the commands [s], shape (n,).
        command: Commands [rad], shape (n,).
        edges: Edges of the intervals [s], shape (m + 1,).

    Returns:
        Mean of the command over each interval [rad], shape (m,).
    """
    before = min(edges[0], time[0]) - 1.0
    after = max(edges[-1], time[-1]) + 1.0
    knots = np.concatenate(([before], time, [after]))
    # About the mean, so that the integral stays small and its differences exact.
    mean = float(command.mean())
    deviation = np.concatenate((command[:1], command)) - mean
    area = np.concatenate(([0.0], np.cumsum(deviation * np.diff(knots))))
    return np.asarray(np.diff(np.interp(edges, knots, area)) / np.diff(edges) + mean)


def interpolate(time: Array, values: Array, grid: Grid) -> Array:
    """Read the cubic spline through `values`, shape (n, ...), at `time` [s] on the grid."""
    spline = make_interp_spline(time, values, k=min(3, len(time) - 1))
    return np.asarray(spline(grid.within(time)))


def pull_back(weights: ComplexArray, time: Array, grid: Grid) -> ComplexArray:
    """Carry weights of the grid over to the samples that are interpolated onto it.

    `values @ pull_back(weights, time, grid) == interpolate(time, values, grid) @ weights`, at the
    cost of one banded solve, whatever number of `values` follows.

    Args:
        weights: Weights of the grid's instants, shape (grid.count, f).
        time: Instants of the samples [s], shape (n,).
        grid: The grid.

    Returns:
        Weights of the samples, shape (n, f).

    Raises:
        LogError: The samples do not span the grid.
    """
    require_span(time, grid)
    degree = min(3, len(time) - 1)
    knots = make_interp_spline(time, np.zeros(len(time)), k=degree).t
    collocation = BSpline.design_matrix(time, knots, degree)
    onto_grid = BSpline.design_matrix(grid.within(time), knots, degree)
    # Real arithmetic: the spline is real, and the solver takes one kind of number.
    parts = np.ascontiguousarray(weights).view(np.float64)
    on_knots: Any = onto_grid.T @ parts
    solved = splu(sparse.csc_matrix(collocation.T)).solve(on_knots)
    return np.ascontiguousarray(solved).view(np.complex128)


def require_span(time: Array, grid: Grid) -> None:
    """Refuse instants [s] that do not span the grid with a LogError."""
    last = grid.start + (grid.count - 1) / grid.rate_hz
    if time[0] > grid.start + _REACH_S or time[-1] < last - _REACH_S:
        raise LogError(
            f"samples from {time[0]:.3f} to {time[-1]:.3f} s do not span the excitation, "
            f"{grid.start:.3f} to {last:.3f} s; simulate or record all of it."
        )


def hold(omega: Array, rate_hz: float) -> ComplexArray:
    """Return the grid factor `exp(-j w D/2) sinc(f D)`, D = 1/rate, shape (f,).

    The head of this module derives it; `omega` holds angular frequencies [rad/s], shape (f,).
    """
    turns = omega / (2.0 * np.pi * rate_hz)
    return np.asarray(np.exp(-1j * np.pi * turns) * np.sinc(turns))
