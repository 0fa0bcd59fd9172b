"""`python -m benchmarks latency`: lateness of a 50 Hz loop, and how long the policy takes in it.

Idle and beside two CPU hogs, with and without real-time scheduling: each case is a process of its
own that runs the policy as the policy process of `pronk deploy` does (a state in, targets out,
ONNX Runtime within), in three ways:

- back to back, a thousand times;
- at ticks 20 ms apart, woken by an absolute deadline;
- the same after the warm-up of `pronk deploy` (`warm_up_until` in `pronk.runtime.policy_process`).

Ticks of both kinds alternate in one loop. Quantiles are the upper edges of the bins of
`Histogram`, 4.7 % wide.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.runner import Progress, table
from pronk.cli import console
from pronk.errors import PronkError
from pronk.evaluation.criteria import Check
from pronk.links.machine import State
from pronk.links.realtime import Histogram, Pace, Wanted, enter, sleep_until
from pronk.policy.runtime import load_policy
from pronk.robots import load_robot
from pronk.runtime.policy_process import WARM_UP, standing, warm_up_until
from pronk.runtime.rollout import PolicyRunner
from pronk.runtime.script import STILL

RATE_HZ = 50.0
HOGS = 2
PRIORITY = 50
BACK_TO_BACK = 1000
LATE_MS, NETWORK_MS = 1.0, 0.2
"""Limits at 99 %, on an idle computer."""
WAYS = ("back to back", "at the tick", "after warm-up")
START_S = 60.0
"""Longest time that a process may take to start."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One way to run the loop."""

    name: str
    hogs: int
    """Processes that compute without end beside it."""
    real_time: bool


CASES = tuple(
    Case(name=f"{'two CPU hogs' if hogs else 'idle'}, {how}", hogs=hogs, real_time=real_time)
    for hogs in (0, HOGS)
    for real_time, how in ((False, "ordinary"), (True, "real time"))
)


@dataclass(frozen=True, kw_only=True)
class Row:
    """Figures of a case."""

    case: str
    granted: tuple[str, ...]
    """Replies of the operating system to the requested priority, core and memory lock."""
    ways: dict[str, dict[str, dict[str, float | int]]]
    """By name (`WAYS`): `lateness` (empty back to back), `network` (ONNX Runtime alone) and
    `decision` (observation, network, targets), each as `Histogram.figures` gives them [ms]."""
    missed: int
    """Ticks left out because the one before was not done."""


def run(policy: Path, seconds: float, progress: Progress) -> list[Row]:
    """All cases, one after the other.

    Args:
        policy: Runs at each tick.
        seconds: Of each case; half of its ticks follow a warm-up.
        progress: Called with the case and its share.

    Raises:
        PronkError: Too short a time, the policy cannot be read, or a process died.
    """
    if not seconds * RATE_HZ >= 20:
        raise PronkError(f"{seconds:g} s of ticks; expected 0.4 s or more, 40 s for 99.9 %.")
    load_policy(policy)
    return [_measure(case, policy, seconds, partial(progress, case.name)) for case in CASES]


def _measure(case: Case, policy: Path, seconds: float, progress: Callable[[float], None]) -> Row:
    context = get_context("spawn")
    result, end = context.Pipe(duplex=False)
    processes: list[BaseProcess] = [
        context.Process(target=_hog, daemon=True) for _ in range(case.hogs)
    ]
    processes.append(context.Process(target=_loop, args=(case, policy, seconds, end), daemon=True))
    try:
        for process in processes:
            process.start()
        end.close()
        begun = time.monotonic()
        while not result.poll(0.2):
            passed = time.monotonic() - begun
            progress(min(passed / (seconds + 3.0), 1.0))
            if passed > seconds + START_S:
                raise PronkError(f"the loop of {case.name!r} did not finish; try again.")
        try:
            found: dict[str, Any] = result.recv()
        except EOFError:
            raise PronkError(f"the loop of {case.name!r} died; try again.") from None
    finally:
        for process in processes:
            process.kill()
            process.join()
    progress(1.0)
    return Row(case=case.name, **found)


def _hog() -> None:
    while True:
        pass


def _loop(case: Case, path: Path, seconds: float, end: Connection) -> None:
    policy = load_policy(path)
    robot = load_robot(policy.contract.robot)
    runner, stand_in = PolicyRunner(policy, robot), PolicyRunner(policy.sibling(), robot)
    states = _states(standing(policy.contract))
    counts = {
        way: {name: Histogram() for name in ("lateness", "network", "decision")} for way in WAYS
    }

    def warm_up() -> None:
        stand_in.reset()
        stand_in.decide(states[0], (STILL, False), 0.0)

    def decide(number: int, way: str) -> None:
        state = states[number % len(states)]
        begun = time.monotonic()
        runner.decide(state, (STILL, False), begun)
        counts[way]["decision"].add(time.monotonic() - begun)
        counts[way]["network"].add(policy.network_s)

    granted = enter(
        Wanted(priority=PRIORITY, core=0, lock=True) if case.real_time else Wanted(lock=False)
    )
    once, ticked, warmed = WAYS
    for _ in range(WARM_UP):
        warm_up()
    for number in range(BACK_TO_BACK):
        decide(number, once)
    pace = Pace(RATE_HZ, time.monotonic() + 0.1)
    last = round(seconds * RATE_HZ)
    while pace.tick < last:
        way = warmed if pace.tick % 2 else ticked
        if way is warmed:
            warm_up_until(pace.deadline, warm_up)
        else:
            sleep_until(pace.deadline)
        counts[way]["lateness"].add(time.monotonic() - pace.deadline)
        decide(pace.tick, way)
        pace.advance(time.monotonic())
    ways = {
        way: {name: histogram.figures() for name, histogram in counted.items()}
        for way, counted in counts.items()
    }
    end.send({"granted": granted, "ways": ways, "missed": pace.missed})


def _states(still: State) -> list[State]:
    """States of a standing robot that moves a little."""
    rng = np.random.default_rng(0)
    size = len(still.position)
    return [
        replace(
            still,
            position=still.position + 0.05 * rng.standard_normal(size),
            velocity=rng.standard_normal(size),
            gyro=0.1 * rng.standard_normal(3),
        )
        for _ in range(16)
    ]


def checks(rows: list[Row]) -> list[Check]:
    """The limits for the loop as `pronk deploy` runs it, on an idle computer."""
    idle = {case.name for case in CASES if not case.hogs}
    return [
        Check(
            what=f"{row.case}: {name}, 99 %",
            value=row.ways[WAYS[-1]][name]["p99_ms"],
            sense="<=",
            limit=limit,
            unit="ms",
        )
        for row in rows
        if row.case in idle
        for name, limit in (("lateness", LATE_MS), ("network", NETWORK_MS))
    ]


def latency(
    policy: tyro.conf.Positional[Path],
    seconds: float = 40.0,
    json_file: console.JsonFile = None,
) -> None:
    """Lateness and latency of the policy at 50 Hz: idle, beside CPU hogs, real time or not.

    Args:
        policy: policy.onnx, which runs at each tick.
        seconds: Of each of the four cases.
        json_file: Also write the figures to this file.
    """
    with console.progress() as report:
        rows = run(policy, seconds, report)
    found = checks(rows)
    cells = []
    for row in rows:
        cells.append((row.case, *[""] * 9, str(row.missed)))
        for way, figures in row.ways.items():
            keys = {"lateness": ("p50", "p99", "p99_9", "max"), "network": ("p50", "p99")}
            keys["decision"] = keys["network"]
            numbers = [
                f"{figures[name][f'{key}_ms']:.3f}" if figures[name]["n"] else ""
                for name, chosen in keys.items()
                for key in chosen
            ]
            cells.append((f"  {way}", str(figures["network"]["n"]), *numbers, ""))
    columns = ["case", "n", "late: median", "99 %", "99.9 %", "largest", "network: median", "99 %"]
    columns += ["decision: median", "99 %", "missed"]
    console.show(table(f"A {RATE_HZ:g} Hz loop on this computer [ms]", columns, cells))
    limits = [
        (
            check.what,
            f"{check.value:.3f}",
            f"{check.sense} {check.limit:g}",
            "yes" if check.passed else "NO",
        )
        for check in found
    ]
    columns = ["what", "measured [ms]", "limit [ms]", "passed"]
    console.show(table("Limits, after warm-up", columns, limits))
    for line in dict.fromkeys(line for row in rows for line in row.granted):
        console.say(line)
    body = {row.case: asdict(row) for row in rows}
    console.write_json(json_file, {"cases": body, "limits": [check.row() for check in found]})
