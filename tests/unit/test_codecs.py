"""Messages of LCM and DDS: layouts against lcm-gen and C, golden bytes, round trips, refusals."""

from __future__ import annotations

import importlib
import math
import struct
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

pytest.importorskip("cyclonedds")

from broken_message import mutated, some_state
from pronk.deploy.links.dds import codec as dds
from pronk.deploy.links.dds.image import (
    HEADER,
    c_image_dtype,
    deserialize_image,
    image_checksum,
    serialize_image,
)
from pronk.deploy.links.dds.messages import LowCmd, LowState
from pronk.deploy.links.lcm import codec as lcm
from pronk.deploy.links.lcm.layouts import (
    CHEETAH,
    KNEE_RATIO,
    WTW,
    LcmLayout,
    find_layout,
    layout_for,
)
from pronk.deploy.links.lcm.messages import (
    CONTROL_PARAMETER,
    LCM_MESSAGES,
    LEG_CONTROL_COMMAND,
    SPI_DATA,
    WTW_LEG_CONTROL_DATA,
    WTW_PD_TAU_TARGETS,
    WTW_STATE_ESTIMATOR,
    LcmMessage,
)
from pronk.errors import HardwareError
from pronk.robots import RobotSpec, load_robot, robot_file_path
from pronk.robots.machine import Command, RefusedError, State

ROBOT = load_robot("mini_cheetah")
JOINTS = dds.joint_map(ROBOT)
StateDecoder = Callable[[tuple[bytes, ...], float], State | None]
POSE = np.array([joint.default_position for joint in ROBOT.joints])
COMMAND = Command(
    position=np.linspace(-1.5, 1.5, 12),
    stiffness=np.linspace(5.0, 20.0, 12),
    damping=np.linspace(0.1, 1.0, 12),
)


class LcmWire:
    """The codec of LCM with a layout; a state is two messages."""

    def __init__(self, layout: LcmLayout) -> None:
        self.layout = layout
        self.name = layout.name
        self.max_position = 12.5  # [rad]
        self.max_stiffness = 500.0 / KNEE_RATIO**2  # [N m/rad]
        self.max_damping = 5.0 / KNEE_RATIO**2  # [N m s/rad]

    def encode(self, command: Command) -> bytes:
        return lcm.encode_lcm_command(self.layout, command)

    def decode(self, data: bytes) -> Command:
        return lcm.decode_lcm_command(self.layout, data)

    def encode_state(self, state: State) -> tuple[bytes, ...]:
        return lcm.encode_lcm_state(self.layout, state)

    def state_decoder(self) -> StateDecoder:
        decoder = lcm.LcmStateDecoder(self.layout, Counter())

        def decode(messages: tuple[bytes, ...], now: float) -> State | None:
            attitude, joints = messages
            decoder.attitude(attitude, now)
            return decoder.joints(joints, now)

        return decode


class DdsWire:
    """The codec of DDS; a state is one message."""

    name = "dds"
    max_position = 4.0 * math.pi  # [rad]
    max_stiffness = 1000.0  # [N m/rad]
    max_damping = 100.0  # [N m s/rad]

    def encode(self, command: Command) -> bytes:
        return dds.encode_dds_command(JOINTS, command)

    def decode(self, data: bytes) -> Command:
        return dds.decode_dds_command(JOINTS, data)

    def encode_state(self, state: State) -> tuple[bytes, ...]:
        return (dds.encode_dds_state(JOINTS, state),)

    def state_decoder(self) -> StateDecoder:
        decoder = dds.DdsStateDecoder(JOINTS, Counter())

        def decode(messages: tuple[bytes, ...], now: float) -> State | None:
            (message,) = messages
            return decoder.take(message, now)

        return decode


Wire = LcmWire | DdsWire
WIRES = (LcmWire(CHEETAH), LcmWire(WTW), DdsWire())
EACH = pytest.mark.parametrize("wire", WIRES, ids=lambda wire: wire.name)


# --- Every wire ---------------------------------------------------------------------------------


def refusal(decode: Callable[[], object]) -> str:
    """Reason for which a message is refused."""
    with pytest.raises(RefusedError) as caught:
        decode()
    return caught.value.reason


def numbers(count: int, low: float, high: float) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.float64, count, elements=st.floats(low, high, width=32))


@EACH
@given(numbers(12, -12, 12), numbers(12, 0, 200), numbers(12, 0, 5))
def test_commands_round_trip(wire: Wire, q: np.ndarray, kp: np.ndarray, kd: np.ndarray) -> None:
    sent = Command(position=q, stiffness=kp, damping=kd, sequence=3, made=1.5)
    got = wire.decode(wire.encode(sent))
    close = {"rtol": 3e-7, "atol": 1e-40}  # numbers of 32 bits
    np.testing.assert_allclose(got.stiffness, kp, **close)
    np.testing.assert_allclose(got.damping, kd, **close)
    # Without stiffness there is no position on DDS.
    np.testing.assert_allclose(got.position[kp > 0.0], q[kp > 0.0], **close)
    assert (got.sequence, got.made) == ((3, 1.5) if wire.name == "wtw" else (0, 0.0))


VALUES = {
    "position": numbers(12, -3, 3),
    "velocity": numbers(12, -40, 40),
    "torque": numbers(12, -30, 30),
    "gyro": numbers(3, -9, 9),
    "accelerometer": numbers(3, -150, 150),
}


@EACH
@given(st.fixed_dictionaries(VALUES), numbers(4, -1, 1).filter(lambda q: float(q @ q) > 0.01))
def test_states_round_trip(
    wire: Wire, values: dict[str, np.ndarray], quaternion: np.ndarray
) -> None:
    orientation = quaternion / np.linalg.norm(quaternion)
    hot = np.arange(30.0, 42.0)
    sent = some_state(**values, orientation=orientation, temperature=hot)
    got = wire.state_decoder()(wire.encode_state(sent), 3.0)
    assert got is not None
    assert (got.time, got.sequence) == (3.0, 0)
    if wire.name == "cheetah":  # which has no torque
        values["torque"] = np.zeros(12)
    for name, value in values.items():
        np.testing.assert_array_equal(getattr(got, name), value)
    np.testing.assert_allclose(got.orientation, orientation, atol=2e-7)
    assert got.robot_time == (None if wire.name == "cheetah" else 12.5)
    if wire.name == "dds":
        assert got.bus_voltage == 24.5
        np.testing.assert_array_equal(got.temperature, hot)
    else:
        assert math.isnan(got.bus_voltage)


@EACH
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("position", np.full(12, math.nan)),
        ("position", np.zeros(6)),
        ("damping", np.full(12, -1.0)),
        ("stiffness", np.full(12, math.inf)),
    ],
)
def test_impossible_commands_are_not_encoded(wire: Wire, name: str, value: np.ndarray) -> None:
    with pytest.raises(HardwareError, match=name):
        wire.encode(replace(COMMAND, **{name: value}))


@EACH
def test_impossible_states_are_refused(wire: Wire) -> None:
    changes: list[tuple[dict[str, Any], str]] = [
        ({"velocity": np.full(12, math.nan)}, "not finite"),
        ({"gyro": np.full(3, math.inf)}, "not finite"),
        ({"orientation": np.zeros(4)}, "quaternion"),
    ]
    if wire.name != "dds":  # has a checksum instead
        changes.append(({"gyro": np.full(3, 36.0)}, "out of range"))
    for change, reason in changes:
        messages = wire.encode_state(some_state(**change))
        assert refusal(partial(wire.state_decoder(), messages, 0.0)) == reason


@EACH
def test_broken_messages_are_refused_or_possible(wire: Wire) -> None:
    intact = wire.encode(COMMAND)
    rng = np.random.default_rng(1)
    refused = 0
    for _ in range(20_000):
        try:
            got = wire.decode(mutated(intact, rng))
        except RefusedError:
            refused += 1
            continue
        # Without a checksum a flipped bit may leave a command that the drives can follow.
        assert np.abs(got.position).max() <= wire.max_position * (1 + 1e-9)
        assert got.stiffness.max() <= wire.max_stiffness * (1 + 1e-9)
        assert got.damping.max() <= wire.max_damping * (1 + 1e-9)
        assert min(got.stiffness.min(), got.damping.min()) >= 0.0
    assert refused > (19_000 if wire.name == "dds" else 10_000)
    decode = wire.state_decoder()
    messages = wire.encode_state(some_state())
    for _ in range(5_000):
        cut = tuple(data[: rng.integers(len(data))] for data in messages)
        with pytest.raises(RefusedError):
            decode(cut, 0.0)
    assert decode(messages, 0.0) is not None


@EACH
def test_state_numbers_follow_the_robots_count(wire: Wire) -> None:
    decode = wire.state_decoder()
    sequences = []
    for t in (0.0, 0.002, 0.01, 0.012):
        state = some_state(robot_time=t, sequence=10 + round(t / 0.002), gyro=np.full(3, t))
        decoded = decode(wire.encode_state(state), t)
        assert decoded is not None
        sequences.append(decoded.sequence)
    assert sequences == ([0, 1, 2, 3] if wire.name == "cheetah" else [0, 1, 5, 6])


# --- LCM ----------------------------------------------------------------------------------------

# Fingerprints and lengths as lcm-gen 1.5.3 gave them for the two stacks' own .lcm files.
KNOWN = {
    "cheetah.leg_control_command_lcmt": (0x277F792B531376CF, 488),
    "cheetah.microstrain_lcmt": (0xE21531EA1392FAAA, 76),
    "cheetah.spi_data_t": (0x3A5F506B524D7E4F, 124),
    "cheetah.control_parameter_request_lcmt": (0xD04FD3ECA4A52D73, 146),
    "wtw.leg_control_data_lcmt": (0x5352516A697F890F, 272),
    "wtw.pd_tau_targets_lcmt": (0xDB10251DE2523982, 544),
    "wtw.state_estimator_lcmt": (0xD50F90505DFFCB6D, 160),
    "pronk.virtual_robot_lcmt": (0x23FC8EF4C8F343CB, 28),
}


def class_name(message: LcmMessage) -> str:
    return message.name.replace(".", "_")


def test_bytes_are_those_of_lcm_gen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("lcm")
    source = "package made;\n"
    for message in LCM_MESSAGES:
        source += f"struct {class_name(message)} {{\n"
        for field in message.fields:
            dimension = "" if field.count is None else f"[{field.count}]"
            source += f"    {field.number} {field.name}{dimension};\n"
        source += "}\n"
    (tmp_path / "all.lcm").write_text(source, encoding="ascii")
    tool = Path(sys.executable).with_name("lcm-gen")
    subprocess.run([tool, "-p", "--ppath", tmp_path, tmp_path / "all.lcm"], check=True)
    monkeypatch.syspath_prepend(tmp_path)
    generated = importlib.import_module("made")
    for message in LCM_MESSAGES:
        assert (message.fingerprint, message.dtype.itemsize) == KNOWN[message.name]
        other = getattr(generated, class_name(message))()
        rng = np.random.default_rng(len(message.name))
        names = (message.dtype.names or ())[1:]
        values = {name: rng.integers(-100, 100, message.dtype[name].shape) for name in names}
        for name, value in values.items():
            setattr(other, name, value.tolist())
        golden = other.encode()
        assert message.encode(values) == golden
        decoded = message.decode(golden)
        for name, value in values.items():
            np.testing.assert_array_equal(decoded[name], value)


def stiff(position: np.ndarray | float = 0.0) -> Command:
    ones = np.ones(12)
    return Command(position=position * ones, stiffness=17.0 * ones, damping=0.4 * ones)


def test_knee_gains_orders_and_signs_on_lcm() -> None:
    # rt_spi.cpp does not convert the knee's gains: a wire gain acts as gain / .6429^2.
    fields = LEG_CONTROL_COMMAND.decode(lcm.encode_lcm_command(CHEETAH, stiff(POSE)))
    np.testing.assert_allclose(fields["kp_joint"], np.tile([17, 17, 17 * 0.41332], 4), rtol=1e-5)
    np.testing.assert_allclose(fields["kd_joint"], np.tile([0.4, 0.4, 0.4 * 0.41332], 4), rtol=1e-5)
    np.testing.assert_allclose(fields["q_des"], np.tile([0, -0.8, 1.6], 4), rtol=1e-6)
    # leg + joint / 8, so that every number identifies its place.
    marks = np.array([leg + joint / 8 for leg in range(4) for joint in range(3)])
    _, data = lcm.encode_lcm_state(CHEETAH, some_state(position=marks, velocity=-marks))
    fields = SPI_DATA.decode(data)
    np.testing.assert_array_equal(fields["q_abad"], [0, 1, 2, 3])
    np.testing.assert_array_equal(fields["q_hip"], [0.125, 1.125, 2.125, 3.125])
    np.testing.assert_array_equal(fields["qd_knee"], [-0.25, -1.25, -2.25, -3.25])
    # The same stance in Unitree's signs: thigh +0.8, calf -1.6; the hips as they are.
    stance = np.tile([0.1, -0.8, 1.6], 4)
    unitree = np.tile([0.1, 0.8, -1.6], 4)
    sent = WTW_PD_TAU_TARGETS.decode(lcm.encode_lcm_command(WTW, stiff(stance)))
    np.testing.assert_array_equal(sent["q_des"], unitree)
    np.testing.assert_array_equal(sent["kp"], np.full(12, 17.0))
    turned = np.array([math.cos(0.2), 0, math.sin(0.2), 0])
    attitude, data = lcm.encode_lcm_state(WTW, some_state(position=stance, orientation=turned))
    fields = WTW_LEG_CONTROL_DATA.decode(data)
    np.testing.assert_allclose(fields["q"], unitree, rtol=1e-6)
    np.testing.assert_array_equal(fields["tau_est"][:3], [0.0, -0.25, -0.5])
    assert (fields["id"], fields["timestamp_us"]) == (7, 12_500_000)
    rpy = WTW_STATE_ESTIMATOR.decode(attitude)["rpy"]
    np.testing.assert_allclose(rpy, [0.0, 0.4, 0.0], atol=1e-6)


@pytest.mark.parametrize("layout", [CHEETAH, WTW], ids=["cheetah", "wtw"])
@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("q_des", math.nan, "not finite"),
        ("q_des", -12.6, "out of range"),
        ("stiffness", -0.1, "out of range"),
        ("stiffness", 501.0, "out of range"),
        ("damping", 5.1, "out of range"),
        ("damping", -math.inf, "not finite"),
        ("tau_ff", 0.5, "feed-forward"),
        ("qd_des", 0.5, "feed-forward"),
    ],
)
def test_impossible_lcm_commands_are_refused(
    layout: LcmLayout, name: str, value: float, reason: str
) -> None:
    fields = layout.command.decode(lcm.encode_lcm_command(layout, stiff(POSE))).copy()
    wire_names = {"stiffness": layout.stiffness_field, "damping": layout.damping_field}
    fields[wire_names.get(name, name)][5] = value
    if layout is CHEETAH and reason == "feed-forward":
        # The Mini Cheetah's controller does not read these fields.
        lcm.decode_lcm_command(layout, fields.tobytes())
    else:
        assert refusal(lambda: lcm.decode_lcm_command(layout, fields.tobytes())) == reason


def test_states_need_a_recent_attitude_and_no_stamps() -> None:
    decoder = lcm.LcmStateDecoder(CHEETAH, Counter())
    attitude, joints = lcm.encode_lcm_state(CHEETAH, some_state())
    assert decoder.joints(joints, 0.0) is None
    decoder.attitude(attitude, 1.0)
    assert decoder.joints(joints, 1.03) is None
    assert decoder.counts == {"no attitude": 2}
    assert decoder.joints(joints, 1.01) is not None
    decoder = lcm.LcmStateDecoder(WTW, Counter())
    decoder.attitude(lcm.encode_lcm_state(WTW, some_state())[0], 0.0)
    states = [decoder.joints(WTW_LEG_CONTROL_DATA.encode({"q": k}), 0.0) for k in (1.0, 1.5)]
    assert [s and (s.sequence, s.robot_time) for s in states] == [(0, None), (1, None)]


def test_control_mode_round_trip() -> None:
    assert lcm.decode_mode_request(lcm.encode_mode_request(0, 5)) == ""
    assert lcm.decode_mode_request(lcm.encode_mode_request(4, 6)) == "locomotion"
    with pytest.raises(RefusedError, match="control_mode"):
        lcm.decode_mode_request(lcm.encode_mode_request(7, 6))
    data = CONTROL_PARAMETER.decode(lcm.encode_mode_request(4, 6))
    # The robot copies the value from memory: a little-endian double.
    assert data["value"].tobytes()[:8] == bytes.fromhex("0000000000001040")
    assert data["name"].tobytes().rstrip(b"\0") == b"control_mode"


def test_clamps_round_trip() -> None:
    names = ROBOT.joint_names
    for clamped, request in ((), 0), (names[::5], 2**62), (names, 7):
        data = lcm.encode_clamps(names, clamped, request)
        assert lcm.decode_clamps(names, data) == (request, clamped)


# --- DDS ----------------------------------------------------------------------------------------

# pack formats of unitree_sdk2_python's C images
C_COMMAND = "<4B4IH2x" + "B3x5f3I" * 20 + "4B" + "55Bx2I"
C_STATE = "<4B4IH2x" + "13fb3x" + "B3x7fb3x3I" * 20 + "4BiH4b15H" + "8hI41B3xf2b2x2f4h2I"
ZEROS = np.zeros(12)
IDLE = dds.encode_dds_command(JOINTS, Command(position=ZEROS, stiffness=ZEROS, damping=ZEROS))


def bitwise_crc(words: bytes) -> int:
    """The textbook loop, a bit at a time."""
    crc = 0xFFFFFFFF
    for (word,) in struct.iter_unpack("<I", words):
        for bit in range(31, -1, -1):
            high = (crc >> 31) ^ (word >> bit & 1)
            crc = (crc << 1 & 0xFFFFFFFF) ^ (0x04C11DB7 if high else 0)
    return crc


@given(st.binary(min_size=8, max_size=80).filter(lambda data: len(data) % 4 == 0))
def test_checksum_is_the_textbook_one_without_the_last_word(data: bytes) -> None:
    assert image_checksum(data) == bitwise_crc(data[:-4])


def test_golden_checksum_and_unitrees_stop_values() -> None:
    assert IDLE[-4:] == bytes.fromhex("cd77e506")
    data = dds.encode_dds_command(
        JOINTS, Command(position=ZEROS, stiffness=ZEROS, damping=ZEROS + 2)
    )
    motors = LowCmd.deserialize(data).motor_cmd
    assert [motor.q for motor in motors] == [2.146e9] * 20
    assert [motor.dq for motor in motors] == [0.0] * 12 + [16000.0] * 8
    off = dds.decode_dds_command(JOINTS, with_motor(mode=0, tau=3.0))
    assert (off.stiffness[4], off.damping[4]) == (0.0, 0.0)
    assert off.stiffness[3] > 0.0


@pytest.mark.parametrize(
    ("message", "c_format", "wire"), [(LowCmd, C_COMMAND, 808), (LowState, C_STATE, 1176)]
)
def test_images_are_those_of_c_and_of_the_librarys_own_serializer(
    message: Any, c_format: str, wire: int
) -> None:
    assert c_image_dtype(message).itemsize == struct.calcsize(c_format)
    values = np.zeros(1, dtype=c_image_dtype(message))
    fill(values[0], np.random.default_rng(3))
    data = serialize_image(message, values)
    assert len(data) == len(HEADER) + wire
    decoded = message.deserialize(data)
    assert decoded.serialize() == data
    assert decoded.crc == int.from_bytes(data[-4:], "little")
    assert deserialize_image(message, data).tobytes()[:-4] == values.tobytes()[:-4]


def fill(values: np.void, rng: np.random.Generator) -> None:
    for name in values.dtype.names or ():
        part = values[name]
        if part.dtype.names:
            for element in np.atleast_1d(part):
                fill(element, rng)
        elif part.dtype.kind == "f":
            values[name] = rng.normal(size=part.shape)
        else:
            values[name] = rng.integers(0, np.iinfo(part.dtype).max, size=part.shape)


def test_golden_offsets_on_dds() -> None:
    data = dds.encode_dds_command(JOINTS, COMMAND)[len(HEADER) :]
    for k in range(12):
        motor = struct.unpack_from("<5f", data, 24 + 36 * k)
        # The Mini Cheetah's pitch axes point the other way.
        q = COMMAND.position[k] * (1.0 if k % 3 == 0 else -1.0)
        gains = (COMMAND.stiffness[k], COMMAND.damping[k])
        assert motor == pytest.approx((q, 0.0, 0.0, *gains), rel=1e-7)
    assert (data[:4], data[22]) == (bytes([0xFE, 0xEF, 0xFF, 0]), 1)

    state = some_state()
    data = dds.encode_dds_state(JOINTS, state)[len(HEADER) :]
    trunk = (*state.orientation, *state.gyro, *state.accelerometer)
    assert struct.unpack_from("<10f", data, 24) == trunk
    assert data[77] == 1
    assert struct.unpack_from("<f", data, 80 + 48 * 5) == (-state.position[5],)
    assert struct.unpack_from("<I", data, 1096) == (12_500,)
    assert struct.unpack_from("<f", data, 1152) == (24.5,)


def with_motor(**fields: float) -> bytes:
    values = deserialize_image(LowCmd, dds.encode_dds_command(JOINTS, COMMAND)).copy()
    for name, value in fields.items():
        values["motor_cmd"][name][0, 4] = value
    return serialize_image(LowCmd, values)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "header"),
        (b"\0\0" + IDLE[2:], "header"),
        (IDLE[:-1], "length"),
        (dds.encode_dds_state(JOINTS, some_state()), "length"),
        (IDLE[:-1] + b"\0", "checksum"),
        (with_motor(mode=2), "mode"),
        (with_motor(q=math.nan), "not finite"),
        (with_motor(kp=-1.0), "out of range"),
        (with_motor(kd=1e6), "out of range"),
        (with_motor(q=1e3), "out of range"),
        (with_motor(tau=0.5), "feed-forward"),
        (with_motor(dq=1.0), "feed-forward"),
    ],
)
def test_impossible_dds_commands_are_refused(data: bytes, reason: str) -> None:
    assert refusal(lambda: dds.decode_dds_command(JOINTS, data)) == reason


def test_layouts_and_robots_that_do_not_exist_are_refused() -> None:
    with pytest.raises(HardwareError, match="go2"):
        find_layout("go2")
    with pytest.raises(HardwareError, match="so101"):
        dds.joint_map(load_robot("so101"))


# --- Other quadrupeds -----------------------------------------------------------------------------

GO2 = load_robot("go2")
GO2_POSE = np.array([joint.default_position for joint in GO2.joints])
UNITREE_POSE = np.tile([0.0, 0.9, -1.8], 4)
"""A standing Go2 in Unitree's own angles: hip, thigh, calf of each leg [rad]."""


def test_a_go2_behind_the_bridge_has_unitrees_signs() -> None:
    wire = LcmWire(layout_for(GO2, "wtw"))
    attitude, _ = wire.encode_state(some_state())
    joints = WTW_LEG_CONTROL_DATA.encode(
        {"q": UNITREE_POSE, "qd": UNITREE_POSE, "tau_est": UNITREE_POSE}
    )
    state = wire.state_decoder()((attitude, joints), 0.0)
    assert state is not None
    for values in (state.position, state.velocity, state.torque):
        np.testing.assert_allclose(values, GO2_POSE, atol=1e-6)
    command = Command(position=GO2_POSE, stiffness=np.ones(12), damping=np.ones(12))
    fields = WTW_PD_TAU_TARGETS.decode(wire.encode(command))
    np.testing.assert_allclose(fields["q_des"], UNITREE_POSE)
    # A speed or a torque of another program is refused for any robot.
    moving = WTW_PD_TAU_TARGETS.encode({"q_des": UNITREE_POSE, "tau_ff": 1.0})
    assert refusal(lambda: wire.decode(moving)) == "feed-forward"


def test_the_mini_cheetah_keeps_its_layouts() -> None:
    assert layout_for(ROBOT, "cheetah") is CHEETAH
    assert layout_for(ROBOT, "wtw") is WTW
    np.testing.assert_array_equal(JOINTS.sign, np.tile([1.0, -1.0, -1.0], 4))
    np.testing.assert_array_equal(dds.joint_map(GO2).sign, np.ones(12))


def go2_with(folder: Path, change: Callable[[ElementTree.Element], None]) -> RobotSpec:
    """Return the Go2 with a change of its model's trunk."""
    source = Path(str(robot_file_path("go2"))).parent
    tree = ElementTree.parse(source / "go2.xml")
    trunk = tree.find(".//body[@name='trunk']")
    assert trunk is not None
    change(trunk)
    tree.write(folder / "go2.xml")
    # The mirror symmetry of its legs is verified, and not of this change.
    text = (source / "robot.yaml").read_text().replace("mirror: {FL: FR, RR: FR, RL: FR}", "")
    (folder / "robot.yaml").write_text(text)
    return load_robot(folder / "robot.yaml")


def left_first(trunk: ElementTree.Element) -> None:
    """Put the front left leg before the front right one, as Unitree's URDF of the Go2 has them."""
    left = trunk.find("body[@name='FL_hip']")
    assert left is not None
    trunk.remove(left)
    trunk.insert(list(trunk).index(trunk.find("body[@name='FR_hip']")), left)


def other_axis(trunk: ElementTree.Element) -> None:
    """Have a thigh turn about z."""
    joint = trunk.find(".//joint[@name='RL_hip_pitch']")
    assert joint is not None
    joint.set("axis", "0 0 1")


@pytest.mark.parametrize(
    ("change", "words"),
    [(left_first, "front left, front right"), (other_axis, "RL_hip_pitch")],
)
def test_a_model_with_other_legs_is_refused(
    change: Callable[[ElementTree.Element], None], words: str, tmp_path: Path
) -> None:
    robot = go2_with(tmp_path, change)
    with pytest.raises(HardwareError, match=words):
        dds.joint_map(robot)
    for name in ("cheetah", "wtw"):
        with pytest.raises(HardwareError, match=words):
            layout_for(robot, name)


def test_a_robots_clock_that_begins_anew_goes_on() -> None:
    decoder = dds.DdsStateDecoder(JOINTS, Counter())
    times = []
    for number in range(-3, 3):
        robot_time = (2**32 + 2 * number) / 1000.0
        state = some_state()
        state = replace(state, robot_time=robot_time, gyro=state.gyro + 0.01 * number)
        taken = decoder.take(dds.encode_dds_state(JOINTS, state), 100.0 + 0.002 * number)
        assert taken is not None
        assert taken.robot_time is not None
        times.append(taken.robot_time)
    np.testing.assert_allclose(np.diff(times), 0.002, atol=1e-6)
    assert decoder.counts == Counter()
