"""The servo: the process that owns the machine, and the only writer to it while it runs.

At 500 Hz, on absolute deadlines: collect states, take the desired command from the state machine,
pass it through the safety filter, send. It runs no network. While it ticks it writes no file: what
it measured and sent goes into a queue that never makes it wait. After the last tick it writes the
trajectory of a virtual robot, if the plan asks for one.

If a request, an error, SIGTERM or the end of the operator's program ends it, it damps the joints
first. SIGKILL, or a stop of the whole process, leaves it no time for that: then the standby process
(`pronk.deploy.runtime.standby`) writes to the robot over a transport of its own, and damps.
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
from pronk.deploy.runtime.memory import Shared
from pronk.deploy.runtime.modes import Mode, OperatorRequest, deciding_request
from pronk.deploy.runtime.plan import SERVO_PRIORITY, RunPlan, TrajectoryMachine
from pronk.deploy.runtime.preflight import delay_objection, refusals
from pronk.deploy.runtime.process_body import run_to_end
from pronk.deploy.runtime.reasons import Decision, FilterAction, Reason
from pronk.deploy.runtime.records import (
    REAL,
    TICK,
    VIRTUAL,
    Record,
    event_record,
    put_state,
    state_dtype,
)
from pronk.deploy.runtime.safety import LEAST_DAMPING_S, SafetyFilter
from pronk.deploy.runtime.state_machine import PREFLIGHT_S, DesiredCommand, StateMachine
from pronk.deploy.runtime.sweep import SweepController
from pronk.errors import HardwareError, PronkError
from pronk.processes import die_with_parent
from pronk.robots.machine import Command, Machine, State

_SWITCH_S = 0.5e-3
"""Longest time that a thread of the link keeps the loop waiting [s]."""
_START_S = 0.01
"""Time from the first state to the first tick [s]."""
_DECIDING = (Mode.STAND, Mode.POLICY, Mode.HALT)
"""Modes in which the policy's latency is measured; while standing its actions are not used."""


def serve_robot(
    plan: RunPlan, name: str, trained_delay_s: tuple[float, float], end: Connection
) -> None:
    """Run the servo's process.

    Args:
        plan: Plan of the run.
        name: Name of the shared memory.
        trained_delay_s: Command delays that the policy was trained for [s].
        end: Pipe to the operator's process.
    """
    leave()  # the operator's process decides
    die_with_parent(signal.SIGTERM)  # damp and end
    shared = Shared(name, len(plan.robot.joints))
    run_to_end(Servo(plan, shared, trained_delay_s), shared, end)


class Servo:
    """The loop and its figures.

    A tick (`_tick`) has this order; `decision_time` is read anew after step 4, because an action
    may be younger than the begin of a tick that was interrupted:

    1. Wait for the deadline and collect the states of the link. The tick begins: `tick_begun`.
    2. Note the states that are new. In PREFLIGHT, check them and perhaps leave that mode.
    3. Read the operator's mailbox, for dead-man button and silence, and the operator's requests.
       Without any state so far, publish and end the tick.
    4. Read the policy's mailbox.
    5. Add the faults that are known before a command exists: the standby process damps, the link
       failed in step 1, the operator's program has ended.
    6. Let the state machine grant the request, which may change the mode, and give the desired
       command of the mode, which may change it again (HALT to SIT, SIT to DAMP) or add a fault
       (swapped encoders, no first action).
    7. Publish the state and the mode for the other processes.
    8. Judge the desired command by the safety filter; damp where there is none.
    9. Send the command, or damping; nothing in a mode of `SILENT`. It is on the wire: `sent_at`.
    10. Add the fault of the link, if it failed in step 1 or 9 and the standby process is silent.
    11. If any fault lasts, enter FAULT, and report a fault that is worse than before the tick.
    12. Count, measure the latency and log.
    """

    def __init__(self, plan: RunPlan, shared: Shared, trained_delay_s: tuple[float, float]) -> None:
        """Read the plan; nothing is opened yet."""
        self.plan = plan
        self.shared = shared
        self.trained_delay_s = trained_delay_s
        self.modes = StateMachine(
            plan.robot,
            plan.timing,
            sweeps=plan.sweep is not None,
            policy_gains=plan.policy_gains(),
        )
        self.safety = SafetyFilter(limits=plan.limits())
        self.action: Record | None = None
        """Newest action of the policy, a record of `ACTIONS`."""
        self.machine: Machine | None = None
        """The machine, once connected."""
        self.pace = Pace(plan.servo_rate_hz)
        self.lateness = Histogram()
        """Lateness of ticks [s]."""
        self.latency = Histogram()
        """Times from a state to the command computed from it [s]."""
        self.age = Histogram()
        """Ages of the newest state at a tick [s]."""
        self.interventions: Counter[str] = Counter()
        """Ticks in which a target was held or moved, by reason."""
        self.faults: list[str] = []
        """Faults, one line each."""
        self.refusals: tuple[str, ...] = ()
        """Refusals of the pre-flight checks."""
        self.states = 0
        """States received."""
        self.lost = 0
        """States missing by their numbers."""
        self.repeated = 0
        """States equal to the one before to the last bit."""
        self._state_record = np.zeros((), dtype=state_dtype(len(plan.robot.joints)))
        self._tick_record = np.zeros((), dtype=TICK)
        self._offset = 0.0
        """CLOCK_MONOTONIC less the machine's clock [s]."""
        self._state: State | None = None
        """Newest state."""
        self._new_states: list[State] = []
        """States since the last tick."""
        self._preflight_states: list[State] = []
        self._stopping = False
        self._alone = False
        """Whether the operator's program has ended."""
        self._parent = os.getppid()
        self._sweep: SweepController | None = None
        self._finished = False
        """Whether the sweep came to its end."""
        self._clamped = threading.Event()

    def stop(self) -> None:
        """Damp and end, soon."""
        self._stopping = True

    def run(self) -> None:
        """Open the machine, tick until stopped, damp, close."""
        try:
            machine = self.plan.link(self._clamp)
            if self.plan.trajectory is not None:
                self._keep_trajectory(machine)
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
        """Return the figures of the run since it started."""
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
            # Without a log no process empties its queues: they fill up, and what they drop was not
            # asked for. A sweep has no `plan.log` either; a dropped sample ends it.
            "dropped": {} if self.plan.log is None else self.shared.dropped(),
        }

    # --- the other processes ----------------------------------------------------------------------

    def _operator(self, now: float) -> tuple[bool, bool]:
        """Read the operator's mailbox and take the new requests.

        Returns:
            Whether the dead-man button is held, and whether the operator's program is gone: its
            heartbeat has been missing for `RunPlan.operator_timeout_s`, or for ten times that since
            the last change of mode if there never was one. The heartbeat of a program that hangs
            goes on for `run._STALL_S`.
        """
        requests = []
        for request_record in self.shared.requests.take():
            request = OperatorRequest(int(request_record["request"]))
            if request is OperatorRequest.CLAMPED:
                self._clamped.set()
            else:
                requests.append(request)
        if requests:
            self.modes.request(deciding_request(requests))
        record = self.shared.operator.read()
        timeout = self.plan.operator_timeout_s
        if record is None:
            return False, now - self.modes.since > 10.0 * timeout
        gone = now - float(record["time"]) > timeout
        return bool(record["held"]) and not gone, gone

    def _report(self, event_kind: str, text: str, *, reason: int = 0, level: int = 0) -> None:
        """Send an event to logger and operator."""
        record = event_record(time.monotonic(), event_kind, text, reason=reason, level=level)
        self.shared.events.put(record)
        self.shared.events_seen.put(record)

    def _publish(self, now: float) -> None:
        """Write the newest state and the mode for the other processes; zeros without a state."""
        record = self._state_record
        if self._state is not None:
            put_state(record, self._state)
            if self._state.remote:
                record["remote"] = np.frombuffer(self._state.remote, np.uint8)
        record["now"] = now
        record["start"] = self.pace.start
        record["progress"] = 0.0 if self._sweep is None else self._sweep.progress
        record["mode"] = self.modes.mode
        record["mode_count"] = self.modes.mode_count
        self.shared.state.write(record)

    # --- the loop ---------------------------------------------------------------------------------

    def _open(self, machine: Machine) -> None:
        """Connect the machine and begin the pre-flight checks."""
        # Before the link starts threads: they inherit the priority, and so never hold the
        # interpreter's lock while something less urgent runs.
        for line in enter(self.plan.real_time_settings(SERVO_PRIORITY, 0)):
            self._report("system", line)
        sys.setswitchinterval(_SWITCH_S)
        machine.connect()
        self.machine = machine
        self.safety = SafetyFilter(
            limits=self.plan.limits(machine.torque_kind), state_rate_hz=machine.state_rate_hz
        )
        self._report("robot", VIRTUAL if machine.virtual else REAL)
        # The states' clock may be another; everything here is on CLOCK_MONOTONIC.
        self._offset = time.monotonic() - machine.now()
        machine.wait(machine.now())
        self.pace = Pace(self.plan.servo_rate_hz, time.monotonic() + _START_S)
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
        """Wait for the tick's deadline; then take states, decide and send (order: `Servo`)."""
        deadline = self.pace.deadline
        link_error = ""
        try:
            states = machine.wait(deadline - self._offset)
        except PronkError as error:
            states = []
            link_error = str(error)
            sleep_until(deadline)
        tick_begun = time.monotonic()
        self.lateness.add(tick_begun - deadline)
        self._take(states)
        if self.modes.mode is Mode.PREFLIGHT:
            self._preflight(machine, tick_begun)
        if self._state is not None:
            self._decide(machine, self._state, tick_begun, link_error)
        else:
            # Without a state nothing is decided, but requests are read.
            self._operator(tick_begun)
            self._publish(tick_begun)
        self.pace.advance(time.monotonic())

    def _take(self, states: list[State]) -> None:
        """Note the new states of a tick, on CLOCK_MONOTONIC."""
        self._new_states = []
        for machine_state in states:
            state = replace(machine_state, time=machine_state.time + self._offset)
            before = self._state
            if before is not None:
                if _same_measurement(state, before):
                    # Repeated data with new stamps: the last real state must grow old.
                    self.repeated += 1
                    continue
                self.lost += max(0, state.sequence - before.sequence - 1)
            self._state = state
            self.states += 1
            self._new_states.append(state)

    def _preflight(self, machine: Machine, now: float) -> None:
        """Collect states; once there are enough, check them and leave the pre-flight checks."""
        self._preflight_states += self._new_states
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
                self.safety.limits,
                self.shared.samples.put,
                state=self._state,
                start=now,
                real_time=True,
            )
        self.modes.preflighted(self.refusals, now)
        self._report("mode", self.modes.mode.name)

    def _decide(self, machine: Machine, state: State, tick_begun: float, link_error: str) -> None:
        """Decide from the newest state what is written to the machine, and write it.

        These are the steps 3 to 12 of a tick, in the order that `Servo` gives.

        Args:
            machine: The machine.
            state: Newest state.
            tick_begun: Time at which the tick began [s].
            link_error: Error of the link while it waited for states; empty if there was none.
        """
        self.age.add(max(0.0, tick_begun - state.time))
        mode_before = self.modes.mode
        level_before = self.safety.level
        dead_man_held, operator_is_gone = self._operator(tick_begun)
        action_is_new = self._read_action()
        # An action may be younger than the begin of a tick that was interrupted.
        decision_time = time.monotonic()

        standby_damps = self.shared.standby.written > 0
        if standby_damps:
            # Its commands are another program's to the link.
            self.safety.fault(Reason.STANDBY, tick_begun)
        elif link_error:
            self.safety.fault(Reason.LINK, tick_begun)
        if operator_is_gone and mode_before not in (Mode.IDLE, Mode.PREFLIGHT):
            self.safety.fault(Reason.ENDED, tick_begun)
        objection = ""
        if mode_before is Mode.STAND and not self.plan.ignore_latency:
            objection = delay_objection(
                self.latency.quantile(0.95), self.latency.count, self.trained_delay_s
            )

        self.modes.grant(decision_time, state.position, self.safety, objection)
        limits = self.safety.limits
        if self._sweep is not None and self.modes.mode is Mode.SWEEP:
            desired = self.modes.follow_sweep(
                decision_time, self._sweep_command(self._sweep, decision_time)
            )
            limits = self._sweep.limits
        else:
            desired = self.modes.desired(decision_time, state.position, self.safety, self.action)
        if self.modes.notice:
            self._report("notice", self.modes.notice)
        self._publish(tick_begun)

        sent: Command | None = None
        if desired.command is None:
            decision = self.safety.damped()
        else:
            sent, decision = self.safety.judge(
                self._new_states or [state],
                desired.command,
                decision_time,
                dead_man=dead_man_held or self.modes.mode is not Mode.POLICY,
                limits=limits,
            )
        send_error = self._send(machine, sent)
        sent_at = time.monotonic()

        fault_text = decision.text if decision.detail else ""
        if standby_damps:
            pass  # errors of the link are those of two writers
        elif send_error or link_error:
            self.safety.fault(Reason.LINK, sent_at)
            fault_text = send_error or link_error
        self._act_on_faults(level_before, tick_begun, fault_text)
        if self._sweep is not None and mode_before is Mode.SWEEP:
            if sent is not None:
                self._sweep.sent(decision_time, sent.position)
            if self.modes.mode is not Mode.SWEEP:
                self._end_sweep()
        if self.modes.mode is not mode_before:
            self._report("mode", self.modes.mode.name)
        if FilterAction.PASS < decision.level < FilterAction.DAMP:
            self.interventions[decision.reason.name.lower()] += 1
        latency = np.nan
        if action_is_new and self.action is not None and self.modes.mode in _DECIDING:
            latency = sent_at - float(self.action["state_time"])
            self.latency.add(max(0.0, latency))
        if self.plan.sweep is None:  # the log of a sweep is of its samples
            self._tick_record["begun"] = tick_begun
            self._tick_record["done"] = sent_at
            self._tick_record["latency"] = latency
            self._log_tick(state, desired, sent, decision)

    def _read_action(self) -> bool:
        """Read the policy's mailbox; whether the action is a new one."""
        action = self.shared.actions.read()
        if action is None:
            return False
        if self.action is not None and action["sequence"] == self.action["sequence"]:
            return False
        self.action = action
        return True

    def _act_on_faults(self, level_before: FilterAction, tick_begun: float, text: str) -> None:
        """Enter FAULT while a fault lasts; report one that is worse than before the tick.

        Args:
            level_before: Level of the fault before the tick.
            tick_begun: Time at which the tick began [s].
            text: Text of a new fault with its numbers; empty for that of its reason.
        """
        safety = self.safety
        if safety.faulted:
            if safety.level > level_before:
                self.faults.append(text or safety.reason.text)
                self._report("fault", self.faults[-1], reason=safety.reason, level=safety.level)
            self.modes.faulted(tick_begun)

    def _send(self, machine: Machine, sent: Command | None) -> str:
        """Write to the machine; return the link's error, or ""."""
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
    ) -> None:
        """Put a tick, of which the times are set, into the logger's queue."""
        tick = self._tick_record
        put_state(tick, state)
        tick["tick"] = self.pace.tick
        tick["deadline"] = self.pace.deadline
        tick["mode"] = self.modes.mode
        tick["level"] = decision.level
        tick["reason"] = decision.reason
        tick["damped"] = sent is None and not self.modes.silent
        tick["action"] = -1 if self.action is None else self.action["sequence"]
        tick["action_state"] = -1 if self.action is None else self.action["state_sequence"]
        tick["blend"] = desired.blend
        tick["stiffness"] = 0.0 if sent is None else desired.stiffness
        tick["desired"] = np.nan if desired.command is None else desired.command.position
        tick["sent"] = np.nan if sent is None else sent.position
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
            self._save_trajectory(machine)
        finally:
            machine.close()
            self.modes.enter(Mode.ENDED, time.monotonic())
            self._report("mode", self.modes.mode.name)
            self._publish(time.monotonic())

    def _keep_trajectory(self, machine: Machine) -> None:
        """Have a machine keep its trajectory; HardwareError if it cannot."""
        if not isinstance(machine, TrajectoryMachine):
            raise HardwareError(
                f"the trajectory of {machine.robot} cannot be recorded over this link; only the "
                "virtual robot in this program (--link sim) keeps one."
            )
        machine.keep_trajectory()

    def _save_trajectory(self, machine: Machine) -> None:
        """Save the machine's trajectory; an error is reported, not raised."""
        path = self.plan.trajectory
        if path is None or not isinstance(machine, TrajectoryMachine):
            return
        try:
            machine.save_trajectory(path)
        except (OSError, PronkError) as error:
            self._report("lost", f"the trajectory was not written: {error}")

    # --- a sweep ----------------------------------------------------------------------------------

    def _sweep_command(self, sweep: SweepController, t: float) -> Command | None:
        """Return the sweep's command at a tick; None once it is over."""
        if self.shared.samples.dropped:
            raise HardwareError(
                "the process that writes the log fell behind; the joints were damped; see that "
                "the disk is not busy."
            )
        logs = len(sweep.complete)
        try:
            command = sweep.command(t, self._new_states, slack=0.5 / self.plan.servo_rate_hz)
        finally:
            for path in sweep.complete[logs:]:
                self._report("log", path.name)
        self._finished = command is None
        return command

    def _end_sweep(self) -> None:
        """End a log that is still open, with the reason."""
        if self._sweep is None:
            return
        if self.faults:
            self._sweep.end(self.faults[-1])
        elif self._alone:
            self._sweep.end("the program that started the sweep ended")
        else:
            self._sweep.end("interrupted")

    def _clamp(self, joints: tuple[str, ...]) -> None:
        """Have the operator clamp joints and wait; runs in a thread of its own."""
        self._clamped.clear()
        self._report("clamp", ", ".join(joints))
        self._clamped.wait()


def _same_measurement(state: State, other: State) -> bool:
    """Whether two states are equal to the last bit, which states of live sensors never are."""
    return (
        np.array_equal(state.gyro, other.gyro)
        and np.array_equal(state.accelerometer, other.accelerometer)
        and np.array_equal(state.position, other.position)
        and np.array_equal(state.velocity, other.velocity)
    )
