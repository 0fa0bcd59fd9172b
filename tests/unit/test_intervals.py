"""Coverage of the 95 % intervals, for white and for coloured noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from analytic import simulate_second_order
from pronk.response import Estimator, FrequencyResponse, H1Operator
from pronk.response.averaged import layout, sums
from pronk.response.grid import grid_over, held_mean
from synthetic_joint import AMPLITUDE, KNEE, chirp_command, linear_joint

RATE = 200.0
SETTINGS = Estimator(max_hz=20.0)


def coloured(rng: np.random.Generator, shape: tuple[int, ...], deviation: float) -> np.ndarray:
    """First-order autoregressive noise with its corner at 2 Hz."""
    pole = np.exp(-2.0 * np.pi * 2.0 / RATE)
    drive = deviation * np.sqrt(1.0 - pole**2) * rng.standard_normal(shape)
    # A second of run-in, so that it is stationary.
    return lfilter([1.0], [1.0, -pole], np.concatenate([drive[..., :200], drive], axis=-1))[
        ..., 200:
    ]


def covered(response: FrequencyResponse, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether the intervals on gain and phase hold the known, per bin."""
    low, high = response.gain_interval(0.95)
    gain = (low <= np.abs(known)) & (np.abs(known) <= high)
    low, high = response.phase_interval(0.95)
    off = np.angle(known / response.response)
    phase = (low - response.phase <= off) & (off <= high - response.phase)
    return gain, phase


@pytest.mark.parametrize("repeats", [3, 5])
def test_intervals_over_repeats_cover_coloured_noise(repeats: int) -> None:
    rng = np.random.default_rng(repeats)
    time, command, _ = chirp_command("chirp", RATE)
    operator = H1Operator.build(time, command, SETTINGS)
    matrix = operator.matrix(time)
    clean = simulate_second_order(command, RATE, **KNEE)
    # What the interval is about: the estimate without noise. Its own bias (at most 0.3 %) is the
    # same for the measured and the simulated joint.
    known = clean @ matrix
    trials = 300
    noise = coloured(rng, (trials, repeats, len(time)), 2e-3)
    each = (clean + noise) @ matrix
    ones = np.ones(len(operator.omega))
    gains, phases = [], []
    for row in each:
        response = FrequencyResponse(
            joint="knee",
            amplitude=AMPLITUDE,
            omega=operator.omega,
            response=row.mean(axis=0),
            coherence=ones,
            averages=ones,
            repeats=row,
            estimator="H1",
            window="",
            segment_s=SETTINGS.segment_s,
        )
        gain, phase = covered(response, known)
        gains.append(gain)
        phases.append(phase)
    for hits in (np.array(gains), np.array(phases)):
        assert 0.93 < hits.mean() < 0.97
        assert hits.mean(axis=0).min() > 0.88
        assert hits.mean(axis=0).max() <= 1.0
    # Between 0.90 and 0.99 for every bin but what chance leaves outside.
    inside = np.mean([(h >= 0.90) & (h <= 0.99) for h in np.array(gains).mean(axis=0)])
    assert inside > 0.97


@pytest.mark.parametrize("colour", ["white", "coloured"])
def test_a_single_repeat_is_covered_by_the_coherence_formula(colour: str) -> None:
    rng = np.random.default_rng(7)
    time, command, _ = chirp_command("chirp", RATE)
    grid = grid_over(time)
    where = layout(grid, SETTINGS, padded=True)
    excited = where.spectra(held_mean(time, command, grid.edges))
    clean = linear_joint(**KNEE)(command, RATE)
    known = sums(excited, where.spectra(clean), where).response(where.omega, RATE)
    hits = []
    for _ in range(150):
        noise = (
            4e-3 * rng.standard_normal(len(time))
            if colour == "white"
            else coloured(rng, (len(time),), 8e-3)
        )
        s = sums(excited, where.spectra(clean + noise), where)
        estimate = s.response(where.omega, RATE)
        response = FrequencyResponse(
            joint="knee",
            amplitude=AMPLITUDE,
            omega=where.omega,
            response=estimate,
            coherence=s.coherence(),
            averages=s.averages(),
            repeats=estimate[None],
            estimator="H1",
            window="",
            segment_s=SETTINGS.segment_s,
        )
        hits.append(covered(response, known)[0])
    assert 0.90 < np.mean(hits) < 0.99
