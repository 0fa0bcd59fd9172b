"""Remarks of a match: held joints that move along where an interval is wide."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pronk.deploy.bench.virtual_sweep import sweep_virtual
from pronk.identify.excitation.plan import make_plan
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.readers import read_logs
from pronk.identify.match.match import match
from pronk.identify.match.notes import moving_shares, wide_interval_note
from pronk.identify.match.result import JointResult
from virtual_robot import ROBOT, SIM_PARAMS

EXCITED = "FL_hip_pitch"
HELD = "FL_knee"
SHARE = 0.1
"""Travel of the held joint over that of the excited one."""


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> JointLog:
    plan = make_plan(ROBOT, [EXCITED], repeats=(1, 1))
    (path,) = sweep_virtual(plan, SIM_PARAMS, tmp_path_factory.mktemp("sweep"))
    (log,) = read_logs([path], robot=ROBOT)
    return log


@pytest.fixture(scope="module")
def moving_log(log: JointLog) -> JointLog:
    """The log in which the held joint moves with the excited one."""
    position = log.position.copy()
    excited = position[:, log.column(EXCITED)]
    position[:, log.column(HELD)] = SHARE * (excited - excited[0])
    return replace(log, position=position)


def with_half_width(result: JointResult, share: float) -> JointResult:
    """Return a result with another interval of the stiffness."""
    value = result.gains.stiffness.value
    interval = ((1.0 - share) * value, (1.0 + share) * value)
    stiffness = replace(result.gains.stiffness, total95=interval)
    return replace(result, gains=replace(result.gains, stiffness=stiffness))


def test_the_share_is_that_of_the_motion(moving_log: JointLog) -> None:
    shares = moving_shares([moving_log], EXCITED, ROBOT)
    assert shares[HELD] == pytest.approx(SHARE)


def test_a_joint_that_is_told_to_move_is_not_held(moving_log: JointLog) -> None:
    command = moving_log.command.copy()
    column = moving_log.column(HELD)
    command[:, column] = moving_log.position[:, column]
    shares = moving_shares([replace(moving_log, command=command)], EXCITED, ROBOT)
    assert HELD not in shares


def test_joints_that_move_along_are_named_where_the_interval_is_wide(
    log: JointLog, moving_log: JointLog
) -> None:
    result = match([log], ROBOT).joints[EXCITED]
    assert wide_interval_note([log], result, ROBOT) == ""
    wide_result = with_half_width(result, 0.5)
    note = wide_interval_note([moving_log], wide_result, ROBOT)
    assert HELD in note
    assert "50 %" in note
    assert "--drive-gains" in note
    assert wide_interval_note([moving_log], with_half_width(result, 0.1), ROBOT) == ""
    # Without a moving neighbour no cause is named.
    position = log.position.copy()
    held_columns = [log.column(name) for name in log.joints if name != EXCITED]
    position[:, held_columns] = 0.0
    still_log = replace(log, position=position)
    assert wide_interval_note([still_log], wide_result, ROBOT) == ""
