"""Gains, friction and delay of one joint, commanded at many rates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pronk.identify.match.match import match
from pronk.robots import load_robot
from tests.fine_joint import JOINT, FineJoint, two_chirps_at

TRUTH = FineJoint()
EQUIVALENT = {"stiffness": 15.70, "damping": 0.374, "frictionloss": 0.084, "delay_s": 6.2e-3}
"""What the joint of 17 N m/rad and 0.4 N m s/rad is in the explicit law at 5 ms, by its log with
commands at 50 Hz, at which each command holds for four whole steps."""


@pytest.mark.parametrize(
    ("rate_hz", "log_hz", "jitter_s"),
    [
        (20.0, 500.0, 0.0),
        (60.0, 476.0, 0.0),
        (75.0, 500.0, 0.0),
        (100.0, 500.0, 0.0),
        (150.0, 1000.0, 0.0),
        (190.0, 190.0, 0.0),
        (200.0, 1000.0, 0.0),
        (500.0, 500.0, 0.0),
        (50.0, 500.0, 4e-3),
    ],
)
def test_the_rate_of_the_commands_does_not_change_the_match(
    tmp_path: Path, rate_hz: float, log_hz: float, jitter_s: float
) -> None:
    rng = np.random.default_rng(int(rate_hz))
    nominal = np.arange(int(43.0 * rate_hz)) / rate_hz
    sent = nominal + jitter_s * rng.uniform(0.0, 1.0, len(nominal))
    log = TRUTH.log(sent, two_chirps_at(sent), log_hz)
    robot = load_robot(str(TRUTH.write_robot(tmp_path)))
    gains = match([log], robot, drive_gains="default").joints[JOINT].gains
    values = {
        "stiffness": gains.stiffness,
        "damping": gains.damping,
        "frictionloss": gains.frictionloss,
        "delay_s": gains.delay_s,
    }
    within = {"stiffness": 0.012, "damping": 0.012, "frictionloss": 0.1, "delay_s": 0.03}
    for name, truth in EQUIVALENT.items():
        fitted = values[name]
        low, high = fitted.total95
        # The joint itself differs a little with the rate, as the law is not the joint's own.
        slack = within[name] * truth
        assert low - slack < truth < high + slack, (name, fitted)
        if name in ("stiffness", "damping"):
            assert fitted.value == pytest.approx(truth, rel=0.015)
