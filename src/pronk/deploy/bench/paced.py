"""The virtual robot in this program, in real time: the link `sim` of `pronk deploy`."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from pronk.deploy.links.link import LinkSettings
from pronk.deploy.links.realtime import sleep_until
from pronk.jump.virtual import capture
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.robots.machine import Command, State, TorqueKind
from pronk.robots.robot import RobotSpec

CAPTURE_RATE_HZ = 1000.0
"""Samples per second of a recorded trajectory; a second takes 0.7 MB of memory."""


class PacedRobot:
    """A virtual robot in real time, on CLOCK_MONOTONIC. Implements `TrajectoryMachine`.

    `wait` runs the physics to the given time and then sleeps until it comes: nothing can be sent in
    between, and the physics does not delay the loop.
    """

    virtual = True

    def __init__(self, inner: VirtualRobot) -> None:
        """Wrap a virtual robot that is not connected yet."""
        self.inner = inner
        self.robot = inner.robot
        self.torque_kind: TorqueKind = inner.torque_kind
        self.state_rate_hz = inner.state_rate_hz
        self._offset = 0.0

    def connect(self) -> None:
        """Start both clocks."""
        self.inner.connect()
        self._offset = time.monotonic() - self.inner.now()

    def now(self) -> float:
        """Return the time of CLOCK_MONOTONIC [s]."""
        return time.monotonic()

    def latest(self) -> State:
        """Return the newest state."""
        return self._shifted(self.inner.latest())

    def wait(self, until: float) -> list[State]:
        """Let time pass to `until` [s]; return the states measured meanwhile."""
        states = self.inner.wait(until - self._offset)
        sleep_until(until)
        return [self._shifted(state) for state in states]

    def send(self, command: Command) -> None:
        """Put a command into force."""
        self.inner.send(command)

    def clamp(self, joints: tuple[str, ...]) -> None:
        """Fix joints where they are, on the bench; () frees all."""
        self.inner.clamp(joints)

    def damp(self) -> None:
        """Damp the joints without stiffness."""
        self.inner.damp()

    def close(self) -> None:
        """Damp and close; closing twice does no harm."""
        self.inner.close()

    def keep_trajectory(self) -> None:
        """Keep the trajectory from the connection on, as cameras around the robot would see it."""
        self.inner.capture_rate_hz = CAPTURE_RATE_HZ

    def save_trajectory(self, path: Path) -> None:
        """Write the trajectory, an .npz of `pronk.jump.virtual.capture`.

        Raises:
            OSError: The file cannot be written.
            PronkError: Nothing was captured.
        """
        capture.save_capture(path, self.inner.capture())

    def _shifted(self, state: State) -> State:
        """Return a state with its time on CLOCK_MONOTONIC."""
        return replace(state, time=state.time + self._offset)


def open_sim(
    robot: RobotSpec,
    *,
    interface: str | None = None,
    seed: int = 0,
    params: str | None = None,
    settings: LinkSettings | None = None,
) -> PacedRobot:
    """Make the virtual robot of an address `sim://BASE?seed=0&params=FILE`, not yet connected.

    Args:
        robot: Structure, masses and drives.
        interface: What holds the trunk, `bench` or `ground`; the ground if None.
        seed: Seed of all noise.
        params: Path of the virtual robot's parameters; those that ship with pronk if None.
        settings: Settings of a network link, without meaning here.
    """
    base: Any = interface or "ground"
    sim_params = load_sim_params(params, robot)
    return PacedRobot(VirtualRobot(robot, sim_params, seed=seed, base=base, capture_rate_hz=None))
