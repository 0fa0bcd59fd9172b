"""Which samples of a recording a fit may use: where the command still explains the response.

A servo has limits of its own (acceleration, speed, torque) that no gain describes. Beyond them the
response is no longer a linear joint's, and the coherence of a sweep that runs into them falls. The
fit uses the sweep up to there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from pronk.logs.joint_log import JointLog

Array = NDArray[np.float64]

COHERENCE_MIN = 0.95
_SEGMENT_S = 5.0
_EXCITED = 1e-3
"""Power of the command, over its largest, from which on a frequency counts as excited."""
_WIDE = 8.0
"""A recording shows where coherence ends only if it was coherent over three octaves below: a sweep
does; a few lines or a motion that mostly sticks do not."""
_WINDOW_S = 2.0
_AT_LIMIT = 0.25
"""Share of its power that a sine at the limit keeps, filtered forwards and backwards."""


def trusted_frequency(time: Array, command: Array, position: Array) -> float:
    """Frequency at which the coherence of a sweep falls below 0.95 [Hz].

    Args:
        time: Timestamps [s], shape (n,).
        command: [rad], shape (n,).
        position: [rad], shape (n,).

    Returns:
        Lowest excited frequency above the coherent band that is not coherent; infinity if the
        coherence does not end, or if the recording is too narrow to show it.
    """
    rate = (len(time) - 1) / (time[-1] - time[0])
    width = min(round(_SEGMENT_S * rate), len(time))
    hz, power = signal.welch(command, rate, nperseg=width)
    excited = power > _EXCITED * power.max()
    if power.max() == 0.0 or np.ptp(position) == 0.0:
        return float("inf")
    _, coherence = signal.coherence(command, position, rate, nperseg=width)
    excited[0] = False  # each segment's mean is removed, so 0 Hz is not excited
    good = excited & (coherence >= COHERENCE_MIN)
    if not good.any():
        return float("inf")
    first = int(np.argmax(good))
    fallen = np.flatnonzero(excited[first:] & ~good[first:])
    if len(fallen) == 0:
        return float("inf")
    last = hz[first + fallen[0] - 1]
    return float(hz[first + fallen[0]]) if last >= _WIDE * hz[first] else float("inf")


def trusted_samples(log: JointLog, joint: str) -> tuple[NDArray[np.bool_], float]:
    """Samples at which the command has nothing above its trusted frequency.

    Args:
        log: The recording.
        joint: The joint.

    Returns:
        Mask, shape (n,): false where, over two seconds, the command is mostly above the trusted
        frequency; and that frequency [Hz].
    """
    column = log.column(joint)
    command = log.command[:, column]
    limit = trusted_frequency(log.time, command, log.position[:, column])
    rate = log.rate_hz
    if not limit < 0.45 * rate:
        return np.ones(len(log.time), dtype=bool), limit
    about = command - command.mean()
    high = signal.sosfiltfilt(signal.butter(4, limit, "highpass", fs=rate, output="sos"), about)
    window = np.ones(max(round(_WINDOW_S * rate), 1))
    share = signal.fftconvolve(high**2, window, "same")
    whole = signal.fftconvolve(about**2, window, "same")
    return np.asarray(share <= _AT_LIMIT * np.maximum(whole, 0.0)), limit
