"""How a machine in real time is served while it is asked."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from pronk.errors import HardwareError
from pronk.links.machine import Command, Machine, State
from pronk.links.realtime import Histogram
from pronk.runtime.sweep.limits import Limits


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Rates and patience of a servo."""

    rate_hz: float = 500.0
    """Of servo ticks: at each the command is written again and the new states are checked."""
    valid_for_s: float = 0.1
    """Silence of this program after which the link's writer damps [s]."""
    oldest_state_s: float = 0.1
    """Age of the newest state beyond which the sweep is ended [s]."""
    silent_s: float = 1.0
    """Silence of the program that shows progress and writes the log, after which it is ended [s];
    one that died is known at once."""

    def __post_init__(self) -> None:
        """Refuse what is no time.

        Raises:
            HardwareError: A number is not above 0.
        """
        for name, value in vars(self).items():
            if not value > 0.0:
                raise HardwareError(f"{name} is {value}; expected a number above 0.")


class Servo:
    """Keeps a command in force on a machine whose clock nobody can stop, and watches it.

    Its ticks are at absolute deadlines: lateness never adds up, and missed ticks are left out.
    """

    def __init__(
        self, timing: Timing | None = None, watch: Callable[[], None] = lambda: None
    ) -> None:
        """Begin; it may serve one recording.

        Args:
            timing: Rates and patience; the usual if None.
            watch: Called at every tick before anything is sent; what it raises ends the recording.
        """
        self.timing = timing or Timing()
        self._watch = watch
        self.lateness = Histogram()
        """From a tick's deadline to its beginning [s]."""
        self.missed = 0
        """Ticks that had passed before their turn."""
        self._sequence = 0

    def hold(
        self,
        machine: Machine,
        command: Command,
        limits: Limits,
        met: list[State],
        *,
        start: float,
        end: float,
    ) -> None:
        """Keep a command in force from `start` to `end` on the machine's clock [s].

        Args:
            machine: Who follows it.
            command: What is asked.
            limits: What no state may exceed.
            met: The states met meanwhile are put here, the one that breaches a limit too.
            start: Deadline of the first tick.
            end: Deadline of the next command's first tick.

        Raises:
            HardwareError: A state beyond a limit or none for too long, or the link's own refusal.
        """
        rate = self.timing.rate_hz
        # Ticks within this command, the last one is the next command's first.
        ticks = max(1, round((end - start) * rate))
        tick = 0
        while tick < ticks:
            self._watch()
            self._send(machine, command)
            tick += 1
            passed = math.ceil((machine.now() - start) * rate)
            if passed > tick:
                self.missed += min(passed, ticks) - tick
                tick = min(passed, ticks)
            deadline = start + (end - start) * tick / ticks
            states = machine.wait(deadline)
            now = machine.now()
            self.lateness.add(max(0.0, now - deadline))
            met += states
            for state in states:
                limits.check(state)
            age = now - machine.latest().time
            if not age <= self.timing.oldest_state_s:
                raise HardwareError(
                    f"the newest state of {machine.robot} is {1e3 * age:.0f} ms old, expected at "
                    f"most {1e3 * self.timing.oldest_state_s:.0f} ms; the joints were damped; "
                    "check the link, and that nothing else keeps this computer busy."
                )

    def figures(self) -> dict[str, float | int]:
        """Of the ticks' lateness, as `Histogram.figures`, and how many were `missed`."""
        return {**self.lateness.figures(), "missed": self.missed}

    def _send(self, machine: Machine, command: Command) -> None:
        self._sequence += 1
        machine.send(
            replace(
                command,
                sequence=self._sequence,
                state_sequence=machine.latest().sequence,
                made=machine.now(),
                valid_for=self.timing.valid_for_s,
            )
        )
