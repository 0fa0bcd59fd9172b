"""The fit in time of one joint: known drives found again, held-out samples, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pronk.errors import IdentifiabilityError, PronkError
from pronk.identify.excitation.signals import Chirp
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.drive_fit import Unidentified, fit_drives, nominal_drives
from pronk.identify.match.match import match
from pronk.identify.match.parameters import DRIVE_MODE, FREE, GAINS_MODE
from pronk.identify.match.recordings import training_samples
from pronk.identify.match.replay import JointReplay
from pronk.identify.match.result import HELD_OUT, NOT_BETTER, DriveFit, held_out_flags
from pronk.identify.match.settings import MatchSettings
from pronk.identify.simulators.load import joint_rigs
from pronk.robots import load_robot
from synthetic_log import Excitation, synthetic_log

ROBOT = load_robot("mini_cheetah")
JOINT = "FR_knee"
MODEL = ROBOT.joint(JOINT).drive
KNOWN = {"stiffness": 21.8, "damping": 0.541, "frictionloss": 3.0 * MODEL.frictionloss}
LATE_S = 0.008
NOISE_RAD = 2e-4


def sweep(amplitudes: tuple[float, ...], repeats: int) -> JointLog:
    """A knee with known gains, three times the model's friction, 8 ms late, 0.2 mrad of noise."""
    excitations = []
    for amplitude in amplitudes:
        offsets = Chirp(length_s=10.0, amplitude=amplitude).samples()
        excitations.append(Excitation(offsets=offsets, repeats=repeats))
    count = repeats * len(amplitudes)
    noise = NOISE_RAD * np.random.default_rng(5).standard_normal((count, 40000))
    log = synthetic_log(ROBOT, JOINT, excitations, **KNOWN, noise=list(noise), delay_s=LATE_S)
    return replace(log, origin=replace(log.origin, source="a.csv"))


def fit(
    log: JointLog,
    parameters: tuple[str, ...] = GAINS_MODE,
    unidentified: Unidentified = "flag",
    nominal: dict[str, float] | None = None,
) -> DriveFit:
    """Fit the knee, from the published drive or with some of its parameters changed."""
    drives = nominal_drives([log], [JOINT], ROBOT)
    drives[JOINT] |= nominal or {}
    with joint_rigs("mujoco", ROBOT) as rigs:
        fits = fit_drives(
            JointReplay(rigs, log.excitations(JOINT)),
            parameters=parameters,
            nominal=drives,
            unidentified=unidentified,
        )
    return fits[JOINT]


@pytest.fixture(scope="module")
def log() -> JointLog:
    return sweep((0.25, 0.125), 2)


@pytest.fixture(scope="module")
def fitted(log: JointLog) -> DriveFit:
    return fit(log)


def assert_known(values: dict[str, float]) -> None:
    assert values["stiffness"] == pytest.approx(KNOWN["stiffness"], rel=0.01)
    assert values["damping"] == pytest.approx(KNOWN["damping"], rel=0.02)
    assert values["frictionloss"] == pytest.approx(KNOWN["frictionloss"], rel=0.03)
    assert values["delay"] == pytest.approx(LATE_S, abs=5e-4)


def test_gains_friction_and_delay_are_found_together(fitted: DriveFit) -> None:
    assert_known(dict(fitted.values))
    assert fitted.settled
    assert fitted.at_bound == ()
    assert fitted.rmse < 2.0 * NOISE_RAD < fitted.nominal_rmse
    assert fitted.amplitude_gains[:, 0] == pytest.approx([0.25, 0.125], rel=1e-3)


@pytest.mark.parametrize("factor", [0.3, 3.0])
def test_a_start_far_from_the_gains_ends_at_the_gains(log: JointLog, factor: float) -> None:
    nominal = {"stiffness": factor * KNOWN["stiffness"], "damping": factor * KNOWN["damping"]}
    assert_known(dict(fit(log, nominal=nominal).values))


def test_gains_that_are_right_already_are_found_from_other_starts_too(log: JointLog) -> None:
    nominal = {**KNOWN, "delay": LATE_S}
    drive = fit(log, nominal=nominal)
    assert_known(dict(drive.values))
    assert drive.rmse == pytest.approx(drive.nominal_rmse, rel=0.02)


def test_magnitude_alone_takes_the_friction_for_gains(log: JointLog, fitted: DriveFit) -> None:
    settings = MatchSettings(grid_points=8, zero_armature=False)
    by_magnitude = match([log], ROBOT, method="paper", settings=settings).gains.joints[JOINT]
    magnitude_error = abs(by_magnitude.damping.value / KNOWN["damping"] - 1.0)
    time_error = abs(fitted.values["damping"] / KNOWN["damping"] - 1.0)
    assert magnitude_error > 5.0 * time_error


def test_total_intervals_hold_the_gains_of_each_amplitude(fitted: DriveFit) -> None:
    for column, name in enumerate(("stiffness", "damping"), 1):
        low, high = fitted.total95[name]
        gains = fitted.amplitude_gains[:, column]
        assert low <= gains.min() < gains.max() <= high
        assert low <= fitted.ci95[name][0] < fitted.ci95[name][1] <= high


def test_the_held_out_repeat_is_met_better_than_with_less_fitting(fitted: DriveFit) -> None:
    errors = fitted.held_out
    assert tuple(errors) == HELD_OUT
    for name in ("nominal", "nominal_delayed", "plain"):
        assert errors["matched"] < 0.5 * errors[name]
    assert errors["matched"] < 5e-4


def test_a_match_that_is_no_better_is_flagged() -> None:
    errors = dict.fromkeys(HELD_OUT, 1e-3)
    assert held_out_flags(errors) == ()
    (flag,) = held_out_flags(errors | {"plain": 0.9e-3})
    assert flag.startswith(NOT_BETTER)


def test_one_chirp_without_repeats_has_intervals_and_held_out_parts() -> None:
    log = sweep((0.25,), 1)
    drive = fit(log)
    stiffness = drive.values["stiffness"]
    low, high = drive.ci95["stiffness"]
    assert stiffness == pytest.approx(KNOWN["stiffness"], rel=0.02)
    assert low < stiffness < high
    assert drive.total95["stiffness"][0] < low
    assert drive.total95["stiffness"][1] > high
    assert drive.held_out["matched"] < 0.5 * drive.held_out["nominal_delayed"]


def test_the_last_repeat_judges_or_every_fourth_part(log: JointLog) -> None:
    with joint_rigs("mujoco", ROBOT) as rigs:
        repeated = JointReplay(rigs, log.excitations(JOINT)).recordings
        once = JointReplay(rigs, sweep((0.25,), 1).excitations(JOINT)).recordings
    commands = [recording.command for recording in repeated]
    assert commands == [0, 0, 1, 1]
    seen = [bool(mask.all()) for mask in training_samples(repeated)]
    assert seen == [True, False, True, False]
    (mask,) = training_samples(once)
    assert mask.mean() == pytest.approx(0.75, abs=0.01)


def test_parameters_that_only_move_together_are_refused(log: JointLog) -> None:
    # The link of the knee is light: all of its drive may be larger by one factor.
    with pytest.raises(IdentifiabilityError, match=r"FR_knee: stiffness.*armature.*payload"):
        fit(log, FREE, "refuse")
    drive = fit(log, DRIVE_MODE, "refuse", {"stiffness": KNOWN["stiffness"]})
    assert drive.values["armature"] == pytest.approx(MODEL.armature, rel=0.03)


def test_unknown_parameters_are_refused(log: JointLog) -> None:
    with pytest.raises(PronkError, match=r"inertia.*stiffness"):
        fit(log, ("damping", "inertia"))
    with pytest.raises(PronkError, match="none"):
        fit(log, ())


def test_gains_of_the_drive_are_required_and_checked(log: JointLog) -> None:
    without_gains = replace(log, stiffness=None, damping=None)
    gains = (25.0, 0.5)
    with pytest.raises(PronkError, match=r"FR_knee.*--drive-gains"):
        match([without_gains], ROBOT)
    with pytest.raises(PronkError, match=r"17 N m/rad.*25"):
        match([log], ROBOT, drive_gains={"knee": gains})
    with pytest.raises(PronkError, match="hip_roll"):
        match([without_gains], ROBOT, drive_gains={"elbow": gains})
