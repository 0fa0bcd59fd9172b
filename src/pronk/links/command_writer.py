"""The only writer of commands on a link.

A command that is not followed by another before it expires is followed by damping, again and
again, from a thread of its own: the program that commanded may be stuck, and a single message may
be lost.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable

from pronk.errors import HardwareError
from pronk.links.machine import Command, damping_command

_DAMP_PERIOD_S = 0.01
"""Between two messages of damping."""


class CommandWriter:
    """Puts commands on a wire, and damping when they expire. Any thread may call it."""

    def __init__(
        self,
        encode: Callable[[Command], bytes],
        publish: Callable[[bytes], None],
        *,
        joints: int = 12,
        damping: float = 1.0,
        repeat_s: float | None = None,
        counts: Counter[str] | None = None,
    ) -> None:
        """Start the thread that watches over the commands; nothing is written yet.

        Args:
            encode: Command to bytes; refuses what no drive could follow.
            publish: Puts bytes on the wire; only called by one thread at a time.
            joints: Of a command.
            damping: Of the joints while they are damped [N m s/rad].
            repeat_s: Time after which the command in force is written again; None for once.
            counts: Where `commands`, `repeats`, `expired` and `not written` are counted.
        """
        self.counts: Counter[str] = Counter() if counts is None else counts
        self.wrote = False
        """Whether anything was written at all."""
        self._encode, self._publish = encode, publish
        self._repeat_s = repeat_s
        self._damping = encode(damping_command(joints, damping))
        self._data = b""
        self._expires = self._due = self._wake = math.inf
        self._open = True
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._keep, name="pronk writer", daemon=True)
        self._thread.start()

    def send(self, command: Command) -> None:
        """Put a command into force; one that has expired already becomes damping.

        Raises:
            HardwareError: No drive could follow it, and it was not sent; or the wire does not take
                it, and it expires all the same and is followed by damping.
        """
        data = self._encode(command)
        expires = command.made + command.valid_for
        with self._changed:
            if time.monotonic() >= expires:
                self.counts["expired"] += 1
                self._force(self._damping, math.inf)
                return
            problem = self._force(data, expires)
            if problem:
                raise HardwareError(
                    f"a command could not be put on the wire ({problem}); check the network."
                )
            self.counts["commands"] += 1

    def damp(self) -> None:
        """Write damping now, and go on until the next command. Never raises."""
        with self._changed:
            self._force(self._damping, math.inf)

    def stop(self) -> None:
        """Write nothing any more."""
        with self._changed:
            self._open = False
            self._changed.notify()
        self._thread.join()

    def _force(self, data: bytes, expires: float) -> str:
        """Put bytes into force; what went wrong, or ""."""
        if not self._open:
            return ""
        self._data, self._expires = data, expires
        problem = self._write()
        # The thread sleeps to the time that was next when it fell asleep.
        if min(self._due, self._expires) < self._wake:
            self._changed.notify()
        return problem

    def _write(self) -> str:
        self.wrote = True
        period = _DAMP_PERIOD_S if self._data is self._damping else math.inf
        self._due = time.monotonic() + (self._repeat_s or period)
        try:
            self._publish(self._data)
        except Exception as error:
            # Whatever it is: the thread that damps must outlive it, and try again.
            self.counts["not written"] += 1
            return str(error) or type(error).__name__
        return ""

    def _keep(self) -> None:
        with self._changed:
            while self._open:
                now = time.monotonic()
                if now >= self._expires:
                    self.counts["expired"] += 1
                    self._data, self._expires = self._damping, math.inf
                    self._write()
                elif now >= self._due:
                    self.counts["repeats"] += 1
                    self._write()
                self._wake = min(self._due, self._expires)
                pause = self._wake - time.monotonic()
                if pause > 0.0:
                    self._changed.wait(pause if pause < math.inf else None)
