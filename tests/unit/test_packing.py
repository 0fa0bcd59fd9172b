"""Trainings side by side on a GPU: how many, MPS around them, time left; none of it needs a GPU."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from pronk.jump.study.local import LocalExecutor
from pronk.jump.study.mps import LOG, PIPE, mps_daemon
from pronk.jump.study.packing import (
    GpuRates,
    RateReading,
    free_memory_mib,
    packing_text,
    settled_rates,
)
from pronk.jump.study.schedule import time_left
from study_cases import export_task, study_root

# Steps/s of each of one to four trainings of 4,096 robots on one H200 under MPS.
MEASURED = {1: 164_000.0, 2: 124_000.0, 3: 99_000.0, 4: 86_000.0}


def filled(rates: GpuRates, rate_by_count: dict[int, float], *, waiting: int = 16) -> int:
    """Add trainings to a GPU one after another; return how many run in the end."""
    count = 0
    while waiting and rates.may_add(count, True):
        count += 1
        waiting -= 1
        if count in rate_by_count:
            rates.note([rate_by_count[count]] * count)
    return count


def test_a_training_is_added_while_the_rate_of_all_together_grows() -> None:
    rates = GpuRates()
    saturated = {**MEASURED, 5: 69_500.0}
    assert filled(rates, saturated) == 5
    assert rates.limit == 4
    # The next GPU takes what was found to be best.
    assert filled(rates, saturated) == 4
    assert "86,000" not in packing_text(rates)
    assert "69,500" in packing_text(rates)


def test_trainings_that_take_turns_stay_alone() -> None:
    """Without MPS two trainings have half the rate each."""
    rates = GpuRates()
    filled(rates, {1: 160_000.0, 2: 80_500.0, 3: 53_000.0})
    assert rates.limit == 1


def test_no_training_is_added_before_those_that_run_have_shown_their_rate() -> None:
    rates = GpuRates()
    assert rates.may_add(0, False)
    assert not rates.may_add(1, False)
    rates.note([MEASURED[1]])
    rates.note([MEASURED[2]] * 2)
    assert rates.may_add(1, False), "another GPU has shown that two fit"
    assert not rates.may_add(2, False)


def test_memory_limits_how_many_fit() -> None:
    rates = GpuRates()
    free_mib = 80_000.0
    count = 0
    while rates.may_add(count, True):
        count += 1
        rates.note([100_000.0] * count)
        rates.note_memory(count, free_mib - 24_000.0 * count, 24_000.0)
    assert count == 3
    assert "GiB" in rates.reason


def test_a_given_number_is_kept() -> None:
    assert filled(GpuRates(limit=3), {}) == 3
    rates = GpuRates(limit=3)
    rates.note([100.0])
    rates.note([50.0, 50.0])
    assert rates.limit == 3


def test_free_memory_is_found_by_number_and_by_uuid() -> None:
    free = free_memory_mib("0, GPU-aa-bb, 81000\n1, GPU-cc, 42\n2, GPU-dd, [N/A]\n\n")
    assert free == {"0": 81000.0, "GPU-aa-bb": 81000.0, "1": 42.0, "GPU-cc": 42.0}


@pytest.mark.parametrize(
    ("running", "waiting", "rooms", "seconds"),
    [
        ([], [], 4, 0.0),
        ([10.0, 30.0], [], 2, 30.0),
        ([10.0, 30.0], [25.0], 2, 35.0),
        ([10.0], [25.0], 2, 25.0),
        ([], [5.0] * 16, 16, 5.0),
        ([], [5.0] * 17, 16, 10.0),
        ([1.0, 2.0, 3.0], [4.0, 4.0, 4.0, 4.0], 3, 9.0),
    ],
)
def test_time_left(running: list[float], waiting: list[float], rooms: int, seconds: float) -> None:
    assert time_left(running, waiting, rooms) == seconds


# --- MPS -----------------------------------------------------------------------------------------

STAND_IN = """#!/bin/sh
# Writes down how it was called, as the driver's program is called.
echo "$1 pipe=$CUDA_MPS_PIPE_DIRECTORY visible=${CUDA_VISIBLE_DEVICES-unset}" >> "$MPS_CALLS"
test "$1" = "-d" || cat >> "$MPS_CALLS"
test -z "$MPS_FAILS"
"""


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put a stand-in for the driver's program on PATH; return the file of its calls."""
    program = tmp_path / "bin" / "nvidia-cuda-mps-control"
    program.parent.mkdir()
    program.write_text(STAND_IN)
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("MPS_CALLS", str(tmp_path / "calls.txt"))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,3")
    monkeypatch.delenv(PIPE, raising=False)
    return tmp_path / "calls.txt"


def test_mps_runs_inside_the_block_and_ends_with_it(calls: Path, tmp_path: Path) -> None:
    lines: list[str] = []

    def interrupted() -> None:
        with mps_daemon(tmp_path / "mps", lines.append) as variables:
            assert set(variables) == {PIPE, LOG}
            for folder in variables.values():
                assert Path(folder).is_dir()
            pipe = variables[PIPE]
            assert len(pipe) <= 80, "sockets in it need names of 107 characters at most"
            assert calls.read_text().splitlines() == [f"-d pipe={pipe} visible=unset"]
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    begin, end, typed = calls.read_text().splitlines()
    assert end == begin.removeprefix("-d")
    assert typed == "quit"
    assert len(lines) == 1


def test_where_mps_does_not_start_that_is_said(
    calls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPS_FAILS", "1")
    lines: list[str] = []
    with mps_daemon(tmp_path / "mps", lines.append) as variables:
        assert variables == {}
    assert "did not start" in lines[0]
    assert len(calls.read_text().splitlines()) == 1


def test_mps_that_runs_already_is_left_as_it_is(
    calls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PIPE, "/tmp/theirs")
    lines: list[str] = []
    with mps_daemon(tmp_path / "mps", lines.append) as variables:
        assert variables == {}
    assert not calls.exists()
    assert "/tmp/theirs" in lines[0]


def test_trainings_are_added_to_gpus_as_they_show_their_rates(tmp_path: Path) -> None:
    """Tasks that end at once fill the GPUs in turn; none waits while a GPU is empty."""
    executor = LocalExecutor(study_root(tmp_path), gpus=("0", "1"), cores=8.0)
    places = []
    for number in range(3):
        task = export_task(str(number), kind="training", gpu=True)
        places.append(executor.try_start(task))
    executor.stop()
    # The third one would share a GPU with a training that has not shown its rate.
    assert places == ["GPU 0", "GPU 1", ""]
    assert executor.rooms() >= 2


def test_the_rate_that_is_told_is_the_mean_of_what_was_measured() -> None:
    rates = GpuRates(limit=4)
    for rate in (80_000.0, 90_000.0, 100_000.0):
        rates.note([rate] * 4)
    assert "90,000 steps/s each, 360,000 together" in packing_text(rates)


def test_rates_count_while_the_same_trainings_step() -> None:
    def reading(
        written_at: float, rate: float, *, iteration_s: float = 1.0, is_last: bool = False
    ) -> RateReading:
        return RateReading(
            written_at=written_at,
            steps_per_second=rate,
            iteration_s=iteration_s,
            is_last=is_last,
        )

    both = [reading(130.0, 120_000.0), reading(131.0, 124_000.0)]
    assert settled_rates(both, same_since=100.0) == [120_000.0, 124_000.0]
    # One of them began a moment ago.
    assert not settled_rates(both, same_since=129.0)
    # One of them writes its policy, and the other one has more of the GPU than it had beside it.
    over = [reading(130.0, 120_000.0, is_last=True), reading(131.0, 160_000.0)]
    assert not settled_rates(over, same_since=100.0)
    # The other one ended while the iteration ran that this rate is of.
    assert not settled_rates([reading(131.0, 140_000.0)], same_since=130.5)
    assert not settled_rates([reading(140.0, 140_000.0, iteration_s=12.0)], same_since=130.5)
    assert settled_rates([reading(140.0, 164_000.0)], same_since=130.5) == [164_000.0]
