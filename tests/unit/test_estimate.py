"""Estimators against joints whose response is known in closed form, and against recorded ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analytic import second_order, simulate_second_order
from pronk.errors import LogError, PronkError
from pronk.logs.joint_log import JointLog
from pronk.logs.readers import read_log
from pronk.response import Estimator, FrequencyResponse, estimate, fit_delay
from pronk.response.averaged import layout, sums
from pronk.response.grid import Grid, grid_over, held_mean
from synthetic_joint import (
    AMPLITUDE,
    JOINTS,
    KNEE,
    chirp_command,
    friction_joint,
    linear_joint,
    make_log,
    multisine_command,
    steps_command,
)

SO101 = Path(__file__).resolve().parents[3] / "shared" / "data" / "so101"


def errors(
    response: FrequencyResponse, joint: dict[str, float], *, delay: float = 0.0
) -> tuple[float, float, int]:
    """Largest gain error (share) and phase error (degrees) where coherent, and how many bins."""
    known = second_order(response.omega, delay_s=delay, **joint)
    use = response.band(0.25, 24.0, 0.95)
    ratio = response.response[use] / known[use]
    return (
        float(np.abs(np.abs(ratio) - 1.0).max()),
        float(np.degrees(np.abs(np.angle(ratio))).max()),
        int(use.sum()),
    )


@pytest.mark.parametrize("rate", [200.0, 500.0, 1000.0])
@pytest.mark.parametrize("kind", ["chirp", "log_chirp"])
@pytest.mark.parametrize("name", JOINTS)
def test_chirp_gives_the_analytic_response(name: str, kind: str, rate: float) -> None:
    log = make_log(
        [chirp_command(kind, rate)] * 3, linear_joint(**JOINTS[name]), kind=kind, noise=2e-5
    )
    (response,) = estimate(log, "knee")
    gain, phase, bins = errors(response, JOINTS[name])
    assert gain < 0.005
    assert phase < 0.5
    assert bins == 191  # every bin of 0.25 to 24 Hz is coherent
    assert response.repeats.shape == (3, len(response.omega))


@pytest.mark.parametrize("rate", [200.0, 500.0])
@pytest.mark.parametrize("name", JOINTS)
def test_multisine_and_steps_give_the_analytic_response(name: str, rate: float) -> None:
    joint = linear_joint(**JOINTS[name])
    sines = [(*multisine_command(rate, seed=seed), None) for seed in range(3)]
    (response,) = estimate(make_log(sines, joint, kind="multisine", period=4.0, noise=2e-5), "knee")
    gain, phase, bins = errors(response, JOINTS[name])
    assert (gain < 0.003, phase < 0.2, bins) == (True, True, 36)
    steps = [steps_command(rate, (0.5, 1.0, 2.0, 3.0, 5.0, 7.3, 10.0, 12.5, 15.0, 20.0))]
    (response,) = estimate(make_log(steps, joint, kind="sine_steps", noise=2e-5), "knee")
    gain, phase, bins = errors(response, JOINTS[name])
    assert (gain < 0.005, phase < 0.2, bins) == (True, True, 10)


def test_multisine_of_unknown_kind_is_right_where_it_is_coherent() -> None:
    """Between the lines there is only their leakage; such bins must not count as coherent."""
    sines = [(*multisine_command(500.0, seed=seed), None) for seed in range(3)]
    (response,) = estimate(make_log(sines, linear_joint(**KNEE), kind="unknown"), "knee")
    gain, phase, bins = errors(response, KNEE)
    assert (gain < 0.005, phase < 0.5, bins) == (True, True, 36)


@pytest.mark.parametrize("jitter", [0.05, 0.3, 0.9])
def test_measured_timestamps_are_used(jitter: float) -> None:
    log = make_log(
        [chirp_command("chirp", 500.0)], linear_joint(**KNEE), kind="chirp", jitter=jitter
    )
    (response,) = estimate(log, "knee")
    gain, phase, bins = errors(response, KNEE)
    assert (gain < 0.01, phase < 0.5, bins) == (True, True, 191)
    # The same rows with invented, even timestamps are off by more than that.
    even = JointLog(
        robot="bench",
        joints=("knee",),
        time=np.arange(len(log.time)) / 500.0 * (1.0 + 0.02 * jitter),
        command=log.command,
        position=log.position,
    )
    assert errors(estimate(even, "knee")[0], KNEE)[0] > gain


def test_held_mean_is_the_zero_order_hold_on_the_grid_and_moves_no_step_off_it() -> None:
    rng = np.random.default_rng(0)
    time, command = np.arange(400) / 500.0, np.repeat(rng.normal(size=40), 10)
    assert np.abs(held_mean(time, command, grid_over(time).edges) - command).max() < 1e-12
    off = Grid(start=0.0013, rate_hz=487.0, count=380)
    area = held_mean(time, command, off.edges).sum() / off.rate_hz
    fine = np.linspace(off.start, off.start + off.count / off.rate_hz, 400_001)[:-1]
    expected = command[np.searchsorted(time, fine, side="right") - 1].mean()
    assert area == pytest.approx(expected * off.count / off.rate_hz, rel=1e-4)


@pytest.mark.parametrize("delay", [0.002, 0.004, 0.010])
def test_delay_is_recovered(delay: float) -> None:
    shift = round(delay * 500.0)

    def late(command: np.ndarray, rate: float) -> np.ndarray:
        return np.r_[np.zeros(shift), simulate_second_order(command, rate, **KNEE)[:-shift]]

    (response,) = estimate(make_log([chirp_command("chirp", 500.0)], late, kind="chirp"), "knee")
    assert response.delay_s == pytest.approx(delay, abs=5e-5)
    gain, phase, _ = errors(response, KNEE, delay=delay)
    assert (gain < 0.005, phase < 0.5) == (True, True)


def test_the_standard_error_of_the_delay_is_its_scatter() -> None:
    signal = chirp_command("chirp", 500.0)
    fits = []
    for seed in range(12):
        log = make_log([signal] * 4, linear_joint(**KNEE), kind="chirp", noise=3e-3, seed=seed)
        fits.append(fit_delay(estimate(log, "knee")[0]))
    delays = np.array([fit.delay_s for fit in fits])
    claimed = float(np.mean([fit.standard_error_s for fit in fits]))
    assert np.abs(delays).max() < 3e-4
    assert 0.4 < float(delays.std(ddof=1)) / claimed < 2.5


def test_friction_shows_in_the_third_harmonic() -> None:
    """Measured: 0.0000 without friction, 0.013 with 0.2 N m, twice that at half the amplitude."""
    time, command, hz = chirp_command("chirp", 500.0)
    ratio = {}
    for friction in (0.0, 0.2):
        for scale in (1.0, 0.5):
            log = make_log(
                [(time, scale * command, hz)],
                friction_joint(friction),
                kind="chirp",
                noise=2e-5,
                amplitude=scale * AMPLITUDE,
            )
            ratio[friction, scale] = estimate(log, "knee")[0].third_harmonic
    assert max(ratio[0.0, 1.0], ratio[0.0, 0.5]) < 0.001
    assert 0.008 < ratio[0.2, 1.0] < 0.02
    assert ratio[0.2, 0.5] == pytest.approx(2.0 * ratio[0.2, 1.0], rel=0.15)
    steps = make_log(
        [steps_command(500.0, (1.0, 2.0, 3.0))], friction_joint(0.2), kind="sine_steps"
    )
    assert estimate(steps, "knee")[0].third_harmonic == pytest.approx(ratio[0.2, 1.0], rel=0.15)


def test_amplitudes_come_largest_first_and_repeats_together() -> None:
    time, command, hz = chirp_command("chirp", 200.0)
    signals = [(time, size * command, hz) for size in (0.5, 0.5, 1.0, 1.0, 1.0)]
    log = make_log(signals, linear_joint(**KNEE), kind="chirp")
    segments = tuple(replace(s, amplitude=float("nan")) for s in log.segments)
    found = estimate(replace(log, segments=segments), "knee")
    assert [r.amplitude for r in found] == pytest.approx([0.25, 0.125], rel=0.01)
    assert [len(r.repeats) for r in found] == [3, 2]
    assert np.array_equal(found[0].omega, found[1].omega)


def test_coherence_of_noise_alone_is_one_over_the_averages() -> None:
    """The effective number of averages is the one that the coherence really rests on."""
    rate, settings = 200.0, Estimator(max_hz=20.0)
    time, command, _ = chirp_command("chirp", rate)
    grid = grid_over(time)
    where = layout(grid, settings, padded=True)
    excited = where.spectra(held_mean(time, command, grid.edges))
    rng = np.random.default_rng(3)
    raw, averages = [], np.empty(0)
    for _ in range(150):
        s = sums(excited, where.spectra(rng.standard_normal(grid.count)), where)
        raw.append(np.abs(s.uy) ** 2 / (s.uu * s.yy))
        averages = s.averages()
    inner = slice(8, -8)
    assert float((np.mean(raw, axis=0) * averages)[inner].mean()) == pytest.approx(1.0, abs=0.1)


def test_a_single_noisy_repeat_is_not_coherent_by_construction() -> None:
    log = make_log([chirp_command("chirp", 200.0)], linear_joint(**KNEE), kind="chirp", noise=0.5)
    assert float(np.median(estimate(log, "knee")[0].coherence)) < 0.7


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ({"window": "haning"}, "one of hann"),
        ({"overlap": 1.0}, "overlap"),
        ({"segment_s": float("nan")}, "segment_s"),
        ({"min_hz": 5.0, "max_hz": 1.0}, "min_hz"),
    ],
)
def test_settings_are_checked(setting: dict[str, Any], words: str) -> None:
    with pytest.raises(PronkError, match=words):
        Estimator(**setting)


def test_logs_without_a_response_are_refused() -> None:
    time, command, hz = chirp_command("chirp", 200.0)
    stuck = make_log([(time, command, hz)], lambda u, _: 1e-4 * np.sin(u), kind="chirp")
    with pytest.raises(LogError, match="knee did not move"):
        estimate(stuck, "knee")
    still = make_log([(time, 0.0 * command, hz)], lambda u, _: u, kind="chirp")
    with pytest.raises(LogError, match="stands still"):
        estimate(still, "knee")
    short = make_log([(time[:300], command[:300], hz[:300])], linear_joint(**KNEE), kind="chirp")
    with pytest.raises(LogError, match="choose a shorter"):
        estimate(short, "knee")
    with pytest.raises(LogError, match=r"no joint 'hip'; it has knee"):
        estimate(short, "hip")
    two = replace(
        stuck,
        joints=("knee", "hip"),
        command=np.repeat(stuck.command, 2, axis=1),
        position=np.repeat(stuck.position, 2, axis=1),
    )
    with pytest.raises(LogError, match="hip was not excited; knee"):
        estimate(two, "hip")


@pytest.mark.skipif(not SO101.exists(), reason="the SO-101 recordings are not here")
def test_recorded_chirp_is_coherent_where_the_servo_follows() -> None:
    """At 2.8 Hz all servos reach their speed limit at once and the response breaks off."""
    log = read_log(SO101 / "chirp_sweep")
    for joint in log.joints[:5]:
        (response,) = estimate(log, joint)
        assert response.repeats.shape[0] == 1
        assert response.coherence[response.band(0.25, 2.6)].min() > 0.95
        assert response.coherence[response.band(2.75, 3.1)].min() < 0.93
        assert response.coherence[response.band(4.3, 20.0)].max() < 0.95
        assert 0.7 < response.gain[response.band(0.9, 1.1)].mean() < 1.0
        assert 0.01 < response.delay_s < 0.06
