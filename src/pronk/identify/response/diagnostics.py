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
_COHERENT = 0.8
"""Highest frequency [Hz] and least coherence that take part in the fit of the delay."""
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
"""At the top of the band: eight at three times it, and no more than that to be fitted."""
_SHAPE = {1: 4, 2: 2, 3: 2}
"""Harmonic and degree of the polynomial that its size and phase follow over the band."""


def fit_delay(response: FrequencyResponse) -> float:
    """Delay beyond a second-order joint [s]; NaN if too few frequencies are coherent.

    Frequencies weigh `coherence / (1 - coherence)`.
    """
    use = response.band(0.0, _TOP_HZ, _COHERENT) & (response.gain > 0.0)
    if int(use.sum()) < _FEWEST:
        return math.nan
    omega, values = response.omega[use], response.response[use]
    coherence = response.coherence[use]
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
            off = np.log(values / (np.exp(log_ratio - 1j * omega * delay) / second_order))
        return np.asarray(np.concatenate([weight * off.real, weight * off.imag]))

    found = least_squares(residual, start, x_scale=[0.1, 0.1, 0.1, 1e-3], method="trf")
    return float(found.x[3])


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
    """Third harmonic of a chirp, the phase being the integral of its frequency.

    The position is fitted by the first three harmonics, each with a size and phase that change
    smoothly over the band, and by a straight line.
    """
    known = np.nan_to_num(frequency, nan=-1.0)
    low, high = _LOW_BAND_HZ
    inside = (known >= low) & (known <= high)
    if int(inside.sum()) < 50:
        return math.nan
    # The longest stretch: a chirp passes the band once.
    stretches = np.flatnonzero(np.diff(np.pad(inside, 1))).reshape(-1, 2)
    first, stop = stretches[int(np.argmax(stretches[:, 1] - stretches[:, 0]))]
    t, y, f = time[first:stop], position[first:stop], frequency[first:stop]
    phase = 2.0 * np.pi * cumulative_trapezoid(f, t, initial=0)
    thin = max(1, int(len(t) / ((t[-1] - t[0]) * high * _SAMPLES_A_TURN)))
    t, y, f, phase = t[::thin], y[::thin], f[::thin], phase[::thin]
    if phase[-1] < 2.0 * np.pi * _FEWEST_CYCLES or np.ptp(f) == 0.0:
        return math.nan
    x = 2.0 * (f - f.min()) / np.ptp(f) - 1.0
    line = np.linspace(-1.0, 1.0, len(t))
    columns, harmonics = [np.ones_like(line), line], [0, 0]
    for harmonic, degree in _SHAPE.items():
        for shape in np.polynomial.legendre.legvander(x, degree).T:
            columns += [shape * np.cos(harmonic * phase), shape * np.sin(harmonic * phase)]
            harmonics += [harmonic, harmonic]
    basis = np.stack(columns, axis=1)
    parts = basis * np.linalg.lstsq(basis, y, rcond=None)[0]
    first, third = (
        float(np.sqrt(np.mean(parts[:, np.equal(harmonics, n)].sum(axis=1) ** 2))) for n in (1, 3)
    )
    return third / first if first > 0.0 else math.nan
