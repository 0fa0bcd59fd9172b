"""Body of a process of a run: its loop, its end by a signal, and the figures that it sends."""

from __future__ import annotations

import signal
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, Protocol

import orjson

from pronk.deploy.runtime.memory import Shared


class ProcessBody(Protocol):
    """What a process of a run does."""

    def run(self) -> None:
        """Run until it is stopped or the run is over."""

    def stop(self) -> None:
        """End, soon; called by a signal's handler."""

    def figures(self) -> dict[str, Any]:
        """Return the figures of the run since its begin."""


def run_to_end(body: ProcessBody, shared: Shared, end: Connection) -> None:
    """Run a process to its end and send its figures.

    Args:
        body: What the process does; SIGTERM stops it.
        shared: Shared memory, which is closed at the end.
        end: Pipe to the process that started this one; gets the figures as JSON.
    """
    signal.signal(signal.SIGTERM, lambda *_: body.stop())
    try:
        body.run()
    finally:
        with suppress(OSError):  # the parent has ended
            end.send_bytes(orjson.dumps(body.figures()))
        end.close()
        shared.close()
