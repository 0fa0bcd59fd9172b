"""The fit in time: known drives found again, what is kept aside, gains that were on the drive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pronk.errors import PronkError
from pronk.identify.excitation.signals import Chirp
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.gains import load_gains, save_gains
from pronk.identify.match.match import match
from pronk.identify.match.result import HELD_OUT, NOT_BETTER, MatchResult, held_out_flags
from pronk.identify.match.settings import MatchSettings
from pronk.robots import load_robot
from synthetic_log import Excitation, synthetic_log

ROBOT = load_robot("mini_cheetah")
MODEL = ROBOT.joint("FR_knee").drive
KNOWN = {"stiffness": 21.8, "damping": 0.541, "frictionloss": 3.0 * MODEL.frictionloss}
LATE_S = 0.008


def sweep(amplitudes: tuple[float, ...], repeats: int) -> JointLog:
    """A knee with known gains, three times the model's friction, 8 ms late, 0.2 mrad of noise."""
    signals = [Chirp(length_s=10.0, amplitude=a).samples() for a in amplitudes]
    excitations = [Excitation(offsets=one, repeats=repeats) for one in signals]
    noise = 2e-4 * np.random.default_rng(5).standard_normal((repeats * len(signals), 40000))
    log = synthetic_log(ROBOT, "FR_knee", excitations, **KNOWN, noise=list(noise), delay_s=LATE_S)
    return replace(log, origin=replace(log.origin, source="a.csv"))


@pytest.fixture(scope="module")
def log() -> JointLog:
    return sweep((0.25, 0.125), 2)


@pytest.fixture(scope="module")
def matched(log: JointLog) -> MatchResult:
    return match([log], ROBOT)


def test_gains_friction_and_delay_are_found_together(matched: MatchResult, tmp_path: Path) -> None:
    save_gains(tmp_path / "gains.yaml", matched.gains)
    kept, own = load_gains(tmp_path / "gains.yaml"), matched.gains.joints["FR_knee"]
    found = kept.joints["FR_knee"]
    assert found.stiffness.value == pytest.approx(KNOWN["stiffness"], rel=0.01)
    assert found.damping.value == pytest.approx(KNOWN["damping"], rel=0.02)
    assert found.frictionloss.value == pytest.approx(KNOWN["frictionloss"], rel=0.03)
    assert found.delay_s.value == pytest.approx(LATE_S, abs=5e-4)
    assert found.stiffness.total95 == pytest.approx(own.stiffness.total95, rel=1e-5)
    assert kept.groups["knee"].frictionloss == found.frictionloss.value
    assert any(flag.startswith("friction: ") for flag in found.flags)


def test_magnitude_alone_takes_the_friction_for_gains(log: JointLog, matched: MatchResult) -> None:
    settings = MatchSettings(grid_points=8, zero_armature=False)
    by_magnitude = match([log], ROBOT, method="paper", settings=settings).gains.joints["FR_knee"]
    in_time = matched.gains.joints["FR_knee"]
    magnitude_error = abs(by_magnitude.damping.value / KNOWN["damping"] - 1.0)
    time_error = abs(in_time.damping.value / KNOWN["damping"] - 1.0)
    assert magnitude_error > 5.0 * time_error


def test_total_intervals_hold_the_gains_of_each_amplitude(matched: MatchResult) -> None:
    fit = matched.joints["FR_knee"].fit
    for column, name in enumerate(("stiffness", "damping"), 1):
        (low, high), own = fit.total95[name], fit.amplitude_gains[:, column]
        assert low <= own.min() < own.max() <= high
        assert low <= fit.ci95[name][0] < fit.ci95[name][1] <= high


def test_the_repeat_that_was_kept_aside_is_met_better_than_with_less_fitting(
    matched: MatchResult,
) -> None:
    errors = matched.joints["FR_knee"].fit.held_out
    assert errors["matched"] < min(5e-4, *(0.5 * errors[name] for name in HELD_OUT[:-1]))
    alike = dict.fromkeys(HELD_OUT, 1e-3)
    assert held_out_flags(alike) == ()
    (flag,) = held_out_flags(alike | {"plain": 0.9e-3})
    assert flag.startswith(NOT_BETTER)


def test_one_chirp_without_repeats_has_intervals_and_a_part_kept_aside() -> None:
    log = sweep((0.25,), 1)
    fit = match([log], ROBOT).joints["FR_knee"].fit
    stiffness = fit.values["stiffness"]
    assert stiffness == pytest.approx(KNOWN["stiffness"], rel=0.02)
    assert fit.ci95["stiffness"][0] < stiffness < fit.ci95["stiffness"][1]
    assert fit.held_out["matched"] < 0.5 * fit.held_out["nominal_delayed"]


def test_gains_of_the_drive_are_required_and_checked(log: JointLog) -> None:
    bare, gains = replace(log, stiffness=None, damping=None), (25.0, 0.5)
    for one, given, words in (
        (bare, None, r"FR_knee.*--drive-gains"),
        (log, {"knee": gains}, r"17 N m/rad.*25"),
        (bare, {"elbow": gains}, "hip_roll"),
    ):
        with pytest.raises(PronkError, match=words):
            match([one], ROBOT, drive_gains=given)
