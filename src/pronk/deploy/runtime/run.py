"""A run of a policy or a sweep: its processes, and the operator's end of them."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, Self

import numpy as np
import orjson

from pronk.deploy.links.address import SIM
from pronk.deploy.links.realtime import Interrupts, sleep_until, terminal_blocked
from pronk.deploy.runtime.log import READY, write_log
from pronk.deploy.runtime.memory import Shared
from pronk.deploy.runtime.modes import Mode, OperatorRequest
from pronk.deploy.runtime.plan import SERVO_PRIORITY, RunPlan
from pronk.deploy.runtime.policy_process import serve_policy
from pronk.deploy.runtime.records import OPERATOR, REQUEST, Event
from pronk.deploy.runtime.servo import serve_robot
from pronk.deploy.runtime.standby import HAS_STANDBY, NO_STANDBY, serve_standby
from pronk.deploy.runtime.teleop import Operator, OperatorCommand
from pronk.errors import HardwareError, LogError, PronkError
from pronk.policy.deployable import UNKNOWN_DELAY_S, DeployablePolicy, open_policy
from pronk.version import VERSION

_RATE_HZ = 50.0
"""Rate of the operator's program [Hz]."""
_BEAT_S = 0.01
"""Time between two heartbeats of the operator's program [s]."""
_STALL_S = 0.7
"""Longest time that the operator's program may be late, on a busy computer or at a slow terminal,
before its heartbeat ends [s]. The servo damps when the heartbeat has been missing for
`RunPlan.operator_timeout_s`, so a program that hangs has the sum of both, by default 1.0 s; one
that was killed or stopped, whose heartbeat ends with it, has `operator_timeout_s` alone."""
_START_S = 30.0
"""Time in which the servo must have opened the link [s]."""
_END_S = 10.0
"""Time in which each process must have ended [s]."""

_QUIT = OperatorCommand(request=OperatorRequest.QUIT)


@dataclass(kw_only=True)
class RunSummary:
    """Figures and events of a run."""

    servo: dict[str, Any] = field(default_factory=dict)
    """Figures of the servo; empty if it was killed."""
    policy: dict[str, Any] = field(default_factory=dict)
    """Figures of the policy's process; empty if it was killed."""
    events_seen: list[Event] = field(default_factory=list)
    """Events of the servo."""
    log_error: str = ""
    """Why the log could not be written to its end."""
    standby: bool = False
    """Whether the standby process damped the joints, because the servo was silent."""
    interrupted: bool = False
    """Whether a signal ended it: the interrupt key, or the end of the terminal."""
    trained_delay_s: tuple[float, float] = (0.0, 0.0)
    """Command delays that the policy was trained for [s]; `UNKNOWN_DELAY_S` if it does not say."""

    @property
    def faults(self) -> list[str]:
        """Faults that damped the robot."""
        return [event.text for event in self.events_seen if event.kind == "fault"]

    @property
    def refusals(self) -> list[str]:
        """Refusals of the pre-flight checks and of opening the link."""
        return [event.text for event in self.events_seen if event.kind == "refused"]

    def delay_words(self) -> str:
        """Return the measured delay and the range that the policy was trained for, in one line."""
        low_ms = 1e3 * self.trained_delay_s[0]
        high_ms = 1e3 * self.trained_delay_s[1]
        measured = self.servo.get("state_to_command", {})
        if self.trained_delay_s == UNKNOWN_DELAY_S:
            if not measured.get("n"):
                return "no delay was measured; deploy.yaml does not say what was trained for."
            return (
                f"state to command {measured['p50_ms']:.1f} ms (median), {measured['p95_ms']:.1f} "
                f"ms (95 %), n = {measured['n']}; deploy.yaml does not say which delays the policy "
                "was trained for; the drives' own delay comes on top."
            )
        if not measured.get("n"):
            return (
                f"no delay was measured; the policy was trained for {low_ms:g} to {high_ms:g} ms."
            )
        median_ms = measured["p50_ms"]
        late_ms = measured["p95_ms"]
        verdict = "within" if late_ms <= high_ms else "BEYOND"
        return (
            f"state to command {median_ms:.1f} ms (median), {late_ms:.1f} ms (95 %), n = "
            f"{measured['n']}: {verdict} the {low_ms:g} to {high_ms:g} ms trained for; the drives' "
            "own delay comes on top."
        )

    def figures(self) -> dict[str, Any]:
        """Return the figures for JSON and the end of the log."""
        trained_delay_s = None
        if self.trained_delay_s != UNKNOWN_DELAY_S:
            trained_delay_s = list(self.trained_delay_s)
        return {
            "servo": self.servo,
            "policy": self.policy,
            "trained_delay_s": trained_delay_s,
            "faults": self.faults,
            "refusals": self.refusals,
            "standby": self.standby,
            "log_error": self.log_error,
            "interrupted": self.interrupted,
        }


class Deployment:
    """Runs the processes of a plan. A context manager; leaving it damps, then ends them all."""

    def __init__(self, plan: RunPlan) -> None:
        """Check what can be checked before any process starts.

        Raises:
            ArtefactError: The policy cannot be read, or is not for this robot.
            PronkError: ONNX Runtime is not installed.
        """
        plan.limits()
        self.plan = plan
        self.summary = RunSummary()
        self._header: dict[str, Any] = {}
        if plan.policy is not None:
            policy = open_policy(plan.policy, plan.robot, plan.deploy_yaml)
            self.summary.trained_delay_s = policy.delay_range_s
            self._header = log_header(plan, policy)
        if plan.sweep is not None:
            plan.sweep.check()
        self.servo: BaseProcess
        self.policy: BaseProcess | None = None
        self.logger: BaseProcess | None = None
        self.standby: BaseProcess | None = None
        """Standby process of a robot behind a network."""
        self._ends: dict[BaseProcess, Connection] = {}
        """This end of the pipe to each process."""
        self._record = np.zeros((), dtype=OPERATOR)
        """Newest command of the operator."""
        self._written = threading.Event()
        self._beating = False
        self._heart = threading.Thread(target=self._beat, name="pronk heartbeat", daemon=True)
        self._open = False
        self._interrupts = Interrupts()

    def __enter__(self) -> Self:
        """Start everything; HardwareError if the link could not be opened."""
        plan = self.plan
        with terminal_blocked():
            self.shared = Shared(joints=len(plan.robot.joints))
        self.write(OperatorCommand())
        self._beating = True
        with terminal_blocked():
            self._heart.start()
        self.servo = self._process("servo", serve_robot, self.summary.trained_delay_s)
        if plan.policy is not None:
            self.policy = self._process("policy", serve_policy)
        if plan.log is not None or plan.sweep is not None:
            self.logger = self._process("log", write_log, self._header)
        if plan.link.address.scheme != SIM:
            self.standby = self._process("standby", serve_standby)
        self._interrupts.__enter__()
        self._open = True
        try:
            with terminal_blocked():
                for process in (self.policy, self.logger, self.standby):
                    if process is not None:
                        process.start()
            if self.logger is not None:
                silent = f"{plan.log}: the process that writes the log did not start."
                reply = self._first_message(self.logger, LogError(silent))
                if reply != READY:
                    raise LogError(reply.decode())
            if self.standby is not None:
                silent = "the process that damps in place of the servo did not start."
                reply = self._first_message(self.standby, HardwareError(silent))
                if reply not in (HAS_STANDBY, NO_STANDBY):
                    raise HardwareError(_unopened(plan, reply.decode()))
            # Last, so that its first tick is logged.
            with terminal_blocked():
                self.servo.start()
            self._await_servo()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def _process(
        self, name: str, body: Callable[..., None], argument: object = None
    ) -> BaseProcess:
        """Return a process that is not started yet.

        Args:
            name: Name of the process.
            body: Called with the plan, the name of the shared memory, `argument` unless it is None,
                and the other end of the pipe.
            argument: Further argument of the body.
        """
        context = get_context("spawn")
        end, other_end = context.Pipe()
        arguments: list[object] = [self.plan, self.shared.name]
        if argument is not None:
            arguments.append(argument)
        arguments.append(other_end)
        process = context.Process(target=body, args=tuple(arguments), name=f"pronk {name}")
        self._ends[process] = end
        return process

    @property
    def mode(self) -> Mode:
        """Mode of the servo; `ENDED` too if its process is gone or the standby took over."""
        if not self.servo.is_alive() or self.shared.standby.written > 0:
            return Mode.ENDED
        return self.shared.mode or Mode.IDLE

    def events_seen(self) -> list[Event]:
        """Return events of the servo since the last call; the summary keeps them too."""
        events = [Event.of(record) for record in self.shared.events_seen.take()]
        self.summary.events_seen += events
        return events

    def write(self, command: OperatorCommand) -> None:
        """Send the operator's command to servo and policy; call it at about 50 Hz.

        Raises:
            KeyboardInterrupt: A signal requests the end; raised only here, and not while closing.
        """
        if self._open:
            self._interrupts.check()
        if command.request is not OperatorRequest.NONE:
            self.shared.requests.put(np.array((command.request,), dtype=REQUEST))
        record = self._record.copy()
        record["time"] = time.monotonic()
        record["held"] = command.dead_man
        record["jump"] = command.jump
        record["command"] = command.command
        # Replaced as a whole; the heartbeat alone writes to the mailbox.
        self._record = record
        self._written.set()

    def _beat(self) -> None:
        """Write the newest command with the time, as promptly as the servo; runs in a thread.

        It stamps a command anew until the command is `_STALL_S` old; the servo waits for another
        `RunPlan.operator_timeout_s` before it damps (`Servo._operator`).
        """
        if self.plan.real_time:
            with suppress(AttributeError, OSError):  # of this thread alone
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(SERVO_PRIORITY))
        while self._beating:
            self._written.clear()
            record = self._record.copy()
            now = time.monotonic()
            if now - float(record["time"]) <= _STALL_S:
                record["time"] = now
                self.shared.operator.write(record)
            self._written.wait(_BEAT_S)

    def run(
        self,
        operator: Operator,
        notify: Callable[[Event], None] | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> RunSummary:
        """Send the operator's commands until the servo ends.

        Args:
            operator: Gives the commands.
            notify: Called with each event of the servo.
            progress: Called with the share of a sweep that is done, 0 to 1.

        Returns:
            The summary, whose figures come when the run is closed.
        """
        wake = time.monotonic()
        while True:
            mode = self.mode
            for event in self.events_seen():
                operator.notified(event.kind, event.text)
                if notify is not None:
                    notify(event)
            if mode is Mode.ENDED:
                return self.summary
            record = self.shared.state.read()
            if record is not None:
                operator.sensed(record["remote"].tobytes())
            if progress is not None:
                progress(0.0 if record is None else float(record["progress"]))
            try:
                command = operator.command(time.monotonic(), mode)
                is_logging = self.logger is not None and self.logger.is_alive()
                if self.plan.sweep is not None and not is_logging:
                    command = _QUIT
                self.write(command)
            except KeyboardInterrupt:
                self.summary.interrupted = True
                self.write(_QUIT)
                operator.leave()
            wake = max(wake + 1.0 / _RATE_HZ, time.monotonic())
            sleep_until(wake)

    def close(self) -> None:
        """Damp, end all processes, finish the log; closing twice has no effect."""
        if not self._open:
            return
        self._open = False
        try:
            if self.servo.pid is not None:
                self._stop_servo()
            for process in (self.standby, self.policy):
                if process is not None and process.pid is not None:
                    process.terminate()
                    process.join(_END_S)
            self.summary.standby = self.shared.standby.written > 0
            self.summary.servo = self._figures(self.servo)
            self.summary.policy = self._figures(self.policy)
            self.events_seen()
            if self.logger is not None and self.logger.pid is not None:
                self._stop_logger(self.logger)
        finally:
            for process in (self.servo, self.policy, self.logger, self.standby):
                if process is not None and process.is_alive():
                    process.kill()
                    process.join()
            self._beating = False
            self._heart.join()
            self.shared.close()
            self._interrupts.__exit__(None, None, None)

    def _stop_servo(self) -> None:
        """Request the end; commands continue meanwhile, because their absence is a fault."""
        if self.shared.standby.written:
            self.servo.kill()  # it is stopped, or was for so long that the joints are damped
            self.servo.join()
            return
        until = time.monotonic() + _END_S
        self.write(_QUIT)
        while self.servo.is_alive() and time.monotonic() < until:
            self.servo.join(1.0 / _RATE_HZ)
            self.write(OperatorCommand())
        if self.servo.is_alive():
            self.servo.terminate()
            self.servo.join(_END_S)

    def _figures(self, process: BaseProcess | None) -> dict[str, Any]:
        """Return what a process sent when it ended; {} if it was killed."""
        if process is None:
            return {}
        end = self._ends[process]
        try:
            if end.poll(1.0):
                return dict(orjson.loads(end.recv_bytes()))
        except (EOFError, OSError):
            pass
        return {}

    def _stop_logger(self, logger: BaseProcess) -> None:
        """Have the logger finish its log; note in the summary what it lacks."""
        summary = self.summary
        end = self._ends[logger]
        figures = summary.figures()
        if not summary.servo:
            figures["reason"] = "the servo's process was killed"
        ended = time.time()
        try:
            if not end.poll():
                end.send_bytes(orjson.dumps(figures))
                logger.join(_END_S)
            if end.poll():  # an error, or the end of the process
                summary.log_error = end.recv_bytes().decode()
            elif logger.exitcode is None:
                summary.log_error = f"the log was not ended within {_END_S:.0f} s"
        except (EOFError, OSError):
            if logger.exitcode != 0:
                summary.log_error = "the process that writes the log was killed"
        dropped = sum(summary.servo.get("dropped", {}).values())
        if dropped and not summary.log_error:
            summary.log_error = f"the log lacks {dropped} records: its process was too slow"
        elif summary.log_error and self.plan.log is not None and self.plan.log.exists():
            lacking_s = max(ended - self.plan.log.stat().st_mtime, 0.0)
            extent = f"{self.plan.log} ends {lacking_s:.1f} s before the run"
            summary.log_error = f"{summary.log_error.rstrip('.')}; {extent}"

    def _first_message(self, process: BaseProcess, silent: PronkError) -> bytes:
        """Return the first message of a process; raise `silent` if it ends or sends none."""
        end = self._ends[process]
        until = time.monotonic() + _START_S
        while not end.poll(0.05):
            self.write(OperatorCommand())
            if process.exitcode is not None or time.monotonic() > until:
                raise silent
        try:
            return end.recv_bytes()
        except EOFError:
            raise silent from None

    def _await_servo(self) -> None:
        """Wait until the servo has opened the link."""
        until = time.monotonic() + _START_S
        while self.shared.state.written == 0:
            self.write(OperatorCommand())
            self.servo.join(0.05)
            self.events_seen()
            if self.servo.exitcode is not None:
                reason = " ".join(self.summary.refusals) or "its process ended without an error."
                raise HardwareError(_unopened(self.plan, reason))
            if time.monotonic() > until:
                raise HardwareError(
                    f"the link was not open after {_START_S:.0f} s; check the robot and the cable."
                )


def _unopened(plan: RunPlan, reason: str) -> str:
    """Return that a link was not opened, and why."""
    return f"the link {plan.link.robot} was not opened: {reason}"


def run_plan(
    plan: RunPlan,
    operator: Operator,
    notify: Callable[[Event], None] | None = None,
    progress: Callable[[float], None] | None = None,
) -> RunSummary:
    """Run a plan from beginning to end.

    Args:
        plan: The plan.
        operator: Gives the operator's commands.
        notify: Called with each event of the servo.
        progress: Called with the share of a sweep that is done, 0 to 1.

    Returns:
        Figures and events of the run.

    Raises:
        HardwareError: It could not start, or the servo's process was killed.
    """
    with Deployment(plan) as deployment:
        summary = deployment.run(operator, notify, progress)
    if not summary.servo:
        damped = (
            "only the robot's own watchdog damps the joints now: secure them before anything else"
        )
        if summary.standby:
            damped = "the standby process damped the joints"
        raise HardwareError(f"the servo's process was killed; {damped}.")
    return summary


def log_header(plan: RunPlan, policy: DeployablePolicy) -> dict[str, Any]:
    """Return the header of a policy's log."""
    import onnxruntime

    return {
        "robot": plan.robot.name,
        "joints": list(plan.robot.joint_names),
        "link": str(plan.link),
        "policy": {"file": str(plan.policy), **policy.provenance()},
        "limits": asdict(plan.limits()),
        "timing": asdict(plan.timing),
        "versions": {"pronk": VERSION, "onnxruntime": onnxruntime.__version__},
    }
