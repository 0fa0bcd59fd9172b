"""A machine that goes wrong on demand, and writes down what it is sent. It really runs."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pronk.errors import HardwareError
from pronk.links.address import Address
from pronk.links.machine import Command, State
from pronk.runtime.plan import Link, Paced


@dataclass(frozen=True, kw_only=True)
class FaultyLink(Link):
    """Opens the virtual robot on its stand, with faults that events switch on."""

    robot: str = "mini_cheetah"

    wire: Path
    """Gets one line for each write: when, and what."""
    nan: Any
    """Event: a joint's speed is not a number."""
    freeze: Any
    """Event: states stop coming."""
    stuck: Any
    """Event: states come with fresh stamps and old numbers."""
    broken: Any = None
    """Event: the link complains at every look; None for never."""
    loss: float = 0.0
    """Share of the states that is lost."""

    def __call__(self, clamp_operator: object = None) -> Faulty:
        return Faulty(Link(robot=self.robot, address=Address.parse("sim://bench"))(), self)


class Faulty:
    """The virtual robot behind a bad link. Implements `Machine`."""

    def __init__(self, inner: Any, link: FaultyLink) -> None:
        assert isinstance(inner, Paced)
        self.inner, self.link = inner, link
        self.robot, self.virtual, self.torque_kind = inner.robot, True, inner.torque_kind
        self.state_rate_hz = inner.state_rate_hz
        self._rng = np.random.default_rng(0)
        self._last: State | None = None

    def now(self) -> float:
        return self.inner.now()

    def connect(self) -> None:
        self.inner.connect()
        self._wire = self.link.wire.open("w", buffering=1)

    def latest(self) -> State:
        return self._last or self.inner.latest()

    def wait(self, until: float) -> list[State]:
        if self.link.broken is not None and self.link.broken.is_set():
            raise HardwareError("the cable was pulled out.")
        met = [state for state in self.inner.wait(until) if self._rng.random() >= self.link.loss]
        if self.link.freeze.is_set():
            met = []
        if self.link.nan.is_set():
            met = [replace(state, velocity=_spoilt(state.velocity)) for state in met]
        if self.link.stuck.is_set() and self._last is not None:
            old = self._last
            met = [replace(old, time=state.time, sequence=state.sequence) for state in met]
        if met:
            self._last = met[-1]
        return met

    def send(self, command: Command) -> None:
        stiffness = float(np.max(command.stiffness))
        self._wire.write(f"{time.monotonic():.6f} send {stiffness:.3f}\n")
        self.inner.send(command)

    def damp(self) -> None:
        self._wire.write(f"{time.monotonic():.6f} damp 0\n")
        self.inner.damp()

    def clamp(self, joints: tuple[str, ...]) -> None:
        self.inner.clamp(joints)

    def close(self) -> None:
        self.inner.close()
        self._wire.close()


def _spoilt(values: np.ndarray) -> np.ndarray:
    changed = values.copy()
    changed[3] = math.nan
    return changed


def writes(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """When something was written [s], and whether it was damping."""
    rows = [line.split() for line in path.read_text().splitlines() if line.count(" ") == 2]
    return np.array([float(row[0]) for row in rows]), np.array([row[1] == "damp" for row in rows])
