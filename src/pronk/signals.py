"""What a process does with a signal to end."""

from __future__ import annotations

import signal


def interrupt(number: int, _frame: object) -> None:
    """End as Ctrl-C does, so that temporary files are removed; a handler of signals.

    Raises:
        KeyboardInterrupt: Always, with the name of the signal.
    """
    raise KeyboardInterrupt(signal.Signals(number).name)
