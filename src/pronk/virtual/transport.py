"""The way of a command to the drives: checked, late by the transport delay, and not for ever.

A command that expires is followed by damping, as whoever writes a real robot's wire does it: at
`made + valid_for`, later by the same delay. A newer command takes the place of an older one
together with its expiry.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from pronk.errors import HardwareError
from pronk.links.machine import Command

_SINK_DAMPING = 1.0
"""Damping of `sinking` [N m s/rad]: a leg sinks from its pose in about a second."""


def sinking(joints: int) -> Command:
    """The command that lets joints sink softly: no stiffness, some damping."""
    zeros = np.zeros(joints)
    return Command(position=zeros, stiffness=zeros, damping=zeros + _SINK_DAMPING)


def check_command(command: Command, joints: int) -> None:
    """See that drives can follow a command.

    Raises:
        HardwareError: Wrong shape, not finite, a negative gain, or a time that is none.
    """
    for name in ("position", "stiffness", "damping"):
        values = np.asarray(getattr(command, name))
        if values.shape != (joints,) or not np.isfinite(values).all():
            raise HardwareError(
                f"command.{name} has shape {values.shape} or is not finite; "
                f"expected {(joints,)} finite numbers, one per joint."
            )
        if name != "position" and values.min() < 0.0:
            raise HardwareError(f"command.{name} is negative; the drives accept 0 or more.")
    if not math.isfinite(command.made) or not command.valid_for > 0.0:
        raise HardwareError(
            f"command.made is {command.made} and command.valid_for {command.valid_for}; expected a "
            "finite time [s] and a positive one, which may be infinite."
        )


class Transport:
    """Commands under way, in order of arrival. Time is counted in physics steps."""

    def __init__(self, joints: int, delay_s: float, step_s: float) -> None:
        """Nothing is under way yet.

        Args:
            joints: How many the commands are for.
            delay_s: From sending to being heard [s].
            step_s: Physics step [s].
        """
        self._sinking = sinking(joints)
        self._delay, self._step = delay_s, step_s
        self._under_way: deque[tuple[int, Command]] = deque()
        self._expiry = math.inf

    def put(self, command: Command, now: float) -> None:
        """Send a command at a time on the machine's clock [s]."""
        self._under_way.append((round((now + self._delay) / self._step), command))

    @property
    def soonest(self) -> float:
        """Physics step at which the next command is heard, of those on the way; may be infinite."""
        return min(self._under_way[0][0], self._expiry) if self._under_way else self._expiry

    def take(self, before: int) -> tuple[int, Command] | None:
        """The next command that is heard before a physics step, and the step; None without one."""
        step = self._under_way[0][0] if self._under_way else before
        # At the same step the newer command wins: it is taken after the expiry.
        if self._expiry <= step and self._expiry < before:
            expired, self._expiry = int(self._expiry), math.inf
            return expired, self._sinking
        if step >= before:
            return None
        _, command = self._under_way.popleft()
        end = command.made + command.valid_for
        self._expiry = round((end + self._delay) / self._step) if math.isfinite(end) else math.inf
        return step, command
