"""The logger's process: from the queues to the file, in nobody's way."""

from __future__ import annotations

import os
import signal
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import orjson

from pronk.deploy.log import DeployLogWriter
from pronk.deploy.plan import Names, Shared
from pronk.errors import LogError

READY = b"ready"
FLUSH_S = 0.25
"""Longest that something is kept from the file [s]."""
_NAP_S = 0.02


def write_log(path: Path, header: dict[str, Any], names: Names, talk: Connection) -> None:
    """Body of the logger's process; ends when it is told to, or when its parent is gone.

    Args:
        path: MCAP file.
        header: What is known beforehand.
        names: Of the shared memory.
        talk: Where it says that the file is open, or why not, and where the word to end comes
            from: JSON, the figures of the run.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = os.getppid()
    shared = Shared(names)
    try:
        _write(path, header, shared, talk, parent)
    except LogError as error:
        talk.send_bytes(str(error).encode())
    finally:
        shared.close()


def _write(
    path: Path, header: dict[str, Any], shared: Shared, talk: Connection, parent: int
) -> None:
    writer = DeployLogWriter(path, header)
    talk.send_bytes(READY)
    flushed = time.monotonic()
    while True:
        ending = talk.poll() or os.getppid() != parent
        _drain(writer, shared)
        if ending:
            break
        now = time.monotonic()
        if now - flushed >= FLUSH_S:
            writer.flush()
            flushed = now
        time.sleep(_NAP_S)
    try:
        figures = orjson.loads(talk.recv_bytes())
    except EOFError:  # whoever should have told the figures is gone
        figures = {}
    writer.end(complete=bool(figures) and not any(shared.dropped().values()), figures=figures)


def _drain(writer: DeployLogWriter, shared: Shared) -> None:
    """Everything that waits, events first: they say what the rest means."""
    for ring in (shared.events, shared.troubles):
        for record in ring.take():
            writer.event(record)
    for record in shared.ticks.take(4096):
        writer.tick(record)
    for record in shared.steps.take(4096):
        writer.step(record)
