"""Ask a machine over a wire: a servo's process moves it, this one writes down what it answers."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from pronk.errors import HardwareError, PronkError
from pronk.links.network_link import ClampOperator
from pronk.links.terminal import Interrupts, unheard
from pronk.logs.mcap_writer import McapLogWriter, reason_of
from pronk.runtime.sweep.channel import Channel
from pronk.runtime.sweep.servo_process import Job, serve

_PERIOD_S = 0.01
"""Between two looks at what the servo says [s]."""
_SILENT_S = 5.0
"""Silence of a servo in the middle of a log after which it counts as stuck [s]."""
_END_S = 10.0
"""In which a servo that was told to stop must have ended [s]: damping takes 3 s at most."""


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """What a recording over a wire left."""

    logs: list[Path]
    virtual: bool
    servo: dict[str, float | int]
    """Lateness of the servo's ticks, as `Servo.figures`."""

    @property
    def words(self) -> str:
        """Whose logs they are."""
        return "the virtual robot" if self.virtual else "a robot that is not the virtual one"


def record_apart(
    job: Job,
    *,
    clamp_operator: ClampOperator,
    progress: Callable[[float], None] = lambda share: None,
    say: Callable[[str], None] = lambda line: None,
    begun: Callable[[Path], None] = lambda path: None,
) -> Recorded:
    """Have a servo's process carry out a plan, and write its logs here.

    Args:
        job: What to do.
        clamp_operator: Fixes joints on a real bench; called in a thread of its own.
        progress: Told the share done, 0 to 1.
        say: Told what the system granted the servo, line by line.
        begun: Told each log that is opened.

    Raises:
        PronkError: The robot may not be moved, breached a limit, or the servo's process was
            killed. What was recorded until then stays, a log that reads and says why it ended.
    """
    ours, theirs = socket.socketpair()
    servo = get_context("spawn").Process(target=serve, args=(job, theirs), name="pronk sweep servo")
    with unheard():
        servo.start()
    theirs.close()
    channel = Channel(ours)
    desk = Desk(
        channel,
        kill=servo.kill,
        clamp_operator=clamp_operator,
        progress=progress,
        say=say,
        begun=begun,
    )
    with Interrupts() as interrupts:
        try:
            desk.attend(interrupts.check)
            servo.join(_END_S)
            return desk.outcome(servo.exitcode)
        except BaseException as error:
            # Whatever went wrong, the interrupt key included: the joints first, then the log.
            channel.put("stop")
            desk.attend(seconds=_END_S)
            desk.end_log(error)
            raise
        finally:
            channel.finish(0.0)
            _end(servo)


def _end(servo: BaseProcess) -> None:
    """It damps by itself once nobody is at the other end; one that cannot is ended."""
    servo.join(_END_S)
    if servo.is_alive():
        servo.kill()
        servo.join()


class Desk:
    """Where what the servo says is taken down."""

    def __init__(
        self,
        channel: Channel,
        *,
        kill: Callable[[], None],
        clamp_operator: ClampOperator,
        progress: Callable[[float], None],
        say: Callable[[str], None],
        begun: Callable[[Path], None],
    ) -> None:
        """Begin; `kill` ends the servo's process, the others as of `record_apart`."""
        self._channel, self._kill = channel, kill
        self._clamp_operator, self._progress, self._say, self._begun = (
            clamp_operator,
            progress,
            say,
            begun,
        )
        self._log: McapLogWriter | None = None
        self._recorded: Recorded | None = None
        self._failed: PronkError | None = None
        self._stuck = False

    def attend(self, check: Callable[[], None] = lambda: None, seconds: float = math.inf) -> None:
        """Take down what the servo says until its end of the channel is closed, or for so long.

        One that is stuck in the middle of a log is killed. `check` is called between two messages:
        no log is left in the middle of a write.

        Raises:
            HardwareError: A log cannot be written.
            KeyboardInterrupt: Somebody wants to end it.
        """
        begun = heard = time.monotonic()
        while not self._channel.gone and (now := time.monotonic()) - begun < seconds:
            check()
            self._channel.put("here")
            for message in self._channel.take():
                heard = now
                self._take(message)
            if self._log is not None and now - heard > _SILENT_S:
                self._stuck = True
                self._kill()
            time.sleep(_PERIOD_S)

    def outcome(self, status: int | None) -> Recorded:
        """What came of it.

        Args:
            status: With which the servo's process ended; below zero the signal that killed it.

        Raises:
            PronkError: Why it ended early.
        """
        if self._failed is not None:
            raise self._failed
        if self._recorded is None:
            if not self._stuck and (status is None or status >= 0):
                raise HardwareError(
                    "the servo's process broke down, and says above why; the joints were damped; "
                    "this is a defect of pronk."
                )
            how = f"said nothing for {_SILENT_S:g} s and " if self._stuck else ""
            raise HardwareError(
                f"the servo's process {how}was killed (signal {-(status or 0)}); only the robot's "
                "own watchdog damps the joints now: see to them before anything else."
            )
        return self._recorded

    def end_log(self, error: BaseException) -> None:
        """End a log that the servo left open.

        Raises:
            HardwareError: It cannot be written.
        """
        self._write(("end", False, reason_of(error)))

    def _take(self, message: tuple[Any, ...]) -> None:
        match message:
            case ("progress", share):
                self._progress(share)
            case ("say", line):
                self._say(line)
            case ("hands", joints):
                threading.Thread(target=self._ask, args=(joints,), daemon=True).start()
            case ("done", logs, virtual, figures):
                self._recorded = Recorded(logs=logs, virtual=virtual, servo=figures)
            case ("failed", error):
                self._failed = error
            case _:
                self._write(message)

    def _write(self, message: tuple[Any, ...]) -> None:
        log = self._log
        try:
            match message:
                case ("open", path, header):
                    self._begun(path)
                    self._log = McapLogWriter(path, header)
                case ("segment", segment) if log is not None:
                    log.segment(segment)
                case ("sample", *values) if log is not None:
                    log.sample(*values)
                case ("end", complete, reason) if log is not None:
                    log.end(complete=complete, reason=reason)
                    self._log = None
        except OSError as error:
            # What still comes for it is left out.
            self._log = None
            raise HardwareError(
                f"the log cannot be written ({error}); the joints were damped; free the disk or "
                "give another folder."
            ) from None

    def _ask(self, joints: tuple[str, ...]) -> None:
        error: PronkError | None = None
        try:
            self._clamp_operator(joints)
        except PronkError as refused:
            error = refused
        except Exception as broken:
            error = HardwareError(f"{type(broken).__name__}: {broken}")
        self._channel.put("hands done", error)
