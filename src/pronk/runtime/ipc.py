"""Shared memory between the processes of a run: records, mailboxes and queues.

A mailbox holds the last value of something; a ring is a bounded queue. Both are plain shared memory
without locks, so that a process that is killed or stopped at any moment cannot block another. Every
slot carries a number and a checksum: a reader detects a half-written slot on any processor.

One process writes a `Mailbox` or puts into a `Ring`; any may read the mailbox, one takes from the
ring. Times are CLOCK_MONOTONIC in seconds, the same for all processes of a computer.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum
from multiprocessing import shared_memory
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pronk.links.machine import State
from pronk.policy.layout import JOINTS, MEASURED_SIZE

_HEAD = struct.Struct("<QQQ")
"""Of a block: count written, count taken, count dropped."""
_SLOT = struct.Struct("<QI")
"""Of a slot: its number, the checksum of the rest."""
_MAILBOX_SLOTS = 4
"""The writer is always two slots or more from the one that is read."""


class _Block:
    """A named piece of shared memory with equal slots."""

    def __init__(self, dtype: np.dtype[Any], slots: int, name: str | None) -> None:
        self.dtype = dtype
        self.slots = slots
        self._stride = -(-(_SLOT.size + dtype.itemsize) // 8) * 8
        size = _HEAD.size + slots * self._stride
        self._owner = name is None
        if name is None:
            self._memory = shared_memory.SharedMemory(create=True, size=size)
        else:
            # A child has its maker's resource tracker, so nothing is removed when it ends.
            self._memory = shared_memory.SharedMemory(name=name)
        buffer = self._memory.buf
        assert buffer is not None
        self._buffer: memoryview = buffer
        # Views of eight aligned bytes: written and read at once.
        self._counts = np.frombuffer(buffer, dtype=np.uint64, count=3)

    @property
    def name(self) -> str:
        """What another process attaches by."""
        return self._memory.name

    @property
    def written(self) -> int:
        """Records written so far."""
        return int(self._counts[0])

    @property
    def dropped(self) -> int:
        """Records that found no room."""
        return int(self._counts[2])

    def close(self) -> None:
        """Let go; the maker also removes it. Twice does no harm."""
        if not hasattr(self, "_counts"):
            return
        del self._counts, self._buffer
        self._memory.close()
        if self._owner:
            self._memory.unlink()

    def _store(self, number: int, data: bytes) -> None:
        start = _HEAD.size + number % self.slots * self._stride
        body = start + _SLOT.size
        _SLOT.pack_into(self._buffer, start, 0, 0)
        self._buffer[body : body + len(data)] = data
        _SLOT.pack_into(self._buffer, start, number + 1, zlib.crc32(data, number + 1 & 0xFFFFFFFF))

    def _load(self, number: int) -> bytes | None:
        """Record `number`, or None if its slot holds another or is half written."""
        start = _HEAD.size + number % self.slots * self._stride
        body = start + _SLOT.size
        data = bytes(self._buffer[body : body + self.dtype.itemsize])
        found, checksum = _SLOT.unpack_from(self._buffer, start)
        fits = found == number + 1 and zlib.crc32(data, number + 1 & 0xFFFFFFFF) == checksum
        return data if fits else None

    def _record(self, data: bytes) -> np.void:
        record: np.void = np.frombuffer(data, dtype=self.dtype)[0]
        return record


class Mailbox(_Block):
    """The newest record of one writer."""

    def __init__(self, dtype: np.dtype[Any], name: str | None = None) -> None:
        """Make one, or attach to the one called `name`."""
        super().__init__(dtype, _MAILBOX_SLOTS, name)

    @classmethod
    def attached(cls, dtype: np.dtype[Any], name: str) -> Self:
        """The mailbox that another process made."""
        return cls(dtype, name)

    def write(self, record: np.ndarray[Any, Any] | np.void) -> None:
        """Put a record of the mailbox's dtype in place of the last."""
        number = self.written
        self._store(number, record.tobytes())
        self._counts[0] = number + 1

    def read(self) -> np.void | None:
        """The newest record; None before the first, or if a writer outran every try."""
        for _ in range(8):
            written = self.written
            if not written:
                return None
            data = self._load(written - 1)
            if data is not None:
                return self._record(data)
        return None


class Ring(_Block):
    """A bounded queue. What does not fit is dropped and counted; the writer never waits."""

    def __init__(self, dtype: np.dtype[Any], slots: int, name: str | None = None) -> None:
        """Make one with room for `slots` records, or attach to the one called `name`."""
        super().__init__(dtype, slots, name)

    def put(self, record: np.ndarray[Any, Any] | np.void) -> bool:
        """Add a record of the ring's dtype; False if there was no room."""
        number = self.written
        if number - int(self._counts[1]) >= self.slots:
            self._counts[2] += np.uint64(1)
            return False
        self._store(number, record.tobytes())
        self._counts[0] = number + 1
        return True

    def take(self, most: int = 1000) -> list[np.void]:
        """Remove and return the oldest records, `most` at a time; [] if there are none."""
        taken = int(self._counts[1])
        found: list[np.void] = []
        while taken < self.written and len(found) < most:
            data = self._load(taken)
            if data is None:
                break  # not yet visible in full; it is there the next time
            found.append(self._record(data))
            taken += 1
            self._counts[1] = taken
        return found


class Mode(IntEnum):
    """What the servo is doing."""

    IDLE = 0
    """Connected or not; nothing is sent."""
    PREFLIGHT = 1
    """Looking at the states; nothing is sent."""
    DAMP = 2
    """Joints damped, waiting."""
    STAND = 3
    """On the way up, and standing there."""
    POLICY = 4
    """The policy decides."""
    HALT = 5
    """The policy decides, commanded to stand still, before it sits down."""
    SIT = 6
    """On the way down."""
    FAULT = 7
    """Joints damped by a fault."""
    SWEEP = 9
    """Joints are excited one after another."""
    ENDED = 8
    """The link is closed."""


class OperatorRequest(IntEnum):
    """Requests of the operator."""

    NONE = 0
    DAMP = 1
    """At once."""
    STAND = 2
    WALK = 3
    """Let the policy decide."""
    SIT = 4
    """Stop, sit down, damp."""
    RESET = 5
    """The cause of a latched fault is gone."""
    CLAMPED = 7
    """The joints of a sweep are clamped as reported."""
    QUIT = 6
    """Damp and leave."""


_STATE: list[Any] = [
    ("sequence", "<i8"),
    ("time", "<f8"),
    ("position", "<f8", JOINTS),
    ("velocity", "<f8", JOINTS),
    ("torque", "<f8", JOINTS),
    ("gyro", "<f8", 3),
    ("accelerometer", "<f8", 3),
    ("orientation", "<f8", 4),
    ("bus_voltage", "<f8"),
    ("robot_time", "<f8"),
    ("temperature", "<f8", JOINTS),
]

STATE = np.dtype(
    [
        *_STATE,
        ("now", "<f8"),
        ("start", "<f8"),
        ("mode", "<i8"),
        ("entry", "<i8"),
        ("progress", "<f8"),
    ]
)
"""Servo to all, every tick: the newest state, the time of tick 0, the mode and how often it has
changed."""

ACTIONS = np.dtype(
    [
        ("sequence", "<i8"),
        ("state_sequence", "<i8"),
        ("state_time", "<f8"),
        ("made", "<f8"),
        ("valid_for", "<f8"),
        ("entry", "<i8"),
        ("position", "<f8", JOINTS),
    ]
)
"""Policy to servo: joint targets; `entry` is that of the record they answer."""

OPERATOR = np.dtype(
    [
        ("time", "<f8"),
        ("request", "<i8"),
        ("requests", "<i8"),
        ("held", "<i8"),
        ("command", "<f8", 3),
        ("jump", "<i8"),
        ("seconds", "<f8"),
    ]
)
"""Operator to servo and policy: the last request and how many there were, dead-man button, velocity
command and jump input."""

TICK = np.dtype(
    [
        *_STATE,
        ("tick", "<i8"),
        ("deadline", "<f8"),
        ("begun", "<f8"),
        ("done", "<f8"),
        ("mode", "<i8"),
        ("blend", "<f8"),
        ("desired", "<f8", JOINTS),
        ("sent", "<f8", JOINTS),
        ("stiffness", "<f8"),
        ("damped", "<i8"),
        ("level", "<i8"),
        ("reason", "<i8"),
        ("action", "<i8"),
        ("action_state", "<i8"),
        ("latency", "<f8"),
    ]
)
"""Servo to logger, every tick: the state, the desired and the sent targets. `blend` is the policy's
share, `stiffness` the share of the drives' own, `action` the number of the policy's action in force
(-1: none), `latency` from the state that a new action uses to its command on the wire (NaN: no new
action)."""

STEP = np.dtype(
    [
        ("sequence", "<i8"),
        ("deadline", "<f8"),
        ("begun", "<f8"),
        ("observed", "<f8"),
        ("inferred", "<f8"),
        ("done", "<f8"),
        ("state_sequence", "<i8"),
        ("state_time", "<f8"),
        ("live", "<i8"),
        ("command", "<f8", 3),
        ("jump", "<i8"),
        ("observation", "<f4", MEASURED_SIZE),
        ("action", "<f4", JOINTS),
        ("target", "<f8", JOINTS),
        ("contact", "<f4", 4),
        ("linear_velocity", "<f4", 3),
    ]
)
"""Policy to logger, every step."""


class SampleKind(IntEnum):
    """What a record of `SAMPLE` holds."""

    SAMPLE = 0
    OPEN = 1
    """A log begins; `number` is its place in the task, `text` the torque's kind."""
    SEGMENT = 2
    """An excitation begins; `number` is its place in the log."""
    END = 3
    """The log ends; `text` says why, empty if it is whole."""


SAMPLE = np.dtype(
    [
        ("kind", "<i8"),
        ("number", "<i8"),
        ("time", "<f8"),
        ("command", "<f8", JOINTS),
        ("position", "<f8", JOINTS),
        ("velocity", "<f8", JOINTS),
        ("torque", "<f8", JOINTS),
        ("frequency", "<f8"),
        ("virtual", "<i8"),
        ("text", "S240"),
    ]
)
"""Servo to logger during a sweep, in the order of the log; `number` of a sample is that of its
excitation, -1 between."""

VIRTUAL, REAL = "the virtual robot", "a real robot"
"""Text of the event `robot`."""
TEXT = 240
EVENT = np.dtype(
    [("time", "<f8"), ("kind", "S16"), ("reason", "<i8"), ("level", "<i8"), ("text", f"S{TEXT}")]
)
"""Servo or policy to logger and operator: something happened."""


def event(
    time: float, kind: str, text: str, *, reason: int = 0, level: int = 0
) -> np.ndarray[Any, Any]:
    """An event's record; the text is cut to what fits."""
    record = np.zeros((), dtype=EVENT)
    record["time"], record["kind"], record["reason"], record["level"] = time, kind, reason, level
    record["text"] = text.encode("ascii", "replace")[:TEXT]
    return record


def put_state(record: np.ndarray[Any, Any], state: State, offset: float) -> None:
    """Write a state into a record that begins with one.

    Args:
        record: Of `STATE` or `TICK`.
        state: On the machine's clock.
        offset: CLOCK_MONOTONIC less the machine's clock [s].
    """
    for name in (
        "sequence",
        "position",
        "velocity",
        "torque",
        "gyro",
        "accelerometer",
        "orientation",
        "bus_voltage",
    ):
        record[name] = getattr(state, name)
    record["time"] = state.time + offset
    record["robot_time"] = np.nan if state.robot_time is None else state.robot_time
    record["temperature"] = np.nan if state.temperature is None else state.temperature


def get_state(record: np.void) -> State:
    """The state in a record, on CLOCK_MONOTONIC."""
    known = not np.isnan(record["temperature"]).all()
    robot_time = float(record["robot_time"])
    return State(
        time=float(record["time"]),
        sequence=int(record["sequence"]),
        position=record["position"],
        velocity=record["velocity"],
        torque=record["torque"],
        gyro=record["gyro"],
        accelerometer=record["accelerometer"],
        bus_voltage=float(record["bus_voltage"]),
        orientation=record["orientation"],
        robot_time=None if np.isnan(robot_time) else robot_time,
        temperature=record["temperature"] if known else None,
    )


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that the servo tells the operator."""

    time: float
    """CLOCK_MONOTONIC [s]."""
    kind: str
    """`mode`, `fault`, `refused`, `notice`, `lost`, `system` or `robot`."""
    text: str
    level: int
    """A `FilterAction`."""

    @classmethod
    def of(cls, record: np.void) -> Self:
        """The notice in a record of `pronk.runtime.ipc.EVENT`."""
        return cls(
            time=float(record["time"]),
            kind=bytes(record["kind"]).decode("ascii"),
            text=bytes(record["text"]).decode("ascii"),
            level=int(record["level"]),
        )


_TICKS, _STEPS, _EVENTS = 2048, 256, 256
"""Room of the queues to the logger: four seconds."""


@dataclass(frozen=True)
class Names:
    """Of the shared memory."""

    state: str
    actions: str
    operator: str
    ticks: str
    steps: str
    events: str
    policy_events: str
    samples: str
    events_seen: str


class Shared:
    """The shared memory of a deployment, made by its first process and attached by the others."""

    def __init__(self, names: Names | None = None) -> None:
        """Make it, or attach to what has these names."""

        def called(which: str) -> str | None:
            return None if names is None else str(getattr(names, which))

        self.state = Mailbox(STATE, called("state"))
        """Servo to all."""
        self.actions = Mailbox(ACTIONS, called("actions"))
        """Policy to servo."""
        self.operator = Mailbox(OPERATOR, called("operator"))
        """Operator to servo and policy."""
        self.ticks = Ring(TICK, _TICKS, called("ticks"))
        """Servo to logger."""
        self.steps = Ring(STEP, _STEPS, called("steps"))
        """Policy to logger."""
        self.events = Ring(EVENT, _EVENTS, called("events"))
        """Servo to logger."""
        self.samples = Ring(SAMPLE, _TICKS, called("samples"))
        """Servo to logger, during a sweep."""
        self.policy_events = Ring(EVENT, _EVENTS, called("policy_events"))
        """Policy to logger."""
        self.events_seen = Ring(EVENT, _EVENTS, called("events_seen"))
        """Servo to operator."""

    @property
    def names(self) -> Names:
        """For the processes that attach."""
        return Names(**{name: block.name for name, block in self._blocks().items()})

    def dropped(self) -> dict[str, int]:
        """Records that found no room on their way to the logger."""
        queues = {
            "ticks": self.ticks,
            "steps": self.steps,
            "events": self.events,
            "samples": self.samples,
        }
        return {name: ring.dropped for name, ring in queues.items()}

    def close(self) -> None:
        """Let go of everything."""
        for block in self._blocks().values():
            block.close()

    def _blocks(self) -> dict[str, Any]:
        return dict(vars(self))


@dataclass(frozen=True, kw_only=True)
class PolicyAction:
    """Joint targets of the policy, on the servo's clock."""

    sequence: int
    state_sequence: int
    state_time: float
    made: float
    valid_for: float
    entry: int
    """Of the mode that it was made for."""
    position: NDArray[np.float64]
