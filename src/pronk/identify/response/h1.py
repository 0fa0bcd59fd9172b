"""H1 from windowed segments, averaged; and the same estimate as a matrix.

Padding: a chirp of pronk starts and ends at rest, so before and after it both signals are known
to stay where they are; segments then reach over the ends, every sample counts alike, and there is
no transient to drop. Of an excitation that ends in motion only whole segments inside it are used.

With the command given, H1 is linear in the position, `H = position @ A` with A of shape
(samples, f): `H1Operator`, with the segments, windows, means and interpolation of the average.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import add

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import fft
from scipy.signal import ShortTimeFFT, get_window

from pronk.arrays import Array, ComplexArray, Mask
from pronk.errors import LogError
from pronk.identify.logs.joint_log import Excitation
from pronk.identify.response.grid import (
    Grid,
    grid_over,
    held_mean,
    hold,
    interpolate,
    pull_back,
    require_span,
)
from pronk.identify.response.response import Estimator, FrequencyResponse

_TINY = np.finfo(np.float64).tiny
_SILENT = 1e-4
"""Share of the largest excitation (power) below which a frequency counts as not excited."""
_LEAKED = 0.3
"""Share of a neighbour's power below which a frequency counts as that neighbour's leakage: beside
a single line a Hann window leaves 0.25. Its response would be that at the line."""
_SETTLED_S = 0.2
"""A command that is constant for so long at the end leaves the joint at rest [s]: five times the
slowest time constant of the drives this was written for."""
_AT_CENTRE = 0.05
"""Share of the amplitude by which an excitation at rest may start off the point it ends at."""


def rests(command: Array, rate_hz: float) -> bool:
    """True if a command [rad] ends constant, and starts where it ends: the joint is at rest."""
    tail = max(2, round(_SETTLED_S * rate_hz))
    amplitude = float(np.ptp(command)) / 2.0
    if len(command) <= tail or amplitude == 0.0:
        return False
    return bool(
        np.ptp(command[-tail:]) <= 1e-6 * amplitude
        and abs(command[0] - command[-1]) <= _AT_CENTRE * amplitude
    )


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Where the segments of one excitation lie on its analysis grid."""

    grid: Grid
    starts: NDArray[np.intp]
    """First sample of each segment, increasing; negative or beyond the end where padded, (k,)."""
    window: Array
    """Shape (samples,)."""
    bins: NDArray[np.intp]
    """Numbers of the frequencies in the transform of a segment, shape (f,)."""

    @property
    def omega(self) -> Array:
        """The frequencies [rad/s], shape (f,)."""
        hz = fft.rfftfreq(len(self.window), 1.0 / self.grid.rate_hz)
        return np.asarray(2.0 * np.pi * hz[self.bins])

    @property
    def padding(self) -> tuple[int, int]:
        """Samples that segments reach over the first and over the last."""
        last = int(self.starts[-1]) + len(self.window)
        return max(0, -int(self.starts[0])), max(0, last - self.grid.count)

    def spectra(self, values: Array) -> ComplexArray:
        """Windowed transform of each segment, its mean taken away, shape (k, f).

        The first and the last value, shape (grid.count,), are repeated in the padding. The phase
        counts from the first sample of each segment.
        """
        padded = np.pad(values, self.padding, mode="edge")
        parts = sliding_window_view(padded, len(self.window))[self.starts + self.padding[0]]
        parts = (parts - parts.mean(axis=1, keepdims=True)) * self.window
        return np.asarray(fft.rfft(parts)[:, self.bins])


def layout(grid: Grid, estimator: Estimator, *, padded: bool) -> Layout:
    """Lay the segments over a grid; LogError if it is too short, or no frequency is left."""
    samples, rate_hz = round(estimator.segment_s * grid.rate_hz), grid.rate_hz
    span = grid.count / rate_hz
    if samples < 8 or grid.count < samples:
        raise LogError(
            f"an excitation of {span:.2f} s ({grid.count} samples at {rate_hz:g} Hz) does not "
            f"fill a segment of {estimator.segment_s:g} s; choose a shorter Estimator.segment_s."
        )
    window = get_window(estimator.window, samples, fftbins=True)
    transform = ShortTimeFFT(
        window,
        hop=max(1, round(samples * (1.0 - estimator.overlap))),
        fs=rate_hz,
        phase_shift=None,
    )
    if padded:
        slices = int(transform.p_min), int(transform.p_max(grid.count))
    else:
        last = transform.upper_border_begin(grid.count)[1]
        slices = int(transform.lower_border_end[1]), int(last)
    if slices[1] - slices[0] < 2:
        raise LogError(
            f"an excitation of {span:.2f} s holds a single segment of {estimator.segment_s:g} s, "
            "of which coherence is always 1; choose a shorter Estimator.segment_s."
        )
    hz, top_hz = np.asarray(transform.f), estimator.top_hz(rate_hz)
    # From the second line on: the main lobe of the window at the first reaches the mean.
    chosen = (hz >= max(estimator.min_hz, hz[2]) - 1e-9) & (hz <= top_hz + 1e-9)
    if not chosen.any():
        raise LogError(
            f"no frequency between {estimator.min_hz:g} and {top_hz:g} Hz with segments of "
            f"{estimator.segment_s:g} s at {rate_hz:g} Hz."
        )
    return Layout(
        grid=grid,
        starts=np.arange(*slices) * transform.hop - transform.m_num_mid,
        window=window,
        bins=np.flatnonzero(chosen),
    )


@dataclass(frozen=True, kw_only=True)
class Sums:
    """Auto and cross spectra summed over segments. Sums of several excitations add up."""

    uu: Array
    uy: ComplexArray
    """conj(U) Y, shape (f,)."""
    yy: Array
    segments: float
    """Number of segments, those that reach into the padding in part."""
    spread: Array
    """Power that white noise of unit power per segment leaves in `uy`, shape (f,)."""

    def __add__(self, other: Sums) -> Sums:
        """Sums over the segments of both."""
        return Sums(**{name: value + vars(other)[name] for name, value in vars(self).items()})

    def response(self, omega: Array, rate_hz: float) -> ComplexArray:
        """Response by H1 = Suy / Suu, from the held command; the noise is on the position."""
        h1 = self.uy / np.maximum(self.uu, _TINY)
        return np.asarray(h1 / hold(omega, rate_hz))

    def coherence(self) -> Array:
        """Magnitude-squared coherence; 0 where the frequency was not excited, shape (f,).

        The share of the position's power over the whole log that the command explains: every
        segment counts, also those in which a chirp is elsewhere, which bring the noise alone. A
        single passage of a chirp in a single segment would be 1 by construction.
        """
        raw = np.abs(self.uy) ** 2 / np.maximum(self.uu * self.yy, _TINY)
        beside = np.pad(self.uu, 1)
        leaked = self.uu < _LEAKED * np.maximum(beside[:-2], beside[2:])
        excited = (self.uu >= _SILENT * self.uu.max()) & ~leaked
        return np.where(excited, np.clip(raw, 0.0, 1.0), 0.0)

    def averages(self) -> Array:
        """Effective number of independent averages that the coherence rests on, shape (f,).

        `segments sum P / sum_s,t conj(U_s) U_t r_st`, P = |U|^2 and r_st the overlap of windows s
        and t inside the excitation: the number n for which `(1 - coherence) / (2 n coherence)` is
        the variance of the estimate under white noise, and 1/n the coherence of noise alone. For
        a chirp it counts the segments in which the chirp is elsewhere, as `coherence` does.
        """
        return np.asarray(self.segments * self.uu / np.maximum(self.spread, _TINY))


def sums(command: ComplexArray, position: ComplexArray, where: Layout) -> Sums:
    """Sum the spectra of one excitation (`Layout.spectra`) over its segments."""
    # Phase from a common instant, in which the noise of two segments correlates by their overlap.
    turn = np.exp(-1j * np.outer(where.starts / where.grid.rate_hz, where.omega))
    aligned, power = command * turn, float(where.window @ where.window)
    # The windows are zero in the padding.
    samples = where.starts[:, None] + np.arange(len(where.window))
    windows = np.where((samples >= 0) & (samples < where.grid.count), where.window, 0.0)
    segments, spread = 0.0, np.zeros(len(where.bins))
    for i, start in enumerate(where.starts):
        own = float(windows[i] @ windows[i]) / power
        segments += own
        spread += own * np.abs(aligned[i]) ** 2
        for j in range(i + 1, len(where.starts)):
            shift = int(where.starts[j] - start)
            if shift >= len(where.window):
                break
            overlap = float(windows[i][shift:] @ windows[j][:-shift]) / power
            spread += 2.0 * overlap * (np.conj(aligned[i]) * aligned[j]).real
    return Sums(
        uu=np.asarray((np.abs(command) ** 2).sum(axis=0)),
        uy=np.asarray((np.conj(command) * position).sum(axis=0)),
        yy=np.asarray((np.abs(position) ** 2).sum(axis=0)),
        segments=segments,
        spread=np.asarray(np.maximum(spread, 0.0)),
    )


def estimate_averaged(
    repeats: Sequence[Excitation], estimator: Estimator, rate_hz: float
) -> FrequencyResponse:
    """Estimate H1 over the segments of all repeats of one excitation."""
    first = repeats[0]
    each, padded = [], []
    for repeat in repeats:
        grid = grid_over(repeat.time, rate_hz)
        command = held_mean(repeat.time, repeat.command, grid.edges)
        position = interpolate(repeat.time, repeat.position, grid)
        padded.append(rests(command, rate_hz))
        where = layout(grid, estimator, padded=padded[-1])
        each.append(sums(where.spectra(command), where.spectra(position), where))
    whole, omega = reduce(add, each), where.omega
    ends = "reaching over the ends at rest" if all(padded) else "inside the excitation"
    return FrequencyResponse(
        joint=first.joint,
        amplitude=first.amplitude,
        omega=omega,
        response=whole.response(omega, rate_hz),
        coherence=whole.coherence(),
        averages=whole.averages(),
        repeats=np.array([one.response(omega, rate_hz) for one in each]),
        estimator="H1",
        window=f"{estimator.window} {estimator.segment_s:g} s, {100.0 * estimator.overlap:.0f} % "
        f"overlap, {ends}, mean of each segment removed",
        segment_s=estimator.segment_s,
        virtual=first.log.virtual,
        source=first.source,
    )


@dataclass(frozen=True, kw_only=True)
class H1Operator:
    """Linear map from the positions of one excitation to its response.

    On the analysis grid it is the sum over segments of `scale` times `Layout.spectra`.
    """

    time: Array
    """Measured timestamps of the log it was built for [s], shape (n,)."""
    layout: Layout
    command: ComplexArray
    """Transforms of the command, shape (k, f)."""

    @classmethod
    def build(
        cls, time: Array, command: Array, estimator: Estimator, *, rate_hz: float | None = None
    ) -> H1Operator:
        """Compute the map for one command [rad] in force from timestamps [s], both of shape (n,).

        The analysis grid has the rate of the timestamps if none is given. LogError as of `layout`.
        """
        grid = grid_over(time, rate_hz)
        held = held_mean(time, command, grid.edges)
        where = layout(grid, estimator, padded=rests(held, grid.rate_hz))
        return cls(time=time, layout=where, command=where.spectra(held))

    @property
    def omega(self) -> Array:
        """[rad/s], shape (f,)."""
        return self.layout.omega

    @property
    def excitation(self) -> Array:
        """Sum of |U|^2: the weight of this excitation among repeats, shape (f,)."""
        return np.asarray((np.abs(self.command) ** 2).sum(axis=0))

    @cached_property
    def scale(self) -> ComplexArray:
        """What the transform of each segment counts in the response, shape (k, f)."""
        factor = hold(self.omega, self.layout.grid.rate_hz)
        return np.conj(self.command) / (np.maximum(self.excitation, _TINY) * factor)

    def weights(self, chosen: Mask | slice = slice(None)) -> ComplexArray:
        """Map from positions on the grid to the chosen frequencies, shape (grid.count, chosen)."""
        where, samples = self.layout, np.arange(len(self.layout.window))
        turn = np.exp(-2j * np.pi * samples / len(samples))
        kernel = where.window[:, None] * turn[np.outer(samples, where.bins[chosen]) % len(samples)]
        # Taking the mean of a segment away is taking the mean of the kernel away.
        kernel -= kernel.mean(axis=0)
        # Padding repeats the first and last sample; its weights gather on them.
        (before, after), count = where.padding, where.grid.count
        spread = np.zeros((before + count + after, kernel.shape[1]), dtype=np.complex128)
        term = np.empty_like(kernel)
        for start, row in zip(where.starts + before, self.scale[:, chosen], strict=True):
            spread[start : start + len(kernel)] += np.multiply(kernel, row, out=term)
        out = spread[before : before + count]
        out[0] += spread[:before].sum(axis=0)
        out[-1] += spread[before + count :].sum(axis=0)
        return out

    def matrix(self, sample_times: Array, chosen: Mask | slice = slice(None)) -> ComplexArray:
        """Map from positions at other instants, `H = positions @ matrix`, shape (m, chosen).

        `sample_times` [s], shape (m,), are increasing instants on the clock of the log; the cubic
        interpolation onto the analysis grid is included. LogError if they do not span the
        excitation.
        """
        return pull_back(self.weights(chosen), sample_times, self.layout.grid)

    def response(self, sample_times: Array, position: Array) -> ComplexArray:
        """`position @ matrix(sample_times)`, shape (f,), by transforms: faster for a few positions.

        Shapes (m,); LogError as of `matrix`.
        """
        require_span(sample_times, self.layout.grid)
        found = self.layout.spectra(interpolate(sample_times, position, self.layout.grid))
        return np.asarray((self.scale * found).sum(axis=0))
