"""The wireless remote of a Unitree robot: its bytes, and what they command."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from pronk.deploy.links.remote import (
    REMOTE_BYTES,
    RemoteButton,
    RemoteInput,
    decode_remote,
    encode_remote,
)
from pronk.deploy.runtime.modes import Mode, OperatorRequest
from pronk.deploy.runtime.remote_operator import Remote
from pronk.deploy.runtime.teleop import TimeLimit
from pronk.robots.machine import RefusedError

RANGES = {"vx": (-2.0, 4.0), "vy": (-0.5, 0.75), "yaw_rate": (-2.0, 1.0)}
OFF = bytes(REMOTE_BYTES)


def wire(
    buttons: int = 0,
    *,
    lx: float = 0.0,
    rx: float = 0.0,
    ry: float = 0.0,
    l2: float = 0.0,
    ly: float = 0.0,
) -> bytes:
    """The bytes as `unitree_joystick.hpp` lays them out, by their offsets."""
    data = bytearray(REMOTE_BYTES)
    data[0:2] = b"\x55\x51"
    struct.pack_into("<H", data, 2, buttons)
    for offset, value in ((4, lx), (8, rx), (12, ry), (16, l2), (20, ly)):
        struct.pack_into("<f", data, offset, value)
    return bytes(data)


def held(*buttons: RemoteButton, **sticks: float) -> bytes:
    return encode_remote(RemoteInput(held=frozenset(buttons), **sticks))


def remote_with(*samples: bytes) -> Remote:
    """A remote that has been heard with some bytes, one after the other."""
    remote = Remote(RANGES)
    for sample in samples:
        remote.sensed(sample)
        remote.command(0.0, Mode.DAMP)
    return remote


@pytest.mark.parametrize(
    ("bit", "button"),
    [
        (0, "R1"),
        (1, "L1"),
        (2, "START"),
        (3, "SELECT"),
        (8, "A"),
        (9, "B"),
        (11, "Y"),
        (15, "LEFT"),
    ],
)
def test_each_button_is_its_bit(bit: int, button: str) -> None:
    decoded = decode_remote(wire(1 << bit))
    assert decoded is not None
    assert decoded.held == {RemoteButton[button]}
    assert encode_remote(decoded) == wire(1 << bit)


def test_the_sticks_are_where_the_layout_has_them() -> None:
    decoded = decode_remote(wire(lx=0.25, rx=-0.5, ry=0.75, l2=1.0, ly=-1.0))
    assert decoded == RemoteInput(
        left_right=0.25, right_right=-0.5, right_forward=0.75, left_forward=-1.0
    )


def test_random_inputs_come_back() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        chosen = [button for button in RemoteButton if rng.random() < 0.3]
        sticks = rng.uniform(-1.0, 1.0, 4).astype(np.float32).tolist()
        remote = RemoteInput(
            held=frozenset(chosen),
            left_right=sticks[0],
            left_forward=sticks[1],
            right_right=sticks[2],
            right_forward=sticks[3],
        )
        assert decode_remote(encode_remote(remote)) == remote


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -3.0])
def test_a_stick_that_is_none_is_refused_and_counts_as_released(value: float) -> None:
    data = wire(1 << RemoteButton.L1, ly=value)
    with pytest.raises(RefusedError):
        decode_remote(data)
    command = remote_with(OFF, data).command(0.0, Mode.POLICY)
    assert not command.dead_man
    assert command.command == (0.0, 0.0, 0.0)


def test_no_remote_and_another_length() -> None:
    assert decode_remote(OFF) is None
    with pytest.raises(RefusedError):
        decode_remote(bytes(39))


def test_the_sticks_reach_the_ends_of_the_ranges() -> None:
    remote = remote_with(held(left_forward=1.0, left_right=-1.0, right_right=-1.0))
    assert remote.command(0.0, Mode.POLICY).command == (4.0, 0.75, 1.0)
    remote.sensed(held(left_forward=-1.0, left_right=1.0, right_right=1.0))
    assert remote.command(0.0, Mode.POLICY).command == (-2.0, -0.5, -2.0)
    remote.sensed(held(left_forward=0.05, left_right=-0.05, right_right=0.05))
    assert remote.command(0.0, Mode.POLICY).command == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("button", "request_"),
    [
        ("A", OperatorRequest.STAND),
        ("Y", OperatorRequest.WALK),
        ("X", OperatorRequest.SIT),
        ("B", OperatorRequest.DAMP),
        ("START", OperatorRequest.RESET),
        ("SELECT", OperatorRequest.QUIT),
    ],
)
def test_a_press_is_one_request(button: str, request_: OperatorRequest) -> None:
    remote = remote_with(held())
    remote.sensed(held(RemoteButton[button]))
    assert remote.command(0.0, Mode.STAND).request is request_
    assert remote.command(0.02, Mode.STAND).request is OperatorRequest.NONE


def test_damping_outweighs_what_is_pressed_with_it() -> None:
    remote = remote_with(held())
    remote.sensed(held(RemoteButton.A, RemoteButton.Y, RemoteButton.B))
    assert remote.command(0.0, Mode.POLICY).request is OperatorRequest.DAMP


def test_quitting_outweighs_damping_that_is_pressed_with_it() -> None:
    remote = remote_with(held())
    remote.sensed(held(RemoteButton.B, RemoteButton.SELECT, RemoteButton.A))
    assert remote.command(0.0, Mode.POLICY).request is OperatorRequest.QUIT


def test_what_is_held_from_the_begin_requests_nothing() -> None:
    remote = Remote(RANGES)
    remote.sensed(held(RemoteButton.A, RemoteButton.L1))
    command = remote.command(0.0, Mode.DAMP)
    assert command.request is OperatorRequest.NONE
    assert command.dead_man


def test_a_remote_that_is_switched_off_is_released() -> None:
    remote = remote_with(held(RemoteButton.L1, left_forward=1.0))
    assert remote.command(0.0, Mode.POLICY).dead_man
    remote.sensed(OFF)
    command = remote.command(0.02, Mode.POLICY)
    assert not command.dead_man
    assert command.command == (0.0, 0.0, 0.0)
    # Switched on again with A held: no request.
    remote.sensed(held(RemoteButton.A))
    assert remote.command(0.04, Mode.DAMP).request is OperatorRequest.NONE


def test_a_jump_is_as_long_as_in_training() -> None:
    remote = remote_with(held())
    remote.sensed(held(RemoteButton.R1))
    assert remote.command(1.0, Mode.POLICY).jump
    assert remote.command(1.4, Mode.POLICY).jump
    assert not remote.command(1.6, Mode.POLICY).jump


def test_an_interrupt_ends_it_and_a_time_limit_passes_the_bytes_on() -> None:
    remote = remote_with(held())
    limited = TimeLimit(remote, 10.0)
    limited.sensed(held(RemoteButton.L1))
    assert limited.command(0.0, Mode.STAND).dead_man
    limited.leave()
    assert limited.command(0.0, Mode.POLICY).request is OperatorRequest.QUIT
