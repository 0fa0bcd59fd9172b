"""A talk between two processes in which neither ever waits for the other.

A servo must not stand still because whoever listens is stuck. So what the system does not take at
once is kept here and tried again later, and reading returns what has come. The system closes the
sockets of a process that dies, of `kill -9` too: the other end knows at its next look.
"""

from __future__ import annotations

import select
import socket
import struct
import threading
import time
from multiprocessing.reduction import ForkingPickler
from typing import Any

_LENGTH = struct.Struct("<I")
_READ = 1 << 16


class Channel:
    """One end of a socket pair. Messages are tuples and arrive whole and in order.

    They are pickled as multiprocessing does: both ends are pronk's own, and nobody else can reach a
    pair that has no name.
    Any thread may put, one may take.
    """

    def __init__(self, end: socket.socket) -> None:
        """Take over one end of `socket.socketpair()`."""
        end.setblocking(False)
        self.gone = False
        """Whether the other end is closed, and all that it said was taken."""
        self._end = end
        self._out, self._in = bytearray(), bytearray()
        self._lock = threading.Lock()

    def put(self, *message: Any) -> None:
        """Say something; to an end that is gone it is lost."""
        data = bytes(ForkingPickler.dumps(message))
        with self._lock:
            self._out += _LENGTH.pack(len(data)) + data
            self._send()

    def take(self) -> list[tuple[Any, ...]]:
        """What was said since the last look."""
        with self._lock:
            self._send()
        while not self.gone:
            try:
                data = self._end.recv(_READ)
            except BlockingIOError:
                break
            except ConnectionError:
                data = b""
            self.gone = not data
            self._in += data
        messages = []
        while len(self._in) >= _LENGTH.size:
            end = _LENGTH.size + _LENGTH.unpack_from(self._in)[0]
            if len(self._in) < end:
                break
            messages.append(ForkingPickler.loads(self._in[_LENGTH.size : end]))
            del self._in[:end]
        return messages

    def finish(self, seconds: float) -> None:
        """Let the other end hear everything, for at most so long [s], and close."""
        until = time.monotonic() + seconds
        with self._lock:
            while self._out and (left := until - time.monotonic()) > 0.0:
                select.select([], [self._end], [], left)
                self._send()
            self._end.close()

    def _send(self) -> None:
        try:
            while self._out:
                del self._out[: self._end.send(self._out)]
        except BlockingIOError:
            pass
        except OSError:
            # Nobody is there any more; `take` finds out by itself.
            self._out.clear()
