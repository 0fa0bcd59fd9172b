"""Logs with a wrong clock or unit, as files of each format: named, refused, or of no effect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.wrong_inputs import Case, judged
from log_files import write_csv, write_mcap, write_npz
from pronk.errors import LogError
from pronk.evaluation.virtual_sweep import sweep_virtual
from pronk.excitation.plan import make_plan
from pronk.logs.joint_log import JointLog
from pronk.logs.readers import read_log
from pronk.match import match_logs
from virtual_robot import ROBOT, SIM_PARAMS

JOINT = "FL_hip_roll"


def write_pace(path: Path, log: JointLog) -> None:
    torch = pytest.importorskip("torch")
    names = {"time": "time", "command": "des_dof_pos", "position": "dof_pos"}
    torch.save({name: torch.tensor(getattr(log, own)) for own, name in names.items()}, path)


WRITERS: dict[str, Callable[[Path, JointLog], None]] = {
    "a.csv": write_csv,
    "a.npz": write_npz,
    "a.mcap": write_mcap,
    "a.pt": write_pace,
}
formats = pytest.mark.parametrize("name", WRITERS)


def read(folder: Path, name: str, log: JointLog) -> JointLog:
    """The log as a file of a format gives it, with the gains of its drives."""
    WRITERS[name](folder / name, log)
    options = {"a.mcap": {}, "a.pt": {"joint_order": log.joints}}.get(name, {"unit": "rad"})
    back = read_log(folder / name, robot=ROBOT, **options)  # type: ignore[arg-type]
    return replace(back, stiffness=log.stiffness, damping=log.damping)


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> JointLog:
    out = tmp_path_factory.mktemp("sweep")
    (path,) = sweep_virtual(make_plan(ROBOT, [JOINT], repeats=(1, 1)), SIM_PARAMS, out)
    return read_log(path, robot=ROBOT)


def times(log: JointLog, factor: float, offset: float = 0.0) -> JointLog:
    segments = tuple(
        replace(one, start=factor * one.start + offset, stop=factor * one.stop + offset)
        for one in log.segments
    )
    return replace(log, time=factor * log.time + offset, segments=segments)


@formats
@pytest.mark.parametrize("factor", [1.0, 1.03])
def test_a_clock_that_runs_wrong_is_named(
    swept: JointLog, tmp_path: Path, name: str, factor: float
) -> None:
    log = read(tmp_path, name, times(swept, factor))
    found, words, _ = judged(Case(log=log, joint=JOINT, robot=ROBOT))
    assert "time" in found if factor > 1.0 else not found, words


@formats
def test_a_clock_that_begins_elsewhere_changes_nothing(
    swept: JointLog, tmp_path: Path, name: str
) -> None:
    here, there = (
        match_logs([read(tmp_path, name, times(swept, 1.0, offset))], ROBOT).gains.joints[JOINT]
        for offset in (0.0, 12_345.0)
    )
    assert there.stiffness == pytest.approx(here.stiffness, rel=1e-3)
    assert there.damping == pytest.approx(here.damping, rel=1e-3)
    assert there.delay_s == pytest.approx(here.delay_s, abs=1e-4)


@formats
@pytest.mark.parametrize("factor", [1e3, 1e6, 1e-3])
def test_a_clock_in_another_unit_is_refused(
    swept: JointLog, tmp_path: Path, name: str, factor: float
) -> None:
    with pytest.raises(LogError, match=r"probably in|no unit"):
        read(tmp_path, name, times(swept, factor))


@formats
@pytest.mark.parametrize("columns", [("command",), ("position",), ("command", "position")])
def test_degrees_are_refused(
    swept: JointLog, tmp_path: Path, name: str, columns: tuple[str, ...]
) -> None:
    """A small chirp, which in degrees stays below a turn."""
    small = {c: 0.2 * getattr(swept, c) for c in ("command", "position")}
    wrong = {c: np.rad2deg(small[c]) for c in columns}
    changed = replace(swept, velocity=None, **small | wrong)
    with pytest.raises(LogError, match="degrees"):
        match_logs([read(tmp_path, name, changed)], ROBOT)
