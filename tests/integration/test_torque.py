"""The torque fit: known drives of a simulated rig recovered, and the recorded AK80-6."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from benchmarks.ak80 import DATA, FITTED, HELD_OUT, JOINTS, RIG, fitted, rig, run
from command_line import accepted, refused
from pronk.errors import IdentifiabilityError, LogError
from pronk.identify.logs.joint_log import JointLog, LogOrigin
from pronk.identify.logs.readers import read_log
from pronk.identify.logs.segment import Segment
from pronk.identify.match import gains
from pronk.identify.match.match import match
from pronk.identify.match.torque import fit_drives, fit_torque
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec

recorded = pytest.mark.skipif(not DATA.is_dir(), reason="the AK80-6 recordings are not here")

ARMATURE, VISCOUS, DRY = 0.003, (0.03, 0.02), (0.15, 0.1)
SCALE = 1.2
"""Of the simulated torque sensor."""
NOISE_NM = 0.02


def simulated(seed: int) -> JointLog:
    """Ten seconds of the rig with known drives, driven by sums of sines of torque."""
    model, off = rig().build_spec().compile(), mujoco.mjtDisableBit
    model.opt.timestep, steps = 0.0005, 20000
    model.opt.disableflags |= int(off.mjDSBL_ACTUATION | off.mjDSBL_LIMIT)
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


@pytest.fixture(scope="module")
def logs() -> list[JointLog]:
    return [simulated(seed) for seed in range(3)]


def test_unknown_links_leave_the_scale_open(logs: list[JointLog]) -> None:
    """Known drives are found in units of a torque sensor that is off by its scale."""
    fit = fit_torque(logs, rig(), JOINTS[0], links_known=False, shared=(JOINTS,))
    for j, joint in enumerate(JOINTS):
        found = fit.joints[joint]
        assert found["armature"].value == pytest.approx(SCALE * ARMATURE, rel=0.1)
        assert found["dry"].value == pytest.approx(SCALE * DRY[j], rel=0.1)
        assert found["viscous"].value == pytest.approx(SCALE * VISCOUS[j], rel=0.15)
        low, high = found["armature"].ci95
        assert found["armature"].identified
        assert low < found["armature"].value < high
    assert not fit.joints["elbow"]["scale"].identified
    # The pendulum that the fit stands for has its torque.
    q, v, a = np.random.default_rng(0).normal(size=(3, 40, 2))
    assert fitted(fit).torque(q, v, a) == pytest.approx(fit.torque(q, v, a), abs=1e-6)


def test_armature_of_the_first_joint_is_not_separated_from_its_link(logs: list[JointLog]) -> None:
    fit = fit_torque(logs, rig(), JOINTS[0], links_known=False)
    assert not fit.joints["shoulder"]["armature"].identified
    assert np.isnan(fit.joints["shoulder"]["armature"].value)
    assert fit.joints["elbow"]["armature"].identified


def test_torque_that_cannot_be_used_is_named(logs: list[JointLog]) -> None:
    log, size = logs[0], np.abs(logs[0].torque)  # type: ignore[arg-type]
    short = Segment(kind="unknown", joints=JOINTS, start=0.0, stop=7.0, amplitude=np.nan)
    for bad, reason in (
        (replace(log, torque=size), "magnitudes"),
        (replace(log, origin=LogOrigin(metadata={"torque": "computed"})), "not measured"),
        (replace(log, time=5.0 * log.time), "Hz, fewer than 160"),
        (replace(log, position=0.0 * log.position), "no joint moves"),
        (log.cut(short), "less than 7.5"),
    ):
        drives, flags = fit_drives([bad], rig())
        assert drives == {}
        assert reason in flags["elbow"]
    with pytest.raises(IdentifiabilityError, match="magnitudes"):
        match([replace(log, command=0.0 * log.command, torque=size)], rig(), mode="drive")
    with pytest.raises(LogError, match="no torque channel"):
        fit_torque([replace(log, torque=None)], rig(), JOINTS[0], links_known=True)


def heavier(factor: float) -> RobotSpec:
    """The rig with a wrong mass of its lower link."""

    def build() -> mujoco.MjSpec:
        spec = rig().build_spec()
        body = spec.body("lower")
        body.mass, body.inertia = factor * body.mass, factor * np.array(body.inertia)
        return spec

    return replace(rig(), build_spec=build)


def test_mode_drive_fits_torque_and_keeps_it(logs: list[JointLog], tmp_path: Path) -> None:
    still = [replace(log, command=0.0 * log.command) for log in logs]
    with pytest.raises(LogError, match="--mode drive"):
        match(still, rig())
    result = match(still, rig(), mode="drive")
    gains.save_gains(tmp_path / "gains.yaml", result.gains)
    kept = gains.load_gains(tmp_path / "gains.yaml")
    for j, joint in enumerate(JOINTS):
        viscous = kept.joints[joint].torque["viscous"].value
        assert viscous == pytest.approx(VISCOUS[j], rel=0.15)
        for found in (result.gains.joints[joint], kept.joints[joint]):
            scale, (low, high) = found.torque["scale"].value, found.torque["scale"].ci95
            assert low < scale < high
            assert scale == pytest.approx(SCALE, rel=0.03)
            assert found.armature.value == pytest.approx(ARMATURE, rel=0.1)
            assert found.frictionloss.value == pytest.approx(DRY[j], rel=0.1)


@pytest.mark.parametrize("factor", [0.9, 1.03, 1.1])
def test_links_that_do_not_hold_are_fitted(logs: list[JointLog], factor: float) -> None:
    drives, _ = fit_drives(logs, heavier(factor))
    for joint in JOINTS:
        assert not drives[joint]["scale"].identified
    elbow = drives["elbow"]["armature"]
    assert elbow.value == pytest.approx(SCALE * ARMATURE, rel=0.05)
    # Both drives are alike in the model but for their friction.
    assert not drives["shoulder"]["armature"].identified


def test_friction_of_a_swept_leg_in_units_of_its_sensor(tmp_path: Path) -> None:
    """Of one joint that moves, armature, scale and links are one; friction is not."""
    robot = load_robot("mini_cheetah")
    words = ["sweep", robot.name, "--joints", "FR_knee", "--repeats", "1", "--amplitude", "0.25"]
    accepted(*words, "--out", tmp_path)
    drives, flags = fit_drives([read_log(tmp_path / "FR_knee.mcap")], robot)
    assert (list(drives), flags) == (["FR_knee"], {})
    own, true = drives["FR_knee"], load_sim_params(None, robot).joints["FR_knee"]
    assert not own["scale"].identified
    assert not own["armature"].identified
    assert own["dry"].value == pytest.approx(true.coulomb / true.torque_scale, rel=0.05)
    low, high = own["viscous"].ci95
    assert low < true.viscous / true.torque_scale < high


COLUMNS = [
    word
    for i, joint in enumerate(JOINTS)
    for column in (f"position.{joint}=pos_meas{i + 1}", f"torque.{joint}=tau_meas{i + 1}")
    for word in ("--columns", column)
]


@recorded
def test_recordings_of_torque_are_fitted_from_the_command_line(tmp_path: Path) -> None:
    (tmp_path / RIG.name).write_text(RIG.read_text())
    accepted("robot", "new", tmp_path / RIG.name)
    robot, out = tmp_path / "robot.yaml", tmp_path / "out" / "gains.yaml"
    logs = [DATA / f"{name}.csv" for name in FITTED]
    words = ["match", *logs, "--robot", robot, "--unit", "rad", *COLUMNS, "--out", out]
    assert "--mode drive" in refused(*words)
    assert not out.exists()
    shown = accepted(*words, "--mode", "drive")
    expected, found = run()["fit"].joints, gains.load_gains(out).joints
    assert found["elbow"].armature.value == pytest.approx(
        expected["elbow"]["armature"].value, rel=1e-4
    )
    assert not found["shoulder"].torque["armature"].identified
    for joint in JOINTS:
        assert found[joint].frictionloss.value == pytest.approx(
            expected[joint]["dry"].value, rel=1e-4
        )
        low, high = found[joint].torque["dry"].ci95
        assert low < found[joint].frictionloss.value < high
        assert "the robot's file" in " ".join(found[joint].flags)
    interval = "{:.4g} to {:.4g}".format(*found["elbow"].torque["armature"].ci95)
    page = (out.parent / "match.html").read_text()
    for part in (f"{found['elbow'].armature.value:.4g}", interval, "armature [kg m^2]"):
        assert part in shown
        assert part in page
    # One drive for both actuators, as their builder may state.
    robot.write_text(robot.read_text().replace("drive: elbow", "drive: shoulder"))
    accepted(*words, "--mode", "drive")
    found = gains.load_gains(out).joints
    assert found["shoulder"].armature == found["elbow"].armature


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
    assert not lost
