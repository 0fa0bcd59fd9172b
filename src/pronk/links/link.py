"""What every link does: opening, states, the writer of commands, clamps and the end.

Before anything is written, states are fresh and no other program commands. A command that is not
followed by another before it expires is followed by damping, from a thread of its own: the program
that commanded may be stuck, and a single message may be lost. A second writer stops the first.
At the end the robot is damped until it is at rest.

A robot whose state is one message and whose command is one message needs only a `Codec` and a
`Transport`:

    def my_link(robot, *, interface=None, speed: int = 115200, **common):
        return StreamLink(robot, MyCodec(robot), lambda: MyTransport(interface, speed), **common)

named as an entry point of the group `pronk.links`, is reached at `my_link://ttyUSB0?speed=9600`.
`pronk.testing.check_link` checks a codec and its transport.
"""

from __future__ import annotations

import math
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from pronk.errors import HardwareError
from pronk.links.machine import Command, RefusedError, State, TorqueKind, damping_command
from pronk.robots.robot import RobotSpec

ClampOperator = Callable[[tuple[str, ...]], None]
"""A person at the bench: receives the joints to fix and returns when they are."""

WINDOW_S = 0.2
"""How long states are watched before a robot is commanded [s]."""
ANSWER_S = 2.0
"""Time for a robot's first state, or for its reply to a request [s]."""
_POLL_S = 0.002
_DAMP_PERIOD_S = 0.01
"""Between two messages of damping [s]."""
_DAMP_AT_LEAST_S, _DAMP_AT_MOST_S = 1.0, 3.0
_AT_REST = 0.5
"""Joint speed below which a robot that is being left counts as at rest [rad/s]."""
_KEPT_STATES = 10_000


@dataclass(frozen=True, kw_only=True)
class Freshness:
    """How fresh states must be before anything moves."""

    share: float = 0.9
    """Of the expected number of states that must have come."""
    longest_gap_s: float = 0.02


def check_rate(
    robot: str, states: Sequence[State], rate_hz: float, fresh: Freshness | None = None
) -> None:
    """Raise HardwareError unless the states of `WINDOW_S` came often enough and without gaps."""
    wanted = fresh or Freshness()
    expected = rate_hz * WINDOW_S
    gap = float(np.diff([state.time for state in states]).max()) if len(states) > 1 else np.inf
    if len(states) < wanted.share * expected or gap > wanted.longest_gap_s:
        raise HardwareError(
            f"{robot} sent {len(states)} fresh states in {WINDOW_S * 1e3:.0f} ms with a longest "
            f"gap of {gap * 1e3:.0f} ms, expected about {expected:.0f} with none above "
            f"{wanted.longest_gap_s * 1e3:.0f} ms; check the network and that this computer is "
            "not busy."
        )


def wait_for(done: Callable[[], bool], seconds: float = ANSWER_S) -> bool:
    """Wait at most `seconds` until a condition holds; return whether it does."""
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() >= end:
            return False
        time.sleep(_POLL_S)
    return True


def await_rest(latest: Callable[[], State | None]) -> None:
    """Wait 1 to 3 s until the newest state is at rest; no state counts as at rest."""
    begun = time.monotonic()
    while (spent := time.monotonic() - begun) < _DAMP_AT_MOST_S:
        state = latest()
        speed = np.abs(state.velocity).max() if state is not None else 0.0
        if spent >= _DAMP_AT_LEAST_S and speed < _AT_REST:
            break
        time.sleep(_POLL_S)


class CommandWriter:
    """Puts commands on a wire, and damping when they expire. Any thread may call it."""

    def __init__(
        self,
        encode: Callable[[Command], bytes],
        publish: Callable[[bytes], None],
        *,
        joints: int = 12,
        damping: float = 1.0,
        repeat_s: float | None = None,
        counts: Counter[str] | None = None,
    ) -> None:
        """Start the thread that watches the expiry; nothing is written yet.

        Args:
            encode: Refuses what no drive could follow.
            publish: Puts bytes on the wire; only called by one thread at a time.
            joints: Of a command.
            damping: Of the joints while they are damped [N m s/rad].
            repeat_s: Time after which the command in force is written again; None for once.
            counts: Gets `commands`, `repeats`, `expired` and `not written`.
        """
        self.counts: Counter[str] = Counter() if counts is None else counts
        self.wrote = False
        """Whether anything was written at all."""
        self._encode, self._publish, self._repeat_s = encode, publish, repeat_s
        self._damping = encode(damping_command(joints, damping))
        self._data = b""
        self._expires = self._due = self._wake = math.inf
        self._open = True
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._watch, name="pronk writer", daemon=True)
        self._thread.start()

    def send(self, command: Command) -> None:
        """Put a command into force; one that has expired already becomes damping.

        Raises:
            HardwareError: No drive could follow it, and it was not sent; or the wire does not take
                it, and it is followed by damping when it expires.
        """
        data = self._encode(command)
        expires = command.made + command.valid_for
        with self._changed:
            if time.monotonic() >= expires:
                self.counts["expired"] += 1
                self._force(self._damping, math.inf)
                return
            problem = self._force(data, expires)
            if problem:
                raise HardwareError(
                    f"a command could not be put on the wire ({problem}); check the network."
                )
            self.counts["commands"] += 1

    def damp(self) -> None:
        """Write damping now, and go on until the next command. Never raises."""
        with self._changed:
            self._force(self._damping, math.inf)

    def stop(self) -> None:
        """Write nothing any more."""
        with self._changed:
            self._open = False
            self._changed.notify()
        self._thread.join()

    def _force(self, data: bytes, expires: float) -> str:
        """Put bytes into force; return what went wrong, or ""."""
        if not self._open:
            return ""
        self._data, self._expires = data, expires
        problem = self._write()
        # The thread sleeps to the time that was next when it fell asleep.
        if min(self._due, self._expires) < self._wake:
            self._changed.notify()
        return problem

    def _write(self) -> str:
        self.wrote = True
        period = _DAMP_PERIOD_S if self._data is self._damping else math.inf
        self._due = time.monotonic() + (self._repeat_s or period)
        try:
            self._publish(self._data)
        except Exception as error:
            # Whatever it is: the thread that damps must outlive it, and try again.
            self.counts["not written"] += 1
            return str(error) or type(error).__name__
        return ""

    def _watch(self) -> None:
        with self._changed:
            while self._open:
                now = time.monotonic()
                if now >= self._expires:
                    self.counts["expired"] += 1
                    self._data, self._expires = self._damping, math.inf
                    self._write()
                elif now >= self._due:
                    self.counts["repeats"] += 1
                    self._write()
                self._wake = min(self._due, self._expires)
                pause = self._wake - time.monotonic()
                if pause > 0.0:
                    self._changed.wait(pause if pause < math.inf else None)


class NetworkLink(ABC):
    """A robot behind a network. Implements `Machine` but for the wire.

    A thread receives, stamps and keeps states, so that a state's age is right however late the
    caller is. `virtual` is known once connected: the virtual robot identifies itself on the wire.
    """

    wire: str
    """Its name in error messages."""
    torque_kind: TorqueKind
    state_rate_hz: float
    _writer: CommandWriter | None = None
    """None while the link is closed."""
    _command_topic: str = ""
    """Where commands are written."""
    _address: str = ""
    """Where states are expected, in words."""

    def __init__(
        self,
        robot: RobotSpec,
        *,
        clamp_operator: ClampOperator | None = None,
        release: bool = False,
        exclusive_s: float = 1.0,
        fresh: Freshness | None = None,
    ) -> None:
        """Describe the link; nothing is opened yet.

        Args:
            robot: Names, order and limits of the joints.
            clamp_operator: Fixes joints on a real bench; None without one.
            release: Switch off the robot's own controller first; a standing robot
                falls then.
            exclusive_s: How long the topic of commands must be silent before pronk writes [s].
            fresh: How fresh states must be; None for what moving a robot takes.
        """
        self.robot, self._robot = robot.name, robot
        self.virtual = False
        self.counts: Counter[str] = Counter()
        """`states`, `commands`, `repeats`, `expired`, `foreign`, and why states were not made."""
        self._clamp_operator, self._release = clamp_operator, release
        self._exclusive_s, self._fresh = exclusive_s, fresh
        self._latest: State | None = None
        self._states: deque[State] = deque(maxlen=_KEPT_STATES)

    def connect(self) -> None:
        """Open the link and check that states come and no other program commands. 1 or 2 s.

        Nothing is written to the joints before; a check that fails raises HardwareError.
        """
        self.close()
        self.virtual, self._latest, self._last_error = False, None, ""
        self.counts.clear()
        self._states.clear()
        self._writer = self._open()
        self._reading = True
        self._thread = threading.Thread(target=self._read, name="pronk reader", daemon=True)
        self._thread.start()
        try:
            self._preflight()
        except BaseException:
            self.close()
            raise

    def now(self) -> float:
        """The local monotonic clock [s]."""
        return time.monotonic()

    def latest(self) -> State:
        """The newest state, without waiting."""
        if self._writer is None or self._latest is None:
            raise self._not_open()
        return self._latest

    def wait(self, until: float) -> list[State]:
        """Sleep to `until` [s]; return the states that arrived since the last call."""
        delay = until - time.monotonic()
        if delay > 0.0:
            time.sleep(delay)
        return [self._states.popleft() for _ in range(len(self._states))]

    def send(self, command: Command) -> None:
        """Put a command into force, until the next or until it expires; refuse a second writer."""
        if self._writer is None:
            raise self._not_open()
        if foreign := self.foreign_commands:
            raise HardwareError(
                f"another program commands the joints on {self._command_topic} "
                f"({foreign} commands met); stop it, and connect again."
            )
        self._writer.send(command)

    def clamp(self, joints: tuple[str, ...]) -> None:
        """Have joints fixed: by the virtual robot itself, or by a person; () frees all."""
        for name in joints:
            self._robot.joint(name)
        if self.virtual and self._writer is not None:
            if not self._hold(joints):
                raise HardwareError(
                    f"the virtual robot did not confirm its clamps within {ANSWER_S:g} s; check "
                    "that `pronk simulate` still runs."
                )
        elif self._clamp_operator is not None:
            self._clamp_operator(joints)
        elif joints:
            raise HardwareError(
                f"{', '.join(joints)} must be fixed mechanically and no person is at the bench; "
                "choose joints that need no clamp, or have someone there who confirms it."
            )

    def damp(self) -> None:
        """Write damping now and go on until a command or the end. Never raises."""
        if self._writer is not None:
            self._writer.damp()

    def close(self) -> None:
        """Leave the robot damped and at rest (1 to 3 s if anything was sent), and close."""
        writer = self._writer
        if writer is None:
            return
        if writer.wrote:
            writer.damp()
            await_rest(lambda: self._latest)
        writer.stop()
        self._reading = False
        self._thread.join()
        self._shut()
        self._writer = None

    def fresh_states(self, rate_hz: float, *, until: float) -> list[State]:
        """Watch one window of states after another; return the first that passes `check_rate`.

        Windows that end before `until` [s] may fail; a later one that fails raises HardwareError.
        """
        while True:
            self.wait(0.0)  # those of before
            states = self.wait(time.monotonic() + WINDOW_S)
            try:
                check_rate(self.robot, states, rate_hz, self._fresh)
            except HardwareError:
                # A busy computer may miss a window; a robot that is too slow misses them all.
                if time.monotonic() > until:
                    raise
            else:
                return states

    def check_exclusive(self, since: float) -> None:
        """Raise HardwareError if another program commanded within `exclusive_s` of `since` [s]."""
        time.sleep(max(0.0, since + self._exclusive_s - time.monotonic()))
        if foreign := self.foreign_commands:
            raise HardwareError(
                f"another program commands the joints: {foreign} commands on "
                f"{self._command_topic} within {self._exclusive_s:g} s; stop that program, or "
                "release the robot's own controller."
            )

    @property
    def foreign_commands(self) -> int:
        """Commands of others met since the link was opened."""
        return self.counts["foreign"]

    def _preflight(self) -> None:
        begun = time.monotonic()
        if not wait_for(lambda: self._latest is not None):
            why = f"; what came was refused: {self._last_error}" if self._last_error else ""
            raise HardwareError(
                f"{self.robot} sent no state on {self._address} within {ANSWER_S:g} s{why}; check "
                "that its program or the virtual robot runs, the link's options and the network."
            )
        self._prepare()
        self.counts["foreign"], silent_from = 0, time.monotonic()
        self.fresh_states(self.state_rate_hz, until=begun + 2.0 * ANSWER_S)
        self.check_exclusive(silent_from)
        self._confirm()
        self.wait(0.0)

    def _read(self) -> None:
        while self._reading:
            self._receive()

    def _take(self, decode: Callable[..., State | None], *given: Any) -> None:
        """Keep what `decode(*given)` makes of a message; count what it refuses."""
        try:
            state = decode(*given)
        except RefusedError as error:
            self.counts[f"refused: {error.reason}"] += 1
            self._last_error = str(error).rstrip(".")
            return
        if state is not None:
            self._latest = state
            self._states.append(state)
            self.counts["states"] += 1

    def _not_open(self) -> HardwareError:
        return HardwareError(
            f"the {self.wire} link to {self.robot} is not open; call connect() first."
        )

    # --- the wire -------------------------------------------------------------------------------

    @abstractmethod
    def _open(self) -> CommandWriter:
        """Open the wire and make the writer."""

    @abstractmethod
    def _receive(self) -> None:
        """Wait a moment for messages and `_take` them; called by the reading thread."""

    @abstractmethod
    def _shut(self) -> None:
        """Close the wire; the writer and the reading thread have stopped."""

    def _prepare(self) -> None:  # noqa: B027
        """Release the robot's own controller, after the first state and before all checks."""

    def _confirm(self) -> None:  # noqa: B027
        """Check what remains when states are fresh, and identify the virtual robot."""

    def _hold(self, joints: tuple[str, ...]) -> bool:
        """Make the virtual robot fix joints; return whether it confirmed."""
        return False


class Codec(Protocol):
    """Bytes to states and commands to bytes, without a socket."""

    name: str
    """Of the wire, in error messages."""
    state_rate_hz: float
    torque_kind: TorqueKind

    def encode(self, command: Command) -> bytes:
        """Encode a command; HardwareError where no drive could follow it (`check_command`)."""

    def decode(self, data: bytes) -> State:
        """Decode a state, whose time and sequence the link replaces; RefusedError for no state."""


class Transport(Protocol):
    """Moves bytes. Opened by whatever makes it."""

    local: bool
    """True where nothing can leave this computer; required without an interface."""

    def receive(self, timeout_s: float) -> list[bytes]:
        """Messages that have come, oldest first; waits at most that long for the first."""

    def send(self, data: bytes) -> None:
        """Send a command."""

    def foreign_commands(self) -> int:
        """Commands of other programs met since it was opened; 0 where the wire has one writer."""

    def close(self) -> None:
        """Close."""


class StreamLink(NetworkLink):
    """A robot behind a codec and a transport. Implements `Machine`."""

    def __init__(
        self,
        robot: RobotSpec,
        codec: Codec,
        transport: Callable[[], Transport],
        *,
        repeat_s: float | None = None,
        **common: Any,
    ) -> None:
        """Describe the link; `transport` opens the wire, `repeat_s` is as of `CommandWriter`.

        What else links take (`common`) is as of `NetworkLink`.
        """
        super().__init__(robot, **common)
        self.torque_kind, self.state_rate_hz = codec.torque_kind, codec.state_rate_hz
        self._codec, self._make, self._repeat_s = codec, transport, repeat_s
        self._command_topic = self._address = self.wire = codec.name

    @property
    def foreign_commands(self) -> int:
        """Commands of others met since the link was opened."""
        return self._transport.foreign_commands()

    def _open(self) -> CommandWriter:
        self._sequence = -1
        self._transport = self._make()
        return CommandWriter(
            self._codec.encode,
            self._transport.send,
            joints=len(self._robot.joints),
            repeat_s=self._repeat_s,
            counts=self.counts,
        )

    def _receive(self) -> None:
        for data in self._transport.receive(0.05):
            self._take(self._numbered, data)

    def _numbered(self, data: bytes) -> State:
        state = self._codec.decode(data)
        self._sequence += 1
        return replace(state, time=time.monotonic(), sequence=self._sequence)

    def _shut(self) -> None:
        self._transport.close()
