"""Left and right: the table of the mirror against the physics of the robot."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from pronk.robots import load_robot
from pronk.robots.legged import legged
from pronk.robots.model import free_spec

BODY = legged("mini_cheetah")

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

from pronk.errors import PronkError
from pronk.train.mdp.observations import CRITIC
from pronk.train.rl.symmetry import ACTION, GROUPS, Mirror, with_mirror_image
from small_ppo import (
    SIZES,
    build,
    observe,
    one_thread,  # noqa: F401
    roll_out,
)

pytestmark = [pytest.mark.train, pytest.mark.usefixtures("one_thread")]

Array = NDArray[np.float64]

ROBOT = load_robot("mini_cheetah")
DEFAULT = np.array([joint.default_position for joint in ROBOT.joints])


@pytest.mark.parametrize("group", [*GROUPS, "action"])
def test_twice_in_the_mirror_is_the_original(group: str) -> None:
    parts = ACTION if group == "action" else GROUPS[group]
    x = torch.randn(5, sum(parts.values()))
    mirror = Mirror(parts)
    assert torch.equal(mirror(mirror(x)), x)
    assert x.shape[1] == SIZES.get(group, 12)


def test_mirror_by_hand() -> None:
    mirror = Mirror({"action": 12, "command": 3})
    x = torch.arange(1.0, 16.0)
    # FR, FL, HR, HL times hip_roll, hip_pitch, knee; then forward, left, yaw rate.
    mirrored = [-4, 5, 6, -1, 2, 3, -10, 11, 12, -7, 8, 9, 13, -14, -15]
    assert mirror(x).tolist() == mirrored


def test_bodies_in_the_mirror() -> None:
    """What legs have changes sides, without a sign; FR, FL, HR, HL, for each kind of joint."""
    mirror = Mirror({"drop": 1, "shank_length": 4, "stiffness": 12})
    mirrored = [1, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14, 17, 16]
    assert mirror(torch.arange(1.0, 18.0)).tolist() == mirrored


def test_histories_keep_their_order() -> None:
    one, three = Mirror({"joint_position": 12}), Mirror({"joint_position": 36})
    x = torch.randn(36)
    assert torch.equal(three(x), torch.cat([one(part) for part in x.split(12)]))


def test_unknown_parts_are_refused() -> None:
    with pytest.raises(PronkError, match=r"how 'whiskers' looks in the mirror; known are angular"):
        Mirror({"whiskers": 3})
    with pytest.raises(PronkError, match=r"command has 4 numbers; expected a multiple of 3"):
        Mirror({"command": 4})
    obs = observe(2)
    obs["odour"] = torch.zeros(2, 1)
    with pytest.raises(PronkError, match=r"what the group 'odour' holds; known are measured"):
        with_mirror_image(None, obs, None)


def test_batch_and_its_mirror_image() -> None:
    obs, actions = observe(4), torch.randn(4, 12)
    both, doubled = with_mirror_image(None, obs, actions)
    assert both is not None
    assert doubled is not None
    assert both.batch_size == torch.Size([8])
    for name, parts in GROUPS.items():
        assert torch.equal(both[name][:4], obs[name])
        assert torch.equal(both[name][4:], Mirror(parts)(obs[name]))
    assert torch.equal(doubled[4:], Mirror(ACTION)(actions))
    assert with_mirror_image(None, None, actions)[0] is None
    assert with_mirror_image(None, obs, None)[1] is None


@pytest.mark.parametrize("jump", [False, True])
def test_ppo_learns_from_both_sides(jump: bool) -> None:
    algorithm = build(
        jump=jump,
        symmetry_cfg={
            "data_augmentation_func": "pronk.train.rl.symmetry:with_mirror_image",
            "use_data_augmentation": True,
            "use_mirror_loss": True,
            "mirror_loss_coeff": 1.0,
        },
    )
    first = None
    for _ in range(20):
        roll_out(algorithm)
        loss = algorithm.update()["symmetry"]
        first = loss if first is None else first
    assert first is not None
    assert 0.0 < loss < first


# --- Physics -------------------------------------------------------------------------------------


def standing_on_a_plane() -> mujoco.MjModel:
    spec = free_spec(ROBOT)
    floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE)
    floor.size = (0.0, 0.0, 1.0)
    model = spec.compile()
    # Both sides must be solved to the last bit that matters, not to the first that will do.
    model.opt.tolerance = 1e-14
    model.opt.iterations = 200
    return model


def truth(model: mujoco.MjModel, data: mujoco.MjData, action: Array) -> Array:
    """The critic's vector, with the robot's own velocity as the command."""
    to_trunk = data.body("trunk").xmat.reshape(3, 3).T
    force = np.zeros(len(BODY.legs))
    feet = [model.geom(f"{leg}_foot_collision").id for leg in BODY.legs]
    wrench = np.zeros(6)
    for i, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, i, wrench)
        for geom in contact.geom:
            if geom in feet:
                force[feet.index(geom)] += np.linalg.norm(wrench[:3])
    velocity, turning = to_trunk @ data.qvel[:3], data.qvel[3:6]
    parts = {
        "angular_velocity": turning,
        "projected_gravity": to_trunk @ np.array([0.0, 0.0, -1.0]),
        "command": np.array([velocity[0], velocity[1], turning[2]]),
        "time_left": np.array([3.0]),
        "joint_position": data.qpos[7:] - DEFAULT,
        "joint_velocity": data.qvel[6:],
        "action": action,
        "linear_velocity": velocity,
        "height": data.qpos[2:3],
        "foot_contact": (force > 0.0).astype(float),
        "foot_force": force,
        "foot_height": np.array([data.site(f"{leg}_foot").xpos[2] for leg in BODY.legs]),
    }
    # What is drawn: a robot that is its own mirror image.
    drawn = list(CRITIC)[len(parts) :]
    parts |= {name: np.ones(CRITIC[name]) for name in drawn}
    assert list(parts) == list(CRITIC)
    return np.concatenate([parts[name] for name in CRITIC])


def fall_and_kick(model: mujoco.MjModel, start: dict[str, Array], actions: Array) -> Array:
    """Vectors of the critic, one a policy step, of a robot with PD drives."""
    data = mujoco.MjData(model)
    data.qpos[:] = start["qpos"]
    data.qvel[:] = start["qvel"]
    mujoco.mj_forward(model, data)
    seen = []
    for action in actions:
        target = DEFAULT + 0.35 * action
        for _ in range(ROBOT.decimation):
            torque = 20.0 * (target - data.qpos[7:]) - 0.45 * data.qvel[6:]
            data.qfrc_applied[6:] = torque
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        seen.append(truth(model, data, action))
    return np.array(seen)


def mirrored(group: str, x: Array) -> Array:
    parts = ACTION if group == "action" else GROUPS[group]
    mirror = Mirror(parts)
    # The table itself, in double precision.
    return np.asarray(x[..., mirror._source.numpy()] * mirror._sign.double().numpy())


@pytest.mark.parametrize("seed", range(3))
def test_mirrored_roll_out_is_that_of_the_mirror_image(seed: int) -> None:
    model = standing_on_a_plane()
    draw = np.random.default_rng(seed)
    actions = draw.normal(0.0, 0.7, (25, 12))
    joints, rates = draw.normal(0.0, 0.1, 12), draw.normal(0.0, 1.0, 12)
    tilt = draw.normal(0.0, 0.1, 3)
    quaternion = np.array([1.0, *tilt]) / np.linalg.norm([1.0, *tilt])
    position, velocity = np.array([0.1, 0.2, 0.33]), draw.normal(0.0, 0.5, 3)
    turning = draw.normal(0.0, 1.0, 3)
    vector, axial = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])

    original = {
        "qpos": np.concatenate([position, quaternion, DEFAULT + joints]),
        "qvel": np.concatenate([velocity, turning, rates]),
    }
    image = {
        "qpos": np.concatenate(
            [
                vector * position,
                quaternion * np.array([1.0, *axial]),
                DEFAULT + mirrored("action", joints),
            ]
        ),
        "qvel": np.concatenate([vector * velocity, axial * turning, mirrored("action", rates)]),
    }
    seen = fall_and_kick(model, original, actions)
    reflected = fall_and_kick(model, image, mirrored("action", actions))
    np.testing.assert_allclose(reflected, mirrored("critic", seen), rtol=0.0, atol=1e-9)
    # It has been a lively half second, on the floor, and not symmetric by itself.
    start = sum(list(CRITIC.values())[: list(CRITIC).index("foot_contact")])
    contact = seen[:, start : start + 4]
    assert 0.1 < contact.mean() < 0.99
    assert np.abs(seen - mirrored("critic", seen)).max() > 1.0
