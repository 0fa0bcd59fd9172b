"""The acceptance criteria and the plan of an evaluation in the training simulator."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pronk.cli.evaluate import PaceReport
from pronk.errors import ArtefactError, PronkError
from pronk.jump.trial.criteria import cost_of_jumping, evaluation_checks
from pronk.jump.trial.results import Spread
from pronk.jump.trial.training_sim import evaluation as sim
from pronk.jump.trial.training_sim.results import load_speed_errors, save_evaluation
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
DT = 0.005
"""Physics step [s]."""


def spread(mean: float, std: float = 0.01) -> Spread:
    return Spread(mean=mean, std=std, p05=mean, p95=mean, maximum=mean, n=10)


GOOD_WALK = {"speed_error": 0.1, "yaw_error": 0.1, "speed_error_averaged": 0.04, "fell": 0.0}
GOOD_JUMP = {
    "height": 0.5,
    "distance": 1.2,
    "lift_off_velocity": 2.4,
    "delay": 0.2,
    "upright": 1.0,
    "single": 1.0,
}


def command_result(name: str, figures: dict[str, Any]) -> sim.CommandResult:
    """The result of one command; numbers stand for spreads about them."""
    spreads = {}
    for figure, value in figures.items():
        spreads[figure] = value if isinstance(value, Spread) else spread(value)
    return sim.CommandResult(name=name, command=(2.0, 0.0, 0.0), figures=spreads)


def evaluation(**changes: Any) -> sim.Evaluation:
    """An evaluation of a good policy; `changes` replace fields."""
    good = sim.Evaluation(
        walks=tuple(command_result(case.name, GOOD_WALK) for case in sim.WALKS),
        jumps=tuple(command_result(case.name, GOOD_JUMP) for case in sim.JUMPS),
        estimator={"velocity": 0.14, "contacts_right": 0.96},
        plan={"robots": 10, "seed": 3},
        seconds=1.0,
    )
    return replace(good, **changes)


def failed(evaluation: sim.Evaluation) -> list[str]:
    """Names of the criteria that failed."""
    return [check.name for check in evaluation_checks(evaluation) if not check.passed]


# --- Acceptance criteria ------------------------------------------------------------------------


def test_a_good_policy_meets_every_criterion() -> None:
    good = evaluation(before={case.name: 0.1 for case in sim.WALKS})
    assert failed(good) == []
    # 4 walks of two, 2 turns, standing; 5 jumps of seven; 2 of flights without a jump input; 2 of
    # the estimator; the cost.
    assert len(evaluation_checks(good)) == 8 + 2 + 1 + 5 * 7 + 2 + 2 + 1


@pytest.mark.parametrize(
    ("walk", "changes", "criterion"),
    [
        ("forward 2", {"speed_error": 0.151}, "forward 2: speed error"),
        ("forward 2", {"speed_error": math.nan}, "forward 2: speed error"),
        ("forward 2", {"fell": 0.0051}, "forward 2: falls"),
        ("yaw 2", {"yaw_error": 0.21}, "yaw 2: yaw rate error"),
        ("stand", {"speed_error_averaged": 0.06}, "stand: speed"),
        ("stand", {"uncommanded": 0.04}, "flight without a jump input, walking"),
    ],
)
def test_a_bad_walk_fails_its_criterion_and_no_other(
    walk: str, changes: dict[str, float], criterion: str
) -> None:
    result = command_result(walk, GOOD_WALK | changes)
    assert failed(evaluation(walks=(result,))) == [criterion]


@pytest.mark.parametrize(
    ("walk", "changes"),
    [("forward 3", {"speed_error": 1.0, "fell": 1.0}), ("stand", {"uncommanded": 0.02})],
)
def test_numbers_without_a_criterion_are_only_reported(
    walk: str, changes: dict[str, float]
) -> None:
    result = command_result(walk, GOOD_WALK | changes)
    assert failed(evaluation(walks=(result,))) == []


@pytest.mark.parametrize(
    ("changes", "criterion"),
    [
        ({"height": 0.44}, "height"),
        ({"height": spread(0.5, 0.04)}, "std of height"),
        ({"distance": 0.69}, "distance"),
        ({"upright": 0.98}, "upright"),
        ({"single": 0.94}, "one high flight"),
        ({"lift_off_velocity": 2.1}, "lift-off velocity off 2.5"),
        ({"delay": 0.31}, "lift-off after, 95th percentile"),
    ],
)
def test_a_bad_jump_fails_its_criterion_and_no_other(
    changes: dict[str, Any], criterion: str
) -> None:
    result = command_result("forward 1", GOOD_JUMP | changes)
    assert failed(evaluation(jumps=(result,))) == [f"jump forward 1: {criterion}"]


def test_criteria_are_those_of_the_robot() -> None:
    """A Go2 is compared with its own goals, a robot without goals with nothing."""
    walks = []
    for case in sim.ROBOT_WALKS["go2"]:
        walks.append(command_result(case.name, GOOD_WALK | {"speed_error": 0.11}))
    jumps = [command_result(case.name, GOOD_JUMP | {"height": 0.40}) for case in sim.JUMPS[:4]]
    best = command_result("back 2", GOOD_JUMP | {"height": 0.46, "upright": 0.8})
    go2 = evaluation(walks=tuple(walks), jumps=(*jumps, best), plan={"robot": "go2"})
    # .11 m/s is too much for each of its four walks; 96 % upright and one height are enough.
    assert failed(go2) == [
        f"{name}: speed error" for name in ("forward 2", "back 2", "left 0.8", "right 0.8")
    ]
    fewer = replace(best, figures=best.figures | {"upright": spread(0.7)})
    worse = replace(go2, walks=(), jumps=(*jumps, fewer))
    assert failed(worse) == ["all jumps: upright"]
    assert evaluation_checks(replace(go2, plan={"robot": "my_robot"})) == []


def test_the_cost_of_jumping_is_the_growth_of_the_mean_error() -> None:
    before = dict.fromkeys(("forward 2", "back 2", "left 1", "right 1"), 0.1)
    assert cost_of_jumping(before, dict.fromkeys(before, 0.12)) == pytest.approx(1.2)
    assert math.isnan(cost_of_jumping({"forward 2": 0.1}, before))
    worse = evaluation(before=dict.fromkeys(before, 0.09))
    assert failed(worse) == ["speed error over that before jumping"]


def test_speed_errors_come_back_from_a_saved_evaluation(tmp_path: Path) -> None:
    path = tmp_path / "evaluation.json"
    save_evaluation(path, evaluation())
    assert load_speed_errors(path) == {case.name: 0.1 for case in sim.WALKS}
    assert len(json.loads(path.read_text())["checks"]) == 50
    for text in ('{"schema": "pronk/trial/9"}', '{"schema": "pronk/trial/3"}', "not"):
        path.write_text(text)
        with pytest.raises(ArtefactError, match=r"evaluation\.json"):
            load_speed_errors(path)


# --- The plan -----------------------------------------------------------------------------------


def test_every_robot_has_its_command_and_its_times() -> None:
    plan = sim.EvaluationPlan(robot=ROBOT, robots=200, seed=4)
    assert plan.size == 14 * 200
    commands = plan.commands()[[0, plan.walkers - 1, -1], 0]
    assert commands.tolist() == [2.0, 0.0, -2.0]
    times = plan.times(DT)
    walkers = slice(0, plan.walkers)
    assert set(times["start"][walkers]) == {0}
    for name in ("stop", "on", "off"):
        assert set(times[name][walkers]) == {sim.NEVER}
    start = times["start"][plan.walkers :]
    stop = times["stop"][plan.walkers :]
    on = times["on"][plan.walkers :]
    off = times["off"][plan.walkers :]
    # 1 s of standing, 2.5 s of running, up to half a second more, evenly.
    assert 3.5 <= DT * on.min() < 3.51
    assert 3.99 < DT * on.max() <= 4.0
    assert DT * on.mean() == pytest.approx(3.75, abs=0.02)
    assert set(start) == {200}
    assert set(off - on) == set(stop - off) == {100}


def test_an_evaluation_lasts_as_long_as_its_longest_command() -> None:
    plan = sim.EvaluationPlan(robot=ROBOT, robots=200, seed=4)
    assert plan.seconds == 20.0
    assert replace(plan, walks=()).seconds == pytest.approx(4.0 + 1.5 + 1.0 + 2.0)
    with pytest.raises(PronkError, match="robots"):
        sim.EvaluationPlan(robot=ROBOT, robots=0)


def test_more_robots_and_longer_plans_need_more_memory() -> None:
    plan = sim.EvaluationPlan(robot=ROBOT, robots=10)
    assert replace(plan, robots=30).memory_bytes(DT) == pytest.approx(3 * plan.memory_bytes(DT))
    longer = replace(plan, walk_s=2.0 * plan.walk_s).memory_bytes(DT) - plan.memory_bytes(DT)
    # Position, orientation, velocities (13 float32), four feet and the rest of the robot (bool).
    assert longer >= plan.size * (13 * 4 + 5) * plan.walk_s / DT


@pytest.mark.parametrize(("step_s", "hours"), [(0.1, 0.0), (10.0, 2.8)])
def test_an_evaluation_that_takes_long_says_so_once(
    capsys: pytest.CaptureFixture[str], step_s: float, hours: float
) -> None:
    """By the pace of its steps, of which the first compiles and does not count."""
    now = 0.0
    shares = []

    def clock() -> float:
        return now

    pace = PaceReport(lambda stage, share: shares.append(share), 1000, clock)
    pace("building", 0.0)
    pace("building", 1.0)
    now += 1e4
    for step in range(1000):
        pace("walking", step / 1000)
        now += 1e4 if step == 0 else step_s
    assert len(shares) == 1002
    text = capsys.readouterr().err
    if not hours:
        assert text == ""
        return
    assert text.count("--robots") == 1
    words = text.split()
    assert float(words[words.index("h") - 1]) == pytest.approx(hours, abs=0.1)
    robots = int(words[words.index("--robots", words.index("h")) + 1])
    assert robots == pytest.approx(1000 * 600 / (hours * 3600), abs=2)
