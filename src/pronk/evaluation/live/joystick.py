"""The stick of `pronk play`: the operator command from page or gamepad."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from threading import Lock

from pronk.policy.contract import COMMANDS
from pronk.runtime.script import STILL, Commanded, Script, Velocity

JUMP_S = Script(command=STILL).jump_s
"""How long the jump input lasts, as in the trial [s]."""
_DEAD = 0.12
"""Deflection of a gamepad's stick that is taken for none."""


@dataclass(frozen=True, kw_only=True)
class Pad:
    """A gamepad, read once."""

    forward: float = 0.0
    """Deflection, -1 to 1."""
    left: float = 0.0
    yaw: float = 0.0
    """Positive turns left."""
    jump: bool = False
    """The button is down."""
    reset: bool = False


def live(deflection: float) -> float:
    """A deflection, -1 to 1, without the dead zone in the middle and continuous at its edge."""
    size = (abs(deflection) - _DEAD) / (1.0 - _DEAD)
    return math.copysign(min(1.0, max(0.0, size)), deflection)


@dataclass
class Stick:
    """Operator command. Pages write it from threads of their own; the pilot reads it."""

    ranges: Mapping[str, tuple[float, float]]
    """Smallest and largest command, by the names in `COMMANDS`."""
    jumps: bool = True
    """The policy knows how to jump."""
    _velocity: Velocity = STILL
    _pad: Pad = Pad()
    _wanted: bool = False
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
            self._wanted = self.jumps

    def reset(self) -> None:
        """Request a reset of the robot."""
        with self._lock:
            self._reset = True

    def take_reset(self) -> bool:
        """Whether a reset was requested since the last call; clears it, and any jump."""
        with self._lock:
            requested, self._reset = self._reset, False
            if requested:
                self._wanted, self._until = False, -math.inf
            return requested

    def feel(self, pad: Pad) -> None:
        """Take a gamepad's state; a button counts when it goes down."""
        with self._lock:
            if pad.jump and not self._pad.jump:
                self._wanted = self.jumps
            if pad.reset and not self._pad.reset:
                self._reset = True
            self._pad = pad

    def commanded(self, t: float) -> Commanded:
        """Command at a time since the policy took over [s]. Implements `pilot.Source`.

        Page and gamepad add up, within the ranges; full deflection is the end of a range.
        """
        with self._lock:
            if self._wanted and t >= self._until:
                self._until = t + JUMP_S
            self._wanted = False
            pad = (self._pad.forward, self._pad.left, self._pad.yaw)
            velocity = []
            for name, value, deflection in zip(COMMANDS, self._velocity, pad, strict=True):
                low, high = self.ranges[name]
                part = live(deflection)
                velocity.append(min(high, max(low, value + part * (high if part > 0.0 else -low))))
            forward, left, yaw = velocity
            return (forward, left, yaw), t < self._until - 1e-9
