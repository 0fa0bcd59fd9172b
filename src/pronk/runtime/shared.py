"""What the processes share: the last value of something, and queues that never wait.

Both are plain shared memory without locks, so that a process that is killed at any moment, or
stopped by a debugger, cannot hold up another. Every slot carries a number and a checksum of its
bytes: a reader that meets a half-written slot sees that the sum is wrong, on any processor.

One process writes a `Mailbox` or puts into a `Ring`; any may read the mailbox, one takes from the
ring.
"""

from __future__ import annotations

import struct
import zlib
from multiprocessing import shared_memory
from typing import Any, Self

import numpy as np

_HEAD = struct.Struct("<QQQ")
"""Of a block: count written, count taken, count dropped."""
_SLOT = struct.Struct("<QI")
"""Of a slot: its number, the checksum of the rest."""
_MAILBOX_SLOTS = 4
"""The writer is always two slots or more from the one that a reader was told of."""


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
