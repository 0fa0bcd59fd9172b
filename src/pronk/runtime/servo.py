"""The servo: the one process that owns the machine and the only writer to it.

At 500 Hz, on absolute deadlines: collect states, take the desired command from the state machine,
pass it through the safety filter, send. It runs no network and writes no files; what it measured
and sent goes into a queue that never makes it wait. Whatever ends it, the joints are damped first.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import Counter
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from pronk.errors import HardwareError, PronkError
from pronk.links.machine import Command, Machine, State
from pronk.links.realtime import Histogram, Pace, enter, leave, sleep_until
from pronk.runtime import ipc
from pronk.runtime.ipc import Mode, OperatorRequest, PolicyAction, Shared
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


def serve_robot(plan: Plan, name: str, trained: tuple[float, float], end: Connection) -> None:
    """Body of the servo's process.

    `trained` are the command delays that the policy was trained for [s].
    """
    leave()  # the operator's process decides
    shared = Shared(name)
    ipc.serve(Servo(plan, shared, trained), shared, end)


class Servo:
    """The loop and its figures."""

    def __init__(self, plan: Plan, shared: Shared, trained: tuple[float, float]) -> None:
        """Read the plan; nothing is opened yet."""
        self.plan = plan
        self.shared = shared
        self.trained = trained
        self.limits = plan.safety()
        self.machine_state = StateMachine(plan.robot, plan.timing)
        self.memory = FilterState()
        self.action: PolicyAction | None = None
        """The policy's newest."""
        self.machine: Machine | None = None
        """Once connected."""
        self.pace = Pace(plan.servo_rate_hz)
        self.lateness = Histogram()
        self.latency = Histogram()
        """From a state to the command computed from it."""
        self.age = Histogram()
        """Of the newest state at each tick."""
        self.interventions: Counter[str] = Counter()
        self.faults: list[str] = []
        self.states = self.lost = self.repeated = 0
        """States received; missing by their numbers; equal to the one before to the last bit."""
        self._state_record = np.zeros((), dtype=ipc.STATE)
        self._tick_record = np.zeros((), dtype=ipc.TICK)
        self._offset = 0.0
        self._requests = 0
        self._state: State | None = None
        self._met: list[State] = []
        self._seen: list[State] = []
        self._stopping = self._alone = False
        self._parent = os.getppid()
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
            machine = self.plan.link(self._clamp)
            self._open(machine)
            while not self._over():
                self._one(machine)
        except PronkError as error:
            self.faults.append(str(error))
            self._report("refused", str(error), level=FilterAction.LATCH)
        finally:
            if self.machine is not None:
                self._close(self.machine)

    def figures(self) -> dict[str, Any]:
        """Of the run so far."""
        return {
            "virtual": None if self.machine is None else self.machine.virtual,
            "ticks": self.lateness.count,
            "missed_ticks": self.pace.missed,
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
            # Without a log no process empties the queues to it, and nothing is lost.
            "dropped": {} if self.plan.log is None else self.shared.dropped(),
        }

    # --- the other processes ----------------------------------------------------------------------

    def _operator(self, now: float) -> tuple[bool, bool]:
        """Read the operator's mailbox: dead-man button held, operator's program gone."""
        record = self.shared.operator.read()
        timeout = self.plan.operator_timeout_s
        if record is None:
            return False, now - self.machine_state.since > 10.0 * timeout
        if record["requests"] != self._requests:
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
        if record is None or (self.action and record["sequence"] == self.action.sequence):
            return False
        values = {name: record[name].tolist() for name in record.dtype.names or ()}
        self.action = PolicyAction(**values | {"position": record["position"]})
        return True

    def _report(self, kind: str, text: str, *, reason: int = 0, level: int = 0) -> None:
        """Send an event to logger and operator."""
        record = ipc.event(time.monotonic(), kind, text, reason=reason, level=level)
        self.shared.events.put(record)
        self.shared.events_seen.put(record)

    def _report_mode(self) -> None:
        self._report("mode", self.machine_state.mode.name)

    def _publish(self, state: State | None, now: float) -> None:
        """Write the newest state and the mode for the other processes; zeros without a state."""
        record = self._state_record
        if state is not None:
            ipc.put_state(record, state)
        ipc.fill(record, now=now, start=self.pace.start, progress=self._progress)
        ipc.fill(record, mode=self.machine_state.mode, entry=self.machine_state.entry)
        self.shared.state.write(record)

    # --- the loop ---------------------------------------------------------------------------------

    def _open(self, machine: Machine) -> None:
        # Before the link starts threads: they inherit the priority, and so never hold the
        # interpreter's lock while something less urgent runs.
        for line in enter(self.plan.wanted(SERVO_PRIORITY, 0)):
            self._report("system", line)
        sys.setswitchinterval(_SWITCH_S)
        machine.connect()
        self.machine = machine
        self._report("robot", ipc.VIRTUAL if machine.virtual else ipc.REAL)
        # The states' clock may be another; everything here is on CLOCK_MONOTONIC.
        self._offset = time.monotonic() - machine.now()
        machine.wait(machine.now())
        self.pace = Pace(self.plan.servo_rate_hz, time.monotonic() + 0.01)
        self.machine_state.enter(Mode.PREFLIGHT, self.pace.start)

    def _over(self) -> bool:
        """Whether the loop may end: quit, and damped long enough."""
        mode, since = self.machine_state.mode, self.machine_state.since
        if not self._alone and os.getppid() != self._parent:
            self._alone = True
            self._report("notice", "the operator's program has ended")
        if self._stopping or self._alone:
            self.machine_state.request(OperatorRequest.QUIT)
        if not self.machine_state.quitting():
            return False
        damped = mode in (Mode.DAMP, Mode.FAULT) and time.monotonic() - since >= LEAST_DAMPING_S
        return damped or mode in (Mode.IDLE, Mode.PREFLIGHT)

    def _one(self, machine: Machine) -> None:
        """One tick."""
        deadline, link_error = self.pace.deadline, ""
        try:
            met = machine.wait(deadline - self._offset)
        except PronkError as error:
            met, link_error = [], str(error)
            sleep_until(deadline)
        begun = time.monotonic()
        self.lateness.add(begun - deadline)
        self._take(met)
        if self.machine_state.mode is Mode.PREFLIGHT:
            self._preflight(machine, begun)
        if self._state is not None:
            self._decide(machine, self._state, begun, link_error)
        else:
            # Without a state nothing is decided, but requests are read.
            self._operator(begun)
            self._publish(None, begun)
        self.pace.advance(time.monotonic())

    def _take(self, met: list[State]) -> None:
        """Note the new states of a tick."""
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
            self._sweep.take(self._met)
        if self.machine_state.mode is Mode.PREFLIGHT:
            self._seen += self._met

    def _preflight(self, machine: Machine, now: float) -> None:
        seconds = now - self.machine_state.since
        if seconds < PREFLIGHT_S:
            return
        found = refusals(self._seen, self.plan.robot, self.limits, now=now, seconds=seconds)
        self._seen.clear()
        for sentence in found:
            self._report("refused", sentence)
        if self.plan.sweep is not None and found:
            self.machine_state.request(OperatorRequest.QUIT)
        elif self.plan.sweep is not None and self._state is not None:
            self._begin_sweep(self.plan.sweep, machine, self._state)
        self.machine_state.preflighted(found, now)
        self._report_mode()

    def _decide(self, machine: Machine, state: State, begun: float, link_error: str) -> None:
        """From a state to what is written to the machine."""
        self.age.add(max(0.0, begun - state.time))
        mode, memory = self.machine_state.mode, self.memory
        held, gone = self._operator(begun)
        fresh = self._new_action()
        if link_error:
            memory = fault(memory, FilterAction.LATCH, Reason.LINK, begun)
        if gone and mode not in (Mode.IDLE, Mode.PREFLIGHT):
            memory = fault(memory, FilterAction.DAMP, Reason.ENDED, begun)
        desired, memory = self.machine_state.step(
            begun, state, memory, self.action, objection=self._objection()
        )
        if self.machine_state.notice:
            self._report("notice", self.machine_state.notice)
        self._publish(state, begun)
        sent, decision, memory = self._filter(desired, state, memory, begun, held)
        why = link_error
        if error := self._send(machine, desired, sent):
            memory, why = fault(memory, FilterAction.LATCH, Reason.LINK, time.monotonic()), error
        done = time.monotonic()
        if memory.level > self.memory.level and memory.faulted:
            why = why or (decision.text if decision.detail else memory.reason.text)
            self.faults.append(why)
            self._report("fault", why, reason=memory.reason, level=memory.level)
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
        latency = np.nan
        if fresh and self.action is not None and self.machine_state.mode in _DECIDING:
            latency = done - self.action.state_time
            self.latency.add(max(0.0, latency))
        if self.plan.sweep is None:  # the log of a sweep is of its samples
            self._log_tick(state, begun, done, desired, sent, decision, latency)

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
        held = held or self.machine_state.mode is not Mode.POLICY
        earlier = self._met[:-1]
        sent, decision, memory = filtered(
            state, desired.command, memory, self.limits, now, held=held, earlier=earlier
        )
        if FilterAction.PASS < decision.level < FilterAction.DAMP:
            self.interventions[decision.reason.name.lower()] += 1
        return sent, decision, memory

    def _send(self, machine: Machine, desired: DesiredCommand, sent: Command | None) -> str:
        """Write to the machine; returns the link's error, or ""."""
        try:
            if sent is not None:
                machine.send(replace(sent, made=sent.made - self._offset))
            elif not desired.silent:
                machine.damp()
        except PronkError as error:
            return str(error)
        return ""

    def _log_tick(
        self,
        state: State,
        begun: float,
        done: float,
        desired: DesiredCommand,
        sent: Command | None,
        decision: FilterDecision,
        latency: float,
    ) -> None:
        """Put a tick into the logger's queue."""
        tick, action = self._tick_record, self.action
        ipc.put_state(tick, state)
        at = {"tick": self.pace.tick, "deadline": self.pace.deadline, "begun": begun, "done": done}
        ipc.fill(tick, **at, mode=self.machine_state.mode, blend=desired.blend, latency=latency)
        ipc.fill(tick, level=decision.level, reason=decision.reason)
        tick["desired"] = np.nan if desired.command is None else desired.command.position
        tick["sent"] = np.nan if sent is None else sent.position
        tick["stiffness"] = 0.0 if sent is None else desired.stiffness
        tick["damped"] = sent is None and not desired.silent
        tick["action"] = -1 if action is None else action.sequence
        tick["action_state"] = -1 if action is None else action.state_sequence
        self.shared.ticks.put(tick)

    def _close(self, machine: Machine) -> None:
        """Leave the joints damped, whatever happened before."""
        self._end_sweep()
        mode = self.machine_state.mode
        try:
            if mode not in (Mode.IDLE, Mode.PREFLIGHT, Mode.DAMP, Mode.FAULT):
                # An error of pronk itself: damp for as long as a fault would.
                until = time.monotonic() + LEAST_DAMPING_S
                while time.monotonic() < until:
                    machine.damp()
                    machine.wait(machine.now() + 1.0 / self.plan.servo_rate_hz)
            self._save_capture(machine)
        finally:
            machine.close()
            self.machine_state.enter(Mode.ENDED, time.monotonic())
            self._report_mode()
            self._publish(self._state, time.monotonic())

    def _save_capture(self, machine: Machine) -> None:
        """Save the trajectory of the virtual robot; an error is reported, not raised."""
        inner = getattr(machine, "inner", None)
        if self.plan.capture is None or inner is None:
            return
        from pronk.virtual.capture import save

        try:
            save(self.plan.capture, inner.capture())
        except (OSError, PronkError) as error:
            self._report("lost", f"the trajectory was not written: {error}")

    # --- a sweep ----------------------------------------------------------------------------------

    def _begin_sweep(self, task: SweepTask, machine: Machine, state: State) -> None:
        self._sweep = SweepController(
            task,
            machine,
            self.shared.samples.put,
            state=state,
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
        """End a log that is still open, with the reason."""
        if self._sweep is not None:
            parent = "the program that started the sweep ended" if self._alone else "interrupted"
            self._sweep.end(self.faults[-1] if self.faults else parent)

    def _clamp(self, joints: tuple[str, ...]) -> None:
        """Have the operator clamp joints and wait; runs in a thread of its own."""
        self._clamped.clear()
        self._report("clamp", ", ".join(joints))
        self._clamped.wait()


def _same(one: State, other: State) -> bool:
    """Whether two states are equal to the last bit, which states of live sensors never are."""
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("gyro", "accelerometer", "position", "velocity")
    )
