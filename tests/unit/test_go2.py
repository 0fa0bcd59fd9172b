"""The Go2 is what its sources say, and fits behind Unitree's messages as it is."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from pronk.robots import load_robot
from pronk.robots.model import bench_spec, free_spec

GO2 = load_robot("go2")


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return free_spec(GO2).compile()


def test_mass_is_the_sum_of_unitrees_parts(model: mujoco.MjModel) -> None:
    leg = 0.678 + 1.152 + 0.154 + 0.04
    assert model.body_mass.sum() == pytest.approx(6.921 + 4 * leg, abs=1e-9)


def test_joints_are_in_the_order_of_the_motors() -> None:
    assert GO2.joint_names[:4] == ("FR_hip_roll", "FR_hip_pitch", "FR_knee", "FL_hip_roll")
    assert [name[:2] for name in GO2.joint_names[::3]] == ["FR", "FL", "RR", "RL"]


def test_model_has_the_robots_hinges(model: mujoco.MjModel) -> None:
    for joint in GO2.joints:
        hinge = model.joint(joint.name)
        np.testing.assert_allclose(hinge.range, joint.range)
        low, high = joint.range
        assert low < joint.default_position < high
        assert model.dof_armature[hinge.dofadr[0]] == joint.drive.armature


def test_feet_are_under_the_hips_and_on_the_floor(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("default").id)
    mujoco.mj_forward(model, data)
    for leg in ("FR", "FL", "RR", "RL"):
        foot, hip = data.site(f"{leg}_foot").xpos, data.body(f"{leg}_thigh").xpos
        assert foot[0] == pytest.approx(hip[0], abs=0.003)
        assert foot[1] == pytest.approx(hip[1], abs=1e-9)
        assert foot[2] == pytest.approx(0.022, abs=1e-9)


def test_drives_have_the_published_limits() -> None:
    hip, knee = GO2.joint("FR_hip_pitch").drive, GO2.joint("FR_knee").drive
    assert hip.armature == pytest.approx(0.01)
    assert knee.armature == pytest.approx(0.0225)
    assert (hip.effort_limit, knee.effort_limit) == (23.7, 35.55)
    # The straight line is that of the torque constant and resistance given.
    for drive in (hip, knee):
        emf = 2.0 * drive.gear_ratio * drive.torque_constant * drive.no_load_speed
        stall = 1.5 * drive.gear_ratio * drive.torque_constant * drive.bus_voltage
        assert emf == pytest.approx(drive.bus_voltage)
        assert stall / drive.resistance == pytest.approx(drive.stall_torque)


@pytest.mark.parametrize("name", ["FL_hip_roll", "RR_hip_roll", "RL_hip_pitch", "RL_knee"])
def test_other_legs_mirror_the_front_right_one(name: str) -> None:
    """Let fall on the bench for .1 s from the default pose, held by the drives."""
    original, sign = GO2.joint(name).original
    moved = []
    for joint, factor in ((name, 1.0), (original, sign)):
        model = bench_spec(GO2, joint).compile()
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_step(model, data, 20)
        moved.append(factor * data.joint(joint).qpos[0])
    assert moved[0] == pytest.approx(moved[1], abs=1e-9)
    assert moved[0] != GO2.joint(name).default_position


def test_the_map_of_the_motors_is_the_identity() -> None:
    pytest.importorskip("cyclonedds")
    from pronk.links.dds.codec import joint_map

    joints = joint_map(GO2)
    np.testing.assert_array_equal(joints.sign, np.ones(12))
    assert not joints.virtual_only
