"""The paper's grid search on logs with known gains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.synthetic_log import Excitation, synthetic_log
from pronk.excitation.signals import Chirp
from pronk.match.grid import (
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
from pronk.match.measured_joint import MeasuredJoint, SimRequest, measured_joints, merged, responses
from pronk.match.settings import MatchSettings
from pronk.response.response import Estimator
from pronk.robots import load_robot
from pronk.simulators.mujoco import MujocoSimulator

ROBOT = load_robot("mini_cheetah")
SETTINGS = MatchSettings()

TABLE_1 = {
    "hip_roll": ((20.6, 0.492), (18.1, 0.516), (18.5, 0.431), (21.0, 0.490)),
    "hip_pitch": ((16.5, 0.382), (17.7, 0.406), (16.9, 0.382), (18.9, 0.431)),
    "knee": ((21.8, 0.541), (22.0, 0.523), (22.2, 0.553), (21.8, 0.553)),
}
"""The paper's Table I, legs FR FL HR HL."""


def gains_of(joint: str) -> tuple[float, float]:
    leg, _, group = joint.partition("_")
    return TABLE_1[group][("FR", "FL", "HR", "HL").index(leg)]


def known(
    joint: str, *, length_s: float = 20.0, settings: MatchSettings = SETTINGS
) -> MeasuredJoint:
    chirp = Excitation(offsets=Chirp(length_s=length_s).samples())
    return measured_joints(
        synthetic_log(ROBOT, joint, [chirp], *gains_of(joint)), joint, ROBOT, settings
    )[0]


def nearest(grid: GridSearch, gains: tuple[float, float]) -> tuple[int, int]:
    return (
        int(np.argmin(np.abs(grid.stiffness - gains[0]))),
        int(np.argmin(np.abs(grid.damping - gains[1]))),
    )


def test_table_1_is_found_again_by_every_joint() -> None:
    """12 of 12: the paper's gains as known gains, a log without noise ."""
    goals = [known(joint.name) for joint in ROBOT.joints]
    with MujocoSimulator(ROBOT) as simulator:
        found = quick_search(simulator, goals, *axes(ROBOT))
    for goal, one in zip(goals, found, strict=True):
        stiffness, damping = gains_of(goal.joint)
        assert one.grid.cell == nearest(one.grid, (stiffness, damping)), goal.joint
        assert one.fit.stiffness == pytest.approx(stiffness, rel=0.005)
        assert one.fit.damping == pytest.approx(damping, rel=0.01)
        assert one.fit.solution.settled
        assert not one.grid.at_edge


def test_the_whole_paper_grid_lands_on_the_nearest_cell() -> None:
    """All 2,500 pairs simulated, two mirror-image knees at once (a short chirp to 18 Hz)."""
    quick = MatchSettings(estimator=Estimator(segment_s=2.0))
    chirp = Excitation(offsets=Chirp(length_s=4.0, stop_hz=18.0).samples(), settle_s=0.2)
    goals = [
        measured_joints(
            synthetic_log(ROBOT, joint, [chirp], *gains_of(joint)), joint, ROBOT, quick
        )[0]
        for joint in ("FR_knee", "HL_knee")
    ]
    assert len(alike(goals, ROBOT)) == 1
    with MujocoSimulator(ROBOT) as simulator:
        found = search(simulator.rig("FR_knee"), goals, *axes(ROBOT))
        assert simulator.count.steps == 2500 * max(goal.steps for goal in goals)
    for goal, one in zip(goals, found, strict=True):
        assert one.error.shape == (50, 50)
        assert one.cell == nearest(one, gains_of(goal.joint))
        assert one.error_db < 0.1
        # Far off the error is large: the map has one valley.
        assert np.sqrt(one.error[0, 0]) > 1.0


def test_rolls_moved_to_the_same_side_share_most_of_a_simulation() -> None:
    """Left rolls are read off the right one's simulation; what could be best is simulated anew."""
    goals = [known(joint, length_s=8.0) for joint in ("FR_hip_roll", "FL_hip_roll", "FR_knee")]
    grid = axes(ROBOT, 12)
    shares: list[float] = []
    with MujocoSimulator(ROBOT) as simulator:
        found = search_all(simulator, goals, *grid, progress=shares.append)
        steps = simulator.count.steps
        whole = [search(simulator.rig(goal.joint), [goal], *grid)[0] for goal in goals]
    for fast, slow in zip(found, whole, strict=True):
        assert fast.cell == slow.cell
        assert fast.error_db == pytest.approx(slow.error_db, rel=1e-9)
        np.testing.assert_allclose(np.sqrt(fast.error), np.sqrt(slow.error), atol=0.05)
    assert steps < 1.2 * 144 * (goals[0].steps + goals[2].steps)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)


def test_the_coarse_search_finds_the_best_of_the_whole_grid() -> None:
    goal = known("FR_knee", length_s=8.0)
    stiffness, damping = axes(ROBOT, 22)
    with MujocoSimulator(ROBOT) as simulator:
        rig = simulator.rig("FR_knee")
        whole = search(rig, [goal], stiffness, damping)[0]
        coarse = coarse_search(rig, [goal], stiffness, damping)[0]
    assert coarse.cell == whole.cell
    looked = np.isfinite(coarse.error)
    assert looked.mean() < 0.3
    np.testing.assert_allclose(coarse.error[looked], whole.error[looked], rtol=1e-12)


def test_the_error_is_the_mean_square_in_decibels() -> None:
    goal = known("FR_hip_pitch", length_s=8.0)
    measured = goal.measured.response[goal.fit_mask]
    assert mean_square(goal, measured * 10 ** (0.5 / 20)) == pytest.approx(0.25)
    # Phase is disregarded (F9).
    turned = measured * np.exp(-1j * goal.omega * 0.01)
    assert mean_square(goal, turned) == pytest.approx(0.0, abs=1e-20)
    dead = np.zeros_like(measured)
    assert mean_square(goal, dead) == pytest.approx(DIVERGED_DB**2)
    broken = np.full_like(measured, np.nan)
    assert mean_square(goal, broken) == pytest.approx(DIVERGED_DB**2)


def test_repeats_in_several_logs_are_put_together() -> None:
    goal = known("FR_knee", length_s=8.0)
    turned = replace(
        goal,
        measured=replace(
            goal.measured,
            response=1.2 * goal.measured.response,
            repeats=np.repeat(1.2 * goal.measured.repeats, 2, axis=0),
        ),
    )
    both = merged([[goal], [turned]])
    assert len(both) == 1
    assert len(both[0].measured.repeats) == 3
    expected = goal.measured.response * (1.0 + 2 * 1.2) / 3
    np.testing.assert_allclose(both[0].measured.response, expected)


def test_full_and_banded_responses_agree() -> None:
    goal = known("FL_hip_roll", length_s=8.0)
    with MujocoSimulator(ROBOT) as simulator:
        request = SimRequest(goal, *gains_of("FL_hip_roll"))
        whole = responses(simulator, [request], whole=True)[0]
        banded = responses(simulator, [request])[0]
    np.testing.assert_allclose(whole, goal.measured.response, rtol=1e-6)
    np.testing.assert_allclose(banded, whole[goal.fit_mask], rtol=1e-3)
