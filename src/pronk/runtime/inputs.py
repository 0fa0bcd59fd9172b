"""What the servo hears: the operator's stick and wishes, the policy's orders."""

from __future__ import annotations

import numpy as np

from pronk.runtime.plan import Shared
from pronk.runtime.records import Wish
from pronk.runtime.states import Director, Order


class Hearing:
    """Reads from the shared memory, and never waits."""

    def __init__(self, shared: Shared, director: Director, stick_valid_s: float) -> None:
        """Begin.

        Args:
            shared: Where it is heard.
            director: Who is told the wishes.
            stick_valid_s: How long the operator's program may be silent [s].
        """
        self.order: Order | None = None
        """The policy's newest."""
        self._shared = shared
        self._director = director
        self._stick_valid_s = stick_valid_s
        self._wishes = 0

    def stick(self, now: float) -> tuple[bool, bool]:
        """Whether the dead-man button is held, and whether the operator's program is gone."""
        stick = self._shared.stick.read()
        if stick is None:
            return False, now - self._director.since > 10.0 * self._stick_valid_s
        if int(stick["wishes"]) != self._wishes:
            self._wishes = int(stick["wishes"])
            self._director.wish(Wish(int(stick["wish"])))
        gone = now - float(stick["time"]) > self._stick_valid_s
        return bool(stick["held"]) and not gone, gone

    def orders(self) -> bool:
        """Take the policy's newest order; whether there is a new one."""
        record = self._shared.orders.read()
        if record is None or (
            self.order is not None and int(record["sequence"]) == self.order.sequence
        ):
            return False
        self.order = Order(
            sequence=int(record["sequence"]),
            state_sequence=int(record["state_sequence"]),
            state_time=float(record["state_time"]),
            made=float(record["made"]),
            valid_for=float(record["valid_for"]),
            entry=int(record["entry"]),
            position=np.array(record["position"]),
        )
        return True
