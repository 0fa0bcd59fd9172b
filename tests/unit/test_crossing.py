"""How sizes grow: practice, rungs, the largest that was crossed; and one real attempt."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from hopper import ROBOT, write_hopper
from pronk.errors import PronkError
from pronk.evaluation import course, crossing, results
from pronk.evaluation.course import CrossingFigures
from pronk.evaluation.crossing import (
    CROSSING,
    CrossingPlan,
    Ladder,
    Search,
    add_crossings,
    climbs,
)
from pronk.evaluation.protocol import Case
from pronk.evaluation.results import Results, Row, Subject
from pronk.runtime.script import Script
from pronk.virtual.sim_params import load_sim_params

SIM_PARAMS = load_sim_params()
SUBJECT = Subject(name="matched", path="policy.onnx", sha256="0" * 64, contract={})
CASE = Case(name="forward 2", command=(2.0, 0.0, 0.0))
PLAN = CrossingPlan(
    cases=(CASE,),
    ladders={"gap": Ladder(first=0.1, step=0.1, leads=(0.0, 0.1))},
    runs=3,
    enough=2,
    practice=2,
    most=0.45,
)


def start_search(plan: CrossingPlan = PLAN) -> Search:
    return Search([SUBJECT], plan, robot=ROBOT, sim_params=SIM_PARAMS)


def climb(crossed: dict[tuple[float, float], int]) -> list[Row]:
    """Climb with a robot that crosses so many runs of each size and lead beyond its reach."""
    search = start_search()
    while planned := search.next_round():
        found = []
        for row, task in planned:
            kind, size = task.obstacle.kind, task.obstacle.size
            if kind == "flat":
                found.append(CrossingFigures(size=0.0, lead=0.0, reach=0.5 + 0.1 * row.number))
                continue
            good = row.number < crossed[size, round(task.lead - 0.55, 6)]
            why = "" if good else course.NON_FOOT_CONTACT
            found.append(CrossingFigures(obstacle=kind, size=size, lead=task.lead, why=why))
        assert 0.0 <= search.share(0.5) <= 1.0
        search.take([row for row, _ in planned], found)
    assert search.share(0.0) == 1.0
    return search.rows


def result(rows: list[Row]) -> Results:
    return Results(
        kind=CROSSING,
        robot="mini_cheetah",
        subjects=(SUBJECT,),
        cases=PLAN.cases,
        rows=tuple(rows),
        seed=0,
        sim_params={},
        script=PLAN.script,
        settings={"kinds": ["gap"], "runs": PLAN.runs, "enough": PLAN.enough},
    )


def test_sizes_grow_until_no_lead_does() -> None:
    counts = {
        (0.1, 0.0): 1,
        (0.1, 0.1): 3,
        (0.2, 0.0): 2,
        (0.2, 0.1): 2,
        (0.3, 0.0): 0,
        (0.3, 0.1): 1,
    }
    rows = climb(counts)
    # Two jumps of practice, then three runs for each of two leads at three sizes.
    assert len(rows) == 2 + 3 * 2 * 3
    (found,) = climbs(result(rows))
    assert [rung.size for rung in found.rungs] == [0.1, 0.2, 0.3]
    assert [(rung.crossed, rung.runs) for rung in found.rungs] == [(3, 3), (2, 3), (1, 3)]
    assert [rung.lead for rung in found.rungs] == pytest.approx([0.65, 0.55, 0.65])
    assert found.rungs[0].reasons == {course.NON_FOOT_CONTACT: 2}
    assert (found.largest, found.ever) == (0.2, 0.3)


def test_a_larger_gap_does_not_count_without_the_smaller() -> None:
    rows = climb({(0.1, 0.0): 0, (0.1, 0.1): 1})
    more = [
        replace(row, figures=replace(row.figures, size=0.2, why=""))
        for row in rows
        if row.figures.obstacle == "gap"
    ]
    (found,) = climbs(result([*rows, *more]))
    assert (found.largest, found.ever) == (0.0, 0.2)


def test_a_robot_that_does_not_jump_crosses_nothing() -> None:
    search = start_search()
    planned = search.next_round()
    search.take([row for row, _ in planned], [CrossingFigures(reach=math.nan)] * len(planned))
    assert search.next_round() == []
    assert climbs(result(search.rows))[0].rungs == ()


def test_starts_depend_on_command_and_number_alone() -> None:
    def starts(plan: CrossingPlan) -> list[object]:
        search = start_search(plan)
        return [(task.job.start, task.job.seed) for _, task in search.next_round()]

    other = Case(name="back 2", command=(-2.0, 0.0, 0.0))
    both = starts(replace(PLAN, cases=(other, CASE)))
    assert both[2:] == starts(PLAN)
    assert starts(replace(PLAN, seed=1)) != starts(PLAN)
    for start, _ in both[2:]:  # type: ignore[misc]
        assert -crossing.PHASE_S * 2.0 <= start.position[0] <= 0.0


@pytest.mark.parametrize(
    "changes",
    [{"enough": 4}, {"practice": 0}, {"cases": (Case(name="x", command=(1.0, 1.0, 0.0)),)}],
)
def test_impossible_plans_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(PronkError, match="expected"):
        replace(PLAN, **changes)  # type: ignore[arg-type]
    with pytest.raises(PronkError, match="sizes must be positive"):
        Ladder(first=0.1, step=0.0, leads=(0.0,))


def test_a_hopper_that_does_not_run_never_comes_to_the_edge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnxruntime")
    monkeypatch.setattr(crossing, "LATE", 0.2)  # half a second is enough to see it stand
    policy = write_hopper(tmp_path / "policy.onnx")
    slow = Case(name="forward", command=(0.2, 0.0, 0.0))
    plan = replace(
        PLAN, cases=(slow,), practice=1, script=Script(command=slow.command, stand_s=0.1)
    )
    found = add_crossings([policy], plan, robot=ROBOT, sim_params=SIM_PARAMS, out=tmp_path)
    assert [row.figures.why for row in found.rows] == [course.NOT_TRIGGERED]
    assert climbs(found)[0].largest == 0.0
    assert repr(results.load(tmp_path, CROSSING).rows) == repr(found.rows)
