"""FrequencyResponse, and the settings of its estimators.

The response is that of the joint, from the position command *as held by the drive* (a staircase)
to the measured position; the hold itself is not part of it, so it compares directly with
`stiffness / (I s^2 + (damping + b) s + stiffness)` (paper M2 with theta_dot_des = 0, reading A9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import special

from pronk.arrays import Array, ComplexArray, Mask
from pronk.errors import ArtefactError, LogError, PronkError
from pronk.files import load_artefact, save_artefact
from pronk.frames import data_frame
from pronk.names import check_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

SCHEMA = "pronk/response/2"

WINDOWS = ("hann", "hamming", "blackman", "boxcar")
_NYQUIST_SHARE = 0.9
"""Highest share of the Nyquist frequency that is reported: above it the cubic interpolation and
the joint's own images fold back."""


LONGEST_SEGMENT_S = 8.0
"""Length of a segment where the excitation is long enough [s].

Eight seconds hold the bias of a 20 s chirp of 0.1 to 25 Hz below 0.5 % of gain down to 0.25 Hz and
at a resonance of damping ratio 0.2; four seconds leave 2 %.
"""


class ShortExcitationError(LogError):
    """An excitation is too short for a response with the frequencies that are asked for."""


@dataclass(frozen=True, kw_only=True)
class Estimator:
    """Settings of the estimators.

    Segments are averaged as Welch does, with the mean of each segment taken away. Periodic signals
    (multisine, sine steps) are read line by line without a window and use the band alone.
    """

    segment_s: float | None = None
    """Length of a segment [s]; its inverse is the spacing of the frequencies. If None, 8 s, or less
    where the excitations are too short for it (`fitting_estimator`)."""
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
        if self.window not in WINDOWS:
            raise PronkError(
                f"Estimator.window is {self.window!r}; expected one of {', '.join(WINDOWS)}."
            )
        given_s = self.segment_s
        if given_s is not None and not (np.isfinite(given_s) and given_s > 0.0):
            raise PronkError(
                f"segment_s (--segment-s) is {given_s!r}; expected a positive number of seconds."
            )
        if not 0.0 <= self.overlap < 1.0:
            raise PronkError(
                f"Estimator.overlap is {self.overlap!r}; expected a share in [0, 1), for instance "
                "0.75."
            )
        if not 0.0 <= self.min_hz < self.max_hz:
            raise PronkError(
                f"Estimator.min_hz is {self.min_hz!r}; expected 0 <= min_hz < max_hz "
                f"({self.max_hz})."
            )

    @property
    def length_s(self) -> float:
        """Length of a segment [s], the longest where none was chosen."""
        return LONGEST_SEGMENT_S if self.segment_s is None else self.segment_s

    def top_hz(self, rate_hz: float) -> float:
        """Highest frequency reported at this rate [Hz]."""
        return min(self.max_hz, _NYQUIST_SHARE * rate_hz / 2.0)


@dataclass(frozen=True, kw_only=True)
class FrequencyResponse:
    """Response of one joint at one amplitude, with its uncertainty."""

    joint: str
    """Name of the joint."""
    amplitude: float
    """Peak of the command [rad]."""
    omega: Array
    """Angular frequencies [rad/s], increasing, shape (f,)."""
    response: ComplexArray
    """Position over held command, averaged over all repeats, shape (f,)."""
    coherence: Array
    """Magnitude-squared coherence in 0..1, over all segments of all repeats, shape (f,)."""
    averages: Array
    """Effective number of independent averages that the coherence rests on, shape (f,)."""
    repeats: ComplexArray
    """Response of each repeat by itself, shape (repeats, f): the unit of uncertainty."""
    estimator: str
    """Name of the estimator, `H1` or `periodic`."""
    window: str
    """Window and overlap in words, for the page."""
    segment_s: float
    """Length of a segment or period [s]; its inverse is the spacing of the frequencies."""
    delay_s: float = 0.0
    """Command delay from the slope of the phase beyond the fitted joint [s]; NaN if not fitted."""
    third_harmonic: float = float("nan")
    """Response at three times the excited frequency over that at it: the friction detector."""
    virtual: bool = False
    """True if the machine was the virtual robot."""
    source: str = ""
    """File that the log was read from."""

    def __post_init__(self) -> None:
        """Refuse a name, shapes and frequencies that no estimate gives, with an ArtefactError."""
        source = self.source or "response"
        check_names([self.joint], source, ArtefactError)
        shape = np.shape(self.omega)
        same_shape = (
            np.shape(self.response) == shape
            and np.shape(self.coherence) == shape
            and np.shape(self.averages) == shape
            and np.shape(self.repeats)[1:] == shape
        )
        if len(shape) != 1 or 0 in shape or not same_shape:
            raise ArtefactError(f"{source}: the response of {self.joint} has contradictory shapes.")
        omega = np.asarray(self.omega)
        is_numeric = omega.dtype.kind in "fi"
        if not is_numeric or not (np.diff(omega, prepend=-1e-12) > 0.0).all():
            raise ArtefactError(
                f"{source}: frequencies of {self.joint} that do not increase from 0."
            )

    def __repr__(self) -> str:
        """Return joint, amplitude, band and coherence on one line."""
        return (
            f"FrequencyResponse({self.joint}, {self.amplitude:.3g} rad, {len(self.omega)} "
            f"frequencies from {self.frequency_hz[0]:.3g} to {self.frequency_hz[-1]:.3g} Hz, "
            f"median coherence {float(np.median(self.coherence)):.3f}, "
            f"{len(self.repeats)} repeats)"
        )

    def plot(self) -> Figure:
        """Draw gain [dB], phase [deg] and coherence over frequency, with 95 % intervals.

        Returns:
            A figure of Matplotlib, to be shown in a notebook or saved with `savefig`.
        """
        from matplotlib.figure import Figure  # slow to import

        figure = Figure(figsize=(8.0, 6.0), layout="constrained")
        gain_axes, phase_axes, coherence_axes = figure.subplots(
            3, 1, sharex=True, height_ratios=[3.0, 2.0, 1.0]
        )
        hz = self.frequency_hz
        low_gain, high_gain = self.gain_interval()
        low_phase, high_phase = self.phase_interval()
        smallest = 1e-10  # -200 dB: a gain of zero can be drawn.
        gain_axes.fill_between(
            hz,
            20.0 * np.log10(np.maximum(low_gain, smallest)),
            20.0 * np.log10(np.maximum(high_gain, smallest)),
            alpha=0.3,
        )
        gain_axes.plot(hz, 20.0 * np.log10(np.maximum(self.gain, smallest)))
        gain_axes.set_title(f"{self.joint}, {self.amplitude:.3g} rad")
        gain_axes.set(xscale="log", ylabel="gain [dB]")
        phase_axes.fill_between(hz, np.degrees(low_phase), np.degrees(high_phase), alpha=0.3)
        phase_axes.plot(hz, np.degrees(self.phase))
        phase_axes.set(ylabel="phase [deg]")
        coherence_axes.plot(hz, self.coherence)
        coherence_axes.set(xlabel="frequency [Hz]", ylabel="coherence", ylim=(0.0, 1.05))
        return figure

    def to_dict(self) -> dict[str, Any]:
        """Return the response as numbers, text and lists, as JSON takes them; gain is absolute."""
        return {
            "joint": self.joint,
            "amplitude_rad": self.amplitude,
            "frequency_hz": self.frequency_hz.tolist(),
            "gain": self.gain.tolist(),
            "phase_rad": self.phase.tolist(),
            "coherence": self.coherence.tolist(),
            "averages": self.averages.tolist(),
            "repeats": len(self.repeats),
            "estimator": self.estimator,
            "window": self.window,
            "segment_s": self.segment_s,
            "delay_s": self.delay_s,
            "third_harmonic": self.third_harmonic,
            "virtual": self.virtual,
            "source": self.source,
        }

    def to_dataframe(self) -> DataFrame:
        """Return the response as a data frame of pandas, a row for each frequency.

        The names of the columns end with the unit; the absolute gain and the coherence have none.
        Columns `low` and `high` are the ends of the 95 % interval.

        Raises:
            PronkError: pandas is not installed.
        """
        low_gain, high_gain = self.gain_interval()
        low_phase, high_phase = self.phase_interval()
        return data_frame(
            {
                "joint": [self.joint] * len(self.omega),
                "amplitude_rad": np.full(len(self.omega), self.amplitude),
                "frequency_hz": self.frequency_hz,
                "gain": self.gain,
                "gain_low": low_gain,
                "gain_high": high_gain,
                "phase_rad": self.phase,
                "phase_low_rad": low_phase,
                "phase_high_rad": high_phase,
                "coherence": self.coherence,
                "averages": self.averages,
            }
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
        """Return the relative standard deviation of the response by its coherence, shape (f,).

        `sqrt((1 - coherence) / (2 averages coherence))` (Bendat and Piersol, *Random Data*,
        eq. 9.90), which takes noise for white inside a bin.
        """
        coherent = np.clip(self.coherence, 1e-9, 1.0)
        averages = np.maximum(self.averages, 1.0)
        return np.asarray(np.sqrt((1.0 - coherent) / (2.0 * coherent * averages)))

    def relative_error(self, level: float = 0.95) -> Array:
        """Return the half-width of the interval on the complex response over its gain, shape (f,).

        It is Student's t over repeats from three repeats on, and follows from `deviation` with
        fewer. The bias of the window comes on top (0.3 % of gain at most for the default settings
        and a chirp of 0.1 to 25 Hz in 20 s), alike for a measured and a simulated joint.
        """
        count = len(self.repeats)
        if count >= 3:
            spread = np.abs(self.repeats - self.repeats.mean(axis=0))
            # Real and imaginary parts share the variance: halve it for one direction.
            deviation = np.sqrt((spread**2).sum(axis=0) / (2.0 * (count - 1)))
            quantile = float(special.stdtrit(2 * (count - 1), 0.5 + level / 2.0))
            return np.asarray(quantile * deviation / np.sqrt(count) / self.gain)
        return np.asarray(float(special.ndtri(0.5 + level / 2.0)) * self.deviation())

    def gain_interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Return the lower and the upper bound of the absolute gain, shapes (f,)."""
        relative = self.relative_error(level)
        return self.gain * np.maximum(1.0 - relative, 0.0), self.gain * (1.0 + relative)

    def phase_interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Return the lower and the upper bound of the phase [rad], shapes (f,)."""
        half = np.arcsin(np.clip(self.relative_error(level), 0.0, 1.0))
        return self.phase - half, self.phase + half

    def band(self, low_hz: float, high_hz: float, coherence: float = 0.0) -> Mask:
        """Return the mask of the coherent frequencies inside a band, shape (f,).

        Args:
            low_hz: Lowest frequency [Hz].
            high_hz: Highest frequency [Hz].
            coherence: Least coherence of a frequency that counts.
        """
        hz = self.frequency_hz
        inside = (hz >= low_hz - 1e-9) & (hz <= high_hz + 1e-9)
        return np.asarray(inside & (self.coherence >= coherence))


@dataclass(frozen=True)
class _ResponseFile:
    """Content of a response file."""

    responses: list[FrequencyResponse]


def save_responses(path: Path, responses: Sequence[FrequencyResponse]) -> None:
    """Write responses to one `*.response.npz` (plain arrays and a JSON header, no pickle)."""
    save_artefact(path, _ResponseFile(list(responses)), SCHEMA)


def load_responses(path: Path) -> list[FrequencyResponse]:
    """Read what `save_responses` wrote; ArtefactError for any other file."""
    return load_artefact(
        path, _ResponseFile, SCHEMA, what="a response file", writer="pronk response LOG"
    ).responses
