"""The torque fit: known drives of a simulated rig recovered, and the recorded AK80-6."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from ak80_pendulum import DATA, FITTED, JOINTS, RIG, compare, fitted, rig
from command_line import accepted, refused
from pronk.errors import IdentifiabilityError, LogError
from pronk.identify.logs.joint_log import JointLog, LogOrigin
from pronk.identify.logs.readers import read_log
from pronk.identify.logs.segment import Segment
from pronk.identify.match.gains import load_gains, save_gains
from pronk.identify.match.match import match
from pronk.identify.match.torque_fit import (
    fit_torque,
    fit_torque_drives,
    left_out_by_torque,
    with_torque,
)
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec

recorded = pytest.mark.skipif(not DATA.is_dir(), reason="the AK80-6 recordings are not here")

ARMATURE = 0.003
VISCOUS = (0.03, 0.02)
DRY = (0.15, 0.1)
SCALE = 1.2
"""Scale of the simulated torque sensor."""
NOISE_NM = 0.02


def simulated(seed: int) -> JointLog:
    """Ten seconds of the rig with known drives, driven by sums of sines of torque."""
    model = rig().build_spec().compile()
    steps = 20000
    model.opt.timestep = 0.0005
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    model.dof_armature[:] = ARMATURE
    model.dof_damping[:] = VISCOUS
    model.dof_frictionloss[:] = 0.0
    data = mujoco.MjData(model)
    random = np.random.default_rng(seed)
    frequency_hz = random.uniform(0.5, 2.5, (5, 2))
    phase = random.uniform(0.0, 2.0 * np.pi, (5, 2))
    position = np.empty((steps, 2))
    velocity = np.empty((steps, 2))
    torque = np.empty((steps, 2))
    for k in range(steps):
        sines = np.sin(2.0 * np.pi * frequency_hz * data.time + phase)
        drive = sines.sum(axis=0) * (0.5, 0.4)
        position[k] = data.qpos
        velocity[k] = data.qvel
        torque[k] = drive
        data.qfrc_applied[:] = drive - np.array(DRY) * np.tanh(data.qvel / 0.05)
        mujoco.mj_step(model, data)
    stride = slice(0, None, 4)
    noise = NOISE_NM * random.standard_normal((steps // 4, 2))
    return JointLog(
        robot="ak80_double_pendulum",
        joints=JOINTS,
        time=np.linspace(0.0, 10.0, steps // 4, endpoint=False),
        command=position[stride],
        position=position[stride],
        velocity=velocity[stride],
        torque=SCALE * torque[stride] + noise,
    )


@pytest.fixture(scope="module")
def logs() -> list[JointLog]:
    return [simulated(seed) for seed in range(3)]


def test_unknown_links_leave_the_scale_open(logs: list[JointLog]) -> None:
    """Known drives are found in units of a torque sensor that is off by its scale."""
    fit = fit_torque(logs, rig(), JOINTS[0], links_known=False, shared=(JOINTS,))
    for number, joint in enumerate(JOINTS):
        drive = fit.joints[joint]
        assert drive["armature"].value == pytest.approx(SCALE * ARMATURE, rel=0.1)
        assert drive["dry"].value == pytest.approx(SCALE * DRY[number], rel=0.1)
        assert drive["viscous"].value == pytest.approx(SCALE * VISCOUS[number], rel=0.15)
        low, high = drive["armature"].ci95
        assert drive["armature"].identified
        assert low < drive["armature"].value < high
    assert not fit.joints["elbow"]["scale"].identified
    # The pendulum that the fit stands for has its torque.
    states = np.random.default_rng(0).normal(size=(3, 40, 2))
    assert fitted(fit).torque(*states) == pytest.approx(fit.torque(*states), abs=1e-6)


def test_armature_of_the_first_joint_is_not_separated_from_its_link(logs: list[JointLog]) -> None:
    fit = fit_torque(logs, rig(), JOINTS[0], links_known=False)
    assert not fit.joints["shoulder"]["armature"].identified
    assert np.isnan(fit.joints["shoulder"]["armature"].value)
    assert fit.joints["elbow"]["armature"].identified


def test_torque_that_cannot_be_used_is_named(logs: list[JointLog]) -> None:
    log = logs[0]
    assert log.torque is not None
    short = Segment(kind="unknown", joints=JOINTS, start=0.0, stop=7.0, amplitude=np.nan)
    magnitudes = replace(log, torque=np.abs(log.torque))
    unusable = {
        "magnitudes": magnitudes,
        "not measured": replace(log, origin=LogOrigin(metadata={"torque": "computed"})),
        "Hz, fewer than 160": replace(log, time=5.0 * log.time),
        "no joint moves": replace(log, position=0.0 * log.position),
        "less than 7.5": log.cut(short),
    }
    for reason, bad_log in unusable.items():
        fits = fit_torque_drives([bad_log], rig())
        assert fits["elbow"].torque == {}
        assert reason in " ".join(fits["elbow"].flags)
        assert with_torque({}, fits, rig()) == {}
    with pytest.raises(IdentifiabilityError, match="magnitudes"):
        match([replace(magnitudes, command=0.0 * log.command)], rig(), mode="drive")
    with pytest.raises(LogError, match="no torque channel"):
        fit_torque([replace(log, torque=None)], rig(), JOINTS[0], links_known=True)


def heavier(factor: float) -> RobotSpec:
    """The rig with a wrong mass of its lower link."""

    def build() -> mujoco.MjSpec:
        spec = rig().build_spec()
        body = spec.body("lower")
        body.mass = factor * body.mass
        body.inertia = factor * np.array(body.inertia)
        return spec

    return replace(rig(), build_spec=build)


def test_mode_drive_fits_torque_and_keeps_it(logs: list[JointLog], tmp_path: Path) -> None:
    still = [replace(log, command=0.0 * log.command) for log in logs]
    with pytest.raises(LogError, match="--mode drive"):
        match(still, rig())
    result = match(still, rig(), mode="drive")
    save_gains(tmp_path / "gains.yaml", result.gains)
    read = load_gains(tmp_path / "gains.yaml")
    for number, joint in enumerate(JOINTS):
        viscous = read.joints[joint].torque["viscous"].value
        assert viscous == pytest.approx(VISCOUS[number], rel=0.15)
        for gains in (result.gains.joints[joint], read.joints[joint]):
            scale = gains.torque["scale"]
            assert scale.ci95[0] < scale.value < scale.ci95[1]
            assert scale.value == pytest.approx(SCALE, rel=0.03)
            assert gains.armature.value == pytest.approx(ARMATURE, rel=0.1)
            assert gains.frictionloss.value == pytest.approx(DRY[number], rel=0.1)


@pytest.mark.parametrize("factor", [0.9, 1.03, 1.1])
def test_links_that_do_not_hold_are_fitted(logs: list[JointLog], factor: float) -> None:
    fits = fit_torque_drives(logs, heavier(factor))
    for joint in JOINTS:
        assert not fits[joint].torque["scale"].identified
    armature = fits["elbow"].torque["armature"]
    assert armature.value == pytest.approx(SCALE * ARMATURE, rel=0.05)
    assert fits["elbow"].values["armature"] == armature.value
    # Both drives are alike in the model but for their friction.
    assert not fits["shoulder"].torque["armature"].identified


def test_a_contradiction_between_position_and_torque_is_flagged(logs: list[JointLog]) -> None:
    by_torque = fit_torque_drives(logs, rig())
    elbow = by_torque["elbow"]
    agreeing = replace(elbow, torque={}, flags=())
    joined = with_torque({"elbow": agreeing}, by_torque, rig())["elbow"]
    assert joined.flags == ()
    assert joined.torque == elbow.torque
    values = {**elbow.values, "armature": 2.0 * elbow.values["armature"]}
    contradicting = replace(agreeing, values=values)
    (flag,) = with_torque({"elbow": contradicting}, by_torque, rig())["elbow"].flags
    assert flag.startswith("armature")
    assert "by torque" in flag


def test_friction_of_a_swept_leg_in_units_of_its_sensor(tmp_path: Path) -> None:
    """Of one joint that moves, armature, scale and links are one; friction is not."""
    robot = load_robot("mini_cheetah")
    words = ["sweep", robot.name, "--joints", "FR_knee", "--repeats", "1", "--amplitude", "0.25"]
    accepted(*words, "--out", tmp_path)
    fits = fit_torque_drives([read_log(tmp_path / "FR_knee.mcap")], robot)
    assert list(fits) == ["FR_knee"]
    assert fits["FR_knee"].flags == ()
    torque = fits["FR_knee"].torque
    true = load_sim_params(None, robot).joints["FR_knee"]
    assert not torque["scale"].identified
    assert not torque["armature"].identified
    assert torque["dry"].value == pytest.approx(true.coulomb / true.torque_scale, rel=0.05)
    low, high = torque["viscous"].ci95
    assert low < true.viscous / true.torque_scale < high


def column_options() -> list[str]:
    """Options that name the columns of the AK80-6 recordings."""
    words = []
    for number, joint in enumerate(JOINTS, 1):
        words += ["--columns", f"position.{joint}=pos_meas{number}"]
        words += ["--columns", f"torque.{joint}=tau_meas{number}"]
    return words


def test_an_angle_that_counts_from_the_base_is_not_dropped_without_a_word(
    logs: list[JointLog],
) -> None:
    for torque_too in (False, True):
        absolute = []
        for log in logs:
            assert log.torque is not None
            position = log.position.copy()
            torque = log.torque.copy()
            position[:, 1] += position[:, 0]
            if torque_too:
                torque[:, 0] -= torque[:, 1]
            absolute.append(
                replace(log, command=0.0 * log.command, position=position, torque=torque)
            )
        with pytest.raises(IdentifiabilityError, match=r"elbow.*count from the base"):
            match(absolute, rig(), mode="drive")
        # Beside a commanded motion the joints are left out with their reason.
        reasons = left_out_by_torque(fit_torque_drives(absolute, rig()), ())
        assert set(reasons) == set(JOINTS)


@recorded
def test_recordings_of_torque_are_fitted_from_the_command_line(tmp_path: Path) -> None:
    (tmp_path / RIG.name).write_text(RIG.read_text())
    accepted("robot", "new", tmp_path / RIG.name)
    robot = tmp_path / "robot.yaml"
    out = tmp_path / "out" / "gains.yaml"
    logs = [DATA / f"{name}.csv" for name in FITTED]
    words = ["match", *logs, "--robot", robot, "--unit", "rad", *column_options(), "--out", out]
    assert "--mode drive" in refused(*words)
    assert not out.exists()
    printed = accepted(*words, "--mode", "drive")
    expected = compare()[0].joints
    gains = load_gains(out).joints
    armature = gains["elbow"].armature.value
    assert armature == pytest.approx(expected["elbow"]["armature"].value, rel=1e-4)
    assert not gains["shoulder"].torque["armature"].identified
    for joint in JOINTS:
        friction = gains[joint].frictionloss.value
        assert friction == pytest.approx(expected[joint]["dry"].value, rel=1e-4)
        low, high = gains[joint].torque["dry"].ci95
        assert low < friction < high
        assert "the robot's file" in " ".join(gains[joint].flags)
    assert "armature" in printed
    assert (out.parent / "match.html").is_file()
    # One drive for both actuators, as their builder may state.
    robot.write_text(robot.read_text().replace("drive: elbow", "drive: shoulder"))
    accepted(*words, "--mode", "drive")
    gains = load_gains(out).joints
    assert gains["shoulder"].armature.value == gains["elbow"].armature.value


@recorded
def test_fit_of_three_recordings_holds_on_the_others() -> None:
    fit, comparisons = compare()
    armature = fit.joints["elbow"]["armature"]
    assert armature.identified
    assert 0.0 < armature.ci95[0] < armature.ci95[1]
    for comparison in comparisons:
        published = [name for name in comparison.errors if name != "fit"]
        assert comparison.lower_than == published, comparison
