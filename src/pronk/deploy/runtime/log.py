"""The log of a run of a policy: what is recorded, the process that writes it, and the reader.

Every time is on CLOCK_MONOTONIC in seconds, the clock of everything that is measured; the messages'
log time is the wall clock.

    /deploy/header   once, first: robot, joints, policy, limits
    /deploy/tick     500 Hz: the fields of `pronk.deploy.runtime.ipc.TICK`
    /deploy/step     50 Hz: the fields of `pronk.deploy.runtime.ipc.STEP`
    /deploy/event    mode changes, faults, refusals, settings granted by the operating system, and
                     whether the robot is virtual
    /deploy/end      last: the figures of the run; a log without it was cut
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from pronk.deploy.links.realtime import leave
from pronk.deploy.runtime.ipc import EVENT, STEP, TICK, VIRTUAL, Event, Shared
from pronk.deploy.runtime.modes import Mode
from pronk.deploy.runtime.plan import Plan
from pronk.deploy.runtime.safety import Reason
from pronk.deploy.runtime.sweep import SweepLogs
from pronk.errors import LogError
from pronk.files import sha256
from pronk.identify.logs.mcap import (
    BOOLEAN,
    INTEGER,
    NUMBER,
    NUMBERS,
    STRING,
    STRINGS,
    DamagedError,
    McapWriter,
    Record,
    records,
)

SCHEMA = "pronk/deploy/3"
_HEADER, _TICK, _STEP, _EVENT, _END = (
    f"/deploy/{name}" for name in ("header", "tick", "step", "event", "end")
)
# Foxglove reads the properties of every object; without them it refuses the channel.
_OBJECT: dict[str, Any] = {"type": "object", "properties": {}}


def _properties(dtype: np.dtype[Any]) -> dict[str, Any]:
    """JSON Schema of a record's fields."""
    fields = {name: dtype[name] for name in dtype.names or ()}
    return {
        name: NUMBERS if of.shape else INTEGER if of.kind == "i" else NUMBER
        for name, of in fields.items()
    }


TOPICS: dict[str, dict[str, Any]] = {
    _HEADER: {"schema": STRING, "robot": STRING, "joints": STRINGS, "link": STRING}
    | {"policy": _OBJECT, "limits": _OBJECT, "timing": _OBJECT, "versions": _OBJECT},
    _TICK: _properties(TICK) | {"mode_name": STRING, "reason_name": STRING},
    _STEP: _properties(STEP),
    _EVENT: {"time": NUMBER, "kind": STRING, "text": STRING, "reason": STRING, "level": STRING},
    _END: {"complete": BOOLEAN, "figures": _OBJECT},
}

MOST_BYTES = 16 * 2**30
"""Largest size that a log may unpack to, four hours [bytes]. It is parsed chunk by chunk and only
its numbers are kept."""
_WRONG = (KeyError, TypeError, ValueError, AttributeError, OverflowError)
"""Raised when messages of another kind are read."""


class DeployLogWriter:
    """Writes a log as the run goes on."""

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        """Open `path`, which is replaced, and write the header; LogError if it cannot be made."""
        try:
            self._file = McapWriter(path, TOPICS)
        except OSError as error:
            raise LogError(f"{path}: cannot be written ({error.strerror}).") from None
        self._wall = time.time() - time.monotonic()
        facts = {"schema": SCHEMA, "robot": header.get("robot"), "link": header.get("link")}
        facts["policy_sha256"] = header.get("policy", {}).get("sha256")
        self._file.metadata({name: str(value) for name, value in facts.items()})
        self._put(_HEADER, time.monotonic(), {"schema": SCHEMA, **header})
        self.flush = self._file.flush
        self.flush()

    def drain(self, shared: Shared) -> None:
        """Write everything that waits, events first: they explain the rest."""
        for ring in (shared.events, shared.policy_events, shared.ticks, shared.steps):
            for record in ring.take():
                self.write(record)

    def write(self, record: np.void) -> None:
        """Write a record of `EVENT`, `TICK` or `STEP`, as plain numbers and lists."""
        names = record.dtype.names or ()
        if names == EVENT.names:
            event = Event.of(record)
            self._put(_EVENT, event.time, vars(event))
            return
        topic, row = _STEP, {name: record[name].tolist() for name in names}
        if names == TICK.names:
            topic, mode, reason = _TICK, Mode(record["mode"]), Reason(record["reason"])
            row |= {"mode_name": mode.name, "reason_name": reason.name}
        self._put(topic, row["begun"], row)

    def end(self, *, complete: bool, figures: dict[str, Any]) -> None:
        """Write the end and close the file."""
        self._put(_END, time.monotonic(), {"complete": complete, "figures": figures})
        self._file.close()

    def _put(self, topic: str, t: float, body: dict[str, Any]) -> None:
        self._file.put(topic, t + self._wall, body)


READY = b"ready"
FLUSH_S = 0.25
"""Longest time until a record is in the file [s]."""
_NAP_S = 0.02
_LAST_S = 6.0
"""Longest wait for the servo after the parent has ended: it damps for a second, and the link for
three at most [s]."""


def write_log(plan: Plan, name: str, header: dict[str, Any], talk: Connection) -> None:
    """Body of the logger's process; ends on request, or after the servo.

    `talk` sends `READY` or an error, and receives the figures of the run, JSON, at its end.
    """
    leave()
    parent = os.getppid()
    shared = Shared(name, len(plan.robot.joints))
    try:
        writer: DeployLogWriter | SweepLogs
        if plan.sweep is not None:
            writer = SweepLogs(plan.sweep)
        else:
            assert plan.log is not None
            writer = DeployLogWriter(plan.log, header)
        _write(writer, shared, talk, parent)
    except LogError as error:
        talk.send_bytes(str(error).encode())
    except OSError as error:
        why = f"the log cannot be written ({error}); free the disk or give another folder."
        talk.send_bytes(why.encode())
    finally:
        shared.close()


def _write(
    writer: DeployLogWriter | SweepLogs, shared: Shared, talk: Connection, parent: int
) -> None:
    talk.send_bytes(READY)
    flushed = time.monotonic()

    def keep() -> None:
        nonlocal flushed
        writer.drain(shared)
        if time.monotonic() - flushed >= FLUSH_S:
            writer.flush()
            flushed = time.monotonic()
        time.sleep(_NAP_S)

    while not talk.poll() and os.getppid() == parent:
        keep()
    try:
        figures = orjson.loads(talk.recv_bytes())
    except (EOFError, OSError):
        # The parent has ended. The servo damps now; that is logged too.
        figures = {}
        until = time.monotonic() + _LAST_S
        while shared.mode not in (None, Mode.ENDED) and time.monotonic() < until:
            keep()
    writer.drain(shared)
    if isinstance(writer, SweepLogs):
        # The servo has ended its log, unless it was killed.
        writer.end(figures.get("reason", "the servo's process was killed"))
    else:
        writer.end(complete=bool(figures) and not any(shared.dropped().values()), figures=figures)


_ARRAYS = (
    {name: ("steps", name) for name in STEP.names or ()}
    | {name: ("ticks", name) for name in TICK.names or () if name != "action"}
    | {
        "time": ("ticks", "begun"),
        "state_time": ("ticks", "time"),
        "state_sequence": ("ticks", "sequence"),
        "action_number": ("ticks", "action"),
        "step_time": ("steps", "begun"),
        "step_live": ("steps", "live"),
    }
)
"""Records and field of each array of a log."""
_DIFFERENCES = {
    "lateness": ("ticks", "begun", "deadline"),
    "work": ("ticks", "done", "begun"),
    "state_age": ("ticks", "begun", "time"),
    "step_lateness": ("steps", "begun", "deadline"),
    "decision": ("steps", "inferred", "observed"),
}
"""Lateness and work of a tick, age of its state, lateness of a step and the time of its network."""
_FLAGS = ("damped", "step_live", "jump")


@dataclass(frozen=True, kw_only=True)
class DeployLog:
    """A run as arrays: T ticks of the servo, P steps of the policy.

    The fields of the records (`pronk.deploy.runtime.ipc`) are attributes: of `ticks` first, then
    those of `steps` that have another name (`step_time`, `step_live`, `command`, `jump`,
    `observation`, `action`, `target`, `contact`, `linear_velocity`). `time` is the begin of a tick,
    `state_time` and `state_sequence` are of the newest state, `action_number` is of the policy's
    action; differences of times have the names of `_DIFFERENCES`. Times are on CLOCK_MONOTONIC [s],
    joints in file order; NaN where there was nothing.
    """

    header: dict[str, Any]
    ticks: NDArray[Any]
    """Records of `TICK`. (T,)"""
    steps: NDArray[Any]
    """Records of `STEP`. (P,)"""
    events: tuple[Event, ...]
    complete: bool
    """True if the end was written and no record was lost."""
    figures: dict[str, Any]
    """Of the run, from the end; empty if the log was cut."""
    damage: str
    """What ended the reading early; empty if nothing did."""
    source: str
    sha256: str

    def __getattr__(self, name: str) -> NDArray[Any]:
        """An array by its name."""
        if name in _DIFFERENCES:
            which, end, begin = _DIFFERENCES[name]
            return np.asarray(getattr(self, which)[end] - getattr(self, which)[begin])
        if name not in _ARRAYS:
            raise AttributeError(name)
        which, field = _ARRAYS[name]
        found: NDArray[Any] = getattr(self, which)[field]
        return found.astype(bool) if name in _FLAGS else found

    @property
    def virtual(self) -> bool:
        """Whether the robot was the virtual one."""
        return any(event.kind == "robot" and event.text == VIRTUAL for event in self.events)

    @property
    def joints(self) -> tuple[str, ...]:
        """In file order."""
        return tuple(self.header["joints"])


def is_deploy_log(path: Path) -> bool:
    """Whether the first message of a file is the header of a deployment's log."""
    with suppress(OSError, DamagedError, StopIteration), path.open("rb") as file:
        first = next(chain.from_iterable(records(file, path.stat().st_size)))
        return first.topic == _HEADER
    return False


def read_deploy_log(path: Path) -> DeployLog:
    """Read a log; one that was cut anywhere gives what came before.

    Raises:
        LogError: Not a deployment's log, or cut before its first tick.
    """
    messages: dict[str, list[Any]] = {topic: [] for topic in TOPICS}
    messages[_TICK], messages[_STEP] = [np.empty(0, TICK)], [np.empty(0, STEP)]
    damage = ""
    try:
        try:
            with path.open("rb") as file:
                for batch in records(file, path.stat().st_size, MOST_BYTES):
                    _take(messages, batch)
        except DamagedError as error:
            damage = str(error)
        if not messages[_HEADER]:
            raise LogError(
                f"{path}: not a log of a deployment; `pronk deploy POLICY --log FILE` writes one."
            )
        header = messages[_HEADER][0]
        if header.get("schema") != SCHEMA:
            raise LogError(f"{path}: schema {header.get('schema')!r}; this pronk reads {SCHEMA!r}.")
        ticks, steps = np.concatenate(messages[_TICK]), np.concatenate(messages[_STEP])
        if not len(ticks):
            raise LogError(f"{path}: cut before the first tick; nothing to read.")
        end = messages[_END][0] if messages[_END] else {}
        return DeployLog(
            header=header,
            ticks=ticks,
            steps=steps,
            events=tuple(Event(**row) for row in messages[_EVENT]),
            complete=bool(end.get("complete", False)) and not damage,
            figures=end.get("figures", {}),
            damage=damage,
            source=str(path),
            sha256=sha256(path),
        )
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except _WRONG as error:
        raise LogError(
            f"{path}: its messages are not those of {SCHEMA} ({type(error).__name__})."
        ) from None


def _take(messages: dict[str, list[Any]], batch: list[Record]) -> None:
    """Add the messages of a chunk, ticks and steps as arrays."""
    for topic, found in messages.items():
        data = [record.data for record in batch if record.topic == topic]
        # One parse for all of them: four times faster than one by one.
        rows = orjson.loads(b"[" + b",".join(data) + b"]")
        kind = {_TICK: TICK, _STEP: STEP}.get(topic)
        found += rows if kind is None or not rows else [_table(rows, kind)]


def _table(rows: list[dict[str, Any]], kind: np.dtype[Any]) -> NDArray[Any]:
    """Messages as records; null becomes NaN. Raises one of `_WRONG` for other messages."""
    table = np.zeros(len(rows), dtype=kind)
    for name in kind.names or ():
        of = kind[name]
        values = np.array([row[name] for row in rows], dtype=of.base)
        if values.shape != (len(rows), *of.shape):
            raise ValueError(f"{name} has the shape {values.shape[1:]}")
        table[name] = values
    return table
