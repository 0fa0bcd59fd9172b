"""Excitation signals: spectra, ramps and limits; correlation of simultaneous commands."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import cumulative_simpson

from pronk.errors import PlanError
from pronk.identify.excitation.signals import Chirp, LogChirp, Multisine, Signal, SineSteps, ramps
from pronk.identify.logs.checks import correlation_note

ALL: tuple[Signal, ...] = (Chirp(), LogChirp(), Multisine(), SineSteps())


@pytest.mark.parametrize("signal", ALL, ids=lambda s: s.kind)
@pytest.mark.parametrize("rate", [50.0, 100.0])
def test_begins_and_ends_at_rest_and_reaches_its_peak(signal: Signal, rate: float) -> None:
    offsets = signal.samples(rate)
    assert offsets[0] == offsets[-1] == 0.0
    assert 0.97 < np.abs(offsets).max() / signal.amplitude <= 1.0 + 1e-12
    assert len(offsets) == len(signal.frequency(rate))
    quiet = replace(signal, amplitude=signal.amplitude / 4.0).samples(rate)
    np.testing.assert_allclose(quiet, offsets / 4.0, atol=1e-15)
    assert signal.duration_s(rate) == pytest.approx(len(offsets) / rate)
    # The ramp is smooth at its outer end: the first moves are small against the peak.
    assert np.abs(offsets[[1, -2]]).max() < 0.02 * signal.amplitude


def test_the_default_chirp_is_the_papers() -> None:
    chirp = Chirp()
    assert chirp.band_hz == (0.1, 25.0)
    assert chirp.amplitude == 0.25
    assert chirp.duration_s() == 20.0


@pytest.mark.parametrize("chirp", [Chirp(), LogChirp()])
def test_a_chirp_turns_at_the_frequency_it_names(chirp: Chirp) -> None:
    rate = 5000.0
    time = np.arange(len(chirp.frequency(rate))) / rate
    turns = cumulative_simpson(chirp.frequency(rate), x=time, initial=0.0)
    inside = slice(round(rate), -round(rate))  # between the ramps
    expected = chirp.amplitude * np.sin(2.0 * np.pi * turns)
    np.testing.assert_allclose(chirp.samples(rate)[inside], expected[inside], atol=1e-8)


def test_multisine_holds_odd_harmonics_and_nothing_else() -> None:
    signal = Multisine(length_s=10.0, periods=3)
    period = signal.one_period()
    spectrum = np.abs(np.fft.rfft(period))
    lines = np.array(signal.harmonic_numbers)
    assert (lines % 2 == 1).all()
    assert np.delete(spectrum, lines).max() < 1e-12 * spectrum[lines].max()
    # What is sent repeats that period exactly between the ramps.
    ramp = round(signal.ramp_s * 50.0)
    sent = signal.samples()[ramp : ramp + 3 * len(period)].reshape(3, -1)
    np.testing.assert_allclose(sent, np.tile(period, (3, 1)), atol=1e-15)
    assert np.abs(period).max() == pytest.approx(signal.amplitude)


def test_multisine_tilt_is_the_slope_of_its_lines() -> None:
    signal = Multisine(tilt=1.0)
    lines = np.abs(np.fft.rfft(signal.one_period()))[list(signal.harmonic_numbers)]
    np.testing.assert_allclose(lines * signal.lines_hz, lines[0] * signal.lines_hz[0], rtol=1e-9)


def test_more_draws_give_a_smaller_crest_factor() -> None:
    first_draw = Multisine(draws=1).one_period()
    best_draw = Multisine(draws=200).one_period()
    first_crest = np.abs(first_draw).max() / first_draw.std()
    best_crest = np.abs(best_draw).max() / best_draw.std()
    assert best_crest < first_crest
    assert best_crest < 2.2
    third_seed = Multisine(seed=3).samples()
    assert np.array_equal(third_seed, Multisine(seed=3).samples())
    assert not np.array_equal(third_seed, Multisine(seed=4).samples())


def test_sine_steps_measure_whole_cycles_of_one_frequency() -> None:
    signal = SineSteps(frequencies_hz=(0.5, 3.3, 12.0))
    offsets = signal.samples()
    frequency = signal.frequency()
    windows = signal.windows()
    for (first, stop, exact), stated_hz in zip(windows, signal.frequencies_hz, strict=True):
        assert exact == pytest.approx(stated_hz, rel=0.02)
        assert set(frequency[first:stop]) == {exact}
        cycles = (stop - first) * exact / 50.0
        assert cycles == pytest.approx(round(cycles), abs=1e-9)
        assert cycles > signal.measure_cycles - 1e-9
        lines = np.abs(np.fft.rfft(offsets[first:stop])) / (stop - first) * 2.0
        assert lines[round(cycles)] == pytest.approx(signal.amplitude, rel=1e-6)
        assert np.delete(lines, round(cycles)).max() < 1e-9
    for (_, stop, _), (first, _, exact) in pairwise(windows):
        assert (first - stop) / 50.0 >= max(signal.settle_s, signal.settle_cycles / exact) - 1e-9
    assert np.isnan(frequency[: round(signal.ramp_s * 50)]).all()


@given(ticks=st.integers(2, 500), ramp=st.integers(0, 250))
def test_ramps_stay_between_zero_and_one(ticks: int, ramp: int) -> None:
    if 2 * ramp > ticks:
        with pytest.raises(PlanError, match="do not fit"):
            ramps(ticks, ramp)
        return
    window = ramps(ticks, ramp)
    assert window[0] == window[-1] == 0.0
    assert 0.0 <= window.min() <= window.max() <= 1.0
    np.testing.assert_allclose(window, window[::-1], atol=1e-15)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Chirp(amplitude=0.0), "amplitude"),
        (lambda: Chirp(amplitude=float("nan")), "amplitude"),
        (lambda: Chirp(start_hz=5.0, stop_hz=1.0), "lower one first"),
        (lambda: Chirp(length_s=-1.0), "length_s"),
        (lambda: Chirp(ramp_s=-0.1), "ramp_s"),
        (lambda: Chirp(stop_hz=30.0).samples(50.0), "reach 25 Hz"),
        (lambda: Multisine(low_hz=0.11, high_hz=0.12), "no odd multiple"),
        (lambda: Multisine(length_s=0.333).samples(50.0), "whole ticks"),
        (lambda: Multisine(high_hz=30.0).samples(50.0), "reach 25 Hz"),
        (lambda: SineSteps(frequencies_hz=()), "frequencies_hz"),
        (lambda: SineSteps(frequencies_hz=(25.0,)).samples(50.0), "below 25 Hz"),
    ],
)
def test_impossible_signals_are_refused(make: object, words: str) -> None:
    with pytest.raises(PlanError, match=words):
        make()  # type: ignore[operator]


def test_commands_correlate_with_a_shifted_copy_and_not_with_noise_or_rest() -> None:
    time = np.arange(6000) / 50.0
    turn = 2.0 * np.pi * time
    shifted = np.stack([np.sin(turn), np.cos(turn)], axis=1)
    assert abs(np.corrcoef(shifted.T)[0, 1]) < 1e-3
    note = correlation_note(time, shifted, ["pan", "lift"])
    assert re.search(r"lift and pan correlate to (0\.9[5-9]|1\.00)", note)
    still = np.stack([np.full(6000, 0.3), np.sin(time)], axis=1)
    assert correlation_note(time, still, ["pan", "lift"]) == ""
    noise = np.random.default_rng(0).normal(size=(6000, 4))
    assert correlation_note(time, noise, list("abcd")) == ""
