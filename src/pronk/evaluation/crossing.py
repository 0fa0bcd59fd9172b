"""Crossing gaps and steps of growing size, until it fails.

For each command, first practice on flat ground: how far in front of the trunk, at the jump input,
do the front-most feet stand for the last time (`reach`)? A robot that lifts off right at the edge
is one whose jump input rises that far before it. Then, size by size, `runs` runs for each of a few
leads about that distance; every run starts at its own place, so that it meets the edge in another
phase of its gait, which the operator does not use. A size counts as crossed with the lead that did
best, if it did so in `enough` of its runs; the sizes grow until no lead does.

`pronk.evaluation.course` has the courses, the operator, and what crossed means.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pronk.errors import PronkError
from pronk.evaluation.course import (
    CrossingFigures,
    Kind,
    Obstacle,
    Operator,
    direction,
    judge,
    lost,
)
from pronk.evaluation.jumps import JumpRules
from pronk.evaluation.processes import in_processes
from pronk.evaluation.protocol import Case
from pronk.evaluation.results import Kind as ResultsKind
from pronk.evaluation.results import Results, Row, Subject, save
from pronk.evaluation.trial import (
    Job,
    build,
    case_rng,
    load_subjects,
    planned_run,
    set_down,
    versions,
)
from pronk.policy.runtime import load_policy
from pronk.robots import load_robot
from pronk.robots.robot import Robot
from pronk.runtime.rollout import ticks
from pronk.runtime.script import STILL, Script
from pronk.virtual.ground import Start
from pronk.virtual.sim_params import SimParams

CROSSING = ResultsKind(
    table="crossing.csv",
    summary="crossing.json",
    schema="pronk/trial-crossing/2",
    writer="pronk trial POLICY --crossing",
    figures=CrossingFigures,
)
CROSSED_BY = (
    Case(name="forward 2", command=(2.0, 0.0, 0.0)),
    Case(name="back 2", command=(-2.0, 0.0, 0.0)),
    Case(name="side +1", command=(0.0, 1.0, 0.0)),
    Case(name="side -1", command=(0.0, -1.0, 0.0)),
)
"""The commands of the paper's gaps (R3)."""
RUN_UP_S = 2.0
"""The edge is as far away as the command goes in this time [s]."""
PHASE_S = 0.5
"""Starts lie up to this many seconds of the command further back: more than a stride [s]."""
LATE = 3.0
"""A run ends if the robot has not reached the edge after this many times the run-up."""
STEERED = 0.02
"""Half-width of the headings at the start: the robot is aimed at the edge [rad]."""


@dataclass(frozen=True, kw_only=True)
class Ladder:
    """The sizes of one kind of obstacle, and the leads."""

    first: float
    """[m]"""
    step: float
    """[m]"""
    leads: tuple[float, ...]
    """Added to the reach of practice [m]."""

    def __post_init__(self) -> None:
        """Refuse a ladder without rungs.

        Raises:
            PronkError: A size is not positive, or there is no lead.
        """
        if not (self.first > 0.0 and self.step > 0.0 and self.leads):
            raise PronkError(f"{self}: sizes must be positive, and there must be a lead.")

    def size(self, rung: int) -> float:
        """Of the rung, from 0 [m]."""
        return round(self.first + rung * self.step, 6)


LADDERS: Mapping[Kind, Ladder] = {
    "gap": Ladder(first=0.1, step=0.05, leads=(0.04, 0.09, 0.14)),
    "up": Ladder(first=0.05, step=0.05, leads=(0.05, 0.15, 0.25)),
    "down": Ladder(first=0.1, step=0.1, leads=(0.0, 0.1)),
}


@dataclass(frozen=True, kw_only=True)
class CrossingPlan:
    """Commands, sizes and runs."""

    cases: tuple[Case, ...] = CROSSED_BY
    ladders: Mapping[Kind, Ladder] = field(default_factory=lambda: dict(LADDERS))
    runs: int = 5
    """For each size and lead."""
    enough: int = 4
    """Of them must cross."""
    practice: int = 8
    """Jumps on flat ground with each command."""
    most: float = 1.5
    """Size at which the search ends even if nothing fails [m]."""
    seed: int = 0
    script: Script = field(default_factory=lambda: Script(command=STILL))
    """Times `stand_s`, `jump_s` and `keep_s`."""
    joint_offset: float = 0.05
    """Half-width of the joints' offsets from the default pose at the start [rad]."""
    rules: JumpRules = field(default_factory=JumpRules)

    def __post_init__(self) -> None:
        """Refuse an empty plan.

        Raises:
            PronkError: One sentence that names the field.
        """
        if self.practice < 1 or not 1 <= self.enough <= self.runs:
            raise PronkError(
                f"{self.practice} jumps of practice, {self.enough} of {self.runs} runs; expected "
                "1 or more of each, and not more needed than run."
            )
        for case in self.cases:
            direction(case.command)


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """One run at an obstacle, with all that it depends on."""

    job: Job
    """Policy, parameters and start; its script has the command and the times `stand_s`, `jump_s`
    and `keep_s`."""
    obstacle: Obstacle
    edge: float
    """Where it begins, along the course [m]."""
    lead: float
    """From the trunk to it when the jump input rises [m]."""


def attempt(task: Attempt) -> CrossingFigures:
    """Run once at an obstacle."""
    job, script, rules = task.job, task.job.script, task.job.rules
    along = direction(script.command)
    machine = set_down(job)
    operator = Operator(
        script,
        edge=task.edge,
        lead=task.lead,
        where=lambda: float(machine.snapshot().position[0, :2] @ along),
    )
    # Time to lift off, to fly and land on all feet, and to stand.
    after = rules.search_s + 1.0 + rules.upright_s
    late = script.stand_s + LATE * (RUN_UP_S + PHASE_S)
    began = machine.now()
    for tick in ticks(machine, load_policy(job.policy), load_robot(job.robot), operator):
        if operator.triggered is None:
            if tick.since > late:
                break
        elif tick.since > operator.triggered + after or lost(
            machine.snapshot(), task.obstacle, script.command, task.edge
        ):
            break
    figures = judge(
        machine.capture(),
        task.obstacle,
        script.command,
        edge=task.edge,
        triggered=None if operator.triggered is None else began + operator.triggered,
        rules=rules,
    )
    return replace(figures, obstacle=task.obstacle.kind, size=task.obstacle.size, lead=task.lead)


def add_crossings(
    policies: Sequence[Path],
    plan: CrossingPlan | None = None,
    *,
    robot: Robot,
    sim_params: SimParams,
    out: Path,
    about: Mapping[str, Any] | None = None,
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Results:
    """Let policies cross gaps and steps; write `crossing.csv` and `crossing.json`.

    Arguments and errors as of `run_trial`; how much there is to do is an estimate.
    """
    begun, plan = time.perf_counter(), plan or CrossingPlan()
    subjects = load_subjects(policies, robot)
    search = Search(subjects, plan, robot=robot, sim_params=sim_params)
    while planned := search.next_round():
        tasks = [task for _, task in planned]
        build(tasks[0].job)  # refuses impossible parameters

        def share(part: float) -> None:
            if progress is not None:
                progress(search.share(part))

        found = in_processes(attempt, tasks, processes=processes, progress=share)
        search.take([row for row, _ in planned], found)
    results = Results(
        kind=CROSSING,
        robot=robot.name,
        subjects=subjects,
        cases=plan.cases,
        rows=tuple(search.rows),
        seed=plan.seed,
        sim_params=dict(about or {}),
        script=plan.script,
        rules=asdict(plan.rules),
        settings={"kinds": list(plan.ladders), "runs": plan.runs, "enough": plan.enough},
        versions=versions(),
        timing={"seconds": time.perf_counter() - begun},
    )
    save(out, results)
    return results


class Search:
    """Climbs all ladders at once, a rung of each in every round."""

    def __init__(
        self,
        subjects: Sequence[Subject],
        plan: CrossingPlan,
        *,
        robot: Robot,
        sim_params: SimParams,
    ) -> None:
        """Begin before practice."""
        self.rows: list[Row] = []
        self._subjects, self._plan = subjects, plan
        self._robot, self._sim_params = robot, sim_params
        self._reach: dict[tuple[str, str], float] = {}
        self._rung: dict[tuple[str, str, Kind], int | None] = {
            (subject.name, case.name, kind): 0
            for subject in subjects
            for case in plan.cases
            for kind in plan.ladders
        }

    def share(self, part: float) -> float:
        """Of the ladders, those that are done; the others as if five rungs were left of each.

        Args:
            part: Of this round that is done. Practice counts as a rung.
        """
        shares = []
        for (policy, case, _), rung in self._rung.items():
            done = part + ((rung or 0) + 1 if (policy, case) in self._reach else 0)
            shares.append(1.0 if rung is None else done / (done + 5.0))
        return sum(shares) / len(shares)

    def next_round(self) -> list[tuple[Row, Attempt]]:
        """Return practice first, then a rung of every ladder that is not done."""
        jobs: list[tuple[Row, Attempt]] = []
        for subject in self._subjects:
            for case in self._plan.cases:
                reach = self._reach.get((subject.name, case.name))
                if reach is None:
                    flat = Obstacle(kind="flat")
                    jobs += self._attempts(subject, case, flat, 0.0, self._plan.practice)
                    continue
                for kind, ladder in self._plan.ladders.items():
                    rung = self._rung[subject.name, case.name, kind]
                    for lead in () if rung is None else ladder.leads:
                        obstacle = Obstacle(kind=kind, size=ladder.size(rung or 0))
                        meant = round(reach + lead, 4)
                        jobs += self._attempts(subject, case, obstacle, meant, self._plan.runs)
        return jobs

    def _attempts(
        self, subject: Subject, case: Case, obstacle: Obstacle, lead: float, runs: int
    ) -> list[tuple[Row, Attempt]]:
        plan, edge = self._plan, RUN_UP_S * math.hypot(*case.command[:2])
        found = []
        for number in range(runs):
            start, seed = draw_start(plan, case, number, self._robot)
            row, job = planned_run(
                subject,
                case,
                number,
                drawn=(replace(plan.script, command=case.command), start, seed),
                robot=self._robot,
                sim_params=self._sim_params,
                rules=plan.rules,
                ground=obstacle.on(self._sim_params.ground, case.command, edge),
            )
            found.append((row, Attempt(job=job, obstacle=obstacle, edge=edge, lead=lead)))
        return found

    def take(self, planned: Sequence[Row], found: Sequence[CrossingFigures]) -> None:
        """Note the outcome of a round, and climb or stop."""
        rows = [replace(row, figures=each) for row, each in zip(planned, found, strict=True)]
        self.rows += rows
        for key in dict.fromkeys((row.policy, row.case) for row in rows):
            own = [row for row in rows if (row.policy, row.case) == key]
            if own[0].figures.obstacle == "flat":
                reaches = [r.figures.reach for r in own if math.isfinite(r.figures.reach)]
                self._reach[key] = float(np.mean(reaches)) if reaches else math.nan
                if not reaches:  # no jump with this command: nothing to cross
                    self._rung |= dict.fromkeys([(*key, kind) for kind in self._plan.ladders])
                continue
            for kind, ladder in self._plan.ladders.items():
                tried = [row for row in own if row.figures.obstacle == kind]
                if tried:
                    rung = self._rung[*key, kind] or 0
                    higher = ladder.size(rung + 1) <= self._plan.most + 1e-9
                    enough = rung_of(tried).crossed >= self._plan.enough
                    self._rung[*key, kind] = rung + 1 if enough and higher else None


def draw_start(plan: CrossingPlan, case: Case, number: int, robot: Robot) -> tuple[Start, int]:
    """Draw start and noise seed of a run: alike for all obstacles and leads."""
    rng = case_rng(plan.seed, case, number)
    back = PHASE_S * math.hypot(*case.command[:2]) * rng.uniform()
    x, y = (-back * direction(case.command)).tolist()
    offset = rng.uniform(-plan.joint_offset, plan.joint_offset, len(robot.joints))
    start = Start(
        position=(x, y),
        yaw=float(rng.uniform(-STEERED, STEERED)),
        joint_offset=tuple(offset.tolist()),
    )
    return start, int(rng.integers(2**31))


# ---- sums ----


@dataclass(frozen=True, kw_only=True)
class Rung:
    """One size, with the lead that did best."""

    size: float
    lead: float
    crossed: int
    runs: int
    """With that lead."""
    reasons: Mapping[str, int]
    """Why the others were not crossed, with all leads."""


@dataclass(frozen=True, kw_only=True)
class Climb:
    """All sizes that one policy tried with one command."""

    policy: str
    case: str
    kind: str
    rungs: tuple[Rung, ...]
    largest: float
    """Largest size crossed in `enough` of its runs, as were all smaller ones; 0 for none [m]."""
    ever: float
    """Largest size crossed in any run; 0 for none [m]."""


def rung_of(rows: Sequence[Row]) -> Rung:
    """Sum up the runs at obstacles of one size, with any lead."""
    figures = [row.figures for row in rows]
    leads = sorted({each.lead for each in figures})
    counts = {lead: sum(each.success for each in figures if each.lead == lead) for lead in leads}
    # With equal counts the shorter lead: the one nearer to the edge.
    best = max(leads, key=lambda lead: (counts[lead], -lead))
    reasons: dict[str, int] = {}
    for each in figures:
        if each.why:
            reasons[each.why] = reasons.get(each.why, 0) + 1
    return Rung(
        size=figures[0].size,
        lead=best,
        crossed=counts[best],
        runs=sum(each.lead == best for each in figures),
        reasons=reasons,
    )


def climbs(results: Results) -> tuple[Climb, ...]:
    """Sum up every policy with every command and kind of obstacle."""
    found = []
    for subject in results.subjects:
        for case in results.cases:
            for kind in results.settings["kinds"]:
                own = [r for r in results.of(subject.name, case.name) if r.figures.obstacle == kind]
                sizes = sorted({row.figures.size for row in own})
                rungs = [rung_of([r for r in own if r.figures.size == size]) for size in sizes]
                enough = [rung.crossed >= results.settings["enough"] for rung in rungs]
                whole = enough.index(False) if False in enough else len(enough)
                found.append(
                    Climb(
                        policy=subject.name,
                        case=case.name,
                        kind=kind,
                        rungs=tuple(rungs),
                        largest=sizes[whole - 1] if whole else 0.0,
                        ever=max((r.figures.size for r in own if r.figures.success), default=0.0),
                    )
                )
    return tuple(found)
