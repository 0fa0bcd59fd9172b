"""`python -m benchmarks profiles LOGS`: the same logs matched for every profile, and how long."""

from __future__ import annotations

import time
from pathlib import Path

import tyro

from benchmarks.runner import machine
from pronk.cli import console
from pronk.identify.logs.readers import read_logs
from pronk.identify.match.match import match
from pronk.identify.simulators.profiles import load_profiles
from pronk.robots import load_robot
from pronk.tables import Cell, Column, Table


def profiles(
    paths: tyro.conf.Positional[tuple[Path, ...]],
    robot: str = "mini_cheetah",
) -> console.Outcome:
    """Match the same logs for every profile: error of each, and its time.

    Args:
        paths: Logs, or folders of logs, as `pronk sweep` writes them.
        robot: A name, or a path to a robot.yaml, MJCF or URDF.
    """
    robot_spec = load_robot(robot)
    logs = read_logs(paths, robot=robot_spec)
    rows: list[tuple[Cell, ...]] = []
    with console.progress() as report:
        for number, name in enumerate(load_profiles(), start=1):
            begin = time.perf_counter()
            result = match(logs, robot_spec, name)
            seconds = time.perf_counter() - begin
            rows.append((name, len(result.joints), result.error_db, len(result.flags), seconds))
            report("profiles", number / len(load_profiles()))
    columns = (
        Column(heading="profile"),
        Column(heading="joints"),
        Column(heading="error", unit="dB"),
        Column(heading="flagged"),
        Column(heading="time", unit="s", digits=1),
    )
    console.show(Table(title="The same logs for every profile", columns=columns, rows=tuple(rows)))
    return console.Outcome(figures={"rows": rows, "machine": machine()})
