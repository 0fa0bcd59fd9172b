"""How stiff a foot of the virtual Go2 may be: what is changed, and what is counted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.go2_feet import FootCase, cases_of, falls_table, go2_feet, run_case
from foreign_policy import write_foreign
from pronk.errors import PronkError
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.robots import load_robot
from pronk.robots.legged import legged

PARAMS = load_sim_params(None, load_robot("go2"))
BRIEF = {"speed": 0.0, "seconds": 2.0}


def shipped_case() -> FootCase:
    [case] = cases_of("25", "1", "2+1", None)
    return case


def test_the_default_options_leave_the_shipped_parameters_as_they_are() -> None:
    assert shipped_case().applied_to(PARAMS) == PARAMS


def test_every_combination_is_run_once() -> None:
    cases = cases_of("16,20,20", "0.97,1", "3+2,2+1", 200.0)
    assert len(set(cases)) == len(cases) == 8
    assert {case.damping for case in cases} == {200.0}
    changed = cases[0].applied_to(PARAMS)
    assert changed.ground == replace(PARAMS.ground, stiffness=16e3, damping=200.0)
    machine = changed.machine
    delays = (machine.command_delay_s, machine.measurement_delay_s)
    assert delays == pytest.approx((0.003, 0.002))
    for name, joint in changed.joints.items():
        assert joint.torque_scale == pytest.approx(0.97 * PARAMS.joints[name].torque_scale)


@pytest.mark.parametrize(
    ("stiffness", "delays"), [("25,many", "2+1"), ("-25", "2+1"), ("25", "3"), ("25", "1+2+3")]
)
def test_impossible_options_are_refused(stiffness: str, delays: str) -> None:
    with pytest.raises(PronkError, match=r"between them|as 2\+1"):
        cases_of(stiffness, "1", delays, None)


def test_the_feet_of_a_standing_robot_carry_its_weight(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    write_foreign(tmp_path)
    weight = 9.81 * (legged("go2").total_mass + PARAMS.trunk.mass_offset)
    for stiffness in (10e3, 25e3):
        case = replace(shipped_case(), stiffness=stiffness)
        row = run_case((case, 0), policy=tmp_path, **BRIEF)
        assert row["fell_s"] is None
        assert 0.25 * weight < stiffness * row["foot_depth"] < 0.6 * weight


def test_falls_are_counted_and_leave_no_speed(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    write_foreign(tmp_path, stiffness=[1.0] * 12)
    outcome = go2_feet(policy=tmp_path, stiffness="20,25", seeds=2, seconds=3.0)
    rows = outcome.figures["rows"]
    assert [(row["stiffness"], row["seed"]) for row in rows] == [
        (20e3, 0),
        (20e3, 1),
        (25e3, 0),
        (25e3, 1),
    ]
    upright = {**rows[3], "fell_s": None, "speed": 3.5, "foot_depth": 0.02}
    cases = cases_of("20,25", "1", "2+1", None)
    fallen, half = falls_table(cases, [*rows[:3], upright], "").text_rows()
    assert fallen[4:6] == ["2", "2"]
    assert half[4:] == ["2", "1", "3.50", "20.0"]
    assert "3.50" not in fallen


def test_a_missing_policy_and_a_number_of_runs_are_named(tmp_path: Path) -> None:
    with pytest.raises(PronkError, match="no such folder"):
        go2_feet(policy=tmp_path / "nothing")
    with pytest.raises(PronkError, match="--seeds 0"):
        go2_feet(policy=tmp_path, seeds=0)
