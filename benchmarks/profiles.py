"""`python -m benchmarks profiles LOGS`: all profiles matched from one set of logs.

The time of a match for all of them on two threads, by both methods; then the cells of the quick
search beside those of simulating every pair of the grid.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.frameworks import SETTINGS
from benchmarks.runner import Progress, machine
from pronk.cli import console
from pronk.errors import PronkError
from pronk.identify.logs.readers import read_logs
from pronk.identify.match.pipeline import match_frameworks
from pronk.identify.match.result import MatchResult
from pronk.identify.match.settings import MatchSettings
from pronk.identify.simulators.profiles import load_profiles
from pronk.jump.trial.tables import table
from pronk.robots import load_robot


def compared(
    quick: Mapping[str, MatchResult], whole: Mapping[str, MatchResult]
) -> list[dict[str, Any]]:
    """Cells of each profile, and by how much those that differ are worse than the best [dB]."""
    rows = []
    for name in (n for n in quick if n):
        worse = []
        for joint, every in whole[name].joints.items():
            cell = np.nanargmin(quick[name].joints[joint].grid_error)
            levels = np.sqrt(every.grid_error.ravel())
            worse.append(float(levels[cell] - levels.min()))
        same = sum(excess == 0.0 for excess in worse)
        rows.append({"profile": name, "joints": len(worse), "same": same, "worst_db": max(worse)})
    return rows


def profiles(
    paths: tyro.conf.Positional[tuple[Path, ...]],
    robot: str = "mini_cheetah",
    repeats: int = 1,
    jobs: int = 2,
    cells: bool = True,
) -> console.Outcome:
    """All profiles matched from one set of logs: time, and cells beside an exhaustive search.

    Args:
        paths: Logs, or folders of logs, as `pronk sweep` writes them.
        robot: A name, or a path to a robot.yaml, MJCF or URDF.
        repeats: Matches timed by each method; 1 or more.
        jobs: Threads of the exhaustive search; twelve joints take 20 minutes of processor time.
        cells: Compare the cells as well.
    """
    if repeats < 1:
        raise PronkError(f"--repeats {repeats}; expected 1 or more.")
    known, names = load_robot(robot), list(load_profiles())
    begin = time.perf_counter()
    logs = read_logs(paths, robot=known)
    console.say(f"{len(logs)} logs read in {time.perf_counter() - begin:.1f} s")
    times: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    quick: Mapping[str, MatchResult] = {}
    with console.progress() as report:
        progress: Progress = report
        for settings in (MatchSettings(), SETTINGS):
            for _ in range(repeats):
                begin, used = time.perf_counter(), time.process_time()
                quick = match_frameworks(logs, known, names, settings=settings, progress=progress)
                wall, used = time.perf_counter() - begin, time.process_time() - used
                console.say(f"{settings.method}: {wall:.1f} s, {used:.1f} processor s")
                row = {"method": settings.method, "wall_s": wall, "processor_s": used}
                times.append(row)
        if cells:
            every = replace(SETTINGS, exhaustive=True, threads=jobs)
            whole = match_frameworks(logs, known, names, settings=every, progress=progress)
            rows = compared(quick, whole)
    if rows:
        sheet = table(
            "profile | joints | same cell | worst [dB];4",
            [list(row.values()) for row in rows],
            title="Cells of the quick search beside those of simulating every pair",
        )
        console.show_sheet(sheet)
    return console.Outcome(figures={"times": times, "rows": rows, "machine": machine()})
