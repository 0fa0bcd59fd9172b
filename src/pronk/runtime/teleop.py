"""A person's hands: a keyboard, a gamepad."""

from __future__ import annotations

import os
import select
import struct
import sys
import termios
import tty
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from pronk.errors import HardwareError
from pronk.runtime.operators import Stick
from pronk.runtime.records import Mode, Wish

HELP = """\
  hold SPACE   dead-man: let go and the joints are damped
  1 stand up   2 let the policy walk   3 sit down   0 damp at once   r fault mended   q leave
  w s forward and back   a d left and right   j l turn   x stand still   ENTER jump"""
"""Keys of the keyboard."""

_STEP = {"w": (0, 0.25), "s": (0, -0.25), "a": (1, 0.1), "d": (1, -0.1), "j": (2, 0.2)} | {
    "l": (2, -0.2)
}
_WISHES = {
    "1": Wish.STAND,
    "2": Wish.WALK,
    "3": Wish.SIT,
    "0": Wish.DAMP,
    "r": Wish.RESET,
    "q": Wish.QUIT,
}
_JUMP_S = 0.5
"""How long one press asks for a jump, as in training [s]: in less, the stride might not come to
where a jump may begin (`pronk.policy.stride`)."""
_REPEAT_S = 0.8
"""A key counts as held for this long after it was heard: the longest usual delay before a keyboard
repeats a key is 0.66 s."""


class Keyboard:
    """Keys of a terminal.

    A terminal knows no "released", only that a held key repeats itself, so its dead-man button
    lets go 0.8 s late; a gamepad's does so at once.
    """

    def __init__(
        self, ranges: Mapping[str, tuple[float, float]], stream: int | None = None
    ) -> None:
        """Listen to a terminal, key by key.

        Args:
            ranges: Commands trained for, smallest and largest (`Contract.command_ranges`).
            stream: File descriptor; standard input if left out.

        Raises:
            HardwareError: It is no terminal.
        """
        self._fd = sys.stdin.fileno() if stream is None else stream
        self._ranges = tuple(ranges.values())
        if not os.isatty(self._fd):
            raise HardwareError(
                "there is no keyboard to hold (standard input is no terminal); run it in a "
                "terminal, take --gamepad, or --script for a run that needs nobody."
            )
        self._before = termios.tcgetattr(self._fd)
        tty.setcbreak(self._fd)
        self._command = [0.0, 0.0, 0.0]
        self._held = self._jump = -1e9
        self._there = True

    def close(self) -> None:
        """Give the terminal back as it was, if it is there."""
        with suppress(termios.error):
            termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)

    def told(self, kind: str, text: str) -> None:
        """After a change of mode nothing of the old command is left."""
        if kind == "mode":
            self._command = [0.0, 0.0, 0.0]

    def leave(self) -> None:
        """Nothing to do."""

    def stick(self, now: float, mode: Mode) -> Stick:
        """What the keys say."""
        del mode
        wish = Wish.NONE
        keys = self._keys()
        if not self._there:
            return Stick(wish=Wish.QUIT)
        for key in keys:
            if key == " ":
                self._held = now
            elif key in _STEP:
                axis, step = _STEP[key]
                low, high = self._ranges[axis]
                self._command[axis] = min(max(self._command[axis] + step, low), high)
            elif key == "x":
                self._command = [0.0, 0.0, 0.0]
            elif key in "\r\n":
                self._jump = now
            elif key in _WISHES:
                wish = _WISHES[key]
        forward, left, yaw = self._command
        return Stick(
            command=(forward, left, yaw),
            jump=now - self._jump < _JUMP_S,
            held=now - self._held < _REPEAT_S,
            wish=wish,
        )

    def _keys(self) -> str:
        keys = b""
        while select.select([self._fd], [], [], 0.0)[0]:
            try:
                part = os.read(self._fd, 256)
            except OSError:
                part = b""
            if not part:
                self._there = False
                break
            keys += part
        return keys.decode("ascii", "ignore")


_EVENT = struct.Struct("<IhBB")
"""js_event of linux/joystick.h: time [ms], value, type, number."""
_BUTTON, _AXIS, _INITIAL = 1, 2, 0x80
_FULL = 32767.0
_DEAD_ZONE = 0.1
# Numbers as the kernel's xpad driver gives them, to which other gamepads are mapped.
_PAD_WISHES = {0: Wish.STAND, 1: Wish.DAMP, 2: Wish.SIT, 3: Wish.WALK, 6: Wish.QUIT, 7: Wish.RESET}
_LEFT_BUMPER, _RIGHT_BUMPER = 4, 5
_FORWARD_AXIS, _LEFT_AXIS, _TURN_AXIS = 1, 0, 3

PAD_HELP = """\
  hold LB      dead-man: let go and the joints are damped
  A stand up   Y let the policy walk   X sit down   B damp at once   START fault mended   BACK leave
  left stick forward and sideways   right stick turn   RB jump"""
"""Buttons of the gamepad."""


class Gamepad:
    """A gamepad through the kernel's joystick interface; unplugged is let go."""

    def __init__(self, path: Path, ranges: Mapping[str, tuple[float, float]]) -> None:
        """Open it.

        Args:
            path: Device, such as /dev/input/js0.
            ranges: Commands trained for, smallest and largest (`Contract.command_ranges`).

        Raises:
            HardwareError: It cannot be opened.
        """
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise HardwareError(
                f"gamepad {path}: {error.strerror}; plug it in, or name another "
                "one (ls /dev/input/js*)."
            ) from None
        self._ranges = tuple(ranges.values())
        self._axes: dict[int, float] = {}
        self._buttons: dict[int, bool] = {}
        self._pressed = False
        self._jump = -1e9
        self._there = True

    def close(self) -> None:
        """Let go of the device."""
        os.close(self._fd)

    def told(self, kind: str, text: str) -> None:
        """A gamepad has no ears."""

    def leave(self) -> None:
        """Nothing to do."""

    def stick(self, now: float, mode: Mode) -> Stick:
        """What sticks and buttons say."""
        del mode
        wish = self._read()
        if not self._there:
            return Stick(wish=wish)
        pushed = [-self._axis(_FORWARD_AXIS), -self._axis(_LEFT_AXIS), -self._axis(_TURN_AXIS)]
        forward, left, yaw = (
            push * (high if push > 0.0 else -low)
            for push, (low, high) in zip(pushed, self._ranges, strict=True)
        )
        pressed = self._buttons.get(_RIGHT_BUMPER, False)
        if pressed and not self._pressed:
            self._jump = now
        self._pressed = pressed
        return Stick(
            command=(forward, left, yaw),
            jump=now - self._jump < _JUMP_S,
            held=self._buttons.get(_LEFT_BUMPER, False),
            wish=wish,
        )

    def _axis(self, number: int) -> float:
        value = self._axes.get(number, 0.0)
        return value if abs(value) > _DEAD_ZONE else 0.0

    def _read(self) -> Wish:
        wish = Wish.NONE
        while True:
            try:
                data = os.read(self._fd, _EVENT.size)
            except BlockingIOError:
                return wish
            except OSError:
                self._there = False
                return wish
            if len(data) < _EVENT.size:
                self._there = False
                return wish
            _, value, kind, number = _EVENT.unpack(data)
            if kind & ~_INITIAL == _AXIS:
                self._axes[number] = value / _FULL
            elif kind & ~_INITIAL == _BUTTON:
                self._buttons[number] = bool(value)
                if value and not kind & _INITIAL:
                    wish = _PAD_WISHES.get(number, wish)
