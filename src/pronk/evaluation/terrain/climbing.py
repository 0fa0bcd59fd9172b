"""Crossing gaps and steps of growing size, until it fails.

For each command, first some practice on flat ground: how far in front of the trunk, at the jump
input, do the front-most feet stand for the last time (`reach`)? A robot that lifts off right at the
edge is one whose jump input rises that far before it. Then, size by size, `runs` runs for each of a
few leads about that distance; every run starts at a place of its own, so that it meets the edge in
another phase of its gait, which the operator does not look at. A size counts as crossed with the
lead that did best, if it did so in `enough` of its runs; the sizes grow until no lead does.

What crossed means, and who triggers the jump, is said in `pronk.evaluation.terrain.course`.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pronk.errors import PronkError
from pronk.evaluation import result_io as sheet
from pronk.evaluation.job import Job, body, set_down
from pronk.evaluation.jumps import JumpRules
from pronk.evaluation.processes import in_processes
from pronk.evaluation.protocol import Case
from pronk.evaluation.result import Subject
from pronk.evaluation.run import mass_of
from pronk.evaluation.subjects import load_subjects
from pronk.evaluation.terrain.course import (
    Kind,
    Obstacle,
    Operator,
    Verdict,
    direction,
    judge,
    lost,
)
from pronk.evaluation.terrain.crossing import Crossing, Crossings, rung_of, save
from pronk.policy.runtime import load_policy
from pronk.robots import load_robot
from pronk.robots.robot import Robot
from pronk.runtime.rollout import ticks
from pronk.runtime.script import STILL, Script
from pronk.virtual.ground import Start
from pronk.virtual.sim_params import SimParams

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
"""A robot that has not come to the edge after this many times the run-up never does."""
STEERED = 0.02
"""Half-width of the headings at the start: someone aims the robot at the edge [rad]."""


@dataclass(frozen=True, kw_only=True)
class Ladder:
    """Sizes to try, and where the jump input rises."""

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
class Plan:
    """What is tried."""

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
    """Half-width of what each joint stands beside the default pose at the start [rad]."""
    rules: JumpRules = field(default_factory=JumpRules)

    def __post_init__(self) -> None:
        """Refuse a plan that tries nothing.

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
    """Policy, body and start; its script has the command and the times `stand_s`, `jump_s` and
    `keep_s`."""
    obstacle: Obstacle
    edge: float
    """Where it begins, along the course [m]."""
    lead: float
    """From the trunk to it when the jump input shall rise [m]."""


def attempt(task: Attempt) -> Verdict:
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
    # Time to lift off, to run_policy and land on all feet, and to stand.
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
    return judge(
        machine.capture(),
        task.obstacle,
        script.command,
        edge=task.edge,
        triggered=None if operator.triggered is None else began + operator.triggered,
        rules=rules,
    )


def add_crossings(
    policies: Sequence[Path],
    plan: Plan | None = None,
    *,
    robot: Robot,
    sim_params: SimParams,
    out: Path,
    about: Mapping[str, Any] | None = None,
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Crossings:
    """Let policies cross gaps and steps on the virtual robot and write `crossing.json`.

    Args:
        policies: `policy.onnx` of each.
        plan: What is tried.
        robot: Which robot they are for.
        sim_params: Body of the virtual robot.
        out: Folder of the trial.
        about: Where the parameters come from, kept with the result.
        processes: How many runs at once; the numbers do not depend on it.
        progress: Called with the share done, 0 to 1; how much there is to do is a guess.

    Raises:
        PronkError: Of policies, sim_params or plan, before the first step.
    """
    begun, plan = time.perf_counter(), plan or Plan()
    subjects = load_subjects(policies, robot)
    search = _Search(subjects, plan, robot=robot, sim_params=sim_params)
    while planned := search.next_round():
        tasks = [task for _, task in planned]
        body(tasks[0].job)  # a body that cannot exist is refused here
        found = in_processes(
            attempt,
            tasks,
            processes=processes,
            progress=lambda part: (progress or _silent)(search.share(part)),
        )
        search.take([row for row, _ in planned], found)
    crossings = Crossings(
        origin=replace(
            sheet.origin(robot, subjects, about=about, seed=plan.seed),
            seconds=time.perf_counter() - begun,
        ),
        cases=plan.cases,
        kinds=tuple(plan.ladders),
        runs=plan.runs,
        enough=plan.enough,
        rows=tuple(search.rows),
    )
    save(out, crossings)
    return crossings


class _Search:
    """Climbs all ladders at once, a rung of each in every round."""

    def __init__(
        self, subjects: Sequence[Subject], plan: Plan, *, robot: Robot, sim_params: SimParams
    ) -> None:
        self.rows: list[Crossing] = []
        self._subjects, self._plan, self._robot, self._sim_params = (
            subjects,
            plan,
            robot,
            sim_params,
        )
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

    def next_round(self) -> list[tuple[Crossing, Attempt]]:
        """Practice first, then a rung of every ladder that is not done."""
        flat = Obstacle(kind="flat")
        jobs: list[tuple[Crossing, Attempt]] = []
        for subject in self._subjects:
            for case in self._plan.cases:
                if (subject.name, case.name) not in self._reach:
                    jobs += self._jobs(subject, case, flat, 0.0, self._plan.practice)
                    continue
                for kind, ladder in self._plan.ladders.items():
                    rung = self._rung[subject.name, case.name, kind]
                    if rung is None:
                        continue
                    obstacle = Obstacle(kind=kind, size=ladder.size(rung))
                    for lead in ladder.leads:
                        meant = round(self._reach[subject.name, case.name] + lead, 4)
                        jobs += self._jobs(subject, case, obstacle, meant, self._plan.runs)
        return jobs

    def _jobs(
        self, subject: Subject, case: Case, obstacle: Obstacle, lead: float, runs: int
    ) -> list[tuple[Crossing, Attempt]]:
        plan, speed = self._plan, math.hypot(*case.command[:2])
        edge = RUN_UP_S * speed
        found = []
        for number in range(runs):
            start, seed = _start(plan, case, number, self._robot)
            row = Crossing(
                policy=subject.name,
                case=case.name,
                kind=obstacle.kind,
                size=obstacle.size,
                lead=lead,
                number=number,
                **asdict(Verdict(why="")),
            )
            job = Job(
                policy=Path(subject.path),
                sha256=subject.sha256,
                robot=self._robot.name,
                sim_params=self._sim_params,
                ground=obstacle.on(self._sim_params.ground, case.command, edge),
                start=start,
                seed=seed,
                script=replace(plan.script, command=case.command),
                rules=plan.rules,
                mass=mass_of(self._robot),
                keep=None,
            )
            found.append((row, Attempt(job=job, obstacle=obstacle, edge=edge, lead=lead)))
        return found

    def take(self, asked: Sequence[Crossing], found: Sequence[Verdict]) -> None:
        """Note what became of a round, and climb or stop."""
        rows = [replace(row, **asdict(each)) for row, each in zip(asked, found, strict=True)]
        self.rows += rows
        for subject in self._subjects:
            for case in self._plan.cases:
                key = (subject.name, case.name)
                mine = [row for row in rows if (row.policy, row.case) == key]
                if any(row.kind == "flat" for row in mine):
                    self._practised(key, mine)
                    continue
                for kind in self._plan.ladders:
                    tried = [row for row in mine if row.kind == kind]
                    if tried:
                        self._climbed((*key, kind), tried)

    def _practised(self, key: tuple[str, str], rows: Sequence[Crossing]) -> None:
        reaches = [row.reach for row in rows if math.isfinite(row.reach)]
        self._reach[key] = float(np.mean(reaches)) if reaches else math.nan
        if not reaches:
            # It does not jump with this command at all, so there is nothing to cross.
            for kind in self._plan.ladders:
                self._rung[*key, kind] = None

    def _climbed(self, key: tuple[str, str, Kind], rows: Sequence[Crossing]) -> None:
        plan, rung = self._plan, self._rung[key]
        assert rung is not None
        higher = plan.ladders[key[2]].size(rung + 1) <= plan.most + 1e-9
        enough = rung_of(rows[0].size, rows).crossed >= plan.enough
        self._rung[key] = rung + 1 if enough and higher else None


def _start(plan: Plan, case: Case, number: int, robot: Robot) -> tuple[Start, int]:
    """How a robot is set down, and the seed of its noise: alike for all obstacles and leads."""
    digest = hashlib.sha256(np.array(case.command, dtype="<f8").tobytes()).digest()
    rng = np.random.default_rng([plan.seed, int.from_bytes(digest[:8], "little"), number])
    back = PHASE_S * math.hypot(*case.command[:2]) * rng.uniform()
    x, y = (-back * direction(case.command)).tolist()
    offset = rng.uniform(-plan.joint_offset, plan.joint_offset, len(robot.joints))
    start = Start(
        position=(x, y),
        yaw=float(rng.uniform(-STEERED, STEERED)),
        joint_offset=tuple(offset.tolist()),
    )
    return start, int(rng.integers(2**31))


def _silent(share: float) -> None:
    """Nobody watches."""
