"""The whole match: from logs to gains, with flags on those that do not fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from chirp_logs import chirp_log
from pronk.errors import IdentifiabilityError, LogError, PronkError, RobotError
from pronk.identify.excitation.signals import Multisine
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match import gains as gains_file
from pronk.identify.match import result as result_file
from pronk.identify.match.gains import JointGains
from pronk.identify.match.pipeline import match_logs
from pronk.identify.match.result import JointFit, MatchResult
from pronk.identify.match.settings import MatchSettings
from pronk.identify.response.response import Estimator
from pronk.robots import load_robot
from synthetic_log import Excitation, synthetic_log

ROBOT = load_robot("mini_cheetah")
QUICK = MatchSettings(
    method="paper", estimator=Estimator(segment_s=4.0), zero_armature=False, grid_points=25
)
KNOWN = {"FR_hip_roll": (20.6, 0.492), "FL_hip_roll": (18.1, 0.516), "FR_knee": (21.8, 0.541)}


def log_of(joint: str, known: tuple[float, float], *, seed: int = 0, **more: Any) -> JointLog:
    log = chirp_log(ROBOT, joint, known, repeats=3, noise_rad=0.001, seed=seed, **more)
    return replace(
        log, origin=replace(log.origin, source=f"/somewhere/{joint}.mcap", sha256=f"{seed:064x}")
    )


@pytest.fixture(scope="module")
def matched() -> MatchResult:
    reports: list[tuple[str, float]] = []
    logs = [log_of(joint, gains, seed=i) for i, (joint, gains) in enumerate(KNOWN.items())]
    result = match_logs(
        logs,
        ROBOT,
        settings=replace(QUICK, zero_armature=True),
        progress=lambda stage, share: reports.append((stage, share)),
    )
    assert {"estimate", "quick search", "amplitudes", "zero armature"} <= {s for s, _ in reports}
    assert all(0.0 <= share <= 1.0 for _, share in reports)
    return result


def grid_optimum(fit: JointFit) -> tuple[float, float]:
    """Stiffness and damping of the node of the grid with the smallest error."""
    row, column = np.unravel_index(int(np.nanargmin(fit.grid_error)), fit.grid_error.shape)
    return float(fit.grid_stiffness[row]), float(fit.grid_damping[column])


def test_known_gains_are_inside_their_intervals(matched: MatchResult) -> None:
    # The robot's order, not that of the logs.
    assert list(matched.gains.joints) == ["FR_hip_roll", "FR_knee", "FL_hip_roll"]
    for joint, known in KNOWN.items():
        found = matched.gains.joints[joint]
        assert found.stiffness.value == pytest.approx(known[0], rel=5e-3)
        assert found.damping.value == pytest.approx(known[1], rel=5e-3)
        for fitted in (found.stiffness, found.damping):
            assert fitted.repeat95[0] < fitted.value < fitted.repeat95[1]
        spacing = 14.0 / 24, 0.6 / 24
        # Stiffness and damping rise together along a valley; a coarse grid may pick its next node.
        grid_stiffness, grid_damping = grid_optimum(matched.joints[joint])
        assert abs(grid_stiffness - known[0]) < 1.5 * spacing[0]
        assert abs(grid_damping - known[1]) < 1.5 * spacing[1]
        assert found.quality.error_db < 0.05
        # The naive gains are those of the real drive, 17 / 0.4.
        assert found.quality.nominal_error_db > 5 * found.quality.error_db
        assert found.quality.coherence_min > 0.9
        assert found.quality.amplitude_spread < 0.01
        assert found.flags == ()
        assert found.armature.value == ROBOT.joint(joint).drive.armature
        assert found.quality.band_hz == ROBOT.joint(joint).band_hz


def test_the_result_holds_responses_maps_and_repeats(matched: MatchResult) -> None:
    for joint in KNOWN:
        one = matched.joints[joint]
        assert [round(r.amplitude, 3) for r in one.responses] == [0.25, 0.125]
        assert one.grid_error.shape == (25, 25)
        assert one.repeat_gains.shape == (3, 2)
        assert one.amplitude_gains.shape == (2, 3)
        assert np.isfinite(one.naive + one.zero_armature).all()  # type: ignore[operator]
        inside = one.responses[0].band(*one.band_hz)
        error = 20 * np.log10(np.abs(one.matched / one.responses[0].response))[inside]
        assert np.sqrt(np.mean(error**2)) == pytest.approx(one.error_db, rel=0.02)


def test_zero_armature_is_refuted_where_the_data_can(matched: MatchResult) -> None:
    knee, roll = matched.joints["FR_knee"], matched.joints["FR_hip_roll"]
    assert knee.zero_armature_error_db > 5 * knee.error_db
    assert any(flag.startswith("zero armature: no match") for flag in knee.flags)
    # The rotor of a hip is light beside the leg: other gains make up for it.
    assert any("not ruled out by this joint" in flag for flag in roll.flags)
    assert matched.gains.joints["FR_knee"].flags == ()


def test_the_gains_name_their_simulator_logs_and_groups(matched: MatchResult) -> None:
    gains = matched.gains
    assert gains.virtual
    assert gains.simulator.version == mujoco.__version__
    assert (gains.simulator.timestep_s, gains.simulator.decimation) == (0.005, 4)
    assert gains.logs["FR_knee.mcap"] == f"{2:064x}"
    assert set(gains.groups) == {"hip_roll", "knee"}


def test_the_artefacts_survive_a_round_trip(matched: MatchResult, tmp_path: Path) -> None:
    gains_file.save_gains(tmp_path / "gains.yaml", matched.gains)
    result_file.save(tmp_path / "match.npz", matched)
    gains = gains_file.load_gains(tmp_path / "gains.yaml")
    again = result_file.load(tmp_path / "match.npz", gains)
    assert set(gains.joints) == set(KNOWN)
    one, other = matched.joints["FR_knee"], again.joints["FR_knee"]
    for name in ("grid_error", "matched", "flags"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_the_grid_way_agrees_with_the_quick_way(matched: MatchResult) -> None:
    log = log_of("FR_knee", KNOWN["FR_knee"], seed=2)
    whole = match_logs([log], ROBOT, settings=replace(QUICK, exhaustive=True, grid_points=25))
    found, quick = whole.joints["FR_knee"], matched.joints["FR_knee"]
    assert grid_optimum(found) == grid_optimum(quick)
    assert found.stiffness == pytest.approx(quick.stiffness, rel=1e-3)
    assert found.damping == pytest.approx(quick.damping, rel=1e-3)
    assert whole.grid_steps_per_second > 1e4
    assert np.isnan(whole.joints["FR_knee"].zero_armature_error_db)


def joint_of(log: JointLog) -> JointGains:
    return match_logs([log], ROBOT, settings=QUICK).gains.joints["FR_knee"]


def test_a_joint_of_another_kind_is_no_match() -> None:
    """A knee of three times the armature: no pair on or off the grid responds alike."""
    found = joint_of(log_of("FR_knee", (17.0, 0.2), frictionloss=0.6, armature=0.02))
    assert any(flag.startswith(("no match", "at the edge")) for flag in found.flags)


def test_a_small_amplitude_that_noise_drowns_is_left_out() -> None:
    log = chirp_log(ROBOT, "FR_knee", (20.0, 0.5), (0.25, 0.01))
    small = log.time >= log.segments[1].start
    noise = 0.1 * np.random.default_rng(0).standard_normal(len(small)) * small
    found = joint_of(replace(log, position=log.position + noise[:, None]))
    assert any(f.startswith("the response at 0.01 rad is left out") for f in found.flags)
    assert np.isnan(found.quality.amplitude_spread)
    assert found.stiffness.value == pytest.approx(20.0, rel=2e-3)


def test_a_multisine_is_matched_through_its_lines() -> None:
    signal = Multisine(amplitude=0.25)
    chirp = Excitation(offsets=signal.samples(), kind="multisine", band_hz=signal.band_hz)
    log = synthetic_log(ROBOT, "FR_knee", [chirp], 21.0, 0.5)
    log = replace(log, segments=tuple(replace(s, period_s=signal.period_s) for s in log.segments))
    found = joint_of(log)
    assert found.stiffness.value == pytest.approx(21.0, rel=5e-3)
    assert found.damping.value == pytest.approx(0.5, rel=5e-3)


def test_naive_gains_are_those_of_the_log() -> None:
    log = log_of("FR_knee", (21.0, 0.5))
    log = replace(log, stiffness=np.array([21.0]), damping=np.array([0.5]))
    assert joint_of(log).quality.nominal_error_db < 0.1


def test_bad_logs_are_refused() -> None:
    good = log_of("FR_knee", (21.0, 0.5))
    elbow = tuple(replace(s, joints=("elbow",)) for s in good.segments)
    steps = tuple(replace(s, kind="sine_steps") for s in good.segments)
    noise = 2.0 * np.random.default_rng(0).standard_normal(good.position.shape)
    for logs, error, message in (
        ([], LogError, "FR_hip_roll"),
        ([replace(good, joints=("elbow",), segments=elbow)], RobotError, r"elbow.*FR_hip_roll"),
        ([replace(good, position=0 * good.position)], LogError, "FR_knee"),
        ([replace(good, units=("unknown",))], LogError, "unit 'unknown'"),
        ([replace(good, position=good.position + noise)], IdentifiabilityError, "coherent"),
        ([replace(good, segments=steps)], LogError, "sine steps"),
    ):
        with pytest.raises(error, match=message):
            match_logs(logs, ROBOT, settings=QUICK)


@pytest.mark.parametrize(
    ("field", "value"),
    [("method", "magic"), ("grid_points", 2), ("coherence_min", 1.0), ("threads", 0)],
)
def test_settings_that_cannot_work_are_refused(field: str, value: object) -> None:
    with pytest.raises(PronkError, match=f"{field} .*expected"):
        MatchSettings(**{field: value})  # type: ignore[arg-type]


# --- Mode drive: damping, armature, friction and delay with the stiffness known ---

DRIVE = {"damping": 0.33, "armature": 0.0055, "frictionloss": 0.3}
LATE_S = 0.004


def late_sweep(*amplitudes: float) -> JointLog:
    """Known drive of FR_knee, three repeats an amplitude, 0.2 mrad of noise, 4 ms late."""
    how = {"repeats": 3, "length_s": 12.0, "noise_rad": 2e-4, "delay_s": LATE_S}
    other = {"armature": DRIVE["armature"], "frictionloss": DRIVE["frictionloss"]}
    return chirp_log(ROBOT, "FR_knee", (17.0, DRIVE["damping"]), amplitudes, **how, **other)


def test_the_drive_is_found_again() -> None:
    found = match_logs([late_sweep(0.25, 0.125)], ROBOT, mode="drive").gains.joints["FR_knee"]
    assert found.stiffness.value == 17.0
    for name, rel in (("damping", 0.02), ("armature", 0.02), ("frictionloss", 0.05)):
        assert getattr(found, name).value == pytest.approx(DRIVE[name], rel=rel)
    assert found.delay_s.value == pytest.approx(LATE_S, abs=2e-4)
    assert found.damping.repeat95[0] < found.damping.value < found.damping.repeat95[1]
    assert found.quality.error_db < 0.05 < 0.2 * found.quality.nominal_error_db
    assert found.flags == ()


def test_what_magnitude_and_phase_cannot_tell_apart_is_refused() -> None:
    everything = ("stiffness", "damping", "armature", "frictionloss", "delay")
    with pytest.raises(IdentifiabilityError, match=r"FR_knee.*stiffness.*armature.*payload"):
        match_logs([late_sweep(0.25)], ROBOT, mode="drive", free=everything)


@pytest.mark.parametrize(
    ("mode", "free", "message"),
    [
        ("drive", ("damping", "inertia"), r"inertia.*stiffness"),
        ("gains", ("damping",), "mode drive"),
        ("both", (), "gains or drive"),
    ],
)
def test_unknown_parameters_and_modes_are_refused(
    mode: str, free: tuple[str, ...], message: str
) -> None:
    with pytest.raises(PronkError, match=message):
        match_logs([late_sweep(0.25)], ROBOT, mode=mode, free=free)  # type: ignore[arg-type]
