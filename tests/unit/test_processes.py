"""Processes that are killed from outside: what is said of them, and where that ends."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

from process_tree import children_of
from pronk.errors import PronkError
from pronk.processes import exit_words, in_processes, pool

NAMES = ("the first job", "the second job", "the third job")
WAY_OUT = "take a smaller number"


def end_by(job: tuple[int, Path]) -> None:
    """Wait until another process works too, then send this process a signal; 0 waits for its end.

    Args:
        job: The signal, and a folder in which every process leaves a file.
    """
    number, folder = job
    (folder / str(os.getpid())).touch()
    while len(list(folder.iterdir())) < 2:
        time.sleep(0.01)
    if number:
        os.kill(os.getpid(), number)
    time.sleep(60.0)


@pytest.mark.parametrize("place", [0, 1])
def test_a_killed_process_is_named_with_its_signal_its_job_and_the_way_out(
    tmp_path: Path, place: int
) -> None:
    jobs = [(0, tmp_path)] * 3
    jobs[place] = (signal.SIGKILL, tmp_path)
    with pytest.raises(PronkError) as ended:
        in_processes(end_by, jobs, processes=2, names=NAMES, way_out=WAY_OUT)
    text = str(ended.value)
    assert "SIGKILL" in text
    assert [name for name in NAMES if name in text] == [NAMES[place]]
    assert WAY_OUT in text
    # Causes are likely ones, more than one.
    assert "memory" in text
    assert "person" in text


def test_a_crash_is_none_of_the_memory(tmp_path: Path) -> None:
    jobs = [(signal.SIGSEGV, tmp_path), (0, tmp_path)]
    with pytest.raises(PronkError) as ended:
        in_processes(end_by, jobs, processes=2, names=NAMES[:2], way_out=WAY_OUT)
    text = str(ended.value)
    assert "SIGSEGV" in text
    assert NAMES[0] in text
    assert "memory" not in text
    assert WAY_OUT not in text


def test_an_ended_process_is_no_defect_though_the_first_of_them_does_not_show(
    tmp_path: Path,
) -> None:
    jobs = [(signal.SIGTERM, tmp_path), (0, tmp_path)]
    with pytest.raises(PronkError) as ended:
        in_processes(end_by, jobs, processes=2, names=NAMES[:2], way_out=WAY_OUT)
    assert "memory" not in str(ended.value)


def test_a_single_job_beside_the_command_is_named(tmp_path: Path) -> None:
    """As the jumps of `pronk demo`, which are submitted by hand."""
    (tmp_path / "other").touch()
    with pytest.raises(PronkError, match="the films"), pool(1, names=("the films",)) as process:
        process.submit(end_by, (signal.SIGKILL, tmp_path)).result()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGBUS])
def test_a_signal_has_its_name_and_number(number: signal.Signals) -> None:
    words = exit_words(-number, WAY_OUT)
    assert number.name in words
    assert str(int(number)) in words
    assert ("memory" in words) == (number == signal.SIGKILL)


def test_an_exit_status_and_a_signal_without_a_name() -> None:
    assert "3" in exit_words(3, WAY_OUT)
    assert "signal" not in exit_words(3, WAY_OUT)
    assert str(signal.SIGRTMIN + 3) in exit_words(-(signal.SIGRTMIN + 3), WAY_OUT)


def kill_first_child() -> None:
    """Kill the first process that this one spawns, as soon as it is there."""
    until = time.monotonic() + 60.0
    while time.monotonic() < until:
        for pid, command in children_of(os.getpid()).items():
            if "spawn_main" in command:
                os.kill(pid, signal.SIGKILL)
                return


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc is of Linux")
@pytest.mark.parametrize("attempt", range(3))
def test_a_process_that_is_killed_while_others_start_is_no_defect(attempt: int) -> None:
    killer = threading.Thread(target=kill_first_child)
    killer.start()
    with pytest.raises(PronkError, match="SIGKILL"):
        in_processes(time.sleep, [60.0] * 6, processes=6)
    killer.join()
