"""How sizes grow: practice, rungs, the largest that was crossed; and one real attempt."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from hopper import ROBOT, write_hopper
from pronk.errors import ArtefactError, PronkError
from pronk.evaluation import result_io as sheet
from pronk.evaluation.protocol import Case
from pronk.evaluation.result import Subject
from pronk.evaluation.terrain import climbing, course, crossing
from pronk.evaluation.terrain.climbing import Ladder, Plan, add_crossings
from pronk.evaluation.terrain.course import Verdict
from pronk.evaluation.terrain.crossing import Crossing, Crossings
from pronk.runtime.script import Script
from pronk.virtual.sim_params import load_sim_params

SIM_PARAMS = load_sim_params()
SUBJECT = Subject(name="matched", path="policy.onnx", sha256="0" * 64, contract={})
CASE = Case(name="forward 2", command=(2.0, 0.0, 0.0))
PLAN = Plan(
    cases=(CASE,),
    ladders={"gap": Ladder(first=0.1, step=0.1, leads=(0.0, 0.1))},
    runs=3,
    enough=2,
    practice=2,
    most=0.45,
)


def climb(answer: dict[tuple[float, float], int], plan: Plan = PLAN) -> list[Crossing]:
    """Climb with a robot that crosses so many runs of each size and lead beyond its reach."""
    search = climbing._Search([SUBJECT], plan, robot=ROBOT, sim_params=SIM_PARAMS)
    while asked := search.next_round():
        found = []
        for row, task in asked:
            assert row.lead == task.lead
            if row.kind == "flat":
                found.append(Verdict(why="", reach=0.5 + 0.1 * row.number))
                continue
            good = answer[row.size, round(row.lead - 0.55, 6)]
            found.append(Verdict(why="" if row.number < good else course.TOUCHED, speed=2.0))
        assert 0.0 <= search.share(0.5) <= 1.0
        search.take([row for row, _ in asked], found)
    assert search.share(0.0) == 1.0
    return search.rows


def result(rows: list[Crossing], plan: Plan = PLAN) -> Crossings:
    origin = sheet.Origin(
        robot="mini_cheetah", virtual=True, subjects=(SUBJECT,), sim_params={}, seed=0, versions={}
    )
    return Crossings(
        origin=origin,
        cases=plan.cases,
        kinds=tuple(plan.ladders),
        runs=plan.runs,
        enough=plan.enough,
        rows=tuple(rows),
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
    (found,) = result(rows).climbs
    assert [rung.size for rung in found.rungs] == [0.1, 0.2, 0.3]
    assert [(rung.crossed, rung.runs) for rung in found.rungs] == [(3, 3), (2, 3), (1, 3)]
    assert [rung.lead for rung in found.rungs] == pytest.approx([0.65, 0.55, 0.65])
    assert found.rungs[0].reasons == {course.TOUCHED: 2}
    assert (found.largest, found.ever) == (0.2, 0.3)


def test_the_search_ends_at_the_most() -> None:
    rows = climb({(size, lead): 3 for size in (0.1, 0.2, 0.3, 0.4) for lead in (0.0, 0.1)})
    assert max(row.size for row in rows) == 0.4
    assert result(rows).climbs[0].largest == 0.4


def test_a_larger_gap_does_not_count_without_the_smaller() -> None:
    rows = climb({(0.1, 0.0): 0, (0.1, 0.1): 1})
    more = [replace(row, size=0.2, why="") for row in rows if row.kind == "gap"]
    (found,) = result([*rows, *more]).climbs
    assert (found.largest, found.ever) == (0.0, 0.2)


def test_a_robot_that_does_not_jump_crosses_nothing() -> None:
    search = climbing._Search([SUBJECT], PLAN, robot=ROBOT, sim_params=SIM_PARAMS)
    asked = search.next_round()
    search.take([row for row, _ in asked], [Verdict(why="", reach=math.nan)] * len(asked))
    assert search.next_round() == []
    assert result(search.rows).climbs[0].rungs == ()


def test_starts_depend_on_command_and_number_alone() -> None:
    def starts(plan: Plan) -> list[object]:
        search = climbing._Search([SUBJECT], plan, robot=ROBOT, sim_params=SIM_PARAMS)
        return [(task.job.start, task.job.seed) for _, task in search.next_round()]

    other = Case(name="back 2", command=(-2.0, 0.0, 0.0))
    both = starts(replace(PLAN, cases=(other, CASE)))
    assert both[2:] == starts(PLAN)
    assert starts(replace(PLAN, seed=1)) != starts(PLAN)
    for start, _ in both[2:]:  # type: ignore[misc]
        assert -climbing.PHASE_S * 2.0 <= start.position[0] <= 0.0


def test_a_sheet_is_read_as_it_was_written(tmp_path: Path) -> None:
    found = result(climb({(0.1, 0.0): 0, (0.1, 0.1): 1}))
    path = crossing.save(tmp_path, found)
    read = crossing.load(tmp_path)
    # NaN is not equal to itself.
    assert repr(read) == repr(found)
    path.write_text(path.read_text().replace('"lead"', '"led"'))
    with pytest.raises(ArtefactError, match=r"damaged.*--crossing"):
        crossing.load(tmp_path)
    path.write_text('{"schema": "another"}')
    with pytest.raises(ArtefactError, match="schema 'another'"):
        crossing.load(tmp_path)
    path.unlink()
    with pytest.raises(ArtefactError, match="no such file"):
        crossing.load(tmp_path)


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
    monkeypatch.setattr(climbing, "LATE", 0.2)  # half a second is enough to see it stand
    policy = write_hopper(tmp_path / "policy.onnx")
    slow = Case(name="forward", command=(0.2, 0.0, 0.0))
    plan = replace(
        PLAN, cases=(slow,), practice=1, script=Script(command=slow.command, stand_s=0.1)
    )
    found = add_crossings([policy], plan, robot=ROBOT, sim_params=SIM_PARAMS, out=tmp_path)
    assert [row.why for row in found.rows] == [course.NOT_TRIGGERED]
    assert found.climbs[0].largest == 0.0
    assert repr(crossing.load(tmp_path).rows) == repr(found.rows)
