"""Samples of joints that moved together: which of them a fit may use, with gaps in the log too."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from pronk.arrays import Array, Mask
from pronk.identify.match.recordings import trusted_frequency

RATE_HZ = 200.0
TIME = np.arange(0.0, 40.0, 1.0 / RATE_HZ)
COMMAND = 0.2 * signal.chirp(TIME, 0.2, TIME[-1], 15.0)
RANDOM = np.random.default_rng(0)
NOISE = RANDOM.standard_normal(TIME.size)
GAPS = [(10.3, 0.05), (20.0, 0.2), (10.3, 1.0), (20.0, 3.0)]
"""Start and length of a gap [s]."""


def linear_joint() -> Array:
    numerator, denominator = signal.butter(2, 8.0, fs=RATE_HZ)
    return np.asarray(signal.lfilter(numerator, denominator, COMMAND) + 2e-4 * NOISE)


def shaken_joint() -> Array:
    """Return the motion of a linear joint that something else shakes from 7 to 12 Hz."""
    sections = signal.butter(4, (7.0, 12.0), "bandpass", fs=RATE_HZ, output="sos")
    return linear_joint() + 0.3 * np.asarray(signal.sosfilt(sections, NOISE))


def outside(start_s: float, length_s: float) -> Mask:
    into_gap_s = TIME - start_s
    return np.asarray((into_gap_s < 0.0) | (into_gap_s > length_s))


@pytest.mark.parametrize(("start_s", "length_s"), GAPS)
def test_a_gap_takes_no_frequency_from_a_linear_joint(start_s: float, length_s: float) -> None:
    rows = outside(start_s, length_s)
    position = linear_joint()
    assert trusted_frequency(TIME, COMMAND, position) == float("inf")
    assert trusted_frequency(TIME[rows], COMMAND[rows], position[rows]) == float("inf")


@pytest.mark.parametrize("lost", [0.02, 0.1])
def test_lost_samples_take_no_frequency_from_a_linear_joint(lost: float) -> None:
    rows = np.random.default_rng(3).random(TIME.size) > lost
    position = linear_joint()
    assert trusted_frequency(TIME[rows], COMMAND[rows], position[rows]) == float("inf")


@pytest.mark.parametrize(("start_s", "length_s"), GAPS[:3])
def test_a_gap_moves_no_end_of_the_coherence(start_s: float, length_s: float) -> None:
    position = shaken_joint()
    whole_hz = trusted_frequency(TIME, COMMAND, position)
    assert whole_hz == pytest.approx(7.0, abs=1.0)
    rows = outside(start_s, length_s)
    with_gap_hz = trusted_frequency(TIME[rows], COMMAND[rows], position[rows])
    assert with_gap_hz == pytest.approx(whole_hz, abs=0.5)
