"""Wrong recordings are refused or flagged, right ones pass, and a misfit is told in plain words."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from corrupted_logs import CORRUPTIONS, REFUSED, Case, judge, without_extra_columns
from pronk.deploy.bench.virtual_sweep import sweep_virtual
from pronk.identify.excitation.plan import make_plan
from pronk.identify.logs.readers import read_logs
from pronk.identify.match.checks import check_excitations, check_response, slow_response
from pronk.identify.response.estimate import estimate_response
from pronk.robots import load_robot
from virtual_robot import ROBOT, SIM_PARAMS

JOINT = "FL_hip_roll"
SO101 = Path(__file__).resolve().parents[3] / "shared" / "data" / "so101"


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    plan = make_plan(ROBOT, [JOINT], repeats=(2, 1))
    (path,) = sweep_virtual(plan, SIM_PARAMS, tmp_path_factory.mktemp("sweep"))
    return Case(log=read_logs([path], robot=ROBOT)[0], joint=JOINT, robot=ROBOT)


@pytest.fixture(scope="module")
def bare_case(case: Case) -> Case:
    return replace(case, log=without_extra_columns(case.log))


@pytest.mark.parametrize("name", CORRUPTIONS)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_wrong_recordings_are_refused_or_flagged(case: Case, name: str, seed: int) -> None:
    corruption = CORRUPTIONS[name]
    checks, sentences = judge(corruption.change(case, np.random.default_rng(seed)))
    assert corruption.check in checks, sentences


@pytest.mark.parametrize(
    "name", [name for name, corruption in CORRUPTIONS.items() if corruption.in_bare_logs]
)
def test_time_command_and_position_suffice(bare_case: Case, name: str) -> None:
    corruption = CORRUPTIONS[name]
    checks, sentences = judge(corruption.change(bare_case, np.random.default_rng(0)))
    assert corruption.check in checks, sentences


def test_right_recordings_pass(case: Case, bare_case: Case) -> None:
    assert judge(case) == (set(), "")
    assert judge(bare_case) == (set(), "")


def test_every_sentence_states_what_was_seen_and_the_way_out(case: Case) -> None:
    for corruption in CORRUPTIONS.values():
        checks, sentences = judge(corruption.change(case, np.random.default_rng(0)))
        assert ";" in sentences or ":" in sentences
        if checks == {REFUSED}:
            assert JOINT in sentences or "log" in sentences


def test_another_joint_that_moves_is_refused(case: Case) -> None:
    columns = [case.log.column(JOINT), case.log.column("FL_knee")]
    position = case.log.position.copy()
    position[:, columns] = position[:, columns[::-1]]
    origin = replace(case.log.origin, metadata={})
    log = replace(case.log, position=position, origin=origin)
    checks, sentence = judge(replace(case, log=log))
    assert checks == {REFUSED}
    assert "FL_knee" in sentence or "did not move" in sentence


def test_the_slow_response_of_a_joint_is_near_one(case: Case) -> None:
    for recording in case.log.excitations(JOINT):
        assert abs(slow_response(recording, ROBOT.joint(JOINT)) - 1.0) < 0.3


@pytest.mark.parametrize(("low_hz", "high_hz"), [(0.0, 3.0), (7.0, 30.0)])
def test_a_misfit_is_said_where_it_is_and_no_cause_is_chosen(
    case: Case, low_hz: float, high_hz: float
) -> None:
    measured = estimate_response(case.log, JOINT)[0]
    used = measured.band(*ROBOT.joint(JOINT).band_hz)
    assert check_response(measured, measured.response, used, 1.0) == ()
    hz = measured.frequency_hz
    simulated = measured.response * np.where((hz >= low_hz) & (hz <= high_hz), 1.5, 1.0)
    (flag,) = check_response(measured, simulated, used, 1.0)
    assert flag.startswith("no match")
    assert "moves less than the simulated one" in flag
    for cause in ("friction", "compliance", "scale", "filter", "payload"):
        assert cause in flag
    (flag,) = check_response(measured, simulated, used, 1.0, cause_is_named=True)
    assert "compliance" not in flag


@pytest.mark.skipif(not SO101.is_dir(), reason="the recordings of the SO-101 are not here")
def test_excitations_of_an_arm_pass() -> None:
    robot = load_robot("so101")
    folders = sorted(path for path in SO101.glob("*") if path.is_dir())
    for log in read_logs(folders, robot=robot):
        for joint in log.excited_joints:
            assert check_excitations(log.excitations(joint), robot) == (), (log.source, joint)


def test_an_encoder_that_is_reset_is_not_taken_for_a_torque_limit(bare_case: Case) -> None:
    position = bare_case.log.position.copy()
    middle = bare_case.log.segments[0].start + 8.0
    position[bare_case.log.time > middle, bare_case.log.column(JOINT)] += 0.8
    excitations = replace(bare_case.log, position=position).excitations(JOINT)
    flags = check_excitations(excitations, ROBOT)
    assert any(flag.startswith("position column") for flag in flags)
    assert not any(flag.startswith("effort limit") for flag in flags[:1])
