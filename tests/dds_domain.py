"""DDS domains of one test process: several run side by side, and must not reach each other."""

from __future__ import annotations

import itertools
import os

_BLOCK = 20
"""Domains of a process; they are used in turns."""
_BLOCKS = 11
"""Blocks of domains from 2 on; DDS has domains up to 232."""
_numbers = itertools.count()


def own_domain() -> int:
    """Return a domain that no other process of this run of the tests uses, another one each time.

    Two runs at once are likely to have other blocks.
    """
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    block = os.getpid() % _BLOCKS
    if worker is not None:
        block = (os.getppid() + int(worker.removeprefix("gw"))) % _BLOCKS
    return 2 + _BLOCK * block + next(_numbers) % _BLOCK
