"""The rig in MuJoCo Warp: the same positions and the same cell, on Warp's CPU device."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from benchmarks.synthetic_log import Excitation, synthetic_log
from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.excitation.signals import Chirp
from pronk.identify.match.grid import search
from pronk.identify.match.measured_joint import measured_joints
from pronk.identify.match.settings import MatchSettings
from pronk.identify.response.response import Estimator
from pronk.identify.simulators.command_trace import CommandTrace
from pronk.identify.simulators.mujoco import JointTestRig, MujocoSimulator, rig_on
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
STIFFNESS = np.array([13.0, 27.0, 20.0, 13.0, 27.0])
DAMPING = np.array([0.1, 0.7, 0.4, 0.7, 0.1])
"""The corners of the grid and its middle."""
ROUNDING = 2e-5
"""Single precision over a few seconds [rad]: 1.3e-5 where the knee is liveliest, 1e-6 elsewhere."""


@contextmanager
def both(joint: str, *, least: int = 1) -> Iterator[tuple[JointTestRig, JointTestRig]]:
    pytest.importorskip("mujoco_warp")
    make = rig_on("warp-cpu")
    with JointTestRig(ROBOT, joint) as known, make(ROBOT, joint, least=least) as warped:
        yield known, warped


def trace(joint: str, length_s: float, amplitude: float = 0.25, turn: int = 0) -> CommandTrace:
    """A chirp of a joint; a joint (counted from 1) stands 0.1 rad off its default position."""
    ticks = amplitude / 0.25 * Chirp(length_s=length_s).samples(50.0)
    pose = np.array([one.default_position for one in ROBOT.joints])
    pose[turn - 1] += 0.1 * (turn > 0)
    command = pose[ROBOT.joint_names.index(joint)] + np.repeat(np.pad(ticks, (5, 0)), 4)
    return CommandTrace(joint=joint, start=0.0, timestep=0.005, command=command, pose=pose)


def positions(rig: JointTestRig, traces: list[CommandTrace], rows: int = 5) -> Array:
    steps = len(traces[0].command)
    out = np.full((rows, steps), np.nan)
    values = {"stiffness": STIFFNESS[:rows], "damping": DAMPING[:rows]}
    for part, position in rig.run(traces, values, steps):
        out[part] = position
    return out


@pytest.mark.train
@pytest.mark.parametrize("joint", ["FR_knee", "FR_hip_roll"])
def test_positions_agree_within_single_precision(joint: str) -> None:
    shared = [trace(joint, 2.0)]
    own = [trace(joint, 1.0, size, turn) for turn, size in ((1, 0.25), (2, -0.2), (3, 0.15))]
    with both(joint) as (known, warped):
        expected, got = positions(known, shared), positions(warped, shared)
        assert warped.steps == expected.size
        assert np.ptp(expected, axis=1).min() > 0.1
        # Equal would mean that both ran on the processor.
        assert 0.0 < np.abs(got - expected).max() < ROUNDING
        apart = positions(warped, own, rows=3) - positions(known, own, rows=3)
        assert np.abs(apart).max() < ROUNDING
        # Nothing of one run is left in the next, nor of a larger one in a smaller.
        assert np.array_equal(positions(warped, shared), got)
        assert np.array_equal(positions(warped, shared, rows=2), got[:2])


@pytest.mark.train
def test_few_simulations_stay_in_double_precision() -> None:
    with both("FR_knee", least=6) as (known, warped):
        excited = [trace("FR_knee", 1.0)]
        assert np.array_equal(positions(known, excited), positions(warped, excited))


@pytest.mark.train
def test_the_grid_finds_the_same_cell() -> None:
    """225 nodes, a step of the paper's grid apart, the known between them."""
    pytest.importorskip("mujoco_warp")
    chirp, joint = Excitation(offsets=Chirp(length_s=4.0).samples()), "FR_hip_roll"
    log = synthetic_log(ROBOT, joint, [chirp], 20.6, 0.492)
    settings = MatchSettings(estimator=Estimator(segment_s=2.0))
    goal = measured_joints(log, joint, ROBOT, settings)[0]
    stiffness = 20.6 + 14.0 / 49.0 * (np.arange(15) - 6.3)
    damping = 0.492 + 0.6 / 49.0 * (np.arange(15) - 7.4)
    grids = []
    for device in ("cpu", "warp-cpu"):
        with MujocoSimulator(ROBOT, device=device) as simulator:
            grids.append(search(simulator, [goal], stiffness, damping)[0])
    known, warped = (np.sqrt(grid.error) for grid in grids)
    assert grids[0].cell == grids[1].cell
    assert not grids[0].at_edge
    # Far less than what sets the best node apart from the next: the cell is no luck.
    best, second = np.sort(known, axis=None)[:2]
    assert 0.0 < np.abs(known - warped).max() < 0.1 * (second - best)


@pytest.mark.train
def test_a_missing_gpu_is_refused() -> None:
    wp = pytest.importorskip("warp")
    if not wp.is_cuda_available():
        with pytest.raises(PronkError, match="CUDA"):
            MujocoSimulator(ROBOT, device="cuda")


def test_a_missing_extra_and_an_unknown_device_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "pronk.identify.simulators.warp", raising=False)
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(PronkError, match=r"pronk\[train\]"):
        rig_on("cuda")
    with pytest.raises(PronkError, match="warp-cpu"):
        MatchSettings(device="tpu")
