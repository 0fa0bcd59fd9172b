"""A log that is written by a thread of its own, so that no disk can make a servo late."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Any, Protocol, Self

from pronk.errors import HardwareError
from pronk.sweep.log import Segment
from pronk.sweep.mcap_log import Floats, McapLogWriter


class LogWriter(Protocol):
    """What a recording needs of a log: `McapLogWriter`, at once or apart."""

    def segment(self, segment: Segment) -> int:
        """Announce a question; returns its number."""

    def sample(
        self,
        time: float,
        command: Floats,
        position: Floats,
        velocity: Floats | None = None,
        torque: Floats | None = None,
        frequency: float = ...,
        segment: int = -1,
    ) -> None:
        """Write one measured state."""


class LogApart:
    """Hands everything to a `McapLogWriter` in the order it came. A context manager like it.

    Arrays handed over must not be changed afterwards.
    """

    def __init__(self, inner: McapLogWriter) -> None:
        """Start the thread.

        Args:
            inner: The log; its header is written.
        """
        self._inner = inner
        self._jobs: queue.SimpleQueue[Callable[[], Any] | None] = queue.SimpleQueue()
        self._failed: OSError | None = None
        self._segments = 0
        self._thread = threading.Thread(target=self._work, name="pronk sweep log", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Write what is waiting and end the log, as `McapLogWriter` does.

        Raises:
            HardwareError: Something could not be written, and the block did not fail before.
        """
        self._jobs.put(None)
        self._thread.join()
        try:
            self._inner.__exit__(kind, error, trace)
        except OSError as failed:
            self._failed = self._failed or failed
        if kind is None:
            self._check()

    def segment(self, segment: Segment) -> int:
        """Announce a question; returns its number."""
        self._put(lambda: self._inner.segment(segment))
        self._segments += 1
        return self._segments - 1

    def sample(
        self,
        time: float,
        command: Floats,
        position: Floats,
        velocity: Floats | None = None,
        torque: Floats | None = None,
        frequency: float = float("nan"),
        segment: int = -1,
    ) -> None:
        """Write one measured state, soon.

        Raises:
            HardwareError: An earlier one could not be written.
        """
        values = (time, command, position, velocity, torque, frequency, segment)
        self._put(lambda: self._inner.sample(*values))

    def _put(self, job: Callable[[], Any]) -> None:
        self._check()
        self._jobs.put(job)

    def _check(self) -> None:
        if self._failed is not None:
            raise HardwareError(
                f"the log {self._inner.path} cannot be written ({self._failed}); free the disk or "
                "give another folder."
            )

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except OSError as error:
                self._failed = self._failed or error
