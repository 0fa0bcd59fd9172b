"""PPO with the estimator on random observations: no environment, small networks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from pronk.jump.train.rl.networks import EstimatorActorCfg, JumpCriticCfg
from pronk.jump.train.rl.ppo import EstimatorPPO, EstimatorPpoCfg

ROBOTS = 32
STEPS = 4
SIZES = {"measured": 105, "jump": 1, "critic": 96, "critic_jump": 12, "estimator_target": 7}


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Networks this small are ten times faster on one thread than on threads that wait."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def observe(rows: int = ROBOTS, *, jump: bool = True) -> TensorDict:
    """Draw groups of the right sizes; without `jump` the jump groups are zero."""
    groups = {name: torch.randn(rows, size) for name, size in SIZES.items()}
    groups["measured"] = 3.0 * groups["measured"] + 1.0
    groups["jump"] = torch.randint(0, 2, (rows, 1)).float() * jump
    groups["critic_jump"] *= jump
    groups["estimator_target"][:, :4] = (groups["estimator_target"][:, :4] > 0.0).float()
    return TensorDict(groups, batch_size=[rows])


def build(
    *,
    robots: int = ROBOTS,
    steps: int = STEPS,
    hidden: tuple[int, ...] = (32, 16),
    read: tuple[str, ...] = ("measured", "jump"),
    observation: TensorDict | None = None,
    environment: Any = None,
    multi_gpu: dict[str, int] | None = None,
    estimator: dict[str, Any] | None = None,
    compile_mode: str | None = None,
    **algorithm: Any,
) -> EstimatorPPO:
    """Build it as rsl_rl's runner does from mjlab's configuration."""
    actor = asdict(EstimatorActorCfg())
    critic = asdict(JumpCriticCfg())
    for model in (actor, critic):
        model["hidden_dims"] = hidden
        for key in ("cnn_cfg", "rnn_type", "rnn_hidden_dim", "rnn_num_layers"):
            del model[key]  # as mjlab's runner does
    del critic["distribution_cfg"]
    ppo = asdict(EstimatorPpoCfg(**algorithm))
    ppo["estimator"] = estimator or {}
    cfg = {
        "actor": actor,
        "critic": critic,
        "algorithm": ppo,
        "obs_groups": {"actor": list(read), "critic": ["critic", "critic_jump"]},
        "num_steps_per_env": steps,
        "multi_gpu": multi_gpu,
        "torch_compile_mode": compile_mode,
    }
    env: Any = SimpleNamespace(num_envs=robots, num_actions=12, unwrapped=environment)
    start = observe(robots) if observation is None else observation
    built = EstimatorPPO.construct_algorithm(start, env, cfg, "cpu")
    built.train_mode()
    return built


def roll_out(algorithm: EstimatorPPO, observe: Any = observe) -> None:
    """Fill the storage, as the runner does."""
    robots = algorithm.storage.num_envs
    with torch.inference_mode():
        observation = observe(robots)
        for _ in range(algorithm.storage.num_transitions_per_env):
            algorithm.act(observation)
            observation = observe(robots)
            dones = torch.rand(robots) < 0.1
            algorithm.process_env_step(observation, torch.randn(robots), dones, {})
        algorithm.compute_returns(observation)


def learn(algorithm: EstimatorPPO, observe: Any = observe) -> None:
    """Learn from one iteration."""
    roll_out(algorithm, observe)
    algorithm.update()


def trained(updates: int = 2, *, jump: bool = True, **cfg: Any) -> EstimatorPPO:
    """Return an algorithm after some updates on observations with or without jump input."""
    algorithm = build(**cfg)
    for _ in range(updates):
        learn(algorithm, lambda rows: observe(rows, jump=jump))
    return algorithm


def weights(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    """Copy all weights and statistics."""
    return {name: value.detach().clone() for name, value in module.state_dict().items()}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    """Return whether names and, bit for bit, values are equal."""
    if a.keys() != b.keys():
        return False
    return all(torch.equal(a[name], b[name]) for name in a)
