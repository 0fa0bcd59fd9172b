"""Excitation signals of a joint, as command offsets about the pose.

A signal is sampled at the ticks of the policy (50 Hz) and each sample is held until the next
tick. Every signal is ramped in and out by half a cosine and its last sample is zero.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pronk.arrays import Array
from pronk.errors import PlanError

POLICY_RATE_HZ = 50.0
"""Rate of the commands (paper S4)."""


@dataclass(frozen=True, kw_only=True)
class Signal(ABC):
    """An excitation signal; the classes below are its kinds."""

    kind: ClassVar[str]
    """Name of the kind in `pronk.identify.logs.segment.SIGNAL_KINDS`."""

    amplitude: float = 0.25
    """Peak of the command about the pose [rad] (paper F3)."""
    ramp_s: float = 0.5
    """Length of the ramp at each end [s]."""

    def __post_init__(self) -> None:
        """Refuse numbers that are not finite, not positive or out of order."""
        self._require_positive("amplitude", self.amplitude)
        self._require_not_negative("ramp_s", self.ramp_s)

    def _require_positive(self, name: str, value: float) -> None:
        if not (np.isfinite(value) and value > 0.0):
            raise PlanError(f"{type(self).__name__}.{name} is {value}; expected a positive number.")

    def _require_not_negative(self, name: str, value: float) -> None:
        if not (np.isfinite(value) and value >= 0.0):
            raise PlanError(f"{type(self).__name__}.{name} is {value}; expected 0 or more.")

    @property
    @abstractmethod
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest excited frequency [Hz]."""

    @property
    def period_s(self) -> float | None:
        """Period between the ramps [s]; None if the signal does not repeat."""
        return None

    def samples(self, rate_hz: float = POLICY_RATE_HZ) -> Array:
        """Return command offsets at the ticks [rad], shape (ticks,), from zero to zero.

        Args:
            rate_hz: Rate of the commands [Hz].

        Raises:
            PlanError: The signal goes above half the rate, where a held command carries nothing.
        """
        # Paper F4, reading A15.
        if self.band_hz[1] > 0.5 * rate_hz * (1.0 + 1e-9):
            raise PlanError(
                f"{type(self).__name__} goes up to {self.band_hz[1]:g} Hz, but commands at "
                f"{rate_hz:g} Hz reach {0.5 * rate_hz:g} Hz; lower the highest frequency."
            )
        return self._samples(rate_hz)

    @abstractmethod
    def frequency(self, rate_hz: float = POLICY_RATE_HZ) -> Array:
        """Return the instantaneous frequency at the ticks [Hz], (ticks,); NaN outside a sine."""

    @abstractmethod
    def _samples(self, rate_hz: float) -> Array: ...

    def duration_s(self, rate_hz: float = POLICY_RATE_HZ) -> float:
        """Return the time from the first tick to the end of the last one [s]."""
        return len(self.frequency(rate_hz)) / rate_hz

    def _ramp(self, rate_hz: float) -> int:
        """Ticks in a ramp."""
        return round(self.ramp_s * rate_hz)

    def _require_ordered(self, low: float, high: float) -> None:
        if not (np.isfinite(low) and np.isfinite(high) and 0.0 < low < high):
            raise PlanError(
                f"{type(self).__name__} goes from {low} to {high} Hz; expected two positive "
                "frequencies, the lower one first, for instance 0.1 and 25."
            )


def ramps(ticks: int, ramp_ticks: int) -> Array:
    """Return half a cosine up from 0, ones, half a cosine down to exactly 0, shape (ticks,)."""
    if 2 * ramp_ticks > ticks:
        raise PlanError(
            f"two ramps of {ramp_ticks} ticks do not fit a signal of {ticks}; shorten the ramp or "
            "lengthen the signal."
        )
    window = np.ones(ticks)
    rise = 0.5 * (1.0 - np.cos(np.pi * np.arange(ramp_ticks) / max(ramp_ticks, 1)))
    window[:ramp_ticks] = rise
    window[ticks - ramp_ticks :] = rise[::-1]
    # Even an abrupt signal begins and ends at rest.
    window[0] = 0.0
    window[-1] = 0.0
    return window


@dataclass(frozen=True, kw_only=True)
class Chirp(Signal):
    """Linear chirp; the defaults are the paper's (F2, F3; 20 s and linear are our reading)."""

    kind = "chirp"

    start_hz: float = 0.1
    """Frequency at the start [Hz]."""
    stop_hz: float = 25.0
    """Frequency at the end [Hz]."""
    length_s: float = 20.0
    """Length, ramps included [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_positive("length_s", self.length_s)
        self._require_ordered(self.start_hz, self.stop_hz)

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest excited frequency [Hz]."""
        return self.start_hz, self.stop_hz

    def _time(self, rate_hz: float) -> Array:
        return np.arange(max(2, round(self.length_s * rate_hz))) / rate_hz

    def _samples(self, rate_hz: float) -> Array:
        time = self._time(rate_hz)
        # Integral of the frequency. A sine: it begins at zero.
        cycles = self._cycles(time / self.length_s) * self.length_s
        wave = np.sin(2.0 * np.pi * cycles)
        return np.asarray(self.amplitude * wave * ramps(len(time), self._ramp(rate_hz)))

    def _cycles(self, share: Array) -> Array:
        """Integral of the frequency over the share of the length [Hz]."""
        return share * (self.start_hz + 0.5 * (self.stop_hz - self.start_hz) * share)

    def frequency(self, rate_hz: float = POLICY_RATE_HZ) -> Array:
        """Return the instantaneous frequency at the ticks [Hz], shape (ticks,)."""
        share = self._time(rate_hz) / self.length_s
        return np.asarray(self.start_hz + (self.stop_hz - self.start_hz) * share)


@dataclass(frozen=True, kw_only=True)
class LogChirp(Chirp):
    """Logarithmic chirp: the same time in every octave, so far more of it at low frequency."""

    kind = "log_chirp"

    def _cycles(self, share: Array) -> Array:
        ratio = np.log(self.stop_hz / self.start_hz)
        return np.asarray(self.start_hz * np.expm1(ratio * share) / ratio)

    def frequency(self, rate_hz: float = POLICY_RATE_HZ) -> Array:
        """Return the instantaneous frequency at the ticks [Hz], shape (ticks,)."""
        share = self._time(rate_hz) / self.length_s
        return np.asarray(self.start_hz * (self.stop_hz / self.start_hz) ** share)


@dataclass(frozen=True, kw_only=True)
class Multisine(Signal):
    """Random-phase odd multisine: many sines at once, all odd harmonics of one period.

    Even harmonics are left silent, so a response there is nonlinearity. Of `draws` seeded
    phase draws the one with the smallest crest factor (peak over root mean square) is taken. The
    ramps lie outside the whole periods. (Pintelon and Schoukens, *System Identification: A
    Frequency Domain Approach*, 2nd ed., sections 2.6 and 4.3.)
    """

    kind = "multisine"

    low_hz: float = 0.1
    """Lowest frequency [Hz]."""
    high_hz: float = 20.0
    """Highest frequency [Hz]."""
    lines: int = 40
    """Lines on the logarithmic grid, before those that fall on the same odd harmonic merge."""
    length_s: float = 10.0
    """Length of one period [s]; the lines are odd multiples of its inverse."""
    periods: int = 4
    """Whole periods between the ramps; an estimator drops the first as transient."""
    tilt: float = 0.5
    """Power of the frequency with which the amplitude of a line falls; 0 makes all lines alike,
    whose amplitude is then limited by speed and torque at the high lines."""
    draws: int = 200
    """Draws of the phases."""
    seed: int = 0
    """Seed of the draws."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_positive("length_s", self.length_s)
        self._require_positive("lines", self.lines)
        self._require_positive("periods", self.periods)
        self._require_positive("draws", self.draws)
        self._require_ordered(self.low_hz, self.high_hz)
        self._require_not_negative("tilt", self.tilt)
        if not self.harmonic_numbers:
            raise PlanError(
                f"Multisine: no odd multiple of {1.0 / self.length_s:g} Hz lies between "
                f"{self.low_hz:g} and {self.high_hz:g} Hz; lengthen the period."
            )

    @property
    def harmonic_numbers(self) -> tuple[int, ...]:
        """Excited odd harmonics, increasing: those nearest to a logarithmic grid."""
        low = self.low_hz * self.length_s
        high = self.high_hz * self.length_s
        lowest = 2 * int(np.ceil((low * (1.0 - 1e-9) - 1.0) / 2.0)) + 1
        highest = 2 * int(np.floor((high * (1.0 + 1e-9) - 1.0) / 2.0)) + 1
        if lowest > highest:
            return ()
        odd = 2 * np.round((np.geomspace(low, high, self.lines) - 1.0) / 2.0).astype(int) + 1
        return tuple(np.unique(np.clip(odd, lowest, highest)).tolist())

    @property
    def lines_hz(self) -> Array:
        """Excited frequencies [Hz], increasing."""
        return np.asarray(np.array(self.harmonic_numbers) / self.length_s)

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest excited frequency [Hz]."""
        return float(self.lines_hz[0]), float(self.lines_hz[-1])

    @property
    def period_s(self) -> float:
        """Period between the ramps [s]."""
        return self.length_s

    def _period(self, rate_hz: float) -> int:
        """Return the ticks in a period; a PlanError if they are not whole."""
        exact = self.length_s * rate_hz
        if abs(exact - round(exact)) > 1e-6:
            raise PlanError(
                f"Multisine.length_s is {self.length_s} s, {exact:.3f} ticks at {rate_hz:g} Hz; "
                f"a period must be whole ticks, for instance {round(exact) / rate_hz:g} s."
            )
        return round(exact)

    def one_period(self, rate_hz: float = POLICY_RATE_HZ) -> Array:
        """Return one period at the ticks [rad], shape (length_s * rate_hz,)."""
        ticks = self._period(rate_hz)
        numbers = np.array(self.harmonic_numbers)
        if 2 * numbers[-1] >= ticks:
            raise PlanError(
                f"Multisine: the line at {self.lines_hz[-1]:g} Hz does not lie below half the rate "
                f"of the commands ({0.5 * rate_hz:g} Hz)."
            )
        phases = np.random.default_rng(self.seed).uniform(
            0.0, 2.0 * np.pi, (self.draws, len(numbers))
        )
        spectrum = np.zeros((self.draws, ticks // 2 + 1), dtype=complex)
        spectrum[:, numbers] = numbers**-self.tilt * np.exp(1j * phases)
        waves = np.fft.irfft(spectrum, ticks, axis=1)
        crest = np.abs(waves).max(axis=1) / np.sqrt((waves**2).mean(axis=1))
        smoothest_wave = waves[np.argmin(crest)]
        return np.asarray(self.amplitude * smoothest_wave / np.abs(smoothest_wave).max())

    def _samples(self, rate_hz: float) -> Array:
        period = self.one_period(rate_hz)
        ramp = self._ramp(rate_hz)
        # Run the period on into both ramps, so that no phase jumps where they meet.
        index = np.arange(-ramp, len(self.frequency(rate_hz)) - ramp) % len(period)
        return np.asarray(period[index] * ramps(len(index), ramp))

    def frequency(self, rate_hz: float = POLICY_RATE_HZ) -> Array:
        """Return the instantaneous frequency at the ticks [Hz], shape (ticks,)."""
        ramp = self._ramp(rate_hz)
        return np.full(self.periods * self._period(rate_hz) + ramp + max(ramp, 1), np.nan)


@dataclass(frozen=True, kw_only=True)
class SineSteps(Signal):
    """One sine after another, each held until the joint has settled and then measured.

    Each frequency is moved to the nearest one of which `measure_cycles` are whole ticks; the
    phase runs on from step to step, so the command never jumps. The ramps lie before the first
    step and after the last and have no frequency of their own (NaN).
    """

    kind = "sine_steps"

    frequencies_hz: tuple[float, ...] = tuple(np.round(np.geomspace(0.5, 20.0, 16), 3).tolist())
    """Frequencies of the sines, in order [Hz]."""
    settle_cycles: int = 3
    """Cycles of each sine before its measurement, at least."""
    settle_s: float = 0.5
    """Time of each sine before its measurement, at least [s]."""
    measure_cycles: int = 5
    """Cycles of each sine that are measured, at least."""
    measure_s: float = 1.0
    """Time of each sine that is measured, at least [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_positive("settle_cycles", self.settle_cycles)
        self._require_positive("measure_cycles", self.measure_cycles)
        self._require_not_negative("settle_s", self.settle_s)
        self._require_not_negative("measure_s", self.measure_s)
        frequencies = np.array(self.frequencies_hz, dtype=np.float64)
        are_positive = np.isfinite(frequencies) & (frequencies > 0.0)
        if len(frequencies) == 0 or not are_positive.all():
            raise PlanError(
                f"SineSteps.frequencies_hz are {self.frequencies_hz}; expected positive numbers."
            )

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest excited frequency [Hz]."""
        return min(self.frequencies_hz), max(self.frequencies_hz)

    def windows(self, rate_hz: float = POLICY_RATE_HZ) -> tuple[tuple[int, int, float], ...]:
        """Return first tick, end tick and exact frequency [Hz] of each measurement.

        Each measurement has whole cycles.
        """
        if max(self.frequencies_hz) >= 0.5 * rate_hz:
            raise PlanError(
                f"SineSteps goes up to {max(self.frequencies_hz):g} Hz, but commands at "
                f"{rate_hz:g} Hz stay below {0.5 * rate_hz:g} Hz; lower the highest frequency."
            )
        windows = []
        tick = self._ramp(rate_hz)
        for stated_hz in self.frequencies_hz:
            cycles = max(self.measure_cycles, int(np.ceil(self.measure_s * stated_hz)))
            measured_ticks = round(cycles * rate_hz / stated_hz)
            exact_hz = cycles * rate_hz / measured_ticks
            settling_s = max(self.settle_cycles / exact_hz, self.settle_s)
            first_tick = tick + int(np.ceil(settling_s * rate_hz))
            end_tick = first_tick + measured_ticks
            windows.append((first_tick, end_tick, exact_hz))
            tick = end_tick
        return tuple(windows)

    def frequency(self, rate_hz: float = POLICY_RATE_HZ) -> Array:
        """Return the instantaneous frequency at the ticks [Hz], shape (ticks,)."""
        windows = self.windows(rate_hz)
        begin = self._ramp(rate_hz)
        frequency = np.full(windows[-1][1] + max(begin, 1), np.nan)
        for _, end_tick, exact_hz in windows:
            frequency[begin:end_tick] = exact_hz
            begin = end_tick
        return frequency

    def _samples(self, rate_hz: float) -> Array:
        windows = self.windows(rate_hz)
        frequency = self.frequency(rate_hz)
        # The first and the last sine run on into the ramps.
        frequency[: windows[0][0]] = windows[0][2]
        frequency[windows[-1][1] :] = windows[-1][2]
        turns = np.concatenate(([0.0], np.cumsum(frequency)[:-1] / rate_hz))
        wave = np.sin(2.0 * np.pi * turns)
        return np.asarray(self.amplitude * wave * ramps(len(wave), self._ramp(rate_hz)))
