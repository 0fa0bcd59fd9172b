"""Drive physics against points worked out by hand.

The reference motor is the Mini Cheetah's hip: kt .05, R .173, 24 V behind 6:1. By hand:
stall 1.5 * 6 * .05 * 24 / .173 = 10.8 / .173 = 62.428 N m; no load 24 / (2 * 6 * .05) = 40 rad/s;
corner for 17 N m at 40 (1 - 17 / 62.428) = 29.107 rad/s.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pronk.robots import load_robot
from pronk.robots import motor as drive
from pronk.robots.load import DriveEntry

LINE = (62.428, 40.0, 17.0)
POWER = {
    "gear_ratio": 6.0,
    "torque_constant": 0.05,
    "bus_voltage": 24.0,
    "stall_torque": 10.8 / 0.173,
}


@pytest.mark.parametrize(
    ("motor", "phases", "stall", "free"),
    [
        ((6.0, 0.05, 24.0, 0.173), 3, 62.428, 40.0),
        ((9.33, 0.05, 24.0, 0.173), 3, 97.08, 25.72),
        ((1.0, 1.2116, 7.4, 2.6762), 1, 3.3502, 6.1076),  # brushed
    ],
)
def test_stall_torque_and_no_load_speed_by_hand(
    motor: tuple[float, float, float, float], phases: int, stall: float, free: float
) -> None:
    gear_ratio, torque_constant, bus_voltage, resistance = motor
    from_motor = DriveEntry(
        effort_limit=17.0,
        phases=phases,
        gear_ratio=gear_ratio,
        torque_constant=torque_constant,
        bus_voltage=bus_voltage,
        resistance=resistance,
    ).drive("")
    assert from_motor.stall_torque == pytest.approx(stall, rel=2e-4)
    assert from_motor.no_load_speed == pytest.approx(free, rel=2e-4)
    from_line = DriveEntry(
        effort_limit=17.0,
        phases=phases,
        gear_ratio=gear_ratio,
        bus_voltage=bus_voltage,
        stall_torque=from_motor.stall_torque,
        no_load_speed=from_motor.no_load_speed,
    ).drive("")
    assert from_line.torque_constant == pytest.approx(torque_constant)
    assert from_line.resistance == pytest.approx(resistance)


def test_limits_at_stall_corner_no_load_and_beyond() -> None:
    speed = np.array([0.0, 29.107, 35.0, 40.0, 42.0, 60.0])
    low, high = drive.torque_limits(speed, *LINE)
    # 62.428 * (1 - 35/40) = 7.8035; at 42: -3.1214; at 60: -31.2, held at the effort limit.
    np.testing.assert_allclose(high, [17.0, 17.0, 7.8035, 0.0, -3.1214, -17.0], atol=1e-3)
    np.testing.assert_allclose(low, -17.0)
    # An effort limit above stall is never reached.
    assert drive.torque_limits(0.0, 3.0, 6.0, 4.0)[1] == 3.0
    hip = load_robot("mini_cheetah").joint("FR_hip_pitch").drive
    constant, resistance = hip.motor
    line = constant * (24.0 - constant * speed[2:5]) / resistance
    high = drive.torque_limits(speed, hip.stall_torque, hip.no_load_speed, hip.effort_limit)[1]
    np.testing.assert_allclose(high[2:5], line, atol=1e-12)


@given(speed=st.floats(-100.0, 100.0))
def test_limits_are_odd_and_bounded(speed: float) -> None:
    low, high = drive.torque_limits(speed, *LINE)
    assert -17.0 <= low <= high <= 17.0
    assert drive.torque_limits(-speed, *LINE) == (-high, -low)


def test_winding_loss_and_power_of_motoring_and_regenerating() -> None:
    # A brushed motor at stall: V^2 / R.
    servo = load_robot("so101").joints[0].drive
    loss = drive.winding_loss(
        servo.stall_torque,
        gear_ratio=servo.gear_ratio,
        torque_constant=servo.torque_constant,
        bus_voltage=servo.bus_voltage,
        stall_torque=servo.stall_torque,
    )
    assert loss == pytest.approx(7.4**2 / 2.6762)
    # 5 N m at the hip: i = 5 / (1.5 * 6 * .05), 1.5 * .173 * i^2 = 32.04 W; 10 rad/s: 50 W more.
    power = drive.electrical_power([5.0, 5.0, 5.0, 5.0], [10.0, -10.0, 0.0, -6.0], **POWER)
    # Below loss / torque = 6.41 rad/s braking heats the winding more than the joint gives.
    np.testing.assert_allclose(power, [82.04, -17.96, 32.04, 2.04], atol=0.01)
