"""Send this process SIGTERM while it runs a command."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from repetition import meanwhile


@contextmanager
def terminated(is_due: Callable[[], bool], handler: Any = signal.SIG_IGN) -> Iterator[None]:
    """Send this process SIGTERM as soon as it is due, if the block still runs then.

    Args:
        is_due: Whether the signal is to be sent; asked again and again.
        handler: What the process does with a signal for which the block sets no handler of its own.
    """
    sent = False

    def terminate() -> None:
        nonlocal sent
        if not sent and is_due():
            sent = True
            os.kill(os.getpid(), signal.SIGTERM)

    # After the block the signal would end the tests.
    handler_before = signal.signal(signal.SIGTERM, handler)
    try:
        with meanwhile(terminate, 0.05):
            yield
    finally:
        signal.signal(signal.SIGTERM, handler_before)
