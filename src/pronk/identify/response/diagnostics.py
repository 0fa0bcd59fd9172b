"""Delay and third harmonic: what a second-order linear joint would not show.

Delay of the command: the gain of a joint fixes its own phase (a second-order joint is minimum
phase); phase beyond it that grows with frequency is delay. All four parameters of

    H = ratio exp(-s delay) / ((s / w0)^2 + 2 zeta s / w0 + 1)

are fitted at once by least squares on log H, so that a percent of gain and a hundredth of a radian
count alike. `ratio` takes up a stiffness ratio below one (gravity, a soft base). What else is not
minimum phase, or beyond second order (a belt, a current loop), adds to the delay found.

Third harmonic: a linear joint excited at f responds at f. Dry friction is odd in the velocity, so
it responds at 3 f as well, the more the smaller the motion. For the knee of the Mini Cheetah at
0.25 rad the ratio is 0.0001 without friction and 0.0033 for every 0.05 N m of it, inversely to the
amplitude.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import least_squares

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.identify.logs.joint_log import Excitation
from pronk.identify.response.grid import analysis_rate
from pronk.identify.response.periodic import read_steps
from pronk.identify.response.response import Estimator, FrequencyResponse

_TOP_HZ = 25.0
"""Highest frequency that takes part in the fit of the delay [Hz]."""
_COHERENT = 0.8
"""Least coherence of a frequency that takes part in the fit of the delay."""
_FLOOR = 1e-3
"""Incoherence that no frequency falls below: a perfect bin must not dominate the fit."""
_FEWEST = 8
"""Fewest frequencies for four parameters: twice as many real equations as twice the unknowns."""

_LOW_BAND_HZ = (1.0, 4.0)
"""Where the third harmonic is measured. A chirp of 0.1 to 25 Hz in 20 s is past its ramp of 0.5 s
at 1 Hz (the ramp itself reads as 0.008); three times 4 Hz is inside the bandwidth of the joints."""
_FEWEST_CYCLES = 3.0
"""Fewest cycles of the signal inside the band that separate f from 3 f."""
_SAMPLES_A_TURN = 25
"""Samples in a cycle at the top of the band, at least: eight at three times the frequency."""
_DEGREES = {1: 4, 2: 2, 3: 2}
"""Degree of the polynomial that the size and phase of each harmonic follow over the band."""
_FEWEST_SAMPLES = 50
"""Fewest samples in the band: two for each of the 24 columns of the fit."""


def fit_delay(response: FrequencyResponse) -> float:
    """Fit the delay beyond a second-order joint [s]; NaN if too few frequencies are coherent.

    Frequencies weigh `coherence / (1 - coherence)`.
    """
    coherent = response.band(0.0, _TOP_HZ, _COHERENT) & (response.gain > 0.0)
    if int(coherent.sum()) < _FEWEST:
        return math.nan
    omega = response.omega[coherent]
    values = response.response[coherent]
    coherence = response.coherence[coherent]
    weight = np.sqrt(coherence / np.maximum(1.0 - coherence, _FLOOR))
    weight = weight / weight.mean()
    # The natural frequency is near where the phase passes -90 degrees.
    natural = omega[int(np.argmin(np.abs(np.unwrap(np.angle(values)) + np.pi / 2.0)))]
    start = np.array([np.log(abs(values[0])), np.log(natural), np.log(0.7), 0.0])

    def residual(parameters: Array) -> Array:
        log_ratio, log_natural, log_zeta, delay = parameters
        # A step that is far too long overflows; the search then takes a shorter one.
        with np.errstate(all="ignore"):
            x = 1j * omega / np.exp(log_natural)
            second_order = x**2 + 2.0 * np.exp(log_zeta) * x + 1.0
            model = np.exp(log_ratio - 1j * omega * delay) / second_order
            deviation = np.log(values / model)
        return np.asarray(np.concatenate([weight * deviation.real, weight * deviation.imag]))

    fit = least_squares(residual, start, x_scale=[0.1, 0.1, 0.1, 1e-3], method="trf")
    return float(fit.x[3])


def third_harmonic(excitation: Excitation) -> float:
    """Measure the third harmonic of the response to one excitation: RMS at 3 f over RMS at f.

    The excited frequencies f from 1 to 4 Hz count. Sine steps are read exactly, chirps by
    demodulation. NaN where the log lacks the frequency, and for multisines.
    """
    if excitation.frequency is None or excitation.segment.kind == "multisine":
        return math.nan
    if excitation.segment.kind == "sine_steps":
        estimator = Estimator(min_hz=_LOW_BAND_HZ[0], max_hz=_LOW_BAND_HZ[1])
        try:
            steps = read_steps(excitation, estimator, analysis_rate([excitation.time]))
        except LogError:
            # No step in the low band.
            return math.nan
        ratios = steps.third[np.isfinite(steps.third)]
        return float(np.sqrt(np.mean(ratios**2))) if len(ratios) else math.nan
    return _of_chirp(excitation.time, excitation.position, excitation.frequency)


def _of_chirp(time: Array, position: Array, frequency: Array) -> float:
    """Measure the third harmonic of a chirp, the phase being the integral of its frequency.

    The position is fitted by the first three harmonics, each with a size and phase that change
    smoothly over the band, and by a straight line. Arrays have shape (n,).
    """
    filled = np.nan_to_num(frequency, nan=-1.0)
    low, high = _LOW_BAND_HZ
    inside = (filled >= low) & (filled <= high)
    if int(inside.sum()) < _FEWEST_SAMPLES:
        return math.nan
    # The longest stretch: a chirp passes the band once.
    stretches = np.flatnonzero(np.diff(np.pad(inside, 1))).reshape(-1, 2)
    start, stop = stretches[int(np.argmax(stretches[:, 1] - stretches[:, 0]))]
    phase = cumulative_trapezoid(frequency[start:stop], time[start:stop], initial=0)
    phase = 2.0 * np.pi * phase
    samples_needed = (time[stop - 1] - time[start]) * high * _SAMPLES_A_TURN
    stride = max(1, int((stop - start) / samples_needed))
    phase = phase[::stride]
    hz = frequency[start:stop:stride]
    motion = position[start:stop:stride]
    if phase[-1] < 2.0 * np.pi * _FEWEST_CYCLES or np.ptp(hz) == 0.0:
        return math.nan
    scaled_hz = 2.0 * (hz - hz.min()) / np.ptp(hz) - 1.0
    line = np.linspace(-1.0, 1.0, len(motion))
    columns = [np.ones_like(line), line]
    harmonics = [0, 0]
    for harmonic, degree in _DEGREES.items():
        for polynomial in np.polynomial.legendre.legvander(scaled_hz, degree).T:
            columns.append(polynomial * np.cos(harmonic * phase))
            columns.append(polynomial * np.sin(harmonic * phase))
            harmonics += [harmonic, harmonic]
    basis = np.stack(columns, axis=1)
    parts = basis * np.linalg.lstsq(basis, motion, rcond=None)[0]
    fundamental_rms = _rms_of(parts[:, np.equal(harmonics, 1)])
    third_rms = _rms_of(parts[:, np.equal(harmonics, 3)])
    return third_rms / fundamental_rms if fundamental_rms > 0.0 else math.nan


def _rms_of(parts: Array) -> float:
    """Root mean square of the sum of some columns."""
    return float(np.sqrt(np.mean(parts.sum(axis=1) ** 2)))
