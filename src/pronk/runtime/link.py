"""Which machine a link's name means, opened in the process that will own it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol

from pronk.errors import HardwareError
from pronk.links.machine import Command, Machine, State, TorqueKind
from pronk.links.open import WIRES, Address
from pronk.links.realtime import sleep_until

if TYPE_CHECKING:
    from pronk.virtual.robot import VirtualRobot

LINKS = ("sim", *WIRES)


class Opener(Protocol):
    """Makes a machine, not yet connected. It is pickled and sent to the servo process."""

    @property
    def robot(self) -> str:
        """Name of the robot that it opens."""

    def __call__(self) -> Machine:
        """The machine."""


@dataclass(frozen=True, kw_only=True)
class Link:
    """A link by its name. Implements `Opener`."""

    kind: str
    """One of `LINKS`."""
    robot: str
    interface: str | None = None
    """Network interface; None is loopback."""
    layout: str = "cheetah"
    """Of LCM's messages: `cheetah` or `wtw`."""
    port: int | None = None
    """Of LCM; None for the virtual robot's on loopback and the robots' on an interface."""
    domain: int | None = None
    """Of DDS; None for the virtual robot's on loopback and the robots' on an interface."""
    release: bool = False
    """Make the robot's own controller let go of the joints first."""
    sim_params: Path | None = None
    """Of the virtual robot; None for the one that comes with pronk."""
    seed: int = 0
    """Of the virtual robot's noise."""
    base: Literal["bench", "ground"] = "ground"
    """How the virtual robot is set up."""

    def __post_init__(self) -> None:
        """Refuse a link that there is not.

        Raises:
            HardwareError: Names those there are.
        """
        if self.kind not in LINKS:
            raise HardwareError(f"link {self.kind!r}; the links are {', '.join(LINKS)}.")

    def __call__(self) -> Machine:
        """The machine, not yet connected.

        Raises:
            HardwareError: The link's library is not installed.
        """
        if self.kind == "sim":
            return Paced(self._virtual())
        from pronk.robots import load_robot

        lcm = self.kind == "lcm"
        address = Address(
            kind=self.kind,
            interface=self.interface,
            layout=self.layout if lcm else None,
            port=self.port if lcm else None,
            domain=None if lcm else self.domain,
        )
        return address.machine(load_robot(self.robot), release=self.release)

    @property
    def local(self) -> bool:
        """True where nothing leaves this computer, so that no real robot can move."""
        return self.kind == "sim" or self.interface is None

    def __str__(self) -> str:
        where = "" if self.kind == "sim" else f" on {self.interface or 'loopback'}"
        return f"{self.kind}{where}"

    def _virtual(self) -> VirtualRobot:
        from pronk.robots import load_robot
        from pronk.virtual.robot import VirtualRobot
        from pronk.virtual.sim_params import load_sim_params

        robot = load_robot(self.robot)
        return VirtualRobot(robot, load_sim_params(self.sim_params), seed=self.seed, base=self.base)


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
