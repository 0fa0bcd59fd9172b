"""The loop over the tasks of a study: what may start, what ended, what is left, in which time.

    outcomes = run_tasks(tasks, executor, root, report=show)

`Executor` is where tasks run: processes of this host, or the nodes of a Ray cluster. A task that
fails is started once more, and named if it fails again, while the others go on. A task that is lost
with its node does not count as failed.
"""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol

from pronk.errors import PronkError
from pronk.jump.study.tasks import LOGS, StudyState, StudyTask, TaskRecord, last_lines
from pronk.jump.train.training_progress import TrainingProgress, read_progress

POLL_S = 0.2
"""Time between two looks at the tasks [s]."""
ATTEMPTS = 2
"""Largest number of failures of a task before it is given up."""
LOSSES = 10
"""Largest number of times that a task is lost with its node before it is given up."""


@dataclass(frozen=True, kw_only=True)
class TaskEnd:
    """A task whose command has ended."""

    name: str
    ended: Literal["well", "failed", "lost"]
    """lost: its node or its process on another node is gone."""
    reason: str = ""


class Executor(Protocol):
    """Where tasks run."""

    def try_start(self, task: StudyTask) -> str:
        """Start a task if there is room; return where it runs, or nothing if there is no room."""

    def poll(self) -> list[TaskEnd]:
        """Return the tasks that have ended since the last call."""

    def stop(self) -> None:
        """End all tasks, trainings at a checkpoint, and wait until they have ended."""

    def rooms(self) -> int:
        """Return how many trainings run at once when there are enough."""


@dataclass(frozen=True, kw_only=True)
class TaskStatus:
    """What is shown of a task while a study runs."""

    name: str
    kind: str
    state: Literal["waiting", "running", "done", "kept", "failed", "skipped"]
    """kept: done before this command. skipped: a task that it needs has failed."""
    place: str = ""
    progress: TrainingProgress | None = None
    """Progress of a training."""
    seconds: float = math.nan
    """Wall time of this attempt so far [s]; NaN if it has not begun."""
    attempts: int = 0
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class StudyProgress:
    """What is shown of a study while it runs."""

    tasks: tuple[TaskStatus, ...]
    seconds: float
    """Wall time since this command began [s]."""
    seconds_left: float
    """Estimated time until all trainings and trials are done [s]; NaN if nothing is known yet."""

    def count(self, *states: str) -> int:
        """Return the number of tasks in some states."""
        return sum(status.state in states for status in self.tasks)


@dataclass(kw_only=True)
class _Running:
    task: StudyTask
    place: str
    begun: float


class _Loop:
    """The states of all tasks while they run."""

    def __init__(self, tasks: Sequence[StudyTask], executor: Executor, root: Path) -> None:
        self.tasks = {task.name: task for task in tasks}
        if len(self.tasks) != len(tasks):
            raise PronkError("two tasks of the study have one name; give arms other names.")
        self.executor = executor
        self.root = root
        self.state = StudyState(root)
        self.state.check_settings([task for task in tasks if not task.needs])
        self.statuses: dict[str, TaskStatus] = {}
        self.running: dict[str, _Running] = {}
        self.failures = dict.fromkeys(self.tasks, 0)
        self.losses = dict.fromkeys(self.tasks, 0)
        self.durations: dict[str, list[float]] = {"training": [], "trial": []}
        self.keys: dict[str, str] = {}
        """Hashes of the tasks that were ready to start."""
        for task in tasks:
            is_ready = all(self.statuses[name].state == "kept" for name in task.needs)
            state: Literal["waiting", "kept"] = "waiting"
            if is_ready and self.state.is_done(task):
                state = "kept"
            self.statuses[task.name] = TaskStatus(name=task.name, kind=task.kind, state=state)

    def is_over(self) -> bool:
        """Return whether no task waits or runs."""
        states = {status.state for status in self.statuses.values()}
        return states.isdisjoint(("waiting", "running"))

    def collect(self) -> None:
        """Take note of the tasks that have ended."""
        for end in self.executor.poll():
            running = self.running.pop(end.name)
            seconds = time.monotonic() - running.begun
            record = self.state.records[end.name]
            record.seconds = seconds
            reason = end.reason
            if end.ended == "well":
                record = self.state.finish(running.task, record)
                reason = record.reason
            if record.status == "done":
                self.durations[running.task.kind].append(seconds)
                self._set(end.name, state="done", seconds=seconds, reason="")
                continue
            if end.ended == "lost":
                self.losses[end.name] += 1
            else:
                self.failures[end.name] += 1
            gives_up = self.failures[end.name] >= ATTEMPTS or self.losses[end.name] > LOSSES
            record.status = "failed" if gives_up else "started"
            record.reason = reason
            self.state.set(end.name, record)
            self._set(end.name, state="failed" if gives_up else "waiting", reason=reason)

    def start(self) -> None:
        """Start what is ready and has room; skip what needs a task that has failed."""
        full: set[tuple[str, bool, float]] = set()
        for name, status in self.statuses.items():
            if status.state != "waiting":
                continue
            task = self.tasks[name]
            # Where one had no room no other that needs the same has any.
            needs = (task.kind, task.gpu, task.cores)
            if needs in full:
                continue
            needed = [self.statuses[need] for need in task.needs]
            failed = [need.name for need in needed if need.state in ("failed", "skipped")]
            if failed:
                self._set(name, state="skipped", reason=f"{failed[0]} has failed")
                continue
            if any(need.state not in ("done", "kept") for need in needed):
                continue
            if name not in self.keys:
                self.keys[name] = task.key(self.root)
                if self.failures[name] + self.losses[name] == 0 and self.state.is_done(task):
                    self._set(name, state="kept")
                    continue
            goes_on = task.goes_on(self.root)
            place = self.executor.try_start(task)
            if not place:
                full.add(needs)
                continue
            attempts = self.failures[name] + self.losses[name] + 1
            record = TaskRecord(
                key=self.keys[name], status="started", attempts=attempts, place=place
            )
            self.state.start(task, record, goes_on=goes_on)
            self.running[name] = _Running(task=task, place=place, begun=time.monotonic())
            self._set(name, state="running", place=place, attempts=attempts)

    def progress(self, seconds: float) -> StudyProgress:
        """Return what is shown, with the progress of running trainings read anew."""
        for name, running in self.running.items():
            progress = None
            if running.task.kind == "training":
                progress = read_progress(self.root / running.task.folder)
            self._set(name, progress=progress, seconds=time.monotonic() - running.begun)
        return StudyProgress(
            tasks=tuple(self.statuses.values()),
            seconds=seconds,
            seconds_left=self._seconds_left(),
        )

    def _seconds_left(self) -> float:
        """Estimate when all is done, trainings first and the trials of the last one behind."""
        left = 0.0
        for kind in ("training", "trial"):
            remaining = []
            durations = list(self.durations[kind])
            waiting = 0
            for status in self.statuses.values():
                if status.kind != kind:
                    continue
                waiting += status.state == "waiting"
                if status.state == "running":
                    seconds = math.nan
                    if status.progress is not None:
                        seconds = status.progress.seconds_left
                        durations.append(status.seconds + seconds)
                    remaining.append(seconds)
            if not remaining and not waiting:
                continue
            mean = sum(durations) / len(durations) if durations else math.nan
            if math.isnan(mean):
                # Nothing is known of trials until the first is done; trainings are most of it.
                if kind == "trial" and left > 0.0:
                    continue
                return math.nan
            for index, seconds in enumerate(remaining):
                if math.isnan(seconds):
                    remaining[index] = mean
            left += time_left(remaining, [mean] * waiting, max(self.executor.rooms(), 1))
        return left

    def _set(self, name: str, **changes: object) -> None:
        self.statuses[name] = replace(self.statuses[name], **changes)  # type: ignore[arg-type]


def time_left(running: Sequence[float], waiting: Sequence[float], rooms: int) -> float:
    """Return when the last task ends if each waiting one takes the room that is free first [s].

    Args:
        running: Times that the running tasks still need [s].
        waiting: Times that the waiting tasks need, in their order [s].
        rooms: How many tasks run at once.
    """
    ends = list(running)
    ends += [0.0] * max(rooms - len(ends), 0)
    heapq.heapify(ends)
    for seconds in waiting:
        heapq.heapreplace(ends, ends[0] + seconds)
    return max(ends, default=0.0)


def run_tasks(
    tasks: Sequence[StudyTask],
    executor: Executor,
    root: Path,
    *,
    report: Callable[[StudyProgress], None],
) -> Mapping[str, TaskStatus]:
    """Run all tasks that are not done yet.

    Args:
        tasks: The tasks, each behind those that it needs.
        executor: Where they run.
        root: Folder of the study.
        report: Called at every look with what is shown.

    Returns:
        The last status of each task, by its name.

    Raises:
        PronkError: A training was begun in the folder with other settings; nothing was started.
        KeyboardInterrupt: The command was interrupted; running trainings wrote a checkpoint.
    """
    (root / LOGS).mkdir(parents=True, exist_ok=True)
    loop = _Loop(tasks, executor, root)
    begun = time.monotonic()
    try:
        while True:
            loop.collect()
            loop.start()
            report(loop.progress(time.monotonic() - begun))
            if loop.is_over():
                return loop.statuses
            time.sleep(POLL_S)
    finally:
        executor.stop()


def end_of_log(root: Path, task: StudyTask) -> str:
    """Return the last lines of a task's log with its path, for the reason of a failure."""
    return f"{last_lines(root / task.log())} (whole log: {root / task.log()})"
