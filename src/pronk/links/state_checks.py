"""Pure checks of the states of a robot at rest, before it may be commanded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.errors import HardwareError
from pronk.links.machine import State
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

WINDOW_S = 0.2
"""How long states are watched [s]."""
GRAVITY = 9.81
GRAVITY_TOLERANCE = 1.0
"""Between the specific force of a robot at rest and gravity [m/s^2]."""
ATTITUDE_TOLERANCE = 0.2
"""Between "up" by the accelerometer and by the attitude filter [rad]."""
FOLDED = 0.15
"""How far beyond its range a joint may rest [rad]: a Go2's calves do when it lies folded."""


@dataclass(frozen=True, kw_only=True)
class Freshness:
    """How fresh states must be before anything moves."""

    share: float = 0.9
    """Of the expected number of states that must have come."""
    longest_gap_s: float = 0.02
    """Between two states [s]."""


def check_rate(
    robot: str, states: Sequence[State], rate_hz: float, fresh: Freshness | None = None
) -> None:
    """Check that the states of `WINDOW_S` come often enough and without gaps.

    Raises:
        HardwareError: They do not.
    """
    wanted = fresh or Freshness()
    expected = rate_hz * WINDOW_S
    gap = float(np.diff([state.time for state in states]).max()) if len(states) > 1 else np.inf
    if len(states) < wanted.share * expected or gap > wanted.longest_gap_s:
        raise HardwareError(
            f"{robot} sent {len(states)} fresh states in {WINDOW_S * 1e3:.0f} ms with a longest "
            f"gap of {gap * 1e3:.0f} ms, expected about {expected:.0f} with none above "
            f"{wanted.longest_gap_s * 1e3:.0f} ms; check the network and that this computer is "
            "not busy."
        )


def check_rest(robot: Robot, states: Sequence[State]) -> None:
    """Check that gravity agrees with the attitude and joints are within range or `FOLDED`.

    Raises:
        HardwareError: One is not.
    """
    # The median, so that one knock on the table does not decide.
    force = np.median([state.accelerometer for state in states], axis=0)
    size = float(np.linalg.norm(force))
    if not abs(size - GRAVITY) <= GRAVITY_TOLERANCE:
        raise HardwareError(
            f"{robot.name}'s accelerometer reads {size:.2f} m/s^2, expected {GRAVITY} within "
            f"{GRAVITY_TOLERANCE:g}; let the robot hang or stand still, and check the unit on the "
            "wire."
        )
    angle = float(np.arccos(np.clip(force / size @ up_of(states[-1].orientation), -1.0, 1.0)))
    if not angle <= ATTITUDE_TOLERANCE:
        raise HardwareError(
            f"{robot.name}'s attitude and accelerometer disagree about the vertical by "
            f"{np.degrees(angle):.0f} degrees, expected at most "
            f"{np.degrees(ATTITUDE_TOLERANCE):.0f}; check the order of the quaternion's numbers, "
            "and let the attitude filter settle."
        )
    for joint, value in zip(robot.joints, states[-1].position, strict=True):
        low, high = joint.range
        if not low - FOLDED <= value <= high + FOLDED:
            raise HardwareError(
                f"{joint.name} is at {value:.3f} rad, expected {low:g} to {high:g} and no more "
                f"than {FOLDED:g} beyond; move it by hand, or check the joints' zero, order and "
                "signs."
            )


def up_of(orientation: Array) -> Array:
    """World's up in the trunk's frame, of a unit quaternion trunk to world w, x, y, z. (3,)."""
    w, x, y, z = orientation
    return np.array([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)])
