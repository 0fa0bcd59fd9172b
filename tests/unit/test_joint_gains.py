"""Gains of a joint from the fit of its drive: the delay is one that a simulator can have."""

from __future__ import annotations

import math

import pytest

from pronk.identify.match.gains import UNKNOWN, Interval
from pronk.identify.match.result import DriveFit, joint_gains
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")


@pytest.mark.parametrize(
    ("delay_s", "fitted", "expected_s", "expected"),
    [
        (0.004, (0.003, 0.005), 0.004, (0.003, 0.005)),
        (0.001, (-0.001, 0.003), 0.001, (0.0, 0.003)),
        (-0.001, (-0.003, 0.002), 0.0, (0.0, 0.002)),
        (-0.004, (-0.005, -0.003), 0.0, UNKNOWN),
    ],
)
def test_the_delay_of_the_gains_lies_in_its_intervals(
    delay_s: float, fitted: Interval, expected_s: float, expected: Interval
) -> None:
    values = {"stiffness": 17.0, "damping": 0.4, "armature": 0.003, "frictionloss": 0.2}
    fit = DriveFit(
        joint="FR_knee",
        values={**values, "stribeck": 0.0, "delay": delay_s},
        ci95={"delay": fitted},
        total95={"delay": fitted},
    )
    delay = joint_gains(fit, ROBOT).delay_s
    assert delay.value == expected_s
    for interval in (delay.repeat95, delay.total95):
        assert interval == pytest.approx(expected, nan_ok=True)
        low, high = interval
        assert math.isnan(low) or low <= delay.value <= high
