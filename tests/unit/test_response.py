"""Estimators against joints whose response is known in closed form, and recorded ones."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from pronk.errors import ArtefactError, LogError, PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.readers import read_log
from pronk.identify.response.estimate import estimate_response, operators
from pronk.identify.response.grid import Grid, grid_over, held_mean
from pronk.identify.response.h1 import H1Operator, SegmentLayout, segment_layout, sum_spectra
from pronk.identify.response.response import (
    Estimator,
    FrequencyResponse,
    load_responses,
    save_responses,
)
from synthetic_joint import (
    AMPLITUDE,
    HIP,
    JOINTS,
    KNEE,
    LIVELY,
    chirp_command,
    friction_joint,
    linear_joint,
    make_log,
    multisine_command,
    second_order,
    simulate_second_order,
    steps_command,
)

SO101 = Path(__file__).resolve().parents[3] / "shared" / "data" / "so101"
KNEE_JOINT = linear_joint(**KNEE)


def chirps(
    count: int = 1, joint: Any = KNEE_JOINT, *, rate: float = 200.0, **more: Any
) -> JointLog:
    return make_log([chirp_command("chirp", rate)] * count, joint, **{"kind": "chirp"} | more)


def multisines(
    count: int = 1, joint: Any = KNEE_JOINT, *, rate: float = 500.0, periods: int = 5, **more: Any
) -> JointLog:
    signals: list[tuple[np.ndarray, np.ndarray, np.ndarray | None]] = []
    for seed in range(count):
        time, command = multisine_command(rate, seed=seed, periods=periods)
        signals.append((time, command, None))
    return make_log(signals, joint, **{"kind": "multisine", "period": 4.0} | more)


def errors(
    response: FrequencyResponse, joint: dict[str, float], *, delay: float = 0.0
) -> tuple[float, float, int]:
    """Largest gain error (share) and phase error (degrees) where coherent, and how many bins."""
    expected = second_order(response.omega, delay_s=delay, **joint)
    use = response.band(0.25, 24.0, 0.95)
    ratio = response.response[use] / expected[use]
    gain = np.abs(np.abs(ratio) - 1.0)
    phase = np.degrees(np.abs(np.angle(ratio)))
    return float(gain.max()), float(phase.max()), int(use.sum())


# --- estimates ----------------------------------------------------------------------------------


NOISE = {"noise": 2e-5}
STEPS_HZ = (0.5, 1.0, 2.0, 3.0, 5.0, 7.3, 10.0, 12.5, 15.0, 20.0)
KINDS: dict[str, tuple[Any, float, float, int]] = {
    "chirp": (lambda j, r: chirps(3, j, rate=r, **NOISE), 0.005, 0.5, 191),  # every bin is coherent
    "log_chirp": (
        lambda j, r: make_log([chirp_command("log_chirp", r)] * 3, j, kind="log_chirp", **NOISE),
        *(0.005, 0.5, 191),
    ),
    "multisine": (lambda j, r: multisines(3, j, rate=r, **NOISE), 0.003, 0.2, 36),
    # Between the lines there is only their leakage; such bins must not count as coherent.
    "unknown": (
        lambda j, r: multisines(3, j, rate=r, kind="unknown", period=None),
        *(0.005, 0.5, 36),
    ),
    "sine_steps": (
        lambda j, r: make_log([steps_command(r, STEPS_HZ)], j, kind="sine_steps", **NOISE),
        *(0.005, 0.2, 10),
    ),
}


@pytest.mark.parametrize("rate", [200.0, 1000.0])
@pytest.mark.parametrize("signal", KINDS)
@pytest.mark.parametrize("name", JOINTS)
def test_the_analytic_response_is_found(name: str, signal: str, rate: float) -> None:
    make, gain_limit, phase_limit, expected = KINDS[signal]
    (response,) = estimate_response(make(linear_joint(**JOINTS[name]), rate), "knee")
    gain, phase, bins = errors(response, JOINTS[name])
    assert (gain < gain_limit, phase < phase_limit, bins) == (True, True, expected)
    # One for each excitation; for each block of periods where there are fewer than three.
    assert len(response.repeats) == (2 if signal == "sine_steps" else 3)


@pytest.mark.parametrize("jitter", [0.05, 0.9])
def test_measured_timestamps_are_used(jitter: float) -> None:
    log = chirps(rate=500.0, jitter=jitter)
    gain, phase, bins = errors(estimate_response(log, "knee")[0], KNEE)
    assert (gain < 0.01, phase < 0.5, bins) == (True, True, 191)
    # The same rows with invented, even timestamps are off by more than that.
    time = np.arange(len(log.time)) / 500.0 * (1.0 + 0.02 * jitter)
    even = replace(log, time=time, segments=(), frequency=None)
    assert errors(estimate_response(even, "knee")[0], KNEE)[0] > gain


def test_held_mean_is_the_zero_order_hold_on_the_grid_and_moves_no_step_off_it() -> None:
    rng = np.random.default_rng(0)
    time = np.arange(400) / 500.0
    command = np.repeat(rng.normal(size=40), 10)
    assert np.abs(held_mean(time, command, grid_over(time).edges) - command).max() < 1e-12
    off = Grid(start=0.0013, rate_hz=487.0, count=380)
    fine = np.linspace(off.start, off.start + off.count / off.rate_hz, 400_001)[:-1]
    expected = command[np.searchsorted(time, fine, side="right") - 1].mean()
    assert held_mean(time, command, off.edges).mean() == pytest.approx(expected, rel=1e-4)


def test_amplitudes_come_largest_first_and_repeats_together() -> None:
    time, command, hz = chirp_command("chirp", 200.0)
    signals = [(time, size * command, hz) for size in (0.5, 0.5, 1.0, 1.0, 1.0)]
    log = make_log(signals, KNEE_JOINT, kind="chirp")
    segments = []
    for segment in log.segments:
        segments.append(replace(segment, amplitude=float("nan")))
    large, small = estimate_response(replace(log, segments=tuple(segments)), "knee")
    assert large.amplitude == pytest.approx(0.25, rel=0.01)
    assert small.amplitude == pytest.approx(0.125, rel=0.01)
    assert len(large.repeats) == 3
    assert len(small.repeats) == 2
    assert np.array_equal(large.omega, small.omega)


def test_settings_are_checked() -> None:
    for words, setting in (
        ("one of hann", {"window": "haning"}),
        ("overlap", {"overlap": 1.0}),
        ("segment_s", {"segment_s": float("nan")}),
        ("min_hz", {"min_hz": 5.0, "max_hz": 1.0}),
    ):
        with pytest.raises(PronkError, match=words):
            Estimator(**setting)


def test_logs_without_a_response_are_refused() -> None:
    time, command, hz = chirp_command("chirp", 200.0)
    stuck = chirps(joint=lambda u, _: 1e-4 * np.sin(u))
    still = make_log([(time, 0.0 * command, hz)], KNEE_JOINT, kind="chirp")
    short = make_log([(time[:300], command[:300], hz[:300])], KNEE_JOINT, kind="chirp")
    time, command, hz = steps_command(500.0, (1.0, 2.0))
    bare = make_log([(time, command, None)], KNEE_JOINT, kind="sine_steps")
    hurried = make_log([(time[:600], command[:600], hz[:600])], KNEE_JOINT, kind="sine_steps")
    with pytest.raises(LogError, match="shorter segments"):
        estimate_response(short, "knee", Estimator(segment_s=8.0))
    two_columns = np.repeat(stuck.command, 2, axis=1)
    two_joints = replace(stuck, joints=("knee", "hip"), command=two_columns, position=two_columns)
    for log, joint, words in (
        (stuck, "knee", "knee did not move"),
        (still, "knee", "stands still"),
        (short, "hip", r"no joint 'hip'; it has knee"),
        (multisines(periods=2), "knee", "3 equal periods are needed"),
        (multisines(period=None), "knee", "no period_s"),
        (bare, "knee", "instantaneous frequency"),
        (hurried, "knee", "the step at 1 Hz lasts"),
        (two_joints, "hip", "hip was not excited; knee"),
    ):
        with pytest.raises(LogError, match=words):
            estimate_response(log, joint)


@pytest.mark.skipif(not SO101.exists(), reason="the SO-101 recordings are not here")
def test_recorded_chirp_is_coherent_where_the_servo_follows() -> None:
    """At 2.8 Hz all servos reach their speed limit at once and the response breaks off."""
    log = read_log(SO101 / "chirp_sweep")
    for joint in log.joints[:5]:
        (response,) = estimate_response(log, joint)
        assert response.repeats.shape[0] == 1
        assert response.coherence[response.band(0.25, 2.6)].min() > 0.95
        assert response.coherence[response.band(2.75, 3.1)].min() < 0.93
        assert response.coherence[response.band(4.3, 20.0)].max() < 0.95
        assert 0.7 < response.gain[response.band(0.9, 1.1)].mean() < 1.0
        assert 0.01 < response.delay_s < 0.06


# --- periods ------------------------------------------------------------------------------------


@pytest.mark.parametrize("ramp_s", [0.0, 1.0])
def test_lines_of_a_linear_joint_are_exact_without_noise(ramp_s: float) -> None:
    """Of five equal periods the first settles; a ramped one falls out."""
    time, command = multisine_command(500.0)
    ramp = np.clip(time / ramp_s, 0.0, 1.0) if ramp_s else 1.0
    log = make_log([(time, command * ramp, None)], KNEE_JOINT, kind="multisine", period=4.0)
    (response,) = estimate_response(log, "knee")
    assert np.abs(response.response / second_order(response.omega, **KNEE) - 1.0).max() < 2e-4
    assert response.repeats.shape == (3 if ramp_s else 4, 36)
    assert np.all(response.averages == len(response.repeats))
    assert np.allclose(response.frequency_hz * 4.0 % 2.0, 1.0)  # Odd lines alone.


# --- delay and third harmonic -------------------------------------------------------------------


@pytest.mark.parametrize(("delay", "noise"), [(0.002, 0.0), (0.010, 0.0), (0.0, 3e-3)])
def test_delay_is_recovered(delay: float, noise: float) -> None:
    def late(command: np.ndarray, rate: float) -> np.ndarray:
        moved = simulate_second_order(command, rate, **KNEE)
        return np.r_[np.zeros(round(delay * rate)), moved][: len(moved)]

    (response,) = estimate_response(chirps(4, late, rate=500.0, noise=noise), "knee")
    assert response.delay_s == pytest.approx(delay, abs=3e-4 if noise else 5e-5)
    gain, phase, _ = errors(response, KNEE, delay=delay)
    assert noise or (gain < 0.005, phase < 0.5) == (True, True)


def test_friction_shows_in_the_third_harmonic() -> None:
    """0.0000 without friction, 0.013 with 0.2 N m, twice that at half the amplitude."""
    time, command, hz = chirp_command("chirp", 500.0)
    signals = (
        ((time, command, hz), 0.0, "chirp"),
        ((time, command, hz), 0.2, "chirp"),
        ((time, 0.5 * command, hz), 0.2, "chirp"),
        (steps_command(500.0, (1.0, 2.0, 3.0)), 0.2, "sine_steps"),
    )
    third_harmonics = []
    for signal, frictionloss, signal_kind in signals:
        joint = friction_joint(frictionloss)
        log = make_log([signal], joint, kind=signal_kind, noise=2e-5)
        third_harmonics.append(estimate_response(log, "knee")[0].third_harmonic)
    no_friction, full_friction, half_amplitude, by_steps = third_harmonics
    assert no_friction < 0.001
    assert 0.008 < full_friction < 0.02
    assert half_amplitude == pytest.approx(2.0 * full_friction, rel=0.15)
    assert by_steps == pytest.approx(full_friction, rel=0.15)


# --- uncertainty --------------------------------------------------------------------------------

SETTINGS = Estimator(max_hz=20.0)


def coloured(rng: np.random.Generator, shape: tuple[int, ...], deviation: float) -> np.ndarray:
    """First-order autoregressive noise at 200 Hz with its corner at 2 Hz."""
    pole = np.exp(-2.0 * np.pi * 2.0 / 200.0)
    drive = deviation * np.sqrt(1.0 - pole**2) * rng.standard_normal(shape)
    # A second of run-in, so that it is stationary.
    driven = np.concatenate([drive[..., :200], drive], axis=-1)
    return lfilter([1.0], [1.0, -pole], driven)[..., 200:]


def covered(omega: np.ndarray, expected: np.ndarray, **parts: np.ndarray) -> np.ndarray:
    """Whether the intervals on gain and phase hold the known response, shape (2, f)."""
    labels = {"joint": "knee", "estimator": "H1", "window": "", "segment_s": SETTINGS.segment_s}
    response = FrequencyResponse(amplitude=AMPLITUDE, omega=omega, **labels, **parts)  # type: ignore[arg-type]
    low, high = response.gain_interval(0.95)
    gain = (low <= np.abs(expected)) & (np.abs(expected) <= high)
    low, high = response.phase_interval(0.95)
    off = np.angle(expected / response.response)
    return np.array([gain, (low - response.phase <= off) & (off <= high - response.phase)])


@pytest.mark.parametrize("repeats", [3, 5])
def test_intervals_over_repeats_cover_coloured_noise(repeats: int) -> None:
    rng = np.random.default_rng(repeats)
    time, command, _ = chirp_command("chirp", 200.0)
    operator = H1Operator.build(time, command, SETTINGS)
    matrix = operator.matrix(time)
    ones = np.ones(len(operator.omega))
    clean = simulate_second_order(command, 200.0, **KNEE)
    noise = coloured(rng, (300, repeats, len(time)), 2e-3)
    expected = clean @ matrix
    covered_trials = []
    for trial_repeats in (clean + noise) @ matrix:
        is_covered = covered(
            operator.omega,
            expected,
            response=trial_repeats.mean(axis=0),
            repeats=trial_repeats,
            coherence=ones,
            averages=ones,
        )
        covered_trials.append(is_covered)
    hits = np.array(covered_trials)
    for shares in hits.swapaxes(0, 1):
        assert 0.93 < shares.mean() < 0.97
        assert shares.mean(axis=0).min() > 0.88
    # Between 0.90 and 0.99 for every bin but what chance leaves outside.
    assert np.mean(np.abs(hits[:, 0].mean(axis=0) - 0.945) <= 0.045) > 0.97


def laid_out() -> tuple[SegmentLayout, np.ndarray]:
    """Segments over one chirp at 200 Hz, and its spectra."""
    time, command, _ = chirp_command("chirp", 200.0)
    layout = segment_layout(grid_over(time), SETTINGS, padded=True)
    return layout, layout.spectra(held_mean(time, command, layout.grid.edges))


@pytest.mark.parametrize("colour", ["white", "coloured"])
def test_a_single_repeat_is_covered_by_the_coherence_formula(colour: str) -> None:
    rng = np.random.default_rng(7)
    layout, excited = laid_out()
    clean = KNEE_JOINT(chirp_command("chirp", 200.0)[1], 200.0)
    expected = sum_spectra(excited, layout.spectra(clean), layout).response(layout.omega, 200.0)
    hits = []
    for _ in range(150):
        white = 4e-3 * rng.standard_normal(len(clean))
        noise = white if colour == "white" else coloured(rng, (len(clean),), 8e-3)
        spectra = sum_spectra(excited, layout.spectra(clean + noise), layout)
        estimated = spectra.response(layout.omega, 200.0)
        is_covered = covered(
            layout.omega,
            expected,
            response=estimated,
            repeats=estimated[None],
            coherence=spectra.coherence(),
            averages=spectra.averages(),
        )
        hits.append(is_covered[0])
    assert 0.90 < np.mean(hits) < 0.99


def test_coherence_of_noise_alone_is_one_over_the_averages() -> None:
    rng = np.random.default_rng(3)
    layout, excited = laid_out()
    raw_coherences = []
    for _ in range(150):
        noise = rng.standard_normal(layout.grid.count)
        spectra = sum_spectra(excited, layout.spectra(noise), layout)
        raw_coherences.append(np.abs(spectra.uy) ** 2 / (spectra.uu * spectra.yy))
    times_averages = np.mean(raw_coherences, axis=0) * spectra.averages()
    assert float(times_averages[8:-8].mean()) == pytest.approx(1.0, abs=0.1)
    # Nor is a single noisy repeat coherent by construction.
    assert float(np.median(estimate_response(chirps(noise=0.5), "knee")[0].coherence)) < 0.7


# --- the estimate as a matrix -------------------------------------------------------------------

IN_MOTION = [tuple(part[:3500] for part in chirp_command("chirp", 200.0))]


@pytest.mark.parametrize(
    ("log", "settings"),
    [
        (chirps(2, noise=1e-3), Estimator(segment_s=4.0)),
        (chirps(2, noise=1e-3, jitter=0.4), Estimator(segment_s=7.3, max_hz=20.0)),
        (chirps(2, noise=1e-3, jitter=0.4, kind="unknown"), Estimator()),
        (make_log(IN_MOTION, KNEE_JOINT, kind="unknown", noise=1e-3), Estimator()),  # type: ignore[arg-type]
        (multisines(3, rate=200.0, noise=1e-3, jitter=0.1), Estimator()),
    ],
    ids=["chirp", "jitter", "unknown", "in motion", "multisine"],
)
def test_operator_is_the_estimate(log: JointLog, settings: Estimator) -> None:
    (response,) = estimate_response(log, "knee", settings)
    (row,) = operators(log, "knee", settings)
    by_matrix = []
    by_transforms = []
    weights = []
    for repeat_operator, segment in zip(row, log.segments, strict=True):
        position = log.cut(segment).position[:, 0]
        by_matrix.append(position @ repeat_operator.matrix(repeat_operator.time))
        by_transforms.append(repeat_operator.response(repeat_operator.time, position))
        weights.append(repeat_operator.excitation)
    scale = np.abs(response.response).max()
    assert np.abs(np.array(by_transforms) - by_matrix).max() < 1e-9 * scale
    if len(by_matrix) == len(response.repeats):
        assert np.abs(by_matrix - response.repeats).max() < 1e-9 * scale
    combined = np.average(by_matrix, axis=0, weights=weights)
    assert np.abs(combined - response.response).max() < 1e-9 * scale


def test_matrix_takes_positions_at_physics_steps() -> None:
    """Positions every 5 ms give the response of those every 2 ms, but for the interpolation."""
    time, command, _ = chirp_command("chirp", 500.0)
    operator = H1Operator.build(time, command, Estimator())
    steps = np.arange(round(time[-1] / 0.005)) * 0.005
    matrix = operator.matrix(steps)
    own_matrix = operator.matrix(time)
    # Offsets do not matter.
    assert np.allclose((command + 1.7) @ own_matrix, command @ own_matrix, atol=1e-8)
    for joint in (KNEE, HIP, LIVELY):
        fine = simulate_second_order(command, 500.0, **joint) @ own_matrix
        coarse = simulate_second_order(np.repeat(command[::10], 4), 200.0, **joint)[: len(steps)]
        low = operator.omega < 2.0 * np.pi * 15.0
        assert np.abs((coarse @ matrix / fine - 1.0)[low]).max() < 1e-3
        assert np.abs(coarse @ matrix / fine - 1.0).max() < 5e-3
    with pytest.raises(LogError, match="do not span"):
        operator.matrix(time[:-500])
    log = make_log([steps_command(200.0, (1.0, 2.0))], KNEE_JOINT, kind="sine_steps")
    with pytest.raises(PronkError, match="match a chirp or a multisine"):
        operators(log, "knee")


# --- files --------------------------------------------------------------------------------------


def test_a_response_tells_itself_in_one_line_and_can_be_drawn() -> None:
    (response,) = estimate_response(chirps(2, noise=1e-4), "knee")
    assert re.fullmatch(r"FrequencyResponse\(knee, .* rad, .* repeats\)", repr(response))
    numbers = response.to_dict()
    assert numbers["gain"] == response.gain.tolist()
    assert numbers["joint"] == "knee"
    json.dumps(numbers)
    figure = response.plot()
    assert [axes.get_ylabel() for axes in figure.axes] == ["gain [dB]", "phase [deg]", "coherence"]


def test_responses_survive_a_file_and_damage_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "knee.response.npz"
    written = [
        *estimate_response(chirps(2, noise=1e-4), "knee"),
        *estimate_response(multisines(), "knee"),
    ]
    save_responses(path, written)
    for a, b in zip(written, load_responses(path), strict=True):
        for name in vars(a):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    before = path.read_bytes()
    with pytest.raises(TypeError):
        save_responses(path, [FrequencyResponse(**{**vars(written[0]), "source": object()})])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    np.savez(path, header=json.dumps({"schema": "pronk/response/0"}))
    with pytest.raises(ArtefactError, match="this pronk reads"):
        load_responses(path)
    np.savez(path, header=np.array([{"schema": "pronk/response/1"}], dtype=object))
    for data in (path.read_bytes(), b"not a zip", before[:-200]):
        path.write_bytes(data)
        with pytest.raises(ArtefactError, match="not a response file"):
            load_responses(path)
    with pytest.raises(ArtefactError, match="no such file"):
        load_responses(tmp_path / "missing.response.npz")
