"""Gaps and steps: the blocks, the trigger of the jump, what counts as crossed, and the search."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hopper import ROBOT, write_hopper
from pronk.errors import PronkError
from pronk.jump.trial import crossing
from pronk.jump.trial.crossing import (
    Attempt,
    CrossingFigures,
    CrossingPlan,
    Ladder,
    Obstacle,
    climb_ladders,
    climbs,
    measure_crossing,
)
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
FORWARD = (2.0, 0.0, 0.0)
BACK = (-2.0, 0.0, 0.0)
TO_THE_LEFT = (0.0, 1.0, 0.0)
# At 2 m/s the trunk of `seen_jump` is at 4.0 m at the jump input and at 4.4 m at lift-off; the
# flight of 2 * 2.0 / g = 0.408 s takes it to 5.216 m. Feet stand 0.21 m before and behind it.
SEEN = seen_jump(up=2.0, speed=2.0)
TOOK_OFF = 4.398 + 0.21
"""Front-most last foothold [m]."""
LANDED = 5.216 - 0.21
"""Hind-most first foothold [m]."""
EDGE = 4.65
"""Place of the edge [m]."""


def obstacle(
    shape: crossing.Shape = "gap",
    *,
    size: float = 0.3,
    command: tuple[float, float, float] = FORWARD,
    edge: float = EDGE,
) -> Obstacle:
    return Obstacle(shape=shape, size=size, command=command, edge=edge)


def measured(
    capture: Capture, obstacle: Obstacle, triggered: float | None = SCRIPT.on
) -> CrossingFigures:
    return measure_crossing(capture, obstacle, 0.65, triggered=triggered, rules=RULES)


# --- The course ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "between", "after"),
    [("gap", -crossing.DEPTH, 0.0), ("up", 0.3, 0.3), ("down", -0.3, -0.3)],
)
@pytest.mark.parametrize(
    ("command", "direction"), [(FORWARD, (1, 0)), (BACK, (-1, 0)), (TO_THE_LEFT, (0, 1))]
)
def test_the_floor_is_where_it_should_be(
    shape: crossing.Shape,
    between: float,
    after: float,
    command: tuple[float, float, float],
    direction: tuple[int, int],
) -> None:
    ground = obstacle(shape, command=command, edge=2.0).on(Ground(friction=0.55, stiffness=20e3))
    assert (ground.friction, ground.stiffness) == (0.55, 20e3)
    heights = {0.0: 0.0, 1.99: 0.0, 2.01: between, 2.29: between, 2.31: after, 8.0: after}
    for side in (0.0, 3.0):
        for along, height in heights.items():
            x = along * direction[0] + side * direction[1]
            y = along * direction[1] + side * direction[0]
            assert ground.height(x, y) == pytest.approx(height)


def test_flat_ground_has_no_blocks() -> None:
    assert obstacle("flat").on(Ground()) == Ground()


@pytest.mark.parametrize("command", [(1.0, 1.0, 0.0), STILL])
def test_a_course_leads_straight_on(command: tuple[float, float, float]) -> None:
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
    assert operator(1.40) == (FORWARD, True)
    assert operator(1.43) == (FORWARD, False)
    assert operator(1.63) == (STILL, False)


# --- What counts as crossed ---------------------------------------------------------------------


def test_a_gap_that_was_crossed() -> None:
    figures = measured(SEEN, obstacle())
    assert figures.success
    assert figures.take_off == pytest.approx(EDGE - TOOK_OFF, abs=1e-9)
    assert figures.reach == pytest.approx(TOOK_OFF - 4.0, abs=1e-9)
    assert figures.reach == pytest.approx(2.0 * (DELAY - 1e-3) + 0.21)
    assert figures.landing == pytest.approx(LANDED - EDGE - 0.3, abs=2e-3)
    assert figures.speed == pytest.approx(2.0)


def test_a_course_to_the_side_is_measured_alike() -> None:
    sideways = seen_jump(up=2.0, speed=2.0, yaw=math.pi / 2)
    figures = measured(sideways, obstacle(command=TO_THE_LEFT))
    assert figures.landing == pytest.approx(measured(SEEN, obstacle()).landing)


def span(begin: float, end: float | None = None) -> slice:
    """Samples between two times [s]."""
    return slice(round(begin * 1000), None if end is None else round(end * 1000))


LOW = changed(SEEN, "foot_position", (span(3.4, 3.45), 0), [4.8, 0.0, -0.01])
"""A foot's centre is under the floor while it is over the gap."""
LEANT = changed(SEEN, "orientation", span(5.5), [0.9, 0.0, 0.4359, 0.0])
"""It leans too far from half a second after the landing on."""
LAY = changed(SEEN, "orientation", span(4.5, 4.6), [0.7, 0.714, 0.0, 0.0])
"""Upright at the end, but it lay on its side meanwhile."""
TOUCHED = changed(SEEN, "other_contact", 4000, True)
"""A shank touched the ground."""
WENT_BACK = changed(SEEN, "position", (span(5.0), 0), 4.9)
"""The trunk is before the far edge at the end."""


@pytest.mark.parametrize(
    ("capture", "size", "why", "is_lost"),
    [
        (SEEN, 0.3, "", False),
        (LOW, 0.3, crossing.STEPPED_IN, True),
        (TOUCHED, 0.3, crossing.NON_FOOT_CONTACT, False),
        (SEEN, 0.4, crossing.NOT_OVER, False),  # the hind feet land 6 mm before the far edge
        (LEANT, 0.3, crossing.FELL, False),
        (LAY, 0.3, crossing.FELL, True),
        (WENT_BACK, 0.3, crossing.NOT_OVER, False),
    ],
)
def test_why_a_gap_was_not_crossed(capture: Capture, size: float, why: str, is_lost: bool) -> None:
    gap = obstacle(size=size)
    assert measured(capture, gap).why == why
    assert crossing.is_lost(capture, gap) is is_lost


def test_a_touch_elsewhere_does_not_count() -> None:
    # A foot pressed into the floor beside the gap, a shank that touched before the jump.
    low = changed(SEEN, "foot_position", (span(3.7, 3.75), 0, 2), -0.001)
    capture = changed(low, "other_contact", span(0.0, 2.9), True)
    assert measured(capture, obstacle()).success


def test_a_jump_that_was_never_commanded() -> None:
    assert measured(SEEN, obstacle(), triggered=None).why == crossing.NOT_TRIGGERED


def test_steps_have_no_bottom_to_fall_into() -> None:
    assert measured(LOW, obstacle("down")).success
    assert measured(LOW, obstacle("up")).landing == pytest.approx(LANDED - EDGE, abs=2e-3)
    assert not crossing.is_lost(LOW, obstacle("up"))


# --- The search ---------------------------------------------------------------------------------

SETUP = TrialSetup(robot=ROBOT, sim_params=load_sim_params(), out=Path())
CASE = Case(name="forward 2", command=FORWARD)
LADDER = Ladder((0.1, 0.2, 0.3, 0.4), (0.0, 0.1))
PLAN = CrossingPlan(cases=(CASE,), ladders={"gap": LADDER}, runs=3, enough=2, practice=2)


@dataclass
class Climber:
    """A robot that crosses so many runs of each size and lead beyond its reach."""

    crossed: dict[tuple[float, float], int] = field(default_factory=dict)
    reach: float = 0.5
    """Reach of its first run of practice; each further one reaches 0.1 m further [m]."""
    attempts: list[Attempt] = field(default_factory=list)

    def climb(self, plan: CrossingPlan = PLAN) -> list[TrialRun]:
        return climb_ladders([subject("matched")], plan, SETUP, run=self._run)

    def _run(self, attempts: list[Attempt]) -> list[TrialRun]:
        self.attempts += attempts
        rows = []
        for attempt in attempts:
            rows.append(replace(attempt.row, figures=self._figures(attempt)))
        return rows

    def _figures(self, attempt: Attempt) -> CrossingFigures:
        number = attempt.row.number
        obstacle = attempt.obstacle
        if obstacle.shape == "flat":
            return CrossingFigures(size=0.0, lead=0.0, reach=self.reach + 0.1 * number)
        beyond = round(attempt.lead - 0.55, 6)  # the mean reach of practice
        is_crossed = number < self.crossed[obstacle.size, beyond]
        return CrossingFigures(
            obstacle=obstacle.shape,
            size=obstacle.size,
            lead=attempt.lead,
            why="" if is_crossed else crossing.NON_FOOT_CONTACT,
        )


def result(rows: list[TrialRun]) -> TrialResults:
    settings = {"shapes": ["gap"], "runs": PLAN.runs, "enough": PLAN.enough}
    return of_kind(
        crossing.CROSSING, ("matched",), cases=(CASE,), rows=tuple(rows), settings=settings
    )


def test_sizes_grow_until_no_lead_does() -> None:
    climber = Climber(
        crossed={
            (0.1, 0.0): 1,
            (0.1, 0.1): 3,
            (0.2, 0.0): 2,
            (0.2, 0.1): 2,
            (0.3, 0.0): 0,
            (0.3, 0.1): 1,
        }
    )
    rows = climber.climb()
    # Two jumps of practice, then three runs for each of two leads at three sizes.
    assert len(rows) == 2 + 3 * 2 * 3
    (climb,) = climbs(result(rows))
    assert [rung.size for rung in climb.rungs] == [0.1, 0.2, 0.3]
    assert [(rung.crossed, rung.runs) for rung in climb.rungs] == [(3, 3), (2, 3), (1, 3)]
    assert [rung.lead for rung in climb.rungs] == pytest.approx([0.65, 0.55, 0.65])
    assert climb.rungs[0].reasons == {crossing.NON_FOOT_CONTACT: 2}
    assert (climb.largest, climb.ever) == (0.2, 0.3)


def test_a_larger_gap_does_not_count_without_the_smaller() -> None:
    rows = Climber(crossed={(0.1, 0.0): 0, (0.1, 0.1): 1}).climb()
    larger = []
    for row in rows[PLAN.practice :]:
        larger.append(replace(row, figures=replace(row.figures, size=0.2, why="")))
    (climb,) = climbs(result([*rows, *larger]))
    assert (climb.largest, climb.ever) == (0.0, 0.2)


def test_a_robot_that_does_not_jump_crosses_nothing() -> None:
    rows = Climber(reach=math.nan).climb()
    assert len(rows) == PLAN.practice
    (climb,) = climbs(result(rows))
    assert climb.rungs == ()


def starts(plan: CrossingPlan) -> list[Any]:
    """Starts and noise seeds of the runs of practice."""
    climber = Climber(reach=math.nan)
    climber.climb(plan)
    return [(attempt.start, attempt.row.seed) for attempt in climber.attempts]


def test_starts_depend_on_command_and_number_alone() -> None:
    back = Case(name="back 2", command=BACK)
    both_commands = starts(replace(PLAN, cases=(back, CASE)))
    assert both_commands[2:] == starts(PLAN)
    assert both_commands[2:] != starts(replace(PLAN, seed=1))
    for start, _ in both_commands[2:]:
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
    results = crossing.add_crossings([policy], plan, replace(SETUP, out=tmp_path))
    assert [row.figures.why for row in results.rows] == [crossing.NOT_TRIGGERED]
    assert climbs(results)[0].largest == 0.0
    assert repr(load_results(tmp_path, crossing.CROSSING).rows) == repr(results.rows)
    assert np.isnan(results.rows[0].figures.reach)
