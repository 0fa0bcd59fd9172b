"""A run of a policy or a sweep: its processes, and the operator's end of them."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Self

import numpy as np
import orjson

from pronk import __version__
from pronk.errors import HardwareError, LogError, PronkError
from pronk.links.address import SIM
from pronk.links.link import ClampOperator
from pronk.links.realtime import Interrupts, sleep_until, terminal_blocked
from pronk.policy.contract import check
from pronk.policy.runtime import Policy, load_policy
from pronk.runtime.ipc import OPERATOR, Event, Mode, OperatorRequest, Shared, fill
from pronk.runtime.log import READY, write_log
from pronk.runtime.plan import SERVO_PRIORITY, Plan
from pronk.runtime.policy_process import serve_policy
from pronk.runtime.servo import serve_robot
from pronk.runtime.standby import serve_standby
from pronk.runtime.teleop import BenchOperator, Operator, OperatorCommand

_RATE_HZ = 50.0
"""Of the operator's program."""
_BEAT_S = 0.01
"""Between two heartbeats of the operator's program [s]."""
_STALL_S = 0.7
"""Longest that the operator's program may be late, on a busy computer or at a slow terminal, before
its heartbeat ends; `Plan.operator_timeout_s` follows [s]."""
_START_S = 30.0
"""In which the servo must have opened the link."""
_END_S = 10.0
"""In which each process must have ended."""

_QUIT = OperatorCommand(request=OperatorRequest.QUIT)


@dataclass(kw_only=True)
class RunSummary:
    """Figures and events of a run."""

    servo: dict[str, Any] = field(default_factory=dict)
    """Of the servo; empty if it was killed."""
    policy: dict[str, Any] = field(default_factory=dict)
    """Of the policy's process; empty if it was killed."""
    events_seen: list[Event] = field(default_factory=list)
    log_error: str = ""
    """Why the log could not be written to its end."""
    standby: bool = False
    """Whether the standby process damped the joints, because the servo was silent."""
    interrupted: bool = False
    """Whether a signal ended it: the interrupt key, or the end of the terminal."""
    trained_delay_s: tuple[float, float] = (0.0, 0.0)
    """Command delays that the policy was trained for [s]."""

    @property
    def faults(self) -> list[str]:
        """Faults that damped the robot."""
        return [event.text for event in self.events_seen if event.kind == "fault"]

    @property
    def refusals(self) -> list[str]:
        """Results of the pre-flight checks and of opening the link."""
        return [event.text for event in self.events_seen if event.kind == "refused"]

    def delay_words(self) -> str:
        """The measured delay and the range that the policy was trained for, in one line."""
        low, high = (1e3 * edge for edge in self.trained_delay_s)
        measured = self.servo.get("state_to_command", {})
        if not measured.get("n"):
            return f"no delay was measured; the policy was trained for {low:g} to {high:g} ms."
        p50, p95 = measured["p50_ms"], measured["p95_ms"]
        where = "within" if p95 <= high else "BEYOND"
        return (
            f"state to command {p50:.1f} ms (median), {p95:.1f} ms (95 %), n = {measured['n']}: "
            f"{where} the {low:g} to {high:g} ms trained for; the drives' own delay comes on top."
        )

    def figures(self) -> dict[str, Any]:
        """For JSON and the end of the log."""
        return {
            "servo": self.servo,
            "policy": self.policy,
            "trained_delay_s": list(self.trained_delay_s),
            "faults": self.faults,
            "refusals": self.refusals,
            "standby": self.standby,
            "log_error": self.log_error,
            "interrupted": self.interrupted,
        }


class Deployment:
    """Runs the processes of a plan. A context manager; leaving it damps, then ends them all."""

    def __init__(self, plan: Plan) -> None:
        """Check what can be checked before any process starts.

        Raises:
            ArtefactError: The policy cannot be read, or is not for this robot.
            PronkError: ONNX Runtime is not installed.
        """
        plan.safety()
        self.plan = plan
        self.summary = RunSummary()
        self._header: dict[str, Any] = {}
        if plan.policy is not None:
            policy = load_policy(plan.policy)
            check(policy.contract, plan.robot)
            self.summary.trained_delay_s = policy.contract.delay_range_s
            self._header = _header(plan, policy)
        if plan.sweep is not None:
            plan.sweep.check()
        self.servo: BaseProcess
        self.policy: BaseProcess | None = None
        self.logger: BaseProcess | None = None
        self.standby: BaseProcess | None = None
        """Of a robot behind a network."""
        self._record = np.zeros((), dtype=OPERATOR)
        self._written, self._beating = threading.Event(), False
        self._heart = threading.Thread(target=self._beat, name="pronk heartbeat", daemon=True)
        self._open = False
        self._interrupts = Interrupts()

    def __enter__(self) -> Self:
        """Start everything; HardwareError if the link could not be opened."""
        plan, context = self.plan, get_context("spawn")
        with terminal_blocked():
            self.shared = Shared(joints=len(plan.robot.joints))
        name = self.shared.name
        self.write(OperatorCommand())
        self._beating = True
        with terminal_blocked():
            self._heart.start()
        self._servo_end, servo_end = context.Pipe(duplex=False)
        self._policy_end, policy_end = context.Pipe(duplex=False)
        self._logger_end, talk = context.Pipe()
        trained = self.summary.trained_delay_s

        def process(what: str, body: Callable[..., None], *given: Any) -> BaseProcess:
            return context.Process(target=body, args=given, name=f"pronk {what}")

        self.servo = process("servo", serve_robot, plan, name, trained, servo_end)
        if plan.policy is not None:
            self.policy = process("policy", serve_policy, plan, name, policy_end)
        if plan.log is not None or plan.sweep is not None:
            self.logger = process("log", write_log, plan, self._header, name, talk)
        if plan.link.address.kind != SIM:
            self._standby_end, standby_end = context.Pipe(duplex=False)
            self.standby = process("standby", serve_standby, plan, name, standby_end)
        self._interrupts.__enter__()
        self._open = True
        try:
            with terminal_blocked():
                for started in (self.policy, self.logger, self.standby):
                    if started is not None:
                        started.start()
            if self.logger is not None:
                self._await_logger(self.logger)
            if self.standby is not None:
                self._await_standby(self.standby)
            # Last, so that its first tick is logged.
            with terminal_blocked():
                self.servo.start()
            for end in (servo_end, policy_end):
                end.close()
            self._await_servo()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def mode(self) -> Mode:
        """Mode of the servo; `ENDED` too if its process is gone or the standby took over."""
        gone = not self.servo.is_alive() or self.shared.standby.written > 0
        return Mode.ENDED if gone else self.shared.mode or Mode.IDLE

    def events_seen(self) -> list[Event]:
        """Events of the servo since the last call; the summary keeps them too."""
        found = [Event.of(record) for record in self.shared.events_seen.take()]
        self.summary.events_seen += found
        return found

    def write(self, command: OperatorCommand) -> None:
        """Send the operator's command to servo and policy; call it at about 50 Hz.

        Raises:
            KeyboardInterrupt: A signal requests the end; raised only here, and not while closing.
        """
        if self._open:
            self._interrupts.check()
        record = self._record.copy()
        if command.request is not OperatorRequest.NONE:
            record["request"] = command.request
            record["requests"] += 1
        fill(record, time=time.monotonic(), held=command.held, jump=command.jump)
        record["command"] = command.command
        # Replaced as a whole; the heartbeat alone writes to the mailbox.
        self._record = record
        self._written.set()

    def _beat(self) -> None:
        """Body of a thread: write the newest command with the time, as promptly as the servo."""
        if self.plan.real_time:
            with suppress(AttributeError, OSError):  # of this thread alone
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(SERVO_PRIORITY))
        while self._beating:
            self._written.clear()
            record, now = self._record.copy(), time.monotonic()
            if now - float(record["time"]) <= _STALL_S:
                record["time"] = now
                self.shared.operator.write(record)
            self._written.wait(_BEAT_S)

    def run(
        self,
        operator: Operator,
        notify: Callable[[Event], None] = lambda event: None,
        progress: Callable[[float], None] = lambda share: None,
    ) -> RunSummary:
        """Send the operator's commands until the servo ends.

        `progress` is called with the share of a sweep that is done, 0 to 1.
        """
        wake = time.monotonic()
        while True:
            mode = self.mode
            for event in self.events_seen():
                operator.notified(event.kind, event.text)
                notify(event)
            if mode is Mode.ENDED:
                return self.summary
            record = self.shared.state.read()
            progress(0.0 if record is None else float(record["progress"]))
            try:
                command = operator.command(time.monotonic(), mode)
                logging = self.logger is not None and self.logger.is_alive()
                self.write(command if logging or self.plan.sweep is None else _QUIT)
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
            if self.standby is not None and self.standby.pid is not None:
                self.standby.terminate()
                self.standby.join(_END_S)
                self.summary.standby = self.shared.standby.written > 0
            self.summary.servo = _received(self._servo_end)
            if self.policy is not None:
                if self.policy.pid is not None:
                    self.policy.terminate()
                    self.policy.join(_END_S)
                self.summary.policy = _received(self._policy_end)
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

    def _stop_logger(self, logger: BaseProcess) -> None:
        summary = self.summary
        figures = summary.figures()
        if not summary.servo:
            figures["reason"] = "the servo's process was killed"
        ended = time.time()
        try:
            if not self._logger_end.poll():
                self._logger_end.send_bytes(orjson.dumps(figures))
                logger.join(_END_S)
            if self._logger_end.poll():  # an error, or the end of the process
                summary.log_error = self._logger_end.recv_bytes().decode()
            elif logger.exitcode is None:
                summary.log_error = f"the log was not ended within {_END_S:.0f} s"
        except EOFError:
            if logger.exitcode != 0:
                summary.log_error = "the process that writes the log was killed"
        except OSError:
            summary.log_error = "the process that writes the log was killed"
        dropped = sum(summary.servo.get("dropped", {}).values())
        if dropped and not summary.log_error:
            summary.log_error = f"the log lacks {dropped} records: its process was too slow"
        elif summary.log_error and self.plan.log is not None and self.plan.log.exists():
            lacking = ended - self.plan.log.stat().st_mtime
            where = f"{self.plan.log} ends {max(lacking, 0.0):.1f} s before the run"
            summary.log_error = f"{summary.log_error.rstrip('.')}; {where}"

    def _await_logger(self, logger: BaseProcess) -> None:
        until = time.monotonic() + _START_S
        while not self._logger_end.poll(0.05):
            self.write(OperatorCommand())
            if logger.exitcode is not None or time.monotonic() > until:
                raise LogError(f"{self.plan.log}: the process that writes the log did not start.")
        reply = self._logger_end.recv_bytes()
        if reply != READY:
            raise LogError(reply.decode())

    def _await_standby(self, standby: BaseProcess) -> None:
        until = time.monotonic() + _START_S
        while not self._standby_end.poll(0.05):
            self.write(OperatorCommand())
            if standby.exitcode is not None or time.monotonic() > until:
                raise HardwareError("the process that damps in place of the servo did not start.")

    def _await_servo(self) -> None:
        until = time.monotonic() + _START_S
        while self.shared.state.written == 0:
            self.write(OperatorCommand())
            self.servo.join(0.05)
            self.events_seen()
            if self.servo.exitcode is not None:
                why = " ".join(self.summary.refusals) or "its process ended without an error."
                raise HardwareError(f"the link {self.plan.link.robot} was not opened: {why}")
            if time.monotonic() > until:
                raise HardwareError(
                    f"the link was not open after {_START_S:.0f} s; check the robot and the cable."
                )


def _received(end: Connection) -> dict[str, Any]:
    """The figures that a process sent when it ended; {} if it was killed."""
    try:
        return dict(orjson.loads(end.recv_bytes())) if end.poll(1.0) else {}
    except (EOFError, OSError):
        return {}


def run(plan: Plan, operator: Operator, notify: Callable[[Event], None]) -> RunSummary:
    """Run a policy from beginning to end; PronkError if it could not start."""
    with Deployment(plan) as deployment:
        summary = deployment.run(operator, notify)
    if not summary.servo:
        raise PronkError(f"the servo's process was killed; {_who_damped(summary)}.")
    return summary


def _who_damped(summary: RunSummary) -> str:
    """What damped the joints after the servo had been killed."""
    if summary.standby:
        return "the standby process damped the joints"
    return "only the robot's own watchdog damps the joints now: secure them before anything else"


def _header(plan: Plan, policy: Policy) -> dict[str, Any]:
    """Of a policy's log."""
    import onnxruntime

    contract = policy.contract
    shown = ("gains", "gains_sha256", "delay_range_s", "jump", "virtual")
    return {
        "robot": plan.robot.name,
        "joints": list(plan.robot.joint_names),
        "link": str(plan.link),
        "policy": {"file": str(plan.policy), "sha256": policy.sha256}
        | {name: getattr(contract, name) for name in shown},
        "limits": vars(plan.safety()),
        "timing": vars(plan.timing),
        "versions": {"pronk": __version__, "onnxruntime": onnxruntime.__version__},
    }


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """The result of a sweep in real time."""

    logs: list[Path]
    virtual: bool
    servo: dict[str, float | int]
    """Lateness of the servo's ticks, and how many were `missed`."""


def run_sweep(
    plan: Plan,
    *,
    clamp_operator: ClampOperator,
    notify: Callable[[Event], None] = lambda event: None,
    progress: Callable[[float], None] = lambda share: None,
) -> Recorded:
    """Carry out a sweep on a machine in real time.

    `clamp_operator` runs in a thread of its own; `progress` gets the share done, 0 to 1.

    Raises:
        PronkError: The robot may not be moved, the filter stopped the sweep, or a process was
            killed. What was recorded until then stays readable, with the reason.
        KeyboardInterrupt: The run was interrupted; the joints were damped.
    """
    assert plan.sweep is not None
    operator = BenchOperator(clamp_operator)
    with Deployment(plan) as deployment:
        summary = deployment.run(operator, notify, progress)
    servo = summary.servo
    if not servo:
        raise HardwareError(f"the servo's process was killed; {_who_damped(summary)}.")
    if summary.interrupted:
        raise KeyboardInterrupt
    if operator.error is not None:
        raise operator.error
    if summary.log_error:
        raise HardwareError(f"{summary.log_error}; the joints were damped.")
    if reasons := summary.refusals or servo["faults"]:
        raise HardwareError(" ".join(reasons))
    if not servo["finished"]:
        raise HardwareError("the sweep was ended (SIGTERM); the joints were damped.")
    figures = {**servo["lateness"], "missed": servo["missed_ticks"]}
    return Recorded(logs=plan.sweep.paths, virtual=bool(servo["virtual"]), servo=figures)
