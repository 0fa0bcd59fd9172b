"""Connecting, states, commands, clamps and closing, common to all links.

A thread of its own writes damping when a command expires without another, for the commanding
program may be stuck. A robot whose state is one message and whose command is one message needs only
a `Codec` and a `Transport` (`StreamLink`; docs/hardware.md has an example).
"""

from __future__ import annotations

import math
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from pronk.arrays import Array
from pronk.errors import HardwareError
from pronk.robots.machine import Command, RefusedError, State, TorqueKind, damping_command
from pronk.robots.robot import RobotSpec

Encode = Callable[[Command], bytes]
Publish = Callable[[bytes], None]
ClampOperator = Callable[[tuple[str, ...]], None]
"""A person at the bench: receives the joints to fix and returns when they are fixed."""

RESPONSE_S = 2.0
"""Time for a robot's first state, or for its response to a request [s]."""
_WINDOW_S = 0.2
"""How long states are watched before a robot is commanded [s]."""
_POLL_S = 0.002
_DAMP_PERIOD_S = 0.01  # between two messages of damping
_LEAST_DAMP_S, _MOST_DAMP_S = 1.0, 3.0
_AT_REST = 0.5  # joint speed below which a damped robot counts as at rest [rad/s]
_KEPT_STATES = 10_000
# Largest share of the robot's rate at which states may come, and the time over which it is counted,
# in which a pause of this computer of 0.2 s with the burst after it passes [s].
_MOST_RATE, _RATE_S = 1.2, 1.0
_MOST_DROPPED = 0.2  # share of the states that may be out of order before a robot is commanded
# A robot's count that went back by more than this belongs to a robot that was started again; one
# that runs ahead of this computer's clock by more than this has jumped [s].
_COUNT_BACK_S, _COUNT_AHEAD_S = 1.0, 0.5
_LEAST_STEP_S = 1e-6


@dataclass(frozen=True, kw_only=True)
class Freshness:
    """How fresh states must be before anything moves."""

    share: float = 0.9  # of the expected number of states that must have come
    longest_gap_s: float = 0.02


def wait_for(done: Callable[[], bool], seconds: float = RESPONSE_S) -> bool:
    """Wait at most `seconds` until a condition holds; return whether it does."""
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() >= end:
            return False
        time.sleep(_POLL_S)
    return True


def await_rest(latest: Callable[[], State | None]) -> None:
    """Wait 1 to 3 s until the newest state is at rest; no state counts as at rest."""

    def at_rest() -> bool:
        state = latest()
        return state is None or bool(np.abs(state.velocity).max() < _AT_REST)

    time.sleep(_LEAST_DAMP_S)
    wait_for(at_rest, _MOST_DAMP_S - _LEAST_DAMP_S)


def unit_quaternion(name: str, values: Array) -> Array:
    """Normalize an attitude; RefusedError `quaternion` for a length that is not 1 within .02."""
    length = math.sqrt(values @ values)
    if not abs(length - 1.0) <= 0.02:
        raise RefusedError(
            "quaternion",
            f"{name} has length {length:.3f}, expected 1 within .02; the inertial unit is not "
            "running, or the order of the numbers is another.",
        )
    return values / length


def port_or_domain(
    what: str, number: int | None, interface: str | None, real: int, virtual: int, allowed: range
) -> int:
    """Number on a wire, by default the `real` robots' with an interface and else `virtual`.

    HardwareError for one that is not allowed, or the real robots' without an interface.
    """
    if number is None:
        return virtual if interface is None else real
    if number not in allowed:
        raise HardwareError(f"{what} {number}; expected {allowed[0]} to {allowed[-1]}.")
    if interface is None and number == real:
        raise HardwareError(
            f"{what} {number} is the real robots'; take another, such as {virtual}, or name the "
            "network interface to the robot as well (for instance eth0)."
        )
    return number


class StateNumbering:
    """Numbers the states of a live robot by the robot's own count, where it has one.

    A count that stood still or went back (`out of order`) and measurements that repeat to the last
    bit (`repeated`) make no state and are counted; so are `clock jumps`, which make one.
    """

    def __init__(
        self, counts: Counter[str], rate_hz: float, *, per_state: int = 1, bits: int = 64
    ) -> None:
        """Start at 0. The robot's count of `bits` grows by `per_state` with each state."""
        self.counts = counts
        self._rate, self._per_state, self._wrap = rate_hz, per_state, 1 << bits
        self._count: int | None = None
        self._time = -math.inf
        self._sequence = -1
        self._measured = b""

    def number(self, measurement: State, count: int | None) -> State | None:
        """Number a measurement.

        Args:
            measurement: A state whose time is its arrival [s]; its sequence does not matter.
            count: The robot's own count, None if it has none.

        Returns:
            The state; simultaneous ones are 1 us apart. None if it is dropped.
        """
        steps = 1
        arrived = measurement.time
        if count is not None and self._count is not None:
            half = self._wrap // 2
            ahead = ((count - self._count + half) % self._wrap - half) / self._per_state
            if -_COUNT_BACK_S * self._rate < ahead <= 0.0:
                self.counts["out of order"] += 1
                return None
            if ahead < 0.0 or ahead > self._rate * (arrived - self._time + _COUNT_AHEAD_S):
                self.counts["clock jumps"] += 1
            else:
                steps = max(1, round(ahead))
        self._count = count
        self._time = arrived = max(arrived, self._time + _LEAST_STEP_S)
        # What never repeats to the last bit while the robot lives.
        measured = (
            measurement.position.tobytes()
            + measurement.velocity.tobytes()
            + measurement.gyro.tobytes()
            + measurement.accelerometer.tobytes()
        )
        if measured == self._measured:
            self.counts["repeated"] += 1
            return None
        self._measured = measured
        self._sequence += steps
        return replace(measurement, time=arrived, sequence=self._sequence)


class CommandWriter:
    """Puts commands on a wire, and damping when they expire. Any thread may call it."""

    def __init__(
        self,
        encode: Encode,
        publish: Publish,
        *,
        damping: Command,
        repeat_s: float | None,
        counts: Counter[str],
    ) -> None:
        """Start the thread that watches the expiry; nothing is written yet.

        `publish` is called by one thread at a time. The command in force is written again after
        `repeat_s` [s]. `counts` gets `commands`, `repeats`, `expired` and `not written`.
        """
        self.counts = counts
        self.wrote = False
        """Whether anything was written at all."""
        self._encode, self._publish, self._repeat_s = encode, publish, repeat_s
        self._damping = encode(damping)
        self._data = b""
        self._expires = self._due = self._wake = math.inf
        self._open = True
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._watch, name="pronk writer", daemon=True)
        self._thread.start()

    def send(self, command: Command) -> None:
        """Put a command into force; damping if it has already expired.

        HardwareError if it is impossible, or if writing failed: then damping follows its expiry.
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
        """Write damping now and repeat it until the next command. Never raises."""
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
        # The thread sleeps until the time that was next when it began to sleep.
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
            # Of any kind: the thread that damps must survive it and try again.
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
    """A robot behind a network. Implements `Machine`; subclasses add the wire.

    A thread receives, timestamps and keeps states, so that their times do not depend on the caller.
    """

    torque_kind: TorqueKind
    state_rate_hz: float
    _writer: CommandWriter | None = None  # None while the link is closed
    _command_topic = _address = ""  # of commands and of states, in error messages
    _repeat_s: float | None = None  # silence after which a command is written again [s]

    def __init__(
        self,
        robot: RobotSpec,
        *,
        clamp_operator: ClampOperator | None = None,
        release: bool = False,
        exclusive_s: float = 1.0,
        fresh: Freshness | None = None,
    ) -> None:
        """Describe the link.

        `release` switches the robot's own controller off first (a standing robot falls then);
        before pronk writes, no command of others may come for `exclusive_s` [s].
        """
        self.robot, self._robot = robot.name, robot
        self._sinking = damping_command(len(robot.joints))
        self.virtual = False
        """Known once connected, when the virtual robot identifies itself."""
        self.counts: Counter[str] = Counter()
        """`states`, `commands`, `repeats`, `expired`, `foreign`, and why messages were dropped."""
        self._clamp_operator, self._release = clamp_operator, release
        self._exclusive_s, self._fresh = exclusive_s, fresh or Freshness()
        self._latest: State | None = None
        self._states: deque[State] = deque(maxlen=_KEPT_STATES)
        self._arrivals: deque[float] = deque()

    def connect(self) -> None:
        """Open the link; HardwareError unless fresh states come and no other program commands.

        It takes 1 or 2 s, in which nothing is written to the joints.
        """
        self.close()
        self.virtual, self._latest, self._last_error = False, None, ""
        self.counts.clear()
        self._states.clear()
        most = 1 + round(_MOST_RATE * _RATE_S * self.state_rate_hz)
        self._arrivals = deque(maxlen=most)
        self._writer = CommandWriter(
            *self._open(),
            damping=self._sinking,
            repeat_s=self._repeat_s,
            counts=self.counts,
        )
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
        """The newest state."""
        self._opened()
        assert self._latest is not None
        return self._latest

    def wait(self, until: float) -> list[State]:
        """Sleep to `until` [s]; return the states that arrived since the last call."""
        delay = until - time.monotonic()
        if delay > 0.0:
            time.sleep(delay)
        return [self._states.popleft() for _ in range(len(self._states))]

    def send(self, command: Command) -> None:
        """Put a command into force until the next or its expiry; refuse where others command."""
        writer = self._opened()
        self.check_exclusive()
        writer.send(command)

    def clamp(self, joints: tuple[str, ...]) -> None:
        """Have joints fixed: by the virtual robot itself, or by a person; () frees all."""
        for name in joints:
            self._robot.joint(name)
        if self.virtual and self._writer is not None:
            if not self._hold(joints):
                raise HardwareError(
                    f"the virtual robot did not confirm its clamps within {RESPONSE_S:g} s; check "
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
        """Write damping now and repeat it until the next command. Never raises."""
        if self._writer is not None:
            self._writer.damp()

    def open_damper(self) -> Callable[[], None] | None:
        """Open the wire to write damping beside the process that commands, once a call.

        None where the wire has one writer.
        """
        return None

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

    def fresh_states(self, *, until: float) -> list[State]:
        """Return the first window of states that is fresh; HardwareError if none is by `until`."""
        expected, fresh = self.state_rate_hz * _WINDOW_S, self._fresh
        while True:
            self.wait(0.0)  # drops earlier states
            states = self.wait(time.monotonic() + _WINDOW_S)
            gap = float(np.diff([s.time for s in states]).max()) if len(states) > 1 else np.inf
            if len(states) >= fresh.share * expected and gap <= fresh.longest_gap_s:
                return states
            # A busy computer may miss a window; a robot that is too slow misses all.
            if time.monotonic() > until:
                raise HardwareError(
                    f"{self.robot} sent {len(states)} fresh states in {_WINDOW_S * 1e3:.0f} ms "
                    f"with a longest gap of {gap * 1e3:.0f} ms, expected about {expected:.0f} with "
                    f"none above {fresh.longest_gap_s * 1e3:.0f} ms; check the network and that "
                    "this computer is not busy."
                )

    def check_exclusive(self) -> None:
        """Raise HardwareError if another program has commanded, or another robot sent states."""
        if foreign := self.foreign_commands:
            raise HardwareError(
                f"another program commands the joints: {foreign} commands on "
                f"{self._command_topic}; stop that program, or release the robot's own controller, "
                "and connect again."
            )
        found = ""
        if (sources := self.sources) > 1:
            found = f"{sources} robots or programs send states"
        elif self.counts["crowded"]:
            found = f"more than {_MOST_RATE * self.state_rate_hz:.0f} states a second come"
        if found:
            raise HardwareError(
                f"{found} on {self._address}, expected one that sends "
                f"{self.state_rate_hz:.0f} a second; switch the others off, or take another port "
                "or domain, and connect again."
            )

    # Both count from when the link was opened.

    @property
    def sources(self) -> int:
        """Senders of states; 1 where the wire does not identify them."""
        return 1

    @property
    def foreign_commands(self) -> int:
        """Commands of others."""
        return self.counts["foreign"]

    def _opened(self) -> CommandWriter:
        if self._writer is None:
            raise HardwareError(f"the link to {self.robot} is not open; call connect() first.")
        return self._writer

    def _preflight(self) -> None:
        begun = time.monotonic()
        if not wait_for(lambda: self._latest is not None):
            why = f"; what came was refused: {self._last_error}" if self._last_error else ""
            raise HardwareError(
                f"{self.robot} sent no state on {self._address} within {RESPONSE_S:g} s{why}; "
                "check that its program or the virtual robot runs, the link's options and the "
                "network."
            )
        self._prepare()
        self.counts["foreign"], silent_from = 0, time.monotonic()
        self.fresh_states(until=begun + 2.0 * RESPONSE_S)
        time.sleep(max(0.0, silent_from + self._exclusive_s - time.monotonic()))
        self.check_exclusive()
        if self.counts["out of order"] > max(10.0, _MOST_DROPPED * self.counts["states"]):
            raise HardwareError(
                f"{self.counts['out of order']} of {self.counts['states']} states on "
                f"{self._address} are out of order, as of two robots; switch one off, or take "
                "another port or domain."
            )
        self._confirm()
        self.wait(0.0)

    def _read(self) -> None:
        while self._reading:
            self._receive()

    def _take(self, decode: Callable[..., State | None], *given: Any) -> None:
        """Keep the state that `decode(*given)` returns, if any; count a refused message."""
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
            arrivals, now = self._arrivals, time.monotonic()
            arrivals.append(now)
            if len(arrivals) == arrivals.maxlen and now - arrivals[0] < _RATE_S:
                self.counts["crowded"] += 1

    # --- the wire -------------------------------------------------------------------------------

    @abstractmethod
    def _open(self) -> tuple[Encode, Publish]:
        """Open the wire; return what encodes a command and what puts its bytes on the wire."""

    @abstractmethod
    def _receive(self) -> None:
        """Wait at most 50 ms for messages and `_take` them; called by the reading thread."""

    @abstractmethod
    def _shut(self) -> None:
        """Close the wire; the writer and the reading thread have stopped."""

    def _prepare(self) -> None:  # noqa: B027
        """Release the robot's own controller, after the first state and before all checks."""

    def _confirm(self) -> None:  # noqa: B027
        """Identify the virtual robot, after all other checks."""

    def _hold(self, joints: tuple[str, ...]) -> bool:
        """Make the virtual robot fix joints; return whether it confirmed."""
        return False


class Codec(Protocol):
    """Decodes states and encodes commands, without a socket."""

    name: str  # of the wire, in error messages
    state_rate_hz: float
    torque_kind: TorqueKind

    def encode(self, command: Command) -> bytes:
        """Encode a command; HardwareError for an impossible one (`check_command`)."""

    def decode(self, data: bytes) -> State:
        """Decode a state, whose time and sequence the link replaces; RefusedError if it is none."""


class Transport(Protocol):
    """Moves bytes; open from the beginning."""

    local: bool  # nothing can leave this computer; required without an interface

    def receive(self, timeout_s: float) -> list[bytes]:
        """Messages that have come, oldest first; waits at most that long for the first."""

    def send(self, data: bytes) -> None:
        """Send a command."""

    def foreign_commands(self) -> int:
        """Commands of other programs since it was opened; 0 where the wire has one writer."""

    def close(self) -> None:
        """Close."""


class StreamLink(NetworkLink):
    """A robot behind a codec and a transport; `pronk.testing.check_link` checks both."""

    def __init__(
        self,
        robot: RobotSpec,
        codec: Codec,
        transport: Callable[[], Transport],
        *,
        repeat_s: float | None = None,
        **common: Any,
    ) -> None:
        """Describe the link; `transport` opens the wire, `common` is as of `NetworkLink`."""
        super().__init__(robot, **common)
        self.torque_kind, self.state_rate_hz = codec.torque_kind, codec.state_rate_hz
        self._codec, self._make, self._repeat_s = codec, transport, repeat_s
        self._command_topic = self._address = codec.name

    @property
    def foreign_commands(self) -> int:
        """Commands of others."""
        return self._transport.foreign_commands()

    def _open(self) -> tuple[Encode, Publish]:
        self._sequence = -1
        self._transport = self._make()
        return self._codec.encode, self._transport.send

    def _receive(self) -> None:
        for data in self._transport.receive(0.05):
            self._take(self._numbered, data)

    def _numbered(self, data: bytes) -> State:
        state = self._codec.decode(data)
        self._sequence += 1
        return replace(state, time=time.monotonic(), sequence=self._sequence)

    def _shut(self) -> None:
        self._transport.close()
