"""The only writer of commands on a link: each command once, and damping for as long as it takes.

A command that is not followed by another before it expires is followed by damping, again and
again, from a thread of its own: whoever commanded may be stuck, and a single message may be lost.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable

import numpy as np

from pronk.errors import HardwareError
from pronk.links.lcm.codec import encode_command
from pronk.links.lcm.layout import Layout
from pronk.links.machine import Command

DAMPING = 1.0
"""Of the joints while they are damped [N m s/rad]."""
_DAMP_PERIOD_S = 0.01
"""Between two messages of damping."""
_REMEMBERED = 512


class CommandWriter:
    """Puts commands on a wire, and damping when they expire. Any thread may call it."""

    def __init__(self, layout: Layout, publish: Callable[[bytes], None]) -> None:
        """Start the thread that watches over the commands.

        Args:
            layout: How commands become bytes.
            publish: Puts bytes on the wire; only ever called by one thread at a time.
        """
        self.counts: Counter[str] = Counter()
        """`commands`, `expired`, `not written`."""
        self.wrote = False
        """Whether anything was written at all."""
        self._layout = layout
        self._publish = publish
        zeros = np.zeros(12)
        self._sink = encode_command(
            layout, Command(position=zeros, stiffness=zeros, damping=zeros + DAMPING)
        )
        # Newest first: a message that comes back is nearly always the last one.
        self._own: deque[bytes] = deque(maxlen=_REMEMBERED)
        self._remembering = threading.Lock()
        self._open, self._damping, self._expires = True, False, math.inf
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._keep, name="pronk lcm writer", daemon=True)
        self._thread.start()

    def send(self, command: Command) -> None:
        """Write a command, once; one that has expired already becomes damping.

        Raises:
            HardwareError: It is not finite or not for twelve joints, and was not sent; or the wire
                does not take it, and it expires all the same and is followed by damping.
        """
        values = (command.position, command.stiffness, command.damping)
        if not all(np.isfinite(value).all() for value in values):
            raise HardwareError("a command holds a number that is not finite; it was not sent.")
        data = encode_command(self._layout, command)
        expires = command.made + command.valid_for
        with self._changed:
            if time.monotonic() >= expires:
                self.counts["expired"] += 1
                self._sink_now()
                return
            # The thread looks at the time of expiry again when the last one has come.
            asleep = not self._damping and self._expires == math.inf
            self._damping, self._expires = False, expires
            if asleep and expires < math.inf:
                self._changed.notify()
            trouble = self._write(data)
            if trouble:
                raise HardwareError(
                    f"a command could not be put on the wire ({trouble}); see to the network."
                )
            self.counts["commands"] += 1

    def damp(self) -> None:
        """Write damping now, and go on until the next command. Never raises."""
        with self._changed:
            self._sink_now()

    def stop(self) -> None:
        """Fall silent."""
        with self._changed:
            self._open = False
            self._changed.notify()
        self._thread.join()

    def is_own(self, data: bytes) -> bool:
        """Whether a command on the wire was written here; each comes back once."""
        with self._remembering:
            try:
                self._own.remove(data)
            except ValueError:
                return False
        return True

    def _sink_now(self) -> None:
        self._damping, self._expires = True, math.inf
        if self._open:
            self._write(self._sink)
            self._changed.notify()

    def _write(self, data: bytes) -> str:
        """Put a message on the wire; what went wrong, or ""."""
        self.wrote = True
        with self._remembering:
            self._own.appendleft(data)
        try:
            self._publish(data)
        except Exception as error:
            # Whatever it is: the thread that damps must outlive it, and try again.
            self.counts["not written"] += 1
            return str(error) or type(error).__name__
        return ""

    def _keep(self) -> None:
        with self._changed:
            while self._open:
                if self._damping:
                    self._changed.wait(_DAMP_PERIOD_S)
                    if self._damping and self._open:
                        self._write(self._sink)
                elif (left := self._expires - time.monotonic()) <= 0.0:
                    self.counts["expired"] += 1
                    self._sink_now()
                else:
                    self._changed.wait(left if left < math.inf else None)
