"""The rig in MuJoCo Warp: the same positions and the same cell, on Warp's CPU device."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.synthetic_log import Excitation, synthetic_log
from pronk.errors import PronkError
from pronk.excitation.signals import Chirp
from pronk.match.grid import search
from pronk.match.measured_joint import measured_joints
from pronk.match.settings import MatchSettings
from pronk.response.response import Estimator
from pronk.robots import load_robot
from pronk.simulators.mujoco import JointTestRig, MujocoSimulator, rig_on

Array = NDArray[np.float64]

ROBOT = load_robot("mini_cheetah")
STIFFNESS = np.array([13.0, 27.0, 20.0, 13.0, 27.0])
DAMPING = np.array([0.1, 0.7, 0.4, 0.7, 0.1])
"""The corners of the grid and its middle."""
ROUNDING = 2e-5
"""Single precision over a few seconds [rad]: 1.3e-5 where the knee is liveliest, 1e-6 elsewhere."""


@contextmanager
def both(joint: str, *, least: int = 1, **options: Any) -> Iterator[tuple[JointTestRig, Any]]:
    make = rig_on("warp-cpu")
    with (
        JointTestRig(ROBOT, joint, **options) as known,
        make(ROBOT, joint, least=least, **options) as warped,
    ):
        yield known, warped


def default_pose(rig: JointTestRig) -> Array:
    return np.array([ROBOT.joint(name).default_position for name in rig.chain])


def command(length_s: float, amplitude: float = 0.25) -> Array:
    ticks = amplitude / 0.25 * Chirp(length_s=length_s).samples(50.0)
    return np.repeat(np.concatenate([np.zeros(5), ticks]), 4)


def positions(rig: JointTestRig, commands: list[Array], poses: list[Array], rows: int = 5) -> Array:
    out = np.full((rows, len(commands[0])), np.nan)
    for part, position in rig.run(commands, poses, STIFFNESS[:rows], DAMPING[:rows]):
        out[part] = position
    return out


@pytest.mark.train
@pytest.mark.parametrize(
    ("joint", "frictionloss"), [("FR_knee", None), ("FR_hip_roll", None), ("FR_knee", 0.3)]
)
def test_positions_agree_within_single_precision(joint: str, frictionloss: float | None) -> None:
    pytest.importorskip("mujoco_warp")
    with both(joint, frictionloss=frictionloss) as (known, warped):
        excited = ([command(2.0)], [default_pose(known)])
        expected, got = positions(known, *excited), positions(warped, *excited)
        assert warped.count.steps == expected.size
    assert np.ptp(expected, axis=1).min() > 0.1
    # Equal would mean that both ran on the processor.
    assert 0.0 < np.abs(got - expected).max() < ROUNDING


@pytest.mark.train
def test_simulations_with_their_own_command_and_pose() -> None:
    pytest.importorskip("mujoco_warp")
    with both("FR_hip_roll") as (known, warped):
        shared = ([command(1.0)], [default_pose(known)])
        first = positions(warped, *shared)
        commands = [command(1.0, amplitude) for amplitude in (0.25, -0.2, 0.15)]
        poses = [default_pose(known) + np.array(turn) for turn in np.eye(3) * 0.1]
        expected = positions(known, commands, poses, rows=3)
        assert np.abs(positions(warped, commands, poses, rows=3) - expected).max() < ROUNDING
        # Nothing of one run is left in the next, nor of a larger one in a smaller.
        assert np.array_equal(positions(warped, *shared), first)
        assert np.array_equal(positions(warped, *shared, rows=2), first[:2])


@pytest.mark.train
def test_few_simulations_stay_in_double_precision() -> None:
    pytest.importorskip("mujoco_warp")
    with both("FR_knee", least=6) as (known, warped):
        excited = ([command(1.0)], [default_pose(known)])
        assert np.array_equal(positions(known, *excited), positions(warped, *excited))


@pytest.mark.train
@pytest.mark.parametrize("joint", ["FR_knee", "FR_hip_roll"])
def test_the_grid_finds_the_same_cell(joint: str) -> None:
    """225 nodes, a step of the paper's grid apart, the known between them."""
    pytest.importorskip("mujoco_warp")
    chirp = Excitation(offsets=Chirp(length_s=4.0).samples())
    log = synthetic_log(ROBOT, joint, [chirp], 20.6, 0.492)
    settings = MatchSettings(estimator=Estimator(segment_s=2.0))
    goal = measured_joints(log, joint, ROBOT, settings)[0]
    stiffness = 20.6 + 14.0 / 49.0 * (np.arange(15) - 6.3)
    damping = 0.492 + 0.6 / 49.0 * (np.arange(15) - 7.4)
    grids = []
    for device in ("cpu", "warp-cpu"):
        with MujocoSimulator(ROBOT, device=device) as simulator:
            grids.append(search(simulator.rig(joint), [goal], stiffness, damping)[0])
    known, warped = (np.sqrt(grid.error) for grid in grids)
    assert grids[0].cell == grids[1].cell
    assert not grids[0].at_edge
    # Far less than what sets the best node apart from the next: the cell is no luck.
    best, second = np.sort(known, axis=None)[:2]
    assert 0.0 < np.abs(known - warped).max() < 0.1 * (second - best)


@pytest.mark.train
def test_a_missing_gpu_is_refused_in_one_sentence() -> None:
    wp = pytest.importorskip("warp")
    if wp.is_cuda_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(PronkError, match="no CUDA device was found"):
        MujocoSimulator(ROBOT, device="cuda")


def test_a_missing_extra_and_an_unknown_device_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "pronk.simulators.warp", raising=False)
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(PronkError, match=r"mujoco_warp is not installed.*pronk\[train\]"):
        rig_on("cuda")
    with pytest.raises(PronkError, match="expected one of cpu, cuda, warp-cpu"):
        rig_on("tpu")
    with pytest.raises(PronkError, match="expected one of cpu, cuda, warp-cpu"):
        MatchSettings(device="tpu")
