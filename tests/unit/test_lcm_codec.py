"""Bytes to states and commands and back, for both layouts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pronk.errors import HardwareError
from pronk.links.lcm import messages as types
from pronk.links.lcm.codec import (
    CHEETAH,
    KNEE_RATIO,
    WTW,
    Layout,
    clamp_message,
    decode_attitude,
    decode_command,
    decode_joints,
    encode_command,
    encode_state,
    layout_of,
    mode_request,
    read_clamp_message,
    read_mode_request,
    roll_pitch_yaw,
    state_of,
)
from pronk.links.machine import Command, RefusedError, State
from pronk.robots import load_robot

BOTH = pytest.mark.parametrize("layout", [CHEETAH, WTW], ids=["cheetah", "wtw"])
ROBOT = load_robot("mini_cheetah")
DEFAULT = np.array([joint.default_position for joint in ROBOT.joints])


def numbers(count: int, low: float, high: float) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.float64, count, elements=st.floats(low, high, width=32))


def command(position: np.ndarray | float = 0.0, stiffness: np.ndarray | float = 17.0) -> Command:
    return Command(
        position=np.zeros(12) + position,
        stiffness=np.zeros(12) + stiffness,
        damping=np.full(12, 0.4),
    )


def state(**changes: object) -> State:
    values: dict[str, object] = {
        "time": 1.0,
        "sequence": 7,
        "position": DEFAULT,
        "velocity": np.arange(12) / 8,
        "torque": np.arange(12) / 4,
        "gyro": np.array([0.25, -0.5, 1.0]),
        "accelerometer": np.array([0.5, 0.25, 9.75]),
        "bus_voltage": 24.0,
        "orientation": np.array([0.5, -0.5, 0.5, 0.5]),
        "robot_time": 12.5,
    }
    return State(**(values | changes))  # type: ignore[arg-type]


@BOTH
@given(numbers(12, -12.5, 12.5), numbers(12, 0, 200), numbers(12, 0, 5))
def test_commands_come_back(
    layout: Layout, position: np.ndarray, stiffness: np.ndarray, damping: np.ndarray
) -> None:
    sent = Command(position=position, stiffness=stiffness, damping=damping, sequence=3, made=1.5)
    got = decode_command(layout, encode_command(layout, sent))
    for name in ("position", "stiffness", "damping"):
        # The wire has floats of 32 bits; the knee's gains are scaled there and back.
        np.testing.assert_allclose(getattr(got, name), getattr(sent, name), rtol=3e-7, atol=1e-40)
    if layout is WTW:
        assert (got.sequence, got.made) == (3, 1.5)


@BOTH
@given(
    numbers(12, -3, 3), numbers(12, -40, 40), numbers(12, -30, 30), numbers(3, -9, 9),
    numbers(3, -150, 150), numbers(4, -1, 1).filter(lambda q: float(q @ q) > 0.01),
)  # fmt: skip
def test_states_come_back(
    layout: Layout,
    position: np.ndarray,
    velocity: np.ndarray,
    torque: np.ndarray,
    gyro: np.ndarray,
    force: np.ndarray,
    quaternion: np.ndarray,
) -> None:
    orientation = quaternion / np.linalg.norm(quaternion)
    sent = state(
        position=position,
        velocity=velocity,
        torque=torque,
        gyro=gyro,
        accelerometer=force,
        orientation=orientation,
    )
    (one, attitude), (two, joints) = encode_state(layout, sent)
    assert (one, two) == (layout.attitude_channel, layout.joints_channel)
    got = state_of(
        decode_joints(layout, joints), decode_attitude(layout, attitude), time=3.0, sequence=9
    )
    assert (got.time, got.sequence) == (3.0, 9)
    np.testing.assert_array_equal(got.position, position)
    np.testing.assert_array_equal(got.velocity, velocity)
    np.testing.assert_array_equal(got.gyro, gyro)
    np.testing.assert_array_equal(got.accelerometer, force)
    np.testing.assert_allclose(got.orientation, orientation, atol=2e-7)
    measured = layout.torque_kind != "absent"
    np.testing.assert_array_equal(got.torque, torque if measured else np.zeros(12))
    assert got.robot_time == (12.5 if layout is WTW else None)
    assert math.isnan(got.bus_voltage)


def test_the_knees_gains_are_divided_on_the_way_to_the_mini_cheetah() -> None:
    # What rt_spi.cpp forgets: a wire gain acts at the knee as gain / .6429^2 = 2.42 times it.
    data = encode_command(CHEETAH, command(stiffness=17.0))
    fields = types.LEG_CONTROL_COMMAND.decode(data)
    np.testing.assert_allclose(fields["kp_joint"], np.tile([17, 17, 17 * 0.41332], 4), rtol=1e-5)
    np.testing.assert_allclose(fields["kd_joint"], np.tile([0.4, 0.4, 0.4 * 0.41332], 4), rtol=1e-5)
    # And the other way: what a stack that forgets it sends is stiffer at the knee.
    forgot = types.LEG_CONTROL_COMMAND.encode(kp_joint=17.0, kd_joint=0.4)
    got = decode_command(CHEETAH, forgot)
    np.testing.assert_allclose(got.stiffness, np.tile([17, 17, 17 * 2.4195], 4), rtol=1e-4)
    np.testing.assert_allclose(got.damping, np.tile([0.4, 0.4, 0.4 * 2.4195], 4), rtol=1e-4)
    assert math.isclose(KNEE_RATIO, 6 / 9.33, rel_tol=1e-3)


def test_the_bridge_gets_the_gains_as_they_are() -> None:
    fields = types.WTW_PD_TAU_TARGETS.decode(encode_command(WTW, command(stiffness=17.0)))
    np.testing.assert_array_equal(fields["kp"], np.full(12, 17.0))


def test_orders_and_signs_of_the_mini_cheetah() -> None:
    # leg + joint / 8, so that every number says where it belongs.
    marks = np.array([leg + joint / 8 for leg in range(4) for joint in range(3)])
    (_, _), (_, data) = encode_state(CHEETAH, state(position=marks, velocity=-marks))
    fields = types.SPI_DATA.decode(data)
    np.testing.assert_array_equal(fields["q_abad"], [0, 1, 2, 3])
    np.testing.assert_array_equal(fields["q_hip"], [0.125, 1.125, 2.125, 3.125])
    np.testing.assert_array_equal(fields["q_knee"], [0.25, 1.25, 2.25, 3.25])
    np.testing.assert_array_equal(fields["qd_knee"], [-0.25, -1.25, -2.25, -3.25])
    sent = types.LEG_CONTROL_COMMAND.decode(encode_command(CHEETAH, command(DEFAULT)))
    np.testing.assert_allclose(sent["q_des"], np.tile([0, -0.8, 1.6], 4), rtol=1e-6)
    assert ROBOT.joint_names[:4] == ("FR_hip_roll", "FR_hip_pitch", "FR_knee", "FL_hip_roll")


def test_orders_and_signs_of_the_bridge() -> None:
    # The same stance in Unitree's signs: thigh +0.8, calf -1.6; the hips as they are.
    position = np.tile([0.1, -0.8, 1.6], 4)
    sent = types.WTW_PD_TAU_TARGETS.decode(encode_command(WTW, command(position)))
    np.testing.assert_array_equal(sent["q_des"], np.tile([0.1, 0.8, -1.6], 4))
    (_, _), (_, data) = encode_state(WTW, state(position=position))
    fields = types.WTW_LEG_CONTROL_DATA.decode(data)
    np.testing.assert_allclose(fields["q"], np.tile([0.1, 0.8, -1.6], 4), rtol=1e-6)
    np.testing.assert_array_equal(fields["tau_est"][:3], [0.0, -0.25, -0.5])
    assert (fields["id"], fields["timestamp_us"]) == (7, 12_500_000)


def test_a_bridge_that_fills_no_stamps_has_none() -> None:
    got = decode_joints(WTW, types.WTW_LEG_CONTROL_DATA.encode(q=1.0))
    assert got.robot_time is None
    assert got.number is None


def changed(layout: Layout, name: str, value: float, index: int = 5) -> bytes:
    """A good command with one number replaced."""
    fields = layout.command.decode(encode_command(layout, command(DEFAULT))).copy()
    fields[name][index] = value
    return fields.tobytes()


@BOTH
@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("q_des", math.nan, "not finite"),
        ("q_des", math.inf, "not finite"),
        ("q_des", -12.6, "out of range"),
        ("kp", -0.1, "out of range"),
        ("kp", 501.0, "out of range"),
        ("kp", math.nan, "not finite"),
        ("kd", 5.1, "out of range"),
        ("kd", -math.inf, "not finite"),
    ],
)
def test_impossible_commands_are_refused(
    layout: Layout, name: str, value: float, reason: str
) -> None:
    field = f"{name}_joint" if layout is CHEETAH and name != "q_des" else name
    with pytest.raises(RefusedError) as met:
        decode_command(layout, changed(layout, field, value))
    assert met.value.reason == reason


def test_feed_forward_is_refused_where_the_robot_would_obey_it() -> None:
    for name in ("qd_des", "tau_ff"):
        with pytest.raises(RefusedError, match="a speed or a torque"):
            decode_command(WTW, changed(WTW, name, 0.5))
        # The Mini Cheetah's controller does not read these fields.
        got = decode_command(CHEETAH, changed(CHEETAH, name, 0.5))
        np.testing.assert_allclose(got.position, DEFAULT, rtol=1e-6)


@BOTH
def test_impossible_states_are_refused(layout: Layout) -> None:
    (_, _), (_, joints) = encode_state(layout, state(velocity=np.full(12, np.nan)))
    with pytest.raises(RefusedError, match="not finite"):
        decode_joints(layout, joints)
    for orientation, reason in (([0, 0, 0, 0], "quaternion"), ([np.nan, 0, 0, 0], "not finite")):
        (_, attitude), _ = encode_state(layout, state(orientation=np.array(orientation)))
        with pytest.raises(RefusedError) as met:
            decode_attitude(layout, attitude)
        assert met.value.reason == reason


def test_the_other_layouts_command_is_refused() -> None:
    with pytest.raises(RefusedError, match="another layout"):
        decode_command(WTW, encode_command(CHEETAH, command()))
    with pytest.raises(HardwareError, match="no LCM layout 'go2'"):
        layout_of("go2")
    with pytest.raises(HardwareError, match=r"has shape \(6,\)"):
        encode_command(CHEETAH, Command(position=np.zeros(6), stiffness=np.zeros(6),
                                        damping=np.zeros(6)))  # fmt: skip


@pytest.mark.parametrize(
    ("quaternion", "angles"),
    [
        ([1, 0, 0, 0], [0, 0, 0]),
        ([math.cos(0.2), math.sin(0.2), 0, 0], [0.4, 0, 0]),
        ([math.cos(0.2), 0, math.sin(0.2), 0], [0, 0.4, 0]),
        ([math.cos(0.2), 0, 0, math.sin(0.2)], [0, 0, 0.4]),
    ],
)
def test_roll_pitch_yaw(quaternion: list[float], angles: list[float]) -> None:
    np.testing.assert_allclose(roll_pitch_yaw(np.array(quaternion)), angles, atol=1e-12)


def test_control_mode_comes_back() -> None:
    assert read_mode_request(mode_request(0, 5)) == ""
    assert read_mode_request(mode_request(4, 6)) == "locomotion"
    with pytest.raises(RefusedError, match=r"to 7\.0; only control_mode can be set here"):
        read_mode_request(mode_request(7, 6))
    data = types.CONTROL_PARAMETER.decode(mode_request(4, 6))
    # The robot copies the value from memory: a little-endian double.
    assert data["value"].tobytes()[:8] == bytes.fromhex("0000000000001040")
    assert data["name"].tobytes().rstrip(b"\0") == b"control_mode"


@given(st.sets(st.sampled_from(ROBOT.joint_names)), st.integers(0, 2**62))
def test_clamps_come_back(held: set[str], number: int) -> None:
    names = ROBOT.joint_names
    sent = tuple(name for name in names if name in held)
    assert read_clamp_message(names, clamp_message(names, sent, number)) == (number, sent)
