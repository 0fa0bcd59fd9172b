"""The quick way: the closed form against the simulator, and the search that rests on it."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from pronk.excitation.signals import Chirp
from pronk.match.grid import axes, search
from pronk.match.measured_joint import DB, Target, targets
from pronk.match.quick import quick_search
from pronk.match.refine import refine
from pronk.match.settings import MatchSettings
from pronk.match.synthetic_log import Ask, rehearse
from pronk.robots import load_robot
from pronk.simulators.batch import Job, Simulator
from pronk.simulators.linear import plant
from pronk.simulators.mujoco import Bench

ROBOT = load_robot("mini_cheetah")
SETTINGS = MatchSettings()


def known(joint: str, stiffness: float, damping: float, *, length_s: float = 10.0) -> Target:
    ask = Ask(offsets=Chirp(length_s=length_s).samples())
    return targets(rehearse(ROBOT, joint, [ask], stiffness, damping), joint, ROBOT, SETTINGS)[0]


def test_without_friction_the_closed_form_is_the_simulation() -> None:
    ask = Ask(offsets=Chirp().samples())
    log = rehearse(ROBOT, "FR_knee", [ask], 20.0, 0.5, frictionloss=0.0)
    measured = targets(log, "FR_knee", ROBOT, SETTINGS)[0].measured
    with Bench(ROBOT, "FR_knee", frictionloss=0.0) as bench:
        closed = plant(bench, np.array([1.6]), measured.omega).response(20.0, 0.5)[0]
    # Below 1 Hz the windows of the chirp leak; above it nothing but the swing of gravity is left.
    above = measured.omega > 2 * np.pi * 1.0
    ratio = (measured.response / closed)[above]
    assert np.abs(DB * np.log(np.abs(ratio))).max() < 0.05
    assert np.abs(np.angle(ratio)).max() < np.deg2rad(0.3)


def test_at_a_fine_step_the_closed_form_is_the_second_order_joint() -> None:
    """`stiffness / (I s^2 + (damping + b) s + stiffness + gravity)` (paper M2, reading A9)."""
    fine = replace(ROBOT, timestep_s=1e-5, decimation=2000)
    omega = 2 * np.pi * np.array([0.5, 2.0, 5.0, 10.0, 20.0])
    with Bench(fine, "FR_knee") as bench:
        linear = replace(plant(bench, np.array([1.6]), omega), frictionloss=0.0)
        found = linear.response(17.0, 0.4)[0]
        data = mujoco.MjData(bench.model)
        data.qpos[:] = 1.6
        mujoco.mj_forward(bench.model, data)
        inertia = np.zeros(1)
        mujoco.mj_mulM(bench.model, data, inertia, np.ones(1))
        bias = []
        for angle in (1.6 - 1e-4, 1.6 + 1e-4):
            data.qpos[:] = angle
            mujoco.mj_forward(bench.model, data)
            bias.append(data.qfrc_bias[0])
    gravity = (bias[1] - bias[0]) / 2e-4
    s = 1j * omega
    viscous = ROBOT.joint("FR_knee").drive.viscous_damping
    expected = 17.0 / (inertia * s**2 + (0.4 + viscous) * s + 17.0 + gravity)
    np.testing.assert_allclose(found, expected, rtol=2e-3)


@pytest.mark.parametrize("joint", ["FR_hip_roll", "FR_hip_pitch", "FR_knee"])
def test_with_friction_it_is_close_enough_to_start_from(joint: str) -> None:
    goal = known(joint, 20.0, 0.5)
    with Bench(ROBOT, joint) as bench:
        linear = plant(bench, bench.pose(goal.question), goal.omega)
    error = goal.error_db(linear.response(20.0, 0.5, amplitude=0.25)[0])
    assert np.sqrt(np.mean(error**2)) < 0.3
    # Friction matters: without it the closed form is worse.
    bare = goal.error_db(linear.response(20.0, 0.5)[0])
    assert np.mean(error**2) < np.mean(bare**2)


def test_the_quick_way_finds_what_simulating_everything_finds() -> None:
    """Same node of the grid, and the refined gains within 0.1 %, off the nodes and off the model.

    The measured joints have twice the simulator's dry friction, so no gains fit exactly and the
    optimum is one of a misfit.
    """
    joints = {"FR_hip_pitch": (17.7, 0.406), "FR_knee": (22.0, 0.523)}
    goals = []
    for joint, gains in joints.items():
        ask = Ask(offsets=Chirp(length_s=8.0).samples())
        log = rehearse(ROBOT, joint, [ask], *gains, frictionloss=0.4)
        goals.append(targets(log, joint, ROBOT, SETTINGS)[0])
    grid = axes(ROBOT, 18)
    with Simulator(ROBOT) as simulator:
        quick = quick_search(simulator, goals, *grid)
        whole = [search(simulator.bench(goal.joint), [goal], *grid)[0] for goal in goals]
        fits = refine(simulator, goals, [one.gains for one in whole])
    for fast, slow, fit in zip(quick, whole, fits, strict=True):
        assert fast.grid.cell == slow.cell
        assert fast.grid.error_db == pytest.approx(slow.error_db, rel=1e-6)
        assert fit.error_db > 0.02
        assert fast.fit.stiffness == pytest.approx(fit.stiffness, rel=1e-3)
        assert fast.fit.damping == pytest.approx(fit.damping, rel=1e-3)
        # The corrected map is that of the simulator around the optimum.
        i, j = slow.cell
        near = (slice(max(i - 2, 0), i + 3), slice(max(j - 2, 0), j + 3))
        np.testing.assert_allclose(
            np.sqrt(fast.grid.error[near]), np.sqrt(slow.error[near]), atol=0.03
        )


def test_the_horizon_changes_no_gain() -> None:
    """Steps that the estimator does not hear of in the band are left out: 0.003 dB at most."""
    goal = known("FR_hip_pitch", 17.0, 0.4, length_s=20.0)
    assert goal.steps < 0.8 * len(goal.matrix)
    with Simulator(ROBOT) as simulator:
        for gains in ((13.0, 0.1), (27.0, 0.7), (20.0, 0.4)):
            job = Job(goal, *gains)
            cut = simulator.responses([job])[0]
            whole = simulator.responses([job], whole=True)[0][goal.inside]
            assert np.abs(DB * np.log(np.abs(cut / whole))).max() < 0.003
