"""Operators: keyboard, gamepad, scripts, and the clamping of joints beside a sweep."""

from __future__ import annotations

import os
import queue
import select
import sys
import termios
import threading
import tty
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pronk.deploy.links.link import ClampOperator
from pronk.deploy.runtime.modes import Mode, OperatorRequest, deciding_request
from pronk.errors import HardwareError, PronkError
from pronk.policy.gamepad import JUMP_S, GamepadButton, GamepadReader
from pronk.policy.script import STILL, Script, Velocity

Ranges = Mapping[str, tuple[float, float]]
"""Smallest and largest commands trained for (`Contract.command_ranges`)."""


@dataclass(frozen=True, kw_only=True)
class OperatorCommand:
    """The operator's input at a moment."""

    command: Velocity = STILL
    """Velocity command: forward, left [m/s], yaw rate [rad/s], in the trunk's frame."""
    jump: bool = False
    """Jump input."""
    dead_man: bool = False
    """Whether the dead-man button is held; without it the robot is damped in `Mode.POLICY`, and in
    no other mode."""
    request: OperatorRequest = OperatorRequest.NONE
    """A new request."""


class Operator:
    """Gives the operator's input, 50 times a second."""

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        """Return the input now (CLOCK_MONOTONIC [s]), in a mode of the servo."""
        raise NotImplementedError

    def notified(self, event_kind: str, text: str) -> None:
        """Receive an event of the servo."""

    def sensed(self, remote: bytes) -> None:
        """Receive the bytes of the robot's wireless remote that came with the newest state."""

    def leave(self) -> None:
        """End, because the program was interrupted."""

    def close(self) -> None:
        """Release the device."""


_PAUSE_S = 1.0
"""Time with a zero command after each script [s]."""


class ScriptedOperator(Operator):
    """Stands up and runs scripts one after another; ends at the first fault.

    `TimeLimit` of `seconds` sits down at their end.
    """

    def __init__(self, scripts: Sequence[Script]) -> None:
        """Run scripts in this order."""
        self.scripts = tuple(scripts)
        self.seconds = sum(script.seconds + _PAUSE_S for script in scripts)
        """Time for which the policy runs [s]."""
        self._began: float | None = None
        self._requested_in = Mode.ENDED
        self._over = False

    def notified(self, event_kind: str, text: str) -> None:
        """End at a fault or refusal."""
        if event_kind in ("fault", "refused"):
            self._over = True
        if event_kind == "notice" and self._began is None:
            self._over = True

    def leave(self) -> None:
        """End."""
        self._over = True

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        """Return the scripts' input."""
        if self._over:
            return OperatorCommand(request=OperatorRequest.QUIT)
        if mode is Mode.DAMP:
            return OperatorCommand(request=self._once(OperatorRequest.STAND, mode))
        if mode is Mode.STAND:
            return OperatorCommand(dead_man=True, request=self._once(OperatorRequest.WALK, mode))
        if mode is Mode.POLICY:
            if self._began is None:
                self._began = now
            t = now - self._began
            for script in self.scripts:
                if 0.0 <= t < script.seconds:
                    command, jump = script.commanded(t)
                    return OperatorCommand(command=command, jump=jump, dead_man=True)
                t -= script.seconds + _PAUSE_S
        return OperatorCommand(dead_man=True)

    def _once(self, request: OperatorRequest, mode: Mode) -> OperatorRequest:
        """Return a request, once in each mode."""
        if self._requested_in is mode:
            return OperatorRequest.NONE
        self._requested_in = mode
        return request


class BenchOperator(Operator):
    """Beside a sweep: clamps joints by hand when the servo requests it."""

    def __init__(self, clamp_operator: ClampOperator) -> None:
        """`clamp_operator` clamps joints; it is called in a thread of its own."""
        self._clamp_operator = clamp_operator
        self._requests: queue.SimpleQueue[OperatorRequest] = queue.SimpleQueue()
        """Requests to send next, oldest first."""
        self.error: PronkError | None = None
        """Error for which joints could not be clamped; None if there was none."""

    def notified(self, event_kind: str, text: str) -> None:
        """Have joints clamped."""
        if event_kind == "clamp":
            joints = tuple(name for name in text.split(", ") if name)
            threading.Thread(target=self._clamp, args=(joints,), daemon=True).start()

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        """Return a held dead-man button; a request once joints are clamped, or cannot be."""
        request = OperatorRequest.NONE
        with suppress(queue.Empty):
            request = self._requests.get_nowait()
        return OperatorCommand(dead_man=True, request=request)

    def _clamp(self, joints: tuple[str, ...]) -> None:
        """Have joints clamped, and request that the sweep goes on or ends; runs in a thread."""
        try:
            self._clamp_operator(joints)
        except PronkError as error:
            self.error = error
        except Exception as error:
            self.error = HardwareError(f"{type(error).__name__}: {error}")
        self._requests.put(OperatorRequest.CLAMPED if self.error is None else OperatorRequest.QUIT)


class TimeLimit(Operator):
    """Another operator for a time from the first start of the policy; then it sits down and ends.

    A robot that stands when the time is over, as after a fault, sits down too.
    """

    def __init__(self, operator: Operator, seconds: float) -> None:
        """Count from the start of the policy [s]."""
        self._operator = operator
        self._seconds = seconds
        self._began: float | None = None
        self._sat_from: Mode | None = None
        """Mode in which the last request to sit down was sent."""

    def notified(self, event_kind: str, text: str) -> None:
        """Pass an event of the servo on."""
        self._operator.notified(event_kind, text)

    def sensed(self, remote: bytes) -> None:
        """Pass the bytes of the robot's remote on."""
        self._operator.sensed(remote)

    def leave(self) -> None:
        """End, because the program was interrupted."""
        self._operator.leave()

    def close(self) -> None:
        """Release the other operator's device."""
        self._operator.close()

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        """Return the other's input, until the time is over; then its requests to damp or end."""
        command = self._operator.command(now, mode)
        if mode is Mode.POLICY and self._began is None:
            self._began = now
        over = self._began is not None and now - self._began >= self._seconds
        if not over or command.request in (OperatorRequest.DAMP, OperatorRequest.QUIT):
            return command
        if mode is Mode.DAMP:
            return OperatorCommand(request=OperatorRequest.QUIT)
        if mode not in (Mode.POLICY, Mode.STAND) or self._sat_from is mode:
            return OperatorCommand(dead_man=command.dead_man)
        self._sat_from = mode
        return OperatorCommand(dead_man=command.dead_man, request=OperatorRequest.SIT)


HELP = """\
  hold SPACE   dead-man: releasing it while the policy runs damps the joints
  1 stand up   2 start the policy   3 sit down   0 damp at once   r reset a fault   q quit
  w s forward and back   a d left and right   j l turn   x stand still   ENTER jump"""
"""Keys of the keyboard."""


_STEPS = {
    "w": (0, 0.25),
    "s": (0, -0.25),
    "a": (1, 0.1),
    "d": (1, -0.1),
    "j": (2, 0.2),
    "l": (2, -0.2),
}
"""Axis of the velocity command and change of it, for each key."""
_REQUESTS = {
    "1": OperatorRequest.STAND,
    "2": OperatorRequest.WALK,
    "3": OperatorRequest.SIT,
    "0": OperatorRequest.DAMP,
    "r": OperatorRequest.RESET,
    "q": OperatorRequest.QUIT,
}
_REPEAT_S = 0.8
"""A key counts as held for this long; keyboards repeat a key after 0.66 s at most [s]."""


_NEVER = -1e9
"""Time of a key that was not pressed yet [s]."""


class Keyboard(Operator):
    """Keys of a terminal.

    A terminal does not report the release of a key, only its repetition, so the dead-man button is
    released 0.8 s late; a gamepad's at once.
    """

    def __init__(self, ranges: Ranges, stream: int | None = None) -> None:
        """Read standard input key by key, or another file; HardwareError if it is no terminal."""
        self._fd = sys.stdin.fileno() if stream is None else stream
        self._ranges = tuple(ranges.values())
        self._jump_pressed = _NEVER
        """Time at which the jump key came last [s]."""
        self._connected = True
        if not os.isatty(self._fd):
            raise HardwareError(
                "there is no keyboard (standard input is no terminal); run it in a terminal, use "
                "--gamepad, or --script for a run without an operator."
            )
        self._attributes = termios.tcgetattr(self._fd)
        """Attributes of the terminal before this program."""
        tty.setcbreak(self._fd)
        self._command = [0.0, 0.0, 0.0]
        self._dead_man_pressed = _NEVER
        """Time at which the dead-man key came last [s]."""

    def close(self) -> None:
        """Restore the terminal."""
        with suppress(termios.error):
            termios.tcsetattr(self._fd, termios.TCSADRAIN, self._attributes)

    def notified(self, event_kind: str, text: str) -> None:
        """Reset the velocity command when the mode changes."""
        if event_kind == "mode":
            self._command = [0.0, 0.0, 0.0]

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        """Return the keys' input."""
        requests = []
        keys = self._read().decode("ascii", "ignore")
        if not self._connected:
            return OperatorCommand(request=OperatorRequest.QUIT)
        for key in keys:
            if key == " ":
                self._dead_man_pressed = now
            elif key in _STEPS:
                axis, step = _STEPS[key]
                low, high = self._ranges[axis]
                self._command[axis] = min(max(self._command[axis] + step, low), high)
            elif key == "x":
                self._command = [0.0, 0.0, 0.0]
            elif key in "\r\n":
                self._jump_pressed = now
            elif key in _REQUESTS:
                requests.append(_REQUESTS[key])
        forward, sideways, yaw_rate = self._command
        return OperatorCommand(
            command=(forward, sideways, yaw_rate),
            jump=now - self._jump_pressed < JUMP_S,
            dead_man=now - self._dead_man_pressed < _REPEAT_S,
            request=deciding_request(requests),
        )

    def _read(self) -> bytes:
        """Return what has come since the last call; note the end of the device."""
        data = b""
        while select.select([self._fd], [], [], 0.0)[0]:
            try:
                received = os.read(self._fd, 4096)
            except OSError:
                received = b""
            if not received:
                self._connected = False
                break
            data += received
        return data


_PAD_REQUESTS: dict[int, OperatorRequest] = {
    GamepadButton.A: OperatorRequest.STAND,
    GamepadButton.B: OperatorRequest.DAMP,
    GamepadButton.X: OperatorRequest.SIT,
    GamepadButton.Y: OperatorRequest.WALK,
    GamepadButton.BACK: OperatorRequest.QUIT,
    GamepadButton.START: OperatorRequest.RESET,
}

PAD_HELP = """\
  hold LB      dead-man: releasing it while the policy runs damps the joints
  A stand up   Y start the policy   X sit down   B damp at once   START reset a fault   BACK quit
  left stick forward and sideways   right stick turn   RB jump"""
"""Buttons of the gamepad."""


class Gamepad(Operator):
    """A gamepad through the kernel's joystick interface; unplugged counts as released."""

    def __init__(self, path: Path, ranges: Ranges) -> None:
        """Open a device such as /dev/input/js0; HardwareError if it cannot be opened."""
        self._reader = GamepadReader(path, ranges)

    def close(self) -> None:
        """Close the device."""
        self._reader.close()

    def command(self, now: float, mode: Mode) -> OperatorCommand:
        """Return the input of sticks and buttons."""
        pad = self._reader.read(now)
        requests = [_PAD_REQUESTS[button] for button in pad.pressed if button in _PAD_REQUESTS]
        return OperatorCommand(
            command=pad.velocity,
            jump=pad.jump,
            dead_man=pad.dead_man,
            request=deciding_request(requests),
        )
