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
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import orjson

from pronk.deploy.plan import SERVO_PRIORITY, Names, Plan, Shared
from pronk.deploy.preflight import delay_objection, refusals
from pronk.deploy.reasons import Level, Reason
from pronk.deploy.records import NEWS, REAL, TICK, VIRTUAL, Mode, Wish, event, put_state
from pronk.deploy.safety import LEAST_DAMPING_S, Memory, Verdict, fault, filtered
from pronk.deploy.states import PREFLIGHT_S, Director, Intent, Order
from pronk.errors import PronkError
from pronk.hardware.machine import Command, Machine, State
from pronk.hardware.realtime import Histogram, Pace, enter

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
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the operator's process decides
    shared = Shared(names)
    servo = Servo(plan, shared, trained)
    signal.signal(signal.SIGTERM, lambda *_: servo.stop())
    try:
        servo.run()
    finally:
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
        self._wishes = 0
        self._order: Order | None = None
        self._seen: list[State] = []
        self._last = np.full(len(self.robot.joints), np.nan)
        self._news = np.zeros((), dtype=NEWS)
        self._tick = np.zeros((), dtype=TICK)

    def stop(self) -> None:
        """Damp and end, soon."""
        self._stopping = True

    def run(self) -> None:
        """Open the machine, tick until told to stop, damp, close."""
        machine = self.plan.link()
        try:
            self._open(machine)
            while not self._over():
                self._one(machine)
        except PronkError as error:
            self._say("refused", str(error), level=Level.LATCH)
        finally:
            self._close(machine)

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
            "dropped": self.shared.dropped(),
        }

    def _open(self, machine: Machine) -> None:
        # Before the link starts threads: they inherit what is granted, and so can never hold the
        # interpreter's lock while something less urgent runs.
        for line in enter(self.plan.wanted(SERVO_PRIORITY, 0)):
            self._say("system", line)
        sys.setswitchinterval(_SWITCH_S)
        machine.connect()
        self._machine = machine
        self._say("robot", VIRTUAL if machine.virtual else REAL)
        # The states' clock may be another; everything here is on CLOCK_MONOTONIC.
        self._offset = time.monotonic() - machine.now()
        machine.wait(machine.now())
        self._pace = Pace(self.plan.servo_rate_hz, time.monotonic() + 0.01)
        self.director.enter(Mode.PREFLIGHT, self._pace.start)

    def _over(self) -> bool:
        """Whether the loop may end: quit, and damped long enough."""
        assert self._pace is not None
        mode, now = self.director.mode, time.monotonic()
        if self._stopping or os.getppid() != self._parent:
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
        begun = time.monotonic()
        self.lateness.add(begun - deadline)
        self._take(met)
        if self.director.mode is Mode.PREFLIGHT:
            self._preflight(begun)
        if self._state is not None:
            self._decide(machine, self._state, deadline, begun, trouble)
        pace.advance(time.monotonic())

    def _decide(
        self, machine: Machine, state: State, deadline: float, begun: float, trouble: str
    ) -> None:
        """From a state to what is written to the machine."""
        self.age.add(max(0.0, begun - state.time))
        mode, memory, why = self.director.mode, self.memory, ""
        held, gone = self._stick(begun)
        fresh = self._orders()
        if trouble:
            memory, why = fault(memory, Level.LATCH, Reason.LINK, begun), trouble
        if gone and mode not in (Mode.IDLE, Mode.PREFLIGHT):
            memory = fault(memory, Level.DAMP, Reason.ENDED, begun)
        intent, memory = self.director.step(
            begun, state, memory, self._order, objection=self._objection()
        )
        if self.director.notice:
            self._say("notice", self.director.notice)
        self._publish(state, begun)
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
            self._say("mode", self.director.mode.name)
        order = self._order
        latency = np.nan
        if fresh and order is not None and self.director.mode in _THINKING:
            latency = done - order.state_time
            self.latency.add(max(0.0, latency))
        self._write(state, (deadline, begun, done), intent, sent, verdict, latency)

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
            self._say("refused", sentence)
        self.director.preflighted(found, now)
        self._say("mode", self.director.mode.name)

    def _stick(self, now: float) -> tuple[bool, bool]:
        """Whether the dead-man button is held, and whether the operator's program is gone."""
        stick = self.shared.stick.read()
        if stick is None:
            return False, now - self.director.since > 10.0 * self.plan.stick_valid_s
        if int(stick["wishes"]) != self._wishes:
            self._wishes = int(stick["wishes"])
            self.director.wish(Wish(int(stick["wish"])))
        gone = now - float(stick["time"]) > self.plan.stick_valid_s
        return bool(stick["held"]) and not gone, gone

    def _orders(self) -> bool:
        """Take the policy's newest order; whether there is a new one."""
        record = self.shared.orders.read()
        if record is None or (
            self._order is not None and int(record["sequence"]) == self._order.sequence
        ):
            return False
        self._order = Order(
            sequence=int(record["sequence"]),
            state_sequence=int(record["state_sequence"]),
            state_time=float(record["state_time"]),
            made=float(record["made"]),
            valid_for=float(record["valid_for"]),
            entry=int(record["entry"]),
            position=np.array(record["position"]),
        )
        return True

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

    def _publish(self, state: State, now: float) -> None:
        """Tell the others."""
        assert self._pace is not None
        news = self._news
        put_state(news, state, 0.0)
        news["now"], news["start"] = now, self._pace.start
        news["mode"], news["entry"] = self.director.mode, self.director.entry
        self.shared.news.write(news)

    def _write(
        self,
        state: State,
        times: tuple[float, float, float],
        intent: Intent,
        sent: Command | None,
        verdict: Verdict,
        latency: float,
    ) -> None:
        """Put the tick into the logger's queue."""
        assert self._pace is not None
        tick = self._tick
        put_state(tick, state, 0.0)
        tick["tick"] = self._pace.tick
        tick["deadline"], tick["begun"], tick["done"] = times
        tick["mode"], tick["blend"] = self.director.mode, intent.blend
        tick["asked"] = np.nan if intent.command is None else intent.command.position
        tick["sent"] = np.nan if sent is None else sent.position
        tick["stiffness"] = 0.0 if sent is None else intent.stiffness
        tick["damped"] = sent is None and not intent.silent
        tick["level"], tick["reason"] = verdict.level, verdict.reason
        tick["order"] = -1 if self._order is None else self._order.sequence
        tick["order_state"] = -1 if self._order is None else self._order.state_sequence
        tick["latency"] = latency
        self.shared.ticks.put(tick)

    def _fault(self, memory: Memory, text: str) -> None:
        self.faults.append(text)
        self._say("fault", text, reason=memory.reason, level=memory.level)

    def _say(
        self, kind: str, text: str, *, reason: Reason = Reason.NONE, level: Level = Level.PASS
    ) -> None:
        """Tell logger and operator."""
        record = event(time.monotonic(), kind, text, reason=reason, level=level)
        self.shared.events.put(record)
        self.shared.notices.put(record)

    def _close(self, machine: Machine) -> None:
        """Leave the joints damped, whatever happened before, and keep what the cameras saw."""
        if self._machine is None:
            return
        quiet = self.director.mode in (Mode.IDLE, Mode.PREFLIGHT)
        try:
            if not quiet and self.director.mode not in (Mode.DAMP, Mode.FAULT):
                # An error of pronk itself: damp for as long as a fault would.
                until = time.monotonic() + LEAST_DAMPING_S
                while time.monotonic() < until:
                    machine.damp()
                    machine.wait(machine.now() + 1.0 / self.plan.servo_rate_hz)
        finally:
            self._keep(machine)
            machine.close()
            self.director.enter(Mode.ENDED, time.monotonic())
            self._say("mode", Mode.ENDED.name)
            if self._state is not None:
                self._publish(self._state, time.monotonic())

    def _keep(self, machine: Machine) -> None:
        inner = getattr(machine, "inner", None)
        if self.plan.capture is not None and inner is not None:
            from pronk.hardware.capture import save

            save(self.plan.capture, inner.capture())


def _same(one: State, other: State) -> bool:
    """Whether two states are the same to the last bit, which no live sensors' are."""
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("gyro", "accelerometer", "position", "velocity")
    )
