"""A link of three parts: encode, decode and a transport.

A robot whose state is one message and whose command is one message needs no more than a `Codec`
and a `Transport`; what every link does (freshness, expiry, damping, a second writer) comes with
`StreamLink`:

    def my_link(robot, *, interface=None, speed: int = 115200, **common):
        return StreamLink(robot, MyCodec(robot), lambda: MyTransport(interface, speed), **common)

named as an entry point of the group `pronk.links`, is reached at `my_link://ttyUSB0?speed=9600`.
`pronk.testing.check_link` checks a codec and its transport.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

from pronk.errors import HardwareError
from pronk.links.command_writer import CommandWriter
from pronk.links.machine import Command, RefusedError, State, TorqueKind
from pronk.links.network_link import ANSWER_S, NetworkLink, wait_for
from pronk.robots.robot import Robot

_KEPT_STATES = 10_000


class Codec(Protocol):
    """Bytes to states and commands to bytes, without a socket."""

    name: str
    """Of the wire, in error messages."""
    state_rate_hz: float
    torque_kind: TorqueKind

    def encode(self, command: Command) -> bytes:
        """Encode a command.

        Raises:
            HardwareError: No drive could follow it (`pronk.links.machine.check_command`).
        """

    def decode(self, data: bytes) -> State:
        """Decode a state; its time and sequence are replaced by the link.

        Raises:
            RefusedError: The bytes are not a state of such a robot.
        """


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
        robot: Robot,
        codec: Codec,
        transport: Callable[[], Transport],
        *,
        repeat_s: float | None = None,
        **common: Any,
    ) -> None:
        """Describe the link; nothing is opened yet.

        Args:
            robot: Names, order and limits of the joints.
            codec: Of its messages.
            transport: Opens the wire.
            repeat_s: Time after which the command in force is written again; None for once.
            **common: As `NetworkLink` takes them.
        """
        super().__init__(robot, **common)
        self.torque_kind = codec.torque_kind
        self.counts: Counter[str] = Counter()
        self._codec, self._make, self._repeat_s = codec, transport, repeat_s
        self._command_topic = self.wire = codec.name  # type: ignore[misc]

    @property
    def _foreign_commands(self) -> int:
        return self._transport.foreign_commands()

    def _open(self) -> None:
        self.counts.clear()
        self._latest: State | None = None
        self._states: deque[State] = deque(maxlen=_KEPT_STATES)
        self._transport = self._make()
        self._writer = CommandWriter(
            self._codec.encode,
            self._transport.send,
            joints=len(self._robot.joints),
            repeat_s=self._repeat_s,
            counts=self.counts,
        )
        self._reading = True
        self._thread = threading.Thread(target=self._read, name="pronk reader", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        sequence = 0
        while self._reading:
            for data in self._transport.receive(0.05):
                try:
                    state = self._codec.decode(data)
                except RefusedError as error:
                    self.counts[f"refused: {error.reason}"] += 1
                    continue
                self._latest = replace(state, time=time.monotonic(), sequence=sequence)
                self._states.append(self._latest)
                sequence += 1

    def _preflight(self) -> None:
        begun = time.monotonic()
        if not wait_for(lambda: self._latest is not None):
            raise HardwareError(
                f"{self.robot} sent no state over {self.wire} within {ANSWER_S:g} s "
                f"({dict(self.counts)}); check that its program runs, and the cable."
            )
        self.fresh_states(self._codec.state_rate_hz, until=begun + 2.0 * ANSWER_S)
        self.check_exclusive(begun)

    def _shut(self) -> None:
        self._reading = False
        self._thread.join()
        self._transport.close()

    def _newest(self) -> State | None:
        return self._latest

    def _arrived(self) -> list[State]:
        return [self._states.popleft() for _ in range(len(self._states))]
