"""The servo: the one process that owns the machine and the only writer to it.

At 500 Hz, on absolute deadlines: collect states, take the desired command from the state machine,
pass it through the safety filter, send. It runs no network and writes no files; what it measured
and sent goes into a queue that never makes it wait. Whatever ends it, the joints are damped first.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import orjson

from pronk.errors import HardwareError, PronkError
from pronk.links.machine import Command, Machine, State
from pronk.links.realtime import Histogram, Pace, enter, leave, sleep_until
from pronk.runtime.ipc import (
    REAL,
    STATE,
    TICK,
    VIRTUAL,
    Mode,
    OperatorRequest,
    PolicyAction,
    Shared,
    event,
    put_state,
)
from pronk.runtime.plan import SERVO_PRIORITY, Plan
from pronk.runtime.preflight import delay_objection, refusals
from pronk.runtime.safety import (
    LEAST_DAMPING_S,
    FilterAction,
    FilterDecision,
    FilterState,
    Reason,
    fault,
    filtered,
)
from pronk.runtime.state_machine import PREFLIGHT_S, VALID_S, DesiredCommand, StateMachine
from pronk.runtime.sweep import SweepController, SweepTask

_SWITCH_S = 0.5e-3
"""Longest that a thread of the link keeps the loop waiting [s]."""
_DECIDING = (Mode.STAND, Mode.POLICY, Mode.HALT)
"""Modes in which the policy's latency is measured; while standing its actions are not used."""


def serve(plan: Plan, name: str, trained: tuple[float, float], end: Connection) -> None:
    """Body of the servo's process.

    Args:
        plan: The run.
        name: Of the shared memory.
        trained: Command delays that the policy was trained for [s].
        end: Sends the figures of the run when it is over, JSON.
    """
    leave()  # the operator's process decides
    shared = Shared(name)
    servo = Servo(plan, shared, trained)
    signal.signal(signal.SIGTERM, lambda *_: servo.stop())
    try:
        servo.run()
    finally:
        with suppress(OSError):  # the parent has ended
            end.send_bytes(orjson.dumps(servo.figures()))
        end.close()
        shared.close()


class Servo:
    """The loop and its figures."""

    def __init__(self, plan: Plan, shared: Shared, trained: tuple[float, float]) -> None:
        """Read the plan; nothing is opened yet."""
        self.plan = plan
        self.shared = shared
        self.trained = trained
        self.robot = plan.robot
        self.limits = plan.safety()
        self.machine_state = StateMachine(self.robot, plan.timing)
        self.action: PolicyAction | None = None
        """The policy's newest."""
        self._requests = 0
        self._state_record = np.zeros((), dtype=STATE)
        self._tick_record = np.zeros((), dtype=TICK)
        self.memory = FilterState()
        self.lateness = Histogram()
        self.latency = Histogram()
        """From a state to the command computed from it."""
        self.age = Histogram()
        """Of the newest state at each tick."""
        self.interventions: dict[str, int] = {}
        self.faults: list[str] = []
        self.states = 0
        self.lost = 0
        self.repeated = 0
        """States equal to the one before to the last bit."""
        self._machine: Machine | None = None
        self._pace: Pace | None = None
        self._state: State | None = None
        self._stopping = False
        self._parent = os.getppid()
        self._alone = False
        self._seen: list[State] = []
        self._met: list[State] = []
        """New states of this tick."""
        self._sweep: SweepController | None = None
        self._progress = 0.0
        self._finished = False
        self._clamped = threading.Event()

    def stop(self) -> None:
        """Damp and end, soon."""
        self._stopping = True

    def run(self) -> None:
        """Open the machine, tick until stopped, damp, close."""
        try:
            machine = self.plan.link(self._fix)
            self._open(machine)
            while not self._over():
                self._one(machine)
        except PronkError as error:
            self.faults.append(str(error))
            self._report("refused", str(error), level=FilterAction.LATCH)
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
            "finished": self._finished,
            "faults": self.faults,
            "refusals": list(self.machine_state.refusals),
            # Without a log nobody empties the queues to it, and nothing is lost.
            "dropped": {} if self.plan.log is None else self.shared.dropped(),
        }

    def _operator(self, now: float) -> tuple[bool, bool]:
        """Read the operator's mailbox: dead-man button held, operator's program gone."""
        record = self.shared.operator.read()
        timeout = self.plan.operator_timeout_s
        if record is None:
            return False, now - self.machine_state.since > 10.0 * timeout
        if int(record["requests"]) != self._requests:
            self._requests = int(record["requests"])
            request = OperatorRequest(int(record["request"]))
            if request is OperatorRequest.CLAMPED:
                self._clamped.set()
            else:
                self.machine_state.request(request)
        gone = now - float(record["time"]) > timeout
        return bool(record["held"]) and not gone, gone

    def _new_action(self) -> bool:
        """Take the policy's newest action; whether there is a new one."""
        record = self.shared.actions.read()
        if record is None or (
            self.action is not None and record["sequence"] == self.action.sequence
        ):
            return False
        values = {name: record[name].tolist() for name in record.dtype.names or ()}
        self.action = PolicyAction(**values | {"position": record["position"]})
        return True

    def _report(self, kind: str, text: str, *, reason: int = 0, level: int = 0) -> None:
        """Send an event to logger and operator."""
        record = event(time.monotonic(), kind, text, reason=reason, level=level)
        self.shared.events.put(record)
        self.shared.events_seen.put(record)

    def _report_mode(self) -> None:
        self._report("mode", self.machine_state.mode.name)

    def _publish(self, state: State | None, now: float, pace: Pace) -> None:
        """Write the newest state and the mode for the other processes; zeros without a state."""
        record = self._state_record
        if state is not None:
            put_state(record, state)
        record["now"], record["start"] = now, pace.start
        record["progress"] = self._progress
        record["mode"], record["entry"] = self.machine_state.mode, self.machine_state.entry
        self.shared.state.write(record)

    def _log_tick(
        self,
        number: int,
        state: State,
        times: tuple[float, float, float],
        desired: DesiredCommand,
        sent: Command | None,
        decision: FilterDecision,
        latency: float,
    ) -> None:
        """Put a tick into the logger's queue.

        `times` are its deadline, begin and end on CLOCK_MONOTONIC [s], `latency` is from a state to
        the command that uses it [s], NaN without a new action.
        """
        tick, action = self._tick_record, self.action
        put_state(tick, state)
        tick["tick"] = number
        tick["deadline"], tick["begun"], tick["done"] = times
        tick["mode"], tick["blend"] = self.machine_state.mode, desired.blend
        tick["desired"] = np.nan if desired.command is None else desired.command.position
        tick["sent"] = np.nan if sent is None else sent.position
        tick["stiffness"] = 0.0 if sent is None else desired.stiffness
        tick["damped"] = sent is None and not desired.silent
        tick["level"], tick["reason"] = decision.level, decision.reason
        tick["action"] = -1 if action is None else action.sequence
        tick["action_state"] = -1 if action is None else action.state_sequence
        tick["latency"] = latency
        self.shared.ticks.put(tick)

    def _open(self, machine: Machine) -> None:
        # Before the link starts threads: they inherit the priority, and so never hold the
        # interpreter's lock while something less urgent runs.
        for line in enter(self.plan.wanted(SERVO_PRIORITY, 0)):
            self._report("system", line)
        sys.setswitchinterval(_SWITCH_S)
        machine.connect()
        self._machine = machine
        self._report("robot", VIRTUAL if machine.virtual else REAL)
        # The states' clock may be another; everything here is on CLOCK_MONOTONIC.
        self._offset = time.monotonic() - machine.now()
        machine.wait(machine.now())
        self._pace = Pace(self.plan.servo_rate_hz, time.monotonic() + 0.01)
        self.machine_state.enter(Mode.PREFLIGHT, self._pace.start)

    def _over(self) -> bool:
        """Whether the loop may end: quit, and damped long enough."""
        assert self._pace is not None
        mode, now = self.machine_state.mode, time.monotonic()
        if not self._alone and os.getppid() != self._parent:
            self._alone = True
            self._report("notice", "the operator's program has ended")
        if self._stopping or self._alone:
            self.machine_state.request(OperatorRequest.QUIT)
        if not self.machine_state.quitting():
            return False
        if mode in (Mode.IDLE, Mode.PREFLIGHT):
            return True
        return mode in (Mode.DAMP, Mode.FAULT) and now - self.machine_state.since >= LEAST_DAMPING_S

    def _one(self, machine: Machine) -> None:
        """One tick."""
        pace = self._pace
        assert pace is not None
        deadline = pace.deadline
        link_error = ""
        try:
            met = machine.wait(deadline - self._offset)
        except PronkError as error:
            met, link_error = [], str(error)
            sleep_until(deadline)
        begun = time.monotonic()
        self.lateness.add(begun - deadline)
        self._take(met)
        if self.machine_state.mode is Mode.PREFLIGHT:
            self._preflight(begun)
        if self._state is not None:
            self._decide(machine, self._state, begun, link_error)
        else:
            # Without a state nothing is decided, but requests are read.
            self._operator(begun)
            self._publish(None, begun, pace)
        pace.advance(time.monotonic())

    def _decide(self, machine: Machine, state: State, begun: float, link_error: str) -> None:
        """From a state to what is written to the machine."""
        pace = self._pace
        assert pace is not None
        self.age.add(max(0.0, begun - state.time))
        mode, memory, why = self.machine_state.mode, self.memory, ""
        held, gone = self._operator(begun)
        fresh = self._new_action()
        if link_error:
            memory, why = fault(memory, FilterAction.LATCH, Reason.LINK, begun), link_error
        if gone and mode not in (Mode.IDLE, Mode.PREFLIGHT):
            memory = fault(memory, FilterAction.DAMP, Reason.ENDED, begun)
        desired, memory = self.machine_state.step(
            begun, state, memory, self.action, objection=self._objection()
        )
        if self.machine_state.notice:
            self._report("notice", self.machine_state.notice)
        self._publish(state, begun, pace)
        sent, decision, memory = self._filter(desired, state, memory, begun, held)
        link_error = self._act(machine, desired, sent)
        done = time.monotonic()
        if link_error:
            memory, why = fault(memory, FilterAction.LATCH, Reason.LINK, done), link_error
        if memory.level > self.memory.level and memory.faulted:
            self._fault(memory, why or (decision.text if decision.detail else memory.reason.text))
        self.memory = memory
        if memory.faulted:
            self.machine_state.faulted(begun)
        if self._sweep is not None and mode is Mode.SWEEP:
            if sent is not None:
                self._sweep.sent(begun, sent.position)
            if self.machine_state.mode is not Mode.SWEEP:
                self._end_sweep()
        if self.machine_state.mode is not mode:
            self._report_mode()
        action = self.action
        latency = np.nan
        if fresh and action is not None and self.machine_state.mode in _DECIDING:
            latency = done - action.state_time
            self.latency.add(max(0.0, latency))
        if self.plan.sweep is not None:
            return  # its log is the samples'
        times = (pace.deadline, begun, done)
        self._log_tick(pace.tick, state, times, desired, sent, decision, latency)

    def _take(self, met: list[State]) -> None:
        self._met.clear()
        for state in met:
            state = replace(state, time=state.time + self._offset)
            if self._state is not None:
                if _same(state, self._state):
                    # Repeated data with new stamps: the last real state must grow old.
                    self.repeated += 1
                    continue
                self.lost += max(0, state.sequence - self._state.sequence - 1)
            self._state = state
            self.states += 1
            self._met.append(state)
            if self._sweep is not None:
                self._sweep.take([state])
            if self.machine_state.mode is Mode.PREFLIGHT:
                self._seen.append(state)

    def _preflight(self, now: float) -> None:
        looked = now - self.machine_state.since
        if looked < PREFLIGHT_S:
            return
        found = refusals(self._seen, self.robot, self.limits, now=now, seconds=looked)
        self._seen.clear()
        for sentence in found:
            self._report("refused", sentence)
        if self.plan.sweep is not None:
            self._begin_sweep(self.plan.sweep)
        self.machine_state.preflighted(found, now)
        self._report_mode()

    # --- a sweep ----------------------------------------------------------------------------------

    def _begin_sweep(self, task: SweepTask) -> None:
        assert self._machine is not None
        assert self._state is not None
        self._sweep = SweepController(
            task,
            self._machine,
            self.shared.samples.put,
            state=self._state,
            real_time=True,
            progress=self._note_progress,
            limits=self.plan.limits,
        )
        self.limits = self._sweep.limits
        self.machine_state.controller = self._excite

    def _excite(self, t: float, state: State) -> DesiredCommand | None:
        """The sweep's command at a tick; None once it is over."""
        del state
        sweep = self._sweep
        assert sweep is not None
        if self.shared.samples.dropped:
            raise HardwareError(
                "the process that writes the log fell behind; the joints were damped; see that "
                "the disk is not busy."
            )
        if sweep.due(t, 0.5 / self.plan.servo_rate_hz):
            if sweep.advance(t) is None:
                self._finished = True
                return None
            self.limits = sweep.limits
        return DesiredCommand(command=sweep.command(t, VALID_S), stiffness=1.0)

    def _note_progress(self, share: float, what: str) -> None:
        self._progress = share
        if what.startswith("wrote "):
            self._report("log", what.removeprefix("wrote "))

    def _end_sweep(self) -> None:
        """End a log that is still open, and say why."""
        if self._sweep is not None:
            parent = "the program that started the sweep ended" if self._alone else "interrupted"
            self._sweep.end(self.faults[-1] if self.faults else parent)

    def _fix(self, joints: tuple[str, ...]) -> None:
        """Have the operator clamp joints and wait; runs in a thread of its own."""
        self._clamped.clear()
        self._report("clamp", ", ".join(joints))
        self._clamped.wait()

    def _objection(self) -> str:
        if self.plan.ignore_latency or self.machine_state.mode is not Mode.STAND:
            return ""
        return delay_objection(self.latency.quantile(0.95), self.latency.count, self.trained)

    def _filter(
        self, desired: DesiredCommand, state: State, memory: FilterState, now: float, held: bool
    ) -> tuple[Command | None, FilterDecision, FilterState]:
        """Pass the desired command through the filter."""
        if desired.command is None:
            quiet = FilterDecision(level=memory.level, reason=memory.reason)
            # Damping is always allowed; the next target is limited to near the measured position.
            return None, quiet, replace(memory, last=None)
        needed = self.machine_state.mode is Mode.POLICY
        sent, decision, memory = filtered(
            state,
            desired.command,
            memory,
            self.limits,
            now,
            held=held or not needed,
            earlier=self._met[:-1],
        )
        if FilterAction.PASS < decision.level < FilterAction.DAMP:
            name = decision.reason.name.lower()
            self.interventions[name] = self.interventions.get(name, 0) + 1
        return sent, decision, memory

    def _act(self, machine: Machine, desired: DesiredCommand, sent: Command | None) -> str:
        """Write to the machine; returns the link's error, or ""."""
        if desired.silent:
            return ""
        try:
            if sent is None:
                machine.damp()
            else:
                machine.send(replace(sent, made=sent.made - self._offset))
        except PronkError as error:
            return str(error)
        return ""

    def _fault(self, memory: FilterState, text: str) -> None:
        self.faults.append(text)
        self._report("fault", text, reason=memory.reason, level=memory.level)

    def _close(self, machine: Machine) -> None:
        """Leave the joints damped, whatever happened before."""
        self._end_sweep()
        quiet = self.machine_state.mode in (Mode.IDLE, Mode.PREFLIGHT)
        try:
            if not quiet and self.machine_state.mode not in (Mode.DAMP, Mode.FAULT):
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
                self.machine_state.enter(Mode.ENDED, time.monotonic())
                self._report_mode()
                if self._pace is not None:
                    self._publish(self._state, time.monotonic(), self._pace)

    def _keep(self, machine: Machine) -> None:
        """Save the trajectory of the virtual robot; an error is reported, not raised."""
        inner = getattr(machine, "inner", None)
        if self.plan.capture is None or inner is None:
            return
        from pronk.virtual.capture import save

        try:
            save(self.plan.capture, inner.capture())
        except (OSError, PronkError) as error:
            self._report("lost", f"the trajectory was not written: {error}")


def _same(one: State, other: State) -> bool:
    """Whether two states are equal to the last bit, which states of live sensors never are."""
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("gyro", "accelerometer", "position", "velocity")
    )
