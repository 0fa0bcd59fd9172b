"""What the processes of a run tell each other, with two real processes on this host."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch")

from pronk.train.runner.processes import in_any

pytestmark = pytest.mark.train

PROGRAM = """
import sys, torch
from pronk.train.runner.processes import in_any
rank, meeting = int(sys.argv[1]), sys.argv[2]
torch.distributed.init_process_group("gloo", init_method=meeting, rank=rank, world_size=2)
two = {"size": 2, "device": "cpu"}
assert in_any(rank == 1, **two)
assert not in_any(False, **two)
torch.distributed.destroy_process_group()
"""


def test_one_process_asks_nobody() -> None:
    assert in_any(True, size=1, device="cpu")
    assert not in_any(False, size=1, device="cpu")


@pytest.mark.slow
def test_two_processes_stop_together(tmp_path: Path) -> None:
    meeting = (tmp_path / "meeting").as_uri()
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(rank), meeting],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in range(2)
    ]
    try:
        said = [process.communicate(timeout=300)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert [process.returncode for process in processes] == [0, 0], said
