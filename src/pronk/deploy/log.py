"""A deployment's log: MCAP, written as it happens, read back as arrays.

Each message is JSON with its schema in the file, so that Foxglove and PlotJuggler show it as it
is. `t` is CLOCK_MONOTONIC in seconds, the clock of everything that is measured; the messages' log
time is the wall clock.

    /deploy/header       once, first: robot, joints, policy, limits
    /deploy/state        500 Hz: the newest state at a tick
    /deploy/asked        500 Hz: joint targets before the filter, the policy's share, the mode
    /deploy/sent         500 Hz: joint targets behind it, its verdict, or that the joints are damped
    /deploy/timing       500 Hz: lateness, age of the state, latency of a new order
    /deploy/observation  50 Hz: what the network read
    /deploy/action       50 Hz: what it gave, and what the operator asked for
    /deploy/event        mode changes, faults, refusals, what the operating system granted, and
                         whether the robot is virtual
    /deploy/end          last: the figures of the run; a log without it was cut
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import orjson
from mcap.writer import CompressionType, IndexType, Writer
from numpy.typing import NDArray

from pronk.deploy.reasons import Level, Reason
from pronk.deploy.records import VIRTUAL, Mode
from pronk.errors import LogError
from pronk.files import sha256

Array = NDArray[np.float64]

SCHEMA = "pronk/deploy/1"
_ROOT = "/deploy/"

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
    "asked": {"t": _N, "tick": _I, "mode": _I, "mode_name": _S, "position": _NS, "blend": _N}
    | {"order": _I, "state_sequence": _I},
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
            schema = {"title": f"pronk.deploy.{topic}", "type": "object", "properties": properties}
            number = self._writer.register_schema(
                f"pronk.deploy.{topic}", "jsonschema", orjson.dumps(schema)
            )
            self._channels[topic] = self._writer.register_channel(_ROOT + topic, "json", number)
        self._wall = time.time() - time.monotonic()
        policy = header.get("policy") or {}
        facts = {"schema": SCHEMA, "robot": header.get("robot"), "link": header.get("link")}
        facts["policy_sha256"] = policy.get("sha256")
        self._writer.add_metadata("pronk", {key: str(value) for key, value in facts.items()})
        self._put("header", time.monotonic(), {"schema": SCHEMA, **header})
        self.flush()

    def tick(self, record: np.void) -> None:
        """One tick of the servo, a record of `TICK`."""
        begun, tick = float(record["begun"]), int(record["tick"])
        state = {
            "t": float(record["time"]),
            "sequence": int(record["sequence"]),
            "bus_voltage": float(record["bus_voltage"]),
            "robot_time": float(record["robot_time"]),
        }
        for name in (
            "position",
            "velocity",
            "torque",
            "gyro",
            "accelerometer",
            "orientation",
            "temperature",
        ):
            state[name] = record[name].tolist()
        self._put("state", begun, state)
        mode = Mode(int(record["mode"]))
        asked = {
            "t": begun,
            "tick": tick,
            "mode": int(mode),
            "mode_name": mode.name,
            "position": record["asked"].tolist(),
            "blend": float(record["blend"]),
            "order": int(record["order"]),
            "state_sequence": int(record["order_state"]),
        }
        self._put("asked", begun, asked)
        reason = Reason(int(record["reason"]))
        sent = {
            "t": float(record["done"]),
            "tick": tick,
            "position": record["sent"].tolist(),
            "stiffness": float(record["stiffness"]),
            "damped": bool(record["damped"]),
            "level": int(record["level"]),
            "reason": int(reason),
            "reason_name": reason.name,
        }
        self._put("sent", begun, sent)
        timing = {
            "t": begun,
            "tick": tick,
            "lateness": begun - float(record["deadline"]),
            "work": float(record["done"]) - begun,
            "state_age": begun - float(record["time"]),
            "latency": float(record["latency"]),
        }
        self._put("timing", begun, timing)

    def step(self, record: np.void) -> None:
        """One step of the policy, a record of `STEP`."""
        begun, step = float(record["begun"]), int(record["sequence"])
        observation = {
            "t": begun,
            "step": step,
            "state_sequence": int(record["state_sequence"]),
            "observation": record["observation"].tolist(),
        }
        self._put("observation", begun, observation)
        action = {
            "t": begun,
            "step": step,
            "live": bool(record["live"]),
            "command": record["command"].tolist(),
            "jump": bool(record["jump"]),
            "action": record["action"].tolist(),
            "target": record["target"].tolist(),
            "contact": record["contact"].tolist(),
            "linear_velocity": record["linear_velocity"].tolist(),
            "lateness": begun - float(record["deadline"]),
            "decision": float(record["inferred"]) - float(record["observed"]),
            "state_age": begun - float(record["state_time"]),
        }
        self._put("action", begun, action)

    def event(self, record: np.void) -> None:
        """Something that happened, a record of `EVENT`."""
        body = {
            "t": float(record["time"]),
            "kind": bytes(record["kind"]).decode("ascii"),
            "text": bytes(record["text"]).decode("ascii"),
            "reason": Reason(int(record["reason"])).name,
            "level": Level(int(record["level"])).name,
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


@dataclass(frozen=True, kw_only=True)
class DeployEvent:
    """Something that happened."""

    time: float
    """CLOCK_MONOTONIC [s]."""
    kind: str
    """`mode`, `fault`, `refused`, `notice`, `system`, `robot` or `policy`."""
    text: str
    reason: str
    """Name of a `Reason`."""
    level: str
    """Name of a `Level`."""


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
    asked: Array
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
    """A `Level`. (T,)"""
    reason: NDArray[np.int64]
    """A `Reason`. (T,)"""
    order: NDArray[np.int64]
    """Number of the policy's order in force; -1 for none. (T,)"""
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
    """Asked by the operator: forward, left [m/s], yaw rate [rad/s]. (P, 3)"""
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
    from pronk.sweep.mcap_stream import DamagedError, records

    try:
        with path.open("rb") as file:
            for batch in records(file, path.stat().st_size):
                for record in batch:
                    return record.topic == _ROOT + "header"
    except (OSError, DamagedError):
        return False
    return False


def read_deploy_log(path: Path) -> DeployLog:
    """Read a log; one that was cut anywhere gives what came before.

    Raises:
        LogError: Not a deployment's log, or cut before its first tick.
    """
    from pronk.sweep.mcap_stream import DamagedError, records

    rows: dict[str, list[bytes]] = {topic: [] for topic in TOPICS}
    damage = ""
    try:
        with path.open("rb") as file:
            for batch in records(file, path.stat().st_size):
                for record in batch:
                    if record.topic.removeprefix(_ROOT) in rows:
                        rows[record.topic.removeprefix(_ROOT)].append(record.data)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except DamagedError as error:
        damage = str(error)
    if not rows["header"]:
        raise LogError(
            f"{path}: not a log of a deployment; `pronk deploy POLICY --log FILE` writes one."
        )
    try:
        return _assemble(path, rows, damage)
    except LogError:
        raise
    except (orjson.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        raise LogError(
            f"{path}: its messages are not those of {SCHEMA} ({type(error).__name__})."
        ) from None


def _assemble(path: Path, rows: dict[str, list[bytes]], damage: str) -> DeployLog:
    # One parse of all messages of a topic together: four times faster than one by one.
    read = {topic: orjson.loads(b"[" + b",".join(rows[topic]) + b"]") for topic in rows}
    header = read["header"][0]
    if header.get("schema") != SCHEMA:
        raise LogError(f"{path}: schema {header.get('schema')!r}; this pronk reads {SCHEMA!r}.")
    # A chunk ends between any two messages: keep the ticks and steps that are there in full.
    ticks = min(len(read[topic]) for topic in ("state", "asked", "sent", "timing"))
    steps = min(len(read[topic]) for topic in ("observation", "action"))
    if not ticks:
        raise LogError(f"{path}: cut before the first tick; nothing to read.")

    def numbers(topic: str, name: str, dtype: Any = np.float64) -> Any:
        count = steps if topic in ("observation", "action") else ticks
        return np.array([row[name] for row in read[topic][:count]], dtype=dtype)

    end = read["end"][0] if read["end"] else {}
    return DeployLog(
        header=header,
        time=numbers("asked", "t"),
        tick=numbers("asked", "tick", np.int64),
        mode=numbers("asked", "mode", np.int64),
        state_time=numbers("state", "t"),
        state_sequence=numbers("state", "sequence", np.int64),
        **{
            name: numbers("state", name)
            for name in ("position", "velocity", "torque", "gyro", "accelerometer", "orientation")
        },
        bus_voltage=numbers("state", "bus_voltage"),
        asked=numbers("asked", "position"),
        sent=numbers("sent", "position"),
        blend=numbers("asked", "blend"),
        stiffness=numbers("sent", "stiffness"),
        damped=numbers("sent", "damped", np.bool_),
        level=numbers("sent", "level", np.int64),
        reason=numbers("sent", "reason", np.int64),
        order=numbers("asked", "order", np.int64),
        **{name: numbers("timing", name) for name in ("lateness", "work", "state_age", "latency")},
        step_time=numbers("action", "t"),
        step_live=numbers("action", "live", np.bool_),
        step_lateness=numbers("action", "lateness"),
        decision=numbers("action", "decision"),
        step_state_age=numbers("action", "state_age"),
        command=numbers("action", "command").reshape(steps, 3),
        jump=numbers("action", "jump", np.bool_),
        observation=numbers("observation", "observation"),
        action=numbers("action", "action"),
        target=numbers("action", "target"),
        contact=numbers("action", "contact"),
        linear_velocity=numbers("action", "linear_velocity"),
        events=tuple(
            DeployEvent(
                time=row["t"],
                kind=row["kind"],
                text=row["text"],
                reason=row["reason"],
                level=row["level"],
            )
            for row in read["event"]
        ),
        complete=bool(end.get("complete", False)) and not damage,
        figures=end.get("figures", {}),
        damage=damage,
        source=str(path),
        sha256=sha256(path),
    )
