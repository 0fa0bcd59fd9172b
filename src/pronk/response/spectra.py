"""Windowed spectra of one question, and what is made of them.

Padding: a chirp of pronk starts and ends at rest, so before and after it both signals are known
to stay where they are; segments then reach over the ends, every sample counts alike, and there is
no transient to drop. Of a question that ends in motion nothing is known beyond its ends, so only
whole segments inside it are used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import ShortTimeFFT

from pronk.errors import LogError
from pronk.response.estimator import Estimator
from pronk.response.grid import Grid, hold

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_SILENT = 1e-4
"""Share of the largest excitation (power) below which a frequency counts as not excited."""


_LEAKED = 0.3
"""Share of a neighbour's power below which a frequency counts as that neighbour's leakage: beside
a single line a Hann window leaves 0.25. Its response would be that at the line."""
_SETTLED_S = 0.2
"""A command that is constant for so long at the end leaves the joint at rest [s]: five times the
slowest time constant of the drives this was written for."""
_AT_CENTRE = 0.05
"""Share of the amplitude by which a question at rest may start off the point it ends at."""


def rests(command: Array, rate_hz: float) -> bool:
    """True if a command ends constant, and starts where it ends: the joint is at rest around it.

    Args:
        command: On the analysis grid [rad], shape (n,).
        rate_hz: Rate of the grid.
    """
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
    """Where the segments of one question lie on its grid."""

    starts: NDArray[np.intp]
    """First sample of each segment; negative or beyond the end where padded, shape (k,)."""
    window: Array
    """Shape (samples,)."""
    omega: Array
    """Frequencies reported [rad/s], shape (f,)."""
    bins: NDArray[np.intp]
    """Their numbers in the transform of a segment, shape (f,)."""
    rate_hz: float
    padded: bool
    count: int
    """Samples of the question, without padding."""

    def measured(self, segment: int) -> Array:
        """The window of a segment, zero where it lies in the padding, shape (samples,)."""
        sample = self.starts[segment] + np.arange(len(self.window))
        return np.where((sample >= 0) & (sample < self.count), self.window, 0.0)


def _transform(estimator: Estimator, rate_hz: float) -> ShortTimeFFT:
    return ShortTimeFFT(
        estimator.weights(rate_hz),
        hop=estimator.hop(rate_hz),
        fs=rate_hz,
        # Phase counted from the first sample of each segment.
        phase_shift=None,
    )


def _slices(transform: ShortTimeFFT, count: int, padded: bool) -> tuple[int, int]:
    """First and one-past-last slice of the transform over `count` samples."""
    if padded:
        return int(transform.p_min), int(transform.p_max(count))
    return int(transform.lower_border_end[1]), int(transform.upper_border_begin(count)[1])


def layout(grid: Grid, estimator: Estimator, *, padded: bool) -> Layout:
    """Lay the segments over a grid.

    Raises:
        LogError: The question is too short for two segments, or no frequency is left.
    """
    transform = _transform(estimator, grid.rate_hz)
    samples = estimator.samples(grid.rate_hz)
    span = grid.count / grid.rate_hz
    if samples < 8 or grid.count < samples:
        raise LogError(
            f"a question of {span:.2f} s ({grid.count} samples at {grid.rate_hz:g} Hz) does not "
            f"fill a segment of {estimator.segment_s:g} s; choose a shorter Estimator.segment_s."
        )
    first, stop = _slices(transform, grid.count, padded)
    if stop - first < 2:
        raise LogError(
            f"a question of {span:.2f} s holds a single segment of {estimator.segment_s:g} s, of "
            "which coherence is 1 whatever the noise; choose a shorter Estimator.segment_s."
        )
    hz = np.asarray(transform.f)
    slack = 1e-9
    # From the second line on: the main lobe of the window at the first reaches the mean.
    chosen = (hz >= max(estimator.min_hz, hz[2]) - slack) & (
        hz <= estimator.top_hz(grid.rate_hz) + slack
    )
    if not chosen.any():
        raise LogError(
            f"no frequency between {estimator.min_hz:g} and {estimator.top_hz(grid.rate_hz):g} Hz "
            f"with segments of {estimator.segment_s:g} s at {grid.rate_hz:g} Hz."
        )
    return Layout(
        starts=np.arange(first, stop) * transform.hop - transform.m_num_mid,
        window=np.asarray(transform.win, dtype=np.float64),
        omega=np.asarray(2.0 * np.pi * hz[chosen]),
        bins=np.flatnonzero(chosen),
        rate_hz=grid.rate_hz,
        padded=padded,
        count=grid.count,
    )


def segment_spectra(values: Array, where: Layout, estimator: Estimator) -> ComplexArray:
    """Windowed transform of each segment, mean taken away.

    Args:
        values: Samples on the grid, shape (n,).
        where: Where the segments lie.
        estimator: The settings that `where` was laid out with.

    Returns:
        Shape (k, f), phase counted from the first sample of each segment.
    """
    transform = _transform(estimator, where.rate_hz)
    first, stop = _slices(transform, len(values), where.padded)
    spectra = transform.stft_detrend(values, "constant", first, stop, padding="edge")
    return np.asarray(spectra[where.bins].T)


@dataclass(frozen=True, kw_only=True)
class Sums:
    """Auto and cross spectra summed over segments. Sums of several questions add up."""

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
        return Sums(
            uu=self.uu + other.uu,
            uy=self.uy + other.uy,
            yy=self.yy + other.yy,
            segments=self.segments + other.segments,
            spread=self.spread + other.spread,
        )

    def response(self, omega: Array, rate_hz: float) -> ComplexArray:
        """Response by H1 = Suy / Suu, from the held command; the noise is on the position."""
        h1 = self.uy / np.maximum(self.uu, np.finfo(np.float64).tiny)
        return np.asarray(h1 / hold(omega, rate_hz))

    def coherence(self) -> Array:
        """Magnitude-squared coherence; 0 where the frequency was not excited, shape (f,).

        Every segment counts, also those in which a chirp is elsewhere: they bring the noise (and
        the harmonics) at this frequency and nothing else. Coherence is then the share of the
        position's power at this frequency, over the whole log, that the command explains. A
        single passage of a chirp in a single segment would be 1 by construction.
        """
        tiny = np.finfo(np.float64).tiny
        raw = np.abs(self.uy) ** 2 / np.maximum(self.uu * self.yy, tiny)
        return np.where(self.excited(), np.clip(raw, 0.0, 1.0), 0.0)

    def excited(self) -> NDArray[np.bool_]:
        """Frequencies that the command holds by more than the leakage of others, shape (f,)."""
        beside = np.pad(self.uu, 1)
        leaked = self.uu < _LEAKED * np.maximum(beside[:-2], beside[2:])
        return np.asarray((self.uu >= _SILENT * self.uu.max()) & ~leaked)

    def averages(self) -> Array:
        """Effective number of independent averages that the coherence rests on, shape (f,).

        `segments sum P / sum_s,t conj(U_s) U_t r_st`, P = |U|^2 and r_st the overlap of windows s
        and t inside the question: the number n for which `(1 - coherence) / (2 n coherence)` is
        the variance of the estimate under white noise, and 1/n the coherence of a position that
        is noise alone. For a stationary random command it is Welch's number; for a chirp it
        counts the segments in which the chirp is elsewhere, as `coherence` does.
        """
        tiny = np.finfo(np.float64).tiny
        return np.asarray(self.segments * self.uu / np.maximum(self.spread, tiny))


def sums(command: ComplexArray, position: ComplexArray, where: Layout) -> Sums:
    """Sum the spectra of one question over its segments.

    Args:
        command: `segment_spectra` of the command, shape (k, f).
        position: The same of the position.
        where: Where the segments lie.
    """
    # Phase from a common instant, in which the noise of two segments correlates by their overlap.
    aligned = command * np.exp(-1j * np.outer(where.starts / where.rate_hz, where.omega))
    power = float(where.window @ where.window)
    windows = [where.measured(i) for i in range(len(where.starts))]
    segments, spread = 0.0, np.zeros(len(where.omega))
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


def total(parts: Sequence[Sums]) -> Sums:
    """Sums over all questions."""
    whole = parts[0]
    for part in parts[1:]:
        whole = whole + part
    return whole
