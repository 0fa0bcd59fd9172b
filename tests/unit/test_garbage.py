"""When Python collects unreachable objects in the processes of pronk."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import atexit
import gc
from pronk import garbage

class Node:
    def __del__(self):
        print("collected", flush=True)

def make_cycle():
    node = Node()
    node.itself = node

garbage.collect_less_often()
atexit.register(print, "exit function")
make_cycle()
{last_line}
"""


def printed_at_the_end(last_line: str) -> list[str]:
    """Return what a process prints that leaves an unreachable cycle behind."""
    code = PROGRAM.format(last_line=last_line)
    command = [sys.executable, "-c", code]
    process = subprocess.run(command, capture_output=True, text=True, check=True)
    return process.stdout.splitlines()


def test_a_process_ends_with_its_exit_functions_but_without_a_collection() -> None:
    assert printed_at_the_end("garbage.end_without_collection()") == ["exit function"]
    assert printed_at_the_end("") == ["exit function", "collected"]
    assert printed_at_the_end("gc.collect()") == ["collected", "exit function"]


def test_the_collector_still_looks_at_new_objects() -> None:
    """Cycles do not pile up without end in a long training."""
    lines = "for _ in range(2 * garbage.YOUNG_OBJECTS):\n    make_cycle()\nprint('loop over')"
    printed = printed_at_the_end(lines)
    assert "collected" in printed[: printed.index("loop over")]
