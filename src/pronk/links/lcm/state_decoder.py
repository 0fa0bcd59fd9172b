"""From LCM messages to numbered states, without a socket.

No state is made, and the reason counted, of a message that is refused; of joints without a young
attitude; of values that repeat to the last bit, as no live sensor's do (frozen data behind a live
count); of a count that went backwards.
"""

from __future__ import annotations

from collections import Counter, deque

from pronk.links.lcm.codec import (
    Attitude,
    Layout,
    decode_attitude,
    decode_joints,
    read_clamp_message,
    state_of,
)
from pronk.links.machine import RefusedError, State

_OLDEST_ATTITUDE_S = 0.02
_NUMBER_JUMP = 1000
"""A count this far from the last is that of a robot that was started again, or a broken one."""
_KEPT_STATES = 10_000


class StateDecoder:
    """Makes states of messages as they come. One thread writes; any may read what it holds."""

    def __init__(self, layout: Layout, names: tuple[str, ...]) -> None:
        """Begin without a state, for the joints of these names."""
        self.counts: Counter[str] = Counter()
        """`states`, and for each reason how often no state was made."""
        self.last_error = ""
        """The last refusal."""
        self.latest: State | None = None
        self.virtual = False
        """Whether the beacon of the virtual robot has come."""
        self.held: tuple[int, tuple[str, ...]] = (0, ())
        """Last request for clamps that the virtual robot met, and the joints it holds."""
        self._states: deque[State] = deque(maxlen=_KEPT_STATES)
        self._layout = layout
        self._names = names
        self._attitude: tuple[float, Attitude] | None = None
        self._values = b""
        self._number: int | None = None
        self._sequence = -1

    def drain(self) -> list[State]:
        """The states made since the last call, oldest first."""
        states = []
        while self._states:
            states.append(self._states.popleft())
        return states

    def attitude(self, data: bytes, now: float) -> None:
        """Take a message of the inertial unit that arrived at `now` [s]. Never raises."""
        try:
            self._attitude = (now, decode_attitude(self._layout, data))
        except RefusedError as error:
            self._refuse(error)

    def joints(self, data: bytes, now: float) -> None:
        """Take a message of the joints that arrived at `now` [s]: it completes a state."""
        try:
            joints = decode_joints(self._layout, data)
        except RefusedError as error:
            self._refuse(error)
            return
        if self._attitude is None or now - self._attitude[0] > _OLDEST_ATTITUDE_S:
            self.counts["no attitude"] += 1
            return
        attitude = self._attitude[1]
        passed = 1
        if joints.number is not None and self._number is not None:
            passed = joints.number - self._number
            if -_NUMBER_JUMP < passed <= 0:
                self.counts["out of order"] += 1
                return
        self._number = joints.number
        values = b"".join(
            part.tobytes()
            for part in (joints.position, joints.velocity, attitude.gyro, attitude.accelerometer)
        )
        if values == self._values:
            self.counts["repeated"] += 1
            return
        self._values = values
        # Where the robot counts, what it counted and did not arrive is missing here too.
        self._sequence += passed if 0 < passed < _NUMBER_JUMP else 1
        self.counts["states"] += 1
        self.latest = state_of(joints, attitude, time=now, sequence=self._sequence)
        self._states.append(self.latest)

    def beacon(self, data: bytes) -> None:
        """Take the beacon of the virtual robot."""
        try:
            self.held = read_clamp_message(self._names, data)
        except RefusedError as error:
            self._refuse(error)
        else:
            self.virtual = True

    def _refuse(self, error: RefusedError) -> None:
        self.counts[f"refused: {error.reason}"] += 1
        self.last_error = str(error).rstrip(".")
