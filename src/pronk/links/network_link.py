"""A robot behind a network, but for its wire: opening, states, commands, clamps and the end.

Whatever the wire, a robot is looked at before anything is written to it, a link that is not open
says so, a second writer stops the first, and a robot is left damped and at rest.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from typing import ClassVar, Protocol

from pronk.errors import HardwareError
from pronk.links.link_checks import Hand, await_rest, check_still_alone, clamp
from pronk.links.machine import Command, State, TorqueKind
from pronk.links.preflight import Freshness
from pronk.robots.robot import Robot


class Writer(Protocol):
    """The only writer of commands on a link."""

    @property
    def wrote(self) -> bool:
        """Whether anything was written at all."""

    def send(self, command: Command) -> None:
        """Put a command into force; one that has expired already becomes damping.

        Raises:
            HardwareError: No drive could follow it, or the wire does not take it.
        """

    def damp(self) -> None:
        """Write damping now, and go on until the next command. Never raises."""


class NetworkLink(ABC):
    """What implements `Machine` on every wire alike.

    `virtual` is known once connected: the virtual robot says on the wire what it is.
    """

    wire: ClassVar[str]
    """Its name, as messages say it."""
    torque_kind: TorqueKind

    def __init__(
        self,
        robot: Robot,
        *,
        hand: Hand | None,
        release: bool,
        alone_s: float,
        fresh: Freshness | None,
    ) -> None:
        """Describe the link; nothing is opened yet.

        Args:
            robot: Names, order and limits of the joints.
            hand: Who fixes joints on a real bench; None if nobody.
            release: Ask the robot's own controller to let go of the joints first.
            alone_s: How long the topic of commands must be silent before pronk writes to it [s].
            fresh: How fresh states must be; None for what moving a robot takes.
        """
        self.robot = robot.name
        self.virtual = False
        self._robot = robot
        self._hand = hand
        self._release = release
        self._alone_s = alone_s
        self._fresh = fresh

    def connect(self) -> None:
        """Open the link and check that the robot is fit to move. One or two seconds.

        Raises:
            HardwareError: A check failed; nothing was written to the robot's joints.
        """
        self.close()
        self.virtual = False
        self._open()
        try:
            self._preflight()
        except BaseException:
            self.close()
            raise

    def now(self) -> float:
        """The local monotonic clock [s]."""
        return time.monotonic()

    def latest(self) -> State:
        """The newest state, without waiting.

        Raises:
            HardwareError: Not connected.
        """
        self._opened()
        state = self._newest()
        if state is None:
            raise self._not_open()
        return state

    def wait(self, until: float) -> list[State]:
        """Sleep to `until` [s]; return the states that arrived since the last call."""
        delay = until - time.monotonic()
        if delay > 0.0:
            time.sleep(delay)
        return self._arrived()

    def send(self, command: Command) -> None:
        """Put a command into force, until the next or until it expires.

        Raises:
            HardwareError: Not connected, not possible, or someone else has commanded since.
        """
        writer = self._opened()
        check_still_alone(self._foreign_commands, self._command_topic)
        writer.send(command)

    def clamp(self, joints: tuple[str, ...]) -> None:
        """Have joints fixed: by the virtual robot itself, or by a person's hand.

        Raises:
            HardwareError: A joint is unknown, nobody is there to fix it, or no answer came.
        """
        virtual = self.virtual and self._writer is not None
        clamp(self._robot, joints, hold=self._hold if virtual else None, hand=self._hand)

    def damp(self) -> None:
        """Write damping now and go on until a command or the end. Never raises."""
        if self._writer is not None:
            self._writer.damp()

    def close(self) -> None:
        """Leave the robot damped and at rest, and close; closing twice does no harm.

        Takes 1 s of damping at least, 3 s at most; no time at all if nothing was ever sent.
        """
        writer = self._writer
        if writer is None:
            return
        if writer.wrote:
            writer.damp()
            await_rest(self._newest)
        self._shut()

    def _opened(self) -> Writer:
        writer = self._writer
        if writer is None:
            raise self._not_open()
        return writer

    def _not_open(self) -> HardwareError:
        return HardwareError(
            f"the {self.wire} link to {self.robot} is not open; call connect() first."
        )

    # --- the wire -------------------------------------------------------------------------------

    @property
    @abstractmethod
    def _writer(self) -> Writer | None:
        """None while the link is closed."""

    @property
    @abstractmethod
    def _command_topic(self) -> str:
        """Where commands are written."""

    @property
    @abstractmethod
    def _foreign_commands(self) -> int:
        """Commands of others met since the link was opened."""

    @abstractmethod
    def _open(self) -> None:
        """Begin to listen, and make the writer."""

    @abstractmethod
    def _preflight(self) -> None:
        """Check that the robot is fit to move, and find out whether it is the virtual one."""

    @abstractmethod
    def _shut(self) -> None:
        """Fall silent and close."""

    @abstractmethod
    def _newest(self) -> State | None:
        """The newest state; None before the first."""

    @abstractmethod
    def _arrived(self) -> list[State]:
        """The states since the last call, oldest first."""

    @abstractmethod
    def _hold(self, joints: tuple[str, ...]) -> bool:
        """Ask the virtual robot to fix joints; whether it confirmed."""
