"""Logs with a wrong clock or unit, as files of another tool: named, refused, or of no effect."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from corrupted_logs import Case, judge
from log_files import write_npz
from pronk.deploy.bench.virtual_sweep import sweep_virtual
from pronk.errors import LogError
from pronk.identify.excitation.plan import make_plan
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_log
from pronk.identify.match.match import match
from virtual_robot import ROBOT, SIM_PARAMS

JOINT = "FL_hip_roll"


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> JointLog:
    out = tmp_path_factory.mktemp("sweep")
    (path,) = sweep_virtual(make_plan(ROBOT, [JOINT], repeats=(1, 1)), SIM_PARAMS, out)
    return read_log(path, robot=ROBOT)


def read(folder: Path, log: JointLog, factor: float = 1.0, offset: float = 0.0) -> JointLog:
    """The log on another clock as a file without segments gives it, with the drives' gains."""
    write_npz(folder / "a.npz", replace(log, time=factor * log.time + offset))
    back = read_log(folder / "a.npz", robot=ROBOT, options=ReadOptions(unit="rad"))
    return replace(back, stiffness=log.stiffness, damping=log.damping)


@pytest.mark.parametrize("factor", [1.0, 1.03])
def test_a_clock_that_runs_wrong_is_named(swept: JointLog, tmp_path: Path, factor: float) -> None:
    case = Case(log=read(tmp_path, swept, factor), joint=JOINT, robot=ROBOT)
    checks, sentences = judge(case)
    expected = {"clock"} if factor > 1.0 else set()
    assert checks == expected, sentences


def test_a_clock_that_begins_elsewhere_changes_nothing(swept: JointLog, tmp_path: Path) -> None:
    at_zero = match([read(tmp_path, swept)], ROBOT).gains.joints[JOINT]
    later = match([read(tmp_path, swept, offset=12_345.0)], ROBOT).gains.joints[JOINT]
    assert later.stiffness.value == pytest.approx(at_zero.stiffness.value, rel=1e-3)
    assert later.damping.value == pytest.approx(at_zero.damping.value, rel=1e-3)
    assert later.delay_s.value == pytest.approx(at_zero.delay_s.value, abs=1e-4)


@pytest.mark.parametrize("factor", [1e3, 1e6, 1e-3])
def test_a_clock_in_another_unit_is_refused(swept: JointLog, tmp_path: Path, factor: float) -> None:
    with pytest.raises(LogError, match=r"probably in|no unit"):
        read(tmp_path, swept, factor)


@pytest.mark.parametrize("columns", [("command",), ("position",), ("command", "position")])
def test_degrees_are_refused(swept: JointLog, tmp_path: Path, columns: tuple[str, ...]) -> None:
    """A small chirp, which in degrees stays below a turn."""
    command = 0.2 * swept.command
    position = 0.2 * swept.position
    if "command" in columns:
        command = np.rad2deg(command)
    if "position" in columns:
        position = np.rad2deg(position)
    in_degrees = replace(swept, velocity=None, command=command, position=position)
    with pytest.raises(LogError, match="degrees"):
        match([read(tmp_path, in_degrees)], ROBOT)
