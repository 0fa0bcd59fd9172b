"""The exported policy is the trained one, and runs as it did in training."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")
pytest.importorskip("onnxruntime")

from tensordict import TensorDict

from pronk.errors import ArtefactError
from pronk.match.gains import GroupGains
from pronk.policy.contract import Contract, check
from pronk.policy.observation import History, Measurement
from pronk.policy.runtime import load_policy
from pronk.robots import load_robot
from pronk.train.gains import TrainingGains, training_gains
from pronk.train.rl.export import TOLERANCE, contract_for, export_policy, verify
from small_ppo import build, observe, roll_out, same, weights

pytestmark = pytest.mark.train

ROBOT = load_robot("mini_cheetah")
PAPER = (1024, 512, 256)


def contract(*, jump: bool, action_scale: float = 0.35) -> Contract:
    return contract_for(
        ROBOT,
        training_gains("naive", ROBOT),
        action_scale=action_scale,
        delay_steps=(0, 2),
        command_limits=(3.0, 1.0, 2.0),
        lift_off_velocity=2.5 if jump else None,
        provenance={"phases": {"walk": 2}, "seed": 1},
    )


def trained(*, jump: bool, hidden: tuple[int, ...] = (32, 16)) -> Any:
    """An actor after an update, its statistics and jump weights not those of the beginning."""
    algorithm = build(jump=jump, hidden=hidden)
    roll_out(algorithm)
    algorithm.update()
    return algorithm.get_policy()


def as_recorded(rows: int) -> TensorDict:
    """Observations as large as those of a robot that runs."""
    groups = observe(rows)
    spread = [3.0] * 3 + [0.3] * 3 + [0.5] * 36 + [10.0] * 36 + [2.0] * 24 + [1.5] * 3
    mean = [0.0] * 5 + [-0.95] + [0.0] * 99
    groups["measured"] = torch.randn(rows, 105) * torch.tensor(spread) + torch.tensor(mean)
    return groups


@pytest.mark.parametrize("jump", [False, True])
def test_onnx_equals_pytorch(tmp_path: Path, jump: bool) -> None:
    torch.manual_seed(5)
    actor = trained(jump=jump, hidden=PAPER)
    before = weights(actor)
    path = tmp_path / "policy.onnx"
    export_policy(actor, contract(jump=jump), path)
    assert path.stat().st_size < 4e6
    assert [file.name for file in tmp_path.iterdir()] == ["policy.onnx"]
    for rows in (1, 256):
        for observations in (observe(rows), as_recorded(rows)):
            difference = verify(path, actor, observations)
            assert difference is not None
            assert difference <= TOLERANCE
    assert actor.training
    assert same(weights(actor), before)
    policy = load_policy(path)
    check(policy.contract, ROBOT)
    assert policy.contract == contract(jump=jump)


def test_verify_sees_a_policy_that_is_another(tmp_path: Path) -> None:
    actor = trained(jump=True)
    path = tmp_path / "policy.onnx"
    export_policy(actor, contract(jump=True), path)
    observations = observe(8)
    honest = verify(path, actor, observations)
    assert honest is not None
    assert honest <= TOLERANCE
    with torch.no_grad():
        actor.estimator.mlp[-1].bias[6] += 0.01
    changed = verify(path, actor, observations)
    assert changed is not None
    assert changed >= 0.0099


def test_the_jump_input_reaches_estimator_and_actor(tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    export_policy(trained(jump=True), contract(jump=True), path)
    measured = observe(1)["measured"].numpy()
    policy = load_policy(path)
    walk, jump = policy.infer(measured, [[0.0]]), policy.infer(measured, [[1.0]])
    for name in ("action", "contact", "linear_velocity"):
        assert not np.array_equal(getattr(walk, name), getattr(jump, name))
    assert ((walk.contact > 0.0) & (walk.contact < 1.0)).all()


def test_an_actor_without_jump_gets_no_contract_with_it(tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    with pytest.raises(ValueError, match="jump"):
        export_policy(trained(jump=False), contract(jump=True), path)
    assert not path.exists()


def test_verify_refuses_what_cannot_be_run(tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    actor = trained(jump=False)
    with pytest.raises(ArtefactError, match="no such file"):
        verify(path, actor, observe(2))
    export_policy(actor, contract(jump=False), path)
    observations = observe(2)
    observations["measured"][1, 3] = math.nan
    with pytest.raises(ArtefactError, match="nan"):
        verify(path, actor, observations)


def test_contract_by_hand() -> None:
    groups = {
        name: GroupGains(stiffness=kp, damping=kd, stiffness_range=1.0, damping_range=0.05)
        for name, kp, kd in (
            ("hip_roll", 20.0, 0.45),
            ("hip_pitch", 17.5, 0.4),
            ("knee", 21.5, 0.55),
        )
    }
    gains = TrainingGains(
        name="matched", robot=ROBOT.name, groups=groups, sha256="ab" * 32, virtual=True
    )
    made = contract_for(
        ROBOT,
        gains,
        action_scale=0.35,
        delay_steps=(0, 2),
        command_limits=(3.0, 1.0, 2.0),
        lift_off_velocity=2.5,
        provenance={"seed": 4},
    )
    assert made.stiffness == (20.0, 17.5, 21.5) * 4
    assert made.damping == (0.45, 0.4, 0.55) * 4
    assert made.default_position == (0.0, -0.8, 1.6) * 4
    assert made.action_scale == (0.35,) * 12
    assert made.delay_range_s == (0.0, 0.01)
    assert made.command_ranges == {"vx": (-3.0, 3.0), "vy": (-1.0, 1.0), "yaw_rate": (-2.0, 2.0)}
    assert (made.gains, made.gains_sha256, made.virtual) == ("matched", "ab" * 32, True)
    assert made.jump
    assert made.provenance == {"seed": 4}
    assert made.versions["torch"] == torch.__version__
    check(made, ROBOT, gains_sha256="ab" * 32)


# --- In the environment of training -------------------------------------------------------------


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    """Two nominal robots without noise."""
    from mjlab.envs import ManagerBasedRlEnv

    from pronk.train.mdp.randomization import Randomization
    from pronk.train.phases import phase
    from pronk.train.tasks import env_cfg

    cfg = env_cfg(phase=phase("jump_b"), randomization=Randomization.none(), num_envs=2, seed=3)
    made = ManagerBasedRlEnv(cfg=cfg, device="cpu")
    yield made
    made.close()


def gravity(quaternion: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """(0, 0, -1) in the frame of a body, from its quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return -np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])


@pytest.mark.slow
def test_the_contract_is_what_the_environment_does(env: Any) -> None:
    from pronk.train.mdp.commands import motion_command
    from pronk.train.tasks import ACTION_SCALE

    made = contract(jump=True, action_scale=ACTION_SCALE)
    robot = env.scene["robot"]
    term = env.action_manager.get_term("joint_position")
    assert tuple(robot.joint_names) == made.joint_names
    np.testing.assert_allclose(robot.data.default_joint_pos[0], made.default_position, atol=1e-6)
    np.testing.assert_allclose(np.broadcast_to(term._scale, (2, 12))[0], made.action_scale)
    assert env.step_dt == pytest.approx(1.0 / made.policy_rate_hz)
    assert env.physics_dt == pytest.approx(made.timestep_s)
    assert env.cfg.decimation == made.decimation
    command = motion_command(env)
    limits = tuple(high for _, high in made.command_ranges.values())
    assert command.cfg.limits == limits
    assert command.cfg.settings.liftoff_velocity == made.lift_off_velocity


@pytest.mark.slow
def test_the_runtime_runs_as_training_did(env: Any, tmp_path: Path) -> None:
    """Measured vector, action and targets, step by step, through a reset of one robot."""
    from pronk.train.tasks import ACTION_SCALE

    torch.manual_seed(11)
    actor = trained(jump=True).eval()
    with torch.no_grad():
        actor.mlp[-1].weight *= 10.0  # so that the robots move
    path = tmp_path / "policy.onnx"
    export_policy(actor, contract(jump=True, action_scale=ACTION_SCALE), path)
    policies = [load_policy(path) for _ in range(2)]
    histories = [History(policies[0].contract.default_position) for _ in range(2)]
    observed, _ = env.reset()
    recorded = []
    resets = 0
    for k in range(12):
        recorded.append({name: observed[name].clone() for name in ("measured", "jump")})
        with torch.no_grad():
            action = actor(observed)
        targets = []
        for i, (policy, history) in enumerate(zip(policies, histories, strict=True)):
            q, v = env.sim.data.qpos[i].numpy().copy(), env.sim.data.qvel[i].numpy().copy()
            now = Measurement(
                angular_velocity=v[3:6],
                projected_gravity=gravity(q[3:7]),
                position=q[7:],
                velocity=v[6:],
            )
            command = observed["measured"][i, -3:].numpy()
            vector = history.observe(now, command)
            np.testing.assert_allclose(vector, observed["measured"][i], rtol=1e-6, atol=2e-6)
            targets.append(policy.step(now, command, bool(observed["jump"][i])))
            assert policy.inference is not None
            np.testing.assert_allclose(policy.inference.action[0], action[i], atol=1e-4)
            history.acted(action[i].numpy())
        if k == 6:
            env.episode_length_buf[1] = 10**6  # time is over: reset within the step
        observed, *_ = env.step(action)
        asked = env.scene["robot"].data.joint_pos_target.numpy()
        for i, done in enumerate(env.reset_buf.tolist()):
            if done:
                policies[i].reset()
                histories[i].reset()
                resets += 1
            else:
                np.testing.assert_allclose(asked[i], targets[i], atol=1e-4)
    assert resets >= 1
    together = {name: torch.cat([step[name] for step in recorded]) for name in recorded[0]}
    difference = verify(path, actor, together)
    assert difference is not None
    assert difference <= TOLERANCE


def test_metadata_says_who_and_how(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    path = tmp_path / "policy.onnx"
    export_policy(trained(jump=False), contract(jump=False), path)
    model = onnx.load(path)
    assert model.producer_name == "pronk"
    assert "walks; trained with naive gains" in model.doc_string
    body = json.loads({prop.key: prop.value for prop in model.metadata_props}["pronk.contract"])
    assert body["lift_off_velocity"] is None
    assert "waits_for_stride" not in body
