"""Moments of the stride, by hand and on the virtual robot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pronk.evaluation.metrics import JumpFigures
from pronk.evaluation.run import Plan, jobs_of
from pronk.evaluation.subjects import load_subjects
from pronk.robots import load_robot
from pronk.virtual.sim_params import SHIPPED, load_sim_params
from tools_folder import FOLDER, load_tool

pytest.importorskip("onnxruntime")
POLICY = FOLDER.parent / "policies" / "matched" / "policy.onnx"


@pytest.fixture
def tool() -> Any:
    return load_tool("jump_moments")


def test_steps_since_the_change_by_hand(tool: Any) -> None:
    position = np.zeros((9, 12))
    position[:, 2] = [0.1, -0.1, -0.2, 0.1, 0.2, -0.1, 0.0, 0.3, 0.1]
    assert [tool.since_change(position, step) for step in range(9)] == [
        None,
        None,
        None,
        0,
        1,
        2,
        0,
        1,
        2,
    ]


def test_a_table_by_hand(tool: Any) -> None:
    well = JumpFigures(told=True, found=True, upright=True, height=0.4, distance=0.6)
    fell = JumpFigures(told=True, found=True, fell=True, touched=True, height=0.5, distance=0.8)
    assert tool.table([(2, well), (None, well), (2, fell)]) == [
        "no stride   1    1  0.400 +- 0.000 m  0.60 +- 0.00 m",
        "        2   2    1  0.450 +- 0.050 m  0.70 +- 0.10 m",
    ]


def test_jumps_are_told_at_once_whatever_the_contract_says(tool: Any) -> None:
    robot, plan = load_robot("mini_cheetah"), Plan(jumps=2)
    subjects = load_subjects([POLICY], robot)
    planned = jobs_of(subjects, plan, robot=robot, sim_params=load_sim_params(SHIPPED), out=Path())
    found = [tool.told_at_once(replace(job, keep=None)) for _, job in planned[:2]]
    assert all(figures.found for _, figures in found)
    # A stride takes ten steps; what is met is drawn, and not the moment that a policy waits for.
    assert all(0 <= since < 12 for since, _ in found)
    assert any(since > 0 for since, _ in found)
