"""Unitree's messages to the byte: layouts, checksum, round trips, and mutations."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("cyclonedds")

from broken_message import mutated
from pronk.errors import HardwareError
from pronk.links.dds import messages as idl
from pronk.links.dds.codec import (
    LowState,
    decode_command,
    decode_state,
    encode_command,
    encode_state,
    idle_command,
    joint_map,
)
from pronk.links.dds.messages import HEADER, checksum, pack, record, unpack, wire_size
from pronk.links.machine import Command, RefusedError, State
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
JOINTS = joint_map(ROBOT)
TWELVE = st.lists(st.floats(-12.0, 12.0, width=32), min_size=12, max_size=12).map(np.array)
GAINS = st.lists(st.floats(0.0, 90.0, width=32), min_size=12, max_size=12).map(np.array)

# pack formats of unitree_sdk2_python's C images
C_COMMAND = "<4B4IH2x" + "B3x5f3I" * 20 + "4B" + "55Bx2I"
C_STATE = "<4B4IH2x" + "13fb3x" + "B3x7fb3x3I" * 20 + "4BiH4b15H" + "8hI41B3xf2b2x2f4h2I"


def some_state(**changed: object) -> State:
    rng = np.random.default_rng(7)
    state = State(
        time=1.234,
        sequence=617,
        position=rng.normal(size=12),
        velocity=rng.normal(size=12),
        torque=rng.normal(size=12),
        gyro=rng.normal(size=3),
        accelerometer=rng.normal(size=3),
        bus_voltage=24.5,
        orientation=np.array([0.5, -0.5, 0.5, 0.5]),
        temperature=np.arange(30.0, 42.0),
    )
    return replace(state, **changed)


def some_command() -> Command:
    rng = np.random.default_rng(8)
    return Command(
        position=rng.uniform(-2.0, 2.0, 12),
        stiffness=rng.uniform(5.0, 20.0, 12),
        damping=rng.uniform(0.1, 1.0, 12),
    )


def bitwise_crc(words: bytes) -> int:
    """The textbook loop, a bit at a time."""
    crc = 0xFFFFFFFF
    for (word,) in struct.iter_unpack("<I", words):
        for bit in range(31, -1, -1):
            high = (crc >> 31) ^ (word >> bit & 1)
            crc = (crc << 1 & 0xFFFFFFFF) ^ (0x04C11DB7 if high else 0)
    return crc


def test_golden_checksum_of_the_idle_command() -> None:
    idle = idle_command()
    assert checksum(idle.tobytes()) == 0x06E577CD
    assert pack(idl.LowCmd, idle)[-4:] == bytes.fromhex("cd77e506")


@given(st.binary(min_size=8, max_size=80).filter(lambda data: len(data) % 4 == 0))
def test_checksum_is_the_textbook_one_without_the_last_word(data: bytes) -> None:
    assert checksum(data) == bitwise_crc(data[:-4])


@pytest.mark.parametrize(
    ("message", "c_format", "wire"), [(idl.LowCmd, C_COMMAND, 808), (idl.LowState, C_STATE, 1176)]
)
def test_golden_sizes(message: object, c_format: str, wire: int) -> None:
    assert record(message).itemsize == struct.calcsize(c_format)
    assert wire_size(message) == wire


def test_golden_offsets_on_the_wire() -> None:
    """One number in each place that is known, found where it belongs in what the library wrote."""
    command = some_command()
    data = encode_command(JOINTS, command)[len(HEADER) :]
    for k in range(12):
        q, dq, tau, kp, kd = struct.unpack_from("<5f", data, 24 + 36 * k)
        # The Mini Cheetah's pitch axes point the other way.
        sign = 1.0 if k % 3 == 0 else -1.0
        assert q == np.float32(sign * command.position[k])
        assert (dq, tau) == (0.0, 0.0)
        assert (kp, kd) == (np.float32(command.stiffness[k]), np.float32(command.damping[k]))
    assert data[:4] == bytes([0xFE, 0xEF, 0xFF, 0])
    assert data[22] == 1

    state = some_state()
    data = encode_state(JOINTS, state)[len(HEADER) :]
    assert struct.unpack_from("<4f", data, 24) == tuple(state.orientation)
    assert struct.unpack_from("<3f", data, 40) == tuple(state.gyro.astype(np.float32))
    assert struct.unpack_from("<3f", data, 52) == tuple(state.accelerometer.astype(np.float32))
    assert data[77] == 1
    (knee,) = struct.unpack_from("<f", data, 80 + 48 * 5)
    assert knee == -np.float32(state.position[5])
    assert struct.unpack_from("<I", data, 1096) == (1234,)
    assert struct.unpack_from("<f", data, 1152) == (24.5,)
    assert struct.unpack_from("<I", data, 1172) == (checksum(image_of(idl.LowState, data)),)


def image_of(message: object, payload: bytes) -> bytes:
    return unpack(message, HEADER + payload).tobytes()


def test_the_librarys_own_serializer_gives_the_same_bytes() -> None:
    """Both ways, for every member of a message full of different numbers."""
    for message in (idl.LowCmd, idl.LowState):
        rng = np.random.default_rng(3)
        values = np.zeros(1, dtype=record(message))
        fill(values[0], rng)
        data = pack(message, values)
        decoded = message.deserialize(data)
        assert decoded.serialize() == data
        assert decoded.crc == int.from_bytes(data[-4:], "little")
        np.testing.assert_array_equal(unpack(message, data)["reserve"], values["reserve"])


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


@given(TWELVE, GAINS, GAINS)
def test_commands_come_back(position: np.ndarray, kp: np.ndarray, kd: np.ndarray) -> None:
    sent = Command(position=position, stiffness=kp, damping=kd)
    met = decode_command(JOINTS, encode_command(JOINTS, sent))
    np.testing.assert_array_equal(met.stiffness, kp)
    np.testing.assert_array_equal(met.damping, kd)
    np.testing.assert_array_equal(met.position, np.where(kp > 0.0, position, 0.0))


@given(TWELVE, TWELVE, TWELVE, st.integers(0, 2**32 - 1))
def test_states_come_back(
    position: np.ndarray, velocity: np.ndarray, torque: np.ndarray, tick: int
) -> None:
    sent = some_state(position=position, velocity=velocity, torque=torque, robot_time=tick / 1000.0)
    low = decode_state(JOINTS, encode_state(JOINTS, sent))
    met = low.state(time=5.0, sequence=9)
    assert low.tick == tick
    assert low.virtual
    for name in ("position", "velocity", "torque", "orientation", "temperature"):
        np.testing.assert_array_equal(getattr(met, name), getattr(sent, name))
    for name in ("gyro", "accelerometer"):
        np.testing.assert_array_equal(getattr(met, name), getattr(sent, name).astype(np.float32))
    assert (met.time, met.sequence, met.bus_voltage) == (5.0, 9, 24.5)
    assert met.robot_time == pytest.approx(tick / 1000.0)


def test_no_stiffness_and_no_damping_are_unitrees_stop_values() -> None:
    nothing = np.zeros(12)
    data = encode_command(JOINTS, Command(position=nothing + 1, stiffness=nothing, damping=nothing))
    assert data == pack(idl.LowCmd, idle_command())
    data = encode_command(JOINTS, Command(position=nothing, stiffness=nothing, damping=nothing + 2))
    motors = idl.LowCmd.deserialize(data).motor_cmd
    assert [motor.q for motor in motors] == [2.146e9] * 20
    assert [motor.dq for motor in motors] == [0.0] * 12 + [16000.0] * 8


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("position", np.full(12, math.nan), "not finite"),
        ("stiffness", np.full(12, 1e39), r"stiffness is up to 1e\+39, expected at most 1000"),
        ("position", np.full(12, 20.0), "position is up to 20, expected at most 12.56"),
        ("damping", np.full(12, -1.0), "damping is negative"),
        ("stiffness", np.zeros(11), r"shape \(11,\) .* expected \(12,\)"),
    ],
)
def test_impossible_commands_are_not_sent(name: str, value: np.ndarray, words: str) -> None:
    with pytest.raises(HardwareError, match=words):
        encode_command(JOINTS, replace(some_command(), **{name: value}))


def with_motor(**fields: float) -> bytes:
    values = unpack(idl.LowCmd, encode_command(JOINTS, some_command())).copy()
    for name, value in fields.items():
        values["motor_cmd"][name][0, 4] = value
    return pack(idl.LowCmd, values)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "header"),
        (b"\0\0" + pack(idl.LowCmd, idle_command())[2:], "header"),
        (pack(idl.LowCmd, idle_command())[:-1], "length"),
        (encode_state(JOINTS, some_state()), "length"),
        (pack(idl.LowCmd, idle_command())[:-1] + b"\0", "checksum"),
        (with_motor(mode=2), "mode"),
        (with_motor(q=math.nan), "not finite"),
        (with_motor(kp=math.inf), "not finite"),
        (with_motor(kp=-1.0), "out of range"),
        (with_motor(kd=1e6), "out of range"),
        (with_motor(q=1e3), "out of range"),
        (with_motor(tau=0.5), "feed-forward"),
        (with_motor(dq=1.0), "feed-forward"),
    ],
)
def test_each_reason_to_refuse_a_command(data: bytes, reason: str) -> None:
    with pytest.raises(RefusedError) as caught:
        decode_command(JOINTS, data)
    assert caught.value.reason == reason


def test_a_motor_that_is_off_has_no_gains() -> None:
    met = decode_command(JOINTS, with_motor(mode=0, tau=3.0))
    assert (met.stiffness[4], met.damping[4]) == (0.0, 0.0)
    assert met.stiffness[3] > 0.0


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"velocity": np.full(12, math.nan)}, "not finite"),
        ({"gyro": np.full(3, math.inf)}, "not finite"),
        ({"orientation": np.zeros(4)}, "quaternion"),
    ],
)
def test_each_reason_to_refuse_a_state(changed: dict[str, np.ndarray], reason: str) -> None:
    low = decode_state(JOINTS, encode_state(JOINTS, some_state(**changed)))
    with pytest.raises(RefusedError) as caught:
        low.state(time=0.0, sequence=0)
    assert caught.value.reason == reason


@settings(max_examples=300)
@given(st.data())
def test_mutations_with_a_right_checksum_are_possible_commands_or_refused(data: st.DataObject):
    """Nonsense with a right checksum is finite and in bounds, or refused."""
    values = unpack(idl.LowCmd, encode_command(JOINTS, some_command())).copy()
    image = bytearray(values.tobytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(image) - 5))
        image[at] = data.draw(st.integers(0, 255))
    changed = np.frombuffer(bytes(image), dtype=values.dtype)
    try:
        met = decode_command(JOINTS, pack(idl.LowCmd, changed))
    except RefusedError:
        return
    assert np.isfinite(met.position).all()
    assert np.abs(met.position).max() <= 4.0 * math.pi
    assert 0.0 <= met.stiffness.min() <= met.stiffness.max() <= 1000.0
    assert 0.0 <= met.damping.min() <= met.damping.max() <= 100.0


def test_twenty_thousand_mutated_states_become_the_same_state_or_none() -> None:
    data = encode_state(JOINTS, some_state())
    honest = decode_state(JOINTS, data)
    rng = np.random.default_rng(1)
    for _ in range(20_000):
        try:
            met: LowState = decode_state(JOINTS, mutated(data, rng))
        except RefusedError:
            continue
        assert met.message.tobytes() == honest.message.tobytes()


def test_a_robot_that_does_not_fit_is_refused() -> None:
    with pytest.raises(HardwareError, match="so101 has no place in Unitree's messages"):
        joint_map(load_robot("so101"))
