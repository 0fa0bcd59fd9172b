"""Walking: one velocity for a long time (paper R4), many times, as `walk.json`.

The figures of one walk are in `pronk.evaluation.walk_metrics`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from pronk.evaluation import result_io as sheet
from pronk.evaluation.job import Job, body, flight
from pronk.evaluation.processes import in_processes
from pronk.evaluation.protocol import Case
from pronk.evaluation.run import Plan, jobs_of
from pronk.evaluation.subjects import load_subjects
from pronk.evaluation.summary import Spread
from pronk.evaluation.walk_metrics import WALK_FIGURES, WalkFigures, measure_walk
from pronk.robots.robot import Robot
from pronk.runtime.script import STILL, Script
from pronk.virtual.sim_params import SimParams

SCHEMA = "pronk/trial-walk/1"
FILE = "walk.json"
WRITER = "pronk trial POLICY --walk"

WALKS = (
    Case(name="forward 2", command=(2.0, 0.0, 0.0)),
    Case(name="back 2", command=(-2.0, 0.0, 0.0)),
    Case(name="side +1", command=(0.0, 1.0, 0.0)),
    Case(name="side -1", command=(0.0, -1.0, 0.0)),
    Case(name="turn +2", command=(0.0, 0.0, 2.0)),
    Case(name="turn -2", command=(0.0, 0.0, -2.0)),
    Case(name="stand", command=(0.0, 0.0, 0.0)),
)
"""The paper's R4, turning at the ends of the trained range (C3), and standing. Positive sideways
and positive turns are to the left."""

WALK_S = 20.0
"""How long a velocity is told [s]."""


@dataclass(frozen=True, kw_only=True)
class Walk:
    """One walk."""

    policy: str
    """Name of the subject."""
    case: str
    """Name of the command."""
    number: int
    seed: int
    """Of its virtual robot's noise."""
    figures: WalkFigures


@dataclass(frozen=True, kw_only=True)
class WalkCell:
    """One policy with one command."""

    policy: str
    case: str
    n: int
    fell: int
    touched: int
    """Walks in which something else than a foot touched the ground."""
    figures: Mapping[str, Spread]
    """Over all walks, those that fell included with what they did before."""


@dataclass(frozen=True, kw_only=True)
class Walks:
    """All of it."""

    origin: sheet.Origin
    cases: tuple[Case, ...]
    seconds: float
    """How long each velocity was told [s]."""
    rows: tuple[Walk, ...]
    """By policy, then command, then number."""

    @cached_property
    def cells(self) -> tuple[WalkCell, ...]:
        """Every policy with every command."""
        return tuple(
            self._cell(subject.name, case.name)
            for subject in self.origin.subjects
            for case in self.cases
        )

    def cell(self, policy: str, case: str) -> WalkCell:
        """One of `cells`."""
        return next(c for c in self.cells if (c.policy, c.case) == (policy, case))

    def _cell(self, policy: str, case: str) -> WalkCell:
        found = [row.figures for row in self.rows if (row.policy, row.case) == (policy, case)]
        return WalkCell(
            policy=policy,
            case=case,
            n=len(found),
            fell=sum(each.fell for each in found),
            touched=sum(each.touched for each in found),
            figures={
                name: Spread.of([getattr(each, name) for each in found]) for name in WALK_FIGURES
            },
        )


def walk_script(command: tuple[float, float, float], *, seconds: float = WALK_S) -> Script:
    """Stand for a moment, then the velocity for `seconds`; no jump, no stop."""
    return Script(command=command, run_s=seconds, jump_s=0.0, keep_s=0.0, stop_s=0.0)


def walk(job: Job) -> WalkFigures:
    """Run one job and measure it."""
    seen, flown = flight(job)
    return measure_walk(seen, job.script, began=flown.began, mass=job.mass, rules=job.rules)


def add_walks(
    policies: Sequence[Path],
    *,
    robot: Robot,
    sim_params: SimParams,
    out: Path,
    about: Mapping[str, Any] | None = None,
    cases: tuple[Case, ...] = WALKS,
    runs: int = 20,
    seconds: float = WALK_S,
    seed: int = 0,
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Walks:
    """Let policies walk on the virtual robot and write `walk.json`.

    Args:
        policies: `policy.onnx` of each.
        robot: Which robot they are for.
        sim_params: Body of the virtual robot.
        out: Folder of the trial.
        about: Where the parameters come from, kept with the result.
        cases: Velocities.
        runs: Walks with each velocity, each with a start and noise of its own.
        seconds: How long each lasts [s].
        seed: Of starts and noise.
        processes: How many walks at once; the numbers do not depend on it.
        progress: Called with the share done, 0 to 1.

    Raises:
        PronkError: Of policies, sim_params or plan, before the first step.
    """
    begun = time.perf_counter()
    subjects = load_subjects(policies, robot, jump=False)
    script = walk_script(STILL, seconds=seconds)
    plan = Plan(cases=cases, jumps=runs, seed=seed, script=script, spread_s=0.0)
    planned = jobs_of(subjects, plan, robot=robot, sim_params=sim_params, out=out)
    jobs = [replace(job, keep=None) for _, job in planned]
    body(jobs[0])  # a body that cannot exist is refused here
    measured = in_processes(walk, jobs, processes=processes, progress=progress)
    walks = Walks(
        origin=replace(
            sheet.origin(robot, subjects, about=about, seed=seed),
            seconds=time.perf_counter() - begun,
        ),
        cases=cases,
        seconds=seconds,
        rows=tuple(
            Walk(policy=row.policy, case=row.case, number=row.number, seed=row.seed, figures=each)
            for (row, _), each in zip(planned, measured, strict=True)
        ),
    )
    save(out, walks)
    return walks


def save(folder: Path, walks: Walks) -> Path:
    """Write `walk.json`; returns its path."""
    return sheet.save(
        folder / FILE,
        SCHEMA,
        walks.origin,
        {
            "seconds": walks.seconds,
            "cases": walks.cases,
            "definitions": sheet.definitions(WALK_FIGURES),
            "cells": walks.cells,
            "rows": [
                {k: v for k, v in asdict(row).items() if k != "figures"} | asdict(row.figures)
                for row in walks.rows
            ],
        },
    )


def load(folder: Path) -> Walks:
    """Read what `save` wrote.

    Raises:
        ArtefactError: Missing, damaged or of another schema.
    """
    names = [entry.name for entry in fields(WalkFigures)]
    with sheet.load(folder / FILE, SCHEMA, writer=WRITER) as (where, told):
        return Walks(
            origin=where,
            cases=tuple(sheet.entry_of(Case, entry) for entry in told["cases"]),
            seconds=told["seconds"],
            rows=tuple(
                Walk(
                    **{k: v for k, v in entry.items() if k not in names},
                    figures=sheet.entry_of(WalkFigures, {k: entry[k] for k in names}),
                )
                for entry in told["rows"]
            ),
        )
