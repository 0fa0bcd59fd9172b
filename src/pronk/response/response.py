"""FrequencyResponse: a joint's answer as complex numbers over frequency.

The response is that of the joint, from the position command *as held by the drive* (a staircase)
to the measured position; the hold itself is not part of it, so it compares directly with
`stiffness / (I s^2 + (damping + b) s + stiffness)` (paper M2 with theta_dot_des = 0, reading A9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pronk.files import load_artefact, save_artefact

SCHEMA = "pronk/response/2"

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, kw_only=True)
class FrequencyResponse:
    """Response of one joint at one amplitude, with what is known of its uncertainty."""

    joint: str
    amplitude: float
    """Peak of the command [rad]."""
    omega: Array
    """Angular frequency [rad/s], increasing, shape (f,)."""
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
    """Length of a segment [s]."""
    delay_s: float = 0.0
    """Command delay from the slope of the phase beyond the fitted joint [s]; NaN if not fitted."""
    third_harmonic: float = float("nan")
    """Response at three times the excited frequency over that at it: the friction detector."""
    virtual: bool = False
    source: str = ""

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

    def relative_error(self, level: float = 0.95) -> Array:
        """Half-width of the interval on the complex response, relative to its gain, shape (f,).

        Where there are three repeats or more it is Student's t over repeats (coloured noise is
        then counted as it is); with fewer, the coherence formula
        `sqrt((1 - coherence) / (2 averages coherence))` (Bendat and Piersol, *Random Data*,
        eq. 9.90), which takes noise for white inside a bin.

        It is the random error alone. Windows bias an estimate as well (0.3 % of gain at most for
        the default settings and a chirp of 0.1 to 25 Hz in 20 s), alike for a measured and a
        simulated joint that go through the same estimator.
        """
        n = len(self.repeats)
        if n >= 3:
            spread = np.abs(self.repeats - self.repeats.mean(axis=0))
            # Real and imaginary parts share the variance: halve it for one direction.
            deviation = np.sqrt((spread**2).sum(axis=0) / (2.0 * (n - 1)))
            quantile = float(stats.t.ppf(0.5 + level / 2.0, 2 * (n - 1)))
            return np.asarray(quantile * deviation / np.sqrt(n) / self.gain)
        coherent = np.clip(self.coherence, 1e-9, 1.0)
        deviation = np.sqrt((1.0 - coherent) / (2.0 * coherent * np.maximum(self.averages, 1.0)))
        return np.asarray(float(stats.norm.ppf(0.5 + level / 2.0)) * deviation)

    def gain_interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Lower and upper bound of the absolute gain."""
        relative = self.relative_error(level)
        return self.gain * np.maximum(1.0 - relative, 0.0), self.gain * (1.0 + relative)

    def phase_interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Lower and upper bound of the phase [rad]."""
        half = np.arcsin(np.clip(self.relative_error(level), 0.0, 1.0))
        return self.phase - half, self.phase + half

    def band(self, low_hz: float, high_hz: float, coherence: float = 0.0) -> NDArray[np.bool_]:
        """Mask of the frequencies inside a band whose coherence is at least `coherence`."""
        hz = self.frequency_hz
        slack = 1e-9
        inside = (hz >= low_hz - slack) & (hz <= high_hz + slack)
        return np.asarray(inside & (self.coherence >= coherence))


@dataclass(frozen=True)
class _Stored:
    responses: list[FrequencyResponse]


def save(path: Path, responses: Sequence[FrequencyResponse]) -> None:
    """Write responses to one `*.response.npz` (plain arrays and a JSON header, no pickle)."""
    save_artefact(path, _Stored(list(responses)), SCHEMA)


def load(path: Path) -> list[FrequencyResponse]:
    """Read what `save` wrote.

    Raises:
        ArtefactError: Not such a file, damaged, or of another schema.
    """
    return load_artefact(
        path, _Stored, SCHEMA, what="a response file", writer="pronk response LOG"
    ).responses
