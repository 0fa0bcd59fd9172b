"""What the networks read: every number where the layout says, noise only where it belongs."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from pronk.robots.legged import legged

BODY = legged("mini_cheetah")

pytest.importorskip("mjlab")
pytestmark = pytest.mark.train

import torch
from torch import Tensor

import small_env
from pronk.policy import layout
from pronk.robots import load_robot
from pronk.train.mdp.commands import motion_command
from pronk.train.mdp.draws import draws
from pronk.train.mdp.observations import CRITIC, CRITIC_JUMP
from pronk.train.phases import enter_phase, phase

Array = NDArray[np.float64]
N = small_env.ROBOTS
DEFAULT = np.array([joint.default_position for joint in load_robot("mini_cheetah").joints])
NOISE = {
    "joint_position": 0.05,  # D7
    "joint_velocity": 0.5,  # D8
    "angular_velocity": 0.2,  # D9
    "projected_gravity": 0.05,  # D10
}
"""Half-widths."""


@pytest.fixture(scope="module")
def built() -> Any:
    return small_env.quiet()


@pytest.fixture(scope="module")
def built_noisy() -> Any:
    return small_env.noisy()


@pytest.fixture
def env(built: Any) -> Any:
    return scripted(built)


@pytest.fixture
def noisy(built_noisy: Any) -> Any:
    return scripted(built_noisy)


def scripted(env: Any) -> Any:
    small_env.fresh(env)
    command = motion_command(env)
    command.scripted = True
    command.velocity[:] = torch.rand(N, 3)
    return env


def part(vector: Tensor, sizes: dict[str, int], name: str) -> Tensor:
    """A named stretch of a vector."""
    names = list(sizes)
    return vector.split(list(sizes.values()), dim=1)[names.index(name)]


def measured(observation: dict[str, Tensor], name: str) -> Tensor:
    """A part of the measured vector, as the layout has it."""
    return observation["measured"][:, list(layout.MEASURED[name].indices)]


def put(env: Any) -> tuple[Array, Array]:
    """Put every robot into a random state; return positions and velocities."""
    qpos, qvel = env.sim.data.qpos, env.sim.data.qvel
    orientation = torch.randn(N, 4)
    qpos[:, 3:7] = orientation / orientation.norm(dim=1, keepdim=True)
    qpos[:, 7:] += torch.rand(N, 12) - 0.5
    qvel[:] = torch.randn(qvel.shape)
    env.sim.forward()
    return np.float64(qpos.numpy()), np.float64(qvel.numpy())


def observe(env: Any) -> dict[str, Tensor]:
    """A new observation of the present state; histories move on."""
    found = env.observation_manager.compute(update_history=True)
    return {name: group.clone() for name, group in found.items()}


def close(found: Tensor, expected: Any, atol: float = 1e-5) -> None:
    np.testing.assert_allclose(found.numpy(), expected, atol=atol, rtol=1e-5)


# --- Measured -------------------------------------------------------------------------------------


def test_groups_and_their_sizes(env: Any) -> None:
    sizes = {name: group.shape for name, group in observe(env).items()}
    assert sizes == {
        "measured": (N, layout.MEASURED_SIZE),
        "jump": (N, 1),
        "critic": (N, sum(CRITIC.values())),
        "critic_jump": (N, sum(CRITIC_JUMP.values())),
        "target": (N, layout.ESTIMATE_SIZE),
    }
    assert layout.MEASURED_SIZE == 105
    assert all(group.dtype == torch.float32 for group in observe(env).values())


def test_every_number_is_where_the_layout_says(env: Any) -> None:
    """Written out once more, so that the layout itself is held to it: a policy depends on it."""
    states, actions = [], []
    for _ in range(3):
        action = torch.rand(N, 12)
        env.action_manager.process_action(action)
        states.append(put(env))
        actions.append(action.numpy())
        seen = observe(env)["measured"]
    qpos, qvel = states[-1]
    close(seen[:, 0:3], qvel[:, 3:6])
    close(seen[:, 3:6], [Rotation.from_quat(q[[4, 5, 6, 3]]).inv().apply([0, 0, -1]) for q in qpos])
    close(seen[:, 6:42], np.hstack([q[:, 7:] - DEFAULT for q, _ in states]))  # old to new
    close(seen[:, 42:78], np.hstack([v[:, 6:] for _, v in states]))
    close(seen[:, 78:102], np.hstack(actions[1:]))
    close(seen[:, 102:105], motion_command(env).velocity)


def test_gravity_by_hand(env: Any) -> None:
    """Nose 30 degrees down: gravity points forward. Left side 30 up: to the right."""
    turned = Rotation.concatenate(
        [Rotation.from_euler(axis, 30.0, degrees=True) for axis in ("y", "x", "z")]
    )
    turned = turned[:2] * Rotation.identity(2)
    quaternion = torch.tensor(turned.as_quat(scalar_first=True))
    env.sim.data.qpos[:2, 3:7] = quaternion.float()
    env.sim.forward()
    found = measured(observe(env), "projected_gravity")[:3]
    half, rest = 0.5, np.sqrt(0.75)
    close(found, [[half, 0.0, -rest], [0.0, -half, -rest], [0.0, 0.0, -1.0]])


def test_what_a_policy_reads_after_a_step(env: Any) -> None:
    """The state in which a step ends, the two before it, and the actions that led here."""
    positions, velocities, actions = [], [], []
    for _ in range(4):
        action = torch.rand(N, 12) - 0.5
        seen = env.step(action)[0]
        positions.append(env.sim.data.qpos[:, 7:].numpy() - DEFAULT)
        velocities.append(env.sim.data.qvel[:, 6:].numpy().copy())
        actions.append(action.numpy())
    close(measured(seen, "joint_position"), np.hstack(positions[-3:]))
    close(measured(seen, "joint_velocity"), np.hstack(velocities[-3:]))
    close(measured(seen, "action"), np.hstack(actions[-2:]))
    newest = seen["measured"][:, list(layout.ACTOR_INDICES)]
    close(newest[:, 9:21], positions[-1])
    close(newest[:, 21:33], velocities[-1])
    close(newest[:, 33:45], actions[-1])


def test_an_episode_begins_with_the_present_as_its_past(env: Any) -> None:
    for _ in range(3):
        before = env.step(torch.rand(N, 12))[0]
    before = {name: group.clone() for name, group in before.items()}
    seen = env.reset(env_ids=torch.tensor([4]))[0]
    position = env.sim.data.qpos[4, 7:].numpy() - DEFAULT
    close(measured(seen, "joint_position")[4], np.tile(position, 3))
    close(measured(seen, "joint_velocity")[4], np.tile(env.sim.data.qvel[4, 6:].numpy(), 3))
    close(measured(seen, "action")[4], 0.0)
    others = torch.arange(N) != 4
    for name in ("joint_position", "joint_velocity", "action"):
        assert torch.equal(measured(seen, name)[others], measured(before, name)[others])


# --- Noise ----------------------------------------------------------------------------------------


def test_noise_is_uniform_within_its_half_width(noisy: Any) -> None:
    """Drawn anew for every number of every measurement."""
    found: dict[str, list[Array]] = {name: [] for name in NOISE}
    for _ in range(40):
        qpos, qvel = put(noisy)
        gravity = Rotation.from_quat(qpos[:, [4, 5, 6, 3]]).inv().apply([0.0, 0.0, -1.0])
        truth = {
            "angular_velocity": qvel[:, 3:6],
            "projected_gravity": gravity,
            "joint_position": qpos[:, 7:] - DEFAULT,
            "joint_velocity": qvel[:, 6:],
        }
        seen = observe(noisy)
        for name, exact in truth.items():
            newest = measured(seen, name)[:, -exact.shape[1] :]
            found[name].append(newest.numpy() - exact)
    for name, width in NOISE.items():
        noise = np.concatenate(found[name]) / width
        assert np.abs(noise).max() <= 1.0 + 1e-4
        assert kstest(noise.ravel(), "uniform", args=(-1.0, 2.0)).pvalue > 1e-3
        correlation = np.corrcoef(noise, rowvar=False)
        assert np.abs(correlation[np.triu_indices(noise.shape[1], 1)]).max() < 0.25


def test_a_measurement_keeps_its_noise_as_it_grows_old(noisy: Any) -> None:
    seen = [noisy.step(torch.rand(N, 12))[0]["measured"].clone() for _ in range(3)]
    for start in (layout.MEASURED[name].start for name in ("joint_position", "joint_velocity")):
        for age in (1, 2):
            then = seen[2 - age][:, start + 24 : start + 36]
            now = seen[2][:, start + 24 - 12 * age : start + 36 - 12 * age]
            assert torch.equal(now, then)


def test_all_but_the_measurements_is_exact(noisy: Any) -> None:
    action = torch.rand(N, 12)
    noisy.action_manager.process_action(action)
    first = (put(noisy), observe(noisy))[1]
    second = observe(noisy)
    for group in ("jump", "critic", "critic_jump", "target"):
        assert torch.equal(first[group], second[group])
    assert torch.equal(measured(first, "action")[:, -12:], action)
    assert torch.equal(measured(first, "command"), motion_command(noisy).velocity)
    for name in NOISE:
        assert not torch.equal(measured(first, name)[:, -3:], measured(second, name)[:, -3:])


# --- Target and critic ----------------------------------------------------------------------------


def contacts(env: Any) -> Array:
    """Feet that touch the floor in the present state, by MuJoCo's collision. (N, 4)"""
    model = env.sim.mj_model
    feet = [model.geom(f"robot/{leg}_foot_collision").id for leg in BODY.legs]
    found = np.zeros((N, 4))
    for i, q in enumerate(env.sim.data.qpos):
        reference = mujoco.MjData(model)
        reference.qpos[:] = q.numpy()
        mujoco.mj_forward(model, reference)
        touching = {int(geom) for contact in reference.contact for geom in contact.geom}
        found[i] = [foot in touching for foot in feet]
    return found


def test_velocity_that_the_estimator_should_find(env: Any) -> None:
    """Turned into the trunk's frame."""
    qpos, qvel = put(env)
    turned = Rotation.from_quat(qpos[:, [4, 5, 6, 3]])
    close(observe(env)["target"][:, 4:], turned.inv().apply(qvel[:, :3]))


@pytest.mark.parametrize("resets", [False, True], ids=["nobody resets", "another robot resets"])
def test_contacts_that_the_estimator_should_find(env: Any, resets: bool) -> None:
    """Of the state that is measured, whatever becomes of other robots."""
    seen, expected = [], []
    for _ in range(6):
        if resets:
            env.episode_length_buf[0] = 10**6
        group = env.step(2.0 * torch.rand(N, 12) - 1.0)[0]
        seen.append(group["target"][1:, :4])
        assert torch.equal(part(group["critic"], CRITIC, "foot_contact")[1:], seen[-1])
        expected.append(contacts(env)[1:])
    close(torch.cat(seen), np.concatenate(expected))
    assert 0.1 < np.mean(expected) < 0.9


def test_parts_of_the_critic(env: Any) -> None:
    action = torch.rand(N, 12)
    env.action_manager.process_action(action)
    qpos, qvel = put(env)
    motion_command(env).time_left[:] = torch.arange(N) / 4
    everything = observe(env)
    seen = everything["critic"]
    turned = Rotation.from_quat(qpos[:, [4, 5, 6, 3]])
    force = env.scene["feet"].data.force.norm(dim=-1)
    expected = {
        "angular_velocity": qvel[:, 3:6],
        "projected_gravity": turned.inv().apply([0.0, 0.0, -1.0]),
        "command": motion_command(env).velocity,
        "time_left": np.arange(N)[:, None] / 4,
        "joint_position": qpos[:, 7:] - DEFAULT,
        "joint_velocity": qvel[:, 6:],
        "action": action,
        "linear_velocity": turned.inv().apply(qvel[:, :3]),
        "height": qpos[:, 2:3],
        "foot_contact": everything["target"][:, :4],
        "foot_force": force / (12.0 * 9.81),
        "foot_height": foot_heights(env, qpos),
        # Nothing is drawn here; the next test has what is.
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
        close(part(seen, CRITIC, name), value)


def test_the_critic_knows_what_was_drawn() -> None:
    """Stiffness and damping by kind of joint, and of each kind by leg."""
    env = small_env.fresh(small_env.drawn())
    seen = env.step(torch.rand(N, 12) - 0.5)[0]["critic"]
    found = draws(env)
    by_kind = [leg * 3 + joint for joint in range(3) for leg in range(4)]
    expected = {
        "no_load": found["no_load"][:, None],
        "drop": 1e3 * found["drop"][:, None],
        "friction": found["friction"][:, None],
        "base_mass": found["base_mass"][:, None],
        "delay": found["delay"][:, None],
        "shank_length": found["shank_length"],
        "stiffness": found["stiffness"][:, by_kind],
        "damping": found["damping"][:, by_kind],
    }
    for name, value in expected.items():
        close(part(seen, CRITIC, name), value)
        assert name == "delay" or value.std() > 0.0
    left = part(seen, CRITIC, "voltage")
    assert torch.all(left < part(seen, CRITIC, "no_load")), "drives draw a current"
    assert torch.all(left > 0.5)


def foot_heights(env: Any, qpos: Array) -> Array:
    """Of the feet's centres, by MuJoCo."""
    model = env.sim.mj_model
    sites = [model.site(f"robot/{leg}_foot").id for leg in BODY.legs]
    found = []
    for q in qpos:
        reference = mujoco.MjData(model)
        reference.qpos[:] = q
        mujoco.mj_kinematics(model, reference)
        found.append(reference.site_xpos[sites, 2].copy())
    return np.array(found)


def test_critic_of_a_robot_that_stands(env: Any) -> None:
    """Known truth: the feet carry one body weight, their centres a radius above the floor."""
    for _ in range(20):
        seen = env.step(torch.tensor([0.0, 0.2, -0.7] * 4).expand(N, 12))[0]["critic"]
    force = part(seen, CRITIC, "foot_force").sum(dim=1)
    assert force.tolist() == pytest.approx([1.0] * N, abs=0.15)
    close(part(seen, CRITIC, "foot_height"), BODY.foot_radius, atol=0.005)
    close(part(seen, CRITIC, "foot_contact"), 1.0)
    close(part(seen, CRITIC, "height"), 0.29, atol=0.04)


def test_jump_input_and_what_the_critic_reads_of_a_jump(env: Any) -> None:
    enter_phase(env, phase("jump_a"))
    command, tracker = motion_command(env), motion_command(env).tracker
    command.jump[:] = torch.arange(N) % 2 == 0
    tracker.mode[:] = torch.arange(N) < 3
    tracker.since[:] = torch.arange(N) * 0.02
    tracker.airborne[:] = torch.arange(N) == 1
    names = ("best", "stroke", "worth", "lead", "flown", "farthest")
    for i, name in enumerate(names):
        getattr(tracker, name)[:] = torch.arange(N) / N + i
    command._jump_left[:] = torch.arange(N) / 8 + 0.125
    jumper = command._rank < 0.5
    seen = observe(env)
    close(seen["jump"][:, 0], [1.0, 0.0] * (N // 2))
    expected = {
        "jump": [1.0, 0.0] * (N // 2),
        "mode": [1.0] * 3 + [0.0] * (N - 3),
        "since": np.arange(N) * 0.02,
        "airborne": [0.0, 1.0] + [0.0] * (N - 2),
        **{name: np.arange(N) / N + i for i, name in enumerate(names)},
        "jumper": jumper,
        "jump_left": np.where(jumper, np.arange(N) / 8 + 0.125, 0.0),
    }
    assert list(expected) == list(CRITIC_JUMP)
    for name, value in expected.items():
        close(part(seen["critic_jump"], CRITIC_JUMP, name)[:, 0], value)
