"""From the bytes of `rt/lowstate` to numbered states, without a socket.

Unitree's states carry no number, but the robot's clock in milliseconds; at 500 Hz it shows how many
states were lost on the way.
"""

from __future__ import annotations

from collections import Counter

from pronk.links.dds.codec import TICKS_PER_S, JointMap, decode_state
from pronk.links.machine import RefusedError, State

STATE_RATE_HZ = 500.0
"""Of `rt/lowstate`."""
_TICKS_BACK = 1000
"""A robot's clock that is this much earlier than the last was started again [ms]."""
_TICKS_AHEAD = 500
"""A robot's clock that runs ahead of this computer's by more than this between two states has
jumped [ms]."""
_LEAST_STEP_S = 1e-6


class StateDecoder:
    """Makes states of messages as they come."""

    def __init__(self, joints: JointMap, counts: Counter[str]) -> None:
        """Begin; `counts` gets `states`, `out of order`, `clock jumps`, `repeated`, refusals."""
        self.counts = counts
        self.virtual = False
        """Whether the last state was a virtual robot's."""
        self.last_error = ""
        """Why the last refused message was refused, one sentence."""
        self._joints = joints
        self._tick: int | None = None
        self._time = -float("inf")
        self._sequence = -1
        self._measured = b""

    def take(self, data: bytes, arrived: float) -> State | None:
        """The state of a message that arrived at a time [s], or None. Never raises.

        States that came together are put 1 us apart.
        """
        try:
            return self._take(data, arrived)
        except RefusedError as error:
            self.counts[f"refused: {error.reason}"] += 1
            self.last_error = str(error).rstrip(".")
            return None

    def _take(self, data: bytes, arrived: float) -> State | None:
        low = decode_state(self._joints, data)
        steps = 1
        if self._tick is not None:
            ahead = (low.tick - self._tick + 2**31) % 2**32 - 2**31
            if -_TICKS_BACK < ahead <= 0:
                self.counts["out of order"] += 1
                return None
            if ahead < 0 or ahead > 1e3 * (arrived - self._time) + _TICKS_AHEAD:
                self.counts["clock jumps"] += 1
            else:
                steps = max(1, round(ahead * STATE_RATE_HZ / TICKS_PER_S))
        arrived = max(arrived, self._time + _LEAST_STEP_S)
        state = low.state(time=arrived, sequence=self._sequence + steps)
        self._tick, self._time, self._sequence = low.tick, arrived, state.sequence
        measured = low.measured
        if measured == self._measured:
            self.counts["repeated"] += 1
            return None
        self._measured = measured
        self.virtual = low.virtual
        self.counts["states"] += 1
        return state
