"""Unitree's wireless remote: the 40 bytes `wireless_remote` of a `LowState`.

Layout, little-endian, as `unitree/dds_wrapper/common/unitree_joystick.hpp` of unitree_sdk2 has it:

    0   head, 2 bytes
    2   buttons, 16 bits, in the order of `RemoteButton`
    4   left stick to the right, float32, -1 to 1
    8   right stick to the right
    12  right stick forward
    16  L2 as an axis
    20  left stick forward
    24  16 bytes that are not used

All zero where no remote is switched on. What the bytes are when a remote is lost while it was held
is not published.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum

from pronk.robots.machine import RefusedError

REMOTE_BYTES = 40
_LAYOUT = struct.Struct("<2sH5f16x")
_FULL_SCALE = 1.5
"""Beyond this a stick's number is none: they are -1 to 1."""


class RemoteButton(IntEnum):
    """Buttons by their bits."""

    R1 = 0
    L1 = 1
    START = 2
    SELECT = 3
    R2 = 4
    L2 = 5
    F1 = 6
    F2 = 7
    A = 8
    B = 9
    X = 10
    Y = 11
    UP = 12
    RIGHT = 13
    DOWN = 14
    LEFT = 15


@dataclass(frozen=True, kw_only=True)
class RemoteInput:
    """Sticks and buttons of a remote at a moment."""

    held: frozenset[RemoteButton] = frozenset()
    """Buttons that are held."""
    left_right: float = 0.0
    """Left stick to the right, -1 to 1."""
    left_forward: float = 0.0
    """Left stick forward."""
    right_right: float = 0.0
    """Right stick to the right."""
    right_forward: float = 0.0
    """Right stick forward."""


def decode_remote(data: bytes) -> RemoteInput | None:
    """Decode the bytes of a remote.

    Args:
        data: `LowState.wireless_remote`.

    Returns:
        What is held and where the sticks are; None if all bytes are zero, as without a remote.

    Raises:
        RefusedError: The bytes are not 40, or a stick is no number from -1 to 1.
    """
    if len(data) != REMOTE_BYTES:
        raise RefusedError("remote", f"wireless_remote has {len(data)} bytes, expected 40.")
    if not any(data):
        return None
    _, buttons, left_right, right_right, right_forward, _, left_forward = _LAYOUT.unpack(data)
    sticks = (left_right, right_right, right_forward, left_forward)
    for value in sticks:
        if not (math.isfinite(value) and abs(value) <= _FULL_SCALE):
            raise RefusedError("remote", f"a stick of the remote is at {value}, expected -1 to 1.")
    held = []
    for button in RemoteButton:
        if buttons >> button & 1:
            held.append(button)
    return RemoteInput(
        held=frozenset(held),
        left_right=left_right,
        left_forward=left_forward,
        right_right=right_right,
        right_forward=right_forward,
    )


def encode_remote(remote: RemoteInput) -> bytes:
    """Encode the bytes of a remote, as a robot with one that is switched on sends them."""
    buttons = 0
    for button in remote.held:
        buttons |= 1 << button
    return _LAYOUT.pack(
        b"\x55\x51",
        buttons,
        remote.left_right,
        remote.right_right,
        remote.right_forward,
        float(RemoteButton.L2 in remote.held),
        remote.left_forward,
    )
