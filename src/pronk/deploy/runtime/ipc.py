"""Shared memory between the processes of a run: mailboxes and queues of NumPy records.

A mailbox holds the newest record of one writer; a ring is a bounded queue with one writer and one
reader. They have no locks, so that a process that is killed at any moment cannot block another.
Every slot carries a number and a checksum: a reader detects a half-written slot on any processor.
Times are CLOCK_MONOTONIC in seconds, the same for all processes of a computer.
"""

from __future__ import annotations

import os
import signal
import zlib
from contextlib import suppress
from dataclasses import dataclass, fields
from enum import IntEnum
from multiprocessing import shared_memory
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Self

import numpy as np
import orjson
from numpy.typing import NDArray

from pronk.deploy.runtime.modes import Mode
from pronk.deploy.runtime.safety import FilterAction, Reason
from pronk.errors import HardwareError
from pronk.policy.observation import JOINTS, MEASURED_SIZE
from pronk.robots.machine import State

Record = np.ndarray[Any, Any] | np.void
_FOLDER = Path("/dev/shm")
"""Of shared memory, on Linux."""


def block(record: np.dtype[Any], slots: int) -> np.dtype[Any]:
    """The memory of a mailbox or ring: records written, taken and dropped, and the slots."""
    slot = np.dtype([("number", "<u8"), ("checksum", "<u8"), ("record", record)], align=True)
    return np.dtype([("counts", "<u8", 3), ("slots", slot, slots)], align=True)


class _Slots:
    """Numbered records in a piece of shared memory of the type `block`."""

    def __init__(self, memory: NDArray[Any]) -> None:
        self._counts = memory["counts"]
        self._number, self._checksum, self._records = (
            memory["slots"][name] for name in ("number", "checksum", "record")
        )

    @property
    def written(self) -> int:
        """Records written so far."""
        return int(self._counts[0])

    @property
    def dropped(self) -> int:
        """Records that did not fit."""
        return int(self._counts[2])

    def close(self) -> None:
        """Release the memory; closing twice has no effect."""
        vars(self).clear()

    def _store(self, record: Record) -> None:
        number = self.written
        place = number % len(self._records)
        self._number[place] = 0
        self._records[place] = record
        self._checksum[place] = zlib.crc32(record.tobytes(), number + 1 & 0xFFFFFFFF)
        self._number[place] = self._counts[0] = number + 1

    def _load(self, number: int) -> np.void | None:
        """Record `number`, or None if its slot holds another or is half written."""
        place = number % len(self._records)
        data = self._records[place].tobytes()
        checksum = zlib.crc32(data, number + 1 & 0xFFFFFFFF)
        if self._number[place] != number + 1 or self._checksum[place] != checksum:
            return None
        record: np.void = np.frombuffer(data, dtype=self._records.dtype)[0]
        return record


class Mailbox(_Slots):
    """The newest record of one writer."""

    def write(self, record: Record) -> None:
        """Replace the record."""
        self._store(record)

    def read(self) -> np.void | None:
        """The newest record; None before the first, or if the writer is too fast to be read."""
        for _ in range(8):
            if not self.written:
                break
            record = self._load(self.written - 1)
            if record is not None:
                return record
        return None


class Ring(_Slots):
    """A bounded queue. Records that do not fit are dropped and counted; the writer never waits."""

    def put(self, record: Record) -> bool:
        """Add a record; False if it did not fit."""
        fits = self.written - int(self._counts[1]) < len(self._records)
        if fits:
            self._store(record)
        else:
            self._counts[2] += np.uint64(1)
        return fits

    def take(self, most: int = 4096) -> list[np.void]:
        """Remove and return the oldest records, `most` at a time."""
        taken = int(self._counts[1])
        found: list[np.void] = []
        while taken < self.written and len(found) < most:
            record = self._load(taken)
            if record is None:
                break  # not yet visible in full
            found.append(record)
            taken += 1
            self._counts[1] = taken
        return found


def _fields(kind: str, names: str, *shape: int) -> list[Any]:
    """Fields of a record that have the same type and shape."""
    return [(name, f"<{kind}", shape) for name in names.split()]


def _state(joints: int) -> list[Any]:
    return [
        *_fields("i8", "sequence"),
        *_fields("f8", "time bus_voltage robot_time"),
        *_fields("f8", "position velocity torque temperature", joints),
        *_fields("f8", "gyro accelerometer", 3),
        *_fields("f8", "orientation", 4),
    ]


def state_dtype(joints: int) -> np.dtype[Any]:
    """Servo to all, every tick: the newest state, the time of tick 0 (`start`) and of this one.

    And the mode, the number of mode changes (`entry`) and the share of a sweep that is done.
    """
    more = _fields("f8", "now start progress") + _fields("i8", "mode entry")
    return np.dtype(_state(joints) + more)


ACTIONS = np.dtype(
    _fields("i8", "sequence state_sequence entry")
    + _fields("f8", "state_time made valid_for")
    + _fields("f8", "position", JOINTS)
)
"""Policy to servo: joint targets, and the `entry` of the state record they were computed from."""

STANDBY = np.dtype(_fields("f8", "time"))
"""Standby process to operator: when it began to damp (CLOCK_MONOTONIC) [s]."""

OPERATOR = np.dtype(
    _fields("f8", "time")
    + _fields("i8", "request requests held jump")
    + _fields("f8", "command", 3)
)
"""Operator to servo and policy: the last request and their count, dead-man button, velocity command
and jump input."""

TICK = np.dtype(
    _state(JOINTS)
    + _fields("i8", "tick mode damped level reason action action_state")
    + _fields("f8", "deadline begun done blend stiffness latency")
    + _fields("f8", "desired sent", JOINTS)
)
"""Servo to logger, every tick: the state, the targets before (`desired`) and after (`sent`) the
safety filter. `blend` is the policy's share of the target, `stiffness` that of the drives',
`action` the number of the policy's action in force (-1: none), `latency` the time from the state of
a new action to its command on the wire (NaN: no new action)."""

STEP = np.dtype(
    _fields("i8", "sequence state_sequence live jump")
    + _fields("f8", "deadline begun observed inferred done state_time")
    + _fields("f8", "command", 3)
    + _fields("f8", "target", JOINTS)
    + _fields("f4", "observation", MEASURED_SIZE)
    + _fields("f4", "action", JOINTS)
    + _fields("f4", "contact", 4)
    + _fields("f4", "linear_velocity", 3)
)
"""Policy to logger, every step."""


class SampleKind(IntEnum):
    """What a record of `SAMPLE` holds."""

    SAMPLE = 0
    OPEN = 1
    """A log begins; `number` is its index in the task, `text` the kind of torque."""
    SEGMENT = 2
    """An excitation begins; `number` is its index in the log."""
    END = 3
    """The log ends; `text` is the reason, empty if it is complete."""


TEXT = 240
"""Longest text of a record."""


def sample_dtype(joints: int) -> np.dtype[Any]:
    """Servo to logger during a sweep, in the order of its log; `kind` is a `SampleKind`.

    `number` of a sample is the index of its excitation, -1 between excitations.
    """
    return np.dtype(
        _fields("i8", "kind number virtual")
        + _fields("f8", "time frequency")
        + _fields("f8", "command position velocity torque", joints)
        + _fields(f"S{TEXT}", "text")
    )


EVENT = np.dtype(
    _fields("f8", "time") + _fields("i8", "reason level") + [("kind", "S16"), ("text", f"S{TEXT}")]
)
"""Servo or policy to logger and operator: something happened; `kind` as in `Event`."""
VIRTUAL, REAL = "the virtual robot", "a real robot"
"""Text of the event `robot`."""


def fill(record: NDArray[Any], **values: Any) -> None:
    """Set fields of a record."""
    for name, value in values.items():
        record[name] = value


def event(
    time: float, kind: str, text: str, *, reason: int = 0, level: int = 0
) -> np.ndarray[Any, Any]:
    """Make a record of `EVENT`; the text is cut to `TEXT` characters."""
    record = np.zeros((), dtype=EVENT)
    data = text.encode("ascii", "replace")[:TEXT]
    fill(record, time=time, kind=kind, reason=reason, level=level, text=data)
    return record


_STATE = tuple(field.name for field in fields(State))


def put_state(record: NDArray[Any], state: State) -> None:
    """Write a state on CLOCK_MONOTONIC into a record that begins with one; NaN for None."""
    for name in _STATE:
        value = getattr(state, name)
        record[name] = np.nan if value is None else value


def get_state(record: np.void) -> State:
    """Read the state in a record."""
    values: dict[str, Any] = {name: record[name] for name in _STATE}
    values |= {name: record[name].item() for name in ("time", "sequence", "robot_time")}
    for name in ("robot_time", "temperature"):
        if np.isnan(values[name]).all():
            values[name] = None
    return State(**values)


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that happened, as the operator's program and the log's reader have it."""

    time: float
    """CLOCK_MONOTONIC [s]."""
    kind: str
    """`mode`, `fault`, `refused`, `notice`, `lost`, `system`, `robot`, `policy`, `clamp`, `log`."""
    text: str
    reason: str = Reason.NONE.name
    """Name of a `Reason`."""
    level: str = FilterAction.PASS.name
    """Name of a `FilterAction`."""

    @classmethod
    def of(cls, record: np.void) -> Self:
        """Read a record of `EVENT`."""
        return cls(
            time=float(record["time"]),
            kind=bytes(record["kind"]).decode("ascii"),
            text=bytes(record["text"]).decode("ascii"),
            reason=Reason(int(record["reason"])).name,
            level=FilterAction(int(record["level"])).name,
        )


def serve(process: Any, shared: Shared, end: Connection) -> None:
    """Run a process (`run`, `stop`, `figures`) to its end; send its figures, JSON."""
    signal.signal(signal.SIGTERM, lambda *_: process.stop())
    try:
        process.run()
    finally:
        with suppress(OSError):  # the parent has ended
            end.send_bytes(orjson.dumps(process.figures()))
        end.close()
        shared.close()


def _allocated(size: int) -> shared_memory.SharedMemory:
    """Make shared memory of which every page exists; HardwareError if there is too little.

    A page of a file system that has become full since would end the process that touches it.
    """
    memory = None
    try:
        memory = shared_memory.SharedMemory(create=True, size=size)
        file = _FOLDER / memory.name
        if file.exists():
            with file.open("r+b") as pages:
                os.posix_fallocate(pages.fileno(), 0, size)
    except OSError as error:
        if memory is not None:
            memory.close()
            memory.unlink()
        raise HardwareError(
            f"{size / 1e6:.1f} MB of shared memory cannot be allocated ({error.strerror}); free "
            f"{_FOLDER}, or make it larger (of a container: --shm-size 64m)."
        ) from None
    return memory


class Shared:
    """The shared memory of a run, made by its first process and attached by the others."""

    state: Mailbox
    actions: Mailbox
    operator: Mailbox
    standby: Mailbox
    ticks: Ring
    """Four seconds of them fit."""
    samples: Ring
    steps: Ring
    events: Ring
    """Servo to logger."""
    policy_events: Ring
    """Policy to logger."""
    events_seen: Ring
    """Servo to operator."""

    def __init__(self, name: str | None = None, joints: int = JOINTS) -> None:
        """Make it, or attach to the one of this name; `joints` of the robot.

        HardwareError if there is too little memory to make it.
        """
        state, sample = state_dtype(joints), sample_dtype(joints)
        mailboxes = {"state": state, "actions": ACTIONS, "operator": OPERATOR, "standby": STANDBY}
        rings = {"ticks": (TICK, 2048), "samples": (sample, 2048), "steps": (STEP, 256)}
        rings |= dict.fromkeys(("events", "policy_events", "events_seen"), (EVENT, 256))
        # The writer of a mailbox is always two slots or more from the one that is read.
        slots = {each: (record, 4) for each, record in mailboxes.items()} | rings
        layout = np.dtype([(each, block(*given)) for each, given in slots.items()], align=True)
        # A child shares its parent's resource tracker, so nothing is removed when it ends.
        self._memory = (
            _allocated(layout.itemsize) if name is None else shared_memory.SharedMemory(name=name)
        )
        # Map every page now: the loop takes no page faults later.
        np.ndarray(layout.itemsize, np.uint8, buffer=self._memory.buf)[::4096].max()
        self._owner = name is None
        self.name = self._memory.name
        """Other processes attach by it."""
        memory: NDArray[Any] = np.ndarray((), dtype=layout, buffer=self._memory.buf)
        for each in slots:
            setattr(self, each, (Mailbox if each in mailboxes else Ring)(memory[each]))

    @property
    def mode(self) -> Mode | None:
        """The servo's newest; None before the first."""
        record = self.state.read()
        return None if record is None else Mode(int(record["mode"]))

    def dropped(self) -> dict[str, int]:
        """Records that did not fit into the queues to the logger."""
        names = ("ticks", "steps", "events", "samples")
        return {name: getattr(self, name).dropped for name in names}

    def close(self) -> None:
        """Release the memory; the process that made it also removes it."""
        for slots in vars(self).values():
            if isinstance(slots, _Slots):
                slots.close()
        self._memory.close()
        if self._owner:
            self._memory.unlink()
            self._owner = False
