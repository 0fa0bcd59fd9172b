"""What the position holds that a linear joint would not: the friction detector.

A linear joint excited at f responds at f. Dry friction is odd in the velocity, so it responds at
3 f as well, the more the smaller the motion; even distortion (gravity, a bent cable) does not.
For the knee of the Mini Cheetah at 0.25 rad the ratio is 0.0001 without friction and 0.0033 for
every 0.05 N m of it, inversely to the amplitude. A multisine shows odd and even distortion at the
odd and even lines that it left silent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from pronk.errors import LogError
from pronk.logs.joint_log import JointLog
from pronk.response.estimator import Estimator
from pronk.response.grid import analysis_rate
from pronk.response.periodic import read_periods
from pronk.response.steps import read_steps

Array = NDArray[np.float64]

LOW_BAND_HZ = (1.0, 4.0)
"""Where it is looked for. A chirp of 0.1 to 25 Hz in 20 s is past its ramp of 0.5 s at 1 Hz (the
ramp itself reads as 0.008); three times 4 Hz is still inside the bandwidth of the joints."""

_FEWEST_CYCLES = 3.0
"""Fewest turns of the question inside the band that can tell f from 3 f."""
_SAMPLES_A_TURN = 25
"""At the top of the band: eight at three times it, and no more than that to be fitted."""
_SHAPE = {1: 4, 2: 2, 3: 2}
"""Harmonic and degree of the polynomial that its size and phase follow over the band."""


def third_harmonic_chirp(
    time: Array, position: Array, frequency: Array, band_hz: tuple[float, float] = LOW_BAND_HZ
) -> float:
    """Third harmonic of the answer to a chirp, by demodulation at three times its frequency.

    The phase of the question is the integral of its frequency; the position is fitted by its first
    three harmonics, each with a size and phase that change smoothly over the band, and by a
    straight line.

    Args:
        time: Timestamps [s], shape (n,).
        position: [rad], shape (n,).
        frequency: Instantaneous frequency of the question [Hz], NaN where there is none, shape
            (n,).
        band_hz: Frequencies looked at [Hz].

    Returns:
        RMS at 3 f over RMS at f; NaN if the question turns fewer than three times in the band.
    """
    inside = np.isfinite(frequency)
    inside[inside] &= (frequency[inside] >= band_hz[0]) & (frequency[inside] <= band_hz[1])
    if int(inside.sum()) < 50:
        return float("nan")
    # The longest stretch: a chirp passes the band once.
    edges = np.flatnonzero(np.diff(np.concatenate(([False], inside, [False]))))
    stretches = edges.reshape(-1, 2)
    first, stop = stretches[int(np.argmax(stretches[:, 1] - stretches[:, 0]))]
    t, y, f = time[first:stop], position[first:stop], frequency[first:stop]
    phase = 2.0 * np.pi * cumulative_trapezoid(f, t, initial=0)
    thin = max(1, int(len(t) / ((t[-1] - t[0]) * band_hz[1] * _SAMPLES_A_TURN)))
    t, y, f, phase = t[::thin], y[::thin], f[::thin], phase[::thin]
    if phase[-1] < 2.0 * np.pi * _FEWEST_CYCLES or np.ptp(f) == 0.0:
        return float("nan")
    x = 2.0 * (f - f.min()) / np.ptp(f) - 1.0
    line = np.linspace(-1.0, 1.0, len(t))
    columns, owner = [np.ones_like(line), line], [0, 0]
    for harmonic, degree in _SHAPE.items():
        for power in range(degree + 1):
            shape = np.polynomial.legendre.legval(x, np.eye(degree + 1)[power])
            columns += [shape * np.cos(harmonic * phase), shape * np.sin(harmonic * phase)]
            owner += [harmonic, harmonic]
    basis = np.stack(columns, axis=1)
    size = np.linalg.lstsq(basis, y, rcond=None)[0]
    rms = {
        k: float(
            np.sqrt(np.mean((basis[:, np.array(owner) == k] @ size[np.array(owner) == k]) ** 2))
        )
        for k in (1, 3)
    }
    return rms[3] / rms[1] if rms[1] > 0.0 else float("nan")


def third_harmonic(log: JointLog, joint: str, band_hz: tuple[float, float] = LOW_BAND_HZ) -> float:
    """Third harmonic of the answer to one question.

    Sine steps are read exactly, chirps by demodulation.

    Args:
        log: One question (`JointLog.cut`).
        joint: The excited joint.
        band_hz: Frequencies looked at [Hz].

    Returns:
        RMS at 3 f over RMS at f; NaN where the log does not tell the frequency, or for multisines
        (see `distortion`).
    """
    if log.frequency is None or not log.segments:
        return float("nan")
    if log.segments[0].kind == "sine_steps":
        estimator = Estimator(min_hz=band_hz[0], max_hz=band_hz[1])
        try:
            ratios = read_steps(log, joint, estimator, analysis_rate(log.time)).third
        except LogError:
            # No step in the low band: nothing to say, which is no error of the log.
            return float("nan")
        known = ratios[np.isfinite(ratios)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
    if log.segments[0].kind == "multisine":
        return float("nan")
    return third_harmonic_chirp(
        log.time, log.position[:, log.column(joint)], log.frequency, band_hz
    )


@dataclass(frozen=True, kw_only=True)
class Distortion:
    """Size of what the position holds beside the linear response, RMS over lines.

    All relative to the RMS of the position over the excited lines.
    """

    even: float
    """At even lines that were not excited, noise taken off; NaN if there are none."""
    odd: float
    """At odd lines that were not excited, noise taken off; NaN if there are none."""
    noise: float
    """Noise of the average over periods at the excited lines."""


def distortion(log: JointLog, joint: str, estimator: Estimator) -> Distortion:
    """Nonlinear distortion of the answer to one multisine.

    Args:
        log: One question (`JointLog.cut`).
        joint: The excited joint.
        estimator: Gives the band.

    Raises:
        LogError: As `read_periods`.
    """
    read = read_periods(log, joint, estimator)
    excited = read.excited
    mean = read.position.mean(axis=0)
    count = len(read.position)
    variance = (np.abs(read.position - mean) ** 2).sum(axis=0) / (count * (count - 1))
    reference = float(np.mean(np.abs(mean[excited]) ** 2))
    low, high = np.flatnonzero(excited)[[0, -1]]
    between = np.arange(len(excited))
    silent = ~excited & (between >= low) & (between <= high)

    def share(which: NDArray[np.bool_]) -> float:
        if not which.any():
            return float("nan")
        power = float(np.mean(np.abs(mean[which]) ** 2 - variance[which]))
        return float(np.sqrt(max(power, 0.0) / reference))

    return Distortion(
        even=share(silent & (read.lines % 2 == 0)),
        odd=share(silent & (read.lines % 2 == 1)),
        noise=float(np.sqrt(np.mean(variance[excited]) / reference)),
    )
