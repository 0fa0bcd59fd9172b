"""A deployment's log, MCAP, read back as arrays; `pronk.runtime.log` writes it.

Each message is JSON with its schema in the file, so that Foxglove and PlotJuggler show it as it
is. `t` is CLOCK_MONOTONIC in seconds, the clock of everything that is measured; the messages' log
time is the wall clock.

    /deploy/header       once, first: robot, joints, policy, limits
    /deploy/state        500 Hz: the newest state at a tick
    /deploy/desired      500 Hz: joint targets before the filter, the policy's share, the mode
    /deploy/sent         500 Hz: joint targets behind it, the decision, or damping
    /deploy/timing       500 Hz: lateness, age of the state, latency of a new action
    /deploy/observation  50 Hz: what the network read
    /deploy/action       50 Hz: its action, and the operator's command
    /deploy/event        mode changes, faults, refusals, what the operating system granted, and
                         whether the robot is virtual
    /deploy/end          last: the figures of the run; a log without it was cut
"""

from __future__ import annotations

import os
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import orjson
from mcap.writer import CompressionType, IndexType, Writer
from numpy.typing import DTypeLike, NDArray

from pronk.errors import LogError
from pronk.files import sha256
from pronk.links.terminal import leave
from pronk.policy.layout import MEASURED_SIZE
from pronk.runtime.ipc import VIRTUAL, Mode, Names, Shared
from pronk.runtime.plan import Plan
from pronk.runtime.safety import FilterAction, Reason
from pronk.runtime.sweep import SweepLogs

if TYPE_CHECKING:
    from pronk.logs.mcap_stream import Record

SCHEMA = "pronk/deploy/2"
ROOT = "/deploy/"

_N: dict[str, Any] = {"type": "number"}
_I: dict[str, Any] = {"type": "integer"}
_S: dict[str, Any] = {"type": "string"}
_B: dict[str, Any] = {"type": "boolean"}
_NS: dict[str, Any] = {"type": "array", "items": {"type": "number"}}
# Foxglove reads the properties of every object; without them it refuses the channel.
_O: dict[str, Any] = {"type": "object", "properties": {}}

TOPICS: dict[str, dict[str, dict[str, Any]]] = {
    "header": {"schema": _S, "robot": _S, "joints": {"type": "array", "items": _S}}
    | {"link": _S, "policy": _O, "limits": _O, "timing": _O, "versions": _O},
    "state": {"t": _N, "sequence": _I, "position": _NS, "velocity": _NS, "torque": _NS}
    | {"gyro": _NS, "accelerometer": _NS, "orientation": _NS, "bus_voltage": _N}
    | {"robot_time": _N, "temperature": _NS},
    "desired": {"t": _N, "tick": _I, "mode": _I, "mode_name": _S, "position": _NS, "blend": _N}
    | {"action": _I, "state_sequence": _I},
    "sent": {"t": _N, "tick": _I, "position": _NS, "stiffness": _N, "damped": _B, "level": _I}
    | {"reason": _I, "reason_name": _S},
    "timing": {"t": _N, "tick": _I, "lateness": _N, "work": _N, "state_age": _N, "latency": _N},
    "observation": {"t": _N, "step": _I, "state_sequence": _I, "observation": _NS},
    "action": {"t": _N, "step": _I, "live": _B, "command": _NS, "jump": _B, "action": _NS}
    | {"target": _NS, "contact": _NS, "linear_velocity": _NS, "lateness": _N, "decision": _N}
    | {"state_age": _N},
    "event": {"t": _N, "kind": _S, "text": _S, "reason": _S, "level": _S},
    "end": {"complete": _B, "figures": _O},
}
"""Topic to the fields of its messages."""


@dataclass(frozen=True, kw_only=True)
class Field:
    """Where a column's numbers come from."""

    topic: str
    key: str
    """Of the messages' objects."""
    shape: tuple[int, ...] = ()
    """Of one message's value."""
    dtype: DTypeLike = np.float64


JOINTS = (-1,)
"""Stands for the shape of one number a joint."""
TICKS = {
    "time": Field(topic="desired", key="t"),
    "tick": Field(topic="desired", key="tick", dtype=np.int64),
    "mode": Field(topic="desired", key="mode", dtype=np.int64),
    "state_time": Field(topic="state", key="t"),
    "state_sequence": Field(topic="state", key="sequence", dtype=np.int64),
    "position": Field(topic="state", key="position", shape=JOINTS),
    "velocity": Field(topic="state", key="velocity", shape=JOINTS),
    "torque": Field(topic="state", key="torque", shape=JOINTS),
    "gyro": Field(topic="state", key="gyro", shape=(3,)),
    "accelerometer": Field(topic="state", key="accelerometer", shape=(3,)),
    "orientation": Field(topic="state", key="orientation", shape=(4,)),
    "bus_voltage": Field(topic="state", key="bus_voltage"),
    "desired": Field(topic="desired", key="position", shape=JOINTS),
    "sent": Field(topic="sent", key="position", shape=JOINTS),
    "blend": Field(topic="desired", key="blend"),
    "stiffness": Field(topic="sent", key="stiffness"),
    "damped": Field(topic="sent", key="damped", dtype=np.bool_),
    "level": Field(topic="sent", key="level", dtype=np.int64),
    "reason": Field(topic="sent", key="reason", dtype=np.int64),
    "action_number": Field(topic="desired", key="action", dtype=np.int64),
    "lateness": Field(topic="timing", key="lateness"),
    "work": Field(topic="timing", key="work"),
    "state_age": Field(topic="timing", key="state_age"),
    "latency": Field(topic="timing", key="latency"),
}
"""Arrays of `DeployLog` that have one row a tick, and where they come from."""
STEPS = {
    "step_time": Field(topic="action", key="t"),
    "step_live": Field(topic="action", key="live", dtype=np.bool_),
    "step_lateness": Field(topic="action", key="lateness"),
    "decision": Field(topic="action", key="decision"),
    "step_state_age": Field(topic="action", key="state_age"),
    "command": Field(topic="action", key="command", shape=(3,)),
    "jump": Field(topic="action", key="jump", dtype=np.bool_),
    "observation": Field(topic="observation", key="observation", shape=(MEASURED_SIZE,)),
    "action": Field(topic="action", key="action", shape=JOINTS),
    "target": Field(topic="action", key="target", shape=JOINTS),
    "contact": Field(topic="action", key="contact", shape=(4,)),
    "linear_velocity": Field(topic="action", key="linear_velocity", shape=(3,)),
}
"""Those that have one row a step of the policy."""


_FIRST = 1024
"""Rows that a column has room for at first."""
_GROWTH = 1.5


class Column:
    """Rows of numbers, with room for more."""

    def __init__(self, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        """Begin without rows."""
        # Pages that are never written to cost no memory.
        self._room: NDArray[Any] = np.empty((_FIRST, *shape), dtype)
        self.count = 0
        """Rows so far."""

    def extend(self, rows: Sequence[Any]) -> None:
        """Add rows; None among numbers becomes NaN.

        Raises:
            TypeError: Something is no number.
            ValueError: Something is no number, or a row has another shape.
        """
        new = np.array(rows, dtype=self._room.dtype)
        if new.shape[1:] != self._room.shape[1:]:
            raise ValueError(f"rows of the shape {new.shape[1:]}")
        end = self.count + len(new)
        if end > len(self._room):
            more = np.empty((max(end, int(_GROWTH * len(self._room))), *new.shape[1:]), new.dtype)
            more[: self.count] = self.rows(self.count)
            self._room = more
        self._room[self.count : end] = new
        self.count = end

    def rows(self, most: int) -> NDArray[Any]:
        """The first rows, `most` of them or as many as there are, where they lie."""
        return self._room[: min(most, self.count)]


class Columns:
    """Columns of several topics; messages of which nothing is wanted are counted, not parsed."""

    def __init__(self, fields: Mapping[str, Field], wanted: Collection[str]) -> None:
        """Begin without rows.

        Args:
            fields: Name of a column to where it comes from.
            wanted: Those to fill; the others stay without rows.
        """
        self._columns = {name: Column(of.shape, of.dtype) for name, of in fields.items()}
        self._of: dict[str, list[tuple[str, Column]]] = {}
        for name in wanted:
            of = fields[name]
            self._of.setdefault(of.topic, []).append((of.key, self._columns[name]))
        self.counts: dict[str, int] = {}
        """Messages of each topic so far."""

    def take(self, chunk: Mapping[str, Sequence[bytes]]) -> None:
        """Take in the messages of a chunk, JSON, by topic.

        Raises:
            KeyError: A message lacks a field.
            TypeError: A field is no number.
            ValueError: A field is no number or has another shape, or a message is no JSON.
        """
        for topic, messages in chunk.items():
            self.counts[topic] = self.counts.get(topic, 0) + len(messages)
            wanted = self._of.get(topic)
            if wanted is None or not messages:
                continue
            # One parse for all of them: four times faster than one by one.
            rows = orjson.loads(b"[" + b",".join(messages) + b"]")
            for key, column in wanted:
                column.extend([row[key] for row in rows])

    def arrays(self, counts: Mapping[str, int]) -> dict[str, NDArray[Any]]:
        """The columns by name.

        Args:
            counts: Column to how many of its rows at most.
        """
        return {name: column.rows(counts[name]) for name, column in self._columns.items()}


class DeployLogWriter:
    """Writes a log as it happens. What was flushed stays readable whatever comes after."""

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        """Open `path`, which is replaced, and write the header.

        Raises:
            LogError: The file cannot be made.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream: IO[bytes] = path.open("wb")
        except OSError as error:
            raise LogError(f"{path}: cannot be written ({error.strerror}).") from None
        self._writer = Writer(
            self._stream, compression=CompressionType.ZSTD, index_types=IndexType.ALL
        )
        self._writer.start(profile="", library="pronk")
        self._channels: dict[str, int] = {}
        for topic, properties in TOPICS.items():
            schema = {"title": f"pronk.runtime.{topic}", "type": "object", "properties": properties}
            number = self._writer.register_schema(
                f"pronk.runtime.{topic}", "jsonschema", orjson.dumps(schema)
            )
            self._channels[topic] = self._writer.register_channel(ROOT + topic, "json", number)
        self._wall = time.time() - time.monotonic()
        policy = header.get("policy") or {}
        facts = {"schema": SCHEMA, "robot": header.get("robot"), "link": header.get("link")}
        facts["policy_sha256"] = policy.get("sha256")
        self._writer.add_metadata("pronk", {key: str(value) for key, value in facts.items()})
        self._put("header", time.monotonic(), {"schema": SCHEMA, **header})
        self.flush()

    def tick(self, record: np.void) -> None:
        """One tick of the servo, a record of `TICK`."""
        begun, mode = float(record["begun"]), Mode(int(record["mode"]))
        reason = Reason(int(record["reason"]))
        head = {"t": begun, "tick": int(record["tick"])}
        state = _values(
            record,
            *("sequence", "bus_voltage", "robot_time", "position", "velocity", "torque"),
            *("gyro", "accelerometer", "orientation", "temperature"),
        )
        self._put("state", begun, {"t": float(record["time"])} | state)
        desired = _values(record, "mode", "blend", "action") | {
            "mode_name": mode.name,
            "position": record["desired"].tolist(),
            "state_sequence": int(record["action_state"]),
        }
        self._put("desired", begun, head | desired)
        sent = _values(record, "stiffness", "level", "reason") | {
            "t": float(record["done"]),
            "position": record["sent"].tolist(),
            "damped": bool(record["damped"]),
            "reason_name": reason.name,
        }
        self._put("sent", begun, head | sent)
        timing = {
            "lateness": begun - float(record["deadline"]),
            "work": float(record["done"]) - begun,
            "state_age": begun - float(record["time"]),
            "latency": float(record["latency"]),
        }
        self._put("timing", begun, head | timing)

    def step(self, record: np.void) -> None:
        """One step of the policy, a record of `STEP`."""
        begun = float(record["begun"])
        head = {"t": begun, "step": int(record["sequence"])}
        observation = _values(record, "state_sequence", "observation")
        self._put("observation", begun, head | observation)
        names = ("command", "action", "target", "contact", "linear_velocity")
        action = _values(record, *names) | {
            "live": bool(record["live"]),
            "jump": bool(record["jump"]),
            "lateness": begun - float(record["deadline"]),
            "decision": float(record["inferred"]) - float(record["observed"]),
            "state_age": begun - float(record["state_time"]),
        }
        self._put("action", begun, head | action)

    def event(self, record: np.void) -> None:
        """Something that happened, a record of `EVENT`."""
        body = {
            "t": float(record["time"]),
            "kind": bytes(record["kind"]).decode("ascii"),
            "text": bytes(record["text"]).decode("ascii"),
            "reason": Reason(int(record["reason"])).name,
            "level": FilterAction(int(record["level"])).name,
        }
        self._put("event", float(record["time"]), body)

    def flush(self) -> None:
        """Finish the chunk and hand everything to the operating system."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._stream.flush()

    def end(self, *, complete: bool, figures: dict[str, Any]) -> None:
        """Write the end and close the file."""
        self._put("end", time.monotonic(), {"complete": complete, "figures": figures})
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()

    def _put(self, topic: str, t: float, body: dict[str, Any]) -> None:
        stamp = round((t + self._wall) * 1e9)
        # NaN becomes null.
        self._writer.add_message(self._channels[topic], stamp, orjson.dumps(body), stamp)


def _values(record: np.void, *names: str) -> dict[str, Any]:
    """Fields of a record as plain numbers and lists."""
    return {name: record[name].tolist() for name in names}


READY = b"ready"
FLUSH_S = 0.25
"""Longest that something is kept from the file [s]."""
_NAP_S = 0.02
_LAST_S = 6.0
"""Longest that the servo is waited for once nobody else is there: it damps for a second, and the
link for three at most [s]."""


def write_log(plan: Plan, header: dict[str, Any], names: Names, talk: Connection) -> None:
    """Body of the logger's process; ends on request, or after the servo.

    Args:
        plan: Of the run.
        header: What is known beforehand.
        names: Of the shared memory.
        talk: Where it says that the file is open, or why not, and where the word to end comes
            from: JSON, the figures of the run.
    """
    leave()
    parent = os.getppid()
    shared = Shared(names)
    try:
        if plan.sweep is not None:
            _write(SweepLogs(plan.sweep), shared, talk, parent)
        else:
            assert plan.log is not None
            _write(DeployLogWriter(plan.log, header), shared, talk, parent)
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
        # The parent is gone. The servo damps now: that is logged too.
        figures = {}
        until = time.monotonic() + _LAST_S
        while _moving(shared) and time.monotonic() < until:
            keep()
    _drain(writer, shared)
    if isinstance(writer, SweepLogs):
        # The servo ended its log, unless it was killed.
        writer.end(complete=False, reason=figures.get("reason", "the servo's process was killed"))
        return
    writer.end(complete=bool(figures) and not any(shared.dropped().values()), figures=figures)


def _moving(shared: Shared) -> bool:
    """Whether the servo has begun and not ended."""
    record = shared.state.read()
    return record is not None and Mode(int(record["mode"])) is not Mode.ENDED


def _drain(writer: DeployLogWriter | SweepLogs, shared: Shared) -> None:
    """Everything that waits, events first: they say what the rest means."""
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


Array = NDArray[np.float64]

_WRONG = (KeyError, TypeError, ValueError, AttributeError, OverflowError)
"""What messages of another kind raise when they are read."""
_MOST_BYTES = 16 * 2**30
"""Largest size that a log may unpack to, four hours [bytes]. It is parsed chunk by chunk and only
its numbers are kept, so that a long one costs time where another reader's would cost memory."""
_NO_LOG = "not a log of a deployment; `pronk deploy POLICY --log FILE` writes one."


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


@dataclass(frozen=True, kw_only=True)
class DeployLog:
    """A deployment as arrays: T ticks of the servo, P steps of the policy.

    Times are on CLOCK_MONOTONIC [s], joints in file order; NaN where there was nothing.
    """

    header: dict[str, Any]
    time: Array
    """When each tick began. (T,)"""
    tick: NDArray[np.int64]
    """Its number. (T,)"""
    mode: NDArray[np.int64]
    """A `Mode`. (T,)"""
    state_time: Array
    """Of the newest state. (T,)"""
    state_sequence: NDArray[np.int64]
    """(T,)"""
    position: Array
    """[rad] (T, joints)"""
    velocity: Array
    """[rad/s] (T, joints)"""
    torque: Array
    """[N m] (T, joints)"""
    gyro: Array
    """[rad/s] (T, 3)"""
    accelerometer: Array
    """[m/s^2] (T, 3)"""
    orientation: Array
    """w, x, y, z (T, 4)"""
    bus_voltage: Array
    """[V] (T,)"""
    desired: Array
    """Targets before the filter [rad]. (T, joints)"""
    sent: Array
    """Targets behind it [rad]; NaN while damped. (T, joints)"""
    blend: Array
    """Share of the policy. (T,)"""
    stiffness: Array
    """Share of the drives' own. (T,)"""
    damped: NDArray[np.bool_]
    """(T,)"""
    level: NDArray[np.int64]
    """A `FilterAction`. (T,)"""
    reason: NDArray[np.int64]
    """A `Reason`. (T,)"""
    action_number: NDArray[np.int64]
    """Number of the policy's action in force; -1 for none. (T,)"""
    lateness: Array
    """(T,)"""
    work: Array
    """From the tick's begin until the command was on the wire. (T,)"""
    state_age: Array
    """(T,)"""
    latency: Array
    """From a state to the first command that answers it; NaN between. (T,)"""
    step_time: Array
    """When each policy step began. (P,)"""
    step_live: NDArray[np.bool_]
    """Whether the policy was in charge. (P,)"""
    step_lateness: Array
    """(P,)"""
    decision: Array
    """(P,)"""
    step_state_age: Array
    """(P,)"""
    command: Array
    """Commanded by the operator: forward, left [m/s], yaw rate [rad/s]. (P, 3)"""
    jump: NDArray[np.bool_]
    """(P,)"""
    observation: Array
    """(P, 105)"""
    action: Array
    """(P, joints)"""
    target: Array
    """[rad] (P, joints)"""
    contact: Array
    """Estimated. (P, 4)"""
    linear_velocity: Array
    """Estimated [m/s]. (P, 3)"""
    events: tuple[DeployEvent, ...]
    complete: bool
    """True if the end was written and says so."""
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


def is_deploy_log(path: Path) -> bool:
    """Whether a file is a deployment's log, as far as its first messages tell."""
    # Readers are imported where they are used: the process that writes starts without them.
    from pronk.logs.mcap_stream import DamagedError, records

    try:
        with path.open("rb") as file:
            for batch in records(file, path.stat().st_size):
                for record in batch:
                    return record.topic == ROOT + "header"
    except (OSError, DamagedError):
        return False
    return False


def read_deploy_log(path: Path, *, only: Collection[str] | None = None) -> DeployLog:
    """Read a log; one that was cut anywhere gives what came before.

    The file's text is read chunk by chunk and never held as a whole. A minute's arrays take 25 MB,
    of which the requested ones are kept.

    Args:
        path: The log.
        only: Names of the arrays of `DeployLog` to read; the others come without rows. None for
            all.

    Raises:
        LogError: Not a deployment's log, or cut before its first tick; or there is no such array.
    """
    from pronk.logs.mcap_stream import DamagedError, records

    wanted = set(TICKS | STEPS if only is None else only)
    if strange := wanted - set(TICKS | STEPS):
        raise LogError(
            f"{path}: unknown arrays {', '.join(sorted(strange))}; "
            f"the arrays of a log are {', '.join(TICKS | STEPS)}."
        )
    rest: dict[str, list[Any]] = {topic: [] for topic in ("event", "end")}
    header, columns, damage = None, None, ""
    try:
        with path.open("rb") as file:
            for batch in records(file, path.stat().st_size, _MOST_BYTES):
                chunk = _sorted(batch)
                if columns is None:
                    if not any(chunk.values()):
                        continue
                    header = _header(path, chunk["header"])
                    columns = Columns(_fields(len(header["joints"])), wanted)
                columns.take(chunk)
                for topic, bodies in rest.items():
                    bodies += map(orjson.loads, chunk[topic])
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except DamagedError as error:
        damage = str(error)
    except _WRONG as error:
        raise _foreign(path, error) from None
    if header is None or columns is None:
        raise LogError(f"{path}: {_NO_LOG}")
    try:
        return _assemble(path, header, columns, rest, damage)
    except _WRONG as error:
        raise _foreign(path, error) from None


def _foreign(path: Path, error: Exception) -> LogError:
    return LogError(f"{path}: its messages are not those of {SCHEMA} ({type(error).__name__}).")


def _sorted(batch: Iterable[Record]) -> dict[str, list[bytes]]:
    """The messages of a chunk by topic."""
    chunk: dict[str, list[bytes]] = {topic: [] for topic in TOPICS}
    for record in batch:
        if record.topic.startswith(ROOT) and record.topic[len(ROOT) :] in chunk:
            chunk[record.topic[len(ROOT) :]].append(record.data)
    return chunk


def _header(path: Path, bodies: list[bytes]) -> dict[str, Any]:
    """The header, which comes first."""
    if not bodies:
        raise LogError(f"{path}: {_NO_LOG}")
    header: dict[str, Any] = orjson.loads(bodies[0])
    if header.get("schema") != SCHEMA:
        raise LogError(f"{path}: schema {header.get('schema')!r}; this pronk reads {SCHEMA!r}.")
    return header


def _fields(joints: int) -> dict[str, Field]:
    """Where the arrays of a robot's log come from."""
    return {
        name: replace(of, shape=(joints,)) if of.shape == JOINTS else of
        for name, of in (TICKS | STEPS).items()
    }


def _assemble(
    path: Path, header: dict[str, Any], columns: Columns, rest: dict[str, list[Any]], damage: str
) -> DeployLog:
    # A chunk ends between any two messages: keep the ticks and steps that are there in full.
    ticks, steps = (
        min(columns.counts[topic] for topic in {of.topic for of in fields.values()})
        for fields in (TICKS, STEPS)
    )
    if not ticks:
        raise LogError(f"{path}: cut before the first tick; nothing to read.")
    end = rest["end"][0] if rest["end"] else {}
    return DeployLog(
        header=header,
        **columns.arrays(dict.fromkeys(TICKS, ticks) | dict.fromkeys(STEPS, steps)),
        events=tuple(
            DeployEvent(
                time=row["t"],
                kind=row["kind"],
                text=row["text"],
                reason=row["reason"],
                level=row["level"],
            )
            for row in rest["event"]
        ),
        complete=bool(end.get("complete", False)) and not damage,
        figures=end.get("figures", {}),
        damage=damage,
        source=str(path),
        sha256=sha256(path),
    )
