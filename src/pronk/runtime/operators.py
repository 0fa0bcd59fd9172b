"""Who holds the stick: what every operator gives, and those that need nobody."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from pronk.runtime.records import Mode, Wish
from pronk.runtime.script import STILL, Script, Velocity


@dataclass(frozen=True, kw_only=True)
class Stick:
    """What the operator wants at a moment."""

    command: Velocity = STILL
    """Forward, left [m/s], yaw rate [rad/s], in the trunk's frame."""
    jump: bool = False
    held: bool = False
    """Whether the dead-man button is held: without it the policy's robot is damped."""
    wish: Wish = Wish.NONE
    """Something new that is asked for."""


class Operator(Protocol):
    """Gives the stick's position, 50 times a second."""

    def stick(self, now: float, mode: Mode) -> Stick:
        """What is wanted now.

        Args:
            now: CLOCK_MONOTONIC [s].
            mode: What the servo is doing.
        """

    def told(self, kind: str, text: str) -> None:
        """Hear what the servo has to say."""

    def leave(self) -> None:
        """The program was interrupted."""


class Scripted:
    """Stands up, runs one script after another, sits down, leaves; needs nobody.

    It ends at the first fault or refusal.
    """

    def __init__(self, scripts: Sequence[Script], *, pause_s: float = 1.0) -> None:
        """Take the scripts.

        Args:
            scripts: What is asked while the policy is in charge, one after the other.
            pause_s: Of standing still between two [s].
        """
        self.scripts = tuple(scripts)
        self.pause_s = pause_s
        self._began: float | None = None
        self._asked = Mode.ENDED
        self._over = False
        self.finished = False
        """True once all scripts have been run to their ends."""

    @property
    def seconds(self) -> float:
        """While the policy is in charge [s]."""
        return sum(script.seconds + self.pause_s for script in self.scripts)

    def told(self, kind: str, text: str) -> None:
        """A fault or a refusal ends it."""
        if kind in ("fault", "refused") or (kind == "notice" and self._began is None):
            self._over = True

    def leave(self) -> None:
        """End it."""
        self._over = True

    def stick(self, now: float, mode: Mode) -> Stick:
        """What the scripts say."""
        if self._over or (self.finished and mode is Mode.DAMP):
            return Stick(wish=self._once(Wish.QUIT, Mode.ENDED))
        if mode is Mode.DAMP:
            return Stick(wish=self._once(Wish.STAND, mode))
        if mode is Mode.STAND:
            return Stick(held=True, wish=self._once(Wish.WALK, mode))
        if mode is not Mode.POLICY:
            return Stick(held=True)
        if self._began is None:
            self._began = now
        t = now - self._began
        for script in self.scripts:
            if t < script.seconds:
                command, jump = script.commanded(t)
                return Stick(command=command, jump=jump, held=True)
            t -= script.seconds
            if t < self.pause_s:
                return Stick(held=True)
            t -= self.pause_s
        self.finished = True
        return Stick(held=True, wish=self._once(Wish.SIT, mode))

    def _once(self, wish: Wish, mode: Mode) -> Wish:
        """A wish, said once for each mode."""
        if self._asked is mode and wish is not Wish.QUIT:
            return Wish.NONE
        self._asked = mode
        return wish


class Timed:
    """Another operator, who sits down when the time is over."""

    def __init__(self, operator: Operator, seconds: float) -> None:
        """Begin to count when the policy takes over.

        Args:
            operator: Who else decides.
            seconds: With the policy in charge [s].
        """
        self._operator = operator
        self._seconds = seconds
        self._began: float | None = None
        self._sat = False

    def stick(self, now: float, mode: Mode) -> Stick:
        """What the other wants, until the time is over."""
        wanted = self._operator.stick(now, mode)
        if mode is Mode.POLICY and self._began is None:
            self._began = now
        if self._began is None or now - self._began < self._seconds:
            return wanted
        if mode is Mode.POLICY:
            wish = Wish.NONE if self._sat else Wish.SIT
            self._sat = True
            return Stick(held=wanted.held, wish=wish)
        return Stick(wish=Wish.QUIT) if mode is Mode.DAMP else Stick(held=wanted.held)

    def told(self, kind: str, text: str) -> None:
        """Tell the other."""
        self._operator.told(kind, text)

    def leave(self) -> None:
        """Tell the other."""
        self._operator.leave()
