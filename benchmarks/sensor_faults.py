"""`python -m benchmarks sensor-faults`: from a fault to damping on the wire.

`tests.deploy_strikes` moves a virtual robot over LCM and DDS in real time and strikes it with
faults. `--docs` writes the section of a page, such as docs/evidence/faults.md.

With `--minutes` the robot walks without a fault instead: what damps it, the memory and the handles
of each process, and the lateness of the servo. Its link may then also be `sim`.
"""

from __future__ import annotations

import json
import math
import os
import time
from contextlib import suppress
from functools import partial
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.runner import Progress, Row, finish, rows_in, rows_of, write_section
from pronk.cli import console
from pronk.deploy.bench.faults import SENSOR_FAULTS, SWAPPED
from pronk.deploy.runtime.modes import Mode
from pronk.deploy.runtime.plan import Link, RunPlan
from pronk.deploy.runtime.run import Deployment
from pronk.errors import HardwareError
from pronk.policy.script import Velocity
from pronk.tables import Column, Table
from tests.deploy_strikes import (
    PROCESSES,
    TIMING,
    TRIES,
    WALKING_ROBOT,
    begin_to_walk,
    drive_until,
    measure,
    served,
)

FAULTS = (*SENSOR_FAULTS, *PROCESSES)
"""Faults that are measured."""
BAR_S = 0.1
"""Time from a fault to damping that a fault should not exceed [s]."""


def rows_of_faults(
    robot: str, policy: Path, link: str, faults: tuple[str, ...], run: int, real_time: bool
) -> list[Row]:
    """Measure each fault once; return a row for each."""
    rows = []
    for result in measure(robot, policy, link, faults, real_time=real_time):
        rows.append(
            {
                "robot": robot,
                "link": link,
                "fault": result.fault,
                "run": run,
                "time_s": result.time_s,
                "reason": result.reason,
            }
        )
    return rows


ROAM = (0.6, 0.2, 0.5)
"""Largest commands of a walk without a fault: forward, left [m/s], yaw rate [rad/s]."""
_ROW_S = 30.0
_FALLS = ("TILT", "SPEED", "OVERRUN", "OVERLOAD")
"""Faults that a robot's own motion may cause."""


def endure(
    policy: Path, link: str, minutes: float, seed: int, progress: Progress, out: Path | None
) -> dict[str, Any]:
    """Walk without a fault under commands that change every two seconds.

    Returns the time walked [s]; time and text of each fault; memory [MB] and open handles by
    process, every 30 s since the robot first walked; and figures of each deployment. A robot that
    has fallen is replaced. `out` is written as the rows come.
    """
    rng = np.random.default_rng([29, seed])
    seconds = 60.0 * minutes
    walked = 0.0
    faults: list[tuple[float, str, str]] = []
    rows: list[dict[str, Any]] = []
    runs: list[dict[str, Any]] = []
    while walked < seconds and len(runs) < TRIES + len(faults):
        with served(WALKING_ROBOT, link) as (address, _):
            plan = RunPlan(
                link=Link(robot=WALKING_ROBOT, address=address),
                policy=policy,
                timing=TIMING,
                ignore_latency=True,
            )
            with suppress(HardwareError), Deployment(plan) as deployment:
                while walked < seconds and begin_to_walk(deployment):
                    begun = time.monotonic()
                    due = 0.0
                    while deployment.mode is Mode.POLICY and walked < seconds:
                        _roam(deployment, rng)
                        now = time.monotonic()
                        walked += now - begun
                        begun = now
                        for event in deployment.events_seen():
                            if event.kind == "fault":
                                faults.append((walked, event.reason, event.text))
                        if begun >= due:
                            due = begun + _ROW_S
                            rows.append({"walked_s": walked, "processes": _processes()})
                        if out is not None and rows:
                            figures = {
                                "link": link,
                                "faults": faults,
                                "rows": rows,
                                "runs": runs,
                                "walked_s": walked,
                            }
                            out.write_text(json.dumps(figures))
                        progress(link, walked / seconds)
            runs.append(deployment.summary.figures())
    return {"link": link, "walked_s": walked, "faults": faults, "rows": rows, "runs": runs}


def _roam(deployment: Deployment, rng: np.random.Generator) -> None:
    """Walk for two seconds under one random command."""
    forward, sideways, yaw_rate = (rng.uniform(-1.0, 1.0, 3) * ROAM).tolist()
    velocity: Velocity = (forward, sideways, yaw_rate)

    def command(t: float) -> Velocity:
        return velocity

    drive_until(deployment, 2.0, (Mode.FAULT, Mode.ENDED), command=command)


def _processes() -> dict[str, tuple[float, int]]:
    """Memory [MB] and open handles of each process of a run, and of this one."""
    pids = {"operator": os.getpid()}
    for process in active_children():
        if process.pid is not None:
            pids[process.name] = process.pid
    sizes = {}
    for name, pid in pids.items():
        with suppress(OSError):
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            handles = sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
            sizes[name] = (pages * os.sysconf("SC_PAGE_SIZE") / 1e6, handles)
    return sizes


def _endured(walks: list[dict[str, Any]]) -> console.Outcome:
    """Print what a walk without faults took and met."""
    tables = []
    for walk in walks:
        falls = 0
        for seconds, reason, text in walk["faults"]:
            console.say(f"{walk['link']}, {seconds:.0f} s, {reason}: {text}")
            if reason in _FALLS:
                falls += 1
        lateness = [run["servo"]["lateness"] for run in walk["runs"] if run["servo"]]
        median_ms = max(figures["p50_ms"] for figures in lateness)
        late_ms = max(figures["p99_ms"] for figures in lateness)
        largest_ms = max(figures["max_ms"] for figures in lateness)
        rows = []
        for name in walk["rows"][-1]["processes"]:
            sizes = [row["processes"][name] for row in walk["rows"] if name in row["processes"]]
            memory_before, handles_before = sizes[min(2, len(sizes) - 1)]
            memory_after, handles_after = sizes[-1]
            rows.append((name, memory_before, memory_after, handles_before, handles_after))
        table = Table(
            title=f"{walk['walked_s'] / 60.0:.1f} minutes over {walk['link']} without a fault",
            columns=(
                Column(heading="process"),
                Column(heading="memory, second minute", unit="MB", digits=1),
                Column(heading="memory, end", unit="MB", digits=1),
                Column(heading="handles, second minute"),
                Column(heading="handles, end"),
            ),
            rows=tuple(rows),
            notes=(
                f"{len(walk['faults']) - falls} false alarms, {falls} falls.",
                f"Servo late by {median_ms:.2f} ms (median), {late_ms:.2f} ms (99 %), "
                f"{largest_ms:.2f} ms at most.",
            ),
        )
        tables.append(table)
    return finish({"walks": walks}, *tables)


def _cell(times_ms: list[float], count: int) -> str:
    """Times to damping of the runs of one fault, and how many of `count` were not found."""
    if not count:
        return "not measured"
    words = []
    if times_ms:
        words.append(f"{np.median(times_ms):.0f} ({max(times_ms):.0f})")
    if len(times_ms) < count:
        words.append(f"{count - len(times_ms)} of {count} not found")
    words.append(f"n = {count}")
    return ", ".join(words)


def struck_names(clocks: str) -> list[str]:
    """Names of the faults that are measured: each of a sensor with each of the robot's clocks.

    Args:
        clocks: Of `CLOCKS`, separated by commas. `right` stands without a name: `imu-repeats`, and
            `imu-repeats@stuck`.
    """
    names: list[str] = []
    for clock in clocks.split(","):
        if clock == "right":
            names += FAULTS
            continue
        for fault in SENSOR_FAULTS:
            if fault not in SWAPPED:
                names.append(f"{fault}@{clock}")
    return names


def faults_section(rows: list[Row], command: str) -> str:
    """Write the table of faults, and the list of those that are found late or not at all.

    Args:
        rows: Of `rows_of_faults`.
        command: Command line that measured them.
    """
    groups = sorted({(row["robot"], row["link"]) for row in rows}, reverse=True)
    names: list[str] = []
    for row in rows:
        if row["fault"] not in names:
            names.append(row["fault"])
    headings = [f"{robot}, {link}" for robot, link in groups]
    table = [["fault", *headings, "reasons"], ["---"] * (len(headings) + 2)]
    missed = []
    for fault in names:
        cells = []
        reasons: set[str] = set()
        for robot, link in groups:
            measured = []
            for row in rows:
                same = (row["robot"], row["link"], row["fault"]) == (robot, link, fault)
                if same and row["reason"] != "not measured":
                    measured.append(row)
            timed = [row for row in measured if not math.isnan(row["time_s"])]
            reasons |= {row["reason"] for row in timed}
            times_ms = [1e3 * row["time_s"] for row in timed]
            cells.append(_cell(times_ms, len(measured)))
            lost = len(measured) - len(timed)
            late = 0
            if fault not in SWAPPED:
                late = len([time_ms for time_ms in times_ms if time_ms > 1e3 * BAR_S])
            if lost or late or not measured:
                missed.append(
                    f"`{fault}` ({robot}, {link}): {late} of {len(measured)} later, {lost} not "
                    "found"
                )
        reason_words = ", ".join(f"`{reason}`" for reason in sorted(reasons))
        table.append([f"`{fault}`", *cells, reason_words])
    lines = "\n".join("| " + " | ".join(row) + " |" for row in table)
    bar = f"{1e3 * BAR_S:.0f} ms"
    failures = "".join(f"- {line}\n" for line in missed) or f"All within {bar}.\n"
    return f"""Measured by `{command}`.

{lines}

Longer than {bar}, or not found:

{failures}"""


def sensor_faults(
    policy: tyro.conf.Positional[Path],
    runs: int = 10,
    robots: str = "mini_cheetah,go2",
    links: str = "lcm,dds",
    clocks: str = "right",
    minutes: float = 0.0,
    seed: int = 0,
    jobs: int = 1,
    out: Path | None = None,
    docs: Path | None = None,
) -> console.Outcome:
    """Time from each fault to damping on the wire, over LCM and DDS in real time.

    Args:
        policy: policy.onnx of the Mini Cheetah that walks.
        runs: With each fault, robot and link.
        robots: mini_cheetah, go2, separated by commas.
        links: lcm, lcm-wtw (which carries the robot's own clock), dds, separated by commas; sim too
            with `--minutes`.
        clocks: The robot's own clock from the begin of a fault of a sensor on, of right, stuck,
            fast, jumps, separated by commas.
        minutes: Of walking without a fault over each link, in place of the faults.
        seed: Of the commands of that walk.
        jobs: Runs at a time, each of which takes two cores; more than 1 without real-time priority.
        out: File of rows in JSON, written as they come; faults go on from those that are there.
        docs: Page whose section of these faults is written.
    """
    if minutes > 0.0:
        with console.progress() as report:
            walks = [endure(policy, link, minutes, seed, report, out) for link in links.split(",")]
        return _endured(walks)
    rows = rows_in(out)
    names = struck_names(clocks)
    done = {(row["robot"], row["link"], row["run"], row["fault"]) for row in rows}
    work = []
    count = len(rows)
    for run in range(runs):
        for robot in robots.split(","):
            for link in links.split(","):
                waiting = []
                for fault in names:
                    if (robot, link, run, fault) not in done:
                        waiting.append(fault)
                if waiting:
                    count += len(waiting)
                    work.append(
                        partial(
                            rows_of_faults,
                            robot,
                            policy,
                            link,
                            tuple(waiting),
                            run,
                            real_time=jobs == 1,
                        )
                    )
    with console.progress() as report:
        for row in rows_of(work, jobs, out):
            rows.append(row)
            report("faults", len(rows) / count)
    options = f"--runs {runs} --robots {robots} --links {links} --clocks {clocks}"
    text = faults_section(rows, f"python -m benchmarks sensor-faults POLICY {options}")
    if docs is not None:
        write_section(docs, "faults over LCM and DDS", text)
    console.say(text)
    return console.Outcome(figures={"rows": rows}, wrote=[] if docs is None else [docs])
