"""What the servo tells the others: the newest state, every tick, everything that happens."""

from __future__ import annotations

import time

import numpy as np

from pronk.links.machine import Command, State
from pronk.links.realtime import Pace
from pronk.runtime.plan import Shared
from pronk.runtime.reasons import Level, Reason
from pronk.runtime.records import NEWS, TICK, event, put_state
from pronk.runtime.safety import Verdict
from pronk.runtime.states import Director, Intent, Order


class Telling:
    """Writes to the shared memory, and never waits."""

    def __init__(self, shared: Shared, director: Director) -> None:
        """Begin.

        Args:
            shared: Where it is told.
            director: Whose mode is told with everything.
        """
        self._shared = shared
        self._director = director
        self._news = np.zeros((), dtype=NEWS)
        self._tick = np.zeros((), dtype=TICK)

    def say(
        self, kind: str, text: str, *, reason: Reason = Reason.NONE, level: Level = Level.PASS
    ) -> None:
        """Tell logger and operator that something happened."""
        record = event(time.monotonic(), kind, text, reason=reason, level=level)
        self._shared.events.put(record)
        self._shared.notices.put(record)

    def mode(self) -> None:
        """Tell logger and operator the mode."""
        self.say("mode", self._director.mode.name)

    def publish(self, state: State | None, now: float, pace: Pace) -> None:
        """Tell all the newest state; without any there are zeros, in a mode that reads none.

        Args:
            state: On CLOCK_MONOTONIC.
            now: When the tick began, on the same clock [s].
            pace: Of the ticks.
        """
        news = self._news
        if state is not None:
            put_state(news, state, 0.0)
        news["now"], news["start"] = now, pace.start
        news["mode"], news["entry"] = self._director.mode, self._director.entry
        self._shared.news.write(news)

    def tick(
        self,
        number: int,
        state: State,
        times: tuple[float, float, float],
        intent: Intent,
        sent: Command | None,
        verdict: Verdict,
        order: Order | None,
        latency: float,
    ) -> None:
        """Put a tick into the logger's queue.

        Args:
            number: Of the tick.
            state: The newest, on CLOCK_MONOTONIC.
            times: Its deadline, when it began, when it was done, on the same clock [s].
            intent: What was asked for.
            sent: What the filter let through; None for damping.
            verdict: The filter's.
            order: The policy's newest.
            latency: From a state to what answers it [s]; NaN if nothing new does.
        """
        tick = self._tick
        put_state(tick, state, 0.0)
        tick["tick"] = number
        tick["deadline"], tick["begun"], tick["done"] = times
        tick["mode"], tick["blend"] = self._director.mode, intent.blend
        tick["asked"] = np.nan if intent.command is None else intent.command.position
        tick["sent"] = np.nan if sent is None else sent.position
        tick["stiffness"] = 0.0 if sent is None else intent.stiffness
        tick["damped"] = sent is None and not intent.silent
        tick["level"], tick["reason"] = verdict.level, verdict.reason
        tick["order"] = -1 if order is None else order.sequence
        tick["order_state"] = -1 if order is None else order.state_sequence
        tick["latency"] = latency
        self._shared.ticks.put(tick)
