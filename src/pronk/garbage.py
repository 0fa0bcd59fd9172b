"""How often Python looks for unreachable objects.

PyTorch, MuJoCo Warp and mjlab make 900,000 objects as they are imported, almost all of which stay
to the end. By Python's own setting the collector looks at each of them many times: of the 10 s of
CPU time of a process that imports them and ends, it took 4 s.
"""

from __future__ import annotations

import gc

YOUNG_OBJECTS = 10_000
"""Number of new objects after which the collector looks at them; Python 3.11 has 700."""


def collect_less_often() -> None:
    """Let more new objects come together before each collection in this process."""
    gc.set_threshold(YOUNG_OBJECTS)


def end_without_collection() -> None:
    """Leave the memory of this process, which is about to end, to the operating system."""
    gc.disable()
    gc.freeze()
