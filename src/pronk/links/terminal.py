r"""Keep a terminal's signals from the processes that move a robot.

Ctrl-C, Ctrl-\, Ctrl-Z and the end of the terminal itself, a lost ssh connection, go to every
process of the program in front of it. A process that moves a robot must damp the joints before it
ends, so it receives none of them: `unheard` while it starts, `leave` when it runs. The program that
started it receives them, and ends it in order: `Interrupts`.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self

TERMINAL = (signal.SIGINT, signal.SIGQUIT, signal.SIGTSTP, signal.SIGHUP)
r"""Signals of a terminal: Ctrl-C, Ctrl-\, Ctrl-Z, and its end."""
ENDING = (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP, signal.SIGTERM)
"""Signals that end a program."""


@contextmanager
def unheard() -> Iterator[None]:
    """Start processes that ignore the terminal; signals that come meanwhile wait."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, TERMINAL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def leave() -> None:
    """Take this process out of the terminal's session and ignore its signals.

    Raises:
        PermissionError: It leads a group of processes, as a program started by a shell does.
    """
    os.setsid()
    for number in TERMINAL:
        signal.signal(number, signal.SIG_IGN)


class Interrupts:
    """Records signals that end the program, without breaking into it; `check` raises them.

    A context manager. Outside the main thread, where Python receives no signals, it records none.
    """

    def __init__(self) -> None:
        """Record nothing yet."""
        self._received = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        """Begin to record."""
        if threading.current_thread() is threading.main_thread():
            for number in ENDING:
                before = signal.getsignal(number)
                # What is ignored, as by nohup, stays so.
                if before not in (signal.SIG_IGN, None):
                    self._before[number] = before
                    signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the handlers of before; twice does no harm."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal has come since the last check."""
        if self._received:
            self._received = False
            raise KeyboardInterrupt

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self._received = True
