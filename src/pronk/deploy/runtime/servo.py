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
from collections import Counter
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from pronk.deploy.links.realtime import Histogram, Pace, enter, leave, sleep_until
from pronk.deploy.runtime import ipc
from pronk.deploy.runtime.ipc import Shared
from pronk.deploy.runtime.modes import Mode, OperatorRequest
from pronk.deploy.runtime.plan import SERVO_PRIORITY, Plan
from pronk.deploy.runtime.preflight import delay_objection, refusals
from pronk.deploy.runtime.safety import (
    LEAST_DAMPING_S,
    Decision,
    FilterAction,
    Reason,
    SafetyFilter,
)
from pronk.deploy.runtime.state_machine import PREFLIGHT_S, DesiredCommand, StateMachine
from pronk.deploy.runtime.sweep import SweepController
from pronk.errors import HardwareError, PronkError
from pronk.processes import die_with_parent
from pronk.robots.machine import Command, Machine, State

_SWITCH_S = 0.5e-3
"""Longest that a thread of the link keeps the loop waiting [s]."""
_DECIDING = (Mode.STAND, Mode.POLICY, Mode.HALT)
"""Modes in which the policy's latency is measured; while standing its actions are not used."""


def serve_robot(plan: Plan, name: str, trained: tuple[float, float], end: Connection) -> None:
    """Body of the servo's process.

    `trained` are the command delays that the policy was trained for [s].
    """
    leave()  # the operator's process decides
    die_with_parent(signal.SIGTERM)  # damp and end
    shared = Shared(name, len(plan.robot.joints))
    ipc.serve(Servo(plan, shared, trained), shared, end)


class Servo:
    """The loop and its figures."""

    def __init__(self, plan: Plan, shared: Shared, trained: tuple[float, float]) -> None:
        """Read the plan; nothing is opened yet."""
        self.plan, self.shared, self.trained = plan, shared, trained
        self.modes = StateMachine(plan.robot, plan.timing)
        self.safety = SafetyFilter(limits=plan.safety())
        self.action: ipc.Record | None = None
        """The policy's newest, a record of `ACTIONS`."""
        self.machine: Machine | None = None
        """Once connected."""
        self.pace = Pace(plan.servo_rate_hz)
        self.lateness, self.latency, self.age = Histogram(), Histogram(), Histogram()
        """Of ticks; from a state to the command computed from it; of the newest state at a tick."""
        self.interventions: Counter[str] = Counter()
        self.faults: list[str] = []
        self.refusals: tuple[str, ...] = ()
        """Of the pre-flight checks."""
        self.states = self.lost = self.repeated = 0
        """States received; missing by their numbers; equal to the one before to the last bit."""
        self._state_record = np.zeros((), dtype=ipc.state_dtype(len(plan.robot.joints)))
        self._tick_record = np.zeros((), dtype=ipc.TICK)
        self._offset = 0.0
        self._requests = 0
        self._state: State | None = None
        self._met: list[State] = []
        """States since the last tick."""
        self._preflight_states: list[State] = []
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
            if self.plan.recorder is not None:
                self.plan.recorder.prepare(machine)
            self._open(machine)
            while not self._over():
                self._tick(machine)
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
            "refusals": list(self.refusals),
            # Without a log no process empties the queues to it, and nothing is lost.
            "dropped": {} if self.plan.log is None else self.shared.dropped(),
        }

    # --- the other processes ----------------------------------------------------------------------

    def _operator(self, now: float) -> tuple[bool, bool]:
        """Read the operator's mailbox: dead-man button held, operator's program gone."""
        record = self.shared.operator.read()
        timeout = self.plan.operator_timeout_s
        if record is None:
            return False, now - self.modes.since > 10.0 * timeout
        if record["requests"] != self._requests:
            self._requests = int(record["requests"])
            request = OperatorRequest(int(record["request"]))
            if request is OperatorRequest.CLAMPED:
                self._clamped.set()
            else:
                self.modes.request(request)
        gone = now - float(record["time"]) > timeout
        return bool(record["held"]) and not gone, gone

    def _report(self, kind: str, text: str, *, reason: int = 0, level: int = 0) -> None:
        """Send an event to logger and operator."""
        record = ipc.event(time.monotonic(), kind, text, reason=reason, level=level)
        self.shared.events.put(record)
        self.shared.events_seen.put(record)

    def _publish(self, now: float) -> None:
        """Write the newest state and the mode for the other processes; zeros without a state."""
        record = self._state_record
        if self._state is not None:
            ipc.put_state(record, self._state)
        ipc.fill(record, now=now, start=self.pace.start, progress=self._progress)
        ipc.fill(record, mode=self.modes.mode, entry=self.modes.entry)
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
        self.safety = SafetyFilter(
            limits=self.plan.safety(machine.torque_kind), state_rate_hz=machine.state_rate_hz
        )
        self._report("robot", ipc.VIRTUAL if machine.virtual else ipc.REAL)
        # The states' clock may be another; everything here is on CLOCK_MONOTONIC.
        self._offset = time.monotonic() - machine.now()
        machine.wait(machine.now())
        self.pace = Pace(self.plan.servo_rate_hz, time.monotonic() + 0.01)
        self.modes.enter(Mode.PREFLIGHT, self.pace.start)

    def _over(self) -> bool:
        """Whether the loop may end: quit, and damped long enough."""
        if not self._alone and os.getppid() != self._parent:
            self._alone = True
            self._report("notice", "the operator's program has ended")
        if self._stopping or self._alone:
            self.modes.request(OperatorRequest.QUIT)
        damped = self.modes.mode in (Mode.DAMP, Mode.FAULT)
        long_enough = time.monotonic() - self.modes.since >= LEAST_DAMPING_S
        return self.modes.quitting and (self.modes.silent or (damped and long_enough))

    def _tick(self, machine: Machine) -> None:
        deadline, link_error = self.pace.deadline, ""
        try:
            met = machine.wait(deadline - self._offset)
        except PronkError as error:
            met, link_error = [], str(error)
            sleep_until(deadline)
        begun = time.monotonic()
        self.lateness.add(begun - deadline)
        self._take(met)
        if self.modes.mode is Mode.PREFLIGHT:
            self._preflight(machine, begun)
        if self._state is not None:
            self._decide(machine, self._state, begun, link_error)
        else:
            # Without a state nothing is decided, but requests are read.
            self._operator(begun)
            self._publish(begun)
        self.pace.advance(time.monotonic())

    def _take(self, met: list[State]) -> None:
        """Note the new states of a tick."""
        self._met = []
        for each in met:
            state, before = replace(each, time=each.time + self._offset), self._state
            if before is not None:
                if _same(state, before):
                    # Repeated data with new stamps: the last real state must grow old.
                    self.repeated += 1
                    continue
                self.lost += max(0, state.sequence - before.sequence - 1)
            self._state = state
            self.states += 1
            self._met.append(state)

    def _preflight(self, machine: Machine, now: float) -> None:
        self._preflight_states += self._met
        seconds = now - self.modes.since
        if seconds < PREFLIGHT_S:
            return
        self.refusals = refusals(
            self._preflight_states,
            self.plan.robot,
            self.safety.limits,
            now=now,
            seconds=seconds,
            state_rate_hz=self.safety.state_rate_hz,
        )
        self._preflight_states.clear()
        for sentence in self.refusals:
            self._report("refused", sentence)
        if self.plan.sweep is not None and self.refusals:
            self.modes.request(OperatorRequest.QUIT)
        elif self.plan.sweep is not None and self._state is not None:
            self._sweep = SweepController(
                self.plan.sweep,
                machine,
                self.safety,
                self.shared.samples.put,
                state=self._state,
                start=now,
                real_time=True,
                progress=lambda share: setattr(self, "_progress", share),
                written=lambda name: self._report("log", name),
            )
            self.modes.sweep = self._excite
        self.modes.preflighted(self.refusals, now)
        self._report("mode", self.modes.mode.name)

    def _decide(self, machine: Machine, state: State, begun: float, link_error: str) -> None:
        """From the states of a tick to what is written to the machine."""
        self.age.add(max(0.0, begun - state.time))
        mode, level = self.modes.mode, self.safety.level
        held, gone = self._operator(begun)
        action, before = self.shared.actions.read(), self.action
        fresh = action is not None and (before is None or action["sequence"] != before["sequence"])
        self.action = action if fresh else before
        # An action may be younger than the begin of a tick that was interrupted.
        now = time.monotonic()
        damped = self.shared.standby.written > 0
        if damped:
            # Its commands are another program's to the link.
            self.safety.fault(Reason.STANDBY, begun)
        elif link_error:
            self.safety.fault(Reason.LINK, begun)
        if gone and mode not in (Mode.IDLE, Mode.PREFLIGHT):
            self.safety.fault(Reason.ENDED, begun)
        objection = ""
        if mode is Mode.STAND and not self.plan.ignore_latency:
            measured = self.latency.quantile(0.95), self.latency.count
            objection = delay_objection(*measured, self.trained)
        desired = self.modes.step(now, state.position, self.safety, self.action, objection)
        if self.modes.notice:
            self._report("notice", self.modes.notice)
        self._publish(begun)
        held = held or self.modes.mode is not Mode.POLICY
        if desired.command is None:
            sent, decision = None, self.safety.damped()
        else:
            states = self._met or [state]
            sent, decision = self.safety.judge(states, desired.command, now, held=held)
        why = self._send(machine, sent) or link_error
        done = time.monotonic()
        if damped:
            why = ""
        elif why:
            self.safety.fault(Reason.LINK, done)
        self._act_on_faults(level, begun, why or (decision.detail and decision.text))
        if self._sweep is not None and mode is Mode.SWEEP:
            if sent is not None:
                self._sweep.sent(now, sent.position)
            if self.modes.mode is not Mode.SWEEP:
                self._end_sweep()
        if self.modes.mode is not mode:
            self._report("mode", self.modes.mode.name)
        if FilterAction.PASS < decision.level < FilterAction.DAMP:
            self.interventions[decision.reason.name.lower()] += 1
        latency = np.nan
        if fresh and self.action is not None and self.modes.mode in _DECIDING:
            latency = done - float(self.action["state_time"])
            self.latency.add(max(0.0, latency))
        if self.plan.sweep is None:  # the log of a sweep is of its samples
            times = {"begun": begun, "done": done, "latency": latency}
            self._log_tick(state, desired, sent, decision, times)

    def _act_on_faults(self, level: FilterAction, begun: float, why: str) -> None:
        """Report a fault that is worse than the `level` before the tick, and leave the mode."""
        safety = self.safety
        if safety.faulted:
            if safety.level > level:
                self.faults.append(why or safety.reason.text)
                self._report("fault", self.faults[-1], reason=safety.reason, level=safety.level)
            self.modes.faulted(begun)

    def _send(self, machine: Machine, sent: Command | None) -> str:
        """Write to the machine; returns the link's error, or ""."""
        try:
            if sent is not None:
                machine.send(replace(sent, made=sent.made - self._offset))
            elif not self.modes.silent:
                machine.damp()
        except PronkError as error:
            return str(error)
        return ""

    def _log_tick(
        self,
        state: State,
        desired: DesiredCommand,
        sent: Command | None,
        decision: Decision,
        times: dict[str, float],
    ) -> None:
        """Put a tick into the logger's queue."""
        tick, action, wanted = self._tick_record, self.action, desired.command
        ipc.put_state(tick, state)
        ipc.fill(tick, **times, tick=self.pace.tick, deadline=self.pace.deadline)
        ipc.fill(tick, mode=self.modes.mode, level=decision.level, reason=decision.reason)
        ipc.fill(
            tick,
            damped=sent is None and not self.modes.silent,
            action=-1 if action is None else action["sequence"],
            action_state=-1 if action is None else action["state_sequence"],
            blend=desired.blend,
            stiffness=0.0 if sent is None else desired.stiffness,
            desired=np.nan if wanted is None else wanted.position,
            sent=np.nan if sent is None else sent.position,
        )
        self.shared.ticks.put(tick)

    def _close(self, machine: Machine) -> None:
        """Leave the joints damped, whatever happened before."""
        self._end_sweep()
        try:
            if not self.modes.silent and self.modes.mode not in (Mode.DAMP, Mode.FAULT):
                # An error of pronk itself: damp for as long as a fault would.
                until = time.monotonic() + LEAST_DAMPING_S
                while time.monotonic() < until:
                    machine.damp()
                    machine.wait(machine.now() + 1.0 / self.plan.servo_rate_hz)
            self._save_recording(machine)
        finally:
            machine.close()
            self.modes.enter(Mode.ENDED, time.monotonic())
            self._report("mode", self.modes.mode.name)
            self._publish(time.monotonic())

    def _save_recording(self, machine: Machine) -> None:
        """Save what the plan's recorder kept; an error is reported, not raised."""
        if self.plan.recorder is None:
            return
        try:
            self.plan.recorder.save(machine)
        except (OSError, PronkError) as error:
            self._report("lost", f"the trajectory was not written: {error}")

    # --- a sweep ----------------------------------------------------------------------------------

    def _excite(self, t: float) -> Command | None:
        """The sweep's command at a tick; None once it is over."""
        assert self._sweep is not None
        if self.shared.samples.dropped:
            raise HardwareError(
                "the process that writes the log fell behind; the joints were damped; see that "
                "the disk is not busy."
            )
        command = self._sweep.command(t, self._met, slack=0.5 / self.plan.servo_rate_hz)
        self._finished = command is None
        return command

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
