"""The linearized simulator against the simulator, and the quick search that uses it."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from benchmarks.synthetic_log import Excitation, synthetic_log
from pronk.excitation.signals import Chirp
from pronk.match.grid import axes, quick_search, search
from pronk.match.measured_joint import DB, MeasuredJoint, SimRequest, measured_joints, responses
from pronk.match.response_fit import refine
from pronk.match.settings import MatchSettings
from pronk.robots import load_robot
from pronk.simulators.linear import plant
from pronk.simulators.mujoco import JointTestRig, MujocoSimulator

ROBOT = load_robot("mini_cheetah")
SETTINGS = MatchSettings()


def known(joint: str, stiffness: float, damping: float, *, length_s: float = 10.0) -> MeasuredJoint:
    chirp = Excitation(offsets=Chirp(length_s=length_s).samples())
    log = synthetic_log(ROBOT, joint, [chirp], stiffness, damping)
    return measured_joints(log, joint, ROBOT, SETTINGS)[0]


def test_without_friction_the_closed_form_is_the_simulation() -> None:
    chirp = Excitation(offsets=Chirp().samples())
    log = synthetic_log(ROBOT, "FR_knee", [chirp], 20.0, 0.5, frictionloss=0.0)
    measured = measured_joints(log, "FR_knee", ROBOT, SETTINGS)[0].measured
    with JointTestRig(ROBOT, "FR_knee", frictionloss=0.0) as rig:
        closed = plant(rig, np.array([1.6]), measured.omega).response(20.0, 0.5)[0]
    # Below 1 Hz the windows of the chirp leak; above it nothing but the swing of gravity is left.
    above = measured.omega > 2 * np.pi * 1.0
    ratio = (measured.response / closed)[above]
    assert np.abs(DB * np.log(np.abs(ratio))).max() < 0.05
    assert np.abs(np.angle(ratio)).max() < np.deg2rad(0.3)


def test_at_a_fine_step_the_closed_form_is_the_second_order_joint() -> None:
    """`stiffness / (I s^2 + (damping + b) s + stiffness + gravity)` (paper M2, reading A9)."""
    fine = replace(ROBOT, timestep_s=1e-5, decimation=2000)
    omega = 2 * np.pi * np.array([0.5, 2.0, 5.0, 10.0, 20.0])
    with JointTestRig(fine, "FR_knee") as rig:
        linear = replace(plant(rig, np.array([1.6]), omega), frictionloss=0.0)
        found = linear.response(17.0, 0.4)[0]
        data = mujoco.MjData(rig.model)
        data.qpos[:] = 1.6
        mujoco.mj_forward(rig.model, data)
        inertia = np.zeros(1)
        mujoco.mj_mulM(rig.model, data, inertia, np.ones(1))
        bias = []
        for angle in (1.6 - 1e-4, 1.6 + 1e-4):
            data.qpos[:] = angle
            mujoco.mj_forward(rig.model, data)
            bias.append(data.qfrc_bias[0])
    gravity = (bias[1] - bias[0]) / 2e-4
    s = 1j * omega
    viscous = ROBOT.joint("FR_knee").drive.viscous_damping
    expected = 17.0 / (inertia * s**2 + (0.4 + viscous) * s + 17.0 + gravity)
    np.testing.assert_allclose(found, expected, rtol=2e-3)


@pytest.mark.parametrize("joint", ["FR_hip_roll", "FR_hip_pitch", "FR_knee"])
def test_with_friction_it_is_close_enough_to_start_from(joint: str) -> None:
    goal = known(joint, 20.0, 0.5)
    with JointTestRig(ROBOT, joint) as rig:
        linear = plant(rig, rig.pose(goal.trace), goal.omega)
    error = goal.error_db(linear.response(20.0, 0.5, amplitude=0.25)[0])
    assert np.sqrt(np.mean(error**2)) < 0.3
    # Friction matters: without it the closed form is worse.
    bare = goal.error_db(linear.response(20.0, 0.5)[0])
    assert np.mean(error**2) < np.mean(bare**2)


def test_the_quick_search_finds_what_simulating_everything_finds() -> None:
    """Same node of the grid, and the refined gains within 0.1 %, off the nodes and off the model.

    The measured joints have twice the simulator's dry friction, so no gains fit exactly and the
    optimum is one of a misfit.
    """
    joints = {"FR_hip_pitch": (17.7, 0.406), "FR_knee": (22.0, 0.523)}
    goals = []
    for joint, gains in joints.items():
        chirp = Excitation(offsets=Chirp(length_s=8.0).samples())
        log = synthetic_log(ROBOT, joint, [chirp], *gains, frictionloss=0.4)
        goals.append(measured_joints(log, joint, ROBOT, SETTINGS)[0])
    grid = axes(ROBOT, 18)
    with MujocoSimulator(ROBOT) as simulator:
        quick = quick_search(simulator, goals, *grid)
        whole = [search(simulator.rig(goal.joint), [goal], *grid)[0] for goal in goals]
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
    """Steps without effect on the band are left out: 0.003 dB at most."""
    goal = known("FR_hip_pitch", 17.0, 0.4, length_s=20.0)
    assert goal.steps < 0.8 * len(goal.matrix)
    with MujocoSimulator(ROBOT) as simulator:
        for gains in ((13.0, 0.1), (27.0, 0.7), (20.0, 0.4)):
            request = SimRequest(goal, *gains)
            cut = responses(simulator, [request])[0]
            whole = responses(simulator, [request], whole=True)[0][goal.fit_mask]
            assert np.abs(DB * np.log(np.abs(cut / whole))).max() < 0.003
