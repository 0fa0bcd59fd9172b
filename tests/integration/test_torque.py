"""The torque fit: known drives of a simulated rig recovered, and the recorded AK80-6."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from benchmarks.ak80 import DATA, HELD_OUT, JOINTS, fitted, read, rig, run
from pronk.errors import LogError
from pronk.logs.joint_log import JointLog
from pronk.match.torque import TorqueFit, fit_torque

recorded = pytest.mark.skipif(not DATA.is_dir(), reason="the AK80-6 recordings are not here")

ARMATURE, VISCOUS, DRY = 0.003, (0.03, 0.02), (0.15, 0.1)
SCALE = 1.2
"""Of the simulated torque sensor."""
NOISE_NM = 0.02
KNOWN_LOST = {
    ("tracking_154220", "position", "shoulder", "model_1.0"),
    ("tracking_154220", "position", "shoulder", "model_2.0"),
}
"""Cells in which a published set has the lower error than the fit."""


def simulated(seed: int) -> JointLog:
    """Ten seconds of the rig with known drives, driven by sums of sines of torque."""
    model = rig().build_spec().compile()
    model.opt.timestep, steps = 0.0005, 20000
    model.opt.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_LIMIT
    )
    model.dof_armature[:], model.dof_damping[:] = ARMATURE, VISCOUS
    model.dof_frictionloss[:] = 0.0
    data, random = mujoco.MjData(model), np.random.default_rng(seed)
    hz, phase = random.uniform(0.5, 2.5, (5, 2)), random.uniform(0.0, 2.0 * np.pi, (5, 2))
    position, velocity, torque = (np.empty((steps, 2)) for _ in range(3))
    for k in range(steps):
        drive = np.sin(2.0 * np.pi * hz * data.time + phase).sum(axis=0) * (0.5, 0.4)
        position[k], velocity[k], torque[k] = data.qpos, data.qvel, drive
        data.qfrc_applied[:] = drive - np.array(DRY) * np.tanh(data.qvel / 0.05)
        mujoco.mj_step(model, data)
    every = slice(0, None, 4)
    return JointLog(
        robot="ak80_double_pendulum",
        joints=JOINTS,
        time=np.linspace(0.0, 10.0, steps // 4, endpoint=False),
        command=position[every],
        position=position[every],
        velocity=velocity[every],
        torque=SCALE * torque[every] + NOISE_NM * random.standard_normal((steps // 4, 2)),
    )


def assert_drives(fit: TorqueFit, factor: float) -> None:
    """Known drives within the tolerance, in units of a torque sensor off by a factor."""
    for j, joint in enumerate(JOINTS):
        found = fit.joints[joint]
        assert found["armature"].identified
        assert found["armature"].value == pytest.approx(factor * ARMATURE, rel=0.1)
        assert found["dry"].value == pytest.approx(factor * DRY[j], rel=0.1)
        assert found["viscous"].value == pytest.approx(factor * VISCOUS[j], rel=0.15)
        low, high = found["armature"].ci95
        assert low < found["armature"].value < high


@pytest.fixture(scope="module")
def logs() -> list[JointLog]:
    return [simulated(seed) for seed in range(3)]


def test_known_drives_and_torque_scale_are_recovered_with_known_links(logs: list[JointLog]) -> None:
    fit = fit_torque(logs, rig(), links_known=True)
    assert_drives(fit, 1.0)
    for joint in JOINTS:
        assert fit.joints[joint]["scale"].value == pytest.approx(SCALE, rel=0.03)


def test_unknown_links_leave_the_scale_open(logs: list[JointLog]) -> None:
    fit = fit_torque(logs, rig(), links_known=False, shared=(JOINTS,))
    assert_drives(fit, SCALE)
    assert not fit.joints["elbow"]["scale"].identified


def test_armature_of_the_first_joint_is_not_told_from_its_link(logs: list[JointLog]) -> None:
    fit = fit_torque(logs, rig(), links_known=False)
    assert not fit.joints["shoulder"]["armature"].identified
    assert np.isnan(fit.joints["shoulder"]["armature"].value)
    assert fit.joints["elbow"]["armature"].identified


def test_pendulum_of_a_fit_has_its_torque(logs: list[JointLog]) -> None:
    fit = fit_torque(logs, rig(), links_known=False, shared=(JOINTS,))
    q, v, a = np.random.default_rng(0).normal(size=(3, 40, 2))
    assert fitted(fit).torque(q, v, a) == pytest.approx(fit.torque(q, v, a), abs=1e-6)


def test_a_log_without_torque_is_refused(logs: list[JointLog]) -> None:
    with pytest.raises(LogError, match="no torque channel"):
        fit_torque([replace(logs[0], torque=None)], rig(), links_known=True)


@recorded
def test_fit_of_three_recordings_holds_on_the_others() -> None:
    found = run()
    armature = found["fit"].joints["elbow"]["armature"]
    assert armature.identified
    assert 0.0 < armature.ci95[0] < armature.ci95[1]
    lost = [
        (log, kind, JOINTS[j], name)
        for log in HELD_OUT
        for kind in ("torque", "position")
        for name, other in found["errors"][log].items()
        for j in range(2)
        if name != "fit" and found["errors"][log]["fit"][kind][j] >= other[kind][j]
    ]
    # The known exceptions; the benchmark prints the numbers.
    assert set(lost) <= KNOWN_LOST
    assert read(HELD_OUT[0]).torque is not None
