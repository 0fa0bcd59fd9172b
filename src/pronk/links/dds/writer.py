"""The only writer of `rt/lowcmd` on a link: the command in force, again and again.

Unitree's drives are written to all the time, and nobody has published what they do when that
stops; so silence is filled with the last command, and with damping once that has expired. The
link's thread drives this: whoever commanded may be stuck.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from typing import Any

import numpy as np

from pronk.links.dds.address import write
from pronk.links.dds.codec import JointMap, encode_command
from pronk.links.machine import Command

_REPEAT_S = 0.004
"""Silence after which the command in force is written again; Unitree's examples write every 1 to
10 ms."""


class CommandWriter:
    """Keeps a command, or damping, in force. Any thread may call it."""

    def __init__(self, joints: JointMap, out: Any, counts: Counter[str]) -> None:
        """Nothing is in force yet, and nothing is written.

        Args:
            joints: Of the robot.
            out: The writer of the topic.
            counts: Where `commands`, `repeats`, `expired` and `not written` are counted.
        """
        self._joints = joints
        self._out = out
        self._counts = counts
        zeros = np.zeros_like(joints.sign)
        sink = Command(position=zeros, stiffness=zeros, damping=zeros + joints.sink)
        self._sink = encode_command(joints, sink)
        self._lock = threading.Lock()
        self._data, self._expires, self._due = b"", math.inf, math.inf

    @property
    def wrote(self) -> bool:
        """Whether anything was written at all."""
        return bool(self._data)

    @property
    def due(self) -> float:
        """When `keep` has something to do next, on the monotonic clock [s]."""
        return self._due

    def send(self, command: Command) -> None:
        """Put a command into force; one that has expired already becomes damping.

        Raises:
            HardwareError: No drive could follow it.
        """
        data = encode_command(self._joints, command)
        expires = command.made + command.valid_for
        with self._lock:
            if time.monotonic() >= expires:
                self._counts["expired"] += 1
                self._force(self._sink, math.inf)
            else:
                self._counts["commands"] += 1
                self._force(data, expires)

    def damp(self) -> None:
        """Put damping into force. Never raises."""
        with self._lock:
            self._force(self._sink, math.inf)

    def keep(self) -> None:
        """Write again what is in force, if it is time; damping, if it has expired."""
        with self._lock:
            now = time.monotonic()
            if now >= self._expires:
                self._counts["expired"] += 1
                self._force(self._sink, math.inf)
            elif now >= self._due:
                self._counts["repeats"] += 1
                self._force(self._data, self._expires)

    def _force(self, data: bytes, expires: float) -> None:
        self._data, self._expires = data, expires
        self._due = min(time.monotonic() + _REPEAT_S, expires)
        write(self._out, data, self._counts)
