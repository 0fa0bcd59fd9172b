"""Updates of PPO and of the estimator, recorded step by step, learn what they learn without."""

from __future__ import annotations

from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

from ppo_case import (
    build,
    learn,
    one_thread,  # noqa: F401
    weights,
)
from pronk.jump.train import compiled
from pronk.jump.train.rl import ppo
from traced_graph import TracedGraph

pytestmark = pytest.mark.train


def learned(*, records: bool, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, list[float]]:
    """Learn from five rollouts, between which changes what phases change.

    Args:
        records: Whether steps of learning and of the policy are recorded, by tracing them.

    Returns:
        The algorithm, and its learning rate after each update.
    """
    with monkeypatch.context() as patch:
        # A trace has the operations of functions, not of kernels that they are compiled to.
        patch.setattr(ppo, "compiled", lambda function: function)
        patch.setattr(ppo, "compiled_step", lambda function: function)
        if records:
            patch.setattr(compiled.RecordedFunction, "graph_type", TracedGraph)
            # Adam refuses to be recorded on a CPU, but where something is compiled.
            patch.setattr(torch.compiler, "is_compiling", lambda: True)
        torch.manual_seed(3)
        algorithm = build(compile_mode="default", use_clipped_value_loss=False)
        assert algorithm.is_compiled
        rates = []
        for update in range(5):
            algorithm.entropy_coef = 0.005 * (update + 1)
            algorithm.get_policy().limit_noise(0.65 - 0.1 * update)
            algorithm.set_estimator_rate(1e-3 / (update + 1))
            if update == 3:
                algorithm.reset_jump_moments()
            learn(algorithm)
            rates.append(algorithm.learning_rate)
    return algorithm, rates


def test_recorded_updates_are_those_without_a_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a learning rate that follows the divergence, and moments that a phase resets."""
    plain, plain_rates = learned(records=False, monkeypatch=monkeypatch)
    fast, fast_rates = learned(records=True, monkeypatch=monkeypatch)
    assert fast_rates == pytest.approx(plain_rates)
    assert len(set(plain_rates)) > 1
    for plain_model, fast_model in ((plain.actor, fast.actor), (plain.critic, fast.critic)):
        expected = weights(plain_model)
        for name, weight in weights(fast_model).items():
            torch.testing.assert_close(weight, expected[name], rtol=1e-4, atol=1e-5)
