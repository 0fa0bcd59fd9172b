"""The paper's match: known gains found again by the grid and off it, intervals that cover."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from pronk.identify.excitation.signals import Chirp
from pronk.identify.match.magnitude import (
    DIVERGED_DB,
    GainInterval,
    command_delay,
    gain_interval,
    grid_axes,
    mean_square,
    refine,
    search_grid,
    search_without_armature,
)
from pronk.identify.match.measured import (
    DB,
    MeasuredJoint,
    measured_joints,
    merged_repeats,
    simulated_response,
)
from pronk.identify.match.parameters import GAINS
from pronk.identify.match.result import (
    GridSearch,
    amplitude_flags,
    amplitude_spread,
)
from pronk.identify.match.settings import MatchSettings
from pronk.identify.response.estimate import operators
from pronk.identify.response.response import Estimator
from pronk.identify.simulators.linear import linearize
from pronk.identify.simulators.mujoco import MujocoSimulator
from pronk.report.paper import TABLE_I
from pronk.robots import load_robot
from pronk.robots.model import bench_inertia
from synthetic_log import Excitation, coloured_noise, synthetic_log

ROBOT = load_robot("mini_cheetah")
SHORT = MatchSettings(estimator=Estimator(segment_s=4.0))
PITCH = "FR_hip_pitch"
PITCH_GAINS = (16.5, 0.382)


def known_target(
    joint: str,
    gains: tuple[float, float] | None = None,
    *,
    segment_s: float = 8.0,
    length_s: float = 8.0,
    stop_hz: float = 25.0,
    frictionloss: float | None = None,
) -> MeasuredJoint:
    """Simulate a joint with known gains (those of Table I), logged without noise."""
    chirp = Excitation(offsets=Chirp(length_s=length_s, stop_hz=stop_hz).samples())
    stiffness, damping = gains or TABLE_I[joint]
    log = synthetic_log(ROBOT, joint, [chirp], stiffness, damping, frictionloss=frictionloss)
    settings = MatchSettings(estimator=Estimator(segment_s=segment_s))
    return measured_joints([log], joint, ROBOT, settings)[0]


def short_targets(
    joint: str,
    gains: tuple[float, float],
    amplitudes: Sequence[float] = (0.25,),
    *,
    repeats: int = 1,
    frictionloss: float | None = None,
    noise: Sequence[np.ndarray] | None = None,
) -> list[MeasuredJoint]:
    """Simulate chirps of 8 s with known gains, measured with segments of 4 s."""
    excitations = []
    for amplitude in amplitudes:
        offsets = Chirp(length_s=8.0, amplitude=amplitude).samples()
        excitations.append(Excitation(offsets=offsets, repeats=repeats))
    stiffness, damping = gains
    log = synthetic_log(
        ROBOT, joint, excitations, stiffness, damping, frictionloss=frictionloss, noise=noise
    )
    return measured_joints([log], joint, ROBOT, SHORT)


def with_repeats(target: MeasuredJoint, repeats: np.ndarray) -> MeasuredJoint:
    """Replace the measured response by the mean of repeats, shape (repeats, f)."""
    measured = replace(target.measured, response=repeats.mean(axis=0), repeats=repeats)
    return replace(target, measured=measured)


def delayed(target: MeasuredJoint, delay_s: float) -> MeasuredJoint:
    """Delay a measured response."""
    turn = np.exp(-1j * target.measured.omega * delay_s)
    return with_repeats(target, target.measured.repeats * turn)


def nearest_node(search: GridSearch, gains: tuple[float, float]) -> tuple[int, int]:
    row = int(np.argmin(np.abs(search.stiffness - gains[0])))
    column = int(np.argmin(np.abs(search.damping - gains[1])))
    return row, column


def intervals(targets: Sequence[MeasuredJoint]) -> list[GainInterval]:
    with MujocoSimulator(ROBOT) as simulator:
        return [gain_interval(refine(simulator, target, PITCH_GAINS)) for target in targets]


# --- the grid -----------------------------------------------------------------------------------


def test_table_1_is_found_again_by_every_joint() -> None:
    """12 of 12: the paper's gains as known gains, within 0.1 cells of the paper's grid."""
    stiffness, damping = grid_axes(ROBOT, 12)
    cell = np.array([14.0 / 49.0, 0.6 / 49.0])
    targets = [known_target(joint.name, length_s=20.0) for joint in ROBOT.joints]
    with MujocoSimulator(ROBOT) as simulator:
        searches = search_grid(simulator, targets, stiffness, damping)
        for target, search in zip(targets, searches, strict=True):
            fit = refine(simulator, target, search.gains)
            distance = np.abs(np.subtract(fit.gains, TABLE_I[target.joint])) / cell
            assert distance.max() < 0.1, target.joint
            assert fit.settled
            assert not search.at_edge


def test_the_whole_paper_grid_lands_on_the_nearest_cell() -> None:
    """All 2,500 pairs simulated, two mirror-image knees at once (a short chirp to 18 Hz)."""
    targets = []
    for joint in ("FR_knee", "HL_knee"):
        targets.append(known_target(joint, length_s=4.0, stop_hz=18.0, segment_s=2.0))
    stiffness, damping = grid_axes(ROBOT)
    shares: list[float] = []

    def progress(stage: str, share: float) -> None:
        shares.append(share)

    with MujocoSimulator(ROBOT) as simulator:
        searches = search_grid(simulator, targets, stiffness, damping, progress=progress)
        assert simulator.steps == 2500 * max(target.steps for target in targets)
    for target, search in zip(targets, searches, strict=True):
        assert search.error.shape == (50, 50)
        assert search.cell == nearest_node(search, TABLE_I[target.joint])
        # Far off the error is large: the map has one valley.
        assert search.error_db < 0.1 < 1.0 < np.sqrt(search.error[0, 0])
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)


def test_without_armature_no_gains_match_a_knee() -> None:
    target = known_target("FR_knee", length_s=4.0, segment_s=2.0)
    with MujocoSimulator(ROBOT) as simulator:
        knee = search_without_armature(simulator, target, 0.05, 1.0)
    assert knee.error_db > 5.0
    assert knee.ruled_out
    assert knee.response.shape == target.measured.omega.shape


def test_the_error_is_the_mean_square_in_decibels() -> None:
    target = known_target(PITCH)
    measured = target.measured.response[target.fit_mask]
    assert mean_square(target.error_db(measured * 10 ** (0.5 / 20))) == pytest.approx(0.25)
    # Phase is disregarded (F9).
    turned = measured * np.exp(-1j * target.omega * 0.01)
    assert mean_square(target.error_db(turned)) == pytest.approx(0.0, abs=1e-20)
    for factor in (0.0, np.nan):
        diverged = mean_square(target.error_db(factor * measured))
        assert diverged == pytest.approx(DIVERGED_DB**2)


# --- measured responses and simulated ones ------------------------------------------------------


def test_repeats_in_several_logs_are_put_together() -> None:
    target = known_target("FR_knee")
    louder = 1.2 * target.measured.repeats
    twice = replace(target.measured, response=louder[0], repeats=np.repeat(louder, 2, axis=0))
    merged = merged_repeats([target, replace(target, measured=twice)])
    assert len(merged.measured.repeats) == 3
    expected = target.measured.response * (1.0 + 2 * 1.2) / 3
    np.testing.assert_allclose(merged.measured.response, expected)


def test_full_and_banded_responses_agree_and_the_horizon_changes_no_gain() -> None:
    """Steps without effect on the band are left out: 0.003 dB at most."""
    target = known_target("FL_hip_roll", length_s=20.0)
    assert target.steps < 0.9 * len(target.trace.command)
    with MujocoSimulator(ROBOT) as simulator:
        for number, gains in enumerate((TABLE_I["FL_hip_roll"], (13.0, 0.1), (27.0, 0.7))):
            values = {"stiffness": np.array([gains[0]]), "damping": np.array([gains[1]])}
            for _, position in simulator.run([target.trace], values, target.steps):
                banded = target.fit_response(position[0])
            named = {"stiffness": gains[0], "damping": gains[1]}
            full = simulated_response(simulator, target, named)
            if number == 0:
                np.testing.assert_allclose(full, target.measured.response, rtol=1e-6)
            difference_db = DB * np.log(np.abs(banded / full[target.fit_mask]))
            assert np.abs(difference_db).max() < 0.003


def test_a_simulated_delay_turns_the_phase() -> None:
    target = known_target(PITCH)
    values = {"stiffness": PITCH_GAINS[0], "damping": PITCH_GAINS[1]}
    with MujocoSimulator(ROBOT) as simulator:
        prompt = simulated_response(simulator, target, values)
        late = simulated_response(simulator, target, values | {"delay": 0.004})
    np.testing.assert_allclose(late, prompt * np.exp(-0.004j * target.measured.omega))


# --- the linearized simulator -------------------------------------------------------------------


def test_at_a_fine_step_the_closed_form_is_the_second_order_joint() -> None:
    """`stiffness / (I s^2 + (damping + b) s + stiffness + gravity)` (paper M2, reading A9)."""
    omega = 2 * np.pi * np.array([0.5, 2.0, 5.0, 10.0, 20.0])
    with MujocoSimulator(replace(ROBOT, timestep_s=1e-5, decimation=2000)) as simulator:
        rig = simulator.rig("FR_knee")
        closed_form = linearize(rig, np.array([1.6]), omega).response(17.0, 0.4)[0]
        data = mujoco.MjData(rig.model)
        bias = []
        for angle in (1.6 - 1e-4, 1.6 + 1e-4):
            data.qpos[:] = angle
            mujoco.mj_forward(rig.model, data)
            bias.append(data.qfrc_bias[0])
        inertia = np.zeros(1)
        mujoco.mj_mulM(rig.model, data, inertia, np.ones(1))
    viscous = ROBOT.joint("FR_knee").drive.viscous_damping
    gravity = (bias[1] - bias[0]) / 2e-4
    s = 1j * omega
    expected = 17.0 / (inertia * s**2 + (0.4 + viscous) * s + 17.0 + gravity)
    np.testing.assert_allclose(closed_form, expected, rtol=2e-3)


def test_inertia_on_the_bench_contains_the_rotor() -> None:
    inertia, gravity = bench_inertia(ROBOT, "FR_hip_roll")
    assert inertia > ROBOT.joint("FR_hip_roll").drive.armature
    assert np.isfinite(gravity)


# --- off the grid -------------------------------------------------------------------------------


def test_known_gains_are_found_from_anywhere_on_the_grid_whatever_the_delay() -> None:
    knee_gains = (22.0, 0.523)
    pitch = short_targets(PITCH, PITCH_GAINS)[0]
    knee = delayed(short_targets("FR_knee", knee_gains)[0], 0.004)
    with MujocoSimulator(ROBOT) as simulator:
        for start in ((13.0, 0.1), (27.0, 0.7), (13.0, 0.7), (27.0, 0.1)):
            for target, gains in ((pitch, PITCH_GAINS), (knee, knee_gains)):
                fit = refine(simulator, target, start)
                assert fit.settled
                assert fit.gains == pytest.approx(gains, rel=1e-3)
                assert fit.error_db < 0.01


def test_off_the_model_the_refinement_is_no_worse_than_the_grid() -> None:
    """The measured joint has twice the simulator's dry friction, so no gains fit exactly."""
    target = known_target("FL_knee", frictionloss=0.4)
    stiffness, damping = grid_axes(ROBOT, 20)
    with MujocoSimulator(ROBOT) as simulator:
        (search,) = search_grid(simulator, [target], stiffness, damping)
        fit = refine(simulator, target, search.gains)
    assert 0.02 < fit.error_db < search.error_db + 0.005
    assert abs(fit.stiffness - search.gains[0]) < 1.5 * (stiffness[1] - stiffness[0])
    assert abs(fit.damping - search.gains[1]) < 1.5 * (damping[1] - damping[0])


def test_delay_is_the_lag_of_the_phase_where_the_joint_is_coherent() -> None:
    target = short_targets(PITCH, PITCH_GAINS)[0]
    band_hz = ROBOT.joint(PITCH).band_hz
    late = delayed(target, 0.002).measured
    incoherent = replace(late, coherence=np.zeros_like(late.coherence))
    for measured, delay_s in ((late, 0.002), (incoherent, 0.0)):
        found_s = command_delay(measured, target.measured.response, band_hz)
        assert found_s == pytest.approx(delay_s, abs=1e-6)


def test_intervals_cover_the_known_gains_under_coloured_noise() -> None:
    """95 % intervals, 200 trials of three repeats each, noise coloured at 2 Hz: 90 to 99 %."""
    rng = np.random.default_rng(2)
    trials = 200
    repeats = 3

    def noise(shape: tuple[int, ...]) -> np.ndarray:
        return coloured_noise(rng, shape, deviation=0.003, corner_hz=2.0, rate_hz=500.0)

    excitation = Excitation(offsets=Chirp(length_s=8.0).samples(), repeats=repeats)
    log = synthetic_log(
        ROBOT, PITCH, [excitation], *PITCH_GAINS, noise=list(noise((repeats, 6000)))
    )
    target = measured_joints([log], PITCH, ROBOT, SHORT)[0]
    operator = operators(log, PITCH, SHORT.estimator)[0][0]
    errors = noise((trials, repeats, len(operator.time))) @ operator.matrix(operator.time)
    quiet = short_targets(PITCH, PITCH_GAINS)[0].measured.response
    stiffness = []
    covered = dict.fromkeys(GAINS, 0)
    with MujocoSimulator(ROBOT) as simulator:
        for trial_errors in errors:
            fit = refine(simulator, with_repeats(target, quiet + trial_errors), PITCH_GAINS)
            interval = gain_interval(fit)
            assert interval.flags == ()
            stiffness.append(fit.stiffness)
            for name, true_gain in zip(GAINS, PITCH_GAINS, strict=True):
                low, high = interval.ci95[name]
                covered[name] += low <= true_gain <= high
    for name in GAINS:
        assert 0.90 * trials <= covered[name] <= 0.99 * trials
    # No bias beside the scatter of the mean.
    assert abs(np.mean(stiffness) - PITCH_GAINS[0]) < 4 * np.std(stiffness) / np.sqrt(trials)


def test_each_repeat_is_fitted_by_itself() -> None:
    repeat_gains = np.array([(16.4, 0.380), (16.5, 0.384), (16.6, 0.386)])
    targets = []
    for stiffness, damping in repeat_gains.tolist():
        targets.append(short_targets(PITCH, (stiffness, damping))[0])
    repeats = np.array([target.measured.response for target in targets])
    (interval,) = intervals([with_repeats(targets[0], repeats)])
    np.testing.assert_allclose(interval.repeat_gains, repeat_gains, rtol=1e-3)
    expected = np.cov(repeat_gains.T) / 3
    np.testing.assert_allclose(interval.covariance, expected, rtol=0.1)
    # Student's t of two degrees of freedom, 97.5 %.
    low, high = interval.ci95["stiffness"]
    assert 0.5 * (high - low) == pytest.approx(4.3027 * np.sqrt(expected[0, 0]), rel=0.05)


def test_few_repeats_are_flagged() -> None:
    noise = 0.002 * np.random.default_rng(3).standard_normal((2, 6000))
    two = short_targets(PITCH, PITCH_GAINS, repeats=2, noise=list(noise))[0]
    single_repeat = replace(two, measured=replace(two.measured, repeats=two.measured.repeats[:1]))
    pair, single = intervals([two, single_repeat])
    assert "two repeats" in pair.flags[0]
    assert "one repeat" in single.flags[0]
    low, high = single.ci95["stiffness"]
    assert low < PITCH_GAINS[0] < high < low + 1.0
    assert 0.0 < single_repeat.measurement_error_db() < 1.0


@pytest.mark.parametrize(("friction", "flagged"), [(0.2, False), (0.8, True)])
def test_friction_that_the_simulator_lacks_shows_between_amplitudes(
    friction: float, flagged: bool
) -> None:
    targets = short_targets("FR_knee", (20.0, 0.5), (0.25, 0.1), frictionloss=friction)
    rows = []
    with MujocoSimulator(ROBOT) as simulator:
        for target in targets:
            fit = refine(simulator, target, (20.0, 0.5))
            rows.append((target.measured.amplitude, fit.stiffness, fit.damping))
    gains = np.array(rows)
    assert gains[:, 0] == pytest.approx([0.25, 0.1], rel=1e-3)
    assert bool(amplitude_flags(gains)) == flagged
    assert (amplitude_spread(gains) < 0.01) != flagged
    assert np.isnan(amplitude_spread(gains[:1]))


def test_gains_make_up_for_the_step_of_the_training_simulator() -> None:
    """The same drive at 0.25 ms and in the 5 ms training simulator (the paper's point)."""
    joint = ROBOT.joint("FR_knee")
    matched = {}
    for timestep_s in (0.00025, 0.000125):
        tick_s = ROBOT.timestep_s * ROBOT.decimation
        fine = replace(ROBOT, timestep_s=timestep_s, decimation=round(tick_s / timestep_s))
        excitation = Excitation(offsets=Chirp(length_s=8.0).samples(1.0 / tick_s))
        log = synthetic_log(fine, joint.name, [excitation], joint.stiffness, joint.damping)
        target = measured_joints([log], joint.name, ROBOT, MatchSettings())[0]
        with MujocoSimulator(ROBOT) as simulator:
            fit = refine(simulator, target, (joint.stiffness, joint.damping))
            nominal = {"stiffness": joint.stiffness, "damping": joint.damping}
            response = simulated_response(simulator, target, nominal)
        nominal_db = target.rms_db(response[target.fit_mask])
        assert nominal_db > 0.2
        assert fit.error_db < min(0.1, 0.3 * nominal_db)
        matched[timestep_s] = fit.gains
    # A first look at this joint gave 14.4 / 0.34.
    assert matched[0.00025] == pytest.approx((14.4, 0.34), rel=0.03)
    assert matched[0.00025] == pytest.approx(matched[0.000125], rel=0.01)
