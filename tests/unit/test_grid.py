"""The paper's search: known gains found again by the whole grid, its shortcuts, the quick way."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from pronk.identify.excitation.signals import Chirp
from pronk.identify.match.grid import (
    DIVERGED_DB,
    GridSearch,
    alike,
    axes,
    coarse_search,
    mean_square,
    quick_search,
    search,
    search_all,
)
from pronk.identify.match.measured_joint import DB, MeasuredJoint, measured_joints, merged
from pronk.identify.match.parameters import GAINS
from pronk.identify.match.response_fit import refine
from pronk.identify.match.settings import MatchSettings
from pronk.identify.match.simulated import SimRequest, responses
from pronk.identify.response.response import Estimator
from pronk.identify.simulators.linear import linearize
from pronk.identify.simulators.mujoco import MujocoSimulator
from pronk.report.paper import TABLE_I
from pronk.robots import load_robot
from synthetic_log import Excitation, synthetic_log

ROBOT = load_robot("mini_cheetah")


def known(
    joint: str,
    gains: tuple[float, float] | None = None,
    *,
    segment_s: float = 8.0,
    length_s: float = 8.0,
    stop_hz: float = 25.0,
    **options: Any,
) -> MeasuredJoint:
    """A joint of the simulator with known gains (those of Table I), logged without noise."""
    chirp = Excitation(offsets=Chirp(length_s=length_s, stop_hz=stop_hz).samples())
    log = synthetic_log(ROBOT, joint, [chirp], *(gains or TABLE_I[joint]), **options)
    settings = MatchSettings(estimator=Estimator(segment_s=segment_s))
    return measured_joints(log, joint, ROBOT, settings)[0]


def nearest(grid: GridSearch, gains: tuple[float, float]) -> tuple[int, int]:
    i, j = (
        np.abs(getattr(grid, name) - gain).argmin() for name, gain in zip(GAINS, gains, strict=True)
    )
    return int(i), int(j)


# --- the grid -----------------------------------------------------------------------------------


def test_table_1_is_found_again_by_every_joint() -> None:
    """12 of 12: the paper's gains as known gains."""
    goals = [known(joint.name, length_s=20.0) for joint in ROBOT.joints]
    with MujocoSimulator(ROBOT) as simulator:
        grids, fits = quick_search(simulator, goals, *axes(ROBOT))
    for goal, grid, fit in zip(goals, grids, fits, strict=True):
        assert grid.cell == nearest(grid, TABLE_I[goal.joint]), goal.joint
        assert fit.gains == pytest.approx(TABLE_I[goal.joint], rel=0.005)
        assert (grid.at_edge, fit.solution.settled) == (False, True)


def test_the_whole_paper_grid_lands_on_the_nearest_cell() -> None:
    """All 2,500 pairs simulated, two mirror-image knees at once (a short chirp to 18 Hz)."""
    short = {"length_s": 4.0, "stop_hz": 18.0, "segment_s": 2.0}
    goals = [known(joint, **short) for joint in ("FR_knee", "HL_knee")]
    assert len(alike(goals, ROBOT)) == 1
    with MujocoSimulator(ROBOT) as simulator:
        found = search(simulator, goals, *axes(ROBOT))
        assert simulator.steps == 2500 * max(goal.steps for goal in goals)
    for goal, one in zip(goals, found, strict=True):
        assert one.error.shape == (50, 50)
        assert one.cell == nearest(one, TABLE_I[goal.joint])
        # Far off the error is large: the map has one valley.
        assert one.error_db < 0.1 < 1.0 < np.sqrt(one.error[0, 0])


def test_rolls_moved_to_the_same_side_share_most_of_a_simulation() -> None:
    """Left rolls are read off the right one's simulation; what could be best is simulated anew."""
    goals = [known(joint) for joint in ("FR_hip_roll", "FL_hip_roll", "FR_knee")]
    grid = axes(ROBOT, 12)
    shares: list[float] = []
    with MujocoSimulator(ROBOT) as simulator:
        found = search_all(simulator, goals, *grid, progress=shares.append)
        steps = simulator.steps
        whole = [search(simulator, [goal], *grid)[0] for goal in goals]
    for fast, slow in zip(found, whole, strict=True):
        assert fast.cell == slow.cell
        assert fast.error_db == pytest.approx(slow.error_db, rel=1e-9)
        np.testing.assert_allclose(np.sqrt(fast.error), np.sqrt(slow.error), atol=0.05)
    assert steps < 1.2 * 144 * (goals[0].steps + goals[2].steps)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)


def test_the_error_is_the_mean_square_in_decibels() -> None:
    goal = known("FR_hip_pitch")
    measured = goal.measured.response[goal.fit_mask]
    assert mean_square(goal.error_db(measured * 10 ** (0.5 / 20))) == pytest.approx(0.25)
    # Phase is disregarded (F9).
    turned = measured * np.exp(-1j * goal.omega * 0.01)
    assert mean_square(goal.error_db(turned)) == pytest.approx(0.0, abs=1e-20)
    for broken in (0.0, np.nan):
        assert mean_square(goal.error_db(broken * measured)) == pytest.approx(DIVERGED_DB**2)


# --- measured responses and simulated ones ------------------------------------------------------


def test_repeats_in_several_logs_are_put_together() -> None:
    goal = known("FR_knee")
    louder = 1.2 * goal.measured.repeats
    twice = replace(goal.measured, response=louder[0], repeats=np.repeat(louder, 2, axis=0))
    (both,) = merged([[goal], [replace(goal, measured=twice)]])
    assert len(both.measured.repeats) == 3
    expected = goal.measured.response * (1.0 + 2 * 1.2) / 3
    np.testing.assert_allclose(both.measured.response, expected)


def test_full_and_banded_responses_agree_and_the_horizon_changes_no_gain() -> None:
    """Steps without effect on the band are left out: 0.003 dB at most."""
    goal = known("FL_hip_roll", length_s=20.0)
    assert goal.steps < 0.9 * len(goal.trace.command)
    requests = [SimRequest(goal, *g) for g in (TABLE_I["FL_hip_roll"], (13.0, 0.1), (27.0, 0.7))]
    with MujocoSimulator(ROBOT) as simulator:
        whole, cut = (responses(simulator, requests, whole=all_) for all_ in (True, False))
    np.testing.assert_allclose(whole[0], goal.measured.response, rtol=1e-6)
    for one, other in zip(whole, cut, strict=True):
        assert np.abs(DB * np.log(np.abs(other / one[goal.fit_mask]))).max() < 0.003


# --- the linearized simulator -------------------------------------------------------------------


def test_at_a_fine_step_the_closed_form_is_the_second_order_joint() -> None:
    """`stiffness / (I s^2 + (damping + b) s + stiffness + gravity)` (paper M2, reading A9)."""
    omega = 2 * np.pi * np.array([0.5, 2.0, 5.0, 10.0, 20.0])
    with MujocoSimulator(replace(ROBOT, timestep_s=1e-5, decimation=2000)) as simulator:
        rig = simulator.rig("FR_knee")
        found = linearize(rig, np.array([1.6]), omega).response(17.0, 0.4)[0]
        data, bias, inertia = mujoco.MjData(rig.model), [], np.zeros(1)
        for angle in (1.6 - 1e-4, 1.6 + 1e-4):
            data.qpos[:] = angle
            mujoco.mj_forward(rig.model, data)
            bias.append(data.qfrc_bias[0])
        mujoco.mj_mulM(rig.model, data, inertia, np.ones(1))
    viscous = ROBOT.joint("FR_knee").drive.viscous_damping
    gravity, s = (bias[1] - bias[0]) / 2e-4, 1j * omega
    expected = 17.0 / (inertia * s**2 + (0.4 + viscous) * s + 17.0 + gravity)
    np.testing.assert_allclose(found, expected, rtol=2e-3)


def test_shorter_searches_find_what_simulating_everything_finds() -> None:
    """Same node of the grid, and the refined gains within 0.1 %, off the nodes and off the model.

    The measured joints have twice the simulator's dry friction, so no gains fit exactly and the
    optimum is one of a misfit.
    """
    goals = [known(f"FL_{group}", frictionloss=0.4) for group in ("hip_pitch", "knee")]
    grid = axes(ROBOT, 20)
    with MujocoSimulator(ROBOT) as simulator:
        grids, quick = quick_search(simulator, goals, *grid)
        whole, coarse = (
            [method(simulator, [goal], *grid)[0] for goal in goals]
            for method in (search, coarse_search)
        )
        fits = refine(simulator, goals, [one.gains for one in whole])
    for cells, fast, rough, slow, fit in zip(grids, quick, coarse, whole, fits, strict=True):
        assert cells.cell == rough.cell == slow.cell
        looked = np.isfinite(rough.error)
        assert looked.mean() < 0.35
        np.testing.assert_allclose(rough.error[looked], slow.error[looked], rtol=1e-12)
        assert cells.error_db == pytest.approx(slow.error_db, rel=1e-6)
        assert fit.error_db > 0.02
        assert fast.gains == pytest.approx(fit.gains, rel=1e-3)
        # The corrected map is that of the simulator around the optimum.
        near = tuple(slice(max(k - 2, 0), k + 3) for k in slow.cell)
        np.testing.assert_allclose(np.sqrt(cells.error[near]), np.sqrt(slow.error[near]), atol=0.03)
