"""The process of a task: one `pronk` command that ends with the process that started it.

python -m pronk.jump.study.task_process PARENT_PID train all --gains gains.yaml ...
"""

from __future__ import annotations

import os
import runpy
import signal
import sys

from pronk.processes import die_with_parent


def run_command() -> None:
    """Run the command as the program `pronk` would."""
    parent = int(sys.argv[1])
    die_with_parent(signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(1)  # The parent ended before the system was asked to watch it.
    sys.argv = ["pronk", *sys.argv[2:]]
    runpy.run_module("pronk.cli.main", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    run_command()
