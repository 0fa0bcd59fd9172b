"""The process that owns the machine while it is asked over a wire, and alone writes to it.

It carries out the plan. The program that started it, its owner, shows progress, writes the logs
and has the person at the bench; if that program says stop, falls silent or dies, the joints are
damped, for a second at least, and the link is closed.
"""

from __future__ import annotations

import queue
import signal
import socket
import sys
import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from pronk.errors import HardwareError, PronkError
from pronk.excitation.plan import SweepPlan
from pronk.links.address import Address
from pronk.links.realtime import Wanted, enter
from pronk.links.state_checks import Freshness
from pronk.links.terminal import leave
from pronk.robots.robot import Robot
from pronk.runtime.sweep.channel import Channel
from pronk.runtime.sweep.log_subprocess import LogApart
from pronk.runtime.sweep.record import record
from pronk.runtime.sweep.servo import Servo, Timing

_PRIORITY = 50
"""Of SCHED_FIFO: above the virtual robot's, below the kernel's own threads."""
_SWITCH_S = 0.5e-3
"""How long one Python thread may keep another from running [s]."""
_LAST_WORDS_S = 5.0
"""In which the owner must have taken what is left of the log [s]."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """What a servo's process shall do."""

    robot: Robot
    plan: SweepPlan
    """Checked by the caller, and again here."""
    out_dir: Path
    """Folder for the logs."""
    address: Address
    release: bool = False
    """Make the robot's own controller let go of the joints first."""
    overwrite: bool = False
    """Replace logs that are already there."""
    real_time: bool = False
    """Ask the system for real-time scheduling."""
    timing: Timing = field(default_factory=Timing)
    fresh: Freshness | None = None
    """How fresh states must be at first; the usual if None."""


def serve(job: Job, end: socket.socket) -> None:
    """Body of the servo's process.

    Args:
        job: What to do.
        end: Of the socket pair at whose other end the owner is.
    """
    leave()  # the terminal's keys and its end are the owner's to hear
    owner = Owner(Channel(end), job.timing.silent_s)
    signal.signal(signal.SIGTERM, lambda *_: owner.told_to_end())
    # Before the link starts threads: they inherit what is granted.
    for answer in enter(Wanted(priority=_PRIORITY)) if job.real_time else ():
        owner.channel.put("say", answer)
    sys.setswitchinterval(_SWITCH_S)
    servo = Servo(job.timing, owner.check)
    try:
        machine = job.address.machine(
            job.robot, clamp_operator=owner.clamp, release=job.release, fresh=job.fresh
        )
        logs = record(
            machine,
            job.robot,
            job.plan,
            job.out_dir,
            progress=lambda share, _: owner.channel.put("progress", share),
            overwrite=job.overwrite,
            servo=servo,
            metadata={"link": str(job.address), "servo_rate_hz": f"{servo.timing.rate_hz:g}"},
            open_log=partial(LogApart, owner.channel),
        )
        owner.channel.put("done", logs, machine.virtual, servo.figures())
    except PronkError as error:
        owner.channel.put("failed", error)
    except KeyboardInterrupt:
        # The owner asked for it, and knows.
        pass
    finally:
        owner.channel.finish(_LAST_WORDS_S)


class Owner:
    """The program that started the servo, as the servo knows it."""

    def __init__(self, channel: Channel, silent_s: float) -> None:
        """Begin.

        Args:
            channel: Its owner is at the other end.
            silent_s: Silence after which it counts as stuck [s].
        """
        self.channel = channel
        self._silent_s = silent_s
        self._heard: float | None = None
        self._ending = False
        self._answers: queue.SimpleQueue[HardwareError | None] = queue.SimpleQueue()

    def told_to_end(self) -> None:
        """Somebody else ends the servo."""
        self._ending = True

    def check(self) -> None:
        """Look whether the owner is well and wants to go on.

        Raises:
            HardwareError: It is not, or somebody else ended this process.
            KeyboardInterrupt: It wants to end.
        """
        messages, now = self.channel.take(), time.monotonic()
        if messages or self._heard is None:
            self._heard = now
        for name, *words in messages:
            if name == "stop":
                raise KeyboardInterrupt
            if name == "hands done":
                self._answers.put(words[0])
        if self.channel.gone:
            raise HardwareError("the program that wrote the log ended; the joints were damped.")
        if now - self._heard > self._silent_s:
            raise HardwareError(
                f"the program that writes the log was stuck for {now - self._heard:.1f} s, "
                f"expected at most {self._silent_s:g} s; the joints were damped; let it run, and "
                "see that its disk is not busy."
            )
        if self._ending:
            raise HardwareError("the servo was told to end (SIGTERM); the joints were damped.")

    def clamp(self, joints: tuple[str, ...]) -> None:
        """Have a person fix joints; returns when it is done. Of another thread than `check`.

        Raises:
            HardwareError: Nobody is there.
        """
        self.channel.put("hands", joints)
        error = self._answers.get()
        if error is not None:
            raise error
