"""The robots are what their sources say, and their models hold together."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

import pronk.robots
from pronk.errors import RobotError
from pronk.logs.sage_reader import SAGE_JOINTS
from pronk.robots import ROBOT_NAMES, load_robot
from pronk.robots.legged import legged
from pronk.robots.model import free_spec

CHEETAH = legged("mini_cheetah")


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return free_spec(load_robot("mini_cheetah")).compile()


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
    model = free_spec(robot).compile()
    for joint in robot.joints:
        hinge = model.joint(joint.name)
        np.testing.assert_allclose(hinge.range, joint.range)
        assert model.jnt_limited[hinge.id]
        low, high = joint.range
        assert low < joint.default_position < high
        assert model.dof_armature[hinge.dofadr[0]] == joint.drive.armature
        assert model.dof_frictionloss[hinge.dofadr[0]] == joint.drive.frictionloss
        assert model.dof_damping[hinge.dofadr[0]] == joint.drive.viscous_damping
    assert model.opt.timestep == robot.timestep_s
    assert robot.timestep_s * robot.decimation * robot.policy_rate_hz == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "armature", "effort", "stall", "free"),
    [
        # S6 and A12 of the paper; stall torque and no-load speed of the open software.
        ("mini_cheetah", (0.0026, 0.0063), (17.0, 26.4), (62.4, 97.1), (40.0, 25.7)),
        ("go2", (0.01, 0.0225), (23.7, 35.55), (23.7, 35.55), (30.1, 20.07)),
    ],
)
def test_drives_have_the_published_figures(
    name: str,
    armature: tuple[float, ...],
    effort: tuple[float, ...],
    stall: tuple[float, ...],
    free: tuple[float, ...],
) -> None:
    drives = [load_robot(name).joint(joint).drive for joint in ("FR_hip_pitch", "FR_knee")]
    assert [drive.armature for drive in drives] == pytest.approx(armature, abs=5e-5)
    assert [drive.effort_limit for drive in drives] == pytest.approx(effort, abs=0.05)
    assert [drive.stall_torque for drive in drives] == pytest.approx(stall, abs=0.05)
    assert [drive.no_load_speed for drive in drives] == pytest.approx(free, abs=0.05)


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
    robot = load_robot(name)
    assert free_spec(robot).compile().body_mass.sum() == pytest.approx(total, abs=1e-6)
    if legs:
        assert robot.joint_names[::3] == tuple(f"{leg}_hip_roll" for leg in legs)
        assert robot.joint_names[:3] == ("FR_hip_roll", "FR_hip_pitch", "FR_knee")


def test_feet_of_go2_are_under_the_hips_and_on_the_floor() -> None:
    model = free_spec(load_robot("go2")).compile()
    data = posed(model)
    for leg in ("FR", "FL", "RR", "RL"):
        foot, hip = data.site(f"{leg}_foot").xpos, data.body(f"{leg}_thigh").xpos
        assert foot[0] == pytest.approx(hip[0], abs=0.003)
        assert foot[1:] == pytest.approx((hip[1], 0.022), abs=1e-9)


def test_it_stands_thirty_centimetres_tall_on_feet_below_its_hips(model: mujoco.MjModel) -> None:
    data = posed(model)
    assert data.body("trunk").xpos[2] == pytest.approx(0.30, abs=0.005)  # S1
    for leg in CHEETAH.legs:
        hip, knee, foot = (
            data.body(f"{leg}_hip").xpos,
            data.body(f"{leg}_shank").xpos,
            data.site(f"{leg}_foot").xpos,
        )
        assert abs(foot[0] - hip[0]) < 0.015
        assert knee[0] < hip[0] - 0.1, "knees bend backward"
        assert foot[2] == pytest.approx(CHEETAH.foot_radius, abs=1e-12), "feet touch the floor"
        side = 1.0 if leg.endswith("L") else -1.0
        assert side * foot[1] == pytest.approx(0.049 + 0.062 + 0.004)


def test_the_whole_robot_is_symmetric_about_its_middle_plane(model: mujoco.MjModel) -> None:
    data = posed(model)
    assert data.subtree_com[0][1] == pytest.approx(0.0, abs=1e-15)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    # Mirroring maps R to L joints, flips y, roll and yaw of the trunk and every hip_roll.
    order = [model.joint(n).dofadr[0] for n in load_robot("mini_cheetah").joint_names]
    swap = [0, 1, 2, 3, 4, 5, *(order[i] for i in (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8))]
    sign = np.array([1, -1, 1, -1, 1, -1, *([-1, 1, 1] * 4)])
    mirrored = (sign[:, None] * full * sign)[np.ix_(swap, swap)]
    np.testing.assert_allclose(mirrored, full, atol=1e-15)


def test_only_feet_legs_and_trunk_touch_a_floor_and_never_each_other() -> None:
    spec = free_spec(load_robot("mini_cheetah"))
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1.0, 1.0, 0.1), pos=(0, 0, 0.5)
    )
    model = spec.compile()
    data = posed(model)
    touching = {model.geom(g).name for pair in data.contact.geom for g in pair}
    expected = {"floor", "trunk_collision"}
    expected |= {f"{leg}_{part}_collision" for leg in CHEETAH.legs for part in ("thigh", "shank")}
    expected |= {f"{leg}_foot_collision" for leg in CHEETAH.legs}
    assert touching == expected
    assert all("floor" in {model.geom(g).name for g in pair} for pair in data.contact.geom)
    foot = [c for c in data.contact if "FR_foot_collision" in {model.geom(g).name for g in c.geom}]
    assert {c.dim for c in foot} == {3}


def test_so101_gravity_sag_agrees_with_the_recorded_offsets() -> None:
    """The evidence for the signs of SAGE recordings: sag over gravity torque is one stiffness."""
    robot = load_robot("so101")
    model = free_spec(robot).compile()
    data = posed(model)
    gravity = -data.qfrc_bias
    sag = {"Pitch": 0.038, "Elbow": 0.037, "Wrist_Pitch": 0.010}  # means of the four recordings
    stiffness = [
        gravity[model.joint(SAGE_JOINTS[name]).dofadr[0]] / offset for name, offset in sag.items()
    ]
    assert all(9.0 < k < 14.0 for k in stiffness)
    assert abs(gravity[model.joint("shoulder_pan").dofadr[0]]) < 1e-3
    assert abs(gravity[model.joint("wrist_roll").dofadr[0]]) < 1e-3


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
    ],
)
def test_inconsistent_file_names_the_entry(old: str, new: str, named: str, tmp_path: Path) -> None:
    folder = Path(pronk.robots.__file__).parent / "mini_cheetah"
    (tmp_path / "mini_cheetah.xml").write_text((folder / "mini_cheetah.xml").read_text())
    (tmp_path / "robot.yaml").write_text(re.sub(old, new, (folder / "robot.yaml").read_text()))
    with pytest.raises(RobotError, match=named):
        load_robot(tmp_path)
