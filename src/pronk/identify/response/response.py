"""FrequencyResponse, and the settings of its estimators.

The response is that of the joint, from the position command *as held by the drive* (a staircase)
to the measured position; the hold itself is not part of it, so it compares directly with
`stiffness / (I s^2 + (damping + b) s + stiffness)` (paper M2 with theta_dot_des = 0, reading A9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

from pronk.arrays import Array, ComplexArray, Mask
from pronk.errors import ArtefactError, PronkError
from pronk.files import load_artefact, save_artefact
from pronk.names import check_names

SCHEMA = "pronk/response/2"

WINDOWS = ("hann", "hamming", "blackman", "boxcar")
_NYQUIST_SHARE = 0.9
"""Highest share of the Nyquist frequency that is reported: above it the cubic interpolation and
the joint's own images fold back."""


@dataclass(frozen=True, kw_only=True)
class Estimator:
    """Settings of the estimators.

    Segments are averaged as Welch does, with the mean of each segment taken away. Periodic signals
    (multisine, sine steps) are read line by line without a window and use the band alone.
    """

    segment_s: float = 8.0
    """Length of a segment [s]; its inverse is the spacing of the frequencies.

    Eight seconds hold the bias of a 20 s chirp of 0.1 to 25 Hz below 0.5 % of gain down to 0.25 Hz
    and at a resonance of damping ratio 0.2; four seconds leave 2 %.
    """
    overlap: float = 0.75
    """Share of a segment that the next one repeats."""
    window: str = "hann"
    """One of `WINDOWS`."""
    min_hz: float = 0.1
    """Lowest frequency reported [Hz]."""
    max_hz: float = 25.0
    """Highest frequency reported [Hz]; 0.9 of the Nyquist frequency where that is lower."""

    def __post_init__(self) -> None:
        """Refuse misspelled and impossible settings."""
        length = np.isfinite(self.segment_s) and self.segment_s > 0.0
        for name, good, expected in (
            ("window", self.window in WINDOWS, f"one of {', '.join(WINDOWS)}"),
            ("segment_s", length, "a positive number of seconds"),
            ("overlap", 0.0 <= self.overlap < 1.0, "a share in [0, 1), for instance 0.75"),
            ("min_hz", 0.0 <= self.min_hz < self.max_hz, f"0 <= min_hz < max_hz ({self.max_hz})"),
        ):
            if not good:
                raise PronkError(
                    f"Estimator.{name} is {getattr(self, name)!r}; expected {expected}."
                )

    def top_hz(self, rate_hz: float) -> float:
        """Highest frequency reported at this rate [Hz]."""
        return min(self.max_hz, _NYQUIST_SHARE * rate_hz / 2.0)


@dataclass(frozen=True, kw_only=True)
class FrequencyResponse:
    """Response of one joint at one amplitude, with its uncertainty."""

    joint: str
    amplitude: float
    """Peak of the command [rad]."""
    omega: Array
    """[rad/s], increasing, shape (f,)."""
    response: ComplexArray
    """Position over held command, averaged over all repeats, shape (f,)."""
    coherence: Array
    """Magnitude-squared coherence in 0..1, over all segments of all repeats, shape (f,)."""
    averages: Array
    """Effective number of independent averages that the coherence rests on, shape (f,)."""
    repeats: ComplexArray
    """Response of each repeat by itself, shape (repeats, f): the unit of uncertainty."""
    estimator: str
    """H1 or periodic."""
    window: str
    """Window and overlap in words, for the page."""
    segment_s: float
    delay_s: float = 0.0
    """Command delay from the slope of the phase beyond the fitted joint [s]; NaN if not fitted."""
    third_harmonic: float = float("nan")
    """Response at three times the excited frequency over that at it: the friction detector."""
    virtual: bool = False
    source: str = ""

    def __post_init__(self) -> None:
        """Refuse a name, shapes and frequencies that no estimate gives."""
        where, shape = self.source or "response", np.shape(self.omega)
        check_names([self.joint], where, ArtefactError)
        fits = all(np.shape(v) == shape for v in (self.response, self.coherence, self.averages))
        if len(shape) != 1 or 0 in shape or not fits or np.shape(self.repeats)[1:] != shape:
            raise ArtefactError(f"{where}: the response of {self.joint} has contradictory shapes.")
        omega = np.asarray(self.omega)
        if omega.dtype.kind not in "fi" or not (np.diff(omega, prepend=-1e-12) > 0.0).all():
            raise ArtefactError(
                f"{where}: frequencies of {self.joint} that do not increase from 0."
            )

    @property
    def frequency_hz(self) -> Array:
        """Frequency [Hz], shape (f,)."""
        return np.asarray(self.omega / (2.0 * np.pi))

    @property
    def gain(self) -> Array:
        """Absolute gain, not dB, shape (f,)."""
        return np.abs(self.response)

    @property
    def phase(self) -> Array:
        """Unwrapped phase [rad], shape (f,)."""
        return np.asarray(np.unwrap(np.angle(self.response)))

    def deviation(self) -> Array:
        """Relative standard deviation of the response by its coherence, shape (f,).

        `sqrt((1 - coherence) / (2 averages coherence))` (Bendat and Piersol, *Random Data*,
        eq. 9.90), which takes noise for white inside a bin.
        """
        coherent = np.clip(self.coherence, 1e-9, 1.0)
        averages = np.maximum(self.averages, 1.0)
        return np.asarray(np.sqrt((1.0 - coherent) / (2.0 * coherent * averages)))

    def relative_error(self, level: float = 0.95) -> Array:
        """Half-width of the interval on the complex response, relative to its gain, shape (f,).

        With three repeats or more Student's t over repeats; with fewer by `deviation`. The bias of
        the window comes on top (0.3 % of gain at most for the default settings and a chirp of 0.1
        to 25 Hz in 20 s), alike for a measured and a simulated joint.
        """
        n = len(self.repeats)
        if n >= 3:
            spread = np.abs(self.repeats - self.repeats.mean(axis=0))
            # Real and imaginary parts share the variance: halve it for one direction.
            deviation = np.sqrt((spread**2).sum(axis=0) / (2.0 * (n - 1)))
            quantile = float(stats.t.ppf(0.5 + level / 2.0, 2 * (n - 1)))
            return np.asarray(quantile * deviation / np.sqrt(n) / self.gain)
        return np.asarray(float(stats.norm.ppf(0.5 + level / 2.0)) * self.deviation())

    def gain_interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Lower and upper bound of the absolute gain."""
        relative = self.relative_error(level)
        return self.gain * np.maximum(1.0 - relative, 0.0), self.gain * (1.0 + relative)

    def phase_interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Lower and upper bound of the phase [rad]."""
        half = np.arcsin(np.clip(self.relative_error(level), 0.0, 1.0))
        return self.phase - half, self.phase + half

    def band(self, low_hz: float, high_hz: float, coherence: float = 0.0) -> Mask:
        """Mask of the frequencies inside a band whose coherence is at least `coherence`."""
        hz = self.frequency_hz
        inside = (hz >= low_hz - 1e-9) & (hz <= high_hz + 1e-9)
        return np.asarray(inside & (self.coherence >= coherence))


@dataclass(frozen=True)
class _Stored:
    responses: list[FrequencyResponse]


def save(path: Path, responses: Sequence[FrequencyResponse]) -> None:
    """Write responses to one `*.response.npz` (plain arrays and a JSON header, no pickle)."""
    save_artefact(path, _Stored(list(responses)), SCHEMA)


def load(path: Path) -> list[FrequencyResponse]:
    """Read what `save` wrote; ArtefactError for any other file."""
    return load_artefact(
        path, _Stored, SCHEMA, what="a response file", writer="pronk response LOG"
    ).responses
