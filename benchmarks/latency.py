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
from pronk.deploy.links.realtime import Histogram, Pace, Wanted, enter, sleep_until
from pronk.deploy.runtime.policy_process import WARM_UP, standing, warm_up_until
from pronk.errors import PronkError
from pronk.jump.trial.criteria import Check
from pronk.policy.rollout import measurement
from pronk.policy.runtime import load_policy
from pronk.policy.script import STILL
from pronk.robots.machine import State

RATE_HZ = 50.0
PRIORITY = 50
BACK_TO_BACK = 1000
LIMITS_MS = {"lateness": 1.0, "network": 0.2}
"""At 99 %, after warm-up on an idle computer."""
WAYS = ("back to back", "at the tick", "after warm-up")
START_S = 60.0
"""Longest time that a process may take to start."""
QUANTILES = {"lateness": ("p50", "p99", "p99_9", "max"), "network": ("p50", "p99")}
QUANTILES["decision"] = QUANTILES["network"]
"""Columns of the table; `network` is ONNX Runtime alone, `decision` is observation, network and
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


CASES = tuple(
    Case(name=f"{'two CPU hogs' if hogs else 'idle'}, {how}", hogs=hogs, real_time=real_time)
    for hogs in (0, 2)
    for real_time, how in ((False, "ordinary"), (True, "real time"))
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
        found, begun = pool.submit(_loop, case, policy, seconds), time.monotonic()
        while not wait([found], timeout=0.2).done:
            passed = time.monotonic() - begun
            progress(case.name, passed / (seconds + 3.0))
            if passed > seconds + START_S:
                raise TimeoutError
        progress(case.name, 1.0)
        return found.result()
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
    states = _states(standing(policy.contract))
    counts = {way: {name: Histogram() for name in QUANTILES} for way in WAYS}

    def warm_up() -> None:
        stand_in.reset()
        stand_in.step(measurement(states[0]), STILL)

    def decide(number: int, way: str) -> None:
        state = states[number % len(states)]
        begun = time.monotonic()
        policy.step(measurement(state), STILL)
        counts[way]["decision"].add(time.monotonic() - begun)
        counts[way]["network"].add(policy.network_s)

    real_time = Wanted(priority=PRIORITY, core=0, lock=True)
    granted = enter(real_time if case.real_time else Wanted(lock=False))
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
        counts[way]["lateness"].add(time.monotonic() - pace.deadline)
        decide(pace.tick, way)
        pace.advance(time.monotonic())
    ways = {
        way: {name: histogram.figures() for name, histogram in counted.items()}
        for way, counted in counts.items()
    }
    return {"case": case.name, "granted": granted, "ways": ways, "missed": pace.missed}


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


def checks(rows: dict[str, Row]) -> list[Check]:
    """The limits for the loop as `pronk deploy` runs it, on an idle computer."""
    return [
        Check(
            name=f"{case.name}: {name}, 99 %",
            value=rows[case.name]["ways"][WAYS[-1]][name]["p99_ms"],
            sense="<=",
            limit=limit,
            unit="ms",
        )
        for case in CASES
        if not case.hogs
        for name, limit in LIMITS_MS.items()
    ]


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
    cells = []
    for name, row in rows.items():
        cells.append((name, *[""] * 9, str(row["missed"])))
        for way, figures in row["ways"].items():
            numbers = [
                f"{figures[what][f'{key}_ms']:.3f}" if figures[what]["n"] else ""
                for what, keys in QUANTILES.items()
                for key in keys
            ]
            cells.append((f"  {way}", str(figures["network"]["n"]), *numbers, ""))
    columns = ["case", "n", "late: median", "99 %", "99.9 %", "largest", "network: median", "99 %"]
    columns += ["decision: median", "99 %", "missed"]
    measured = console.table(f"A {RATE_HZ:g} Hz loop on this computer [ms]", columns, cells)
    found = checks(rows)
    limits = [
        (c.name, f"{c.value:.3f}", f"{c.sense} {c.limit:g}", "yes" if c.passed else "NO")
        for c in found
    ]
    columns = ["what", "measured [ms]", "limit [ms]", "passed"]
    figures = {"cases": rows, "limits": [check.row() for check in found]}
    return finish(figures, measured, console.table("Limits, after warm-up", columns, limits))
    for line in dict.fromkeys(line for row in rows.values() for line in row["granted"]):
        console.say(line)
