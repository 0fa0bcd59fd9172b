"""Which machine a link's name means, opened in the process that will own it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Protocol

from pronk.links.address import Address
from pronk.links.machine import Command, Machine, State, TorqueKind
from pronk.links.network_link import ClampOperator
from pronk.links.realtime import sleep_until
from pronk.links.state_checks import Freshness
from pronk.virtual.robot import VirtualRobot


class Opener(Protocol):
    """Makes a machine, not yet connected. It is pickled and sent to the servo process."""

    @property
    def robot(self) -> str:
        """Name of the robot that it opens."""

    def __call__(self, clamp_operator: ClampOperator | None = None) -> Machine:
        """The machine; `clamp_operator` fixes joints on a real bench."""


@dataclass(frozen=True, kw_only=True)
class Link:
    """A robot at an address. Implements `Opener`."""

    robot: str
    address: Address = field(default_factory=Address)
    release: bool = False
    """Make the robot's own controller let go of the joints first."""
    fresh: Freshness | None = None
    """How fresh states must be at first; the usual if None."""

    def __call__(self, clamp_operator: ClampOperator | None = None) -> Machine:
        """Make the machine, not yet connected; the virtual robot in real time.

        Raises:
            HardwareError: The link's library is not installed.
        """
        from pronk.robots import load_robot

        machine = self.address.machine(
            load_robot(self.robot),
            clamp_operator=clamp_operator,
            release=self.release,
            fresh=self.fresh,
        )
        return Paced(machine) if isinstance(machine, VirtualRobot) else machine

    @property
    def local(self) -> bool:
        """True where nothing leaves this computer, so that no real robot can move."""
        return self.address.local

    def __str__(self) -> str:
        return str(self.address)


class Paced:
    """The virtual robot in real time, on CLOCK_MONOTONIC. Implements `Machine`.

    `wait` first lets the physics run ahead to the time waited for and then sleeps until that time
    comes. Nothing can be sent in between, so it is the same as if both passed together, and what
    the physics costs does not make the loop late.
    """

    virtual = True

    def __init__(self, inner: VirtualRobot) -> None:
        """Wrap a virtual robot that is not connected yet."""
        self.inner = inner
        self.robot = inner.robot
        self.torque_kind: TorqueKind = inner.torque_kind
        self._offset = 0.0

    def now(self) -> float:
        """CLOCK_MONOTONIC [s]."""
        return time.monotonic()

    def connect(self) -> None:
        """Start both clocks."""
        self.inner.connect()
        self._offset = time.monotonic() - self.inner.now()

    def latest(self) -> State:
        """The newest state."""
        return self._shifted(self.inner.latest())

    def wait(self, until: float) -> list[State]:
        """Let time pass to `until`; return the states met on the way."""
        states = self.inner.wait(until - self._offset)
        sleep_until(until)
        return [self._shifted(state) for state in states]

    def send(self, command: Command) -> None:
        """Put a command into force."""
        self.inner.send(command)

    def clamp(self, joints: tuple[str, ...]) -> None:
        """Fix joints where they are."""
        self.inner.clamp(joints)

    def damp(self) -> None:
        """Let the joints sink softly."""
        self.inner.damp()

    def close(self) -> None:
        """Damp and close."""
        self.inner.close()

    def _shifted(self, state: State) -> State:
        return replace(state, time=state.time + self._offset)
