"""Walks of the virtual robot: one velocity for a long time (paper R4), many times."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pronk.evaluation.protocol import Case
from pronk.evaluation.results import Kind, Results
from pronk.evaluation.trial import Plan, build, load_subjects, plan_jobs, run_jobs
from pronk.evaluation.walk_metrics import WalkFigures, measure_walk
from pronk.robots.robot import Robot
from pronk.runtime.script import STILL, Script, Velocity
from pronk.virtual.sim_params import SimParams

WALK = Kind(
    table="walk.csv",
    summary="walk.json",
    schema="pronk/trial-walk/2",
    writer="pronk trial POLICY --walk",
    figures=WalkFigures,
)
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
"""Length of a walk [s]."""


def walk_script(command: Velocity, *, seconds: float = WALK_S) -> Script:
    """Stand for a moment, then the velocity for `seconds`; no jump, no stop."""
    return Script(command=command, run_s=seconds, jump_s=0.0, keep_s=0.0, stop_s=0.0)


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
) -> Results:
    """Let policies walk on the virtual robot and write `walk.csv` and `walk.json`.

    Arguments and errors as of `run_trial`; `runs` walks of `seconds` with each of `cases`.
    """
    subjects = load_subjects(policies, robot, jump=False)
    script = walk_script(STILL, seconds=seconds)
    plan = Plan(cases=cases, jumps=runs, seed=seed, script=script, spread_s=0.0)
    planned = plan_jobs(
        subjects,
        plan,
        robot=robot,
        sim_params=sim_params,
        out=out,
        keep="none",
        measure=measure_walk,
    )
    build(planned[0][1])  # refuses impossible parameters
    return run_jobs(
        planned,
        kind=WALK,
        subjects=subjects,
        plan=plan,
        robot=robot,
        out=out,
        about=about,
        processes=processes,
        progress=progress,
    )
