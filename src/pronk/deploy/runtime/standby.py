"""The standby process: damps the joints when the servo's process has stopped or was killed.

It has a transport of its own and reads the time that the servo writes into shared memory at every
tick. A servo that has been silent for `RunPlan.silence_s` while it drove the joints has stopped,
and with it the thread of its link that damps when a command expires. A servo that goes on later
finds the commands of another writer, and damps too.

A wire that has one writer (a link of one's own without `open_damper`) and the virtual robot in this
program have no standby.
"""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from multiprocessing.connection import Connection

import numpy as np

from pronk.deploy.links.link import NetworkLink
from pronk.deploy.links.realtime import RealTimeSettings, enter, leave, sleep_until
from pronk.deploy.runtime.memory import Shared
from pronk.deploy.runtime.modes import DRIVEN, Mode
from pronk.deploy.runtime.plan import STANDBY_PRIORITY, RunPlan
from pronk.deploy.runtime.records import STANDBY
from pronk.errors import PronkError

HAS_STANDBY = b"standby"
"""First message of a standby process that can damp."""
NO_STANDBY = b"no standby"
"""First message of one whose link cannot have a standby."""
_POLL_S = 0.004
"""Time between two looks at the servo [s]."""
_REPEAT_S = 0.01
"""Time between two messages of damping [s]."""
_LEAST_S = 3.0
"""Shortest time of damping, in which any robot here comes to rest [s]."""


def serve_standby(plan: RunPlan, name: str, end: Connection) -> None:
    """Run the standby process.

    Args:
        plan: Plan of the run.
        name: Name of the shared memory.
        end: Pipe to the operator's process; gets `HAS_STANDBY`, `NO_STANDBY`, or why the link
            cannot be opened, as a sentence.
    """
    leave()
    stopping = False

    def stop(*_: object) -> None:
        nonlocal stopping
        stopping = True

    signal.signal(signal.SIGTERM, stop)
    try:
        machine = plan.link()
        damp = machine.open_damper() if isinstance(machine, NetworkLink) else None
    except PronkError as error:
        end.send_bytes(str(error).encode())
        return
    end.send_bytes(NO_STANDBY if damp is None else HAS_STANDBY)
    if damp is None:
        return
    if plan.real_time:
        enter(RealTimeSettings(priority=STANDBY_PRIORITY))
    else:
        enter(RealTimeSettings(lock=False))
    shared = Shared(name, len(plan.robot.joints))
    parent = os.getppid()
    record = np.zeros((), STANDBY)
    damping_since: float | None = None
    next_message = 0.0
    while True:
        now = time.monotonic()
        state = shared.state.read()
        mode = None if state is None else Mode(int(state["mode"]))
        orphaned = os.getppid() != parent
        if damping_since is None:
            # A servo that drove the joints and has not ended may yet fall silent.
            if mode is Mode.ENDED or ((stopping or orphaned) and mode not in DRIVEN):
                break
            if state is not None and mode in DRIVEN and now - float(state["now"]) > plan.silence_s:
                damping_since = now
                record["time"] = now
                shared.standby.write(record)
        elif now - damping_since > _LEAST_S and (stopping or orphaned or mode is Mode.ENDED):
            break
        if damping_since is not None and now >= next_message:
            # Whatever fails, as a cable that is out for a moment: the next message may get through.
            with suppress(Exception):
                damp()
            next_message = now + _REPEAT_S
        sleep_until(now + _POLL_S)
    shared.close()
