"""What `pronk play` reads of a running robot: height, speed, and its jumps one after the other."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from pronk.evaluation.jumps import JumpRules, cosine_of_tilt
from pronk.evaluation.metrics import FALLEN_COSINE, FALLEN_HEIGHT
from pronk.virtual.capture import Capture


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
    """Follows a robot sample by sample; flights are those of `pronk.evaluation.jumps`."""

    rules: JumpRules = field(default_factory=JumpRules)
    hops: list[Hop] = field(default_factory=list)
    height: float = math.nan
    """Of the trunk over the floor [m]."""
    speed: float = math.nan
    """Horizontal [m/s]."""
    fallen: bool = False
    _flight: Capture | None = None
    _apex: float = -math.inf

    def see(self, sample: Capture) -> None:
        """Take in a capture of one sample, of the present moment."""
        self.height = float(sample.position[0, 2])
        self.speed = float(np.hypot(*sample.velocity[0, :2]))
        upright = cosine_of_tilt(sample.orientation[0]) >= FALLEN_COSINE
        self.fallen = not upright or self.height < FALLEN_HEIGHT
        airborne = not sample.contact.any() and not bool(sample.other_contact[0])
        if airborne and self._flight is None:
            self._flight, self._apex = sample, -math.inf
        if self._flight is None:
            return
        if airborne:
            self._apex = max(self._apex, self.height)
            return
        self._land(self._flight, sample)
        self._flight = None

    def forget(self) -> None:
        """The robot was set down anew."""
        self._flight = None

    def _land(self, up: Capture, down: Capture) -> None:
        duration = float(down.time[0] - up.time[0])
        if duration >= self.rules.long_s and self._apex > self.rules.high:
            way = down.position[0, :2] - up.position[0, :2]
            self.hops.append(
                Hop(
                    vertical=float(up.velocity[0, 2]),
                    apex=self._apex,
                    duration=duration,
                    distance=float(np.hypot(*way)),
                )
            )
