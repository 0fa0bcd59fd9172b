"""LCM: the table of messages against lcm-gen itself, both layouts, states, addresses."""

from __future__ import annotations

import importlib
import math
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from broken_message import some_state
from pronk.errors import HardwareError
from pronk.links.lcm import messages as types
from pronk.links.lcm.codec import (
    CHEETAH,
    WTW,
    Layout,
    StateDecoder,
    clamp_message,
    decode_command,
    encode_command,
    encode_state,
    layout_of,
    mode_request,
    read_clamp_message,
    read_mode_request,
    roll_pitch_yaw,
)
from pronk.links.lcm.link import VIRTUAL_PORT, multicast_interface, url_of
from pronk.links.lcm.messages import MESSAGES, SPI_DATA, Message
from pronk.links.machine import Command, RefusedError, State
from pronk.robots import load_robot

BOTH = pytest.mark.parametrize("layout", [CHEETAH, WTW], ids=["cheetah", "wtw"])
ROBOT = load_robot("mini_cheetah")
DEFAULT = np.array([joint.default_position for joint in ROBOT.joints])

# Fingerprints and lengths as lcm-gen 1.5.3 gave them for the two stacks' own .lcm files.
KNOWN = {
    "cheetah.leg_control_command_lcmt": (0x277F792B531376CF, 488),
    "cheetah.microstrain_lcmt": (0xE21531EA1392FAAA, 76),
    "cheetah.spi_data_t": (0x3A5F506B524D7E4F, 124),
    "cheetah.control_parameter_request_lcmt": (0xD04FD3ECA4A52D73, 146),
    "wtw.leg_control_data_lcmt": (0x5352516A697F890F, 272),
    "wtw.pd_tau_targets_lcmt": (0xDB10251DE2523982, 544),
    "wtw.state_estimator_lcmt": (0xD50F90505DFFCB6D, 160),
}


def class_name(message: Message) -> str:
    return message.name.replace(".", "_")


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ModuleType]:
    """What lcm-gen makes of the same fields, as a package with one class per message."""
    pytest.importorskip("lcm")
    folder = tmp_path_factory.mktemp("lcmgen")
    source = "package made;\n" + "".join(
        f"struct {class_name(message)} {{ {message.layout}; }}\n" for message in MESSAGES
    )
    (folder / "all.lcm").write_text(source, encoding="ascii")
    tool = Path(sys.executable).with_name("lcm-gen")
    subprocess.run([tool, "-p", "--ppath", folder, folder / "all.lcm"], check=True)
    sys.path.insert(0, str(folder))
    try:
        yield importlib.import_module("made")
    finally:
        sys.path.remove(str(folder))


def test_every_message_of_both_stacks_is_in_the_table() -> None:
    stacks = {m.name: (m.fingerprint, m.size) for m in MESSAGES if m.name[:6] != "pronk."}
    assert stacks == KNOWN


@pytest.mark.parametrize("message", MESSAGES, ids=class_name)
def test_bytes_are_those_of_lcm_gen(message: Message, generated: ModuleType) -> None:
    other = getattr(generated, class_name(message))()
    rng = np.random.default_rng(len(message.name))
    names = (message.dtype.names or ())[1:]
    values = {name: rng.integers(-100, 100, message.dtype[name].shape) for name in names}
    for name, value in values.items():
        setattr(other, name, value.tolist())
    golden = other.encode()
    assert message.encode(**values) == golden
    decoded = message.decode(golden)
    for name, value in values.items():
        np.testing.assert_array_equal(decoded[name], value)


def test_golden_bytes() -> None:
    # Written out by hand: fingerprint, then big-endian floats and integers, nothing between.
    data = SPI_DATA.encode(q_abad=1.0, qd_knee=-2.0, flags=[1, 0, 0, 2], spi_driver_status=-1)
    assert data.hex() == (
        "3a5f506b524d7e4f"
        + "3f800000" * 4
        + "00000000" * 16
        + "c0000000" * 4
        + "00000001000000000000000000000002"
        + "ffffffff"
    )


@pytest.mark.parametrize("layout", ["float q[4]; float w[3]; float b[3]", "float32 q"])
def test_a_wrong_table_is_refused(layout: str) -> None:
    with pytest.raises(HardwareError, match="vectornav_lcmt"):
        Message("cheetah.vectornav_lcmt", 0xEAF20DBD97EFD7B9, layout)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "fingerprint"),
        (b"\x3a", "fingerprint"),
        (bytes(124), "fingerprint"),
        (types.WTW_LEG_CONTROL_DATA.encode(), "fingerprint"),
        (SPI_DATA.encode()[:-1], "length"),
        (SPI_DATA.encode() + b"\0", "length"),
    ],
)
def test_what_is_not_a_message_is_refused(data: bytes, reason: str) -> None:
    with pytest.raises(RefusedError) as met:
        SPI_DATA.decode(data)
    assert met.value.reason == reason


# --- commands -----------------------------------------------------------------------------------


def numbers(count: int, low: float, high: float) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.float64, count, elements=st.floats(low, high, width=32))


def command(position: np.ndarray | float = 0.0) -> Command:
    ones = np.ones(12)
    return Command(position=position * ones, stiffness=17.0 * ones, damping=0.4 * ones)


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


def test_the_knees_gains_are_divided_on_the_way_to_the_mini_cheetah() -> None:
    # What rt_spi.cpp forgets: a wire gain acts at the knee as gain / .6429^2 = 2.42 times it.
    fields = types.LEG_CONTROL_COMMAND.decode(encode_command(CHEETAH, command()))
    np.testing.assert_allclose(fields["kp_joint"], np.tile([17, 17, 17 * 0.41332], 4), rtol=1e-5)
    np.testing.assert_allclose(fields["kd_joint"], np.tile([0.4, 0.4, 0.4 * 0.41332], 4), rtol=1e-5)
    # And the other way: what a stack that forgets it sends is stiffer at the knee.
    forgot = types.LEG_CONTROL_COMMAND.encode(kp_joint=17.0, kd_joint=0.4)
    got = decode_command(CHEETAH, forgot)
    np.testing.assert_allclose(got.stiffness, np.tile([17, 17, 17 * 2.4195], 4), rtol=1e-4)
    bridge = types.WTW_PD_TAU_TARGETS.decode(encode_command(WTW, command()))
    np.testing.assert_array_equal(bridge["kp"], np.full(12, 17.0))


@BOTH
@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("q_des", math.nan, "not finite"),
        ("q_des", -12.6, "out of range"),
        ("kp", -0.1, "out of range"),
        ("kp", 501.0, "out of range"),
        ("kd", 5.1, "out of range"),
        ("kd", -math.inf, "not finite"),
        ("tau_ff", 0.5, "feed-forward"),
        ("qd_des", 0.5, "feed-forward"),
    ],
)
def test_impossible_commands_are_refused(
    layout: Layout, name: str, value: float, reason: str
) -> None:
    fields = layout.command.decode(encode_command(layout, command(DEFAULT))).copy()
    fields[f"{name}_joint" if layout is CHEETAH and name in ("kp", "kd") else name][5] = value
    if layout is CHEETAH and reason == "feed-forward":
        # The Mini Cheetah's controller does not read these fields.
        decode_command(layout, fields.tobytes())
        return
    with pytest.raises(RefusedError) as met:
        decode_command(layout, fields.tobytes())
    assert met.value.reason == reason


def test_other_layouts_and_other_shapes_are_refused() -> None:
    with pytest.raises(HardwareError, match="go2"):
        layout_of("go2")
    with pytest.raises(HardwareError, match=r"\(6,\)"):
        encode_command(CHEETAH, replace(command(), position=np.zeros(6)))


# --- states -------------------------------------------------------------------------------------


def take(decoder: StateDecoder, layout: Layout, state: State, now: float = 0.0) -> State | None:
    (_, attitude), (_, joints) = encode_state(layout, state)
    decoder.attitude(attitude, now)
    return decoder.joints(joints, now)


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
    accelerometer: np.ndarray,
    quaternion: np.ndarray,
) -> None:
    orientation = quaternion / np.linalg.norm(quaternion)
    exact = {
        "position": position, "velocity": velocity, "gyro": gyro, "accelerometer": accelerometer
    }  # fmt: skip
    sent = some_state(torque=torque, orientation=orientation, **exact)
    got = take(StateDecoder(layout, Counter()), layout, sent, 3.0)
    assert got is not None
    assert (got.time, got.sequence) == (3.0, 0)
    for name, value in exact.items():
        np.testing.assert_array_equal(getattr(got, name), value)
    np.testing.assert_allclose(got.orientation, orientation, atol=2e-7)
    measured = layout.torque_kind != "absent"
    np.testing.assert_array_equal(got.torque, torque if measured else np.zeros(12))
    assert got.robot_time == (12.5 if layout is WTW else None)
    assert math.isnan(got.bus_voltage)


def test_orders_and_signs() -> None:
    # leg + joint / 8, so that every number says where it belongs.
    marks = np.array([leg + joint / 8 for leg in range(4) for joint in range(3)])
    _, (_, data) = encode_state(CHEETAH, some_state(position=marks, velocity=-marks))
    fields = SPI_DATA.decode(data)
    np.testing.assert_array_equal(fields["q_abad"], [0, 1, 2, 3])
    np.testing.assert_array_equal(fields["q_hip"], [0.125, 1.125, 2.125, 3.125])
    np.testing.assert_array_equal(fields["qd_knee"], [-0.25, -1.25, -2.25, -3.25])
    sent = types.LEG_CONTROL_COMMAND.decode(encode_command(CHEETAH, command(DEFAULT)))
    np.testing.assert_allclose(sent["q_des"], np.tile([0, -0.8, 1.6], 4), rtol=1e-6)
    # The same stance in Unitree's signs: thigh +0.8, calf -1.6; the hips as they are.
    stance, unitree = np.tile([0.1, -0.8, 1.6], 4), np.tile([0.1, 0.8, -1.6], 4)
    sent = types.WTW_PD_TAU_TARGETS.decode(encode_command(WTW, command(stance)))
    np.testing.assert_array_equal(sent["q_des"], unitree)
    _, (_, data) = encode_state(WTW, some_state(position=stance))
    fields = types.WTW_LEG_CONTROL_DATA.decode(data)
    np.testing.assert_allclose(fields["q"], unitree, rtol=1e-6)
    np.testing.assert_array_equal(fields["tau_est"][:3], [0.0, -0.25, -0.5])
    assert (fields["id"], fields["timestamp_us"]) == (7, 12_500_000)


@BOTH
@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"velocity": np.full(12, np.nan)}, "not finite"),
        ({"orientation": np.zeros(4)}, "quaternion"),
        ({"orientation": np.array([np.nan, 0, 0, 0])}, "not finite"),
        ({"gyro": np.full(3, 36.0)}, "out of range"),
    ],
)
def test_impossible_states_are_refused(
    layout: Layout, changes: dict[str, np.ndarray], reason: str
) -> None:
    with pytest.raises(RefusedError) as met:
        take(StateDecoder(layout, Counter()), layout, some_state(**changes))
    assert met.value.reason == reason


def shaken(k: int, **changes: int) -> State:
    return some_state(**{"sequence": 10 + k, "gyro": np.full(3, 1e-3 * (k % 97))} | changes)


@pytest.mark.parametrize(
    ("layout", "arrived", "expected", "late"),
    [
        (WTW, (0, 1, 5), [0, 1, 5], 0),
        (CHEETAH, (0, 1, 5), [0, 1, 2], 0),
        (WTW, (0, 2, 1, 2, 3), [0, 2, 3], 2),
        # A robot that was started again counts from the beginning, and a broken count is no count.
        (WTW, (0, 10**9, 1), [0, 1, 2], 0),
    ],
    ids=["lost", "lost, not counted", "late and double", "started again"],
)
def test_states_are_numbered_by_the_robots_count(
    layout: Layout, arrived: tuple[int, ...], expected: list[int], late: int
) -> None:
    decoder = StateDecoder(layout, Counter())
    states = [take(decoder, layout, shaken(k)) for k in arrived]
    assert [state.sequence for state in states if state is not None] == expected
    assert decoder.counts["out of order"] == late


@BOTH
def test_frozen_values_make_no_states_however_their_count_lives(layout: Layout) -> None:
    decoder = StateDecoder(layout, Counter())
    made = [take(decoder, layout, some_state(sequence=10 + k)) for k in range(50)]
    assert [state is None for state in made] == [False] + [True] * 49
    assert decoder.counts == {"repeated": 49}
    assert take(decoder, layout, shaken(60)) is not None


def test_joints_without_a_young_attitude_make_no_state() -> None:
    decoder = StateDecoder(CHEETAH, Counter())
    (_, attitude), (_, joints) = encode_state(CHEETAH, some_state())
    assert decoder.joints(joints, 0.0) is None
    decoder.attitude(attitude, 1.0)
    assert decoder.joints(joints, 1.03) is None
    assert decoder.counts == {"no attitude": 2}
    assert decoder.joints(joints, 1.01) is not None


def test_a_bridge_that_fills_no_stamps_has_none() -> None:
    decoder = StateDecoder(WTW, Counter())
    (_, attitude), _ = encode_state(WTW, some_state())
    decoder.attitude(attitude, 0.0)
    states = [decoder.joints(types.WTW_LEG_CONTROL_DATA.encode(q=k), 0.0) for k in (1.0, 1.5)]
    assert [s and (s.sequence, s.robot_time) for s in states] == [(0, None), (1, None)]


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


# --- requests and addresses ---------------------------------------------------------------------


def test_control_mode_comes_back() -> None:
    assert read_mode_request(mode_request(0, 5)) == ""
    assert read_mode_request(mode_request(4, 6)) == "locomotion"
    with pytest.raises(RefusedError, match="control_mode"):
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


TABLE = """Iface	Destination	Gateway 	Flags	RefCnt	Use	Metric	Mask		MTU	Window	IRTT
eth0	00000000	010200C0	0003	0	0	0	00000000	0	0	0
eth0	000200C0	00000000	0001	0	0	0	00FFFFFF	0	0	0
"""
LAN = "wlan0	000000E0	00000000	0001	0	0	0	000000F0	0	0	0\n"
HOST = "robot	434CFFEF	00000000	0005	0	0	0	FFFFFFFF	0	0	0\n"


def test_the_interface_by_which_multicast_leaves() -> None:
    assert multicast_interface(TABLE) == "eth0"
    assert multicast_interface(TABLE + LAN) == "wlan0"
    assert multicast_interface(TABLE + HOST + LAN) == "robot"
    assert multicast_interface(TABLE.splitlines()[0]) is None


def test_nothing_leaves_this_computer_unless_an_interface_is_named() -> None:
    assert url_of() == f"udpm://239.255.76.67:{VIRTUAL_PORT}?ttl=0"
    assert url_of(port=9000).endswith(":9000?ttl=0")
    assert url_of(interface="lo") == "udpm://239.255.76.67:7667?ttl=0"
    for port, interface, words in ((7667, None, "7667"), (80, None, "80"), (None, "no0", "no0")):
        with pytest.raises(HardwareError, match=words):
            url_of(port=port, interface=interface)
