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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from pronk.arrays import Array, Mask
from pronk.errors import PronkError
from pronk.jump.trial.jumps import (
    FALLEN_COSINE,
    JumpRules,
    cosine_of_tilt,
    figure,
    jump_flights,
    measure_jump,
    sample_at,
)
from pronk.jump.trial.protocol import Case, named
from pronk.jump.trial.results import (
    TrialResults,
    TrialRun,
    TriedPolicy,
    save_results,
    study_kind,
)
from pronk.jump.trial.trial import (
    OFFSET,
    TrialJob,
    TrialSetup,
    case_rng,
    load_subjects,
    software_versions,
)
from pronk.jump.virtual.capture import Capture
from pronk.jump.virtual.ground import Box, Ground, Start
from pronk.policy.rollout import ticks
from pronk.policy.script import STILL, Commanded, Script, Velocity
from pronk.processes import FEWER_PROCESSES, in_processes

Shape = Literal["flat", "gap", "up", "down"]

DEPTH = 1.0
"""Depth of a gap [m]."""
BEHIND = 5.0
"""Length of the floor behind the start [m]."""
BEYOND = 15.0
"""Length of the floor behind the far edge [m]."""
WIDE = 8.0
"""Half-width of the course [m]."""
RUN_UP_S = 2.0
"""Time in which the command reaches the edge [s]."""
PHASE_S = 0.5
"""Starts lie up to this many seconds of the command further back, more than a stride [s]."""
LATE = 3.0
"""A run ends if the robot has not reached the edge after this many times the run-up [1]."""
STEERED = 0.02
"""Half-width of the headings at the start [rad]."""
ROUNDS_LEFT = 5.0
"""Number of rounds of the search that still come, as the progress guesses."""

NOT_TRIGGERED = "never came to the place of the jump"
STEPPED_IN = "a foot went below the floor between the edges"
NON_FOOT_CONTACT = "something but a foot touched"
NOT_OVER = "not every foot came down behind the far edge"
FELL = "not upright 2 s later"


@dataclass(frozen=True, kw_only=True)
class Obstacle:
    """A gap or a step on the way of a command."""

    shape: Shape
    size: float = 0.0
    """Width of a gap, height of a step [m]."""
    command: Velocity
    """Velocity straight forward, back or to a side."""
    edge: float
    """Place where it begins, along the course [m]."""

    @property
    def far(self) -> float:
        """Place where the floor goes on, along the course [m]."""
        return self.edge + self.size if self.shape == "gap" else self.edge

    def on(self, ground: Ground) -> Ground:
        """Put the obstacle on a ground, whose friction and stiffness stay."""
        if self.shape == "flat":
            return replace(ground, floor=0.0, terrain=())
        if self.shape == "gap":
            floor = -DEPTH
            near_block = self._box(-BEHIND, self.edge, floor, 0.0)
            far_block = self._box(self.far, self.far + BEYOND, floor, 0.0)
            terrain: tuple[Box, ...] = (near_block, far_block)
        elif self.shape == "up":
            floor = 0.0
            terrain = (self._box(self.far, self.far + BEYOND, floor, self.size),)
        else:
            floor = -self.size
            terrain = (self._box(-BEHIND, self.edge, floor, 0.0),)
        return replace(ground, floor=floor, terrain=terrain)

    def _box(self, begin: float, end: float, low: float, high: float) -> Box:
        """Return a block between two places of the course and two heights [m]."""
        way = direction(self.command)
        x, y = (0.5 * (begin + end) * way).tolist()
        half_x, half_y = np.where(way != 0.0, 0.5 * (end - begin), WIDE).tolist()
        return Box(
            center=(x, y, 0.5 * (low + high)), half_size=(half_x, half_y, 0.5 * (high - low))
        )


def direction(command: Velocity) -> Array:
    """Return the unit vector of a command straight forward, back or to a side. (2,)."""
    forward, sideways, _ = command
    if bool(forward) == bool(sideways):
        raise PronkError(
            f"command {command} on a course; expected one straight forward, back or to a side."
        )
    return np.array([np.sign(forward), np.sign(sideways)])


# ---- one run ----


@dataclass
class CourseOperator:
    """The command over time: run, and jump when the trunk is at `trigger_at`."""

    script: Script
    trigger_at: float
    """Place of the trunk at which the jump is commanded, along the course [m]."""
    trunk_place: Callable[[], float]
    """Returns the trunk's place along the course [m]."""
    triggered: float | None = None
    """When the jump input rose, since the policy took over [s]."""

    def __call__(self, t: float) -> Commanded:
        """Return the command at a time since the policy took over [s]."""
        script = self.script
        if t < script.stand_s:
            return STILL, False
        if self.triggered is None and self.trunk_place() >= self.trigger_at:
            self.triggered = t
        if self.triggered is None:
            return script.command, False
        since = t - self.triggered
        is_moving = since < script.jump_s + script.keep_s
        return (script.command if is_moving else STILL), since < script.jump_s


@dataclass(frozen=True, kw_only=True)
class CrossingFigures:
    """One run at an obstacle."""

    obstacle: str = "flat"
    """Shape of the obstacle; `flat` for practice."""
    why: str = ""
    """First condition that was not met; empty if the obstacle was crossed."""
    size: float = figure("m", "width of the gap, height of the step")
    lead: float = figure("m", "from the trunk to the edge when the jump input rises")
    take_off: float = figure("m", "from the front-most last foothold before the flight to the edge")
    landing: float = figure("m", "from the far edge to the hind-most first foothold behind it")
    reach: float = figure("m", "from the trunk at the jump input to the front-most last foothold")
    speed: float = figure("m/s", "along the course at the jump input")

    @property
    def standing(self) -> bool:
        """Whether there was a run to measure, which is always so."""
        return True

    @property
    def found(self) -> bool:
        """Whether there was a run to measure, which is always so."""
        return True

    @property
    def success(self) -> bool:
        """Whether the obstacle was crossed."""
        return not self.why

    @property
    def fell(self) -> bool:
        """Whether the robot was not upright at the end."""
        return self.why == FELL

    @property
    def non_foot_contact(self) -> bool:
        """Whether something but a foot touched the ground."""
        return self.why == NON_FOOT_CONTACT


CROSSING = study_kind("crossing", CrossingFigures, measure_jump)


def is_lost(capture: Capture, obstacle: Obstacle) -> bool:
    """Return whether a run has failed already: a sample leans too far, or a foot stepped in."""
    fallen = cosine_of_tilt(capture.orientation) < FALLEN_COSINE
    return bool(fallen.any() or _stepped_in(capture, obstacle).any())


def measure_crossing(
    capture: Capture,
    obstacle: Obstacle,
    lead: float,
    *,
    triggered: float | None,
    rules: JumpRules,
) -> CrossingFigures:
    """Measure one run at an obstacle.

    Args:
        capture: The recorded motion.
        obstacle: What was to be crossed.
        lead: Distance from the trunk to the edge at which the jump was commanded [m].
        triggered: When the jump input rose, on the capture's clock [s]; None for never.
        rules: Times and heights of the definitions.
    """
    if triggered is None:
        return CrossingFigures(
            obstacle=obstacle.shape, size=obstacle.size, lead=lead, why=NOT_TRIGGERED
        )
    way = direction(obstacle.command)
    count = len(capture.time)
    on = min(sample_at(capture, triggered), count - 1)
    foot_place = capture.foot_position[:, :, :2] @ way
    trunk_place = capture.position[:, :2] @ way
    legs = np.arange(foot_place.shape[1])
    # The first sample from the jump input on at which each foot stands behind the far edge.
    behind = capture.contact & (foot_place >= obstacle.far)
    touched = np.where(behind[on:].any(axis=0), on + behind[on:].argmax(axis=0), count)
    landed = int(touched.max())
    reach = math.nan
    take_off = math.nan
    main = jump_flights(capture, on, rules, count).main
    if main is not None:
        before = capture.contact[: main.liftoff]
        last_stance = main.liftoff - 1 - before[::-1].argmax(axis=0)
        stood = np.where(before.any(axis=0), foot_place[last_stance, legs], -np.inf)
        front = float(stood.max())
        reach = front - float(trunk_place[on])
        if obstacle.shape != "flat":
            take_off = obstacle.edge - front
    landing = math.nan
    if landed < count and obstacle.shape != "flat":
        landing = float(foot_place[touched, legs].min()) - obstacle.far
    return CrossingFigures(
        obstacle=obstacle.shape,
        size=obstacle.size,
        lead=lead,
        why=_why_not_crossed(capture, obstacle, on=on, landed=landed, rules=rules),
        take_off=take_off,
        landing=landing,
        reach=reach,
        speed=float(capture.velocity[on, :2] @ way),
    )


def _why_not_crossed(
    capture: Capture, obstacle: Obstacle, *, on: int, landed: int, rules: JumpRules
) -> str:
    """Return the first condition that was not met; empty if the obstacle was crossed.

    Args:
        capture: The recorded motion.
        obstacle: What was to be crossed.
        on: Sample at which the jump input rose.
        landed: Sample from which on every foot has stood behind the far edge.
        rules: Times and heights of the definitions.
    """
    way = direction(obstacle.command)
    count = len(capture.time)
    settled = landed + round(rules.upright_s / capture.dt)
    end = min(settled + 1, count)
    cosine = cosine_of_tilt(capture.orientation)
    if _stepped_in(capture, obstacle)[:end].any():
        return STEPPED_IN
    if capture.other_contact[on:end].any():
        return NON_FOOT_CONTACT
    if landed >= count:
        return NOT_OVER
    is_upright = settled < count and cosine[settled] >= rules.upright_cosine
    if not is_upright or (cosine[:end] < FALLEN_COSINE).any():
        return FELL
    hindmost_foot = float((capture.foot_position[settled, :, :2] @ way).min())
    trunk = float(capture.position[settled, :2] @ way)
    if min(trunk, hindmost_foot) < obstacle.far:
        return NOT_OVER
    return ""


def _stepped_in(capture: Capture, obstacle: Obstacle) -> Mask:
    """Return the samples with a foot's centre below the floor between the edges of a gap. (T,)."""
    foot_place = capture.foot_position[:, :, :2] @ direction(obstacle.command)
    between = (foot_place > obstacle.edge) & (foot_place < obstacle.far)  # empty but for a gap
    return np.asarray((between & (capture.foot_position[:, :, 2] < 0.0)).any(axis=1))


@dataclass(frozen=True, kw_only=True)
class Attempt(TrialJob):
    """One run at an obstacle; the row's script has `stand_s`, `jump_s` and `keep_s`."""

    obstacle: Obstacle
    lead: float
    """Distance from the trunk to it when the jump input rises [m]."""


def run_attempt(attempt: Attempt) -> TrialRun:
    """Run once at an obstacle and measure it."""
    script = attempt.row.script
    obstacle = attempt.obstacle
    robot = attempt.setup.robot
    rules = JumpRules.of(robot)
    way = direction(script.command)
    machine = attempt.set_down()
    operator = CourseOperator(
        script,
        trigger_at=obstacle.edge - attempt.lead,
        trunk_place=lambda: float(machine.snapshot().position[0, :2] @ way),
    )
    # Time to lift off, to fly and land on all feet, and to stand.
    after_jump_s = rules.search_s + 1.0 + rules.upright_s
    latest_s = script.stand_s + LATE * (RUN_UP_S + PHASE_S)
    began = machine.now()
    for since in ticks(machine, attempt.policy(), robot, operator):
        if operator.triggered is None:
            if since > latest_s:
                break
        elif since > operator.triggered + after_jump_s or is_lost(machine.snapshot(), obstacle):
            break
    triggered = None if operator.triggered is None else began + operator.triggered
    figures = measure_crossing(
        machine.capture(), obstacle, attempt.lead, triggered=triggered, rules=rules
    )
    return replace(attempt.row, figures=figures)


# ---- many runs ----


class Ladder(NamedTuple):
    """The sizes of one shape of obstacle, and the leads beyond the reach of practice [m]."""

    sizes: tuple[float, ...]
    leads: tuple[float, ...]


def _sizes(first_cm: int, step_cm: int) -> tuple[float, ...]:
    """Return sizes up to 1.5 m [m]."""
    return tuple(cm / 100 for cm in range(first_cm, 151, step_cm))


LADDERS: Mapping[Shape, Ladder] = {
    "gap": Ladder(_sizes(10, 5), (0.04, 0.09, 0.14)),
    "up": Ladder(_sizes(5, 5), (0.05, 0.15, 0.25)),
    "down": Ladder(_sizes(10, 10), (0.0, 0.1)),
}


@dataclass(frozen=True, kw_only=True)
class CrossingPlan:
    """Commands, sizes and runs; the commands are those of the paper's gaps (R3)."""

    cases: tuple[Case, ...] = named("forward 2", "back 2", "side +1", "side -1")
    ladders: Mapping[Shape, Ladder] = field(default_factory=lambda: dict(LADDERS))
    """Sizes and leads by shape of obstacle."""
    runs: int = 5
    """Number of runs for each size and lead."""
    enough: int = 4
    """Number of them that must cross."""
    practice: int = 8
    """Number of jumps on flat ground with each command."""
    seed: int = 0
    """Seed of all draws."""
    script: Script = field(default_factory=lambda: Script(command=STILL))
    """Times of every run: `stand_s`, `jump_s` and `keep_s`."""


@dataclass(frozen=True, kw_only=True)
class _OpenClimb:
    """A ladder that one policy still climbs with one command."""

    subject: TriedPolicy
    case: Case
    shape: Shape
    reach: float
    """Mean reach of practice [m]."""


def climb_ladders(
    subjects: Sequence[TriedPolicy],
    plan: CrossingPlan,
    setup: TrialSetup,
    *,
    run: Callable[[list[Attempt]], list[TrialRun]],
) -> list[TrialRun]:
    """Practise, then climb all ladders at once, a size of each in every round.

    Args:
        subjects: The policies.
        plan: Commands, sizes and runs.
        setup: What the runs are on.
        run: Runs the attempts of one round.

    Returns:
        All runs, those of practice first.
    """
    practice: list[Attempt] = []
    for subject in subjects:
        for case in plan.cases:
            practice += _plan_attempts(
                subject, case, plan, setup, shape="flat", size=0.0, lead=0.0, runs=plan.practice
            )
    rows = run(practice)
    climbing: list[_OpenClimb] = []
    for subject in subjects:
        for case in plan.cases:
            reaches = []
            for row in rows:
                is_its_own = row.policy == subject.name and row.case == case.name
                if is_its_own and math.isfinite(row.figures.reach):
                    reaches.append(row.figures.reach)
            # Without a jump there is nothing to cross.
            if reaches:
                for shape in plan.ladders:
                    climbing.append(
                        _OpenClimb(
                            subject=subject, case=case, shape=shape, reach=float(np.mean(reaches))
                        )
                    )
    for rung in itertools.count():
        climbing = [climb for climb in climbing if rung < len(plan.ladders[climb.shape].sizes)]
        if not climbing:
            break
        attempts: list[Attempt] = []
        for climb in climbing:
            sizes, leads = plan.ladders[climb.shape]
            for beyond in leads:
                attempts += _plan_attempts(
                    climb.subject,
                    climb.case,
                    plan,
                    setup,
                    shape=climb.shape,
                    size=sizes[rung],
                    lead=round(climb.reach + beyond, 4),
                    runs=plan.runs,
                )
        round_rows = run(attempts)
        rows += round_rows
        still_climbing = []
        for climb in climbing:
            climb_rows = []
            for row in round_rows:
                if (row.policy, row.case, row.figures.obstacle) == (
                    climb.subject.name,
                    climb.case.name,
                    climb.shape,
                ):
                    climb_rows.append(row)
            if rung_of(climb_rows).crossed >= plan.enough:
                still_climbing.append(climb)
        climbing = still_climbing
    return rows


def _plan_attempts(
    subject: TriedPolicy,
    case: Case,
    plan: CrossingPlan,
    setup: TrialSetup,
    *,
    shape: Shape,
    size: float,
    lead: float,
    runs: int,
) -> list[Attempt]:
    """Plan runs at one obstacle; their starts are alike for all obstacles and leads."""
    speed = math.hypot(*case.command[:2])
    obstacle = Obstacle(shape=shape, size=size, command=case.command, edge=RUN_UP_S * speed)
    ground = obstacle.on(setup.sim_params.ground)
    course_setup = replace(setup, sim_params=replace(setup.sim_params, ground=ground))
    attempts = []
    for number in range(runs):
        rng = case_rng(plan.seed, case, number)
        x, y = (-PHASE_S * speed * rng.uniform() * direction(case.command)).tolist()
        offset = rng.uniform(-OFFSET, OFFSET, len(setup.robot.joints))
        yaw = float(rng.uniform(-STEERED, STEERED))
        row = TrialRun(
            policy=subject.name,
            case=case.name,
            number=number,
            seed=int(rng.integers(2**31)),
            script=replace(plan.script, command=case.command),
        )
        attempts.append(
            Attempt(
                row=row,
                subject=subject,
                run_kind=CROSSING,
                setup=course_setup,
                start=Start(position=(x, y), yaw=yaw, joint_offset=tuple(offset.tolist())),
                obstacle=obstacle,
                lead=lead,
            )
        )
    return attempts


def add_crossings(
    policies: Sequence[Path],
    plan: CrossingPlan,
    setup: TrialSetup,
    *,
    progress: Callable[[float], None] = lambda share: None,
) -> TrialResults:
    """Let policies cross gaps and steps; write `crossing.csv` and `crossing.json`.

    Args:
        policies: Files of the policies.
        plan: Commands, sizes and runs.
        setup: What the runs are on.
        progress: Called with an estimate of the share that is done, 0 to 1.

    Raises:
        PronkError: A policy or parameter is impossible; nothing was run then.
    """
    begun = time.perf_counter()
    subjects = load_subjects(policies, setup.robot)
    rounds = itertools.count()

    def run(attempts: list[Attempt]) -> list[TrialRun]:
        """Run one round."""
        attempts[0].build()  # refuses impossible parameters
        done = next(rounds)

        def report(share: float) -> None:
            progress((done + share) / (done + share + ROUNDS_LEFT))

        return in_processes(
            run_attempt,
            attempts,
            processes=setup.processes,
            names=[f"{attempt.name}, {attempt.obstacle.shape}" for attempt in attempts],
            way_out=FEWER_PROCESSES,
            progress=report,
        )

    rows = climb_ladders(subjects, plan, setup, run=run)
    progress(1.0)
    results = TrialResults(
        run_kind=CROSSING,
        rows=tuple(rows),
        robot=setup.robot.name,
        subjects=subjects,
        cases=plan.cases,
        seed=plan.seed,
        sim_params=setup.about,
        script=plan.script,
        rules=asdict(JumpRules.of(setup.robot)),
        settings={"shapes": list(plan.ladders), "runs": plan.runs, "enough": plan.enough},
        versions=software_versions(),
        timing={"seconds": time.perf_counter() - begun},
    )
    save_results(setup.out, results)
    return results


# ---- sums ----


class Rung(NamedTuple):
    """One size, with the lead that did best."""

    size: float
    lead: float
    crossed: int
    """Number of runs that crossed with that lead."""
    runs: int
    """Number of runs with that lead."""
    reasons: Mapping[str, int]
    """Why the others were not crossed, with all leads."""


class Climb(NamedTuple):
    """All sizes that one policy tried with one command."""

    policy: str
    case: str
    shape: str
    rungs: tuple[Rung, ...]
    largest: float
    """Largest size crossed in `enough` of its runs, as were all smaller ones; 0 for none [m]."""
    ever: float
    """Largest size crossed in any run; 0 for none [m]."""


def rung_of(rows: Sequence[TrialRun]) -> Rung:
    """Sum up the runs at obstacles of one size, with any lead."""
    crossed: Counter[float] = Counter()
    runs: Counter[float] = Counter()
    reasons: Counter[str] = Counter()
    for row in rows:
        runs[row.figures.lead] += 1
        if row.figures.success:
            crossed[row.figures.lead] += 1
        else:
            reasons[row.figures.why] += 1
    # With equal counts the shorter lead: the one nearer to the edge.
    best = max(sorted(runs), key=lambda lead: (crossed[lead], -lead))
    return Rung(
        size=rows[0].figures.size,
        lead=best,
        crossed=crossed[best],
        runs=runs[best],
        reasons=reasons,
    )


def climbs(results: TrialResults) -> tuple[Climb, ...]:
    """Sum up every policy with every command and shape of obstacle."""
    summed_climbs = []
    for subject in results.subjects:
        for case in results.cases:
            rows = results.of(subject.name, case.name)
            for shape in results.settings["shapes"]:
                obstacle_rows = [row for row in rows if row.figures.obstacle == shape]
                summed_climbs.append(
                    _sum_up_climb(
                        subject.name, case.name, shape, obstacle_rows, results.settings["enough"]
                    )
                )
    return tuple(summed_climbs)


def _sum_up_climb(
    policy: str, case: str, shape: str, rows: Sequence[TrialRun], enough: int
) -> Climb:
    """Sum up all sizes of one shape of obstacle."""
    rungs = []
    largest = 0.0
    is_unbroken = True
    for size in sorted({row.figures.size for row in rows}):
        rung = rung_of([row for row in rows if row.figures.size == size])
        rungs.append(rung)
        is_unbroken = is_unbroken and rung.crossed >= enough
        if is_unbroken:
            largest = rung.size
    crossed_sizes = [row.figures.size for row in rows if row.figures.success]
    return Climb(
        policy=policy,
        case=case,
        shape=shape,
        rungs=tuple(rungs),
        largest=largest,
        ever=max(crossed_sizes, default=0.0),
    )
