"""Comparison of a robot's own clock with the times at which its states arrive.

The supervision times states by their arrival alone, so a robot's clock that is wrong hides nothing.
It is compared all the same: the number of a state, its age and the log depend on it.
"""

from __future__ import annotations

import math

BLOCK_S = 0.5
"""Length of a block; nothing is judged before the second has ended, after a second [s]."""
_BLOCKS = 3
"""Blocks of which the earliest arrivals are compared: the newest, and those of a second before."""
_LONGEST_DELAY_S = 0.5
"""Spread of the delays within a block beyond which a clock has jumped [s]: states that are delayed
by more than 0.1 s are a fault of their own."""
_NO_TIME = 1e9
"""Offset of a time that is not a finite number, which disagrees with any other [s]."""


class ClockComparison:
    """How far a robot's clock and the times of arrival drift apart over a second.

    The offset of a state is its arrival less its own time. A delay on the way makes it larger,
    never smaller, so the least offset of a block of half a second is that of the least delayed
    state. Bursts after a pause do not change it. Blocks whose least offsets differ were timed by
    clocks that run at different rates, or of which one has jumped.
    """

    def __init__(self) -> None:
        """Begin without a state."""
        self.disagreement = 0.0
        """Largest difference of the two clocks over a second, so far [s]; not negative."""
        self._least_offsets: list[float] = []
        self._block_end = -math.inf
        self._least = math.inf
        self._largest = -math.inf
        self._scatter = 0.0

    def begin(self) -> None:
        """Begin anew with the next state."""
        self.disagreement = 0.0
        self._least_offsets = []
        self._block_end = -math.inf
        self._least = math.inf
        self._largest = -math.inf
        self._scatter = 0.0

    def observe(self, arrival: float, robot_time: float | None) -> None:
        """Take a state.

        Args:
            arrival: Time of its arrival, not before that of the state before [s].
            robot_time: The robot's own time of it [s]; None where the wire carries none.
        """
        if robot_time is None:
            self.begin()
            return
        offset = arrival - robot_time
        if not math.isfinite(offset):
            offset = _NO_TIME
        if math.isinf(self._block_end):
            self._block_end = arrival + BLOCK_S
        if arrival >= self._block_end:
            self._end_block()
            self._block_end = arrival + BLOCK_S
        self._least = min(self._least, offset)
        self._largest = max(self._largest, offset)

    def _end_block(self) -> None:
        """Compare the block that ends with those before."""
        self._scatter = max(self._scatter, self._largest - self._least)
        self._least_offsets = [*self._least_offsets[1 - _BLOCKS :], self._least]
        if len(self._least_offsets) > 1:
            spread = max(self._least_offsets) - min(self._least_offsets)
            self.disagreement = max(self.disagreement, spread)
            if self._scatter > _LONGEST_DELAY_S:
                self.disagreement = max(self.disagreement, self._scatter)
        self._least = math.inf
        self._largest = -math.inf
