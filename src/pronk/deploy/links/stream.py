"""A robot whose state is one message and whose command is one message.

It needs only a `Codec` and a `Transport`; docs/evidence/hardware.md has an example.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

from pronk.deploy.links.link import LinkSettings, NetworkLink
from pronk.deploy.links.writer import Encode, Publish
from pronk.robots.machine import Command, State, TorqueKind
from pronk.robots.robot import RobotSpec


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
    """A robot behind a codec and a transport.

    `pronk.testing.check_link` checks both.
    """

    def __init__(
        self,
        robot: RobotSpec,
        codec: Codec,
        transport: Callable[[], Transport],
        *,
        repeat_s: float | None = None,
        settings: LinkSettings | None = None,
    ) -> None:
        """Describe the link.

        Args:
            robot: The robot.
            codec: Decodes its states and encodes commands.
            transport: Opens the wire.
            repeat_s: Silence after which a command is written again [s]; None for never.
            settings: Settings of every link; the usual if None.
        """
        super().__init__(robot, settings)
        self.torque_kind = codec.torque_kind
        self.state_rate_hz = codec.state_rate_hz
        self._codec = codec
        self._open_transport = transport
        self._repeat_s = repeat_s
        self._command_topic = codec.name
        self._address = codec.name

    @property
    def foreign_commands(self) -> int:
        """Commands of others."""
        return self._transport.foreign_commands()

    # --- the wire -------------------------------------------------------------------------------

    def _open(self) -> tuple[Encode, Publish]:
        self._sequence = -1
        self._transport = self._open_transport()
        return self._codec.encode, self._transport.send

    def _receive(self) -> None:
        for data in self._transport.receive(0.05):
            self._take(self._decode, data, time.monotonic())

    def _decode(self, data: bytes, arrived: float) -> State:
        """Decode a state, with the time of its arrival [s] and the link's own number."""
        state = self._codec.decode(data)
        self._sequence += 1
        return replace(state, time=arrived, sequence=self._sequence)

    def _shut(self) -> None:
        self._transport.close()
