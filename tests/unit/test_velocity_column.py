"""The velocity column of a log, compared with the derivative of its position."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pronk.errors import IdentifiabilityError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.velocity import velocity_column, velocity_note
from pronk.identify.match.match import match
from pronk.robots import load_robot
from tests.fine_joint import JOINT, FineJoint, chirp_at


def log_with_velocity(
    *, scale: float = 1.0, delay_s: float = 0.0, rate_hz: float = 200.0, sine_hz: float = 0.0
) -> JointLog:
    """Record a sweep, or a sine, with a velocity that is scaled and late."""
    truth = FineJoint()
    sent = np.arange(0.0, 20.0, 0.02)
    if sine_hz:
        command = 0.3 * np.sin(2.0 * np.pi * sine_hz * sent)
    else:
        command = chirp_at(sent, 0.3, length_s=19.0, highest_hz=12.0)
    log = truth.log(sent, command, rate_hz, noise_rad=1e-3)
    exact = truth.log(sent, command, 1000.0, noise_rad=0.0)
    speed = np.gradient(exact.position[:, 0], exact.time)
    velocity = scale * np.interp(log.time - delay_s, exact.time, speed)
    return replace(log, velocity=velocity[:, None])


@pytest.mark.parametrize("rate_hz", [50.0, 200.0, 500.0])
def test_an_honest_velocity_has_no_note(rate_hz: float) -> None:
    log = log_with_velocity(rate_hz=rate_hz)
    comparison = velocity_column(log, JOINT)
    assert comparison is not None
    assert comparison.usable
    assert not velocity_note(log, JOINT, "log.csv")


@pytest.mark.parametrize(
    ("scale", "delay_s", "sine_hz"),
    [(0.4, 0.0, 0.0), (-1.0, 0.0, 0.0), (9.0, 0.0, 0.0), (1.0, 0.06, 0.0), (-2.5, 0.0, 3.0)],
)
def test_a_wrong_velocity_is_said_with_its_numbers(
    scale: float, delay_s: float, sine_hz: float
) -> None:
    log = log_with_velocity(scale=scale, delay_s=delay_s, sine_hz=sine_hz)
    comparison = velocity_column(log, JOINT)
    assert comparison is not None
    assert not comparison.usable
    assert comparison.scale == pytest.approx(scale, rel=0.05)
    assert comparison.delay_s == pytest.approx(delay_s, abs=0.011)
    assert "not used" in velocity_note(log, JOINT, "log.csv")


def test_a_velocity_of_something_else_is_not_used() -> None:
    log = log_with_velocity()
    other = np.random.default_rng(0).standard_normal(log.position.shape)
    comparison = velocity_column(replace(log, velocity=np.cumsum(other, axis=0)), JOINT)
    assert comparison is not None
    assert not comparison.usable


def test_the_match_says_it_and_gives_the_same_gains(tmp_path: Path) -> None:
    robot = load_robot(str(FineJoint().write_robot(tmp_path)))
    results = []
    for scale in (1.0, 0.4):
        results.append(match([log_with_velocity(scale=scale)], robot, drive_gains="default"))
    right, wrong = results
    assert wrong.joints[JOINT].gains == right.joints[JOINT].gains
    assert not any("velocity" in note for note in right.notes)
    assert any("velocity" in note and "0.4" in note for note in wrong.notes)
    with pytest.raises(IdentifiabilityError, match=r"0\.32 Hz.*velocity column"):
        match([log_with_velocity(scale=0.4, sine_hz=0.32)], robot, drive_gains="default")
