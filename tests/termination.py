"""Send this process SIGTERM while it runs a command."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def terminated(is_due: Callable[[], bool], handler: Any = signal.SIG_IGN) -> Iterator[None]:
    """Send this process SIGTERM as soon as it is due, if the block still runs then.

    Args:
        is_due: Whether the signal is to be sent; asked again and again.
        handler: What the process does with a signal for which the block sets no handler of its own.
    """
    over = threading.Event()

    def terminate() -> None:
        while not over.wait(0.05):
            if is_due():
                os.kill(os.getpid(), signal.SIGTERM)
                return

    # After the block the signal would end the tests.
    handler_before = signal.signal(signal.SIGTERM, handler)
    thread = threading.Thread(target=terminate)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        signal.signal(signal.SIGTERM, handler_before)
