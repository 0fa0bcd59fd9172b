"""PPO with the estimator on made-up observations: no environment, small networks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from pronk.train.rl.actor import EstimatorActorCfg, JumpCriticCfg
from pronk.train.rl.ppo import EstimatorPPO, EstimatorPpoCfg

ROBOTS = 32
STEPS = 4
ACTIONS = 12
SIZES = {"measured": 105, "jump": 1, "critic": 96, "critic_jump": 12, "target": 7}


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Networks this small are ten times faster on one thread than on threads that wait."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def observe(rows: int = ROBOTS) -> TensorDict:
    """Random groups of the right sizes; the jump input and the contacts are 0 or 1."""
    groups = {name: torch.randn(rows, size) for name, size in SIZES.items()}
    groups["measured"] = 3.0 * groups["measured"] + 1.0
    groups["jump"] = torch.randint(0, 2, (rows, 1)).float()
    groups["target"][:, :4] = (groups["target"][:, :4] > 0.0).float()
    return TensorDict(groups, batch_size=[rows])


def build(
    *,
    jump: bool = False,
    hidden: tuple[int, ...] = (32, 16),
    observation: TensorDict | None = None,
    multi_gpu: dict[str, int] | None = None,
    device: str = "cpu",
    **algorithm: Any,
) -> EstimatorPPO:
    """As rsl_rl's runner builds it from mjlab's configuration."""
    models = {
        "actor": asdict(EstimatorActorCfg(hidden_dims=hidden)),
        "critic": asdict(JumpCriticCfg(hidden_dims=hidden)),
    }
    for model in models.values():  # what mjlab's runner strips
        for key in ("cnn_cfg", "distribution_cfg", "rnn_type"):
            if model[key] is None:
                del model[key]
        del model["rnn_hidden_dim"], model["rnn_num_layers"]
    groups = {"actor": ["measured"], "critic": ["critic"]}
    if jump:
        groups = {"actor": ["measured", "jump"], "critic": ["critic", "critic_jump"]}
    cfg = {
        **models,
        "algorithm": asdict(EstimatorPpoCfg(**algorithm)),
        "obs_groups": groups,
        "num_steps_per_env": STEPS,
        "multi_gpu": multi_gpu,
    }
    env: Any = SimpleNamespace(num_envs=ROBOTS, num_actions=ACTIONS)
    start = (observe() if observation is None else observation).to(device)
    made = EstimatorPPO.construct_algorithm(start, env, cfg, device)
    made.train_mode()
    assert isinstance(made, EstimatorPPO)
    return made


def roll_out(algorithm: EstimatorPPO, observe: Any = observe) -> None:
    """Fill the storage, as the runner does."""
    with torch.inference_mode():
        observation = observe().to(algorithm.device)
        for _ in range(STEPS):
            algorithm.act(observation)
            observation = observe().to(algorithm.device)
            rewards = torch.randn(ROBOTS, device=algorithm.device)
            dones = torch.rand(ROBOTS, device=algorithm.device) < 0.1
            algorithm.process_env_step(observation, rewards, dones, {})
        algorithm.compute_returns(observation)


def weights(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    """A copy of all weights and statistics."""
    return {name: value.detach().clone() for name, value in module.state_dict().items()}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    """Equal names and, bit for bit, values."""
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
