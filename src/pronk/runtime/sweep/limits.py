"""What no measured state of a sweep may exceed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pronk.errors import HardwareError
from pronk.links.machine import State, TorqueKind
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

_SAG = 0.05
"""How much farther than it lay a joint may go on the way to its pose [rad]."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What no measured state may exceed. All arrays of shape (joints,), robot's order."""

    names: tuple[str, ...]
    low: Array
    """[rad]"""
    high: Array
    """[rad]"""
    speed: Array
    """[rad/s]"""
    torque: Array
    """[N m]; infinite where the machine does not measure it."""

    @classmethod
    def of(cls, robot: Robot, torque_kind: TorqueKind = "measured") -> Limits:
        """The robot's own: ranges, no-load speeds, effort limits."""
        effort = np.array([joint.drive.effort_limit for joint in robot.joints])
        return cls(
            names=robot.joint_names,
            low=np.array([joint.range[0] for joint in robot.joints]),
            high=np.array([joint.range[1] for joint in robot.joints]),
            speed=np.array([joint.drive.no_load_speed for joint in robot.joints]),
            torque=effort if torque_kind == "measured" else np.full_like(effort, np.inf),
        )

    def from_where_it_lies(self, position: Array) -> Limits:
        """The same for the way to the pose, from a position that may be a little outside.

        How far outside is for the link's checks to allow: a folded robot is.
        """
        outside = np.array((position < self.low, position > self.high))
        return replace(
            self,
            low=np.where(outside[0], position - _SAG, self.low),
            high=np.where(outside[1], position + _SAG, self.high),
        )

    def check(self, state: State) -> None:
        """Stop at the first breach.

        Raises:
            HardwareError: Names the joint, the value and the limit.
        """
        q, v, tau = state.position, state.velocity, state.torque
        # NaN compares false, so ask for what is right rather than for what is wrong.
        fine = (
            (q >= self.low)
            & (q <= self.high)
            & (np.abs(v) <= self.speed)
            & (np.abs(tau) <= self.torque)
        )
        if fine.all():
            return
        i = int(np.argmin(fine))
        for value, low, high, unit in (
            (q[i], self.low[i], self.high[i], "rad"),
            (v[i], -self.speed[i], self.speed[i], "rad/s"),
            (tau[i], -self.torque[i], self.torque[i], "N m"),
        ):
            if not low <= value <= high:
                raise HardwareError(
                    f"{self.names[i]} is at {value:.3f} {unit} at t = {state.time:.3f} s, outside "
                    f"{low:.3f} to {high:.3f} {unit}; the joints were damped."
                )
