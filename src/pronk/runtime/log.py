"""The log of a run of a policy: what is recorded, the process that writes it, and the reader.

`t` is CLOCK_MONOTONIC in seconds, the clock of everything that is measured; the messages' log time
is the wall clock.

    /deploy/header       once, first: robot, joints, policy, limits
    /deploy/state        500 Hz: the newest state at a tick
    /deploy/desired      500 Hz: joint targets before the filter, the policy's share, the mode
    /deploy/sent         500 Hz: joint targets after it, the decision, or damping
    /deploy/timing       500 Hz: lateness, age of the state, latency of a new action
    /deploy/observation  50 Hz: input of the network
    /deploy/action       50 Hz: its action, and the operator's command
    /deploy/event        mode changes, faults, refusals, settings granted by the operating system,
                         and whether the robot is virtual
    /deploy/end          last: the figures of the run; a log without it was cut
"""

# ruff: noqa: RUF009 (a column is a field)

from __future__ import annotations

import os
import time
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, fields
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from numpy.typing import DTypeLike, NDArray

from pronk.errors import LogError
from pronk.files import sha256
from pronk.links.realtime import leave
from pronk.logs.mcap import (
    BOOLEAN,
    INTEGER,
    NUMBER,
    NUMBERS,
    STRING,
    STRINGS,
    DamagedError,
    McapWriter,
    records,
)
from pronk.policy.layout import MEASURED_SIZE
from pronk.runtime.ipc import VIRTUAL, Mode, Shared
from pronk.runtime.plan import Plan
from pronk.runtime.safety import FilterAction, Reason
from pronk.runtime.sweep import SweepLogs

Array = NDArray[np.float64]

SCHEMA = "pronk/deploy/2"
ROOT = "/deploy/"
# Foxglove reads the properties of every object; without them it refuses the channel.
_OBJECT: dict[str, Any] = {"type": "object", "properties": {}}
_TICK = {"t": NUMBER, "tick": INTEGER}
_STEP = {"t": NUMBER, "step": INTEGER}
TOPICS: dict[str, dict[str, Any]] = {
    "header": {"schema": STRING, "robot": STRING, "joints": STRINGS, "link": STRING}
    | {"policy": _OBJECT, "limits": _OBJECT, "timing": _OBJECT, "versions": _OBJECT},
    "state": {"t": NUMBER, "sequence": INTEGER, "bus_voltage": NUMBER, "robot_time": NUMBER}
    | {"position": NUMBERS, "velocity": NUMBERS, "torque": NUMBERS, "temperature": NUMBERS}
    | {"gyro": NUMBERS, "accelerometer": NUMBERS, "orientation": NUMBERS},
    "desired": _TICK
    | {"mode": INTEGER, "mode_name": STRING, "position": NUMBERS, "blend": NUMBER}
    | {"action": INTEGER, "state_sequence": INTEGER},
    "sent": _TICK
    | {"position": NUMBERS, "stiffness": NUMBER, "damped": BOOLEAN, "level": INTEGER}
    | {"reason": INTEGER, "reason_name": STRING},
    "timing": _TICK | {"lateness": NUMBER, "work": NUMBER, "state_age": NUMBER, "latency": NUMBER},
    "observation": _STEP | {"state_sequence": INTEGER, "observation": NUMBERS},
    "action": _STEP
    | {"live": BOOLEAN, "command": NUMBERS, "jump": BOOLEAN, "action": NUMBERS}
    | {"target": NUMBERS, "contact": NUMBERS, "linear_velocity": NUMBERS, "lateness": NUMBER}
    | {"decision": NUMBER, "state_age": NUMBER},
    "event": {"t": NUMBER, "kind": STRING, "text": STRING, "reason": STRING, "level": STRING},
    "end": {"complete": BOOLEAN, "figures": _OBJECT},
}
"""Topic to the fields of its messages."""

_WRONG = (KeyError, TypeError, ValueError, AttributeError, OverflowError)
"""Raised when messages of another kind are read."""
MOST_BYTES = 16 * 2**30
"""Largest size that a log may unpack to, four hours [bytes]. It is parsed chunk by chunk and only
its numbers are kept."""
_NO_LOG = "not a log of a deployment; `pronk deploy POLICY --log FILE` writes one."


class DeployLogWriter:
    """Writes a log as the run goes on."""

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        """Open `path`, which is replaced, and write the header.

        Raises:
            LogError: The file cannot be made.
        """
        try:
            self._file = McapWriter(path, {ROOT + name: of for name, of in TOPICS.items()})
        except OSError as error:
            raise LogError(f"{path}: cannot be written ({error.strerror}).") from None
        self._wall = time.time() - time.monotonic()
        facts = {"schema": SCHEMA, "robot": header.get("robot"), "link": header.get("link")}
        facts["policy_sha256"] = (header.get("policy") or {}).get("sha256")
        self._file.metadata({name: str(value) for name, value in facts.items()})
        self.put("header", time.monotonic(), {"schema": SCHEMA, **header})
        self.flush = self._file.flush
        self.flush()

    def put(self, topic: str, t: float, body: dict[str, Any]) -> None:
        """Write a message; `t` is CLOCK_MONOTONIC [s]."""
        self._file.put(ROOT + topic, t + self._wall, body)

    def tick(self, record: np.void) -> None:
        """Write one tick of the servo, a record of `TICK`."""
        row = _values(record)
        begun = row["begun"]
        head = {"t": begun, "tick": row["tick"]}
        self.put("state", begun, {"t": row["time"]} | _chosen(row, "state"))
        names = {"mode_name": Mode(row["mode"]).name, "position": row["desired"]}
        desired = _chosen(row, "desired") | names | {"state_sequence": row["action_state"]}
        self.put("desired", begun, head | desired)
        sent = _chosen(row, "sent") | {"t": row["done"], "position": row["sent"]}
        sent |= {"damped": bool(row["damped"]), "reason_name": Reason(row["reason"]).name}
        self.put("sent", begun, head | sent)
        timing = {
            "lateness": begun - row["deadline"],
            "work": row["done"] - begun,
            "state_age": begun - row["time"],
            "latency": row["latency"],
        }
        self.put("timing", begun, head | timing)

    def step(self, record: np.void) -> None:
        """Write one step of the policy, a record of `STEP`."""
        row = _values(record)
        begun = row["begun"]
        head = {"t": begun, "step": row["sequence"]}
        self.put("observation", begun, head | _chosen(row, "observation"))
        action = _chosen(row, "action") | {
            "live": bool(row["live"]),
            "jump": bool(row["jump"]),
            "lateness": begun - row["deadline"],
            "decision": row["inferred"] - row["observed"],
            "state_age": begun - row["state_time"],
        }
        self.put("action", begun, head | action)

    def event(self, record: np.void) -> None:
        """Write a record of `EVENT`."""
        row = _values(record)
        body = {
            "t": row["time"],
            "kind": row["kind"].decode("ascii"),
            "text": row["text"].decode("ascii"),
            "reason": Reason(row["reason"]).name,
            "level": FilterAction(row["level"]).name,
        }
        self.put("event", row["time"], body)

    def end(self, *, complete: bool, figures: dict[str, Any]) -> None:
        """Write the end and close the file."""
        self.put("end", time.monotonic(), {"complete": complete, "figures": figures})
        self._file.close()


def _values(record: np.void) -> dict[str, Any]:
    """A record as plain numbers and lists."""
    return {name: record[name].tolist() for name in record.dtype.names or ()}


def _chosen(row: dict[str, Any], topic: str) -> dict[str, Any]:
    """The fields of a topic that a record has under the same name."""
    return {name: row[name] for name in TOPICS[topic] if name in row}


READY = b"ready"
FLUSH_S = 0.25
"""Longest time until a record is in the file [s]."""
_NAP_S = 0.02
_LAST_S = 6.0
"""Longest wait for the servo after the parent has ended: it damps for a second, and the link for
three at most [s]."""


def write_log(plan: Plan, header: dict[str, Any], name: str, talk: Connection) -> None:
    """Body of the logger's process; ends on request, or after the servo.

    Args:
        plan: Of the run.
        header: Of a policy's log.
        name: Of the shared memory.
        talk: Sends `READY` or an error; receives the figures of the run, JSON, at its end.
    """
    leave()
    parent = os.getppid()
    shared = Shared(name)
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
        _drain(writer, shared)
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
        while _moving(shared) and time.monotonic() < until:
            keep()
    _drain(writer, shared)
    if isinstance(writer, SweepLogs):
        # The servo has ended its log, unless it was killed.
        writer.end(complete=False, reason=figures.get("reason", "the servo's process was killed"))
    else:
        writer.end(complete=bool(figures) and not any(shared.dropped().values()), figures=figures)


def _moving(shared: Shared) -> bool:
    """Whether the servo has begun and not ended."""
    record = shared.state.read()
    return record is not None and Mode(int(record["mode"])) is not Mode.ENDED


def _drain(writer: DeployLogWriter | SweepLogs, shared: Shared) -> None:
    """Write everything that waits, events first: they explain the rest."""
    if isinstance(writer, SweepLogs):
        for record in shared.samples.take(4096):
            writer.replay(record)
        shared.events.take()
        return
    for ring in (shared.events, shared.policy_events):
        for record in ring.take():
            writer.event(record)
    for record in shared.ticks.take(4096):
        writer.tick(record)
    for record in shared.steps.take(4096):
        writer.step(record)


@dataclass(frozen=True, kw_only=True)
class DeployEvent:
    """Something that happened."""

    time: float
    """CLOCK_MONOTONIC [s]."""
    kind: str
    """`mode`, `fault`, `refused`, `notice`, `lost`, `system`, `robot` or `policy`."""
    text: str
    reason: str
    """Name of a `Reason`."""
    level: str
    """Name of a `FilterAction`."""


_JOINTS = -1
"""Shape of one number a joint."""


def _column(
    topic: str, key: str, *shape: int, dtype: DTypeLike = np.float64, tick: bool = True
) -> Any:
    """An array of `DeployLog`: where its rows come from, and the shape of a row."""
    return field(
        metadata={"topic": topic, "key": key, "shape": shape, "dtype": dtype, "tick": tick}
    )


def _step(key: str, *shape: int, topic: str = "action", dtype: DTypeLike = np.float64) -> Any:
    """An array with one row a step of the policy."""
    return _column(topic, key, *shape, dtype=dtype, tick=False)


@dataclass(frozen=True, kw_only=True)
class DeployLog:
    """A run as arrays: T ticks of the servo, P steps of the policy.

    Times are on CLOCK_MONOTONIC [s], joints in file order; NaN where there was nothing.
    """

    header: dict[str, Any]
    time: Array = _column("desired", "t")
    """When each tick began. (T,)"""
    tick: NDArray[np.int64] = _column("desired", "tick", dtype=np.int64)
    """Its number. (T,)"""
    mode: NDArray[np.int64] = _column("desired", "mode", dtype=np.int64)
    """A `Mode`. (T,)"""
    state_time: Array = _column("state", "t")
    """Of the newest state. (T,)"""
    state_sequence: NDArray[np.int64] = _column("state", "sequence", dtype=np.int64)
    """(T,)"""
    position: Array = _column("state", "position", _JOINTS)
    """[rad] (T, joints)"""
    velocity: Array = _column("state", "velocity", _JOINTS)
    """[rad/s] (T, joints)"""
    torque: Array = _column("state", "torque", _JOINTS)
    """[N m] (T, joints)"""
    temperature: Array = _column("state", "temperature", _JOINTS)
    """Of the motors [deg C]. (T, joints)"""
    gyro: Array = _column("state", "gyro", 3)
    """[rad/s] (T, 3)"""
    accelerometer: Array = _column("state", "accelerometer", 3)
    """[m/s^2] (T, 3)"""
    orientation: Array = _column("state", "orientation", 4)
    """w, x, y, z (T, 4)"""
    bus_voltage: Array = _column("state", "bus_voltage")
    """[V] (T,)"""
    desired: Array = _column("desired", "position", _JOINTS)
    """Targets before the filter [rad]. (T, joints)"""
    sent: Array = _column("sent", "position", _JOINTS)
    """Targets after it [rad]; NaN while damped. (T, joints)"""
    blend: Array = _column("desired", "blend")
    """Share of the policy. (T,)"""
    stiffness: Array = _column("sent", "stiffness")
    """Share of the drives' own. (T,)"""
    damped: NDArray[np.bool_] = _column("sent", "damped", dtype=np.bool_)
    """(T,)"""
    level: NDArray[np.int64] = _column("sent", "level", dtype=np.int64)
    """A `FilterAction`. (T,)"""
    reason: NDArray[np.int64] = _column("sent", "reason", dtype=np.int64)
    """A `Reason`. (T,)"""
    action_number: NDArray[np.int64] = _column("desired", "action", dtype=np.int64)
    """Number of the policy's action in force; -1 for none. (T,)"""
    lateness: Array = _column("timing", "lateness")
    """(T,)"""
    work: Array = _column("timing", "work")
    """From the begin of the tick until the command was on the wire. (T,)"""
    state_age: Array = _column("timing", "state_age")
    """(T,)"""
    latency: Array = _column("timing", "latency")
    """From a state to the first command computed from it; NaN between. (T,)"""
    step_time: Array = _step("t")
    """When each policy step began. (P,)"""
    step_live: NDArray[np.bool_] = _step("live", dtype=np.bool_)
    """Whether the policy was in charge. (P,)"""
    step_lateness: Array = _step("lateness")
    """(P,)"""
    decision: Array = _step("decision")
    """Time of observation and network. (P,)"""
    step_state_age: Array = _step("state_age")
    """(P,)"""
    command: Array = _step("command", 3)
    """Commanded by the operator: forward, left [m/s], yaw rate [rad/s]. (P, 3)"""
    jump: NDArray[np.bool_] = _step("jump", dtype=np.bool_)
    """(P,)"""
    observation: Array = _step("observation", MEASURED_SIZE, topic="observation")
    """(P, 105)"""
    action: Array = _step("action", _JOINTS)
    """(P, joints)"""
    target: Array = _step("target", _JOINTS)
    """[rad] (P, joints)"""
    contact: Array = _step("contact", 4)
    """Estimated. (P, 4)"""
    linear_velocity: Array = _step("linear_velocity", 3)
    """Estimated [m/s]. (P, 3)"""
    events: tuple[DeployEvent, ...]
    complete: bool
    """True if the end was written and no record was lost."""
    figures: dict[str, Any]
    """Of the run, from the end; empty if the log was cut."""
    damage: str
    """What ended the reading early; empty if nothing did."""
    source: str
    sha256: str

    @property
    def virtual(self) -> bool:
        """Whether the robot was the virtual one."""
        return any(event.kind == "robot" and event.text == VIRTUAL for event in self.events)

    @property
    def joints(self) -> tuple[str, ...]:
        """In file order."""
        return tuple(self.header["joints"])


_COLUMNS = {each.name: each.metadata for each in fields(DeployLog) if each.metadata}


def is_deploy_log(path: Path) -> bool:
    """Whether the first message of a file is the header of a deployment's log."""
    try:
        with path.open("rb") as file:
            for batch in records(file, path.stat().st_size):
                for record in batch:
                    return record.topic == ROOT + "header"
    except (OSError, DamagedError):
        pass
    return False


def read_deploy_log(path: Path, *, only: Collection[str] | None = None) -> DeployLog:
    """Read a log; one that was cut anywhere gives what came before.

    The file's text is read chunk by chunk and never held as a whole.

    Args:
        path: The log.
        only: Names of the arrays of `DeployLog` to read; the others have no rows. None for all.

    Raises:
        LogError: Not a deployment's log, or cut before its first tick; or there is no such array.
    """
    wanted = set(_COLUMNS if only is None else only)
    if unknown := wanted - set(_COLUMNS):
        raise LogError(
            f"{path}: unknown arrays {', '.join(sorted(unknown))}; "
            f"the arrays of a log are {', '.join(_COLUMNS)}."
        )
    found = _Columns(wanted)
    damage = ""
    try:
        with path.open("rb") as file:
            for batch in records(file, path.stat().st_size, MOST_BYTES):
                found.take((record.topic, record.data) for record in batch)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except DamagedError as error:
        damage = str(error)
    except _WRONG as error:
        raise _foreign(path, error) from None
    if not found.header:
        raise LogError(f"{path}: {_NO_LOG}")
    if found.header.get("schema") != SCHEMA:
        raise LogError(
            f"{path}: schema {found.header.get('schema')!r}; this pronk reads {SCHEMA!r}."
        )
    try:
        arrays = found.arrays()
        if not found.ticks:
            raise LogError(f"{path}: cut before the first tick; nothing to read.")
        end = found.end
        return DeployLog(
            header=found.header,
            **arrays,
            events=tuple(DeployEvent(time=row.pop("t"), **row) for row in found.events),
            complete=bool(end.get("complete", False)) and not damage,
            figures=end.get("figures", {}),
            damage=damage,
            source=str(path),
            sha256=sha256(path),
        )
    except _WRONG as error:
        raise _foreign(path, error) from None


def _foreign(path: Path, error: Exception) -> LogError:
    return LogError(f"{path}: its messages are not those of {SCHEMA} ({type(error).__name__}).")


class _Columns:
    """The rows of a log so far, as an array per chunk; messages not wanted are only counted."""

    def __init__(self, wanted: Collection[str]) -> None:
        self.header: dict[str, Any] = {}
        self.events: list[dict[str, Any]] = []
        self.end: dict[str, Any] = {}
        self.ticks = 0
        self._rows: dict[str, list[NDArray[Any]]] = {name: [] for name in wanted}
        self._counts = {each["topic"]: 0 for each in _COLUMNS.values()}

    def take(self, batch: Iterable[tuple[str, bytes]]) -> None:
        """Take the messages of a chunk: topic and JSON.

        Raises:
            KeyError: A message lacks a field.
            TypeError: A field is not a number.
            ValueError: A field has another shape, or a message is not JSON.
        """
        chunk: dict[str, list[bytes]] = {}
        for topic, data in batch:
            if topic.startswith(ROOT):
                chunk.setdefault(topic.removeprefix(ROOT), []).append(data)
        for topic, messages in chunk.items():
            if topic in self._counts:
                self._take_rows(topic, messages)
            elif topic == "event":
                self.events += map(orjson.loads, messages)
            elif topic == "end":
                self.end = orjson.loads(messages[0])
            elif topic == "header" and not self.header:
                self.header = orjson.loads(messages[0])

    def _take_rows(self, topic: str, messages: list[bytes]) -> None:
        self._counts[topic] += len(messages)
        wanted = [name for name in self._rows if _COLUMNS[name]["topic"] == topic]
        if not wanted:
            return
        # One parse for all of them: four times faster than one by one.
        rows = orjson.loads(b"[" + b",".join(messages) + b"]")
        for name in wanted:
            key, dtype = _COLUMNS[name]["key"], _COLUMNS[name]["dtype"]
            values = np.array([row[key] for row in rows], dtype=dtype)  # None becomes NaN
            if values.shape[1:] != self._shape(name):
                raise ValueError(f"rows of the shape {values.shape[1:]}")
            self._rows[name].append(values)

    def _shape(self, name: str) -> tuple[int, ...]:
        joints = len(self.header["joints"])
        return tuple(joints if size == _JOINTS else size for size in _COLUMNS[name]["shape"])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The columns; a chunk ends between any two messages, so only full rows are kept."""
        whole = {True: set[int](), False: set[int]()}
        for each in _COLUMNS.values():
            whole[each["tick"]].add(self._counts[each["topic"]])
        self.ticks = min(whole[True])
        arrays = {}
        for name, each in _COLUMNS.items():
            none = np.empty((0, *self._shape(name)), each["dtype"])
            arrays[name] = np.concatenate([none, *self._rows.get(name, [])])
            arrays[name] = arrays[name][: min(whole[each["tick"]])]
        return arrays
