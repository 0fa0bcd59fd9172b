"""The progress of a study as a table and as a line."""

from __future__ import annotations

import math
from datetime import timedelta

from pronk.jump.study.schedule import StudyProgress, TaskStatus
from pronk.tables import Cell, Column, Table

_ORDER = ("failed", "running", "waiting", "done", "kept", "skipped")
"""States in the order in which a table with too many rows shows them."""


def progress_line(progress: StudyProgress) -> str:
    """Return counts, the rate of all trainings together and the time left, in one line."""
    parts = []
    for kind in ("training", "trial"):
        statuses = [status for status in progress.tasks if status.kind == kind]
        if not statuses:
            continue
        done = sum(status.state in ("done", "kept") for status in statuses)
        running = sum(status.state == "running" for status in statuses)
        text = f"{kind}s: {done} of {len(statuses)} done, {running} running"
        failed = sum(status.state in ("failed", "skipped") for status in statuses)
        if failed:
            text += f", {failed} FAILED"
        parts.append(text)
    rate = total_rate(progress)
    if rate > 0.0:
        parts.append(f"{rate:,.0f} steps/s together")
    parts.append(f"{duration(progress.seconds)} so far")
    parts.append(f"{duration(progress.seconds_left)} left")
    return "; ".join(parts)


def total_rate(progress: StudyProgress) -> float:
    """Return the rate of all running trainings together [steps/s]."""
    rate = 0.0
    for status in progress.tasks:
        if status.progress is not None and status.state == "running":
            rate += status.progress.steps_per_second
    return rate


def progress_table(progress: StudyProgress, rows: int) -> Table:
    """Return a row for each training, those that run or have failed first.

    Args:
        progress: What is shown.
        rows: Largest number of rows.
    """
    trainings = [status for status in progress.tasks if status.kind == "training"]
    trainings.sort(key=lambda status: _ORDER.index(status.state))
    table_rows: list[tuple[Cell, ...]] = []
    for status in trainings[:rows]:
        table_rows.append(_row(status))
    return Table(
        title="",
        columns=(
            Column(heading="training"),
            Column(heading="state"),
            Column(heading="on"),
            Column(heading="phase"),
            Column(heading="iterations"),
            Column(heading="steps/s", digits=0),
            Column(heading="reward", digits=2),
            Column(heading="left"),
        ),
        rows=tuple(table_rows),
    )


def _row(status: TaskStatus) -> tuple[Cell, ...]:
    state = status.state if status.attempts < 2 else f"{status.state}, start {status.attempts}"
    progress = status.progress
    if progress is None or status.state != "running":
        return (status.name, state, status.place, "", "", None, None, "")
    return (
        status.name,
        state,
        status.place,
        progress.phase,
        f"{progress.iteration}/{progress.iterations}",
        progress.steps_per_second,
        progress.reward,
        duration(progress.seconds_left),
    )


def duration(seconds: float) -> str:
    """Return a duration as h:mm:ss; `?` if it is not known."""
    if not math.isfinite(seconds):
        return "?"
    return str(timedelta(seconds=round(seconds)))
