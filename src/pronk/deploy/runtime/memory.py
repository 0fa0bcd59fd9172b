"""Shared memory between the processes of a run: mailboxes and queues of records.

A mailbox holds the newest record of one writer; a ring is a bounded queue with one writer and one
reader. They have no locks, so that a process that is killed at any moment cannot block another.
Every slot carries a number and a checksum: a reader detects a half-written slot on any processor.
`memory_dtype` declares all of them.
"""

from __future__ import annotations

import os
import zlib
from multiprocessing import shared_memory
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.deploy.runtime.modes import Mode
from pronk.deploy.runtime.records import (
    ACTIONS,
    EVENT,
    OPERATOR,
    REQUEST,
    STANDBY,
    STEP,
    TICK,
    Record,
    sample_dtype,
    state_dtype,
)
from pronk.errors import HardwareError
from pronk.policy.observation import JOINTS

_FOLDER = Path("/dev/shm")
"""Folder of shared memory, on Linux."""
_PAGE_SIZE = 4096
"""Size of a page of memory [bytes]."""
_READS = 8
"""Times that a mailbox is read before its writer counts as too fast."""

MAILBOX_SLOTS = 4
"""Slots of a mailbox: its writer is always two slots or more from the one that is read."""
TICK_SLOTS = 2048
"""Ticks, and samples of a sweep, that wait for the logger: four seconds of them."""
STEP_SLOTS = 256
"""Steps of the policy that wait for the logger."""
EVENT_SLOTS = 256
"""Events that wait for the logger or the operator."""
REQUEST_SLOTS = 256
"""Requests of the operator that wait for the servo: five seconds of them at 50 Hz."""


def slots_dtype(record: np.dtype[Any], slots: int) -> np.dtype[Any]:
    """Return the memory of a mailbox or ring: its counts and its slots.

    The counts are of the records written, taken and dropped.
    """
    slot = np.dtype([("number", "<u8"), ("checksum", "<u8"), ("record", record)], align=True)
    return np.dtype([("counts", "<u8", (3,)), ("slots", slot, (slots,))], align=True)


def memory_dtype(joints: int) -> np.dtype[Any]:
    """Return the layout of the shared memory of a run, for a robot of so many joints."""
    sample = sample_dtype(joints)
    return np.dtype(
        [
            # Mailboxes.
            ("state", slots_dtype(state_dtype(joints), MAILBOX_SLOTS)),
            ("actions", slots_dtype(ACTIONS, MAILBOX_SLOTS)),
            ("operator", slots_dtype(OPERATOR, MAILBOX_SLOTS)),
            ("standby", slots_dtype(STANDBY, MAILBOX_SLOTS)),
            # Rings.
            ("ticks", slots_dtype(TICK, TICK_SLOTS)),
            ("samples", slots_dtype(sample, TICK_SLOTS)),
            ("steps", slots_dtype(STEP, STEP_SLOTS)),
            ("events", slots_dtype(EVENT, EVENT_SLOTS)),
            ("policy_events", slots_dtype(EVENT, EVENT_SLOTS)),
            ("events_seen", slots_dtype(EVENT, EVENT_SLOTS)),
            ("requests", slots_dtype(REQUEST, REQUEST_SLOTS)),
        ],
        align=True,
    )


class _Slots:
    """Numbered records in a piece of shared memory of the type `slots_dtype`."""

    def __init__(self, memory: NDArray[Any]) -> None:
        """Use a piece of memory."""
        self._bind(memory)

    def _bind(self, memory: NDArray[Any]) -> None:
        """Take the parts of a piece of memory."""
        self._counts = memory["counts"]
        self._numbers = memory["slots"]["number"]
        self._checksums = memory["slots"]["checksum"]
        self._records = memory["slots"]["record"]

    @property
    def written(self) -> int:
        """Number of records written so far."""
        return int(self._counts[0])

    @property
    def dropped(self) -> int:
        """Number of records that did not fit."""
        return int(self._counts[2])

    def close(self) -> None:
        """Release the memory; closing twice has no effect."""
        # One private slot takes its place, so that nothing points into the memory any more.
        self._bind(np.zeros((), dtype=slots_dtype(self._records.dtype, 1)))

    def _store(self, record: Record) -> None:
        """Write a record into the next slot."""
        number = self.written
        slot = number % len(self._records)
        self._numbers[slot] = 0
        self._records[slot] = record
        self._checksums[slot] = zlib.crc32(record.tobytes(), number + 1 & 0xFFFFFFFF)
        self._numbers[slot] = number + 1
        self._counts[0] = number + 1

    def _load(self, number: int) -> np.void | None:
        """Return record `number`, or None if its slot holds another or is half written."""
        slot = number % len(self._records)
        data = self._records[slot].tobytes()
        checksum = zlib.crc32(data, number + 1 & 0xFFFFFFFF)
        if self._numbers[slot] != number + 1 or self._checksums[slot] != checksum:
            return None
        record: np.void = np.frombuffer(data, dtype=self._records.dtype)[0]
        return record


class Mailbox(_Slots):
    """The newest record of one writer."""

    def write(self, record: Record) -> None:
        """Replace the record."""
        self._store(record)

    def read(self) -> np.void | None:
        """Return the newest record; None before the first, or if the writer is too fast."""
        for _ in range(_READS):
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

    def take(self, count: int = 4096) -> list[np.void]:
        """Remove and return the oldest records, at most `count`."""
        taken = int(self._counts[1])
        records: list[np.void] = []
        while taken < self.written and len(records) < count:
            record = self._load(taken)
            if record is None:
                break  # not yet visible in full
            records.append(record)
            taken += 1
            self._counts[1] = taken
        return records


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

    def __init__(self, name: str | None = None, joints: int = JOINTS) -> None:
        """Make the memory, or attach to the one of this name.

        Args:
            name: Name of memory that exists; None makes it.
            joints: Number of joints of the robot.

        Raises:
            HardwareError: There is too little memory to make it.
        """
        layout = memory_dtype(joints)
        # A child shares its parent's resource tracker, so nothing is removed when it ends.
        if name is None:
            self._memory = _allocated(layout.itemsize)
        else:
            self._memory = shared_memory.SharedMemory(name=name)
        # Map every page now: the loop takes no page faults later.
        np.ndarray(layout.itemsize, np.uint8, buffer=self._memory.buf)[::_PAGE_SIZE].max()
        self._owner = name is None
        self.name = self._memory.name
        """Name by which other processes attach."""
        memory: NDArray[Any] = np.ndarray((), dtype=layout, buffer=self._memory.buf)
        self.state = Mailbox(memory["state"])
        """Servo to all: `state_dtype`."""
        self.actions = Mailbox(memory["actions"])
        """Policy to servo: `ACTIONS`."""
        self.operator = Mailbox(memory["operator"])
        """Operator to servo and policy: `OPERATOR`."""
        self.standby = Mailbox(memory["standby"])
        """Standby process to servo and operator: `STANDBY`."""
        self.ticks = Ring(memory["ticks"])
        """Servo to logger, in a policy's run: `TICK`."""
        self.samples = Ring(memory["samples"])
        """Servo to logger, in a sweep: `sample_dtype`."""
        self.steps = Ring(memory["steps"])
        """Policy to logger: `STEP`."""
        self.events = Ring(memory["events"])
        """Servo to logger: `EVENT`."""
        self.policy_events = Ring(memory["policy_events"])
        """Policy to logger: `EVENT`."""
        self.events_seen = Ring(memory["events_seen"])
        """Servo to operator: `EVENT`."""
        self.requests = Ring(memory["requests"])
        """Operator to servo: `REQUEST`. In a mailbox a later request would replace one that the
        servo has not read yet."""

    @property
    def mode(self) -> Mode | None:
        """Newest mode of the servo; None before the first."""
        record = self.state.read()
        return None if record is None else Mode(int(record["mode"]))

    def dropped(self) -> dict[str, int]:
        """Return the number of records that did not fit into a queue to the logger, by queue.

        `policy_events` is not counted: its events are few.
        """
        return {
            "ticks": self.ticks.dropped,
            "steps": self.steps.dropped,
            "events": self.events.dropped,
            "samples": self.samples.dropped,
        }

    def close(self) -> None:
        """Release the memory; the process that made it also removes it."""
        self.state.close()
        self.actions.close()
        self.operator.close()
        self.standby.close()
        self.ticks.close()
        self.samples.close()
        self.steps.close()
        self.events.close()
        self.policy_events.close()
        self.events_seen.close()
        self.requests.close()
        self._memory.close()
        if self._owner:
            self._memory.unlink()
            self._owner = False
