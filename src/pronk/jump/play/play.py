"""The virtual robot in real time under the commands of a person.

Without waiting for the clock it runs 3.1 times faster than real time without a page and 2.4 times
with one (12 s at 1 m/s each, two cores shared with other work).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, field, fields
from threading import Lock
from typing import Any, Protocol

import numpy as np

from pronk.deploy.runtime.modes import Mode, OperatorRequest
from pronk.deploy.runtime.teleop import Operator
from pronk.jump.trial.jumps import JumpRules, fallen_at, jump_flights
from pronk.jump.virtual.capture import Capture
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import SimParams
from pronk.policy.contract import COMMANDS
from pronk.policy.rollout import ticks
from pronk.policy.runtime import Policy
from pronk.policy.script import STILL, Commanded, Script, Velocity
from pronk.robots.machine import State
from pronk.robots.robot import RobotSpec

JUMP_S = Script(command=STILL).jump_s
"""How long the jump input lasts, as in the trial [s]."""
_SAMPLE_S = 0.004
"""Between two samples of the robot; a lift-off speed is off by less than 4 cm/s for it."""
_LATE_S = 0.25
"""Delay that is not made up for: the robot then runs late instead of faster than real time."""


@dataclass
class Joystick:
    """Operator command of the page, which writes it from threads of its own, and of a gamepad."""

    ranges: Mapping[str, tuple[float, float]]
    """Smallest and largest command, by the names in `COMMANDS`."""
    jumps: bool = True
    """Whether the policy has a jump input."""
    gamepad: Operator | None = None
    """Its velocity is added to the page's; it is read once a policy step."""
    _velocity: Velocity = STILL
    _jump: bool = False
    _until: float = -math.inf
    _reset: bool = False
    _lock: Lock = field(default_factory=Lock)

    def set_velocity(self, velocity: Velocity) -> None:
        """Command a velocity: forward, left [m/s], yaw rate [rad/s]."""
        with self._lock:
            self._velocity = velocity

    def jump(self) -> None:
        """Command a jump at the next tick, unless one is under way."""
        with self._lock:
            self._jump = self.jumps

    def reset(self) -> None:
        """Request a reset of the robot."""
        with self._lock:
            self._reset = True

    def take_reset(self) -> bool:
        """Whether a reset was requested since the last call; clears it, and any jump."""
        with self._lock:
            requested, self._reset = self._reset, False
            if requested:
                self._jump, self._until = False, -math.inf
            return requested

    def commanded(self, t: float) -> Commanded:
        """Command at a time since the policy took over [s]: page plus gamepad, within the ranges.

        The gamepad's jump input is as long as its own timing makes it.
        """
        added, pressed = STILL, False
        if self.gamepad is not None:
            pad = self.gamepad.command(time.monotonic(), Mode.POLICY)
            added, pressed = pad.command, pad.jump and self.jumps
            if pad.request is OperatorRequest.RESET:
                self.reset()
        with self._lock:
            if self._jump and t >= self._until:
                self._until = t + JUMP_S
            self._jump = False
            forward, left, yaw = (
                min(self.ranges[name][1], max(self.ranges[name][0], a + b))
                for name, a, b in zip(COMMANDS, self._velocity, added, strict=True)
            )
            return (forward, left, yaw), pressed or t < self._until - 1e-9


@dataclass(frozen=True, kw_only=True)
class Hop:
    """A flight that lifted the trunk."""

    vertical: float
    """Upward speed of the trunk at lift-off [m/s]."""
    apex: float
    """Highest trunk over the floor [m]."""
    duration: float
    """[s]"""
    distance: float
    """Of the trunk from lift-off to touchdown [m]."""


@dataclass
class Gauge:
    """Height, speed and jumps of a running robot, by the rules of `pronk.jump.trial.jumps`."""

    rules: JumpRules
    hops: list[Hop] = field(default_factory=list)
    height: float = math.nan
    """Of the trunk over the floor [m]."""
    speed: float = math.nan
    """Horizontal [m/s]."""
    fallen: bool = False
    _seen: list[Capture] = field(default_factory=list)
    """The samples of a flight under way."""

    def add(self, sample: Capture) -> None:
        """Take in a capture of one sample, of the present moment."""
        self.height = float(sample.position[0, 2])
        self.speed = float(np.hypot(*sample.velocity[0, :2]))
        self.fallen = fallen_at(sample) == 0
        self._seen.append(sample)
        if sample.contact.any() and len(self._seen) > 1:
            self._land()
        if self.fallen or sample.contact.any():
            self.reset()

    def _land(self) -> None:
        """Keep the flight that the last sample has ended, if it was a jump."""
        names = (entry.name for entry in fields(Capture))
        joined = {k: np.concatenate([getattr(one, k) for one in self._seen]) for k in names}
        seen = Capture(**joined)
        if flight := jump_flights(seen, 0, self.rules, fallen_at(seen)).main:
            up, down = flight
            hop = Hop(
                vertical=float(seen.velocity[up, 2]),
                apex=float(seen.position[up:down, 2].max()),
                duration=float(seen.time[down] - seen.time[up]),
                distance=float(np.hypot(*(seen.position[down, :2] - seen.position[up, :2]))),
            )
            self.hops.append(hop)

    def reset(self) -> None:
        """Forget a flight under way."""
        self._seen.clear()


class Page(Protocol):
    """What shows the robot to a person."""

    def show(self, sample: Capture, gauge: Gauge, factor: float) -> None:
        """Draw robot, figures and simulated seconds per second; called once a policy step."""


class _Sampled(VirtualRobot):
    """A virtual robot that is sampled while it runs."""

    sampled: Callable[[Capture], None] | None = None

    def wait(self, until: float) -> list[State]:
        states: list[State] = []
        while (now := self.now()) < until:
            states += super().wait(min(until, now + _SAMPLE_S))
            if self.sampled is not None:
                self.sampled(self.snapshot())
        return states


def play(
    robot: RobotSpec,
    policy: Policy,
    sim_params: SimParams,
    joystick: Joystick,
    page: Page,
    *,
    seed: int = 0,
    until: Callable[[float], bool] = lambda simulated: False,
) -> dict[str, Any]:
    """Run the robot in real time until Ctrl-C; a fallen one goes on until it is reset.

    `until`, called with the simulated time [s], ends the run as well. Returns `simulated_s`,
    `wall_s`, the number of `resets`, and `hops`.
    """
    gauge = Gauge(JumpRules.of(robot))
    machine = _Sampled(robot, sim_params, base="ground", seed=seed, capture_rate_hz=None)
    began, simulated, resets, over = time.perf_counter(), 0.0, 0, False
    with suppress(KeyboardInterrupt), closing(machine):  # the usual end
        while not over:
            machine.sampled = None
            machine.connect()
            machine.sampled = gauge.add
            gauge.reset()
            before, start, late = simulated, time.perf_counter(), 0.0
            for since in ticks(machine, policy, robot, joystick.commanded):
                simulated = before + since
                wall = time.perf_counter() - start
                page.show(machine.snapshot(), gauge, since / wall if since else 1.0)
                over, again = until(simulated), joystick.take_reset()
                if over or again:
                    resets += again
                    break
                ahead = start + late + since - time.perf_counter()
                time.sleep(max(0.0, ahead))
                late -= ahead if ahead < -_LATE_S else 0.0
    wall_s = time.perf_counter() - began
    return {"simulated_s": simulated, "wall_s": wall_s, "resets": resets, "hops": gauge.hops}
