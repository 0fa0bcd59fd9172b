"""A deployment's log, MCAP, read back as arrays; `pronk.runtime.log_writer` writes it.

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

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.files import sha256
from pronk.runtime.columns import Columns, Field
from pronk.runtime.log_topics import JOINTS, ROOT, SCHEMA, STEPS, TICKS, TOPICS
from pronk.runtime.records import VIRTUAL

if TYPE_CHECKING:
    from pronk.logs.mcap_stream import Record

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
    of which those asked for are kept.

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
            f"{path}: asked for {', '.join(sorted(strange))}; "
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
