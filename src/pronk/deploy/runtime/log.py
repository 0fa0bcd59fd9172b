"""The log of a run of a policy: its messages, and the process that writes them.

Every time is on CLOCK_MONOTONIC in seconds, the clock of everything that is measured; the messages'
log time is the wall clock. `pronk.deploy.runtime.deploy_log` reads it.

    /deploy/header   once, first: robot, joints, policy, limits
    /deploy/tick     500 Hz: the fields of `pronk.deploy.runtime.records.TICK`
    /deploy/step     50 Hz: the fields of `pronk.deploy.runtime.records.STEP`
    /deploy/event    mode changes, faults, refusals, settings granted by the operating system, and
                     whether the robot is virtual
    /deploy/end      last: the figures of the run; a log without it was cut
"""

from __future__ import annotations

import os
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import orjson

from pronk.deploy.links.realtime import leave
from pronk.deploy.runtime.memory import Shared
from pronk.deploy.runtime.modes import Mode
from pronk.deploy.runtime.plan import RunPlan
from pronk.deploy.runtime.reasons import Reason
from pronk.deploy.runtime.records import EVENT, STEP, TICK, Event
from pronk.deploy.runtime.sweep_logs import SweepLogs
from pronk.errors import LogError
from pronk.identify.logs.mcap import (
    BOOLEAN,
    INTEGER,
    NUMBER,
    NUMBERS,
    STRING,
    STRINGS,
    McapWriter,
)

SCHEMA = "pronk/deploy/4"
HEADER_TOPIC = "/deploy/header"
TICK_TOPIC = "/deploy/tick"
STEP_TOPIC = "/deploy/step"
EVENT_TOPIC = "/deploy/event"
END_TOPIC = "/deploy/end"

# Foxglove reads the properties of every object; without them it refuses the channel.
_OBJECT: dict[str, Any] = {"type": "object", "properties": {}}


def _properties(dtype: np.dtype[Any]) -> dict[str, Any]:
    """Return the JSON Schema of a record's fields."""
    properties: dict[str, Any] = {}
    for name in dtype.names or ():
        field = dtype[name]
        if field.shape:
            properties[name] = NUMBERS
        elif field.kind == "i":
            properties[name] = INTEGER
        else:
            properties[name] = NUMBER
    return properties


TOPICS: dict[str, dict[str, Any]] = {
    HEADER_TOPIC: {
        "schema": STRING,
        "robot": STRING,
        "joints": STRINGS,
        "link": STRING,
        "policy": _OBJECT,
        "limits": _OBJECT,
        "timing": _OBJECT,
        "versions": _OBJECT,
    },
    TICK_TOPIC: {**_properties(TICK), "mode_name": STRING, "reason_name": STRING},
    STEP_TOPIC: _properties(STEP),
    EVENT_TOPIC: {
        "time": NUMBER,
        "kind": STRING,
        "text": STRING,
        "reason": STRING,
        "level": STRING,
    },
    END_TOPIC: {"complete": BOOLEAN, "figures": _OBJECT},
}
"""Properties of the messages of each topic, as JSON Schema has them."""


class DeployLogWriter:
    """Writes a log as the run goes on."""

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        """Open `path`, which is replaced, and write the header; LogError if it cannot be made."""
        try:
            self._file = McapWriter(path, TOPICS)
        except OSError as error:
            raise LogError(f"{path}: cannot be written ({error.strerror}).") from None
        self._wall_offset = time.time() - time.monotonic()
        """Wall clock less CLOCK_MONOTONIC [s]."""
        policy = header.get("policy", {})
        self._file.metadata(
            {
                "schema": SCHEMA,
                "robot": str(header.get("robot")),
                "link": str(header.get("link")),
                "policy_sha256": str(policy.get("sha256")),
            }
        )
        self._put(HEADER_TOPIC, time.monotonic(), {"schema": SCHEMA, **header})
        self.flush()

    def flush(self) -> None:
        """Pass everything to the operating system."""
        self._file.flush()

    def drain(self, shared: Shared) -> None:
        """Write everything that waits, events first: they explain the other records."""
        for ring in (shared.events, shared.policy_events, shared.ticks, shared.steps):
            for record in ring.take():
                self.write(record)

    def write(self, record: np.void) -> None:
        """Write a record of `EVENT`, `TICK` or `STEP`, as plain numbers and lists."""
        names = record.dtype.names or ()
        if names == EVENT.names:
            event = Event.of(record)
            message = {
                "time": event.time,
                "kind": event.kind,
                "text": event.text,
                "reason": event.reason,
                "level": event.level,
            }
            self._put(EVENT_TOPIC, event.time, message)
            return
        row = {name: record[name].tolist() for name in names}
        topic = STEP_TOPIC
        if names == TICK.names:
            topic = TICK_TOPIC
            row["mode_name"] = Mode(record["mode"]).name
            row["reason_name"] = Reason(record["reason"]).name
        self._put(topic, row["begun"], row)

    def end(self, *, complete: bool, figures: dict[str, Any]) -> None:
        """Write the end and close the file.

        Args:
            complete: Whether no record was lost.
            figures: Figures of the run.
        """
        self._put(END_TOPIC, time.monotonic(), {"complete": complete, "figures": figures})
        self._file.close()

    def _put(self, topic: str, t: float, body: dict[str, Any]) -> None:
        """Write a message of a time of CLOCK_MONOTONIC [s]."""
        self._file.put(topic, t + self._wall_offset, body)


READY = b"ready"
"""First message of the logger's process, once its log is open."""
FLUSH_S = 0.25
"""Longest time until a record is in the file [s]."""
_NAP_S = 0.02
"""Time between two looks at the queues [s]."""
_LAST_S = 6.0
"""Longest wait for the servo after the parent has ended: it damps for a second, and the link for
three at most [s]."""


def write_log(plan: RunPlan, name: str, header: dict[str, Any], talk: Connection) -> None:
    """Run the logger's process; it ends on request, or after the servo.

    Args:
        plan: Plan of the run.
        name: Name of the shared memory.
        header: Header of a policy's log.
        talk: Pipe to the operator's process: sends `READY` or an error, and receives the figures of
            the run, JSON, at its end.
    """
    leave()
    parent = os.getppid()
    shared = Shared(name, len(plan.robot.joints))
    try:
        if plan.sweep is not None:
            _write_sweep(SweepLogs(plan.sweep), shared, talk, parent)
        else:
            assert plan.log is not None
            _write_policy_log(DeployLogWriter(plan.log, header), shared, talk, parent)
    except LogError as error:
        talk.send_bytes(str(error).encode())
    except OSError as error:
        text = f"the log cannot be written ({error}); free the disk or give another folder."
        talk.send_bytes(text.encode())
    finally:
        shared.close()


def _write_sweep(logs: SweepLogs, shared: Shared, talk: Connection, parent: int) -> None:
    """Write the logs of a sweep until the run ends."""
    figures = _drain_until_end(logs, shared, talk, parent)
    # The servo has ended its log, unless it was killed.
    logs.end(figures.get("reason", "the servo's process was killed"))


def _write_policy_log(
    writer: DeployLogWriter, shared: Shared, talk: Connection, parent: int
) -> None:
    """Write the log of a policy until the run ends."""
    figures = _drain_until_end(writer, shared, talk, parent)
    complete = bool(figures) and not any(shared.dropped().values())
    writer.end(complete=complete, figures=figures)


def _drain_until_end(
    writer: DeployLogWriter | SweepLogs, shared: Shared, talk: Connection, parent: int
) -> dict[str, Any]:
    """Write what comes until the run ends; return its figures, {} if the parent has ended."""
    talk.send_bytes(READY)
    flushed = time.monotonic()

    def drain() -> None:
        nonlocal flushed
        writer.drain(shared)
        if time.monotonic() - flushed >= FLUSH_S:
            writer.flush()
            flushed = time.monotonic()
        time.sleep(_NAP_S)

    while not talk.poll() and os.getppid() == parent:
        drain()
    figures: dict[str, Any] = {}
    try:
        figures = orjson.loads(talk.recv_bytes())
    except (EOFError, OSError):
        # The parent has ended. The servo damps now; that is logged too.
        until = time.monotonic() + _LAST_S
        while shared.mode not in (None, Mode.ENDED) and time.monotonic() < until:
            drain()
    writer.drain(shared)
    return figures
