"""Left and right: the mirror image of vectors against the physics of the robot."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from parts import where
from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.robots import load_robot
from pronk.robots.legged import legged
from pronk.robots.model import free_spec
from quadruped_model import write_quadruped

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

from tensordict import TensorDict

from pronk.jump.train.mdp.observations import CRITIC
from pronk.jump.train.rl import symmetry
from pronk.jump.train.rl.symmetry import GROUPS, mirrored, with_mirror_image

pytestmark = pytest.mark.train


ROBOT = load_robot("mini_cheetah")
BODY = legged("mini_cheetah")
DEFAULT = np.array([joint.default_position for joint in ROBOT.joints])


@pytest.mark.parametrize(
    ("parts", "image"),
    [
        # FR, FL, HR, HL times hip_roll, hip_pitch, knee.
        ({"action": 12}, [-4, 5, 6, -1, 2, 3, -10, 11, 12, -7, 8, 9]),
        ({"command": 3, "linear_velocity": 3}, [1, -2, -3, 4, -5, 6]),
        ({"angular_velocity": 3, "projected_gravity": 3}, [-1, 2, -3, 4, -5, 6]),
        ({"drop": 1, "shank_length": 4}, [1, 3, 2, 5, 4]),
        # Of each joint group by leg, without a sign.
        ({"stiffness": 12}, [2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11]),
        # A history keeps its order.
        ({"contact": 8}, [2, 1, 4, 3, 6, 5, 8, 7]),
    ],
)
def test_mirror_by_hand(
    monkeypatch: pytest.MonkeyPatch, parts: dict[str, int], image: list[float]
) -> None:
    group = str(parts)
    monkeypatch.setattr(symmetry, "GROUPS", {group: parts})
    x = torch.arange(1.0, 1.0 + len(image))
    assert mirrored(group, x, BODY).tolist() == image


def test_mirror_of_legs_in_another_order(tmp_path: Path) -> None:
    """Legs LF, LH, RF, RH, as ANYmal's: the sides follow from the model, not from the names."""
    body = legged(write_quadruped(tmp_path / "robot"))
    x = torch.arange(1.0, 13.0)
    image = [-7, 8, 9, -10, 11, 12, -1, 2, 3, -4, 5, 6]
    assert mirrored("action", x, body).tolist() == image


def test_a_batch_and_its_mirror_image(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(symmetry, "motion_command", lambda env: SimpleNamespace(body=BODY))
    env = SimpleNamespace(unwrapped=None)
    groups = {}
    for name, parts in GROUPS.items():
        groups[name] = torch.randn(4, sum(parts.values()))
    observations = TensorDict(groups, batch_size=[4]).exclude("action")
    doubled_observations, doubled_action = with_mirror_image(env, observations, groups["action"])
    doubled = {**doubled_observations.to_dict(), "action": doubled_action}
    for name, group in groups.items():
        image = mirrored(name, group, BODY)
        assert torch.equal(mirrored(name, image, BODY), group)
        assert torch.equal(doubled[name], torch.cat([group, image]))
    assert with_mirror_image(env, None, None) == (None, None)
    with pytest.raises(PronkError, match="odour"):
        with_mirror_image(env, TensorDict({"odour": torch.zeros(2, 1)}, batch_size=[2]), None)


def critic(model: mujoco.MjModel, data: mujoco.MjData, action: Array) -> Array:
    """Return the critic's vector, with the robot's own velocity as the command."""
    to_trunk = data.body("trunk").xmat.reshape(3, 3).T
    force = np.zeros(4)
    wrench = np.zeros(6)
    feet = [model.geom(f"{leg}_foot_collision").id for leg in BODY.legs]
    for i, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, i, wrench)
        for geom in contact.geom:
            if geom in feet:
                force[feet.index(geom)] += np.linalg.norm(wrench[:3])
    velocity = to_trunk @ data.qvel[:3]
    angular = data.qvel[3:6]
    # What is randomized: ones, as of a robot that is its own mirror image.
    ones = {name: np.ones(size) for name, size in CRITIC.items()}
    parts = ones | {
        "angular_velocity": angular,
        "projected_gravity": to_trunk @ np.array([0.0, 0.0, -1.0]),
        "command": np.array([velocity[0], velocity[1], angular[2]]),
        "joint_position": data.qpos[7:] - DEFAULT,
        "joint_velocity": data.qvel[6:],
        "action": action,
        "linear_velocity": velocity,
        "height": data.qpos[2:3],
        "foot_contact": (force > 0.0).astype(float),
        "foot_force": force,
        "foot_height": np.array([data.site(f"{leg}_foot").xpos[2] for leg in BODY.legs]),
    }
    return np.concatenate([parts[name] for name in CRITIC])


def rollout(model: mujoco.MjModel, qpos: Array, qvel: Array, actions: Array) -> Array:
    """Return the critic's vector after each policy step of a robot with PD drives."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    data.qvel[:] = qvel
    seen = []
    for action in actions:
        target = DEFAULT + 0.35 * action
        for _ in range(ROBOT.decimation):
            data.qfrc_applied[6:] = 20.0 * (target - data.qpos[7:]) - 0.45 * data.qvel[6:]
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        seen.append(critic(model, data, action))
    return np.array(seen)


def reflected(group: str, x: Array) -> Array:
    """Mirror in double precision: the mirror only moves numbers and changes signs."""
    return np.asarray(mirrored(group, torch.tensor(x).double(), BODY).numpy())


@pytest.mark.parametrize("seed", range(3))
def test_mirrored_rollout_is_that_of_the_mirror_image(seed: int) -> None:
    spec = free_spec(ROBOT)
    floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE)
    floor.size = (0.0, 0.0, 1.0)
    model = spec.compile()
    # Both sides must be solved to the last bit that matters.
    model.opt.tolerance = 1e-14
    model.opt.iterations = 200
    draw = np.random.default_rng(seed)
    actions = draw.normal(0.0, 0.7, (25, 12))
    joints = draw.normal(0.0, 0.1, 12)
    rates = draw.normal(0.0, 1.0, 12)
    tilt = np.array([1.0, *draw.normal(0.0, 0.1, 3)])
    pose = np.array([0.1, 0.2, 0.33, *tilt / np.linalg.norm(tilt)])
    twist = np.concatenate([draw.normal(0.0, 0.5, 3), draw.normal(0.0, 1.0, 3)])
    seen = rollout(model, np.append(pose, DEFAULT + joints), np.append(twist, rates), actions)
    pose *= (1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0)
    twist *= (1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
    joints = reflected("action", joints)
    rates = reflected("action", rates)
    actions = reflected("action", actions)
    image = rollout(model, np.append(pose, DEFAULT + joints), np.append(twist, rates), actions)
    np.testing.assert_allclose(image, reflected("critic", seen), rtol=0.0, atol=1e-9)
    # The half second had contacts, and was not symmetric by itself.
    assert 0.1 < seen[:, where(CRITIC, "foot_contact")].mean() < 0.99
    assert np.abs(seen - reflected("critic", seen)).max() > 1.0
