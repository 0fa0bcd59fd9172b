"""Kernels compiled side by side, and the time that it takes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pronk.train.runner.kernels import MODULES, compile_ahead, kernel_seconds


def test_the_time_of_compiling_is_told_from_that_of_loading() -> None:
    printed = (
        "Module smooth 52b3ca0 load on device 'cuda:0' took 1500.25 ms  (compiled)\n"
        "Module solver a3620bc load on device 'cuda:0' took 700.00 ms  (cached)\n"
        "step took 9.00 ms\n"
        "Module other 1234567 load on device 'cuda:0' took 499.75 ms  (compiled)\n"
    )
    assert kernel_seconds(printed) == pytest.approx(2.0)


def test_every_module_is_of_this_mujoco_warp_and_has_kernels(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[str] = []
    monkeypatch.setattr(
        "warp.force_load",
        lambda *, device, modules, max_workers: given.extend(m.name for m in modules if m.kernels),
    )
    assert compile_ahead("cpu") == 0.0
    assert tuple(given) == MODULES


def test_a_module_that_is_no_more_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "pronk.train.runner.kernels.MODULES", ("mujoco_warp._src.gone", MODULES[-1])
    )
    given: list[str] = []
    monkeypatch.setattr(
        "warp.force_load",
        lambda *, device, modules, max_workers: given.extend(m.name for m in modules),
    )
    compile_ahead("cpu")
    assert given == [MODULES[-1]]


def test_a_full_cache_costs_nothing(tmp_path: Path) -> None:
    code = (
        "import pronk.train.runner.kernels as k;"
        "k.MODULES = k.MODULES[-1:];"
        "print(k.compile_ahead('cpu'))"
    )
    seconds = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "WARP_CACHE_PATH": str(tmp_path)},
        )
        seconds.append(float(done.stdout.splitlines()[-1]))
    assert seconds[0] > 0.0
    assert seconds[1] == 0.0
