"""A robot behind a network, but for its wire: opening, states, commands, clamps and the end.

Before anything is written, states are fresh and no other program commands; a joint is fixed by the
virtual robot itself or by a person; a second writer stops the first; and at the end the robot is
damped until it is at rest.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

import numpy as np

from pronk.errors import HardwareError
from pronk.links.command_writer import CommandWriter
from pronk.links.machine import Command, State, TorqueKind
from pronk.links.state_checks import WINDOW_S, Freshness, check_rate
from pronk.robots.robot import Robot

ClampOperator = Callable[[tuple[str, ...]], None]
"""A person at the bench: receives the joints to fix and returns when they are."""

ANSWER_S = 2.0
"""Time for a robot's first state, or for its reply to a request [s]."""
_POLL_S = 0.002
_DAMP_AT_LEAST_S, _DAMP_AT_MOST_S = 1.0, 3.0
_AT_REST = 0.5
"""Joint speed below which a robot that is being left counts as at rest [rad/s]."""


def wait_for(done: Callable[[], bool], seconds: float = ANSWER_S) -> bool:
    """Wait at most `seconds` until a condition holds; whether it does."""
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() >= end:
            return False
        time.sleep(_POLL_S)
    return True


def await_rest(latest: Callable[[], State | None]) -> None:
    """Wait until a robot that is being damped is at rest: 1 s at least, 3 s at most.

    Args:
        latest: Its newest state; None counts as at rest.
    """
    begun = time.monotonic()
    while (spent := time.monotonic() - begun) < _DAMP_AT_MOST_S:
        state = latest()
        speed = np.abs(state.velocity).max() if state is not None else 0.0
        if spent >= _DAMP_AT_LEAST_S and speed < _AT_REST:
            break
        time.sleep(_POLL_S)


class NetworkLink(ABC):
    """What implements `Machine` on every wire alike.

    `virtual` is known once connected: the virtual robot identifies itself on the wire.
    """

    wire: ClassVar[str]
    """Its name in error messages."""
    torque_kind: TorqueKind
    _writer: CommandWriter | None = None
    """None while the link is closed."""
    _command_topic: str = ""
    """Where commands are written."""

    def __init__(
        self,
        robot: Robot,
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
            release: Make the robot's own controller let go of the joints first; a standing robot
                falls then.
            exclusive_s: How long the topic of commands must be silent before pronk writes [s].
            fresh: How fresh states must be; None for what moving a robot takes.
        """
        self.robot = robot.name
        self.virtual = False
        self._robot = robot
        self._clamp_operator = clamp_operator
        self._release = release
        self._exclusive_s = exclusive_s
        self._fresh = fresh

    def connect(self) -> None:
        """Open the link and check that states come and no other program commands. 1 or 2 s.

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
            HardwareError: Not connected, not possible, or another program has commanded since.
        """
        writer = self._opened()
        if self._foreign_commands:
            raise HardwareError(
                f"another program commands the joints on {self._command_topic} "
                f"({self._foreign_commands} commands met); stop it, and connect again."
            )
        writer.send(command)

    def clamp(self, joints: tuple[str, ...]) -> None:
        """Have joints fixed: by the virtual robot itself, or by a person; () frees all.

        Raises:
            RobotError: A joint is unknown.
            HardwareError: There is no clamp operator, or no reply came.
        """
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
                f"{', '.join(joints)} must be fixed mechanically and nobody is at the bench; "
                "choose joints that need no clamp, or have someone there who confirms it."
            )

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
        writer.stop()
        self._shut()
        self._writer = None

    def fresh_states(self, rate_hz: float, *, until: float) -> list[State]:
        """Watch one window of states after another until they come often enough, without gaps.

        Args:
            rate_hz: Expected.
            until: Windows that end no later may fail, on the local monotonic clock [s].

        Returns:
            The states of the first window that is good.

        Raises:
            HardwareError: None was by then.
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
        """Check, `exclusive_s` after `since` [s], that no other program has commanded.

        Raises:
            HardwareError: One has.
        """
        time.sleep(max(0.0, since + self._exclusive_s - time.monotonic()))
        if self._foreign_commands:
            raise HardwareError(
                f"another program commands the joints: {self._foreign_commands} commands on "
                f"{self._command_topic} within {self._exclusive_s:g} s; stop that program, or "
                "release the robot's own controller."
            )

    def _opened(self) -> CommandWriter:
        if self._writer is None:
            raise self._not_open()
        return self._writer

    def _not_open(self) -> HardwareError:
        return HardwareError(
            f"the {self.wire} link to {self.robot} is not open; call connect() first."
        )

    # --- the wire -------------------------------------------------------------------------------

    @property
    @abstractmethod
    def _foreign_commands(self) -> int:
        """Commands of others met since the link was opened."""

    @abstractmethod
    def _open(self) -> None:
        """Begin to listen, and make the writer."""

    @abstractmethod
    def _preflight(self) -> None:
        """Check states and other programs, and find out whether it is the virtual robot."""

    @abstractmethod
    def _shut(self) -> None:
        """Close the wire; the writer has stopped."""

    @abstractmethod
    def _newest(self) -> State | None:
        """The newest state; None before the first."""

    @abstractmethod
    def _arrived(self) -> list[State]:
        """The states since the last call, oldest first."""

    def _hold(self, joints: tuple[str, ...]) -> bool:
        """Make the virtual robot fix joints; whether it confirmed."""
        return False
