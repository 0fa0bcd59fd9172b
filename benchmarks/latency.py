"""`python -m benchmarks latency`: lateness of a 50 Hz loop, and how long the policy takes in it.

Idle and beside two CPU hogs, with and without real-time scheduling: each case is a process of its
own that runs the policy as the policy process of `pronk deploy` does (a state in, targets out,
ONNX Runtime within), in three ways:

- back to back, a thousand times;
- at ticks 20 ms apart, woken by an absolute deadline;
- the same after the warm-up of `pronk deploy` (`warm_up_until` in
  `pronk.deploy.runtime.policy_process`).

Ticks of both kinds alternate in one loop. Quantiles are the upper edges of the bins of
`Histogram`, 4.7 % wide.
"""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor, TimeoutError, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.runner import Progress, finish
from pronk.cli import console
from pronk.deploy.links.realtime import Histogram, Pace, RealTimeSettings, enter, sleep_until
from pronk.deploy.runtime.policy_process import WARM_UP, standing, warm_up_until
from pronk.errors import PronkError
from pronk.jump.trial.criteria import Check
from pronk.policy.rollout import measurement
from pronk.policy.runtime import load_policy
from pronk.policy.script import STILL
from pronk.robots.machine import State
from pronk.tables import Cell, Column, Table

RATE_HZ = 50.0
PRIORITY = 50
BACK_TO_BACK = 1000
LIMITS_MS = {"lateness": 1.0, "network": 0.2}
"""At 99 %, after warm-up on an idle computer."""
WAYS = ("back to back", "at the tick", "after warm-up")
START_S = 60.0
"""Longest time that a process may take to start."""
QUANTITIES = ("lateness", "network", "decision")
"""What is measured; `network` is ONNX Runtime alone, `decision` is observation, network and
targets."""

Row = dict[str, Any]
"""Figures of a case: `granted` (replies of the operating system to the requested priority, core and
memory lock), `ways` (by way and quantity as `Histogram.figures` gives them [ms]; no lateness back
to back), `missed` (ticks left out because the one before was not done)."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One way to run the loop."""

    name: str
    hogs: int
    """Processes that compute without end beside it."""
    real_time: bool


CASES = (
    Case(name="idle, ordinary", hogs=0, real_time=False),
    Case(name="idle, real time", hogs=0, real_time=True),
    Case(name="two CPU hogs, ordinary", hogs=2, real_time=False),
    Case(name="two CPU hogs, real time", hogs=2, real_time=True),
)


def run(policy: Path, seconds: float, progress: Progress) -> dict[str, Row]:
    """Run all cases one after the other, `seconds` each; half of the ticks follow a warm-up.

    Raises:
        PronkError: Too short a time, the policy cannot be read, or a process died.
    """
    if not seconds * RATE_HZ >= 20:
        raise PronkError(f"{seconds:g} s of ticks; expected 0.4 s or more, 40 s for 99.9 %.")
    load_policy(policy)
    return {case.name: _measure(case, policy, seconds, progress) for case in CASES}


def _measure(case: Case, policy: Path, seconds: float, progress: Progress) -> Row:
    context = get_context("spawn")
    hogs = [context.Process(target=_hog, daemon=True) for _ in range(case.hogs)]
    for hog in hogs:
        hog.start()
    pool = ProcessPoolExecutor(1, mp_context=context)
    try:
        begun = time.monotonic()
        loop = pool.submit(_loop, case, policy, seconds)
        while not wait([loop], timeout=0.2).done:
            passed = time.monotonic() - begun
            progress(case.name, passed / (seconds + 3.0))
            if passed > seconds + START_S:
                raise TimeoutError
        progress(case.name, 1.0)
        return loop.result()
    except (BrokenProcessPool, TimeoutError):
        raise PronkError(f"the loop of {case.name!r} did not finish; try again.") from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for hog in hogs:
            hog.kill()
            hog.join()


def _hog() -> None:
    while True:
        pass


def _loop(case: Case, path: Path, seconds: float) -> Row:
    policy = load_policy(path)
    stand_in = policy.sibling()
    states = _states(standing(policy.start_position))
    histograms: dict[str, dict[str, Histogram]] = {}
    for way in WAYS:
        histograms[way] = {name: Histogram() for name in QUANTITIES}

    def warm_up() -> None:
        stand_in.reset()
        stand_in.step(measurement(states[0]), STILL)

    def decide(number: int, way: str) -> None:
        state = states[number % len(states)]
        begun = time.monotonic()
        policy.step(measurement(state), STILL)
        histograms[way]["decision"].add(time.monotonic() - begun)
        histograms[way]["network"].add(policy.network_s)

    real_time = RealTimeSettings(priority=PRIORITY, core=0, lock=True)
    granted = enter(real_time if case.real_time else RealTimeSettings(lock=False))
    once, ticked, warmed = WAYS
    for _ in range(WARM_UP):
        warm_up()
    for number in range(BACK_TO_BACK):
        decide(number, once)
    pace = Pace(RATE_HZ, time.monotonic() + 0.1)
    while pace.tick < round(seconds * RATE_HZ):
        way = warmed if pace.tick % 2 else ticked
        if way is warmed:
            warm_up_until(pace.deadline, warm_up)
        else:
            sleep_until(pace.deadline)
        histograms[way]["lateness"].add(time.monotonic() - pace.deadline)
        decide(pace.tick, way)
        pace.advance(time.monotonic())
    ways: dict[str, dict[str, Any]] = {}
    for way, of_way in histograms.items():
        ways[way] = {name: histogram.figures() for name, histogram in of_way.items()}
    return {"case": case.name, "granted": granted, "ways": ways, "missed": pace.missed}


def _states(still: State) -> list[State]:
    """States of a standing robot that moves a little."""
    rng = np.random.default_rng(0)
    size = len(still.position)
    states = []
    for _ in range(16):
        state = replace(
            still,
            position=still.position + 0.05 * rng.standard_normal(size),
            velocity=rng.standard_normal(size),
            gyro=0.1 * rng.standard_normal(3),
        )
        states.append(state)
    return states


def checks(rows: dict[str, Row]) -> list[Check]:
    """Return the limits for the loop as `pronk deploy` runs it, on an idle computer."""
    limit_checks = []
    for case in CASES:
        if case.hogs:
            continue
        figures = rows[case.name]["ways"][WAYS[-1]]
        for name, limit in LIMITS_MS.items():
            check = Check(
                name=f"{case.name}: {name}, 99 %",
                value=figures[name]["p99_ms"],
                sense="<=",
                limit=limit,
                unit="ms",
            )
            limit_checks.append(check)
    return limit_checks


def latency(
    policy: tyro.conf.Positional[Path],
    seconds: float = 40.0,
) -> console.Outcome:
    """Lateness and latency of the policy at 50 Hz: idle, beside CPU hogs, real time or not.

    Args:
        policy: policy.onnx, which runs at each tick.
        seconds: Of each of the four cases.
    """
    with console.progress() as report:
        rows = run(policy, seconds, report)
    limit_checks = checks(rows)
    figures = {"cases": rows, "limits": [check.row() for check in limit_checks]}
    return finish(figures, _measured_table(rows), _limit_table(limit_checks))


def _measured_table(rows: dict[str, Row]) -> Table:
    """Return the quantiles of every case and way."""
    table_rows: list[tuple[Cell, ...]] = []
    for name, row in rows.items():
        for way, figures in row["ways"].items():
            late = figures["lateness"]
            network = figures["network"]
            decision = figures["decision"]
            cells: list[Cell] = [f"{name}: {way}", network["n"]]
            for key in ("p50_ms", "p99_ms", "p99_9_ms", "max_ms"):
                cells.append(late[key] if late["n"] else None)
            cells += [network["p50_ms"], network["p99_ms"]]
            cells += [decision["p50_ms"], decision["p99_ms"], row["missed"]]
            table_rows.append(tuple(cells))
    return Table(
        title=f"A {RATE_HZ:g} Hz loop on this computer [ms]",
        columns=(
            Column(heading="case"),
            Column(heading="n"),
            Column(heading="late: median"),
            Column(heading="99 %"),
            Column(heading="99.9 %"),
            Column(heading="largest"),
            Column(heading="network: median"),
            Column(heading="99 %"),
            Column(heading="decision: median"),
            Column(heading="99 %"),
            Column(heading="missed"),
        ),
        rows=tuple(table_rows),
    )


def _limit_table(limit_checks: list[Check]) -> Table:
    """Return the figures with a limit."""
    rows = []
    for check in limit_checks:
        passed = "yes" if check.passed else "NO"
        rows.append((check.name, check.value, f"{check.sense} {check.limit:g}", passed))
    return Table(
        title="Limits, after warm-up",
        columns=(
            Column(heading="figure"),
            Column(heading="measured", unit="ms"),
            Column(heading="limit", unit="ms"),
            Column(heading="passed"),
        ),
        rows=tuple(rows),
    )
