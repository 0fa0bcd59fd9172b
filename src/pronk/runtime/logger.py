"""The logger's process: from the queues to the file, in nobody's way."""

from __future__ import annotations

import os
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import orjson

from pronk.errors import LogError
from pronk.links.terminal import leave
from pronk.runtime.log_writer import DeployLogWriter
from pronk.runtime.plan import Names, Shared
from pronk.runtime.records import Mode

READY = b"ready"
FLUSH_S = 0.25
"""Longest that something is kept from the file [s]."""
_NAP_S = 0.02
_LAST_S = 6.0
"""Longest that the servo is waited for once nobody else is there: it damps for a second, and the
link for three at most [s]."""


def write_log(path: Path, header: dict[str, Any], names: Names, talk: Connection) -> None:
    """Body of the logger's process; ends when it is told to, or after the servo if nobody can.

    Args:
        path: MCAP file.
        header: What is known beforehand.
        names: Of the shared memory.
        talk: Where it says that the file is open, or why not, and where the word to end comes
            from: JSON, the figures of the run.
    """
    leave()
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

    def keep() -> None:
        nonlocal flushed
        _drain(writer, shared)
        if time.monotonic() - flushed >= FLUSH_S:
            writer.flush()
            flushed = time.monotonic()
        time.sleep(_NAP_S)

    while not talk.poll() and os.getppid() == parent:
        keep()
    try:
        figures = orjson.loads(talk.recv_bytes())
    except (EOFError, OSError):
        # Whoever should have told the figures is gone. The servo damps now: that is kept too.
        figures = {}
        until = time.monotonic() + _LAST_S
        while _moving(shared) and time.monotonic() < until:
            keep()
    _drain(writer, shared)
    writer.end(complete=bool(figures) and not any(shared.dropped().values()), figures=figures)


def _moving(shared: Shared) -> bool:
    """Whether the servo has begun and not ended."""
    news = shared.news.read()
    return news is not None and Mode(int(news["mode"])) is not Mode.ENDED


def _drain(writer: DeployLogWriter, shared: Shared) -> None:
    """Everything that waits, events first: they say what the rest means."""
    for ring in (shared.events, shared.troubles):
        for record in ring.take():
            writer.event(record)
    for record in shared.ticks.take(4096):
        writer.tick(record)
    for record in shared.steps.take(4096):
        writer.step(record)
