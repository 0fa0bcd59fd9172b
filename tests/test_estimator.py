"""The estimator, the actor that reads it, and PPO beside it."""

from __future__ import annotations

import copy
import math
import socket
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

from rsl_rl.algorithms import PPO
from tensordict import TensorDict

from pronk.errors import PronkError
from pronk.policy.layout import ACTOR_INDICES, ESTIMATOR_INDICES
from pronk.train.rl.estimator import Estimator, estimator_losses
from pronk.train.rl.normalization import RolloutNormalization
from pronk.train.rl.ppo import EstimatorPPO, EstimatorPpoCfg
from small_ppo import (
    ROBOTS,
    STEPS,
    build,
    observe,
    one_thread,  # noqa: F401
    roll_out,
    same,
    weights,
)

pytestmark = [pytest.mark.train, pytest.mark.usefixtures("one_thread")]


def without_estimator(module: Any) -> dict[str, Any]:
    return {k: v for k, v in weights(module).items() if not k.startswith("estimator.")}


def test_losses_by_hand() -> None:
    contact = torch.tensor([[0.0, 0.0, 0.0, math.log(3.0)]])
    velocity = torch.tensor([[1.0, 2.0, 3.0]])
    target = torch.tensor([[1.0, 0.0, 1.0, 0.0, 0.0, 2.0, 1.0]])
    cross_entropy, squared = estimator_losses((contact, velocity), target)
    # Probabilities 1/2, 1/2, 1/2 and 3/4 where there is no contact.
    assert float(cross_entropy) == pytest.approx((3 * math.log(2) + math.log(4)) / 4)
    assert float(squared) == pytest.approx((1 + 0 + 4) / 3)


def test_estimate_is_a_probability_of_the_logit() -> None:
    estimator = Estimator(jump_size=1)
    x = torch.randn(5, 103)
    contact, velocity = estimator(x)
    probability, same_velocity = estimator.estimate(x)
    torch.testing.assert_close(probability, 1 / (1 + torch.exp(-contact)))
    assert torch.equal(velocity, same_velocity)


@pytest.mark.parametrize("jump", [False, True])
def test_what_the_networks_read(jump: bool) -> None:
    algorithm = build(jump=jump)
    roll_out(algorithm)
    algorithm.update()  # so that the statistics are not those of the beginning
    actor, critic, obs = algorithm.get_policy(), algorithm.get_critic(), observe()
    statistics = actor.obs_normalizer
    measured = (obs["measured"] - statistics.mean) / (statistics.std + 0.01)
    tail = [obs["jump"]] if jump else []
    read = torch.cat([measured[:, list(ESTIMATOR_INDICES)], *tail], dim=1)
    torch.testing.assert_close(actor.estimator_input(obs), read)
    estimate = torch.cat(actor.estimate(obs), dim=1)
    acting = torch.cat([estimate, measured[:, list(ACTOR_INDICES)], *tail], dim=1)
    assert acting.shape == (ROBOTS, 52 + jump)
    torch.testing.assert_close(actor.get_latent(obs), acting)

    truth = (obs["critic"] - critic.obs_normalizer.mean) / (critic.obs_normalizer.std + 0.01)
    tail = [obs["critic_jump"]] if jump else []
    torch.testing.assert_close(critic.get_latent(obs), torch.cat([truth, *tail], dim=1))


def test_noise_is_limited_where_it_is_larger() -> None:
    algorithm = build(jump=True)
    actor, obs = algorithm.get_policy(), observe()
    parameter = actor.distribution.std_param
    before = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6] * 2
    with torch.no_grad():
        parameter.copy_(torch.tensor(before))
    actor.limit_noise(math.inf)
    assert parameter.tolist() == pytest.approx(before)
    actor.limit_noise(0.3)
    limited = [0.1, 0.2, 0.3, 0.3, 0.3, 0.3] * 2
    assert parameter.tolist() == pytest.approx(limited)
    actor(obs, stochastic_output=True)
    acts_by = torch.tensor(limited).expand(ROBOTS, -1)
    torch.testing.assert_close(actor.output_std, acts_by)
    actor.limit_noise(0.5)
    assert parameter.tolist() == pytest.approx(limited), "a limit is no aim"


def test_limited_noise_goes_on_being_learned() -> None:
    algorithm = build(jump=True)
    actor = algorithm.get_policy()
    actor.limit_noise(0.3)
    parameter = actor.distribution.std_param
    assert any(p is parameter for g in algorithm.optimizer.param_groups for p in g["params"])
    assert parameter.requires_grad
    roll_out(algorithm)
    algorithm.update()
    assert actor.distribution.std_param is parameter
    changed = parameter.detach() - 0.3
    assert 0.0 < float(changed.abs().max()) < 0.1


def test_wrong_observations_are_refused() -> None:
    algorithm = build()
    actor = type(algorithm.get_policy())
    obs = observe()
    with pytest.raises(PronkError, match=r"reads the groups jump, measured; expected measured, or"):
        actor(obs, {"actor": ["jump", "measured"]}, "actor", 12)
    obs["measured"] = torch.zeros(ROBOTS, 104)
    with pytest.raises(PronkError, match=r"has 104 numbers; expected 105"):
        actor(obs, {"actor": ["measured", "jump"]}, "actor", 12)
    del obs["target"]
    obs["measured"] = torch.zeros(ROBOTS, 105)
    with pytest.raises(PronkError, match=r"needs 'target' to learn from"):
        build(observation=obs)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("estimator_epochs", 0),
        ("estimator_mini_batches", 0),
        ("estimator_learning_rate", 0.0),
        ("estimator_learning_rate", math.nan),
    ],
)
def test_impossible_settings_are_refused(field: str, value: float) -> None:
    with pytest.raises(PronkError, match=f"{field} is .*; expected"):
        EstimatorPpoCfg(**{field: value})


def test_ppo_leaves_the_estimator_alone() -> None:
    algorithm = build(jump=True)
    actor = algorithm.get_policy()
    for _ in range(2):  # the second time the estimator's own gradients have been there
        roll_out(algorithm)
        estimator, network = weights(actor.estimator), weights(actor.mlp)
        PPO.update(algorithm)
        assert same(weights(actor.estimator), estimator)
        assert not same(weights(actor.mlp), network)
        assert all(p.grad is None for p in actor.estimator.parameters())
        algorithm._update_estimator()


def test_supervision_leaves_everything_else_alone() -> None:
    algorithm = build(jump=True)
    actor, critic = algorithm.get_policy(), algorithm.get_critic()
    roll_out(algorithm)
    PPO.update(algorithm)
    before, values = without_estimator(actor), weights(critic)
    estimator = weights(actor.estimator)
    algorithm._update_estimator()
    assert same(without_estimator(actor), before)
    assert same(weights(critic), values)
    changed = weights(actor.estimator)
    assert all(not torch.equal(changed[name], estimator[name]) for name in estimator)
    assert all(p.grad is None for p in actor.estimator.parameters())


def test_every_weight_has_one_optimizer() -> None:
    algorithm = build(jump=True)
    actor, critic = algorithm.get_policy(), algorithm.get_critic()
    mine = [p for g in algorithm.estimator_optimizer.param_groups for p in g["params"]]
    others = [p for g in algorithm.optimizer.param_groups for p in g["params"]]
    assert {id(p) for p in mine} == {id(p) for p in actor.estimator.parameters()}
    everything = [*actor.parameters(), *critic.parameters()]
    assert sorted(map(id, mine + others)) == sorted(map(id, everything))


def test_losses_are_means_over_the_rollout() -> None:
    # With a learning rate of nearly nothing the mean over mini-batches is that of the rollout.
    algorithm = build(estimator_learning_rate=1e-30, estimator_epochs=2, estimator_mini_batches=4)
    roll_out(algorithm)
    actor, rollout = algorithm.get_policy(), algorithm.storage.observations.flatten(0, 1).clone()
    with torch.no_grad():
        estimate = actor.estimator(actor.estimator_input(rollout))
    contact, velocity = estimator_losses(estimate, rollout["target"])
    losses = algorithm.update()
    assert losses["estimator_contact"] == pytest.approx(float(contact), rel=1e-5)
    assert losses["estimator_velocity"] == pytest.approx(float(velocity), rel=1e-5)
    assert {"value", "surrogate", "entropy"} <= losses.keys()


def test_learns_a_known_truth() -> None:
    torch.manual_seed(0)
    mixing = torch.randn(102, 7) / math.sqrt(102) / 3.0

    def observe_truth() -> TensorDict:
        obs = observe()
        truth = (obs["measured"][:, list(ESTIMATOR_INDICES)] - 1.0) @ mixing
        truth[:, :4] = (truth[:, :4] > 0.0).float()
        obs["target"] = truth
        return obs

    algorithm = build(hidden=(8,), estimator_epochs=4, num_learning_epochs=1)
    for _ in range(100):
        roll_out(algorithm, observe_truth)
        algorithm.update()
    fresh = observe_truth()
    with torch.no_grad():
        contact, velocity = algorithm.get_policy().estimate(fresh)
    right = ((contact > 0.5) == (fresh["target"][:, :4] > 0.5)).float().mean()
    error = (velocity - fresh["target"][:, 4:]).square().mean().sqrt()
    # Guessing is right half of the time, with an error of one.
    assert float(right) > 0.85
    assert float(error) < 0.3


def test_statistics_are_those_of_all_rollouts() -> None:
    algorithm = build()
    seen = []
    for _ in range(3):
        roll_out(algorithm)
        seen.append(algorithm.storage.observations.clone())
        algorithm.update()
    for model, group in ((algorithm.get_policy(), "measured"), (algorithm.get_critic(), "critic")):
        samples = torch.cat([obs[group].flatten(0, 1) for obs in seen])
        normalizer = model.obs_normalizer
        assert int(normalizer.count) == len(samples) == 3 * ROBOTS * STEPS
        torch.testing.assert_close(normalizer.mean, samples.mean(dim=0), rtol=1e-4, atol=1e-5)
        std = samples.std(dim=0, correction=0)
        torch.testing.assert_close(normalizer.std, std, rtol=1e-4, atol=1e-5)


def test_first_importance_ratio_is_one() -> None:
    algorithm = build(jump=True)
    for _ in range(2):
        roll_out(algorithm)
        stored, actor = algorithm.storage, algorithm.get_policy()
        actor(stored.observations.flatten(0, 1), stochastic_output=True)
        anew = actor.get_output_log_prob(stored.actions.flatten(0, 1))
        torch.testing.assert_close(anew, stored.actions_log_prob.flatten())
        algorithm.update()


@pytest.mark.parametrize("jump", [False, True])
def test_saved_and_loaded_it_goes_on_alike(jump: bool) -> None:
    first, second = build(jump=jump), build(jump=jump)
    roll_out(first)
    first.update()
    # A copy, as a file is: torch's optimizers take over the very tensors they are given.
    assert second.load(copy.deepcopy(first.save()))
    torch.manual_seed(1)
    roll_out(first)
    losses = first.update()
    torch.manual_seed(1)
    roll_out(second)
    assert second.update() == losses
    assert same(weights(first.get_policy()), weights(second.get_policy()))
    assert same(weights(first.get_critic()), weights(second.get_critic()))
    assert first.learning_rate == second.learning_rate


def test_networks_alone_can_be_loaded() -> None:
    first, second = build(), build()
    roll_out(first)
    first.update()
    assert not second.load(first.save(), {"actor": True})
    assert same(weights(first.get_policy()), weights(second.get_policy()))
    assert not second.estimator_optimizer.state


def test_normalised_rollout_has_mean_zero_and_spread_one() -> None:
    normalizer = RolloutNormalization(3)
    x = torch.randn(4, 50, 3) * torch.tensor([1.0, 10.0, 0.1]) + 5.0
    normalizer.learn(x)
    y = normalizer(x).flatten(0, 1)
    torch.testing.assert_close(y.mean(dim=0), torch.zeros(3), rtol=0, atol=1e-5)
    flat = x.flatten(0, 1).std(dim=0, correction=0)
    torch.testing.assert_close(y.std(dim=0, correction=0), flat / (flat + 0.01))


def _one_of_two(rank: int, port: int, folder: str) -> None:
    """A process of two: learns from data of its own, writes down what it has become."""
    torch.set_num_threads(1)
    torch.distributed.init_process_group(
        "gloo", init_method=f"tcp://127.0.0.1:{port}", rank=rank, world_size=2
    )
    torch.manual_seed(10 + rank)
    ranks = {"global_rank": rank, "local_rank": rank, "world_size": 2}
    algorithm = build(jump=True, multi_gpu=ranks)
    algorithm.broadcast_parameters()
    for _ in range(2):
        roll_out(algorithm)
        algorithm.update()
    seen = algorithm.storage.observations["measured"]
    torch.save(
        {
            "actor": weights(algorithm.get_policy()),
            "critic": weights(algorithm.get_critic()),
            "seen": {"measured": seen.clone()},
        },
        Path(folder) / f"{rank}.pt",
    )
    torch.distributed.destroy_process_group()


@pytest.mark.slow
def test_processes_stay_together(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    torch.multiprocessing.spawn(_one_of_two, (port, str(tmp_path)), nprocs=2)
    first, second = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in (0, 1))
    assert not same(first["seen"], second["seen"])
    assert same(first["actor"], second["actor"])
    assert same(first["critic"], second["critic"])
    assert int(first["actor"]["obs_normalizer.count"]) == 2 * 2 * ROBOTS * STEPS


def test_ppo_is_found_by_its_name() -> None:
    from rsl_rl.utils import resolve_callable

    assert resolve_callable(EstimatorPpoCfg().class_name) is EstimatorPPO
