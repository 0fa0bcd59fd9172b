"""What is measured of the robots, against MuJoCo's own account of the same state."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pronk.robots.legged import legged

BODY = legged("mini_cheetah")

pytest.importorskip("mjlab")
pytestmark = pytest.mark.train

import torch

import small_env
from pronk.train.mdp.commands import motion_command

Array = NDArray[np.float64]
N = small_env.ROBOTS
LIMBS = ("thigh", "shank")


@pytest.fixture(scope="module")
def built() -> Any:
    return small_env.quiet()


@pytest.fixture
def env(built: Any) -> Any:
    small_env.fresh(built)
    motion_command(built).scripted = True
    return built


def stir(env: Any, steps: int = 4) -> None:
    """Let the robots move, each its own way, and land."""
    for _ in range(steps):
        env.step(2.0 * torch.rand(N, 12) - 1.0)


def test_motion_is_what_mujoco_says(env: Any) -> None:
    """Positions and velocities are of now; what is derived is of one physics step before."""
    stir(env)
    env.cfg.decimation = 1
    data = env.sim.data
    qpos, qvel = (np.float64(value.numpy()) for value in (data.qpos, data.qvel))
    env.step(torch.rand(N, 12))
    motion = motion_command(env).motion
    model = env.sim.mj_model
    foot = [model.site(f"robot/{leg}_foot").id for leg in BODY.legs]
    ball = [model.geom(f"robot/{leg}_foot_collision").id for leg in BODY.legs]
    knee = [model.joint(f"robot/{leg}_knee").id for leg in BODY.legs]
    seen = set()
    for i in range(N):
        reference = mujoco.MjData(model)
        reference.qpos[:], reference.qvel[:] = qpos[i], qvel[i]
        reference.ctrl[:] = data.ctrl[i].numpy()
        mujoco.mj_forward(model, reference)
        height = reference.site_xpos[foot, 2] - 0.0175
        np.testing.assert_allclose(motion.foot_height[i], height, atol=1e-5)
        place = reference.site_xpos[foot, :2]
        np.testing.assert_allclose(motion.foot_position[i], place, atol=1e-5)
        np.testing.assert_allclose(motion.knee_height[i], reference.xanchor[knee, 2], atol=1e-5)
        twist = np.zeros(6)
        for k, site in enumerate(foot):
            mujoco.mj_objectVelocity(model, reference, mujoco.mjtObj.mjOBJ_SITE, site, twist, 0)
            np.testing.assert_allclose(motion.foot_velocity[i, k], twist[3:], atol=1e-4)
        force = contact_force(model, reference, ball)
        np.testing.assert_array_equal(motion.contact[i], np.linalg.norm(force, axis=1) > 0.0)
        size = np.linalg.norm(force, axis=1)
        np.testing.assert_allclose(motion.force[i], size, rtol=0.02, atol=0.5)
        seen |= set(motion.contact[i].tolist())
        np.testing.assert_allclose(motion.torque[i], reference.qfrc_actuator[6:], atol=1e-4)
        # Of now.
        now, speed = (np.float64(value[i].numpy()) for value in (data.qpos, data.qvel))
        trunk = Rotation.from_quat(now[3:7], scalar_first=True)
        for name, value in {
            "position": now[7:],
            "velocity": speed[6:],
            "height": now[2],
            "velocity_world": speed[:3],
            "velocity_heading": heading(trunk).inv().apply(speed[:3])[:2],
            "angular_velocity": speed[3:6],
            "gravity": trunk.inv().apply([0.0, 0.0, -1.0]),
            "heading": heading(trunk).apply([1.0, 0.0, 0.0])[:2],
        }.items():
            np.testing.assert_allclose(getattr(motion, name)[i], value, atol=1e-5, err_msg=name)
    assert seen == {True, False}, "some feet in the air, some on the ground"


def heading(trunk: Rotation) -> Rotation:
    """The turn about the vertical that looks where a trunk does."""
    x, y, _ = trunk.apply([1.0, 0.0, 0.0])
    return Rotation.from_euler("z", np.arctan2(y, x))


def contact_force(model: Any, data: Any, geoms: list[int]) -> Array:
    """The floor's force on each of some geoms, world frame."""
    total = np.zeros((len(geoms), 3))
    wrench = np.zeros(6)
    for i, contact in enumerate(data.contact):
        for k, geom in enumerate(geoms):
            if geom in contact.geom:
                mujoco.mj_contactForce(model, data, i, wrench)
                total[k] += contact.frame.reshape(3, 3).T @ wrench[:3]
    return total


def test_a_robot_that_stands_is_carried_by_its_feet(env: Any) -> None:
    """Knees asked a little further, so that drives this soft hold 12 kg (S1) up for a while."""
    for _ in range(20):
        env.step(torch.tensor([0.0, 0.2, -0.7] * 4).expand(N, 12))
    motion = motion_command(env).motion
    assert motion.contact.all()
    assert not motion.touching.any()
    weight = BODY.total_mass * 9.81
    # The sensor gives the force of the foot on the floor.
    upwards = -env.scene["feet"].data.force[..., 2].sum(dim=-1)
    assert upwards.tolist() == pytest.approx([weight] * N, rel=0.05)
    assert (motion.force.sum(dim=-1) >= upwards).all()
    assert (motion.force.sum(dim=-1) / weight < 1.25).all()
    assert motion.height.tolist() == pytest.approx([0.29] * N, abs=0.04)


def test_changes_are_since_the_step_before(env: Any) -> None:
    command = motion_command(env)
    stir(env, 2)
    before = command.motion
    force, velocity = before.torque.clone(), before.foot_velocity.clone()
    stir(env, 1)
    after = command.motion
    assert torch.equal(after.torque_change, after.torque - force)
    assert torch.equal(after.foot_velocity_change, after.foot_velocity - velocity)
    assert after.torque_change.abs().max() > 1.0
    assert after.foot_velocity_change.abs().max() > 0.1


def test_a_robot_that_starts_anew_has_no_step_before(env: Any) -> None:
    command = motion_command(env)
    stir(env, 2)
    force = command.motion.torque.clone()
    env.reset(env_ids=torch.tensor([2]))
    stir(env, 1)
    after = command.motion
    force[2] = 0.0
    assert torch.equal(after.torque_change, after.torque - force)
    assert torch.equal(after.foot_velocity_change[2], after.foot_velocity[2])
    assert not torch.equal(after.foot_velocity_change[3], after.foot_velocity[3])


def test_measured_once_a_step(env: Any) -> None:
    """The tracker must not see a step twice."""
    command = motion_command(env)
    command.jump[:] = True
    stir(env, 1)
    first = command.motion
    assert command.motion is first
    assert command.tracker.since.tolist() == pytest.approx([0.02] * N)
    stir(env, 1)
    assert command.motion is not first
    assert command.tracker.since.tolist() == pytest.approx([0.04] * N)


def test_what_was_measured_stays_when_physics_goes_on(env: Any) -> None:
    motion = motion_command(env).motion
    before = {name: value.clone() for name, value in vars(motion).items()}
    env.reset(env_ids=torch.tensor([0]))
    stir(env, 1)
    for name in ("height", "gravity", "heading", "foot_position", "foot_height"):
        assert torch.equal(getattr(motion, name), before[name]), name
    for name in ("knee_height", "leg_length"):
        assert torch.equal(getattr(motion, name), before[name]), name


def test_length_of_a_leg_is_that_of_the_model(env: Any) -> None:
    """In the leg's plane: the foot lies beside it by as much as the knee does."""
    stir(env, 3)
    model, motion = env.sim.mj_model, motion_command(env).motion
    reference = mujoco.MjData(model)
    for i in range(N):
        reference.qpos[7:] = motion.position[i]
        mujoco.mj_kinematics(model, reference)
        foot = [model.site(f"robot/{leg}_foot").id for leg in BODY.legs]
        pitch = [model.joint(f"robot/{leg}_hip_pitch").id for leg in BODY.legs]
        reach = np.linalg.norm(reference.site_xpos[foot] - reference.xanchor[pitch], axis=1)
        length = np.sqrt(reach**2 - 0.004**2)
        np.testing.assert_allclose(motion.leg_length[i], length, atol=1e-6)
    assert float(motion.leg_length.std()) > 1e-3, "legs that bend"


def test_parts_other_than_feet_that_touch_are_counted(env: Any) -> None:
    """Robots set upon the floor: which of their parts are below it is geometry."""
    legs = {
        # Upside down, legs up: the trunk alone.
        0: (0.04, (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        # Thighs level, shanks folded under: knees and trunk's belly.
        1: (0.03, (1.0, 0.0, 0.0, 0.0), (0.0, -1.6, 2.5)),
        # Standing.
        2: (0.299, (1.0, 0.0, 0.0, 0.0), (0.0, -0.8, 1.6)),
    }
    qpos = env.sim.data.qpos
    for i, (height, orientation, joints) in legs.items():
        qpos[i, 2] = height
        qpos[i, 3:7] = torch.tensor(orientation)
        qpos[i, 7:] = torch.tensor(joints).repeat(4)
    env.sim.data.qvel[:] = 0.0
    env.cfg.decimation = 1
    model = env.sim.mj_model
    parts = {model.geom("robot/trunk_collision").id}
    parts |= {model.geom(f"robot/{leg}_{x}_collision").id for leg in BODY.legs for x in LIMBS}
    expected = []
    for i in legs:
        reference = mujoco.MjData(model)
        reference.qpos[:] = qpos[i].numpy()
        mujoco.mj_forward(model, reference)
        hit = {int(g) for contact in reference.contact for g in contact.geom}
        expected.append(float(len(hit & parts)))
    env.step(torch.zeros(N, 12))
    found = motion_command(env)._motion.touching[:3].tolist()
    assert found == expected
    assert found[0] == 1.0
    assert found[1] >= 5.0
    assert found[2] == 0.0
