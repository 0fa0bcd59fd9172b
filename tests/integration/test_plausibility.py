"""Wrong inputs are named: every corruption of one log of the virtual robot, and none of the log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.wrong_inputs import CORRUPTIONS, SETTINGS, Case, bare, judged
from pronk.deploy.bench.virtual_sweep import sweep_virtual
from pronk.identify.excitation.plan import make_plan
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.readers import read_logs
from pronk.identify.match.pipeline import match_logs
from pronk.identify.match.plausibility import CAUSES, findings, require_plausible
from pronk.jump.virtual.sim_params import SimParams
from pronk.robots import load_robot
from tests.virtual_robot import ROBOT, SIM_PARAMS

JOINT = "FL_hip_roll"
SO101 = Path(__file__).resolve().parents[3] / "shared" / "data" / "so101"


def sweep(params: SimParams, out: Path) -> Case:
    plan = make_plan(ROBOT, [JOINT], repeats=(2, 1))
    (path,) = sweep_virtual(plan, params, out)
    return Case(log=read_logs([path], robot=ROBOT)[0], joint=JOINT, robot=ROBOT)


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return sweep(SIM_PARAMS, tmp_path_factory.mktemp("sweep"))


@pytest.mark.parametrize("name", [name for name, (change, _) in CORRUPTIONS.items() if change])
@pytest.mark.parametrize("seed", [0, 1])
def test_named_or_refused(case: Case, name: str, seed: int) -> None:
    change, causes = CORRUPTIONS[name]
    assert change is not None
    wrong = change(case, np.random.default_rng(seed))
    found, words, _ = judged(wrong)
    assert found == {"refused"} or found & causes, words


@pytest.mark.parametrize("kind", ["sweep", "bare"])
def test_right_inputs_pass(case: Case, kind: str) -> None:
    right = case if kind == "sweep" else replace(case, log=bare(case.log))
    found, _, unchecked = judged(right)
    assert found == set()
    hidden = {"drive gains", "other leg", "command delay"} if kind == "bare" else set()
    assert {CAUSES[cause][0] for cause in hidden} == set(unchecked)


@pytest.mark.parametrize("name", ["encoder scale 1.05", "position filtered"])
def test_position_and_command_alone_show_a_wrong_position(case: Case, name: str) -> None:
    test_named_or_refused(replace(case, log=bare(case.log)), name, 0)


def bare_log(case: Case, **columns: np.ndarray) -> JointLog:
    return replace(bare(case.log), **columns)


def test_a_command_column_later_than_the_joint_is_named(case: Case) -> None:
    late = round(0.02 * case.log.rate_hz)
    command = np.concatenate([np.repeat(case.log.command[:1], late, 0), case.log.command[:-late]])
    assert judged(replace(case, log=bare_log(case, command=command)))[0] == {"command delay"}


def test_stated_gains_change_no_matched_gains(case: Case) -> None:
    log = bare_log(case)
    assert log.stiffness is not None
    logs = log, replace(log, stiffness=1.25 * log.stiffness)
    right, wrong = (match_logs([one], ROBOT, settings=SETTINGS).joints[JOINT] for one in logs)
    assert wrong.stiffness == pytest.approx(right.stiffness, rel=0.01)
    assert wrong.damping == pytest.approx(right.damping, rel=0.01)


def test_a_position_without_counts_of_an_encoder_passes(case: Case) -> None:
    noise = 1e-6 * np.random.default_rng(0).standard_normal(case.log.position.shape)
    log = bare_log(case, position=case.log.position + noise)
    assert judged(replace(case, log=log))[0] == set()


@pytest.mark.parametrize("factor", [3.0, 1.0 / 3.0])
def test_wrong_friction_is_named(tmp_path: Path, factor: float) -> None:
    own = SIM_PARAMS.joints[JOINT]
    coulomb = factor * ROBOT.joint(JOINT).drive.frictionloss
    changed = replace(own, coulomb=coulomb, breakaway=1.3 * coulomb)
    params = replace(SIM_PARAMS, joints={**SIM_PARAMS.joints, JOINT: changed})
    assert judged(sweep(params, tmp_path))[0] == {"friction"}


@pytest.mark.skipif(not SO101.is_dir(), reason="the recordings of the SO-101 are not here")
def test_recordings_of_an_arm_pass() -> None:
    robot = load_robot("so101")
    for log in read_logs(sorted(path for path in SO101.glob("*") if path.is_dir()), robot=robot):
        moving = np.ptp(log.command, axis=0) > 1e-3
        for name, moves in zip(log.joints, moving, strict=True):
            if moves and log.unit(name) == "rad":
                require_plausible({name: [log]}, robot)
                assert findings([log], name, robot)[0] == [], (log.source, name)
