"""Operators: keyboard, gamepad, and scripted ones that need nobody."""

from __future__ import annotations

import os
import select
import struct
import sys
import termios
import threading
import tty
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from pronk.errors import HardwareError, PronkError
from pronk.links.network_link import ClampOperator
from pronk.runtime.ipc import Mode, OperatorRequest
from pronk.runtime.script import STILL, Script, Velocity


@dataclass(frozen=True, kw_only=True)
class OperatorCommand:
    """What the operator wants at a moment."""

    command: Velocity = STILL
    """Forward, left [m/s], yaw rate [rad/s], in the trunk's frame."""
    jump: bool = False
    held: bool = False
    """Whether the dead-man button is held: without it the policy's robot is damped."""
    request: OperatorRequest = OperatorRequest.NONE
    """A new request."""


class Operator(Protocol):
    """Gives the stick's position, 50 times a second."""

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        """What is wanted now.

        Args:
            now: CLOCK_MONOTONIC [s].
            mode: What the servo is doing.
        """

    def notified(self, kind: str, text: str) -> None:
        """Hear what the servo has to say."""

    def leave(self) -> None:
        """The program was interrupted."""


class ScriptedOperator:
    """Stands up, runs one script after another, sits down, leaves; needs nobody.

    It ends at the first fault or refusal.
    """

    def __init__(self, scripts: Sequence[Script], *, pause_s: float = 1.0) -> None:
        """Take the scripts.

        Args:
            scripts: Commands while the policy is in charge, one after the other.
            pause_s: Of standing still between two [s].
        """
        self.scripts = tuple(scripts)
        self.pause_s = pause_s
        self._began: float | None = None
        self._requested_in = Mode.ENDED
        self._over = False
        self.finished = False
        """True once all scripts have been run to their ends."""

    @property
    def seconds(self) -> float:
        """While the policy is in charge [s]."""
        return sum(script.seconds + self.pause_s for script in self.scripts)

    def notified(self, kind: str, text: str) -> None:
        """A fault or a refusal ends it."""
        if kind in ("fault", "refused") or (kind == "notice" and self._began is None):
            self._over = True

    def leave(self) -> None:
        """End it."""
        self._over = True

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        """What the scripts say."""
        if self._over or (self.finished and mode is Mode.DAMP):
            return OperatorCommand(request=self._once(OperatorRequest.QUIT, Mode.ENDED))
        if mode is Mode.DAMP:
            return OperatorCommand(request=self._once(OperatorRequest.STAND, mode))
        if mode is Mode.STAND:
            return OperatorCommand(held=True, request=self._once(OperatorRequest.WALK, mode))
        if mode is not Mode.POLICY:
            return OperatorCommand(held=True)
        if self._began is None:
            self._began = now
        t = now - self._began
        for script in self.scripts:
            if t < script.seconds:
                command, jump = script.commanded(t)
                return OperatorCommand(command=command, jump=jump, held=True)
            t -= script.seconds
            if t < self.pause_s:
                return OperatorCommand(held=True)
            t -= self.pause_s
        self.finished = True
        return OperatorCommand(held=True, request=self._once(OperatorRequest.SIT, mode))

    def _once(self, request: OperatorRequest, mode: Mode) -> OperatorRequest:
        """A request, said once for each mode."""
        if self._requested_in is mode and request is not OperatorRequest.QUIT:
            return OperatorRequest.NONE
        self._requested_in = mode
        return request


class BenchOperator:
    """Beside a sweep: clamps joints by hand when the servo requests it."""

    def __init__(self, clamp_operator: ClampOperator) -> None:
        """`clamp_operator` clamps joints; it is called in a thread of its own."""
        self._clamp = clamp_operator
        self._next = OperatorRequest.NONE
        self.error: PronkError | None = None
        """Why joints could not be clamped."""

    def notified(self, kind: str, text: str) -> None:
        """Have joints clamped."""
        if kind == "clamp":
            joints = tuple(name for name in text.split(", ") if name)
            threading.Thread(target=self._fix, args=(joints,), daemon=True).start()

    def leave(self) -> None:
        """No-op: the run requests the end itself."""

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        """The dead-man button is held; a request once joints are clamped, or cannot be."""
        del now, mode
        request, self._next = self._next, OperatorRequest.NONE
        return OperatorCommand(held=True, request=request)

    def _fix(self, joints: tuple[str, ...]) -> None:
        try:
            self._clamp(joints)
        except PronkError as error:
            self.error = error
        except Exception as error:
            self.error = HardwareError(f"{type(error).__name__}: {error}")
        self._next = OperatorRequest.CLAMPED if self.error is None else OperatorRequest.QUIT


class TimeLimit:
    """Another operator, who sits down when the time is over."""

    def __init__(self, operator: Operator, seconds: float) -> None:
        """Begin to count when the policy takes over.

        Args:
            operator: Who else decides.
            seconds: With the policy in charge [s].
        """
        self._operator = operator
        self._seconds = seconds
        self._began: float | None = None
        self._sat = False

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        """What the other wants, until the time is over."""
        wanted = self._operator.command(now, mode)
        if mode is Mode.POLICY and self._began is None:
            self._began = now
        if self._began is None or now - self._began < self._seconds:
            return wanted
        if mode is Mode.POLICY:
            request = OperatorRequest.NONE if self._sat else OperatorRequest.SIT
            self._sat = True
            return OperatorCommand(held=wanted.held, request=request)
        return (
            OperatorCommand(request=OperatorRequest.QUIT)
            if mode is Mode.DAMP
            else OperatorCommand(held=wanted.held)
        )

    def notified(self, kind: str, text: str) -> None:
        """Tell the other."""
        self._operator.notified(kind, text)

    def leave(self) -> None:
        """Tell the other."""
        self._operator.leave()


HELP = """\
  hold SPACE   dead-man: let go and the joints are damped
  1 stand up   2 let the policy walk   3 sit down   0 damp at once   r fault mended   q leave
  w s forward and back   a d left and right   j l turn   x stand still   ENTER jump"""
"""Keys of the keyboard."""

_STEP = {"w": (0, 0.25), "s": (0, -0.25), "a": (1, 0.1), "d": (1, -0.1), "j": (2, 0.2)} | {
    "l": (2, -0.2)
}
_REQUESTS = {
    "1": OperatorRequest.STAND,
    "2": OperatorRequest.WALK,
    "3": OperatorRequest.SIT,
    "0": OperatorRequest.DAMP,
    "r": OperatorRequest.RESET,
    "q": OperatorRequest.QUIT,
}
_JUMP_S = 0.5
"""Length of the jump input of one press, as in training [s]."""
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

    def notified(self, kind: str, text: str) -> None:
        """After a change of mode nothing of the old command is left."""
        if kind == "mode":
            self._command = [0.0, 0.0, 0.0]

    def leave(self) -> None:
        """Nothing to do."""

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        """What the keys say."""
        del mode
        request = OperatorRequest.NONE
        keys = self._keys()
        if not self._there:
            return OperatorCommand(request=OperatorRequest.QUIT)
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
            elif key in _REQUESTS:
                request = _REQUESTS[key]
        forward, left, yaw = self._command
        return OperatorCommand(
            command=(forward, left, yaw),
            jump=now - self._jump < _JUMP_S,
            held=now - self._held < _REPEAT_S,
            request=request,
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
_PAD_REQUESTS = {
    0: OperatorRequest.STAND,
    1: OperatorRequest.DAMP,
    2: OperatorRequest.SIT,
    3: OperatorRequest.WALK,
    6: OperatorRequest.QUIT,
    7: OperatorRequest.RESET,
}
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

    def notified(self, kind: str, text: str) -> None:
        """A gamepad has no ears."""

    def leave(self) -> None:
        """Nothing to do."""

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        """What sticks and buttons say."""
        del mode
        request = self._read()
        if not self._there:
            return OperatorCommand(request=request)
        pushed = [-self._axis(_FORWARD_AXIS), -self._axis(_LEFT_AXIS), -self._axis(_TURN_AXIS)]
        forward, left, yaw = (
            push * (high if push > 0.0 else -low)
            for push, (low, high) in zip(pushed, self._ranges, strict=True)
        )
        pressed = self._buttons.get(_RIGHT_BUMPER, False)
        if pressed and not self._pressed:
            self._jump = now
        self._pressed = pressed
        return OperatorCommand(
            command=(forward, left, yaw),
            jump=now - self._jump < _JUMP_S,
            held=self._buttons.get(_LEFT_BUMPER, False),
            request=request,
        )

    def _axis(self, number: int) -> float:
        value = self._axes.get(number, 0.0)
        return value if abs(value) > _DEAD_ZONE else 0.0

    def _read(self) -> OperatorRequest:
        request = OperatorRequest.NONE
        while True:
            try:
                data = os.read(self._fd, _EVENT.size)
            except BlockingIOError:
                return request
            except OSError:
                self._there = False
                return request
            if len(data) < _EVENT.size:
                self._there = False
                return request
            _, value, kind, number = _EVENT.unpack(data)
            if kind & ~_INITIAL == _AXIS:
                self._axes[number] = value / _FULL
            elif kind & ~_INITIAL == _BUTTON:
                self._buttons[number] = bool(value)
                if value and not kind & _INITIAL:
                    request = _PAD_REQUESTS.get(number, request)
