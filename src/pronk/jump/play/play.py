"""The virtual robot in real time under the commands of a person.

Without waiting for the clock it runs 3.1 times faster than real time without a page and 2.4 times
with one (12 s at 1 m/s each, two cores shared with other work).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from threading import Lock
from typing import Any, Protocol

import numpy as np

from pronk.jump.trial.jumps import JumpRules, fallen_at, jump_flights
from pronk.jump.virtual.capture import Capture
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import SimParams
from pronk.policy.contract import COMMANDS
from pronk.policy.gamepad import GamepadButton, GamepadInput
from pronk.policy.rollout import ticks
from pronk.policy.runtime import Policy
from pronk.policy.script import STILL, Commanded, Script, Velocity
from pronk.robots.machine import State
from pronk.robots.robot import RobotSpec

JUMP_S = Script(command=STILL).jump_s
"""Length of the jump input, as in the trial [s]."""
_SAMPLE_S = 0.004
"""Time between two samples of the robot; a lift-off speed is off by less than 4 cm/s for it [s]."""
_LATE_S = 0.25
"""Delay that is not made up for: the robot then runs late instead of faster than real time [s]."""


class Pad(Protocol):
    """A gamepad, as `pronk.policy.gamepad.GamepadReader` is one."""

    def read(self, now: float) -> GamepadInput:
        """Return the input at a time of a steady clock [s]."""


@dataclass
class Joystick:
    """Command of the page, which writes it from threads of its own, and of a gamepad."""

    ranges: Mapping[str, tuple[float, float]]
    """Smallest and largest command, by the names in `COMMANDS`."""
    jumps: bool = True
    """The policy has a jump input."""
    gamepad: Pad | None = None
    """Gamepad that is read once a policy step; its velocity is added to the page's."""
    _velocity: Velocity = STILL
    _jump_requested: bool = False
    _jump_until: float = -math.inf
    _reset_requested: bool = False
    _lock: Lock = field(default_factory=Lock)

    def set_velocity(self, velocity: Velocity) -> None:
        """Command a velocity: forward, left [m/s], yaw rate [rad/s]."""
        with self._lock:
            self._velocity = velocity

    def jump(self) -> None:
        """Command a jump at the next tick, unless one is under way."""
        with self._lock:
            self._jump_requested = self.jumps

    def reset(self) -> None:
        """Request a reset of the robot."""
        with self._lock:
            self._reset_requested = True

    def take_reset(self) -> bool:
        """Return whether a reset was requested since the last call; clear it, and any jump."""
        with self._lock:
            requested = self._reset_requested
            self._reset_requested = False
            if requested:
                self._jump_requested = False
                self._jump_until = -math.inf
            return requested

    def commanded(self, t: float) -> Commanded:
        """Return page plus gamepad, within the ranges.

        The gamepad's jump input is as long as its own timing makes it.

        Args:
            t: Time since the policy took over [s].
        """
        pad = GamepadInput()
        if self.gamepad is not None:
            pad = self.gamepad.read(time.monotonic())
            if GamepadButton.START in pad.pressed:
                self.reset()
        with self._lock:
            if self._jump_requested and t >= self._jump_until:
                self._jump_until = t + JUMP_S
            self._jump_requested = False
            command = (
                self._limited(0, pad.velocity),
                self._limited(1, pad.velocity),
                self._limited(2, pad.velocity),
            )
            jump = (pad.jump and self.jumps) or t < self._jump_until - 1e-9
            return command, jump

    def _limited(self, index: int, added: Velocity) -> float:
        """Return one part of the velocity of page and gamepad together, within its range."""
        low, high = self.ranges[COMMANDS[index]]
        return min(high, max(low, self._velocity[index] + added[index]))


@dataclass(frozen=True, kw_only=True)
class Hop:
    """A flight that lifted the trunk."""

    vertical: float
    """Upward speed of the trunk at lift-off [m/s]."""
    apex: float
    """Highest trunk over the floor [m]."""
    duration: float
    """Time in the air [s]."""
    distance: float
    """Distance of the trunk from lift-off to touchdown [m]."""


@dataclass
class Gauge:
    """Height, speed and jumps of a running robot, by the rules of `pronk.jump.trial.jumps`."""

    rules: JumpRules
    hops: list[Hop] = field(default_factory=list)
    """Jumps since the start, the last one at the end."""
    height: float = math.nan
    """Height of the trunk over the floor [m]."""
    speed: float = math.nan
    """Horizontal speed of the trunk [m/s]."""
    fallen: bool = False
    """The robot lies or leans too far."""
    _flight: list[Capture] = field(default_factory=list)
    """Samples of a flight under way."""

    def add(self, sample: Capture) -> None:
        """Take in a capture of one sample, of the present moment."""
        self.height = float(sample.position[0, 2])
        self.speed = float(np.hypot(*sample.velocity[0, :2]))
        self.fallen = fallen_at(sample) == 0
        self._flight.append(sample)
        if sample.contact.any() and len(self._flight) > 1:
            self._land()
        if self.fallen or sample.contact.any():
            self.reset()

    def _land(self) -> None:
        """Keep the flight that the last sample has ended, if it was a jump."""
        capture = joined(self._flight)
        flight = jump_flights(capture, 0, self.rules, fallen_at(capture)).main
        if flight is None:
            return
        liftoff, touchdown = flight
        displacement = capture.position[touchdown, :2] - capture.position[liftoff, :2]
        self.hops.append(
            Hop(
                vertical=float(capture.velocity[liftoff, 2]),
                apex=float(capture.position[liftoff:touchdown, 2].max()),
                duration=float(capture.time[touchdown] - capture.time[liftoff]),
                distance=float(np.hypot(*displacement)),
            )
        )

    def reset(self) -> None:
        """Forget a flight under way."""
        self._flight.clear()


def joined(captures: Sequence[Capture]) -> Capture:
    """Return captures that follow one another as one."""

    def join(name: str) -> Any:
        return np.concatenate([getattr(capture, name) for capture in captures])

    return Capture(
        time=join("time"),
        position=join("position"),
        orientation=join("orientation"),
        velocity=join("velocity"),
        angular_velocity=join("angular_velocity"),
        foot_position=join("foot_position"),
        contact=join("contact"),
        other_contact=join("other_contact"),
        other_parts=join("other_parts"),
        joint_position=join("joint_position"),
        joint_velocity=join("joint_velocity"),
        torque=join("torque"),
        electrical_power=join("electrical_power"),
        bus_voltage=join("bus_voltage"),
    )


class Page(Protocol):
    """What shows the robot to a person."""

    def show(self, sample: Capture, gauge: Gauge, factor: float) -> None:
        """Draw the robot and its figures; called once a policy step.

        Args:
            sample: The present moment.
            gauge: Height, speed and jumps.
            factor: Simulated seconds per second.
        """


class _SampledRobot(VirtualRobot):
    """A virtual robot that is sampled while it runs."""

    sampled: Callable[[Capture], None] | None = None
    """Called with each sample; None for no samples."""

    def wait(self, until: float) -> list[State]:
        states: list[State] = []
        while self.now() < until:
            states += super().wait(min(until, self.now() + _SAMPLE_S))
            if self.sampled is not None:
                self.sampled(self.snapshot())
        return states


@dataclass(frozen=True, kw_only=True)
class PlayedRun:
    """What was played, when it has ended."""

    simulated_s: float
    """Simulated time [s]."""
    wall_s: float
    """Wall time [s]."""
    resets: int
    """Number of times the robot was set down anew."""
    hops: list[Hop]
    """All jumps."""


def play_in_real_time(
    robot: RobotSpec,
    policy: Policy,
    sim_params: SimParams,
    joystick: Joystick,
    page: Page,
    *,
    seed: int = 0,
    until: Callable[[float], bool] = lambda simulated: False,
) -> PlayedRun:
    """Run the robot in real time until Ctrl-C; a fallen one goes on until it is reset.

    Args:
        robot: The robot.
        policy: Its policy.
        sim_params: Parameters of the virtual robot.
        joystick: The commands.
        page: Shows the robot.
        seed: Seed of the virtual robot's noise.
        until: Called with the simulated time [s]; ends the run as well.
    """
    gauge = Gauge(JumpRules.of(robot))
    machine = _SampledRobot(robot, sim_params, base="ground", seed=seed, capture_rate_hz=None)
    began = time.perf_counter()
    simulated_s = 0.0
    resets = 0
    is_over = False
    with suppress(KeyboardInterrupt), closing(machine):  # the usual end
        while not is_over:
            machine.sampled = None
            machine.connect()
            machine.sampled = gauge.add
            gauge.reset()
            before_s = simulated_s
            start = time.perf_counter()
            late_s = 0.0
            for since in ticks(machine, policy, robot, joystick.commanded):
                simulated_s = before_s + since
                wall_s = time.perf_counter() - start
                page.show(machine.snapshot(), gauge, since / wall_s if since else 1.0)
                is_over = until(simulated_s)
                is_reset = joystick.take_reset()
                if is_reset:
                    resets += 1
                if is_over or is_reset:
                    break
                ahead_s = start + late_s + since - time.perf_counter()
                time.sleep(max(0.0, ahead_s))
                if ahead_s < -_LATE_S:
                    late_s -= ahead_s
    return PlayedRun(
        simulated_s=simulated_s,
        wall_s=time.perf_counter() - began,
        resets=resets,
        hops=gauge.hops,
    )
