"""How far jumps get by offsets to a policy's targets: what is added, and from where it goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.reach import (
    END_S,
    KNOTS_S,
    Approach,
    OffsetLayout,
    cost,
    offset_table,
    reach,
    search_offsets,
)
from pronk.errors import PronkError
from pronk.jump.trial.jumps import FlightFigures, JumpFigures
from pronk.jump.trial.protocol import named
from pronk.jump.trial.trial import (
    TrialJob,
    TrialPlan,
    load_subjects,
    plan_jobs,
    run_job,
    setup_of,
)
from pronk.robots import load_robot

POLICY = Path(__file__).parents[2] / "policies/matched/policy.onnx"
ROBOT = load_robot("mini_cheetah")
SIZE = 6 * len(KNOTS_S)


@pytest.fixture(scope="module")
def job() -> TrialJob:
    """The first jump forwards of a trial with the shipped policy."""
    pytest.importorskip("onnxruntime")
    setup = setup_of(POLICY, Path(), processes=1)
    plan = TrialPlan(cases=named("forward 2"), jumps=1, rates=0, seed=0)
    [job] = plan_jobs(load_subjects([POLICY], setup.robot), plan, setup)
    return job


def test_offsets_are_those_of_the_knots_and_alike_on_both_sides() -> None:
    values = np.random.default_rng(0).normal(0.0, 0.3, SIZE)
    at_knots = values.reshape(2, 3, len(KNOTS_S))
    rate_hz = 100.0  # a step at every knot
    offsets = offset_table(values, OffsetLayout.of(ROBOT), rate_hz)
    assert offsets.shape == (round(END_S * rate_hz), 12)
    steps = [round(time * rate_hz) for time in KNOTS_S]
    for k, joint in enumerate(ROBOT.joints):
        part = 0 if joint.name.startswith("F") else 1
        kind = ("hip_roll", "hip_pitch", "knee").index(joint.name.split("_", 1)[1])
        turns_other_way = kind == 0 and joint.name[1] == "L"
        expected = -at_knots[part, kind] if turns_other_way else at_knots[part, kind]
        np.testing.assert_allclose(offsets[steps, k], expected, atol=1e-9)
    # After the last knot they go down to nothing.
    last = np.abs(offsets[steps[-1] :])
    assert np.all(np.diff(last, axis=0) <= 0.0)


def test_front_and_left_of_another_robot_follow_from_its_hips() -> None:
    robot = load_robot("go2")
    layout = OffsetLayout.of(robot)
    for name, row, sign in zip(robot.joint_names, layout.rows, layout.signs, strict=True):
        kind = ("hip_roll", "hip_pitch", "knee").index(name.split("_", 1)[1])
        assert row == kind + (0 if name.startswith("F") else 3)
        assert sign == (-1.0 if kind == 0 and name[1] == "L" else 1.0)


def test_without_offsets_the_jump_is_that_of_a_trial(job: TrialJob) -> None:
    jump = Approach.of(job).jump(np.zeros(SIZE))
    assert jump == run_job(job).figures


def test_offsets_have_an_effect_from_the_jump_command_on(job: TrialJob) -> None:
    values = np.full(SIZE, 0.05)
    approach = Approach.of(job)
    changed = approach.jump(values, watched_s=0.6)
    capture = approach.machine.capture()
    plain = Approach.of(job)
    unchanged = plain.jump(np.zeros(SIZE), watched_s=0.6)
    same = plain.machine.capture()
    differs = np.any(capture.position != same.position, axis=1)
    first = float(capture.time[np.argmax(differs)]) - approach.began
    on = job.row.script.on
    assert on <= first <= on + 0.02
    assert changed.flight.distance != unchanged.flight.distance


def test_a_touch_and_a_fall_cost_length() -> None:
    flight = FlightFigures(along=0.8)
    clean = JumpFigures(standing=True, found=True, flight=flight)
    touched = JumpFigures(standing=True, found=True, flight=flight, non_foot_contact=True)
    fell = JumpFigures(standing=True, found=True, flight=flight, fell=True)
    zero = np.zeros(SIZE)
    assert cost(clean, zero) == pytest.approx(-0.8)
    assert cost(clean, zero) < cost(touched, zero) < cost(fell, zero)
    assert cost(JumpFigures(standing=True), zero) == 0.0


def test_a_search_makes_a_jump_longer(job: TrialJob) -> None:
    pytest.importorskip("cma")
    values = search_offsets(Approach.of(job), evaluations=100, seed=0, jobs=2)
    longer = Approach.of(job).jump(values, watched_s=0.8)
    plain = Approach.of(job).jump(np.zeros(SIZE), watched_s=0.8)
    assert longer.flight.along > plain.flight.along + 0.02


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"evaluations": 3}, "expected"),
        ({"jumps": 0}, "expected"),
        ({"jobs": 0}, "expected"),
        ({"seed": -1}, "expected"),
        ({"command": "0,0,1"}, "2,0"),
        ({"command": "forward 2"}, "1,0,0"),
        ({"out": Path(__file__) / "figures.json"}, "not a folder"),
    ],
)
def test_impossible_options_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(PronkError, match=words):
        reach(POLICY, **options)
