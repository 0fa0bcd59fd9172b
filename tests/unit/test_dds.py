"""Unitree's messages to the byte: layouts, checksum, round trips, mutations, numbered states."""

from __future__ import annotations

import math
import struct
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("cyclonedds")

from broken_message import mutated, some_state
from pronk.errors import HardwareError
from pronk.links.dds import messages as idl
from pronk.links.dds.codec import (
    StateDecoder,
    decode_command,
    encode_command,
    encode_state,
    idle_command,
    joint_map,
    state_of,
)
from pronk.links.dds.messages import HEADER, checksum, pack, record, unpack, wire_size
from pronk.links.machine import Command, RefusedError, State
from pronk.robots import load_robot

JOINTS = joint_map(load_robot("mini_cheetah"))
TWELVE = st.lists(st.floats(-12.0, 12.0, width=32), min_size=12, max_size=12).map(np.array)
GAINS = st.lists(st.floats(0.0, 90.0, width=32), min_size=12, max_size=12).map(np.array)
RNG = np.random.default_rng(8)
COMMAND = Command(
    position=RNG.uniform(-2.0, 2.0, 12),
    stiffness=RNG.uniform(5.0, 20.0, 12),
    damping=RNG.uniform(0.1, 1.0, 12),
)
# pack formats of unitree_sdk2_python's C images
C_COMMAND = "<4B4IH2x" + "B3x5f3I" * 20 + "4B" + "55Bx2I"
C_STATE = "<4B4IH2x" + "13fb3x" + "B3x7fb3x3I" * 20 + "4BiH4b15H" + "8hI41B3xf2b2x2f4h2I"
IDLE = pack(idl.LowCmd, idle_command())


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
    assert checksum(data) == bitwise_crc(data[:-4])


def test_golden_checksum_of_the_idle_command() -> None:
    assert IDLE[-4:] == bytes.fromhex("cd77e506")


@pytest.mark.parametrize(
    ("message", "c_format", "wire"), [(idl.LowCmd, C_COMMAND, 808), (idl.LowState, C_STATE, 1176)]
)
def test_images_are_those_of_c_and_of_the_librarys_own_serializer(
    message: object, c_format: str, wire: int
) -> None:
    assert (record(message).itemsize, wire_size(message)) == (struct.calcsize(c_format), wire)
    values = np.zeros(1, dtype=record(message))
    fill(values[0], np.random.default_rng(3))
    data = pack(message, values)
    decoded = message.deserialize(data)  # type: ignore[attr-defined]
    assert decoded.serialize() == data
    assert decoded.crc == int.from_bytes(data[-4:], "little")
    assert unpack(message, data).tobytes()[:-4] == values.tobytes()[:-4]


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


def test_golden_offsets_on_the_wire() -> None:
    data = encode_command(JOINTS, COMMAND)[len(HEADER) :]
    for k in range(12):
        q, dq, tau, kp, kd = struct.unpack_from("<5f", data, 24 + 36 * k)
        # The Mini Cheetah's pitch axes point the other way.
        sign = 1.0 if k % 3 == 0 else -1.0
        assert q == np.float32(sign * COMMAND.position[k])
        assert (dq, tau) == (0.0, 0.0)
        assert (kp, kd) == (np.float32(COMMAND.stiffness[k]), np.float32(COMMAND.damping[k]))
    assert (data[:4], data[22]) == (bytes([0xFE, 0xEF, 0xFF, 0]), 1)

    state = some_state()
    data = encode_state(JOINTS, state)[len(HEADER) :]
    trunk = (*state.orientation, *state.gyro, *state.accelerometer)
    assert struct.unpack_from("<10f", data, 24) == trunk
    assert data[77] == 1
    assert struct.unpack_from("<f", data, 80 + 48 * 5) == (-state.position[5],)
    assert struct.unpack_from("<I", data, 1096) == (12_500,)
    assert struct.unpack_from("<f", data, 1152) == (24.5,)


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
    sent = some_state(
        position=position,
        velocity=velocity,
        torque=torque,
        robot_time=tick / 1000.0,
        temperature=np.arange(30.0, 42.0),
    )
    decoder = StateDecoder(JOINTS, Counter())
    assert not decoder.virtual
    met = decoder.take(encode_state(JOINTS, sent), 5.0)
    assert met is not None
    assert decoder.virtual
    for name in (
        "position", "velocity", "torque", "orientation", "temperature", "gyro", "accelerometer"
    ):  # fmt: skip
        np.testing.assert_array_equal(getattr(met, name), getattr(sent, name))
    assert (met.time, met.sequence, met.bus_voltage) == (5.0, 0, 24.5)
    assert met.robot_time == pytest.approx(tick / 1000.0)


def test_no_stiffness_and_no_damping_are_unitrees_stop_values() -> None:
    nothing = np.zeros(12)
    data = encode_command(JOINTS, Command(position=nothing + 1, stiffness=nothing, damping=nothing))
    assert data == IDLE
    data = encode_command(JOINTS, Command(position=nothing, stiffness=nothing, damping=nothing + 2))
    motors = idl.LowCmd.deserialize(data).motor_cmd
    assert [motor.q for motor in motors] == [2.146e9] * 20
    assert [motor.dq for motor in motors] == [0.0] * 12 + [16000.0] * 8


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("position", np.full(12, math.nan)),
        ("stiffness", np.full(12, 1e39)),
        ("position", np.full(12, 20.0)),
        ("damping", np.full(12, -1.0)),
        ("stiffness", np.zeros(11)),
    ],
)
def test_impossible_commands_are_not_sent(name: str, value: np.ndarray) -> None:
    with pytest.raises(HardwareError, match=name):
        encode_command(JOINTS, replace(COMMAND, **{name: value}))


def with_motor(**fields: float) -> bytes:
    values = unpack(idl.LowCmd, encode_command(JOINTS, COMMAND)).copy()
    for name, value in fields.items():
        values["motor_cmd"][name][0, 4] = value
    return pack(idl.LowCmd, values)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "header"),
        (b"\0\0" + IDLE[2:], "header"),
        (IDLE[:-1], "length"),
        (encode_state(JOINTS, some_state()), "length"),
        (IDLE[:-1] + b"\0", "checksum"),
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
    with pytest.raises(RefusedError) as caught:
        StateDecoder(JOINTS, Counter()).take(encode_state(JOINTS, some_state(**changed)), 0.0)
    assert caught.value.reason == reason


@given(st.data())
def test_mutations_with_a_right_checksum_are_possible_commands_or_refused(
    data: st.DataObject,
) -> None:
    values = unpack(idl.LowCmd, encode_command(JOINTS, COMMAND)).copy()
    image = bytearray(values.tobytes())
    for _ in range(data.draw(st.integers(1, 4))):
        image[data.draw(st.integers(0, len(image) - 5))] = data.draw(st.integers(0, 255))
    changed = np.frombuffer(bytes(image), dtype=values.dtype)
    try:
        met = decode_command(JOINTS, pack(idl.LowCmd, changed))
    except RefusedError:
        return
    assert np.abs(met.position).max() <= 4.0 * math.pi
    assert 0.0 <= met.stiffness.min() <= met.stiffness.max() <= 1000.0
    assert 0.0 <= met.damping.min() <= met.damping.max() <= 100.0


def test_mutated_states_become_the_same_state_or_none() -> None:
    data = encode_state(JOINTS, some_state())
    right = unpack(idl.LowState, data)
    assert state_of(JOINTS, right, time=0.0, sequence=0).bus_voltage == 24.5
    rng = np.random.default_rng(1)
    for _ in range(20_000):
        try:
            met = unpack(idl.LowState, mutated(data, rng))
        except RefusedError:
            continue
        assert met.tobytes() == right.tobytes()


def test_a_robot_that_does_not_fit_is_refused() -> None:
    with pytest.raises(HardwareError, match="so101"):
        joint_map(load_robot("so101"))


def message(tick: int, value: float | None = None) -> bytes:
    """A message at a robot's time [ms]; its joints are at `value`, by default as many mrad."""
    angle = np.full(12, 1e-3 * (tick % 1000) if value is None else value)
    return encode_state(JOINTS, some_state(robot_time=tick / 1000.0, position=angle))


@pytest.mark.parametrize(
    ("ticks", "numbers", "counts"),
    [
        ((5000, 5002, 5004, 5006), [0, 1, 2, 3], {}),
        # A jitter of the robot's clock of a millisecond loses nothing.
        ((5000, 5001, 5004, 5005, 5008), [0, 1, 3, 4, 6], {}),
        ((5000, 5002, 5008, 5010), [0, 1, 4, 5], {}),
        ((5000, 5002, 5002, 5006, 5004, 5008), [0, 1, 3, 4], {"out of order": 2}),
        ((90_000, 90_002, 4, 6, 8000, 8002), [0, 1, 2, 3, 4, 5], {"clock jumps": 2}),
        ((2**32 - 4, 2**32 - 2, 0, 2), [0, 1, 2, 3], {}),
    ],
    ids=["regular", "jitter", "lost", "late and double", "clock jumps", "largest number"],
)
def test_states_are_numbered_by_the_robots_clock(
    ticks: tuple[int, ...], numbers: list[int], counts: dict[str, int]
) -> None:
    decoder = StateDecoder(JOINTS, Counter())
    states = [decoder.take(message(tick), 10.0 + 0.002 * k) for k, tick in enumerate(ticks)]
    assert [state.sequence for state in states if state is not None] == numbers
    assert decoder.counts == counts


def test_frozen_values_behind_a_live_clock_make_no_states() -> None:
    decoder = StateDecoder(JOINTS, Counter())
    made = [decoder.take(message(2 * k, 0.5), 0.002 * k) for k in range(5)]
    assert [state is None for state in made] == [False] + [True] * 4
    assert decoder.counts == {"repeated": 4}
    assert decoder.take(message(12, 0.6), 0.012) is not None


def test_times_grow_even_where_messages_came_at_once() -> None:
    decoder = StateDecoder(JOINTS, Counter())
    states = [decoder.take(message(2 * k), 7.0) for k in range(4)]
    times = [state.time for state in states if isinstance(state, State)]
    assert times == pytest.approx([7.0, 7.0 + 1e-6, 7.0 + 2e-6, 7.0 + 3e-6], abs=1e-8)
