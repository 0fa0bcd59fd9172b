"""How punctual a 50 Hz loop is here, and how quick the policy's answer in it.

Idle and beside two CPU hogs, with and without real-time scheduling: each case is a process of its
own that decides as the policy's process of `pronk deploy` does (a state in, a command out, the
network in ONNX Runtime within), in three ways:

- back to back, a thousand times, all in the caches;
- at ticks 20 ms apart, woken by an absolute deadline;
- the same after the rehearsals that `pronk deploy` makes (`pronk.runtime.policy_process`).

Ticks of both kinds take turns in one loop, so that both meet the same computer. Quantiles are the
upper edges of the bins of `Histogram`, 4.7 % wide.
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
from rich.table import Table
from rich.text import Text

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
"""Decisions one after the other."""
LATE_MS, NETWORK_MS = 1.0, 0.2
"""Bars at 99 %, on an idle computer."""
WAYS = ("back to back", "at the tick", "after rehearsals")
_START_S = 60.0


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
class Way:
    """What came of one way in one case. Times in ms, as `Histogram.figures` gives them."""

    lateness: dict[str, float | int]
    """Empty of ticks where there are none: back to back."""
    network: dict[str, float | int]
    """ONNX Runtime alone."""
    decision: dict[str, float | int]
    """From a state to a command: the observation, the network, the targets."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """What came of a case."""

    case: str
    granted: tuple[str, ...]
    """What the operating system said to what was asked for."""
    ways: dict[str, Way]
    """By their names, `WAYS`."""
    missed: int
    """Ticks left out because the one before was not done."""


def run(policy: Path, seconds: float, progress: Callable[[str, float], None]) -> list[Row]:
    """All cases, one after the other.

    Args:
        policy: Which decides at each tick.
        seconds: Of each case; half of its ticks are rehearsed.
        progress: Told how far each case has come.

    Raises:
        PronkError: Too short a time, the policy cannot be read, or a process did not answer.
    """
    if not seconds * RATE_HZ >= 20:
        raise PronkError(f"{seconds:g} s of ticks; expected 0.4 s or more, 40 s for 99.9 %.")
    load_policy(policy)
    rows = []
    for case in CASES:
        progress(case.name, 0.0)
        rows.append(_measured(case, policy, seconds, partial(progress, case.name)))
        progress(case.name, 1.0)
    return rows


def _measured(case: Case, policy: Path, seconds: float, progress: Callable[[float], None]) -> Row:
    context = get_context("spawn")
    answer, end = context.Pipe(duplex=False)
    hogs: list[BaseProcess] = [context.Process(target=_hog, daemon=True) for _ in range(case.hogs)]
    loop = context.Process(target=_loop, args=(case, policy, seconds, end), daemon=True)
    processes = [*hogs, loop]
    try:
        for process in processes:
            process.start()
        end.close()
        begun = time.monotonic()
        while not answer.poll(0.2):
            passed = time.monotonic() - begun
            progress(min(passed / (seconds + 3.0), 1.0))
            if passed > seconds + _START_S:
                raise PronkError(f"the loop of {case.name!r} did not answer; try again.")
        try:
            found: dict[str, Any] = answer.recv()
        except EOFError:
            raise PronkError(f"the loop of {case.name!r} died; try again.") from None
    finally:
        for process in processes:
            process.kill()
            process.join()
    return Row(case=case.name, **found)


def _hog() -> None:
    while True:
        pass


class _Counts:
    """Of one way."""

    def __init__(self) -> None:
        self.lateness, self.network, self.decision = Histogram(), Histogram(), Histogram()

    def way(self) -> Way:
        return Way(**{name: counted.figures() for name, counted in vars(self).items()})


def _loop(case: Case, path: Path, seconds: float, end: Connection) -> None:
    policy = load_policy(path)
    robot = load_robot(policy.contract.robot)
    pilot, stand_in = PolicyRunner(policy, robot), PolicyRunner(policy.sibling(), robot)
    states = _states(standing(policy.contract))
    counts = {way: _Counts() for way in WAYS}

    def warm_up() -> None:
        stand_in.reset()
        stand_in.decide(states[0], (STILL, False), 0.0)

    def decide(number: int, way: str) -> None:
        state = states[number % len(states)]
        begun = time.monotonic()
        pilot.decide(state, (STILL, False), begun)
        counts[way].decision.add(time.monotonic() - begun)
        counts[way].network.add(policy.network_s)

    granted = enter(
        Wanted(priority=PRIORITY, core=0, lock=True) if case.real_time else Wanted(lock=False)
    )
    once, ticked, rehearsed = WAYS
    for _ in range(WARM_UP):
        warm_up()
    for number in range(BACK_TO_BACK):
        decide(number, once)
    pace = Pace(RATE_HZ, time.monotonic() + 0.1)
    last = round(seconds * RATE_HZ)
    while pace.tick < last:
        way = rehearsed if pace.tick % 2 else ticked
        if way is rehearsed:
            warm_up_until(pace.deadline, warm_up)
        else:
            sleep_until(pace.deadline)
        counts[way].lateness.add(time.monotonic() - pace.deadline)
        decide(pace.tick, way)
        pace.advance(time.monotonic())
    ways = {way: counted.way() for way, counted in counts.items()}
    end.send({"granted": granted, "ways": ways, "missed": pace.missed})


def _states(still: State) -> list[State]:
    """States of a robot that fidgets."""
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
    """The bars of the loop as `pronk deploy` runs it, on an idle computer."""
    idle = {case.name for case in CASES if not case.hogs}
    found = []
    for row in rows:
        if row.case not in idle:
            continue
        way = row.ways[WAYS[-1]]
        for what, figures, bar in (
            ("lateness", way.lateness, LATE_MS),
            ("network", way.network, NETWORK_MS),
        ):
            name = f"{row.case}: {what}, 99 %"
            found.append(
                Check(what=name, value=figures["p99_ms"], sense="<=", limit=bar, unit="ms")
            )
    return found


def table(rows: list[Row]) -> Table:
    """The rows, for reading."""
    made = Table(title=Text(f"A {RATE_HZ:g} Hz loop on this computer [ms]"), title_justify="left")
    for column in (
        "case",
        "n",
        "late: median",
        "99 %",
        "99.9 %",
        "largest",
        "network: median",
        "99 %",
        "decision: median",
        "99 %",
        "missed",
    ):
        made.add_column(Text(column), justify="left" if column == "case" else "right")
    for row in rows:
        made.add_row(row.case, *[""] * 9, str(row.missed), style="bold")
        for name, way in row.ways.items():
            late = [_number(way.lateness, f"{key}_ms") for key in ("p50", "p99", "p99_9", "max")]
            quick = [
                _number(figures, key)
                for figures in (way.network, way.decision)
                for key in ("p50_ms", "p99_ms")
            ]
            made.add_row(f"  {name}", str(way.network["n"]), *late, *quick, "")
    return made


def _number(figures: dict[str, float | int], key: str) -> str:
    return f"{figures[key]:.3f}" if figures["n"] else ""


def bars(rows: list[Row]) -> Table:
    """The bars and whether they are met, for reading."""
    made = Table(title=Text("Bars, after rehearsals"), title_justify="left")
    for column in ("what", "measured [ms]", "bar [ms]", "passed"):
        made.add_column(Text(column), justify="left" if column == "what" else "right")
    for check in checks(rows):
        word = "yes" if check.passed else "NO"
        made.add_row(check.what, f"{check.value:.3f}", f"{check.sense} {check.limit:g}", word)
    return made


def figures(rows: list[Row]) -> dict[str, Any]:
    """For JSON."""
    return {
        "cases": {row.case: asdict(row) for row in rows},
        "bars": [check.row() for check in checks(rows)],
    }
