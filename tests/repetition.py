"""Repeat something in a thread beside a test."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def meanwhile(act: Callable[[], object], period_s: float) -> Iterator[None]:
    """Repeat something in another thread until the block ends.

    Args:
        act: Called again and again.
        period_s: Time between the end of a call and the next one [s].
    """
    over = threading.Event()

    def loop() -> None:
        while not over.wait(period_s):
            act()

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
