"""Whether a robot on its stand or standing still is fit to be commanded: pure checks of states.

Each raises one sentence that says what was got, what was expected and the way out.
"""

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
_GRAVITY, _GRAVITY_WITHIN = 9.81, 1.0
_DIRECTION_WITHIN = 0.2
"""Between gravity as the accelerometer and as the attitude have it [rad]."""
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
    """States come often enough and without gaps.

    Args:
        robot: Its name.
        states: Those of `WINDOW_S`.
        rate_hz: Expected.
        fresh: What is asked; as `Freshness` has it if None.

    Raises:
        HardwareError: They do not.
    """
    asked = fresh or Freshness()
    expected = rate_hz * WINDOW_S
    gap = float(np.diff([state.time for state in states]).max()) if len(states) > 1 else np.inf
    if len(states) < asked.share * expected or gap > asked.longest_gap_s:
        raise HardwareError(
            f"{robot} sent {len(states)} fresh states in {WINDOW_S * 1e3:.0f} ms with a longest "
            f"gap of {gap * 1e3:.0f} ms, expected about {expected:.0f} with none above "
            f"{asked.longest_gap_s * 1e3:.0f} ms; check the network and that this computer is not "
            "busy."
        )


def check_rest(robot: Robot, states: Sequence[State]) -> None:
    """Gravity is where the attitude has it, and every joint is within its limits or `FOLDED`.

    Raises:
        HardwareError: One is not.
    """
    # The median, so that one knock on the table does not decide.
    force = np.median([state.accelerometer for state in states], axis=0)
    size = float(np.linalg.norm(force))
    if not abs(size - _GRAVITY) <= _GRAVITY_WITHIN:
        raise HardwareError(
            f"{robot.name}'s accelerometer reads {size:.2f} m/s^2, expected {_GRAVITY} within "
            f"{_GRAVITY_WITHIN:g}; let the robot hang or stand still, and check the unit on the "
            "wire."
        )
    angle = float(np.arccos(np.clip(force / size @ up_of(states[-1].orientation), -1.0, 1.0)))
    if not angle <= _DIRECTION_WITHIN:
        raise HardwareError(
            f"{robot.name}'s attitude and accelerometer disagree about where up is by "
            f"{np.degrees(angle):.0f} degrees, expected at most "
            f"{np.degrees(_DIRECTION_WITHIN):.0f}; check the order of the quaternion's numbers, "
            "and let the attitude filter settle."
        )
    position = states[-1].position
    for joint, value in zip(robot.joints, position, strict=True):
        low, high = joint.range
        if not low - FOLDED <= value <= high + FOLDED:
            raise HardwareError(
                f"{joint.name} is at {value:.3f} rad, expected {low:g} to {high:g} and no more "
                f"than {FOLDED:g} beyond; move it by hand, or check the joints' zero, order and "
                "signs."
            )


def up_of(orientation: Array) -> Array:
    """The world's up in the trunk's frame, shape (3,).

    Args:
        orientation: Trunk to world, unit quaternion w, x, y, z.
    """
    w, x, y, z = orientation
    return np.array([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)])
