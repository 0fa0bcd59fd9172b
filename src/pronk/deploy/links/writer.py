"""The writer of commands: what is in force, its expiry, and damping after it.

A thread of its own writes damping when a command expires without another, for the commanding
program may be stuck.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable

from pronk.errors import HardwareError
from pronk.robots.machine import Command

Encode = Callable[[Command], bytes]
Publish = Callable[[bytes], None]

_DAMP_PERIOD_S = 0.01
"""Time between two messages of damping [s]."""


class CommandWriter:
    """Puts commands on a wire, and damping when they expire. Any thread may call it."""

    def __init__(
        self,
        encode: Encode,
        publish: Publish,
        *,
        damping: Command,
        repeat_s: float | None,
        counts: Counter[str],
    ) -> None:
        """Start the thread that watches the expiry; nothing is written yet.

        Args:
            encode: Encodes a command.
            publish: Puts bytes on the wire; called by one thread at a time.
            damping: Command written when another expires.
            repeat_s: Silence after which the command in force is written again [s]; None for never.
            counts: Gets `commands`, `repeats`, `expired` and `not written`.
        """
        self.counts = counts
        self.wrote = False
        """Whether anything was written at all."""
        self._encode = encode
        self._publish = publish
        self._repeat_s = repeat_s
        self._damping = encode(damping)
        self._data = b""  # in force
        self._expires = math.inf  # when it expires [s]
        self._due = math.inf  # when it is written again [s]
        self._wake = math.inf  # until when the thread sleeps [s]
        self._open = True
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._watch, name="pronk writer", daemon=True)
        self._thread.start()

    def send(self, command: Command) -> None:
        """Put a command into force; damping if it has already expired.

        HardwareError if it is impossible, or if writing failed: then damping follows its expiry.
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
        """Write damping now and repeat it until the next command. Never raises."""
        with self._changed:
            self._force(self._damping, math.inf)

    def stop(self) -> None:
        """Write nothing any more."""
        with self._changed:
            self._open = False
            self._changed.notify()
        self._thread.join()

    def _force(self, data: bytes, expires: float) -> str:
        """Put bytes into force; return what went wrong, or ""."""
        if not self._open:
            return ""
        self._data = data
        self._expires = expires
        problem = self._write()
        # The thread sleeps until the time that was next when it began to sleep.
        if min(self._due, self._expires) < self._wake:
            self._changed.notify()
        return problem

    def _write(self) -> str:
        """Write what is in force; return what went wrong, or ""."""
        self.wrote = True
        period = _DAMP_PERIOD_S if self._data is self._damping else math.inf
        self._due = time.monotonic() + (self._repeat_s or period)
        try:
            self._publish(self._data)
        except Exception as error:
            # Of any kind: the thread that damps must survive it and try again.
            self.counts["not written"] += 1
            return str(error) or type(error).__name__
        return ""

    def _watch(self) -> None:
        """Write damping when a command expires, and repeat what is in force."""
        with self._changed:
            while self._open:
                now = time.monotonic()
                if now >= self._expires:
                    self.counts["expired"] += 1
                    self._data = self._damping
                    self._expires = math.inf
                    self._write()
                elif now >= self._due:
                    self.counts["repeats"] += 1
                    self._write()
                self._wake = min(self._due, self._expires)
                pause = self._wake - time.monotonic()
                if pause > 0.0:
                    self._changed.wait(pause if pause < math.inf else None)
