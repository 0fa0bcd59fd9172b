"""The robots are what their sources say, and their models hold together."""

from __future__ import annotations

import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

import pronk.robots
from pronk.errors import RobotError
from pronk.identify.logs.sage_reader import SAGE_JOINTS
from pronk.robots import ROBOT_NAMES, load_robot, robot_file_path
from pronk.robots.legged import legged
from pronk.robots.model import free_spec
from pronk.robots.motor import torque_limits
from pronk.robots.robot import RobotSpec

CHEETAH = legged("mini_cheetah")
MODELS = {name: free_spec(load_robot(name)).compile() for name in ROBOT_NAMES}


def posed(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("default").id)
    mujoco.mj_forward(model, data)
    return data


def test_unknown_robot_names_the_known_ones() -> None:
    with pytest.raises(RobotError, match="mini_cheetah"):
        load_robot("go1")
    with pytest.raises(RobotError, match="legs"):
        legged("so101")


def test_dimensions_of_legs_come_from_the_model() -> None:
    go2 = legged("go2")
    assert go2.legs == ("FR", "FL", "RR", "RL")
    assert go2.leg_joints == CHEETAH.leg_joints == ("hip_roll", "hip_pitch", "knee")
    assert (go2.thigh_length, go2.shank_length, go2.foot_radius) == (0.213, 0.213, 0.022)
    lengths = (CHEETAH.thigh_length, CHEETAH.shank_length, CHEETAH.foot_radius)
    assert lengths == (0.209, 0.195, 0.0175)


@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_every_joint_of_the_robot_is_a_hinge_of_the_model(name: str) -> None:
    robot = load_robot(name)
    model = MODELS[name]
    for joint in robot.joints:
        hinge = model.joint(joint.name)
        drive = joint.drive
        np.testing.assert_allclose(hinge.range, joint.range)
        assert model.jnt_limited[hinge.id]
        passive = (drive.armature, drive.frictionloss, drive.viscous_damping)
        assert (hinge.armature, hinge.frictionloss, hinge.damping) == passive
    assert model.opt.timestep == robot.timestep_s


@pytest.mark.parametrize(
    ("name", "joint", "figures"),
    [
        # S6 and A12 of the paper; stall torque and no-load speed of the open software.
        ("mini_cheetah", "FR_hip_pitch", (0.0026, 17.0, 62.4, 40.0)),
        ("mini_cheetah", "FR_knee", (0.0063, 26.4, 97.1, 25.7)),
        # Limits of unitree_ros; the stall torque is where the line through the corner of the test
        # of the motor by its maker, 20.2 N m at 13.5 rad/s, meets standstill.
        ("go2", "FR_hip_pitch", (0.01, 23.7, 36.62, 30.1)),
        ("go2", "FR_knee", (0.036749, 45.43, 70.2, 15.70)),
    ],
)
def test_drives_have_the_published_figures(
    name: str, joint: str, figures: tuple[float, ...]
) -> None:
    drive = load_robot(name).joint(joint).drive
    assert drive.armature == pytest.approx(figures[0], abs=5e-5)
    limits = (drive.effort_limit, drive.stall_torque, drive.no_load_speed)
    assert limits == pytest.approx(figures[1:], abs=0.05)


def test_knees_of_the_go2_are_their_motors_behind_a_linkage() -> None:
    # unitree_ros, go2_description.urdf: effort and velocity of hip, thigh and calf.
    hip = load_robot("go2").joint("RL_hip_pitch").drive
    knee = load_robot("go2").joint("RL_knee").drive
    ratio = 45.43 / 23.7
    assert (hip.effort_limit, hip.no_load_speed) == (23.7, 30.1)
    assert (knee.effort_limit, knee.no_load_speed) == (45.43, 15.70)
    assert ratio == pytest.approx(1.917, abs=5e-4)
    assert knee.gear_ratio / hip.gear_ratio == pytest.approx(ratio, rel=1e-3)
    assert knee.armature / hip.armature == pytest.approx(ratio**2, rel=1e-3)
    assert hip.corner_speed / knee.corner_speed == pytest.approx(ratio, rel=1e-3)
    # unitree_rl_lab's test of the motor: its corner lies on the line.
    _, greatest = torque_limits(13.5, hip.stall_torque, hip.no_load_speed, hip.effort_limit)
    assert float(greatest) == pytest.approx(20.2, abs=0.05)


def test_a_drive_has_a_flat_limit_a_corner_and_a_no_load_speed(tmp_path: Path) -> None:
    robot = drive_of(tmp_path, "corner_speed: 4.0", "no_load_speed: 10.0", "effort_limit: 12.0")
    drive = robot.joints[0].drive
    assert drive.corner_speed == pytest.approx(4.0)
    speeds = np.array([0.0, 3.9, 7.0, 10.0, -5.0])
    low, high = torque_limits(speeds, drive.stall_torque, drive.no_load_speed, drive.effort_limit)
    assert high == pytest.approx([12.0, 12.0, 6.0, 0.0, 12.0])
    assert low == pytest.approx([-12.0, -12.0, -12.0, -12.0, -10.0])
    # The straight line from standstill on is a corner at rest.
    line = drive_of(tmp_path, "corner_speed: 0.0", "no_load_speed: 10.0", "effort_limit: 12.0")
    assert line.joints[0].drive.stall_torque == 12.0
    assert line.joints[0].drive.corner_speed == 0.0


@pytest.mark.parametrize(
    ("entries", "word"),
    [
        (("corner_speed: 10.0", "no_load_speed: 10.0"), "above"),
        (("corner_speed: 4.0",), "no_load_speed"),
        (("corner_speed: 4.0", "no_load_speed: 10.0", "stall_torque: 30.0"), "stall_torque"),
        (("corner_speed: 4.0", "torque_constant: 0.1", "resistance: 0.2"), "constants"),
        (("corner_speed: -1.0", "no_load_speed: 10.0"), "corner_speed"),
    ],
)
def test_a_corner_that_contradicts_the_line_is_refused(
    tmp_path: Path, entries: tuple[str, ...], word: str
) -> None:
    with pytest.raises(RobotError, match=word):
        drive_of(tmp_path, "effort_limit: 12.0", *entries)


@pytest.mark.parametrize("number", [".inf", "-.inf", ".nan"])
@pytest.mark.parametrize("key", ["effort_limit", "no_load_speed", "frictionloss", "gear_ratio"])
def test_a_drive_with_a_number_that_is_not_finite_is_refused(
    tmp_path: Path, key: str, number: str
) -> None:
    entries = {"effort_limit": "12.0", "stall_torque": "30.0", "no_load_speed": "10.0"}
    entries[key] = number
    lines = [f"{name}: {value}" for name, value in entries.items()]
    with pytest.raises(RobotError) as refusal:
        drive_of(tmp_path, *lines)
    sentence = str(refusal.value)
    assert str(tmp_path / "robot.yaml") in sentence
    assert f"drives.motor.{key} is {number.replace('.', '')}" in sentence
    assert "finite" in sentence
    drive = load_robot("go2").joint("FR_knee").drive
    with pytest.raises(RobotError, match=key):
        replace(drive, **{key: float(number.replace(".", ""))})


def test_the_tilt_of_a_hung_robot_may_be_infinite(tmp_path: Path) -> None:
    robot = drive_of(tmp_path, "effort_limit: 12.0", "stall_torque: 30.0", "no_load_speed: 10.0")
    assert np.isfinite(robot.limits.tilt)
    with (tmp_path / "robot.yaml").open("a") as file:
        file.write("\nlimits: {tilt: .inf}\n")
    assert load_robot(tmp_path / "robot.yaml").limits.tilt == np.inf


def drive_of(folder: Path, *entries: str) -> RobotSpec:
    """Write a robot of one joint whose drive has these entries, and read it."""
    (folder / "arm.xml").write_text(
        "<mujoco><worldbody><body name='link'><joint name='elbow' type='hinge' axis='0 1 0' "
        "range='-1 1' limited='true'/><geom type='capsule' fromto='0 0 0 0 0 -.2' size='.02' "
        "mass='.3'/></body></worldbody><compiler angle='radian'/></mujoco>"
    )
    lines = [
        "schema: pronk/robot/1",
        "name: arm",
        "model: arm.xml",
        "drives:",
        "  motor:",
        *(f"    {entry}" for entry in entries),
        "groups:",
        "  elbow: {drive: motor, stiffness: 5.0, damping: 0.1, band_hz: [0.5, 5.0]}",
        "poses:",
        "  default: {elbow: 0.0}",
    ]
    (folder / "robot.yaml").write_text("\n".join(lines))
    return load_robot(folder / "robot.yaml")


@pytest.mark.parametrize(
    ("name", "total", "legs"),
    [
        # An original leg is .54 + .634 + .064 kg and two rotors of .055 kg; the third the trunk's.
        ("mini_cheetah", 12.0, ("FR", "FL", "HR", "HL")),
        ("go2", 6.921 + 4 * (0.678 + 1.152 + 0.154 + 0.04), ("FR", "FL", "RR", "RL")),
        ("so101", 0.632006, ()),
    ],
)
def test_mass_and_order_of_legs(name: str, total: float, legs: tuple[str, ...]) -> None:
    assert MODELS[name].body_mass.sum() == pytest.approx(total, abs=1e-6)
    if legs:
        names: list[str] = []
        for leg in legs:
            names += [f"{leg}_hip_roll", f"{leg}_hip_pitch", f"{leg}_knee"]
        assert load_robot(name).joint_names == tuple(names)


@pytest.mark.parametrize(
    ("name", "hip", "ahead", "side"),
    [("mini_cheetah", "hip", 0.015, 0.049 + 0.062 + 0.004), ("go2", "thigh", 0.003, 0.142)],
)
def test_feet_are_under_the_hips_and_on_the_floor(
    name: str, hip: str, ahead: float, side: float
) -> None:
    data = posed(MODELS[name])
    body = legged(name)
    for leg in body.legs:
        x = data.body(f"{leg}_{hip}").xpos[0]
        outwards = side if leg.endswith("L") else -side
        foot = data.site(f"{leg}_foot").xpos
        assert foot[0] == pytest.approx(x, abs=ahead)
        assert foot[1:] == pytest.approx((outwards, body.foot_radius), abs=1e-9)
        if name == "mini_cheetah":
            assert data.body(f"{leg}_shank").xpos[0] < x - 0.1, "knees bend backward"
    if name == "mini_cheetah":
        assert data.body("trunk").xpos[2] == pytest.approx(0.30, abs=0.005)  # S1


def test_the_whole_robot_is_symmetric_about_its_middle_plane() -> None:
    model = MODELS["mini_cheetah"]
    data = posed(model)
    assert data.subtree_com[0][1] == pytest.approx(0.0, abs=1e-15)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    # Mirroring maps R to L joints, flips y, roll and yaw of the trunk and every hip_roll.
    names = load_robot("mini_cheetah").joint_names
    swap = [0, 1, 2, 3, 4, 5]
    for index in (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8):
        swap.append(model.joint(names[index]).dofadr[0])
    sign = np.array([1, -1, 1, -1, 1, -1, *([-1, 1, 1] * 4)])
    mirrored = (sign[:, None] * full * sign)[np.ix_(swap, swap)]
    np.testing.assert_allclose(mirrored, full, atol=1e-15)


def test_only_feet_legs_and_trunk_touch_a_floor_and_never_each_other() -> None:
    spec = free_spec(load_robot("mini_cheetah"))
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1.0, 1.0, 0.1), pos=(0, 0, 0.5)
    )
    model = spec.compile()
    touching = set()
    for contact in posed(model).contact:
        names = {model.geom(index).name for index in contact.geom}
        assert "floor" in names
        touching |= names
        if "FR_foot_collision" in names:
            assert contact.dim == 3
    expected = {"floor", "trunk_collision"}
    for leg in CHEETAH.legs:
        expected |= {f"{leg}_thigh_collision", f"{leg}_shank_collision", f"{leg}_foot_collision"}
    assert touching == expected


def test_so101_gravity_sag_agrees_with_the_recorded_offsets() -> None:
    """The evidence for the signs of SAGE recordings: sag over gravity torque is one stiffness."""
    model = MODELS["so101"]
    bias = posed(model).qfrc_bias
    gravity = {}
    for joint in load_robot("so101").joint_names:
        gravity[joint] = -bias[model.joint(joint).dofadr[0]]
    sag = {"Pitch": 0.038, "Elbow": 0.037, "Wrist_Pitch": 0.010}  # means of the four recordings
    for name, offset in sag.items():
        assert 9.0 < gravity[SAGE_JOINTS[name]] / offset < 14.0
    assert abs(gravity["shoulder_pan"]) < 1e-3
    assert abs(gravity["wrist_roll"]) < 1e-3


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("negated: .*", "negated: []", "FL_hip_roll"),
        ("drive: knee", "drive: ankle", "ankle"),
        (r"\*_knee", "*_ankle", "knee"),
        ("gear_ratio: 9.33", "gear_ratio: -1.0", "gear_ratio"),
        ("base_body: trunk", "base_body: chest", "chest"),
        ("  default:", "  home:", "default"),
        ("hip_pitch: -0.8", "hip_pitch: -4.0", "FR_hip_pitch at -4 rad"),
        ("model: mini_cheetah.xml", "model: other.xml", "other.xml"),
        ("policy_rate_hz: 50.0", "policy_rate_hz: 100.0", "policy_rate_hz"),
        ("decimation: 4 ", "decimation: 7 ", "decimation"),
        (r"band_hz: \[0.1, 15.0\]", "band_hz: [15.0, 0.1]", "band_hz"),
    ],
)
def test_inconsistent_file_names_the_entry(old: str, new: str, named: str, tmp_path: Path) -> None:
    folder = Path(pronk.robots.__file__).parent / "mini_cheetah"
    (tmp_path / "mini_cheetah.xml").write_text((folder / "mini_cheetah.xml").read_text())
    (tmp_path / "robot.yaml").write_text(re.sub(old, new, (folder / "robot.yaml").read_text()))
    with pytest.raises(RobotError, match=named):
        load_robot(tmp_path)


def test_a_robot_is_read_again_when_its_model_has_changed(tmp_path: Path) -> None:
    source = Path(str(robot_file_path("go2"))).parent
    file = tmp_path / "robot.yaml"
    file.write_text((source / "robot.yaml").read_text())
    model = tmp_path / "go2.xml"
    model.write_text((source / "go2.xml").read_text())
    assert load_robot(file).joint("FR_hip_roll").range == pytest.approx((-1.0472, 1.0472))
    model.write_text(model.read_text().replace('range="-1.0472 1.0472"', 'range="-0.5 0.4"'))
    os.utime(model, ns=(1, 1))
    assert load_robot(file).joint("FR_hip_roll").range == pytest.approx((-0.5, 0.4))
    model.unlink()
    with pytest.raises(RobotError, match="no such file"):
        load_robot(file)


def test_dimensions_of_legs_are_read_again_when_a_file_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = robot_file_path("go2").parent
    file = tmp_path / "robot.yaml"
    file.write_text((source / "robot.yaml").read_text())
    model = tmp_path / "go2.xml"
    model.write_text((source / "go2.xml").read_text())
    assert legged(file) == legged("go2")
    file.write_text(file.read_text().replace("hip_pitch: 0.9,", "hip_pitch: 0.85,"))
    os.utime(file, ns=(1, 1))
    assert legged(file).default_position["hip_pitch"] == 0.85
    model.write_text(model.read_text().replace('size="0.022"', 'size="0.03"'))
    os.utime(model, ns=(1, 1))
    assert legged(file).foot_radius == 0.03
    # The same relative path is another robot in another folder.
    other = tmp_path / "other"
    shutil.copytree(source, other)
    monkeypatch.chdir(tmp_path)
    assert legged("robot.yaml").foot_radius == 0.03
    monkeypatch.chdir(other)
    assert legged("robot.yaml").foot_radius == 0.022


def test_a_robot_is_shown_in_one_line() -> None:
    text = repr(load_robot("so101"))
    assert "so101" in text
    assert len(text) < 100
