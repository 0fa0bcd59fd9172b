"""Export of a policy to ONNX, and its contract."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")
pytest.importorskip("onnxruntime")
from ppo_case import observe, one_thread, same, trained, weights  # noqa: F401
from pronk.errors import ArtefactError
from pronk.jump.train.rl.export import TOLERANCE, contract_for, export_policy, verify
from pronk.policy.contract import Contract, check
from pronk.policy.runtime import load_policy
from training_env import MATCHED, ROBOT, config

pytestmark = pytest.mark.train
SHA256 = "ab" * 32


def contract(*, jump: bool) -> Contract:
    cfg = config(1, replace(MATCHED, sha256=SHA256, virtual=True))
    return contract_for(cfg, jump=jump, provenance={"phases": {"walk": 2}, "seed": 1})


@pytest.mark.parametrize("jump", [False, True])
def test_onnx_equals_pytorch(tmp_path: Path, jump: bool) -> None:
    torch.manual_seed(5)
    actor = trained(jump=jump, hidden=(1024, 512, 256)).get_policy()
    before = weights(actor)
    path = tmp_path / "policy.onnx"
    export_policy(actor, contract(jump=jump), path)
    assert path.stat().st_size < 4e6
    assert [file.name for file in tmp_path.iterdir()] == ["policy.onnx"]
    running = observe(256)  # as large as the observations of a robot that runs
    spread = torch.tensor([3.0] * 3 + [0.3] * 3 + [0.5] * 36 + [10.0] * 36 + [2.0] * 24 + [1.5] * 3)
    running["measured"] = torch.randn(256, 105) * spread
    for observations in (observe(1), observe(256), running):
        assert verify(path, actor, observations) <= TOLERANCE
    assert actor.training
    assert same(weights(actor), before)
    policy = load_policy(path)
    check(policy.contract, ROBOT)
    assert policy.contract == contract(jump=jump)


def test_verify_finds_another_policy_and_refuses_other_files(tmp_path: Path) -> None:
    actor = trained(1).get_policy()
    path = tmp_path / "policy.onnx"
    observations = observe(8)
    with pytest.raises(ArtefactError, match="no such file"):
        verify(path, actor, observations)
    export_policy(actor, contract(jump=True), path)
    with torch.no_grad():
        actor.estimator.mlp[-1].bias[6] += 0.01
    assert verify(path, actor, observations) >= 0.0099
    observations["measured"][1, 3] = math.nan
    with pytest.raises(ArtefactError, match="nan"):
        verify(path, actor, observations)


def test_the_jump_input_reaches_estimator_and_actor(tmp_path: Path) -> None:
    """A walking policy is the one with the jump input at zero."""
    actor = trained(1).get_policy()
    for has_jump in (False, True):
        export_policy(actor, contract(jump=has_jump), tmp_path / f"{has_jump}.onnx")
    measured = observe(1)["measured"].numpy()
    policy = load_policy(tmp_path / "True.onnx")
    walk = policy.infer(measured)
    jump = policy.infer(measured, [[1.0]])
    plain = load_policy(tmp_path / "False.onnx").infer(measured)
    np.testing.assert_allclose(plain.action, walk.action, atol=1e-6)
    for name in ("action", "contact", "linear_velocity"):
        assert not np.array_equal(getattr(walk, name), getattr(jump, name))
    assert ((walk.contact > 0.0) & (walk.contact < 1.0)).all()


def test_contract_by_hand() -> None:
    jumping = contract(jump=True)
    assert jumping.stiffness == (20.0, 17.5, 21.5) * 4
    assert jumping.damping == (0.45, 0.4, 0.55) * 4
    assert jumping.default_position == (0.0, -0.8, 1.6) * 4
    assert jumping.action_scale == (0.35,) * 12
    assert jumping.delay_range_s == (0.0, 0.01)
    assert jumping.command_ranges == {"vx": (-3.0, 3.0), "vy": (-1.0, 1.0), "yaw_rate": (-2.0, 2.0)}
    assert (jumping.gains, jumping.gains_sha256, jumping.virtual) == ("matched", SHA256, True)
    assert jumping.versions["torch"] == torch.__version__
    check(jumping, ROBOT, gains_sha256=SHA256)
