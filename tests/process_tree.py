"""The processes that a process has started, from Linux's /proc."""

from __future__ import annotations

import contextlib
from pathlib import Path


def children_of(pid: int) -> dict[int, str]:
    """Return the command lines of the processes that a process started and that still run.

    Args:
        pid: Number of the process.

    Returns:
        The command line of each child, its words parted by spaces, by its number.
    """
    children = {}
    # Each thread has a list of its own.
    for listed in Path(f"/proc/{pid}/task").glob("*/children"):
        words: list[str] = []
        with contextlib.suppress(OSError):
            words = listed.read_text().split()
        for word in words:
            # A child may end in between.
            with contextlib.suppress(OSError):
                command = Path(f"/proc/{word}/cmdline").read_bytes()
                children[int(word)] = command.replace(b"\0", b" ").decode(errors="replace")
    return children


def descendants_of(pid: int) -> dict[int, str]:
    """Return the command lines of all processes below a process, as `children_of` does."""
    found = children_of(pid)
    for child in list(found):
        found.update(descendants_of(child))
    return found
