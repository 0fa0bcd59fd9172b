"""A machine that goes wrong on demand, and writes down what it is sent. It really runs."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pronk.deploy.links.address import Address
from pronk.deploy.runtime.plan import Link
from pronk.errors import HardwareError
from pronk.robots.machine import Command, State


@dataclass(frozen=True, kw_only=True)
class FaultyLink(Link):
    """Opens the virtual robot on its stand, with faults that events switch on."""

    robot: str = "mini_cheetah"

    wire: Path
    """Gets one line for each write: when, and what."""
    faults: Mapping[str, Any] = field(default_factory=dict)
    """Events: `nan`, a joint's speed is not a number; `freeze`, states stop coming; `stuck`, states
    come with fresh stamps and old numbers; `broken`, the link complains at every look."""
    loss: float = 0.0
    """Share of the states that is lost."""

    def __call__(self, clamp_operator: object = None) -> Faulty:
        return Faulty(Link(robot=self.robot, address=Address.parse("sim://bench"))(), self)


class Faulty:
    """The virtual robot behind a bad link. Implements `Machine`."""

    def __init__(self, inner: Any, link: FaultyLink) -> None:
        self.inner, self.link = inner, link
        self.robot, self.virtual, self.torque_kind = inner.robot, True, inner.torque_kind
        self.state_rate_hz, self.now, self.clamp = inner.state_rate_hz, inner.now, inner.clamp
        self._rng = np.random.default_rng(0)
        self._last: State | None = None

    def connect(self) -> None:
        self.inner.connect()
        self._wire = self.link.wire.open("w", buffering=1)

    def latest(self) -> State:
        return self._last or self.inner.latest()

    def wait(self, until: float) -> list[State]:
        on = {name for name, event in self.link.faults.items() if event.is_set()}
        if "broken" in on:
            raise HardwareError("the cable was pulled out.")
        met = [state for state in self.inner.wait(until) if self._rng.random() >= self.link.loss]
        if "freeze" in on:
            met = []
        if "nan" in on:
            wrong = np.where(np.arange(12) == 3, math.nan, 0.0)
            met = [replace(state, velocity=state.velocity + wrong) for state in met]
        if "stuck" in on and self._last is not None:
            old = self._last
            met = [replace(old, time=state.time, sequence=state.sequence) for state in met]
        if met:
            self._last = met[-1]
        return met

    def send(self, command: Command) -> None:
        self._write("send")
        self.inner.send(command)

    def damp(self) -> None:
        self._write("damp")
        self.inner.damp()

    def close(self) -> None:
        self.inner.close()
        self._wire.close()

    def _write(self, what: str) -> None:
        self._wire.write(f"{time.monotonic():.6f} {what}\n")


def writes(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """When something was written [s], and whether it was damping."""
    rows = [line.split() for line in path.read_text().splitlines() if line[-4:] in ("send", "damp")]
    return np.array([float(row[0]) for row in rows]), np.array([row[1] == "damp" for row in rows])
