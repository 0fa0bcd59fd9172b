"""How punctual a 50 Hz loop is here: idle, beside two CPU hogs, with and without real time.

Each case is a process of its own that paces itself by absolute deadlines and, at each tick, runs a
policy's network on a changing observation, as the policy's process of `pronk deploy` does.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from pronk.deploy.thinker import PRIME_S, WARM_UP
from pronk.errors import PronkError
from pronk.hardware.realtime import Histogram, Pace, Wanted, enter, sleep_until
from pronk.policy.layout import MEASURED_SIZE
from pronk.policy.runtime import load_policy

RATE_HZ = 50.0
HOGS = 2
PRIORITY = 50
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
class Row:
    """What came of a case. Times in ms, as `Histogram.figures` gives them."""

    case: str
    granted: tuple[str, ...]
    """What the operating system said to what was asked for."""
    lateness: dict[str, float | int]
    network: dict[str, float | int]
    """ONNX Runtime alone."""
    missed: int
    """Ticks left out because the one before was not done."""


def run(policy: Path, seconds: float, progress: Callable[[str, float], None]) -> list[Row]:
    """All cases, one after the other.

    Args:
        policy: Whose network runs at each tick.
        seconds: Of each case.
        progress: Told how far each case has come.

    Raises:
        PronkError: Too short a time, the policy cannot be read, or a process did not answer.
    """
    if not seconds * RATE_HZ >= 20:
        raise PronkError(f"{seconds:g} s of ticks; expected 0.4 s or more, 20 s for 99.9 %.")
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


def _loop(case: Case, path: Path, seconds: float, end: Connection) -> None:
    network, feeds = _network(path)
    rng = np.random.default_rng(0)
    seen = 0.1 * rng.standard_normal((16, 1, MEASURED_SIZE)).astype(np.float32)
    granted = enter(
        Wanted(priority=PRIORITY, core=0, lock=True) if case.real_time else Wanted(lock=False)
    )
    lateness, inference = Histogram(), Histogram()
    pace = Pace(RATE_HZ, time.monotonic() + 0.1)
    last = round(seconds * RATE_HZ)
    while pace.tick < last:
        # As `pronk deploy` does, so that the weights are in the cache.
        sleep_until(pace.deadline - PRIME_S)
        network.run(None, feeds)
        sleep_until(pace.deadline)
        lateness.add(time.monotonic() - pace.deadline)
        feeds["measured"] = seen[pace.tick % len(seen)]
        begun = time.monotonic()
        network.run(None, feeds)
        inference.add(time.monotonic() - begun)
        pace.advance(time.monotonic())
    end.send(
        {
            "granted": granted,
            "lateness": lateness.figures(),
            "network": inference.figures(),
            "missed": pace.missed,
        }
    )


def _network(path: Path) -> tuple[Any, dict[str, Any]]:
    """The bare network on one thread, warm, and what it is fed."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    feeds = {node.name: np.zeros((1, node.shape[1]), np.float32) for node in session.get_inputs()}
    for _ in range(WARM_UP):
        session.run(None, feeds)
    return session, feeds


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
        "missed",
    ):
        made.add_column(Text(column), justify="left" if column == "case" else "right")
    for row in rows:
        late = [f"{row.lateness[key]:.3f}" for key in ("p50_ms", "p99_ms", "p99_9_ms", "max_ms")]
        network = [f"{row.network[key]:.3f}" for key in ("p50_ms", "p99_ms")]
        made.add_row(row.case, str(row.lateness["n"]), *late, *network, str(row.missed))
    return made


def figures(rows: list[Row]) -> dict[str, Any]:
    """For JSON."""
    return {row.case: asdict(row) for row in rows}
