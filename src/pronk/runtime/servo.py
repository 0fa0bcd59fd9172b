"""The servo: the one process that owns the machine and the only writer to it.

At 500 Hz, on absolute deadlines: collect states, ask the state machine what is wanted, let the
safety filter have the last word, send. It neither thinks nor writes files; what it saw and did goes
into a queue that never makes it wait. Whatever ends it, the joints are damped first.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import orjson

from pronk.errors import PronkError
from pronk.links.machine import Command, Machine, State
from pronk.links.realtime import Histogram, Pace, enter, sleep_until
from pronk.links.terminal import leave
from pronk.runtime.inputs import Hearing
from pronk.runtime.outputs import Telling
from pronk.runtime.plan import SERVO_PRIORITY, Names, Plan, Shared
from pronk.runtime.preflight import delay_objection, refusals
from pronk.runtime.reasons import Level, Reason
from pronk.runtime.records import REAL, VIRTUAL, Mode, Wish
from pronk.runtime.safety import LEAST_DAMPING_S, Memory, Verdict, fault, filtered
from pronk.runtime.states import PREFLIGHT_S, Director, Intent

_SWITCH_S = 0.5e-3
"""Longest that a thread of the link keeps the loop waiting [s]."""
_THINKING = (Mode.STAND, Mode.POLICY, Mode.HALT)
"""Modes in which the policy's latency is measured; while standing it decides, but is not heard."""


def serve(plan: Plan, names: Names, trained: tuple[float, float], end: Connection) -> None:
    """Body of the servo process.

    Args:
        plan: What to do.
        names: Of the shared memory.
        trained: Command delays that the policy was trained for [s].
        end: Where the figures of the run go when it is over, as JSON.
    """
    leave()  # the operator's process decides
    shared = Shared(names)
    servo = Servo(plan, shared, trained)
    signal.signal(signal.SIGTERM, lambda *_: servo.stop())
    try:
        servo.run()
    finally:
        with suppress(OSError):  # nobody is there any more
            end.send_bytes(orjson.dumps(servo.figures()))
        end.close()
        shared.close()


class Servo:
    """The loop and what it counts."""

    def __init__(self, plan: Plan, shared: Shared, trained: tuple[float, float]) -> None:
        """Read the plan; nothing is opened yet."""
        self.plan = plan
        self.shared = shared
        self.trained = trained
        self.robot = plan.robot
        self.limits = plan.safety()
        self.director = Director(self.robot, plan.timing)
        self.telling = Telling(shared, self.director)
        self.hearing = Hearing(shared, self.director, plan.stick_valid_s)
        self.memory = Memory()
        self.lateness = Histogram()
        self.latency = Histogram()
        """From a state to the command that answers it."""
        self.age = Histogram()
        """Of the newest state at each tick."""
        self.interventions: dict[str, int] = {}
        self.faults: list[str] = []
        self.states = 0
        self.lost = 0
        self.repeated = 0
        """States whose numbers were those of the one before, to the last bit."""
        self._machine: Machine | None = None
        self._pace: Pace | None = None
        self._state: State | None = None
        self._stopping = False
        self._parent = os.getppid()
        self._alone = False
        self._seen: list[State] = []

    def stop(self) -> None:
        """Damp and end, soon."""
        self._stopping = True

    def run(self) -> None:
        """Open the machine, tick until told to stop, damp, close."""
        try:
            machine = self.plan.link()
            self._open(machine)
            while not self._over():
                self._one(machine)
        except PronkError as error:
            self.telling.say("refused", str(error), level=Level.LATCH)
        finally:
            if self._machine is not None:
                self._close(self._machine)

    def figures(self) -> dict[str, Any]:
        """Of the run so far."""
        pace = self._pace
        machine = self._machine
        return {
            "virtual": None if machine is None else machine.virtual,
            "ticks": self.lateness.count,
            "missed_ticks": 0 if pace is None else pace.missed,
            "states": self.states,
            "states_lost": self.lost,
            "states_repeated": self.repeated,
            "lateness": self.lateness.figures(),
            "state_to_command": self.latency.figures(),
            "state_age": self.age.figures(),
            "interventions": self.interventions,
            "faults": self.faults,
            "refusals": list(self.director.refusals),
            # Without a log nobody empties the queues to it, and nothing is lost.
            "dropped": {} if self.plan.log is None else self.shared.dropped(),
        }

    def _open(self, machine: Machine) -> None:
        # Before the link starts threads: they inherit what is granted, and so can never hold the
        # interpreter's lock while something less urgent runs.
        for line in enter(self.plan.wanted(SERVO_PRIORITY, 0)):
            self.telling.say("system", line)
        sys.setswitchinterval(_SWITCH_S)
        machine.connect()
        self._machine = machine
        self.telling.say("robot", VIRTUAL if machine.virtual else REAL)
        # The states' clock may be another; everything here is on CLOCK_MONOTONIC.
        self._offset = time.monotonic() - machine.now()
        machine.wait(machine.now())
        self._pace = Pace(self.plan.servo_rate_hz, time.monotonic() + 0.01)
        self.director.enter(Mode.PREFLIGHT, self._pace.start)

    def _over(self) -> bool:
        """Whether the loop may end: quit, and damped long enough."""
        assert self._pace is not None
        mode, now = self.director.mode, time.monotonic()
        if not self._alone and os.getppid() != self._parent:
            self._alone = True
            self.telling.say("notice", "the operator's program has ended")
        if self._stopping or self._alone:
            self.director.wish(Wish.QUIT)
        if not self.director.quitting():
            return False
        if mode in (Mode.IDLE, Mode.PREFLIGHT):
            return True
        return mode in (Mode.DAMP, Mode.FAULT) and now - self.director.since >= LEAST_DAMPING_S

    def _one(self, machine: Machine) -> None:
        """One tick."""
        pace = self._pace
        assert pace is not None
        deadline = pace.deadline
        trouble = ""
        try:
            met = machine.wait(deadline - self._offset)
        except PronkError as error:
            met, trouble = [], str(error)
            sleep_until(deadline)
        begun = time.monotonic()
        self.lateness.add(begun - deadline)
        self._take(met)
        if self.director.mode is Mode.PREFLIGHT:
            self._preflight(begun)
        if self._state is not None:
            self._decide(machine, self._state, begun, trouble)
        else:
            # Nothing to decide on, but the operator is heard, and told.
            self.hearing.stick(begun)
            self.telling.publish(None, begun, pace)
        pace.advance(time.monotonic())

    def _decide(self, machine: Machine, state: State, begun: float, trouble: str) -> None:
        """From a state to what is written to the machine."""
        pace = self._pace
        assert pace is not None
        self.age.add(max(0.0, begun - state.time))
        mode, memory, why = self.director.mode, self.memory, ""
        held, gone = self.hearing.stick(begun)
        fresh = self.hearing.orders()
        if trouble:
            memory, why = fault(memory, Level.LATCH, Reason.LINK, begun), trouble
        if gone and mode not in (Mode.IDLE, Mode.PREFLIGHT):
            memory = fault(memory, Level.DAMP, Reason.ENDED, begun)
        intent, memory = self.director.step(
            begun, state, memory, self.hearing.order, objection=self._objection()
        )
        if self.director.notice:
            self.telling.say("notice", self.director.notice)
        self.telling.publish(state, begun, pace)
        sent, verdict, memory = self._filter(intent, state, memory, begun, held)
        trouble = self._act(machine, intent, sent)
        done = time.monotonic()
        if trouble:
            memory, why = fault(memory, Level.LATCH, Reason.LINK, done), trouble
        if memory.level > self.memory.level and memory.faulted:
            self._fault(memory, why or (verdict.text if verdict.detail else memory.reason.text))
        self.memory = memory
        if memory.faulted:
            self.director.faulted(begun)
        if self.director.mode is not mode:
            self.telling.mode()
        order = self.hearing.order
        latency = np.nan
        if fresh and order is not None and self.director.mode in _THINKING:
            latency = done - order.state_time
            self.latency.add(max(0.0, latency))
        times = (pace.deadline, begun, done)
        self.telling.tick(pace.tick, state, times, intent, sent, verdict, order, latency)

    def _take(self, met: list[State]) -> None:
        for state in met:
            state = replace(state, time=state.time + self._offset)
            if self._state is not None:
                if _same(state, self._state):
                    # Data that stand still behind a clock that goes on: let the last real state
                    # grow old.
                    self.repeated += 1
                    continue
                self.lost += max(0, state.sequence - self._state.sequence - 1)
            self._state = state
            self.states += 1
            if self.director.mode is Mode.PREFLIGHT:
                self._seen.append(state)

    def _preflight(self, now: float) -> None:
        looked = now - self.director.since
        if looked < PREFLIGHT_S:
            return
        found = refusals(self._seen, self.robot, self.limits, now=now, seconds=looked)
        self._seen.clear()
        for sentence in found:
            self.telling.say("refused", sentence)
        self.director.preflighted(found, now)
        self.telling.mode()

    def _objection(self) -> str:
        if self.plan.any_delay or self.director.mode is not Mode.STAND:
            return ""
        return delay_objection(self.latency.quantile(0.95), self.latency.count, self.trained)

    def _filter(
        self, intent: Intent, state: State, memory: Memory, now: float, held: bool
    ) -> tuple[Command | None, Verdict, Memory]:
        """The filter's word on what is asked."""
        if intent.command is None:
            quiet = Verdict(level=memory.level, reason=memory.reason)
            # Damping is always allowed; the next target is measured against where the joints are.
            return None, quiet, replace(memory, last=None)
        needed = self.director.mode is Mode.POLICY
        sent, verdict, memory = filtered(
            state, intent.command, memory, self.limits, now, held=held or not needed
        )
        if Level.PASS < verdict.level < Level.DAMP:
            name = verdict.reason.name.lower()
            self.interventions[name] = self.interventions.get(name, 0) + 1
        return sent, verdict, memory

    def _act(self, machine: Machine, intent: Intent, sent: Command | None) -> str:
        """Write to the machine; what the link objects to, or ""."""
        if intent.silent:
            return ""
        try:
            if sent is None:
                machine.damp()
            else:
                machine.send(replace(sent, made=sent.made - self._offset))
        except PronkError as error:
            return str(error)
        return ""

    def _fault(self, memory: Memory, text: str) -> None:
        self.faults.append(text)
        self.telling.say("fault", text, reason=memory.reason, level=memory.level)

    def _close(self, machine: Machine) -> None:
        """Leave the joints damped, whatever happened before, and keep what the cameras saw."""
        quiet = self.director.mode in (Mode.IDLE, Mode.PREFLIGHT)
        try:
            if not quiet and self.director.mode not in (Mode.DAMP, Mode.FAULT):
                # An error of pronk itself: damp for as long as a fault would.
                until = time.monotonic() + LEAST_DAMPING_S
                while time.monotonic() < until:
                    machine.damp()
                    machine.wait(machine.now() + 1.0 / self.plan.servo_rate_hz)
        finally:
            try:
                self._keep(machine)
            finally:
                machine.close()
                self.director.enter(Mode.ENDED, time.monotonic())
                self.telling.mode()
                if self._pace is not None:
                    self.telling.publish(self._state, time.monotonic(), self._pace)

    def _keep(self, machine: Machine) -> None:
        """Save what the cameras saw; a disk that is full harms nothing else."""
        inner = getattr(machine, "inner", None)
        if self.plan.capture is None or inner is None:
            return
        from pronk.virtual.capture import save

        try:
            save(self.plan.capture, inner.capture())
        except (OSError, PronkError) as error:
            self.telling.say("lost", f"what the cameras saw was not kept: {error}")


def _same(one: State, other: State) -> bool:
    """Whether two states are the same to the last bit, which no live sensors' are."""
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("gyro", "accelerometer", "position", "velocity")
    )
