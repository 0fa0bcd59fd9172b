"""Numbers of the states of a live robot, and the check of their attitude."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

from pronk.arrays import Array
from pronk.robots.machine import RefusedError, State

_COUNT_BACK_S = 1.0
"""A count that went back by more than this belongs to a robot that was started again [s]."""
_COUNT_AHEAD_S = 0.5
"""A count that runs ahead of this computer's clock by more than this has jumped [s]."""
_LEAST_STEP_S = 1e-6
"""Time between two states that arrived together [s]."""


def unit_quaternion(name: str, values: Array) -> Array:
    """Normalize an attitude; RefusedError `quaternion` for a length that is not 1 within .02."""
    length = math.sqrt(values @ values)
    if not abs(length - 1.0) <= 0.02:
        raise RefusedError(
            "quaternion",
            f"{name} has length {length:.3f}, expected 1 within .02; the inertial unit is not "
            "running, or the order of the numbers is another.",
        )
    return values / length


class StateNumbering:
    """Numbers the states of a live robot by the robot's own count, where it has one.

    A count that stood still or went back (`out of order`) and measurements that repeat to the last
    bit (`repeated`) make no state and are counted; so are `clock jumps`, which make one.
    """

    def __init__(
        self, counts: Counter[str], rate_hz: float, *, per_state: int = 1, bits: int = 64
    ) -> None:
        """Start at 0.

        Args:
            counts: Gets `out of order`, `repeated` and `clock jumps`.
            rate_hz: States per second.
            per_state: By how much the robot's count grows with each state.
            bits: Bits of the robot's count, which wraps.
        """
        self.counts = counts
        self._rate_hz = rate_hz
        self._per_state = per_state
        self._wrap = 1 << bits
        self._count: int | None = None
        self._time = -math.inf
        self._sequence = -1
        self._measured = b""

    def number(self, measurement: State, count: int | None) -> State | None:
        """Number a measurement.

        Args:
            measurement: A state whose time is its arrival [s]; its sequence does not matter.
            count: The robot's own count, None if it has none.

        Returns:
            The state; simultaneous ones are 1 us apart. None if it is dropped.
        """
        steps = 1
        arrived = measurement.time
        if count is not None and self._count is not None:
            half = self._wrap // 2
            ahead = ((count - self._count + half) % self._wrap - half) / self._per_state
            if -_COUNT_BACK_S * self._rate_hz < ahead <= 0.0:
                self.counts["out of order"] += 1
                return None
            farthest = self._rate_hz * (arrived - self._time + _COUNT_AHEAD_S)
            if ahead < 0.0 or ahead > farthest:
                self.counts["clock jumps"] += 1
            else:
                steps = max(1, round(ahead))
        self._count = count
        self._time = max(arrived, self._time + _LEAST_STEP_S)
        # What never repeats to the last bit while the robot lives.
        measured = (
            measurement.position.tobytes()
            + measurement.velocity.tobytes()
            + measurement.gyro.tobytes()
            + measurement.accelerometer.tobytes()
        )
        if measured == self._measured:
            self.counts["repeated"] += 1
            return None
        self._measured = measured
        self._sequence += steps
        return replace(measurement, time=self._time, sequence=self._sequence)
