"""Gaps and steps: the blocks, the trigger of the jump, what counts as crossed, and the search."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hopper import ROBOT, write_hopper
from pronk.errors import PronkError
from pronk.jump.trial import crossing
from pronk.jump.trial.crossing import Attempt, CrossingFigures, CrossingPlan, Ladder, Obstacle
from pronk.jump.trial.jumps import JumpRules
from pronk.jump.trial.protocol import Case
from pronk.jump.trial.results import TrialResults, TrialRun, load_results
from pronk.jump.trial.trial import TrialSetup
from pronk.jump.virtual.capture import Capture
from pronk.jump.virtual.ground import Ground
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.policy.script import STILL, Script
from report_cases import of_kind, subject
from seen_jump import DELAY, SCRIPT, changed, seen_jump

RULES = JumpRules.of(ROBOT)
FORWARD, BACK, LEFT = (2.0, 0.0, 0.0), (-2.0, 0.0, 0.0), (0.0, 1.0, 0.0)
# At 2 m/s the trunk of `seen_jump` is at 4.0 m at the jump input and at 4.4 m at lift-off; the
# flight of 2 * 2.0 / g = 0.408 s takes it to 5.216 m. Feet stand 0.21 m before and behind it.
SEEN = seen_jump(up=2.0, speed=2.0)
TOOK_OFF, LANDED = 4.398 + 0.21, 5.216 - 0.21
EDGE = 4.65


def obstacle(kind: crossing.Shape = "gap", **changes: Any) -> Obstacle:
    return Obstacle(kind=kind, **({"size": 0.3, "command": FORWARD, "edge": EDGE} | changes))


GAP = obstacle()


def settled(
    seen: Capture, obstacle: Obstacle = GAP, triggered: float | None = SCRIPT.on
) -> CrossingFigures:
    return crossing.measure_crossing(seen, obstacle, 0.65, triggered=triggered, rules=RULES)


# --- The course ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "between", "after"),
    [("gap", -crossing.DEPTH, 0.0), ("up", 0.3, 0.3), ("down", -0.3, -0.3)],
)
@pytest.mark.parametrize(("command", "way"), [(FORWARD, (1, 0)), (BACK, (-1, 0)), (LEFT, (0, 1))])
def test_the_floor_is_where_it_should_be(
    kind: crossing.Shape, between: float, after: float, command: Any, way: tuple[int, int]
) -> None:
    own = Ground(friction=0.55, stiffness=20e3)
    ground = obstacle(kind, command=command, edge=2.0).on(own)
    assert (ground.friction, ground.stiffness) == (0.55, 20e3)
    places = {0.0: 0.0, 1.99: 0.0, 2.01: between, 2.29: between, 2.31: after, 8.0: after}
    for side in (0.0, 3.0):
        for s, expected in places.items():
            x, y = s * way[0] + side * way[1], s * way[1] + side * way[0]
            assert ground.height(x, y) == pytest.approx(expected)
    assert obstacle("flat", command=command).on(Ground()) == Ground()


def test_a_course_leads_straight_on() -> None:
    for command in ((1.0, 1.0, 0.0), STILL):
        with pytest.raises(PronkError, match="course"):
            crossing.direction(command)


def test_the_operator_looks_at_the_trunk() -> None:
    script = Script(command=FORWARD, stand_s=1.0, jump_s=0.4, keep_s=0.2)
    place = 5.0  # where it stands does not matter before it runs
    operator = crossing.CourseOperator(script, trigger_at=1.5, trunk_place=lambda: place)
    assert operator(0.5) == (STILL, False)
    place = 1.49
    assert operator(1.0) == (FORWARD, False)
    assert operator.triggered is None
    place = 1.5
    assert operator(1.02) == (FORWARD, True)
    assert operator.triggered == 1.02
    place = 0.0  # never taken back
    after = [operator(t) for t in (1.40, 1.43, 1.63)]
    assert after == [(FORWARD, True), (FORWARD, False), (STILL, False)]


def test_a_gap_that_was_crossed() -> None:
    found = settled(SEEN)
    assert found.take_off == pytest.approx(EDGE - TOOK_OFF, abs=1e-9)
    assert found.reach == pytest.approx(TOOK_OFF - 4.0, abs=1e-9)
    assert found.reach == pytest.approx(2.0 * (DELAY - 1e-3) + 0.21)
    assert found.landing == pytest.approx(LANDED - EDGE - 0.3, abs=2e-3)
    assert found.speed == pytest.approx(2.0)
    aside = settled(seen_jump(up=2.0, speed=2.0, yaw=math.pi / 2), obstacle(command=LEFT))
    assert aside.landing == pytest.approx(found.landing)


def span(begin: float, end: float | None = None) -> slice:
    return slice(round(begin * 1000), None if end is None else round(end * 1000))


LOW = changed(SEEN, "foot_position", (span(3.4, 3.45), 0), [4.8, 0.0, -0.01])
"""A foot's centre is under the floor while it is over the gap."""
LEANT = changed(SEEN, "orientation", span(5.5), [0.9, 0.0, 0.4359, 0.0])
LAY = changed(SEEN, "orientation", span(4.5, 4.6), [0.7, 0.714, 0.0, 0.0])
"""Upright at the end, but it lay on its side meanwhile."""


@pytest.mark.parametrize(
    ("seen", "size", "why", "ends"),
    [
        (SEEN, 0.3, "", False),
        (LOW, 0.3, crossing.STEPPED_IN, True),
        (changed(SEEN, "other_contact", 4000, True), 0.3, crossing.NON_FOOT_CONTACT, False),
        (SEEN, 0.4, crossing.NOT_OVER, False),  # the hind feet land 6 mm before the far edge
        (LEANT, 0.3, crossing.FELL, False),
        (LAY, 0.3, crossing.FELL, True),
        (changed(SEEN, "position", (span(5.0), 0), 4.9), 0.3, crossing.NOT_OVER, False),  # back
    ],
)
def test_why_a_gap_was_not_crossed(seen: Capture, size: float, why: str, ends: bool) -> None:
    assert settled(seen, obstacle(size=size)).why == why
    assert crossing.is_lost(seen, obstacle(size=size)) is ends


def test_what_happens_elsewhere_does_not_count() -> None:
    # A foot pressed into the floor beside the gap, a shank that touched before the jump.
    low = changed(SEEN, "foot_position", (span(3.7, 3.75), 0, 2), -0.001)
    assert settled(changed(low, "other_contact", span(0.0, 2.9), True)).success
    assert settled(SEEN, triggered=None).why == crossing.NOT_TRIGGERED
    # Steps have no bottom to fall into.
    assert settled(LOW, obstacle("down")).success
    assert settled(LOW, obstacle("up")).landing == pytest.approx(LANDED - EDGE, abs=2e-3)
    assert not crossing.is_lost(LOW, obstacle("up"))


# --- The search ---------------------------------------------------------------------------------

SETUP = TrialSetup(robot=ROBOT, sim_params=load_sim_params(), out=Path())
CASE = Case(name="forward 2", command=FORWARD)
LADDER = Ladder((0.1, 0.2, 0.3, 0.4), (0.0, 0.1))
PLAN = CrossingPlan(cases=(CASE,), ladders={"gap": LADDER}, runs=3, enough=2, practice=2)


def climb(
    crossed: dict[tuple[float, float], int], plan: CrossingPlan = PLAN, reach: float = 0.5
) -> tuple[list[TrialRun], list[Attempt]]:
    """Climb with a robot that crosses so many runs of each size and lead beyond its reach."""
    done: list[Attempt] = []

    def run(tasks: list[Attempt]) -> list[TrialRun]:
        done.extend(tasks)
        return [replace(task.row, figures=figures(task)) for task in tasks]

    def figures(task: Attempt) -> CrossingFigures:
        kind, size, number = task.obstacle.kind, task.obstacle.size, task.row.number
        if kind == "flat":
            return CrossingFigures(size=0.0, lead=0.0, reach=reach + 0.1 * number)
        good = number < crossed[size, round(task.lead - 0.55, 6)]
        why = "" if good else crossing.NON_FOOT_CONTACT
        return CrossingFigures(obstacle=kind, size=size, lead=task.lead, why=why)

    return crossing.climb_ladders([subject("matched")], plan, SETUP, run=run), done


def result(rows: list[TrialRun]) -> TrialResults:
    settings = {"kinds": ["gap"], "runs": PLAN.runs, "enough": PLAN.enough}
    rest: Any = {"rows": tuple(rows), "settings": settings}
    return of_kind(crossing.CROSSING, ("matched",), cases=(CASE,), **rest)


def test_sizes_grow_until_no_lead_does() -> None:
    crossed = {(0.1, 0.0): 1, (0.1, 0.1): 3, (0.2, 0.0): 2, (0.2, 0.1): 2}
    crossed |= {(0.3, 0.0): 0, (0.3, 0.1): 1}
    rows, _ = climb(crossed)
    # Two jumps of practice, then three runs for each of two leads at three sizes.
    assert len(rows) == 2 + 3 * 2 * 3
    (found,) = crossing.climbs(result(rows))
    assert [rung.size for rung in found.rungs] == [0.1, 0.2, 0.3]
    assert [(rung.crossed, rung.runs) for rung in found.rungs] == [(3, 3), (2, 3), (1, 3)]
    assert [rung.lead for rung in found.rungs] == pytest.approx([0.65, 0.55, 0.65])
    assert found.rungs[0].reasons == {crossing.NON_FOOT_CONTACT: 2}
    assert (found.largest, found.ever) == (0.2, 0.3)
    # A larger gap does not count without the smaller.
    rows, _ = climb({(0.1, 0.0): 0, (0.1, 0.1): 1})
    more = [replace(row, figures=replace(row.figures, size=0.2, why="")) for row in rows[2:]]
    (found,) = crossing.climbs(result([*rows, *more]))
    assert (found.largest, found.ever) == (0.0, 0.2)


def test_a_robot_that_does_not_jump_crosses_nothing() -> None:
    rows, _ = climb({}, reach=math.nan)
    assert len(rows) == PLAN.practice
    assert crossing.climbs(result(rows))[0].rungs == ()


def test_starts_depend_on_command_and_number_alone() -> None:
    def starts(plan: CrossingPlan) -> list[object]:
        return [(a.start, a.row.seed) for a in climb({}, plan, reach=math.nan)[1]]

    other = Case(name="back 2", command=BACK)
    both = starts(replace(PLAN, cases=(other, CASE)))
    assert both[2:] == starts(PLAN) != starts(replace(PLAN, seed=1))
    for start, _ in both[2:]:  # type: ignore[misc]
        assert -crossing.PHASE_S * 2.0 <= start.position[0] <= 0.0


def test_a_hopper_that_does_not_run_never_comes_to_the_edge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnxruntime")
    monkeypatch.setattr(crossing, "LATE", 0.2)  # half a second is enough to see it stand
    policy = write_hopper(tmp_path / "policy.onnx")
    slow = Case(name="forward", command=(0.2, 0.0, 0.0))
    script = Script(command=slow.command, stand_s=0.1)
    plan = replace(PLAN, cases=(slow,), practice=1, script=script)
    found = crossing.add_crossings([policy], plan, replace(SETUP, out=tmp_path))
    assert [row.figures.why for row in found.rows] == [crossing.NOT_TRIGGERED]
    assert crossing.climbs(found)[0].largest == 0.0
    assert repr(load_results(tmp_path, crossing.CROSSING).rows) == repr(found.rows)
    assert np.isnan(found.rows[0].figures.reach)
