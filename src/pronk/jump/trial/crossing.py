"""Crossing gaps and steps of growing size, until it fails.

    gap     the floor ends at the edge and goes on `size` further; between, it is 1 m down
    up      behind the edge the floor is `size` higher
    down    behind the edge the floor is `size` lower
    flat    no edge: for practice

Coordinates: s along the commanded direction, which the robot faces at the start; the edge is at
s = `edge`. The jump input rises when the trunk is `lead` before it (the operator's choice), stays
for `jump_s`, the velocity for `keep_s` longer; then the command is zero.

For each command, first practice on flat ground: `reach` is how far in front of the trunk, at the
jump input, the front-most feet stand for the last time. Then, size by size, `runs` runs for each of
a few leads about that distance; every run starts at its own place and meets the edge in another
phase of its gait. A size counts as crossed with the lead that did best, if it did so in `enough` of
its runs; the sizes grow until no lead does.

Crossed means all of this, from the jump input to 2 s after the landing:

    no foot's centre was below floor level between the edges of a gap;
    nothing but feet touched anything;
    landing: every foot has touched ground behind the far edge;
    2 s later trunk and feet are behind the far edge, and the trunk leans 30 degrees at most,
    never having leant 70 degrees.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from pronk.arrays import Array, Mask
from pronk.errors import PronkError
from pronk.jump.trial.jumps import (
    FALLEN_COSINE,
    JumpRules,
    cosine_of_tilt,
    jump_flights,
    number,
    sample_at,
)
from pronk.jump.trial.protocol import Case, named
from pronk.jump.trial.results import Results, Row, Subject, extra_kind
from pronk.jump.trial.trial import OFFSET, Job, Setup, case_rng, finished, load_subjects
from pronk.jump.virtual.capture import Capture
from pronk.jump.virtual.ground import Box, Ground, Start
from pronk.policy.rollout import ticks
from pronk.policy.script import STILL, Commanded, Script, Velocity
from pronk.processes import in_processes

Shape = Literal["flat", "gap", "up", "down"]

DEPTH = 1.0
"""Of a gap [m]."""
BEHIND, BEYOND = 5.0, 15.0
"""Floor behind the start and behind the far edge [m]."""
WIDE = 8.0
"""Half-width of the course [m]."""
RUN_UP_S = 2.0
"""The edge is as far away as the command goes in this time [s]."""
PHASE_S = 0.5
"""Starts lie up to this many seconds of the command further back: more than a stride [s]."""
LATE = 3.0
"""A run ends if the robot has not reached the edge after this many times the run-up."""
STEERED = 0.02
"""Half-width of the headings at the start [rad]."""

NOT_TRIGGERED = "never came to the place of the jump"
STEPPED_IN = "a foot went below the floor between the edges"
NON_FOOT_CONTACT = "something but a foot touched"
NOT_OVER = "not every foot came down behind the far edge"
FELL = "not upright 2 s later"


@dataclass(frozen=True, kw_only=True)
class Obstacle:
    """A gap or a step on the way of a command."""

    kind: Shape
    size: float = 0.0
    """Width of a gap, height of a step [m]."""
    command: Velocity
    """Straight forward, back or to a side."""
    edge: float
    """Where it begins, along the course [m]."""

    @property
    def far(self) -> float:
        """Where the floor goes on, along the course [m]."""
        return self.edge + (self.size if self.kind == "gap" else 0.0)

    def on(self, ground: Ground) -> Ground:
        """Put the obstacle on a ground, whose friction and stiffness stay."""
        if self.kind == "flat":
            return replace(ground, floor=0.0, terrain=())
        floor = {"gap": -DEPTH, "up": 0.0, "down": -self.size}[self.kind]
        boxes = [] if self.kind == "up" else [self._box(-BEHIND, self.edge, floor, 0.0)]
        if self.kind != "down":
            top = self.size if self.kind == "up" else 0.0
            boxes.append(self._box(self.far, self.far + BEYOND, floor, top))
        return replace(ground, floor=floor, terrain=tuple(boxes))

    def _box(self, begin: float, end: float, low: float, high: float) -> Box:
        """A block between two places of the course and two heights."""
        along = direction(self.command)
        x, y = (0.5 * (begin + end) * along).tolist()
        a, b = np.where(along != 0.0, 0.5 * (end - begin), WIDE).tolist()
        return Box(center=(x, y, 0.5 * (low + high)), half_size=(a, b, 0.5 * (high - low)))


def direction(command: Velocity) -> Array:
    """Unit vector in the plane of a command straight forward, back or to a side. (2,)."""
    forward, left, _ = command
    if bool(forward) == bool(left):
        raise PronkError(
            f"command {command} on a course; expected one straight forward, back or to a side."
        )
    return np.array([np.sign(forward), np.sign(left)])


# ---- one run ----


@dataclass
class Operator:
    """The command over time: run, and jump when the trunk is at `trigger_at`."""

    script: Script
    trigger_at: float
    """Along the course [m]."""
    where: Callable[[], float]
    """Returns the trunk's place along the course [m]."""
    triggered: float | None = None
    """When the jump input rose, since the policy took over [s]."""

    def __call__(self, t: float) -> Commanded:
        """Return the command at a time since the policy took over [s]."""
        script = self.script
        if t < script.stand_s:
            return STILL, False
        if self.triggered is None and self.where() >= self.trigger_at:
            self.triggered = t
        if self.triggered is None:
            return script.command, False
        since = t - self.triggered
        moving = since < script.jump_s + script.keep_s
        return (script.command if moving else STILL), since < script.jump_s


@dataclass(frozen=True, kw_only=True)
class CrossingFigures:
    """One run at an obstacle."""

    obstacle: str = "flat"
    """Its kind; `flat` for practice."""
    why: str = ""
    """Empty if it was crossed, else the first condition that was not met."""
    size: float = number("m", "width of the gap, height of the step")
    lead: float = number("m", "from the trunk to the edge when the jump input rises")
    take_off: float = number("m", "from the front-most last foothold before the flight to the edge")
    landing: float = number("m", "from the far edge to the hind-most first foothold behind it")
    reach: float = number("m", "from the trunk at the jump input to the front-most last foothold")
    speed: float = number("m/s", "along the course at the jump input")

    @property
    def success(self) -> bool:
        """The obstacle was crossed."""
        return not self.why


CROSSING = extra_kind("crossing", figures=CrossingFigures)


def lost(seen: Capture, obstacle: Obstacle) -> bool:
    """Whether a run has failed already: a sample leans too far, or a foot stepped in."""
    fallen = cosine_of_tilt(seen.orientation) < FALLEN_COSINE
    return bool(fallen.any() or _stepped_in(seen, obstacle).any())


def measure_crossing(
    seen: Capture, obstacle: Obstacle, lead: float, *, triggered: float | None, rules: JumpRules
) -> CrossingFigures:
    """Measure one run at an obstacle.

    `triggered` is when the jump input rose, on the capture's clock [s]; None for never.
    """
    figures: dict[str, Any] = {"obstacle": obstacle.kind, "size": obstacle.size, "lead": lead}
    if triggered is None:
        return CrossingFigures(why=NOT_TRIGGERED, **figures)
    along, count, far = direction(obstacle.command), len(seen.time), obstacle.far
    on = min(sample_at(seen, triggered), count - 1)
    feet, trunk = seen.foot_position[:, :, :2] @ along, seen.position[:, :2] @ along
    behind = seen.contact & (feet >= far)
    first = np.where(behind[on:].any(axis=0), on + behind[on:].argmax(axis=0), count)
    landed, legs = int(first.max()), np.arange(feet.shape[1])
    settled = landed + round(rules.upright_s / seen.dt)
    figures["speed"] = float(seen.velocity[on, :2] @ along)
    main = jump_flights(seen, on, rules, count).main
    if main is not None:
        before = seen.contact[: main.liftoff]
        stood = feet[main.liftoff - 1 - before[::-1].argmax(axis=0), legs]
        front = float(np.where(before.any(axis=0), stood, -np.inf).max())
        figures["reach"] = front - float(trunk[on])
        if obstacle.kind != "flat":
            figures["take_off"] = obstacle.edge - front
    if landed < count and obstacle.kind != "flat":
        figures["landing"] = float(feet[first, legs].min()) - far
    end, cosine = min(settled + 1, count), cosine_of_tilt(seen.orientation)
    upright = settled < count and cosine[settled] >= rules.upright_cosine
    why = ""
    if _stepped_in(seen, obstacle)[:end].any():
        why = STEPPED_IN
    elif seen.other_contact[on:end].any():
        why = NON_FOOT_CONTACT
    elif landed >= count:
        why = NOT_OVER
    elif not upright or (cosine[:end] < FALLEN_COSINE).any():
        why = FELL
    elif min(trunk[settled], feet[settled].min()) < far:
        why = NOT_OVER
    return CrossingFigures(why=why, **figures)


def _stepped_in(seen: Capture, obstacle: Obstacle) -> Mask:
    """Samples with the centre of a foot below the floor between the edges of a gap. (T,)."""
    feet = seen.foot_position[:, :, :2] @ direction(obstacle.command)
    between = (feet > obstacle.edge) & (feet < obstacle.far)  # empty but for a gap
    return np.asarray((between & (seen.foot_position[:, :, 2] < 0.0)).any(axis=1))


@dataclass(frozen=True, kw_only=True)
class Attempt(Job):
    """One run at an obstacle; the row's script has `stand_s`, `jump_s` and `keep_s`."""

    obstacle: Obstacle
    lead: float
    """From the trunk to it when the jump input rises [m]."""


def attempt(task: Attempt) -> Row:
    """Run once at an obstacle and measure it."""
    script, obstacle, robot = task.row.script, task.obstacle, task.setup.robot
    along, machine, rules = direction(script.command), task.set_down(), JumpRules.of(robot)
    operator = Operator(
        script,
        trigger_at=obstacle.edge - task.lead,
        where=lambda: float(machine.snapshot().position[0, :2] @ along),
    )
    # Time to lift off, to fly and land on all feet, and to stand.
    after = rules.search_s + 1.0 + rules.upright_s
    late, began = script.stand_s + LATE * (RUN_UP_S + PHASE_S), machine.now()
    for since in ticks(machine, task.policy(), robot, operator):
        if operator.triggered is None:
            if since > late:
                break
        elif since > operator.triggered + after or lost(machine.snapshot(), obstacle):
            break
    triggered = None if operator.triggered is None else began + operator.triggered
    how: Any = {"triggered": triggered, "rules": rules}
    figures = measure_crossing(machine.capture(), obstacle, task.lead, **how)
    return replace(task.row, figures=figures)


# ---- many runs ----


class Ladder(NamedTuple):
    """The sizes of one kind of obstacle, and the leads beyond the reach of practice [m]."""

    sizes: tuple[float, ...]
    leads: tuple[float, ...]


LADDERS: Mapping[Shape, Ladder] = {
    "gap": Ladder(tuple(cm / 100 for cm in range(10, 151, 5)), (0.04, 0.09, 0.14)),
    "up": Ladder(tuple(cm / 100 for cm in range(5, 151, 5)), (0.05, 0.15, 0.25)),
    "down": Ladder(tuple(cm / 100 for cm in range(10, 151, 10)), (0.0, 0.1)),
}


@dataclass(frozen=True, kw_only=True)
class CrossingPlan:
    """Commands, sizes and runs; the commands are those of the paper's gaps (R3)."""

    cases: tuple[Case, ...] = named("forward 2", "back 2", "side +1", "side -1")
    ladders: Mapping[Shape, Ladder] = field(default_factory=lambda: dict(LADDERS))
    runs: int = 5
    """For each size and lead."""
    enough: int = 4
    """Of them must cross."""
    practice: int = 8
    """Jumps on flat ground with each command."""
    seed: int = 0
    script: Script = field(default_factory=lambda: Script(command=STILL))
    """Times `stand_s`, `jump_s` and `keep_s`."""


def search(
    subjects: Sequence[Subject],
    plan: CrossingPlan,
    setup: Setup,
    *,
    run: Callable[[list[Attempt]], list[Row]],
) -> list[Row]:
    """Practise, then climb all ladders at once, a rung of each in every round; `run` runs one."""
    robot, params = setup.robot, setup.sim_params

    def attempts(
        subject: Subject, case: Case, kind: Shape, size: float, lead: float, runs: int
    ) -> Iterator[Attempt]:
        """Plan runs at one obstacle; their starts are alike for all obstacles and leads."""
        speed = math.hypot(*case.command[:2])
        obstacle = Obstacle(kind=kind, size=size, command=case.command, edge=RUN_UP_S * speed)
        script = replace(plan.script, command=case.command)
        for count in range(runs):
            rng = case_rng(plan.seed, case, count)
            x, y = (-PHASE_S * speed * rng.uniform() * direction(case.command)).tolist()
            offset = rng.uniform(-OFFSET, OFFSET, len(robot.joints))
            yaw, seed = float(rng.uniform(-STEERED, STEERED)), int(rng.integers(2**31))
            row = Row(policy=subject.name, case=case.name, number=count, seed=seed, script=script)
            yield Attempt(
                row=row,
                subject=subject,
                kind=CROSSING,
                setup=replace(setup, sim_params=replace(params, ground=obstacle.on(params.ground))),
                start=Start(position=(x, y), yaw=yaw, joint_offset=tuple(offset.tolist())),
                obstacle=obstacle,
                lead=lead,
            )

    pairs = list(itertools.product(subjects, plan.cases))
    flat = (attempts(*pair, "flat", 0.0, 0.0, plan.practice) for pair in pairs)
    rows = run([task for tasks in flat for task in tasks])
    climbing: list[tuple[Subject, Case, Shape, float]] = []
    for subject, case in pairs:
        names = (subject.name, case.name)
        own = [row.figures.reach for row in rows if (row.policy, row.case) == names]
        if known := list(filter(math.isfinite, own)):  # without a jump there is nothing to cross
            climbing += [(subject, case, kind, float(np.mean(known))) for kind in plan.ladders]
    for rung in itertools.count():
        climbing = [one for one in climbing if rung < len(plan.ladders[one[2]].sizes)]
        if not climbing:
            break
        steps: list[Attempt] = []
        for subject, case, kind, reach in climbing:
            sizes, leads = plan.ladders[kind]
            for lead in (round(reach + beyond, 4) for beyond in leads):
                steps += attempts(subject, case, kind, sizes[rung], lead, plan.runs)
        found = run(steps)
        rows += found
        tried: dict[tuple[str, str, str], list[Row]] = {}
        for row in found:
            tried.setdefault((row.policy, row.case, row.figures.obstacle), []).append(row)
        climbing = [
            (subject, case, kind, reach)
            for subject, case, kind, reach in climbing
            if rung_of(tried[subject.name, case.name, kind]).crossed >= plan.enough
        ]
    return rows


def add_crossings(
    policies: Sequence[Path],
    plan: CrossingPlan,
    setup: Setup,
    *,
    progress: Callable[[float], None] = lambda share: None,
) -> Results:
    """Let policies cross gaps and steps; write `crossing.csv` and `crossing.json`.

    Arguments and errors as of `run_trial`; the progress is an estimate.
    """
    begun, rounds = time.perf_counter(), itertools.count()
    subjects = load_subjects(policies, setup.robot)

    def run(tasks: list[Attempt]) -> list[Row]:
        """Run one round; about five more follow each."""
        tasks[0].build()  # refuses impossible parameters
        done = next(rounds)
        return in_processes(
            attempt,
            tasks,
            processes=setup.processes,
            progress=lambda part: progress((done + part) / (done + part + 5.0)),
        )

    rows = search(subjects, plan, setup, run=run)
    progress(1.0)
    return finished(
        CROSSING,
        subjects,
        rows,
        setup,
        cases=plan.cases,
        seed=plan.seed,
        script=plan.script,
        rules=asdict(JumpRules.of(setup.robot)),
        settings={"kinds": list(plan.ladders), "runs": plan.runs, "enough": plan.enough},
        timing={"seconds": time.perf_counter() - begun},
    )


# ---- sums ----


class Rung(NamedTuple):
    """One size, with the lead that did best."""

    size: float
    lead: float
    crossed: int
    runs: int
    """With that lead."""
    reasons: Mapping[str, int]
    """Why the others were not crossed, with all leads."""


class Climb(NamedTuple):
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
    return Rung(
        size=figures[0].size,
        lead=best,
        crossed=counts[best],
        runs=sum(each.lead == best for each in figures),
        reasons=Counter(each.why for each in figures if each.why),
    )


def climbs(results: Results) -> tuple[Climb, ...]:
    """Sum up every policy with every command and kind of obstacle."""
    found = []
    tried = itertools.product(results.subjects, results.cases, results.settings["kinds"])
    for subject, case, kind in tried:
        rows = results.of(subject.name, case.name)
        own = [row for row in rows if row.figures.obstacle == kind]
        sizes = sorted({row.figures.size for row in own})
        rungs = [rung_of([row for row in own if row.figures.size == size]) for size in sizes]
        crossed = itertools.takewhile(lambda r: r.crossed >= results.settings["enough"], rungs)
        largest = max((rung.size for rung in crossed), default=0.0)
        ever = max((row.figures.size for row in own if row.figures.success), default=0.0)
        found.append(Climb(subject.name, case.name, kind, tuple(rungs), largest, ever))
    return tuple(found)
