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
from pronk.robots.machine import Command, Machine, State, TorqueKind


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

    virtual = True

    def __init__(self, inner: Machine, link: FaultyLink) -> None:
        self.inner = inner
        self.link = link
        self.robot = inner.robot
        self.torque_kind: TorqueKind = inner.torque_kind
        self.state_rate_hz = inner.state_rate_hz
        self._rng = np.random.default_rng(0)
        self._newest: State | None = None

    def connect(self) -> None:
        self.inner.connect()
        self._wire = self.link.wire.open("w", buffering=1)

    def now(self) -> float:
        return self.inner.now()

    def latest(self) -> State:
        return self._newest or self.inner.latest()

    def wait(self, until: float) -> list[State]:
        active = {name for name, event in self.link.faults.items() if event.is_set()}
        if "broken" in active:
            raise HardwareError("the cable was pulled out.")
        states = []
        for state in self.inner.wait(until):
            if self._rng.random() >= self.link.loss:
                states.append(state)
        if "freeze" in active:
            states = []
        if "nan" in active:
            spoilt = np.where(np.arange(12) == 3, math.nan, 0.0)
            states = [replace(state, velocity=state.velocity + spoilt) for state in states]
        if "stuck" in active and self._newest is not None:
            newest = self._newest
            states = [replace(newest, time=s.time, sequence=s.sequence) for s in states]
        if states:
            self._newest = states[-1]
        return states

    def send(self, command: Command) -> None:
        self._write("send")
        self.inner.send(command)

    def clamp(self, joints: tuple[str, ...]) -> None:
        self.inner.clamp(joints)

    def damp(self) -> None:
        self._write("damp")
        self.inner.damp()

    def close(self) -> None:
        self.inner.close()
        self._wire.close()

    def _write(self, action: str) -> None:
        self._wire.write(f"{time.monotonic():.6f} {action}\n")


def writes(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """When something was written [s], and whether it was damping."""
    times = []
    damps = []
    for line in path.read_text().splitlines():
        # The last line may be cut.
        if line.endswith((" send", " damp")):
            time_text, action = line.split()
            times.append(float(time_text))
            damps.append(action == "damp")
    return np.array(times), np.array(damps)
