"""Ctrl-C and `kill` end a run at the next checkpoint; the second one ends it at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def stop_signals(stop: Callable[[str], None]) -> Iterator[None]:
    """Inside the block the first SIGINT or SIGTERM calls `stop` with its name.

    The next one does what it does outside. Python tells only the main thread of signals; in
    another thread the block changes nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}

    def ask(number: int, frame: FrameType | None) -> None:
        name = signal.Signals(number)
        signal.signal(name, before[name])
        stop(name.name)

    for number in before:
        signal.signal(number, ask)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
