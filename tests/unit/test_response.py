"""Estimators against joints whose response is known in closed form, and recorded ones."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from pronk.errors import ArtefactError, LogError, PronkError
from pronk.logs.joint_log import JointLog
from pronk.logs.readers import read_log
from pronk.response import (
    Estimator,
    FrequencyResponse,
    H1Operator,
    estimate,
    load,
    operators,
    save,
)
from pronk.response.grid import Grid, grid_over, held_mean
from pronk.response.h1 import layout, sums
from pronk.response.periodic import read_periods
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
    signals = [(*multisine_command(rate, seed=k, periods=periods), None) for k in range(count)]
    return make_log(signals, joint, **{"kind": "multisine", "period": 4.0} | more)


def errors(
    response: FrequencyResponse, joint: dict[str, float], *, delay: float = 0.0
) -> tuple[float, float, int]:
    """Largest gain error (share) and phase error (degrees) where coherent, and how many bins."""
    known = second_order(response.omega, delay_s=delay, **joint)
    use = response.band(0.25, 24.0, 0.95)
    ratio = response.response[use] / known[use]
    gain, phase = np.abs(np.abs(ratio) - 1.0), np.degrees(np.abs(np.angle(ratio)))
    return float(gain.max()), float(phase.max()), int(use.sum())


# --- estimates ----------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [200.0, 1000.0])
@pytest.mark.parametrize("kind", ["chirp", "log_chirp"])
@pytest.mark.parametrize("name", JOINTS)
def test_chirp_gives_the_analytic_response(name: str, kind: str, rate: float) -> None:
    log = make_log(
        [chirp_command(kind, rate)] * 3, linear_joint(**JOINTS[name]), kind=kind, noise=2e-5
    )
    (response,) = estimate(log, "knee")
    gain, phase, bins = errors(response, JOINTS[name])
    assert (gain < 0.005, phase < 0.5, bins) == (True, True, 191)  # Every bin is coherent.
    assert response.repeats.shape == (3, len(response.omega))


@pytest.mark.parametrize("rate", [200.0, 500.0])
@pytest.mark.parametrize("name", JOINTS)
def test_multisine_and_steps_give_the_analytic_response(name: str, rate: float) -> None:
    joint = linear_joint(**JOINTS[name])
    (response,) = estimate(multisines(3, joint, rate=rate, noise=2e-5), "knee")
    gain, phase, bins = errors(response, JOINTS[name])
    assert (gain < 0.003, phase < 0.2, bins) == (True, True, 36)
    steps = [steps_command(rate, (0.5, 1.0, 2.0, 3.0, 5.0, 7.3, 10.0, 12.5, 15.0, 20.0))]
    (response,) = estimate(make_log(steps, joint, kind="sine_steps", noise=2e-5), "knee")
    gain, phase, bins = errors(response, JOINTS[name])
    assert (gain < 0.005, phase < 0.2, bins) == (True, True, 10)


def test_multisine_of_unknown_kind_is_right_where_it_is_coherent() -> None:
    """Between the lines there is only their leakage; such bins must not count as coherent."""
    (response,) = estimate(multisines(3, kind="unknown", period=None), "knee")
    gain, phase, bins = errors(response, KNEE)
    assert (gain < 0.005, phase < 0.5, bins) == (True, True, 36)


@pytest.mark.parametrize("jitter", [0.05, 0.9])
def test_measured_timestamps_are_used(jitter: float) -> None:
    log = chirps(rate=500.0, jitter=jitter)
    gain, phase, bins = errors(estimate(log, "knee")[0], KNEE)
    assert (gain < 0.01, phase < 0.5, bins) == (True, True, 191)
    # The same rows with invented, even timestamps are off by more than that.
    time = np.arange(len(log.time)) / 500.0 * (1.0 + 0.02 * jitter)
    even = replace(log, time=time, segments=(), frequency=None)
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


def test_amplitudes_come_largest_first_and_repeats_together() -> None:
    time, command, hz = chirp_command("chirp", 200.0)
    signals = [(time, size * command, hz) for size in (0.5, 0.5, 1.0, 1.0, 1.0)]
    log = make_log(signals, KNEE_JOINT, kind="chirp")
    segments = tuple(replace(s, amplitude=float("nan")) for s in log.segments)
    found = estimate(replace(log, segments=segments), "knee")
    assert [r.amplitude for r in found] == pytest.approx([0.25, 0.125], rel=0.01)
    assert [len(r.repeats) for r in found] == [3, 2]
    assert np.array_equal(found[0].omega, found[1].omega)


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
    stuck = chirps(joint=lambda u, _: 1e-4 * np.sin(u))
    still = make_log([(time, 0.0 * command, hz)], lambda u, _: u, kind="chirp")
    short = make_log([(time[:300], command[:300], hz[:300])], KNEE_JOINT, kind="chirp")
    time, command, hz = steps_command(500.0, (1.0, 2.0))
    hurried = (time[:600], command[:600], hz[:600])
    for log, joint, words in (
        (stuck, "knee", "knee did not move"),
        (still, "knee", "stands still"),
        (short, "knee", "choose a shorter"),
        (short, "hip", r"no joint 'hip'; it has knee"),
        (multisines(periods=2), "knee", "3 equal periods are needed"),
        (multisines(period=None), "knee", "no period_s"),
        (
            make_log([(time, command, None)], KNEE_JOINT, kind="sine_steps"),
            "knee",
            "instantaneous frequency",
        ),
        (make_log([hurried], KNEE_JOINT, kind="sine_steps"), "knee", "the step at 1 Hz lasts"),
    ):
        with pytest.raises(LogError, match=words):
            estimate(log, joint)
    both = np.repeat(stuck.command, 2, axis=1)
    two = replace(stuck, joints=("knee", "hip"), command=both, position=both)
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


# --- periods ------------------------------------------------------------------------------------


def test_lines_of_a_linear_joint_are_exact_without_noise() -> None:
    (response,) = estimate(multisines(), "knee")
    known = second_order(response.omega, **KNEE)
    assert np.abs(response.response / known - 1.0).max() < 2e-4
    # Five equal periods, of which the first settles: four repeats.
    assert response.repeats.shape == (4, 36)
    assert np.allclose(response.frequency_hz * 4.0 % 2.0, 1.0)  # Odd lines alone.
    (response,) = estimate(multisines(3, noise=1e-3), "knee")
    assert response.repeats.shape == (3, 36)
    assert np.all(response.averages == 12)


def test_ramped_and_unequal_periods_fall_out() -> None:
    time, command = multisine_command(500.0)
    ramped = [(time, command * np.clip(time / 1.0, 0.0, 1.0), None)]
    log = make_log(ramped, KNEE_JOINT, kind="multisine", period=4.0)
    read = read_periods(log, "knee", Estimator(), 500.0)
    assert len(read.command) == 3
    known = second_order(read.omega, **KNEE)
    assert np.abs(read.position / read.command / known - 1.0).max() < 2e-4


# --- delay and third harmonic -------------------------------------------------------------------


@pytest.mark.parametrize("delay", [0.002, 0.010])
def test_delay_is_recovered(delay: float) -> None:
    shift = round(delay * 500.0)

    def late(command: np.ndarray, rate: float) -> np.ndarray:
        return np.r_[np.zeros(shift), simulate_second_order(command, rate, **KNEE)[:-shift]]

    (response,) = estimate(chirps(joint=late, rate=500.0), "knee")
    assert response.delay_s == pytest.approx(delay, abs=5e-5)
    gain, phase, _ = errors(response, KNEE, delay=delay)
    assert (gain < 0.005, phase < 0.5) == (True, True)


def test_noise_moves_the_delay_little() -> None:
    for seed in range(4):
        (response,) = estimate(chirps(4, rate=500.0, noise=3e-3, seed=seed), "knee")
        assert abs(response.delay_s) < 3e-4


def test_friction_shows_in_the_third_harmonic() -> None:
    """0.0000 without friction, 0.013 with 0.2 N m, twice that at half the amplitude."""
    time, command, hz = chirp_command("chirp", 500.0)
    ratio = {}
    for friction, scale in ((0.0, 1.0), (0.2, 1.0), (0.2, 0.5)):
        signal = (time, scale * command, hz)
        log = make_log([signal], friction_joint(friction), kind="chirp", noise=2e-5)
        ratio[friction, scale] = estimate(log, "knee")[0].third_harmonic
    assert ratio[0.0, 1.0] < 0.001
    assert 0.008 < ratio[0.2, 1.0] < 0.02
    assert ratio[0.2, 0.5] == pytest.approx(2.0 * ratio[0.2, 1.0], rel=0.15)
    signals = [steps_command(500.0, (1.0, 2.0, 3.0))]
    steps = make_log(signals, friction_joint(0.2), kind="sine_steps")
    assert estimate(steps, "knee")[0].third_harmonic == pytest.approx(ratio[0.2, 1.0], rel=0.15)


# --- uncertainty --------------------------------------------------------------------------------

SETTINGS = Estimator(max_hz=20.0)


def coloured(rng: np.random.Generator, shape: tuple[int, ...], deviation: float) -> np.ndarray:
    """First-order autoregressive noise at 200 Hz with its corner at 2 Hz."""
    pole = np.exp(-2.0 * np.pi * 2.0 / 200.0)
    drive = deviation * np.sqrt(1.0 - pole**2) * rng.standard_normal(shape)
    # A second of run-in, so that it is stationary.
    driven = np.concatenate([drive[..., :200], drive], axis=-1)
    return lfilter([1.0], [1.0, -pole], driven)[..., 200:]


def covered(omega: np.ndarray, known: np.ndarray, **parts: np.ndarray) -> np.ndarray:
    """Whether the intervals on gain and phase hold the known response, shape (2, f)."""
    labels = {"joint": "knee", "estimator": "H1", "window": "", "segment_s": SETTINGS.segment_s}
    response = FrequencyResponse(amplitude=AMPLITUDE, omega=omega, **labels, **parts)  # type: ignore[arg-type]
    low, high = response.gain_interval(0.95)
    gain = (low <= np.abs(known)) & (np.abs(known) <= high)
    low, high = response.phase_interval(0.95)
    off = np.angle(known / response.response)
    return np.array([gain, (low - response.phase <= off) & (off <= high - response.phase)])


@pytest.mark.parametrize("repeats", [3, 5])
def test_intervals_over_repeats_cover_coloured_noise(repeats: int) -> None:
    rng = np.random.default_rng(repeats)
    time, command, _ = chirp_command("chirp", 200.0)
    operator = H1Operator.build(time, command, SETTINGS)
    matrix, ones = operator.matrix(time), np.ones(len(operator.omega))
    clean = simulate_second_order(command, 200.0, **KNEE)
    noise = coloured(rng, (300, repeats, len(time)), 2e-3)
    hits = np.array(
        [
            covered(
                operator.omega,
                clean @ matrix,
                response=row.mean(axis=0),
                coherence=ones,
                averages=ones,
                repeats=row,
            )
            for row in (clean + noise) @ matrix
        ]
    )
    for each in (hits[:, 0], hits[:, 1]):
        assert 0.93 < each.mean() < 0.97
        assert each.mean(axis=0).min() > 0.88
    # Between 0.90 and 0.99 for every bin but what chance leaves outside.
    assert np.mean(np.abs(hits[:, 0].mean(axis=0) - 0.945) <= 0.045) > 0.97


@pytest.mark.parametrize("colour", ["white", "coloured"])
def test_a_single_repeat_is_covered_by_the_coherence_formula(colour: str) -> None:
    rng = np.random.default_rng(7)
    time, command, _ = chirp_command("chirp", 200.0)
    grid = grid_over(time)
    where = layout(grid, SETTINGS, padded=True)
    excited = where.spectra(held_mean(time, command, grid.edges))
    clean = KNEE_JOINT(command, 200.0)
    known = sums(excited, where.spectra(clean), where).response(where.omega, 200.0)
    hits = []
    for _ in range(150):
        white = 4e-3 * rng.standard_normal(len(time))
        noise = white if colour == "white" else coloured(rng, (len(time),), 8e-3)
        s = sums(excited, where.spectra(clean + noise), where)
        found = s.response(where.omega, 200.0)
        parts = {"coherence": s.coherence(), "averages": s.averages(), "repeats": found[None]}
        hits.append(covered(where.omega, known, response=found, **parts)[0])
    assert 0.90 < np.mean(hits) < 0.99


def test_coherence_of_noise_alone_is_one_over_the_averages() -> None:
    time, command, _ = chirp_command("chirp", 200.0)
    grid = grid_over(time)
    where = layout(grid, SETTINGS, padded=True)
    excited = where.spectra(held_mean(time, command, grid.edges))
    rng = np.random.default_rng(3)
    raw, averages = [], np.empty(0)
    for _ in range(150):
        s = sums(excited, where.spectra(rng.standard_normal(grid.count)), where)
        raw.append(np.abs(s.uy) ** 2 / (s.uu * s.yy))
        averages = s.averages()
    inner = slice(8, -8)
    assert float((np.mean(raw, axis=0) * averages)[inner].mean()) == pytest.approx(1.0, abs=0.1)
    # Nor is a single noisy repeat coherent by construction.
    assert float(np.median(estimate(chirps(noise=0.5), "knee")[0].coherence)) < 0.7


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
    (response,) = estimate(log, "knee", settings)
    (row,) = operators(log, "knee", settings)
    parts = [log.cut(segment) for segment in log.segments]
    each = np.array([p.position[:, 0] @ o.matrix(o.time) for o, p in zip(row, parts, strict=True)])
    weight = np.array([one.excitation for one in row])
    scale = np.abs(response.response).max()
    for operator, part, expected in zip(row, parts, each, strict=True):
        found = operator.response(operator.time, part.position[:, 0])
        assert np.abs(found - expected).max() < 1e-9 * scale
    if len(each) == len(response.repeats):
        assert np.abs(each - response.repeats).max() < 1e-9 * scale
    whole = (each * weight).sum(axis=0) / weight.sum(axis=0)
    assert np.abs(whole - response.response).max() < 1e-9 * scale


def test_matrix_takes_positions_at_physics_steps() -> None:
    """Positions every 5 ms give the response of those every 2 ms, but for the interpolation."""
    time, command, _ = chirp_command("chirp", 500.0)
    operator = H1Operator.build(time, command, Estimator())
    steps = np.arange(round(time[-1] / 0.005)) * 0.005
    matrix, own = operator.matrix(steps), operator.matrix(time)
    assert np.allclose((command + 1.7) @ own, command @ own, atol=1e-8)  # Offsets do not matter.
    for joint in (KNEE, HIP, LIVELY):
        fine = simulate_second_order(command, 500.0, **joint) @ own
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


def test_responses_survive_a_file_and_damage_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "knee.response.npz"
    written = [*estimate(chirps(2, noise=1e-4), "knee"), *estimate(multisines(), "knee")]
    save(path, written)
    for a, b in zip(written, load(path), strict=True):
        for name in vars(a):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    before = path.read_bytes()
    with pytest.raises(TypeError):
        save(path, [FrequencyResponse(**{**vars(written[0]), "source": object()})])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    headers: dict[str, Any] = {
        "this pronk reads": json.dumps({"schema": "pronk/response/0"}),
        "not a response file": np.array([{"schema": "pronk/response/1"}], dtype=object),
    }
    for words, header in headers.items():
        np.savez(path, header=header)
        with pytest.raises(ArtefactError, match=words):
            load(path)
    for data in (b"not a zip", before[:-200]):
        path.write_bytes(data)
        with pytest.raises(ArtefactError, match="not a response file"):
            load(path)
    with pytest.raises(ArtefactError, match="no such file"):
        load(tmp_path / "missing.response.npz")
