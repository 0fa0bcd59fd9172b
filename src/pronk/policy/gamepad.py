"""A gamepad through the kernel's joystick interface, as commands of a policy."""

from __future__ import annotations

import os
import select
import stat
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

from pronk.errors import HardwareError
from pronk.policy.contract import COMMANDS
from pronk.policy.script import STILL, Velocity

JUMP_S = 0.5
"""Length of the jump input of one press, as in training [s]."""
DEAD_ZONE = 0.1
"""Share of its way that a stick may be off its centre without a command [1]."""

# js_event of linux/joystick.h: time [ms], value, type, number.
_EVENT = struct.Struct("<IhBB")
_BUTTON_EVENT = 1
_AXIS_EVENT = 2
_INITIAL_STATE = 0x80
_FULL_SCALE = 32767.0
_READ_BYTES = 4096

# Numbers of the kernel's xpad driver, to which other gamepads are mapped.
_FORWARD_AXIS = 1
_LEFT_AXIS = 0
_TURN_AXIS = 3


class GamepadButton(IntEnum):
    """Buttons by the numbers of the kernel's xpad driver."""

    A = 0
    B = 1
    X = 2
    Y = 3
    LEFT_BUMPER = 4
    RIGHT_BUMPER = 5
    BACK = 6
    START = 7


def stick_command(push: float, span: tuple[float, float]) -> float:
    """Return the command of a stick.

    Args:
        push: Share of its way that the stick is off its centre, -1 to 1.
        span: Smallest and largest command, at the ends of its way.
    """
    if abs(push) <= DEAD_ZONE:
        return 0.0
    low, high = span
    share = min(abs(push), 1.0)
    return share * high if push > 0.0 else share * low


@dataclass(frozen=True, kw_only=True)
class GamepadInput:
    """Sticks and buttons of a gamepad at a moment."""

    velocity: Velocity = STILL
    """Forward, left [m/s], yaw rate [rad/s], in the trunk's frame."""
    jump: bool = False
    """Jump input: the right bumper was pressed within the last `JUMP_S`."""
    dead_man: bool = False
    """The left bumper is held."""
    pressed: tuple[int, ...] = ()
    """Numbers of the buttons that were pressed since the last reading, in their order."""


class GamepadReader:
    """Reads a gamepad; one that is unplugged counts as released."""

    def __init__(self, path: Path, ranges: Mapping[str, tuple[float, float]]) -> None:
        """Open a gamepad.

        Args:
            path: Device such as /dev/input/js0.
            ranges: Smallest and largest command, by the names in `COMMANDS`.

        Raises:
            HardwareError: The device cannot be opened, or is a file or a folder.
        """
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise HardwareError(
                f"gamepad {path}: {error.strerror}; plug it in, or name another "
                "one (ls /dev/input/js*)."
            ) from None
        kind = os.fstat(self._fd).st_mode
        if stat.S_ISREG(kind) or stat.S_ISDIR(kind):
            os.close(self._fd)
            raise HardwareError(
                f"gamepad {path} is no device; name one such as /dev/input/js0 (ls /dev/input/js*)."
            )
        self._ranges = ranges
        self._connected = True
        self._axes: dict[int, float] = {}
        self._buttons: dict[int, bool] = {}
        self._jump_pressed_at = -1e9

    def close(self) -> None:
        """Close the device."""
        os.close(self._fd)

    def read(self, now: float) -> GamepadInput:
        """Return the input at a time of a steady clock [s]."""
        pressed = []
        for _, value, kind, number in _EVENT.iter_unpack(self._read_events()):
            if kind & ~_INITIAL_STATE == _AXIS_EVENT:
                self._axes[number] = value / _FULL_SCALE
            elif kind & ~_INITIAL_STATE == _BUTTON_EVENT:
                self._buttons[number] = bool(value)
                if value and not kind & _INITIAL_STATE:
                    pressed.append(number)
        if not self._connected:
            return GamepadInput(pressed=tuple(pressed))
        # Of a press whose end is read with its begin, the state of the button shows nothing.
        if GamepadButton.RIGHT_BUMPER in pressed:
            self._jump_pressed_at = now
        forward, left, yaw_rate = COMMANDS
        return GamepadInput(
            velocity=(
                self._commanded(_FORWARD_AXIS, forward),
                self._commanded(_LEFT_AXIS, left),
                self._commanded(_TURN_AXIS, yaw_rate),
            ),
            jump=now - self._jump_pressed_at < JUMP_S,
            dead_man=self._buttons.get(GamepadButton.LEFT_BUMPER, False),
            pressed=tuple(pressed),
        )

    def _commanded(self, axis: int, name: str) -> float:
        """Return the command of one axis, which is negative forward and to the left."""
        return stick_command(-self._axes.get(axis, 0.0), self._ranges[name])

    def _read_events(self) -> bytes:
        """Return all events since the last call; notes the end of the device."""
        events = b""
        while select.select([self._fd], [], [], 0.0)[0]:
            try:
                part = os.read(self._fd, _READ_BYTES)
            except OSError:
                part = b""
            if not part:
                self._connected = False
                break
            events += part
        return events
