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
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import fft

from pronk.arrays import Array, ComplexArray, Mask
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
from pronk.identify.response.response import (
    Estimator,
    FrequencyResponse,
    ShortExcitationError,
)

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
    """Return True if a command [rad] starts where it ends, and ends at rest."""
    tail = max(2, round(_SETTLED_S * rate_hz))
    amplitude = float(np.ptp(command)) / 2.0
    if len(command) <= tail or amplitude == 0.0:
        return False
    return bool(
        np.ptp(command[-tail:]) <= 1e-6 * amplitude
        and abs(command[0] - command[-1]) <= _AT_CENTRE * amplitude
    )


@dataclass(frozen=True, kw_only=True)
class SegmentLayout:
    """Where the segments of one excitation lie on its analysis grid."""

    grid: Grid
    starts: NDArray[np.intp]
    """First sample of each segment, increasing; negative or beyond the end where padded, (k,)."""
    window: Array
    """Window of a segment, shape (samples,)."""
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
        """Transform each segment, its mean taken away and windowed, shape (k, f).

        The first and the last value, shape (grid.count,), are repeated in the padding. The phase
        counts from the first sample of each segment.
        """
        padded = np.pad(values, self.padding, mode="edge")
        parts = sliding_window_view(padded, len(self.window))[self.starts + self.padding[0]]
        parts = (parts - parts.mean(axis=1, keepdims=True)) * self.window
        return np.asarray(fft.rfft(parts)[:, self.bins])


def segment_layout(grid: Grid, estimator: Estimator, *, padded: bool) -> SegmentLayout:
    """Lay the segments over a grid.

    Args:
        grid: The analysis grid of one excitation.
        estimator: Length, overlap and window of the segments, and the band.
        padded: True to let segments reach over the ends.

    Raises:
        ShortExcitationError: The grid is too short for two segments, or the band holds no
            frequency.
    """
    from scipy.signal import ShortTimeFFT, get_window  # slow to import

    rate_hz = grid.rate_hz
    samples = round(estimator.length_s * rate_hz)
    span = grid.count / rate_hz
    if samples < 8 or grid.count < samples:
        raise ShortExcitationError(
            f"an excitation of {span:.2f} s ({grid.count} samples at {rate_hz:g} Hz) does not "
            f"fill a segment of {estimator.length_s:g} s and 8 samples; choose shorter segments "
            "(--segment-s), or leave the option out."
        )
    window = get_window(estimator.window, samples, fftbins=True)
    transform = ShortTimeFFT(
        window,
        hop=max(1, round(samples * (1.0 - estimator.overlap))),
        fs=rate_hz,
        phase_shift=None,
    )
    if padded:
        first = int(transform.p_min)
        stop = int(transform.p_max(grid.count))
    else:
        first = int(transform.lower_border_end[1])
        stop = int(transform.upper_border_begin(grid.count)[1])
    if stop - first < 2:
        raise ShortExcitationError(
            f"an excitation of {span:.2f} s holds a single segment of {estimator.length_s:g} s, "
            "of which coherence is always 1; choose shorter segments (--segment-s), or leave the "
            "option out."
        )
    hz = np.asarray(transform.f)
    top_hz = estimator.top_hz(rate_hz)
    # From the second line on: the main lobe of the window at the first reaches the mean.
    chosen = (hz >= max(estimator.min_hz, hz[2]) - 1e-9) & (hz <= top_hz + 1e-9)
    if not chosen.any():
        raise ShortExcitationError(
            f"no frequency between {estimator.min_hz:g} and {top_hz:g} Hz with segments of "
            f"{estimator.length_s:g} s at {rate_hz:g} Hz."
        )
    return SegmentLayout(
        grid=grid,
        starts=np.arange(first, stop) * transform.hop - transform.m_num_mid,
        window=window,
        bins=np.flatnonzero(chosen),
    )


@dataclass(frozen=True, kw_only=True)
class Sums:
    """Auto and cross spectra summed over segments; those of several excitations can be added."""

    uu: Array
    """Power of the command, `|U|^2`, shape (f,)."""
    uy: ComplexArray
    """Cross spectrum, `conj(U) Y`, shape (f,)."""
    yy: Array
    """Power of the position, `|Y|^2`, shape (f,)."""
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
        """Return H1 = Suy / Suu from the held command, for noise on the position, shape (f,)."""
        h1 = self.uy / np.maximum(self.uu, _TINY)
        return np.asarray(h1 / hold(omega, rate_hz))

    def coherence(self) -> Array:
        """Return the magnitude-squared coherence, 0 where nothing was excited, shape (f,).

        It is the share of the position's power in all segments that the command explains: every
        segment counts, also those in which a chirp is elsewhere, which bring the noise alone. A
        single passage of a chirp in a single segment would be 1 by construction.
        """
        raw = np.abs(self.uy) ** 2 / np.maximum(self.uu * self.yy, _TINY)
        padded = np.pad(self.uu, 1)
        leaked = self.uu < _LEAKED * np.maximum(padded[:-2], padded[2:])
        excited = (self.uu >= _SILENT * self.uu.max()) & ~leaked
        return np.where(excited, np.clip(raw, 0.0, 1.0), 0.0)

    def averages(self) -> Array:
        """Return the effective number of independent averages behind the coherence, shape (f,).

        `segments sum P / sum_s,t conj(U_s) U_t r_st`, P = |U|^2 and r_st the overlap of windows s
        and t inside the excitation: the number n for which `(1 - coherence) / (2 n coherence)` is
        the variance of the estimate under white noise, and 1/n the coherence of noise alone. For
        a chirp it counts the segments in which the chirp is elsewhere, as `coherence` does.
        """
        return np.asarray(self.segments * self.uu / np.maximum(self.spread, _TINY))


def sum_spectra(command: ComplexArray, position: ComplexArray, segments: SegmentLayout) -> Sums:
    """Sum the spectra of one excitation over its segments.

    Args:
        command: Spectra of the command, by `SegmentLayout.spectra`, shape (k, f).
        position: Spectra of the position, shape (k, f).
        segments: Where the segments lie.
    """
    # Phase from a common instant, in which the noise of two segments correlates by their overlap.
    turn = np.exp(-1j * np.outer(segments.starts / segments.grid.rate_hz, segments.omega))
    aligned = command * turn
    power = float(segments.window @ segments.window)
    # The windows are zero in the padding.
    samples = segments.starts[:, None] + np.arange(len(segments.window))
    inside = (samples >= 0) & (samples < segments.grid.count)
    windows = np.where(inside, segments.window, 0.0)
    count = 0.0
    spread = np.zeros(len(segments.bins))
    for i, start in enumerate(segments.starts):
        share = float(windows[i] @ windows[i]) / power
        count += share
        spread += share * np.abs(aligned[i]) ** 2
        for j in range(i + 1, len(segments.starts)):
            shift = int(segments.starts[j] - start)
            if shift >= len(segments.window):
                break
            overlap = float(windows[i][shift:] @ windows[j][:-shift]) / power
            spread += 2.0 * overlap * (np.conj(aligned[i]) * aligned[j]).real
    return Sums(
        uu=np.asarray((np.abs(command) ** 2).sum(axis=0)),
        uy=np.asarray((np.conj(command) * position).sum(axis=0)),
        yy=np.asarray((np.abs(position) ** 2).sum(axis=0)),
        segments=count,
        spread=np.asarray(np.maximum(spread, 0.0)),
    )


def estimate_averaged(
    repeats: Sequence[Excitation], estimator: Estimator, rate_hz: float
) -> FrequencyResponse:
    """Estimate H1 over the segments of all repeats of one excitation."""
    first = repeats[0]
    sums_of_repeats = []
    ends = "reaching over the ends at rest"
    for repeat in repeats:
        grid = grid_over(repeat.time, rate_hz)
        command = held_mean(repeat.time, repeat.command, grid.edges)
        position = interpolate(repeat.time, repeat.position, grid)
        padded = rests(command, rate_hz)
        if not padded:
            ends = "inside the excitation"
        segments = segment_layout(grid, estimator, padded=padded)
        sums_of_repeats.append(
            sum_spectra(segments.spectra(command), segments.spectra(position), segments)
        )
    total = sums_of_repeats[0]
    for sums in sums_of_repeats[1:]:
        total = total + sums
    omega = segments.omega
    return FrequencyResponse(
        joint=first.joint,
        amplitude=first.amplitude,
        omega=omega,
        response=total.response(omega, rate_hz),
        coherence=total.coherence(),
        averages=total.averages(),
        repeats=np.array([sums.response(omega, rate_hz) for sums in sums_of_repeats]),
        estimator="H1",
        window=(
            f"{estimator.window} {estimator.length_s:g} s, {100.0 * estimator.overlap:.0f} % "
            f"overlap, {ends}, mean of each segment removed"
        ),
        segment_s=estimator.length_s,
        virtual=first.log.virtual,
        source=first.source,
    )


@dataclass(frozen=True, kw_only=True)
class H1Operator:
    """Linear map from the positions of one excitation to its response.

    On the analysis grid it is the sum over segments of `scale` times `SegmentLayout.spectra`.
    """

    time: Array
    """Measured timestamps of the log it was built for [s], shape (n,)."""
    layout: SegmentLayout
    """Where the segments lie on the analysis grid."""
    command: ComplexArray
    """Transforms of the command, shape (k, f)."""

    @classmethod
    def build(
        cls, time: Array, command: Array, estimator: Estimator, *, rate_hz: float | None = None
    ) -> H1Operator:
        """Compute the map for one command.

        Args:
            time: Timestamps [s], shape (n,).
            command: Command in force from each timestamp [rad], shape (n,).
            estimator: Segments, window and band.
            rate_hz: Rate of the analysis grid [Hz]; that of the timestamps if None.

        Raises:
            LogError: The excitation is too short, or the band holds no frequency.
        """
        grid = grid_over(time, rate_hz)
        held = held_mean(time, command, grid.edges)
        segments = segment_layout(grid, estimator, padded=rests(held, grid.rate_hz))
        return cls(time=time, layout=segments, command=segments.spectra(held))

    @property
    def omega(self) -> Array:
        """Angular frequencies [rad/s], shape (f,)."""
        return self.layout.omega

    @property
    def excitation(self) -> Array:
        """Power of the command, the weight of this excitation among repeats, shape (f,)."""
        return np.asarray((np.abs(self.command) ** 2).sum(axis=0))

    @cached_property
    def scale(self) -> ComplexArray:
        """Factor of the transform of each segment in the response, shape (k, f)."""
        factor = hold(self.omega, self.layout.grid.rate_hz)
        return np.conj(self.command) / (np.maximum(self.excitation, _TINY) * factor)

    def weights(self, chosen: Mask | slice = slice(None)) -> ComplexArray:
        """Return the map from positions on the grid to the chosen frequencies, (count, chosen)."""
        segments = self.layout
        samples = np.arange(len(segments.window))
        turn = np.exp(-2j * np.pi * samples / len(samples))
        turns = turn[np.outer(samples, segments.bins[chosen]) % len(samples)]
        kernel = segments.window[:, None] * turns
        # Taking the mean of a segment away is taking the mean of the kernel away.
        kernel -= kernel.mean(axis=0)
        before, after = segments.padding
        count = segments.grid.count
        padded = np.zeros((before + count + after, kernel.shape[1]), dtype=np.complex128)
        term = np.empty_like(kernel)
        for start, factors in zip(segments.starts + before, self.scale[:, chosen], strict=True):
            padded[start : start + len(kernel)] += np.multiply(kernel, factors, out=term)
        # Padding repeats the first and last sample; its weights gather on them.
        weights = padded[before : before + count]
        weights[0] += padded[:before].sum(axis=0)
        weights[-1] += padded[before + count :].sum(axis=0)
        return weights

    def matrix(self, sample_times: Array, chosen: Mask | slice = slice(None)) -> ComplexArray:
        """Return the map from positions at other instants, `H = positions @ matrix`.

        The cubic interpolation onto the analysis grid is included.

        Args:
            sample_times: Increasing instants on the clock of the log [s], shape (m,).
            chosen: The frequencies, as a mask of shape (f,).

        Returns:
            The map, shape (m, chosen).

        Raises:
            LogError: The instants do not span the excitation.
        """
        return pull_back(self.weights(chosen), sample_times, self.layout.grid)

    def response(self, sample_times: Array, position: Array) -> ComplexArray:
        """Return `position @ matrix(sample_times)` by transforms, faster for few positions.

        Args:
            sample_times: Increasing instants on the clock of the log [s], shape (m,).
            position: Positions at these instants [rad], shape (m,).

        Returns:
            The response, shape (f,).

        Raises:
            LogError: The instants do not span the excitation.
        """
        require_span(sample_times, self.layout.grid)
        spectra = self.layout.spectra(interpolate(sample_times, position, self.layout.grid))
        return np.asarray((self.scale * spectra).sum(axis=0))
