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

from pronk.actuator import model as drive
from pronk.robots import load_robot

HIP = {"gear_ratio": 6.0, "torque_constant": 0.05, "bus_voltage": 24.0}
LINE = (62.428, 40.0, 17.0)


def test_stall_torque_and_no_load_speed_by_hand() -> None:
    assert drive.stall_torque(**HIP, resistance=0.173) == pytest.approx(10.8 / 0.173)
    assert drive.no_load_speed(**HIP) == pytest.approx(40.0)
    knee = {**HIP, "gear_ratio": 9.33}
    assert drive.stall_torque(**knee, resistance=0.173) == pytest.approx(97.08, abs=0.01)
    assert drive.no_load_speed(**knee) == pytest.approx(25.72, abs=0.01)


def test_brushed_motor_has_unit_factors() -> None:
    servo = {"gear_ratio": 1.0, "torque_constant": 1.2116, "bus_voltage": 7.4}
    stall = drive.stall_torque(**servo, resistance=2.6762, torque_factor=1.0)
    assert stall == pytest.approx(3.3502, abs=1e-4)
    assert drive.no_load_speed(**servo, emf_factor=1.0) == pytest.approx(6.1076, abs=1e-4)


@pytest.mark.parametrize("name", ["mini_cheetah", "so101"])
def test_robot_constants_follow_from_the_motor(name: str) -> None:
    three_phase = name == "mini_cheetah"
    for joint in load_robot(name).joints:
        d = joint.drive
        motor = {
            "gear_ratio": d.gear_ratio,
            "torque_constant": d.torque_constant,
            "bus_voltage": d.bus_voltage,
        }
        stall = drive.stall_torque(
            **motor, resistance=d.resistance, torque_factor=1.5 if three_phase else 1.0
        )
        free = drive.no_load_speed(**motor, emf_factor=2.0 if three_phase else 1.0)
        assert d.stall_torque == pytest.approx(stall)
        assert d.no_load_speed == pytest.approx(free)


def test_pd_torque_by_hand() -> None:
    torque = drive.pd_torque(0.25, [0.0, 0.25], [0.0, 2.0], stiffness=17.0, damping=0.4)
    np.testing.assert_allclose(torque, [4.25, -0.8])


def test_limits_at_stall_corner_no_load_and_beyond() -> None:
    corner = 40.0 * (1.0 - 17.0 / 62.428)
    assert corner == pytest.approx(29.107, abs=1e-3)
    speed = np.array([0.0, corner, 35.0, 40.0, 42.0, 60.0])
    low, high = drive.torque_limits(speed, *LINE)
    # 62.428 * (1 - 35/40) = 7.8035; at 42: -3.1214; at 60: -31.2, held at the effort limit.
    np.testing.assert_allclose(high, [17.0, 17.0, 7.8035, 0.0, -3.1214, -17.0], atol=1e-9)
    np.testing.assert_allclose(low, -17.0)


def test_effort_limit_above_stall_is_never_reached() -> None:
    _, high = drive.torque_limits(0.0, 3.0, 6.0, 4.0)
    assert high == 3.0


@given(
    speed=st.floats(-100.0, 100.0),
    torque=st.floats(-100.0, 100.0),
)
def test_clip_is_odd_bounded_and_idempotent(speed: float, torque: float) -> None:
    out = drive.clip_torque(torque, speed, *LINE)
    assert abs(out) <= 17.0
    assert drive.clip_torque(-torque, -speed, *LINE) == -out
    assert drive.clip_torque(out, speed, *LINE) == out


def test_motor_constants_give_the_torque_line() -> None:
    constant, resistance = drive.motor_constants(
        stall_torque=62.428, no_load_speed=40.0, bus_voltage=24.0
    )
    speed = np.linspace(29.2, 40.0, 7)
    _, high = drive.torque_limits(speed, *LINE)
    np.testing.assert_allclose(high, constant * (24.0 - constant * speed) / resistance, atol=1e-12)


POWER = {**HIP, "stall_torque": 10.8 / 0.173}


def test_winding_loss_is_three_phase_copper_loss() -> None:
    # 17 N m at the hip: i = 17 / (1.5 * 6 * .05) = 37.78 A peak; 1.5 * .173 * i^2 = 370.3 W.
    assert drive.winding_loss(17.0, **POWER) == pytest.approx(1.5 * 0.173 * (17.0 / 0.45) ** 2)
    assert drive.winding_loss(17.0, **POWER) == pytest.approx(370.3, abs=0.1)


def test_winding_loss_of_a_brushed_motor_at_stall_is_v_squared_over_r() -> None:
    d = load_robot("so101").joints[0].drive
    loss = drive.winding_loss(
        d.stall_torque,
        gear_ratio=d.gear_ratio,
        torque_constant=d.torque_constant,
        stall_torque=d.stall_torque,
        bus_voltage=d.bus_voltage,
    )
    assert loss == pytest.approx(7.4**2 / 2.6762)


def test_power_motoring_and_regenerating() -> None:
    # 5 N m: loss 1.5 * .173 * (5 / .45)^2 = 32.04 W; 10 rad/s: 50 W of mechanical power.
    power = drive.electrical_power([5.0, 5.0, 5.0], [10.0, -10.0, 0.0], **POWER)
    np.testing.assert_allclose(power, [82.04, -17.96, 32.04], atol=0.01)
    np.testing.assert_allclose(drive.bus_current(power, 24.0), power / 24.0)
    assert drive.bus_current(-17.96, 24.0) == pytest.approx(-0.748, abs=1e-3)


def test_slow_braking_still_draws_power() -> None:
    # Below loss / torque = 6.41 rad/s braking heats the winding more than the joint gives.
    slow, fast = drive.electrical_power(5.0, np.array([-6.0, -7.0]), **POWER)
    assert slow > 0.0 > fast
