"""Motion and observations against MuJoCo and SciPy: values, places in the vectors, noise."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

pytest.importorskip("mjlab")

import torch
from torch import Tensor

import training_env
from parts import where
from pronk.arrays import Array
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.mdp.observations import CRITIC, CRITIC_JUMP
from pronk.policy.observation import ACTOR_INDICES, MEASURED
from pronk.robots.legged import legged
from training_env import MANY, ROBOT, N

pytestmark = pytest.mark.train

BODY = legged("mini_cheetah")
DEFAULT = np.array([joint.default_position for joint in ROBOT.joints])


@pytest.fixture
def env() -> Any:
    built = training_env.fresh(training_env.nominal(), scripted=True)
    motion_command(built).velocity[:] = torch.rand(N, 3)
    return built


def ids(env: Any, element: str, pattern: str) -> list[int]:
    """Return the ids of a part of every leg in the model."""
    named = getattr(env.sim.mj_model, element)
    return [named(f"robot/{leg}_{pattern}").id for leg in BODY.legs]


def rotations(qpos: Any) -> Rotation:
    """Return the attitudes of the trunks."""
    return Rotation.from_quat(np.float64(qpos[:, 3:7]), scalar_first=True)


def put(env: Any) -> tuple[Array, Array]:
    """Put every robot into a random state; return positions and velocities."""
    qpos = env.sim.data.qpos
    qvel = env.sim.data.qvel
    qpos[:, 3:7] = torch.nn.functional.normalize(torch.randn(env.num_envs, 4), dim=1)
    qpos[:, 7:] += torch.rand(env.num_envs, 12) - 0.5
    qvel[:] = torch.randn(qvel.shape)
    env.sim.forward()
    return state(env)


def state(env: Any) -> tuple[Array, Array]:
    """Return positions and velocities of every robot."""
    qpos = np.float64(env.sim.data.qpos.numpy())
    qvel = np.float64(env.sim.data.qvel.numpy())
    return qpos, qvel


def kept(groups: dict[str, Tensor]) -> dict[str, Tensor]:
    """Copy groups of observations."""
    return {name: group.clone() for name, group in groups.items()}


def observe(env: Any) -> dict[str, Tensor]:
    """Return the observations of the present state."""
    return kept(env.observation_manager.compute(update_history=True))


def measured(observation: dict[str, Tensor], name: str) -> Tensor:
    """Return a part of the measured vector."""
    return observation["measured"][:, list(MEASURED[name])]


def close(value: Tensor, expected: Any, atol: float = 1e-5) -> None:
    """Require that a value is the expected one but for rounding."""
    np.testing.assert_allclose(value.numpy(), expected, atol=atol, rtol=1e-5)


# --- Motion --------------------------------------------------------------------------------------


def references(env: Any, qpos: Array, qvel: Array, ctrl: Any = None) -> list[mujoco.MjData]:
    """Return the same states in MuJoCo."""
    states = []
    for i in range(len(qpos)):
        data = mujoco.MjData(env.sim.mj_model)
        data.qpos[:] = qpos[i]
        data.qvel[:] = qvel[i]
        if ctrl is not None:
            data.ctrl[:] = ctrl[i]
        mujoco.mj_forward(env.sim.mj_model, data)
        states.append(data)
    return states


def contacts(data: mujoco.MjData, geoms: list[int]) -> list[float]:
    """Return 1 for each geom that touches something, 0 for the others."""
    touching: set[int] = set()
    for contact in data.contact:
        touching.update(contact.geom.tolist())
    return [float(geom in touching) for geom in geoms]


def test_motion_is_that_of_mujoco(env: Any) -> None:
    """Positions and velocities are of now; derived quantities of one physics step before."""
    for _ in range(4):
        env.step(2.0 * torch.rand(N, 12) - 1.0)
    env.cfg.decimation = 1
    data = env.sim.data
    model = env.sim.mj_model
    qpos, qvel = state(env)
    env.step(torch.rand(N, 12))
    motion = motion_command(env).motion
    legs = motion.legs
    sites = ids(env, "site", "foot")
    balls = ids(env, "geom", "foot_collision")
    knees = ids(env, "joint", "knee")
    hips = ids(env, "joint", "hip_pitch")
    twist = np.zeros(6)
    wrench = np.zeros(6)
    for i, reference in enumerate(references(env, qpos, qvel, data.ctrl.numpy())):
        force = np.zeros((4, 3))
        speed = []
        for k, contact in enumerate(reference.contact):
            mujoco.mj_contactForce(model, reference, k, wrench)
            for geom in contact.geom:
                if geom in balls:
                    world_force = contact.frame.reshape(3, 3).T @ wrench[:3]
                    force[balls.index(geom)] += world_force
        for site in sites:
            mujoco.mj_objectVelocity(model, reference, mujoco.mjtObj.mjOBJ_SITE, site, twist, 0)
            speed.append(twist[3:].copy())
        size = np.linalg.norm(force, axis=1)
        np.testing.assert_array_equal(legs.contact[i], size > 0.0)
        np.testing.assert_allclose(legs.force[i], size, rtol=0.02, atol=0.5)
        close(legs.foot_height[i], reference.site_xpos[sites, 2] - 0.0175)
        close(legs.foot_position[i], reference.site_xpos[sites, :2])
        close(legs.knee_height[i], reference.xanchor[knees, 2])
        close(legs.foot_velocity[i], speed, atol=1e-4)
        close(motion.joints.torque[i], reference.qfrc_actuator[6:], atol=1e-4)
    assert 0.0 < legs.contact.float().mean() < 1.0
    qpos, qvel = state(env)
    trunk = rotations(qpos)
    x, y, _ = trunk.apply([1.0, 0.0, 0.0]).T
    heading = Rotation.from_euler("z", np.arctan2(y, x)[:, None])
    close(motion.joints.position, qpos[:, 7:])
    close(motion.joints.velocity, qvel[:, 6:])
    close(motion.trunk.height, qpos[:, 2])
    close(motion.trunk.velocity_world, qvel[:, :3])
    close(motion.trunk.velocity_heading, heading.inv().apply(qvel[:, :3])[:, :2])
    close(motion.trunk.angular_velocity, qvel[:, 3:6])
    close(motion.trunk.gravity, trunk.inv().apply([0.0, 0.0, -1.0]))
    close(motion.trunk.heading, heading.apply([1.0, 0.0, 0.0])[:, :2])
    # In the leg's plane: the foot is beside it by as much as the knee.
    for i, reference in enumerate(references(env, qpos, qvel)):
        far = np.linalg.norm(reference.site_xpos[sites] - reference.xanchor[hips], axis=1)
        close(legs.length[i], np.sqrt(far**2 - 0.004**2))


def test_changes_are_since_the_step_before(env: Any) -> None:
    """Of a robot that begins an episode, since zero. Each step is measured once."""
    command = motion_command(env)
    command.jump[:] = True
    for _ in range(2):
        env.step(2.0 * torch.rand(N, 12) - 1.0)
    before = command.motion
    torque = before.joints.torque.clone()
    foot_velocity = before.legs.foot_velocity.clone()
    unchanged = [
        before.trunk.height,
        before.trunk.gravity,
        before.legs.foot_position,
        before.legs.knee_height,
        before.legs.length,
    ]
    copies = [value.clone() for value in unchanged]
    assert command.motion is before
    assert command.state.since.tolist() == pytest.approx([0.04] * N)
    env.reset(env_ids=torch.tensor([2]))
    env.step(2.0 * torch.rand(N, 12) - 1.0)
    after = command.motion
    torque[2] = 0.0
    foot_velocity[2] = 0.0
    assert torch.equal(after.joints.torque_change, after.joints.torque - torque)
    velocity_change = after.legs.foot_velocity - foot_velocity
    assert torch.equal(after.legs.foot_velocity_change, velocity_change)
    for value, copy in zip(unchanged, copies, strict=True):
        assert torch.equal(value, copy), "a copy"


def test_non_foot_contacts_are_counted(env: Any) -> None:
    """Upside down: the trunk; thighs level and shanks folded: knees and trunk; standing."""
    poses = [
        (0.04, 0.0, 1.0, 0.0, 0.0, *(0.0, 0.0, 0.0) * 4),
        (0.03, 1.0, 0.0, 0.0, 0.0, *(0.0, -1.6, 2.5) * 4),
        (0.299, 1.0, 0.0, 0.0, 0.0, *(0.0, -0.8, 1.6) * 4),
    ]
    env.sim.data.qpos[:3, 2:] = torch.tensor(poses)
    env.sim.data.qvel.zero_()
    env.cfg.decimation = 1
    parts = [env.sim.mj_model.geom("robot/trunk_collision").id]
    parts += ids(env, "geom", "thigh_collision") + ids(env, "geom", "shank_collision")
    states = references(env, state(env)[0][:3], np.zeros((3, 18)))
    expected = [sum(contacts(data, parts)) for data in states]
    env.step(torch.zeros(N, 12))
    assert expected[::2] == [1.0, 0.0]
    assert expected[1] >= 5.0
    assert motion_command(env).motion.non_foot_contacts[:3].tolist() == expected


# --- Measured vector -----------------------------------------------------------------------------


def test_layout_of_the_measured_vector(env: Any) -> None:
    """Written out once more, since policies depend on it; histories run from old to new."""
    positions = []
    velocities = []
    actions = []
    for _ in range(4):
        actions.append(torch.rand(N, 12) - 0.5)
        groups = kept(env.step(actions[-1])[0])
        qpos, qvel = state(env)
        positions.append(qpos[:, 7:] - DEFAULT)
        velocities.append(qvel[:, 6:])
    seen = groups["measured"]
    assert seen.shape == (N, 105)
    close(seen[:, 0:3], qvel[:, 3:6])
    close(seen[:, 3:6], rotations(qpos).inv().apply([0.0, 0.0, -1.0]))
    close(seen[:, 6:42], np.hstack(positions[-3:]))
    close(seen[:, 42:78], np.hstack(velocities[-3:]))
    close(seen[:, 78:102], np.hstack(actions[-2:]))
    close(seen[:, 102:105], motion_command(env).velocity)
    now = np.hstack([qpos[:, 7:] - DEFAULT, qvel[:, 6:], actions[-1]])
    close(seen[:, list(ACTOR_INDICES)][:, 9:], now)
    # A new episode begins with the present as its past; the other robots' histories stay.
    anew = env.reset(env_ids=torch.tensor([4]))[0]
    close(measured(anew, "joint_position")[4], np.tile(state(env)[0][4, 7:] - DEFAULT, 3))
    close(measured(anew, "action")[4], 0.0)
    running = torch.arange(N) != 4
    for name in ("joint_position", "joint_velocity", "action"):
        assert torch.equal(measured(anew, name)[running], measured(groups, name)[running])


def test_noise_is_uniform_and_on_the_measured_vector_alone() -> None:
    """D7 to D10: drawn anew for every number of every measurement, which keeps it in histories."""
    env = training_env.fresh(training_env.randomized(), scripted=True)
    widths = {
        "joint_position": 0.05,
        "joint_velocity": 0.5,
        "angular_velocity": 0.2,
        "projected_gravity": 0.05,
    }
    errors: dict[str, list[Array]] = {name: [] for name in widths}
    for _ in range(5):
        qpos, qvel = put(env)
        first = observe(env)
        second = observe(env)
        exact = {
            "angular_velocity": qvel[:, 3:6],
            "projected_gravity": rotations(qpos).inv().apply([0.0, 0.0, -1.0]),
            "joint_position": qpos[:, 7:] - DEFAULT,
            "joint_velocity": qvel[:, 6:],
        }
        for name, value in exact.items():
            size = value.shape[1]
            for seen in (first, second):
                errors[name].append(measured(seen, name)[:, -size:].numpy() - value)
            if measured(first, name).shape[1] > size:
                then = measured(second, name)[:, -2 * size : -size]
                assert torch.equal(then, measured(first, name)[:, -size:])
        for name in ("jump", "critic", "critic_jump", "estimator_target"):
            assert torch.equal(first[name], second[name])
        assert torch.equal(measured(first, "command"), motion_command(env).velocity)
    for name, width in widths.items():
        noise = np.concatenate(errors[name]) / width
        assert np.abs(noise).max() <= 1.0 + 1e-4
        assert kstest(noise.ravel(), "uniform", args=(-1.0, 2.0)).pvalue > 1e-3
        correlation = np.corrcoef(noise, rowvar=False)[np.triu_indices(noise.shape[1], 1)]
        assert np.abs(correlation).max() < 5.0 / np.sqrt(10 * MANY)


# --- Critic and estimator ------------------------------------------------------------------------


def test_layout_of_the_critic_vector(env: Any) -> None:
    command = motion_command(env)
    action = torch.rand(N, 12)
    env.action_manager.process_action(action)
    qpos, qvel = put(env)
    command.time_left[:] = torch.arange(N) / 4
    seen = observe(env)
    trunk = rotations(qpos)
    feet = ids(env, "site", "foot")
    force = env.scene["feet"].data.force.norm(dim=-1)
    foot_height = []
    for reference in references(env, qpos, qvel):
        foot_height.append(reference.site_xpos[feet, 2])
    expected = {
        "angular_velocity": qvel[:, 3:6],
        "projected_gravity": trunk.inv().apply([0.0, 0.0, -1.0]),
        "command": command.velocity,
        "time_left": np.arange(N)[:, None] / 4,
        "joint_position": qpos[:, 7:] - DEFAULT,
        "joint_velocity": qvel[:, 6:],
        "action": action,
        "linear_velocity": trunk.inv().apply(qvel[:, :3]),
        "height": qpos[:, 2:3],
        "foot_contact": seen["estimator_target"][:, :4],
        "foot_force": force / (12.0 * 9.81),
        "foot_height": foot_height,
        # Nominal.
        "voltage": 1.0,
        "no_load": 1.0,
        "drop": 0.0,
        "friction": env.sim.mj_model.geom("robot/FR_foot_collision").friction[0],
        "base_mass": BODY.base_mass,
        "delay": 0.0,
        "shank_length": BODY.shank_length,
        "stiffness": 17.0,
        "damping": 0.4,
    }
    assert list(expected) == list(CRITIC)
    for name, value in expected.items():
        close(seen["critic"][:, where(CRITIC, name)], value)
    close(seen["estimator_target"][:, 4:], trunk.inv().apply(qvel[:, :3]))


@pytest.mark.parametrize("resets", [False, True])
def test_contacts_are_those_of_the_present_state(env: Any, resets: bool) -> None:
    """Whether or not another robot's episode ends."""
    seen = []
    expected = []
    for _ in range(6):
        if resets:
            env.episode_length_buf[0] = 10**6
        groups = env.step(2.0 * torch.rand(N, 12) - 1.0)[0]
        seen.append(groups["estimator_target"][1:, :4])
        assert torch.equal(groups["critic"][1:, where(CRITIC, "foot_contact")], seen[-1])
        qpos, qvel = state(env)
        feet = ids(env, "geom", "foot_collision")
        robots = []
        for reference in references(env, qpos[1:], qvel[1:]):
            robots.append(contacts(reference, feet))
        expected.append(robots)
    close(torch.stack(seen), expected)
    assert 0.1 < np.mean(expected) < 0.9


def test_layout_of_the_critic_jump_vector() -> None:
    env = training_env.fresh(training_env.nominal(), "jump_a", scripted=True)
    command = motion_command(env)
    command.jump[:] = torch.arange(N) % 2 == 0
    expected = []
    for i, name in enumerate(CRITIC_JUMP):
        value = getattr(command.state if hasattr(command.state, name) else command, name)
        if hasattr(command.state, name):
            value[:] = torch.arange(N) / N + i if value.dtype != torch.bool else torch.arange(N) < i
        expected.append(value.float())
    seen = observe(env)
    close(seen["jump"][:, 0], [1.0, 0.0] * (N // 2))
    close(seen["critic_jump"], torch.stack(expected, dim=1))
