r"""What a terminal does to programs, kept away from the processes that move a robot.

Ctrl-C, Ctrl-\, Ctrl-Z and the end of the terminal itself, a lost ssh connection, go to every
process of the program in front of it. A process that moves a robot must damp the joints before it
ends, so it hears none of them: `unheard` while it starts, `leave` when it runs. The program that
started it hears them, and ends it in order: `Interrupts`.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, Self

TERMINAL = (signal.SIGINT, signal.SIGQUIT, signal.SIGTSTP, signal.SIGHUP)
r"""Signals of a terminal: Ctrl-C, Ctrl-\, Ctrl-Z, and its end."""
ENDING = (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP, signal.SIGTERM)
"""Signals by which somebody ends a program."""


@contextmanager
def unheard() -> Iterator[None]:
    """Processes that are started meanwhile never hear the terminal; what comes now waits."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, TERMINAL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def leave() -> None:
    """Take this process out of the terminal's session, deaf to its signals; its first act.

    Raises:
        PermissionError: It leads a group of processes, as a program started by a shell does.
    """
    os.setsid()
    for number in TERMINAL:
        signal.signal(number, signal.SIG_IGN)


class Interrupts:
    """Notes that somebody wants to end the program, and breaks into nothing: it asks when it may.

    A context manager. Outside the main thread, where Python hears no signals, it notes nothing.
    """

    def __init__(self) -> None:
        """Hear nothing yet."""
        self._asked = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        """Begin to hear."""
        if threading.current_thread() is threading.main_thread():
            for number in ENDING:
                before = signal.getsignal(number)
                # What is ignored, as by nohup, stays so.
                if before not in (signal.SIG_IGN, None):
                    self._before[number] = before
                    signal.signal(number, self._hear)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give the signals back to whoever had them; twice does no harm."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()

    def check(self) -> None:
        """Look whether somebody has asked since the last look.

        Raises:
            KeyboardInterrupt: Yes.
        """
        if self._asked:
            self._asked = False
            raise KeyboardInterrupt

    def _hear(self, number: int, frame: FrameType | None) -> None:
        self._asked = True
