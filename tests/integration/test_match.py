"""The whole match: from logs to gains, with flags on those that do not fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from chirp_logs import chirp_log
from pronk.errors import ArtefactError, IdentifiabilityError, LogError, PronkError, RobotError
from pronk.identify.excitation.signals import Multisine
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match import gains as gains_file
from pronk.identify.match.gains import JointGains
from pronk.identify.match.match import hashes_by_name, match
from pronk.identify.match.predict import predict
from pronk.identify.match.result import MatchResult, load_match, save_match
from pronk.identify.match.settings import MatchSettings
from pronk.identify.response.response import Estimator
from pronk.robots import load_robot
from synthetic_log import Excitation, synthetic_log

ROBOT = load_robot("mini_cheetah")
COARSE = MatchSettings(estimator=Estimator(segment_s=4.0), zero_armature=False, grid_points=10)
"""A grid of 100 nodes: the refinement goes off it all the same."""
KNOWN = {"FR_hip_roll": (20.6, 0.492), "FL_hip_roll": (18.1, 0.516), "FR_knee": (21.8, 0.541)}


def knee_log(
    gains: tuple[float, float], *, frictionloss: float | None = None, armature: float | None = None
) -> JointLog:
    """Chirps to a knee with known gains, three repeats of two amplitudes, 1 mrad of noise."""
    drive = ROBOT.joint("FR_knee").drive
    return chirp_log(
        ROBOT,
        "FR_knee",
        gains,
        repeats=3,
        noise_rad=0.001,
        frictionloss=drive.frictionloss if frictionloss is None else frictionloss,
        armature=drive.armature if armature is None else armature,
    )


@pytest.fixture(scope="module")
def matched() -> MatchResult:
    reports: list[tuple[str, float]] = []
    logs = []
    for seed, (joint, gains) in enumerate(KNOWN.items()):
        log = chirp_log(ROBOT, joint, gains, repeats=3, noise_rad=0.001, seed=seed)
        origin = replace(log.origin, source=f"/somewhere/{joint}.mcap", sha256=f"{seed:064x}")
        logs.append(replace(log, origin=origin))
    result = match(
        logs,
        ROBOT,
        method="paper",
        settings=replace(COARSE, zero_armature=True),
        progress=lambda stage, share: reports.append((stage, share)),
    )
    assert {stage for stage, _ in reports} == {"estimate", "grid", "fit", "responses"}
    assert all(0.0 <= share <= 1.0 for _, share in reports)
    return result


def test_known_gains_are_inside_their_intervals(matched: MatchResult) -> None:
    # The robot's order, not that of the logs.
    assert list(matched.joints) == ["FR_hip_roll", "FR_knee", "FL_hip_roll"]
    for joint, true_gains in KNOWN.items():
        gains = matched.gains.joints[joint]
        assert (gains.stiffness.value, gains.damping.value) == pytest.approx(true_gains, rel=5e-3)
        for fitted in (gains.stiffness, gains.damping):
            assert fitted.repeat95[0] < fitted.value < fitted.repeat95[1]
        assert gains.quality.error_db < 0.05
        # The nominal gains are those of the real drive, 17 / 0.4.
        assert gains.quality.nominal_error_db > 5 * gains.quality.error_db
        assert gains.quality.coherence_min > 0.9
        assert gains.quality.amplitude_spread < 0.01
        assert gains.quality.band_hz == ROBOT.joint(joint).band_hz
        assert gains.flags == ()
        assert gains.armature.value == ROBOT.joint(joint).drive.armature
        grid = matched.joints[joint].grid
        assert grid is not None
        # Stiffness and damping rise together along a valley; a coarse grid may pick its next node.
        assert abs(grid.gains[0] - true_gains[0]) < 1.5 * (grid.stiffness[1] - grid.stiffness[0])
        assert abs(grid.gains[1] - true_gains[1]) < 1.5 * (grid.damping[1] - grid.damping[0])


def test_the_result_holds_responses_maps_and_amplitudes(matched: MatchResult) -> None:
    for joint in KNOWN:
        result = matched.joints[joint]
        assert result.responses is not None
        assert result.grid is not None
        assert result.zero_armature is not None
        measured = result.responses.measured
        assert [round(response.amplitude, 3) for response in measured] == [0.25, 0.125]
        assert result.grid.error.shape == (10, 10)
        assert result.fit.amplitude_gains.shape == (2, 3)
        assert np.isfinite(result.responses.nominal).all()
        assert np.isfinite(result.zero_armature.response).all()
        inside = measured[0].band(*result.responses.band_hz)
        ratio = np.abs(result.responses.matched / measured[0].response)[inside]
        error_db = np.sqrt(np.mean((20 * np.log10(ratio)) ** 2))
        assert error_db == pytest.approx(result.responses.error_db, rel=0.02)


def test_zero_armature_is_refuted_where_the_data_can(matched: MatchResult) -> None:
    knee = matched.joints["FR_knee"]
    roll = matched.joints["FR_hip_roll"]
    assert knee.zero_armature is not None
    assert roll.zero_armature is not None
    assert knee.zero_armature.error_db > 5 * knee.gains.quality.error_db
    assert knee.zero_armature.ruled_out
    # The rotor of a hip is light beside the leg: other gains make up for it.
    assert not roll.zero_armature.ruled_out


def test_the_gains_name_their_simulator_logs_and_groups(matched: MatchResult) -> None:
    gains = matched.gains
    assert gains.virtual
    assert gains.simulator.version == mujoco.__version__
    assert (gains.simulator.timestep_s, gains.simulator.decimation) == (0.005, 4)
    assert gains.logs["FR_knee.mcap"] == f"{2:064x}"
    assert set(gains.groups) == {"hip_roll", "knee"}


def test_logs_of_one_file_name_keep_a_hash_each() -> None:
    """Two sweeps of a robot into two folders have files of the same names."""
    log = chirp_log(ROBOT, "FR_knee", (21.0, 0.5), (0.25,), length_s=2.0)
    logs = []
    for source in ("/a/monday/knee.mcap", "/a/tuesday/knee.mcap", "/a/tuesday/hip.mcap"):
        origin = replace(log.origin, source=source, sha256=source)
        logs.append(replace(log, origin=origin))
    assert hashes_by_name(logs) == {
        "monday/knee.mcap": "/a/monday/knee.mcap",
        "tuesday/knee.mcap": "/a/tuesday/knee.mcap",
        "hip.mcap": "/a/tuesday/hip.mcap",
    }


def test_the_artefacts_survive_a_round_trip(matched: MatchResult, tmp_path: Path) -> None:
    gains_file.save_gains(tmp_path / "gains.yaml", matched.gains)
    save_match(tmp_path / "match.npz", matched)
    gains = gains_file.load_gains(tmp_path / "gains.yaml")
    loaded = load_match(tmp_path / "match.npz")
    assert set(gains.joints) == set(KNOWN)
    assert repr(loaded) == repr(matched)
    knee = loaded.joints["FR_knee"]
    saved = matched.joints["FR_knee"]
    # By text, because unknown intervals are NaN, which equals nothing.
    assert repr(knee.gains) == repr(saved.gains)
    assert knee.grid is not None
    assert saved.grid is not None
    np.testing.assert_array_equal(knee.grid.error, saved.grid.error)


def test_the_result_describes_draws_and_lists_itself(matched: MatchResult, tmp_path: Path) -> None:
    lines = repr(matched).splitlines()
    assert len(lines) == 1 + len(KNOWN)
    assert "FR_knee: 21.8" in lines[2]
    for joint in (None, "FR_knee"):
        matched.plot(joint).savefig(tmp_path / f"{joint}.svg")
    assert "FR_knee" in (tmp_path / "FR_knee.svg").read_text(encoding="utf-8")
    with pytest.raises(ArtefactError, match=r"elbow.*FR_knee"):
        matched.plot("elbow")
    figures = matched.to_dict()
    assert figures["joints"]["FR_knee"]["stiffness"]["value"] == pytest.approx(21.8, rel=5e-3)
    assert figures["simulator"]["engine"] == "mujoco"


def matched_knee(log: JointLog) -> JointGains:
    return match([log], ROBOT, method="paper", settings=COARSE).gains.joints["FR_knee"]


def test_a_joint_of_another_kind_is_no_match() -> None:
    """A knee of three times the armature: no pair on or off the grid responds alike."""
    gains = matched_knee(knee_log((17.0, 0.2), frictionloss=0.6, armature=0.02))
    assert any(flag.startswith(("no match", "at the edge")) for flag in gains.flags)


def test_a_small_amplitude_that_noise_drowns_is_left_out() -> None:
    log = chirp_log(ROBOT, "FR_knee", (20.0, 0.5), (0.25, 0.01))
    small = log.time >= log.segments[1].start
    noise = 0.1 * np.random.default_rng(0).standard_normal(len(small)) * small
    gains = matched_knee(replace(log, position=log.position + noise[:, None]))
    assert any(flag.startswith("the response at 0.01 rad is left out") for flag in gains.flags)
    assert np.isnan(gains.quality.amplitude_spread)
    assert gains.stiffness.value == pytest.approx(20.0, rel=2e-3)


def test_a_multisine_is_matched_through_its_lines() -> None:
    signal = Multisine(amplitude=0.25)
    excitation = Excitation(offsets=signal.samples(), kind="multisine", band_hz=signal.band_hz)
    log = synthetic_log(ROBOT, "FR_knee", [excitation], 21.0, 0.5)
    segments = []
    for segment in log.segments:
        segments.append(replace(segment, period_s=signal.period_s))
    gains = matched_knee(replace(log, segments=tuple(segments)))
    assert (gains.stiffness.value, gains.damping.value) == pytest.approx((21.0, 0.5), rel=5e-3)


def test_nominal_gains_are_those_of_the_log() -> None:
    log = knee_log((21.0, 0.5))
    stated = replace(log, stiffness=np.array([21.0]), damping=np.array([0.5]))
    assert matched_knee(stated).quality.nominal_error_db < 0.1


def test_logs_of_different_drive_gains_are_refused() -> None:
    """One pair of simulated gains cannot stand for two drives."""
    soft = knee_log((17.0, 0.4))
    stiff = knee_log((30.0, 0.6))
    stiff = replace(stiff, stiffness=np.array([30.0]), damping=np.array([0.6]))
    for mode in ("gains", "drive"):
        with pytest.raises(LogError, match=r"FR_knee.*30.*17.*one at a time"):
            match([soft, stiff], ROBOT, mode=mode)  # type: ignore[arg-type]


SOFT = (5.0, 0.1)
"""Gains on the drives of a leg's other joints, far below those of the robot's file."""


def log_with_soft_neighbours(joint: str, neighbour_gains: tuple[float, float] = SOFT) -> JointLog:
    """Sweep a joint whose neighbours have other gains than in the robot's file, as the log says."""
    chain = ROBOT.joint(joint).chain
    joints = []
    # A leg is simulated as the one that it mirrors.
    simulated_neighbours = [ROBOT.joint(name).original[0] for name in chain if name != joint]
    for robot_joint in ROBOT.joints:
        if robot_joint.original[0] in simulated_neighbours:
            robot_joint = replace(robot_joint, stiffness=SOFT[0], damping=SOFT[1])
        joints.append(robot_joint)
    log = chirp_log(replace(ROBOT, joints=tuple(joints)), joint, (17.0, 0.4))
    pose = np.array([ROBOT.joint(name).default_position for name in chain])
    still = np.tile(pose, (len(log.time), 1))
    column = chain.index(joint)
    command = still.copy()
    command[:, column] = log.command[:, 0]
    position = still.copy()
    position[:, column] = log.position[:, 0]
    stiffness = np.full(len(chain), neighbour_gains[0])
    stiffness[column] = 17.0
    damping = np.full(len(chain), neighbour_gains[1])
    damping[column] = 0.4
    return replace(
        log,
        joints=chain,
        command=command,
        position=position,
        stiffness=stiffness,
        damping=damping,
        pose=pose,
    )


@pytest.mark.parametrize("joint", ["FR_hip_pitch", "HL_hip_pitch"])
def test_neighbours_are_held_with_the_gains_of_the_log(joint: str) -> None:
    log = log_with_soft_neighbours(joint)
    result = match([log], ROBOT)
    gains = result.gains.joints[joint]
    assert gains.stiffness.value == pytest.approx(17.0, rel=1e-3)
    assert gains.damping.value == pytest.approx(0.4, rel=1e-3)
    assert gains.flags == ()
    (replayed,) = predict(log, ROBOT, result.gains).joints
    assert replayed.rmse_matched < 2e-5


def test_logs_that_contradict_each_other_of_a_neighbour_are_flagged() -> None:
    joint = "FR_hip_pitch"
    logs = [log_with_soft_neighbours(joint), log_with_soft_neighbours(joint, (30.0, 0.5))]
    flags = match(logs, ROBOT).gains.joints[joint].flags
    assert any("FR_knee" in flag and "different gains" in flag for flag in flags)


def test_bad_logs_are_refused() -> None:
    good = knee_log((21.0, 0.5))
    elbow = tuple(replace(segment, joints=("elbow",)) for segment in good.segments)
    steps = tuple(replace(segment, kind="sine_steps") for segment in good.segments)
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
            match(logs, ROBOT, method="paper", settings=COARSE)


def test_settings_that_cannot_work_are_refused() -> None:
    with pytest.raises(PronkError, match=r"grid_points .*expected"):
        MatchSettings(grid_points=2)
    with pytest.raises(PronkError, match=r"coherence_min .*expected"):
        MatchSettings(coherence_min=1.0)
    with pytest.raises(PronkError, match=r"threads .*expected"):
        MatchSettings(threads=0)


# --- Mode drive: damping, armature, friction and delay with the stiffness known ---

DAMPING = 0.33
ARMATURE = 0.0055
FRICTION = 0.3
LATE_S = 0.004


def late_sweep(*amplitudes: float) -> JointLog:
    """Known drive of FR_knee, three repeats an amplitude, 0.2 mrad of noise, 4 ms late."""
    return chirp_log(
        ROBOT,
        "FR_knee",
        (17.0, DAMPING),
        amplitudes,
        repeats=3,
        length_s=12.0,
        noise_rad=2e-4,
        delay_s=LATE_S,
        armature=ARMATURE,
        frictionloss=FRICTION,
    )


def test_the_drive_is_found_again() -> None:
    result = match([late_sweep(0.25, 0.125)], ROBOT, mode="drive")
    gains = result.gains.joints["FR_knee"]
    assert gains.stiffness.value == 17.0
    assert gains.damping.value == pytest.approx(DAMPING, rel=0.02)
    assert gains.armature.value == pytest.approx(ARMATURE, rel=0.02)
    assert gains.frictionloss.value == pytest.approx(FRICTION, rel=0.05)
    assert gains.delay_s.value == pytest.approx(LATE_S, abs=2e-4)
    assert gains.damping.repeat95[0] < gains.damping.value < gains.damping.repeat95[1]
    assert gains.quality.error_db < 0.05 < 0.2 * gains.quality.nominal_error_db
    assert gains.flags == ()


def test_one_amplitude_does_not_tell_all_parameters_of_a_drive_apart() -> None:
    """Stiffness, damping, armature and friction trade against one another in one amplitude."""
    all_parameters = ("stiffness", "damping", "armature", "frictionloss", "delay")
    settings = MatchSettings(fitted=all_parameters)
    with pytest.raises(IdentifiabilityError, match=r"FR_knee.*(stiffness|armature)"):
        match([late_sweep(0.25)], ROBOT, mode="drive", settings=settings)


@pytest.mark.parametrize(
    ("mode", "method", "fitted", "message"),
    [
        ("drive", "time", ("damping", "inertia"), r"inertia.*stiffness"),
        ("gains", "time", ("damping",), "mode drive"),
        ("both", "time", (), "gains or drive"),
        ("gains", "magic", (), "time or paper"),
        ("drive", "paper", (), "leave the method out"),
    ],
)
def test_choices_that_are_not_known_are_refused(
    mode: str, method: str, fitted: tuple[str, ...], message: str
) -> None:
    settings = MatchSettings(fitted=fitted)
    with pytest.raises(PronkError, match=message):
        match([], ROBOT, mode=mode, method=method, settings=settings)  # type: ignore[arg-type]


def test_an_unknown_simulator_is_refused() -> None:
    with pytest.raises(PronkError, match=r"nothing.*mujoco"):
        match([late_sweep(0.25)], ROBOT, "nothing")
