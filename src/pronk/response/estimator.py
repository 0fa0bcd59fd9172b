"""Settings of the estimators."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import get_window

from pronk.errors import PronkError

WINDOWS = ("hann", "hamming", "blackman", "boxcar")

_NYQUIST_SHARE = 0.9
"""Highest share of the Nyquist frequency that is reported: above it the cubic interpolation and
the joint's own images fold back."""


@dataclass(frozen=True, kw_only=True)
class Estimator:
    """How a response is estimated.

    Segments are averaged as Welch does, with the mean of each segment taken away. Periodic
    questions (multisine, sine steps) need no window and are read line by line instead; of these
    settings they use the band alone.
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
        """Refuse misspelled and impossible settings.

        Raises:
            PronkError: With what was got and what there is to choose from.
        """
        if self.window not in WINDOWS:
            raise PronkError(
                f"Estimator.window is {self.window!r}; expected one of {', '.join(WINDOWS)}."
            )
        if not (np.isfinite(self.segment_s) and self.segment_s > 0.0):
            raise PronkError(
                f"Estimator.segment_s is {self.segment_s}; expected a positive number of seconds."
            )
        if not 0.0 <= self.overlap < 1.0:
            raise PronkError(
                f"Estimator.overlap is {self.overlap}; expected a share in [0, 1), for instance "
                "0.75."
            )
        if not 0.0 <= self.min_hz < self.max_hz:
            raise PronkError(
                f"Estimator.min_hz is {self.min_hz} and max_hz {self.max_hz}; expected "
                "0 <= min_hz < max_hz [Hz]."
            )

    def samples(self, rate_hz: float) -> int:
        """Samples in a segment."""
        return round(self.segment_s * rate_hz)

    def hop(self, rate_hz: float) -> int:
        """Samples from one segment to the next."""
        return max(1, round(self.samples(rate_hz) * (1.0 - self.overlap)))

    def weights(self, rate_hz: float) -> NDArray[np.float64]:
        """The window, shape (samples,)."""
        return np.asarray(get_window(self.window, self.samples(rate_hz), fftbins=True))

    def top_hz(self, rate_hz: float) -> float:
        """Highest frequency reported at this rate [Hz]."""
        return min(self.max_hz, _NYQUIST_SHARE * rate_hz / 2.0)

    def words(self) -> str:
        """Window and overlap, for the page."""
        return f"{self.window} {self.segment_s:g} s, {100.0 * self.overlap:.0f} % overlap"
