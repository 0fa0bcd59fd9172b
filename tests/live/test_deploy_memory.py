"""What a run takes of the system: shared memory, the disk, memory of the servo, processes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from hopper import write_hopper
from process_tree import children_of
from pronk.exit_status import ExitStatus

pytestmark = pytest.mark.live


def deployed_with(folder: str, size: str, tmp_path: Path, *words: str) -> Any:
    """`pronk deploy` where a folder is a file system of a small size."""
    pytest.importorskip("onnxruntime")
    small = f"mount -t tmpfs -o size={size} tmpfs {folder} && exec "
    unshare = ["unshare", "--mount", "--map-root-user", "sh", "-c"]
    if shutil.which("unshare") is None or subprocess.run([*unshare, small + "true"]).returncode:
        pytest.skip("file systems cannot be mounted here")
    policy = write_hopper(tmp_path / "policy.onnx")
    command = f"{sys.executable} -m pronk.cli.main deploy {policy} --script 0,0 {' '.join(words)}"
    return subprocess.run([*unshare, small + command], capture_output=True, text=True)


def test_too_little_shared_memory_is_one_sentence(tmp_path: Path) -> None:
    done = deployed_with("/dev/shm", "64k", tmp_path)
    assert done.returncode == 2, done.stdout + done.stderr
    assert "/dev/shm" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_log_that_ends_on_a_full_disk_is_a_failure(tmp_path: Path) -> None:
    folder = tmp_path / "small"
    folder.mkdir()
    log = folder / "run.mcap"
    done = deployed_with(
        str(folder), "256k", tmp_path, "--log", str(log), "--seconds", "0.5", "--base", "bench"
    )
    assert done.returncode == ExitStatus.RUN_FAULT, done.stdout + done.stderr
    assert f"{log} ends" in " ".join(done.stderr.split())
    assert "No space left" in done.stderr
    assert "Traceback" not in done.stderr


def _alive(pid: int) -> bool:
    """Whether a process runs; one that ended and was not waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(
    not sys.platform.startswith("linux") or (os.cpu_count() or 1) < 2,
    reason="prctl is of Linux, and one core needs one process",
)
def test_the_processes_of_a_killed_sweep_end_too(tmp_path: Path) -> None:
    words = ["sweep", "mini_cheetah", "--out", str(tmp_path / "logs")]
    running = subprocess.Popen(
        [sys.executable, "-m", "pronk.cli.main", *words], stdout=subprocess.DEVNULL
    )
    until = time.monotonic() + 120.0
    children: dict[int, str] = {}
    # Two that sweep, and the tracker of what they share.
    while len(children) < 3 and time.monotonic() < until:
        time.sleep(0.05)
        children = children_of(running.pid)
    time.sleep(1.0)
    running.kill()
    running.wait()
    assert len(children) >= 3
    until = time.monotonic() + 20.0
    while any(map(_alive, children)) and time.monotonic() < until:
        time.sleep(0.05)
    assert not [pid for pid in children if _alive(pid)]
