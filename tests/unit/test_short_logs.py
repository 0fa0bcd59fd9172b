"""Logs shorter than a segment of the response, and commands of few frequencies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pronk.errors import IdentifiabilityError, LogError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.match import match
from pronk.identify.match.settings import MatchSettings
from pronk.identify.response.estimate import estimate_response, resolution_note
from pronk.identify.response.response import Estimator
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from tests.fine_joint import JOINT, FineJoint, chirp_at

SERVO = FineJoint(
    stiffness=1.2,
    damping=0.03,
    armature=0.0018,
    mass=0.09,
    inertia=3e-4,
    frictionloss=0.03,
    viscous=0.004,
    delay_s=0.006,
)
"""A servo of 25 g with a light link."""


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotSpec:
    """The servo as it is known before the match: with other gains."""
    wrong = replace(SERVO, stiffness=2.0, damping=0.05)
    return load_robot(str(wrong.write_robot(tmp_path_factory.mktemp("servo"))))


def sweep(length_s: float, rate_hz: float, *, top_hz: float = 6.0, seed: int = 0) -> JointLog:
    """Record a chirp that ends in motion, commanded by the loop that records."""
    sent = np.arange(int(length_s * rate_hz) + 1) / rate_hz
    command = chirp_at(sent, 0.35, length_s=length_s + 0.5, highest_hz=top_hz)
    return SERVO.log(sent, command, rate_hz, noise_rad=1e-3, seed=seed)


@pytest.mark.parametrize(
    ("length_s", "rate_hz"), [(3.0, 50.0), (3.0, 190.0), (6.0, 47.5), (6.0, 188.0), (11.0, 100.0)]
)
def test_gains_of_a_servo_from_a_short_log(
    robot: RobotSpec, length_s: float, rate_hz: float
) -> None:
    gains = match([sweep(length_s, rate_hz)], robot, drive_gains="default").joints[JOINT].gains
    # The explicit law at 5 ms makes a percent of it.
    assert gains.stiffness.value == pytest.approx(1.2, rel=0.02)
    assert gains.damping.value == pytest.approx(0.03, rel=0.03)
    low, high = gains.stiffness.total95
    assert low < 1.2 < high
    low, high = gains.frictionloss.total95
    assert low < SERVO.frictionloss < high


def test_several_short_files_are_one_match(robot: RobotSpec) -> None:
    logs = [sweep(3.0, 100.0, top_hz=3.0 + seed, seed=seed) for seed in range(5)]
    together = match(logs, robot, drive_gains="default").joints[JOINT].gains
    assert together.stiffness.value == pytest.approx(1.2, rel=0.02)
    assert together.damping.value == pytest.approx(0.03, rel=0.03)


@pytest.mark.parametrize("length_s", [2.0, 3.0, 5.0, 7.9, 9.0, 11.9, 12.1, 20.0])
def test_segments_follow_the_length_of_a_log(length_s: float) -> None:
    response = estimate_response(sweep(length_s, 100.0), JOINT)[0]
    assert response.segment_s <= length_s / 1.45
    assert len(response.omega) >= 10
    assert bool(resolution_note(response)) == (response.segment_s < 8.0)


def test_a_chosen_segment_is_kept_or_refused(robot: RobotSpec) -> None:
    log = sweep(6.0, 100.0)
    assert estimate_response(log, JOINT, Estimator(segment_s=2.0))[0].segment_s == 2.0
    too_long = Estimator(segment_s=7.0)
    with pytest.raises(LogError, match="--segment-s"):
        estimate_response(log, JOINT, too_long)
    with pytest.raises(LogError, match="--segment-s"):
        match([log], robot, drive_gains="default", settings=MatchSettings(estimator=too_long))


def test_a_sweep_of_a_part_of_the_band_is_matched(robot: RobotSpec) -> None:
    gains = match([sweep(20.0, 100.0)], robot, drive_gains="default").joints[JOINT].gains
    assert gains.stiffness.value == pytest.approx(1.2, rel=0.02)
    assert not gains.flags


@pytest.mark.parametrize("sines_hz", [(0.32,), (2.0,), (3.1,)])
def test_a_single_sine_is_named(robot: RobotSpec, sines_hz: tuple[float, ...]) -> None:
    sent = np.arange(0.0, 30.0, 0.02)
    command = np.zeros(len(sent))
    for sine_hz in sines_hz:
        command += 0.3 * np.sin(2.0 * np.pi * sine_hz * sent)
    log = SERVO.log(sent, command, 50.0)
    with pytest.raises(IdentifiabilityError) as error:
        match([log], robot, drive_gains="default")
    words = str(error.value)
    for sine_hz in sines_hz:
        assert f"{sine_hz:.2g}" in words
    assert "amplitude" not in words
