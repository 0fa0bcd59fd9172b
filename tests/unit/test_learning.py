"""Networks and PPO: the estimator, the normalization, the blank jump input, checkpoints."""

from __future__ import annotations

import copy
import math
import socket
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")
from rsl_rl.algorithms import PPO

from ppo_case import (
    ROBOTS,
    STEPS,
    build,
    learn,
    observe,
    one_thread,  # noqa: F401
    roll_out,
    same,
    trained,
    weights,
)
from pronk.errors import ArtefactError, PronkError
from pronk.jump.train.rl import checkpoint
from pronk.jump.train.rl.networks import JUMP_WEIGHT, StateEstimator
from pronk.jump.train.rl.ppo import EstimatorPPO
from pronk.policy.observation import ACTOR_INDICES, ESTIMATOR_INDICES

pytestmark = pytest.mark.train
PAPER = (1024, 512, 256)


# --- Estimator and normalization -----------------------------------------------------------------


def test_losses_by_hand() -> None:
    estimator = StateEstimator()
    with torch.no_grad():
        for parameter in estimator.parameters():
            parameter.zero_()
        estimator.mlp[-1].bias[:] = torch.tensor([0.0, 0.0, 0.0, math.log(3.0), 1.0, 2.0, 3.0])
    x = torch.randn(1, 103)
    target = torch.tensor([[1.0, 0.0, 1.0, 0.0, 0.0, 2.0, 1.0]])
    with torch.no_grad():
        cross_entropy, squared = estimator.losses(x, target)
    # Probabilities 1/2, 1/2, 1/2 and 3/4 where there is no contact.
    assert float(cross_entropy) == pytest.approx((3 * math.log(2) + math.log(4)) / 4)
    assert float(squared) == pytest.approx((1 + 0 + 4) / 3)
    contact, _ = estimator(x)
    torch.testing.assert_close(contact, torch.tensor([[0.5, 0.5, 0.5, 0.75]]))


def test_what_the_networks_read() -> None:
    algorithm = trained(1)
    actor = algorithm.get_policy()
    critic = algorithm.critic
    obs = observe()
    statistics = actor.obs_normalizer
    measured = (obs["measured"] - statistics.mean) / (statistics.std + 0.01)
    read = torch.cat([measured[:, list(ESTIMATOR_INDICES)], obs["jump"]], dim=1)
    torch.testing.assert_close(actor.estimator_input(obs), read)
    estimate = torch.cat(actor.estimate(obs), dim=1)
    acting = torch.cat([estimate, measured[:, list(ACTOR_INDICES)], obs["jump"]], dim=1)
    assert acting.shape == (ROBOTS, 53)
    torch.testing.assert_close(actor.get_latent(obs), acting)
    state = (obs["critic"] - critic.obs_normalizer.mean) / (critic.obs_normalizer.std + 0.01)
    torch.testing.assert_close(critic.get_latent(obs), torch.cat([state, obs["critic_jump"]], 1))


def test_noise_is_limited_where_it_is_larger_and_still_learned() -> None:
    algorithm = build()
    actor = algorithm.get_policy()
    parameter = actor.distribution.std_param
    with torch.no_grad():
        parameter.copy_(torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6] * 2))
    for largest, limited in ((math.inf, [0.4, 0.5, 0.6]), (0.3, [0.3, 0.3, 0.3])):
        actor.limit_noise(largest)
        assert parameter.tolist() == pytest.approx([0.1, 0.2, 0.3, *limited] * 2)
    before = parameter.detach().clone()
    learn(algorithm)
    assert actor.distribution.std_param is parameter
    assert 0.0 < float((parameter.detach() - before).abs().max()) < 0.1


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"read": ("jump", "measured")}, "expected measured and jump"),
        ({"observation": observe().set("measured", torch.zeros(ROBOTS, 104))}, "104 numbers"),
        ({"observation": observe().exclude("estimator_target")}, "estimator_target"),
        ({"estimator": {"epochs": 0}}, "more than 0"),
        ({"estimator": {"learning_rate": math.nan}}, "more than 0"),
    ],
)
def test_impossible_inputs_are_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(PronkError, match=words):
        build(**changes)


def identities(parameters: Iterable[Any]) -> list[int]:
    """Return which tensors the parameters are, in an order of their own."""
    return sorted(map(id, parameters))


def test_ppo_and_supervision_change_different_weights() -> None:
    """Every weight has one optimizer."""
    algorithm = build()
    actor = algorithm.get_policy()
    (estimator_group,) = algorithm.estimator_optimizer.param_groups
    (ppo_group,) = algorithm.optimizer.param_groups
    assert identities(estimator_group["params"]) == identities(actor.estimator.parameters())
    optimized = [*estimator_group["params"], *ppo_group["params"]]
    parameters = [*actor.parameters(), *algorithm.critic.parameters()]
    assert identities(optimized) == identities(parameters)
    for _ in range(2):  # the second time the estimator has had gradients of its own
        roll_out(algorithm)
        estimator = weights(actor.estimator)
        network = weights(actor.mlp)
        PPO.update(algorithm)
        assert same(weights(actor.estimator), estimator)
        assert not same(weights(actor.mlp), network)
        for parameter in actor.estimator.parameters():
            assert parameter.grad is None
        algorithm.update()
        assert not same(weights(actor.estimator), estimator)


def test_losses_are_means_over_the_rollout() -> None:
    # With a learning rate of nearly nothing the mean over mini-batches is that of the rollout.
    algorithm = build(estimator={"learning_rate": 1e-30, "epochs": 2, "mini_batches": 4})
    roll_out(algorithm)
    actor = algorithm.get_policy()
    rollout = algorithm.storage.observations.flatten(0, 1).clone()
    with torch.no_grad():
        inputs = actor.estimator_input(rollout)
        contact_loss, velocity_loss = actor.estimator.losses(inputs, rollout["estimator_target"])
    losses = algorithm.update()
    assert losses["estimator_contact"] == pytest.approx(float(contact_loss), rel=1e-5)
    assert losses["estimator_velocity"] == pytest.approx(float(velocity_loss), rel=1e-5)


def test_the_estimator_learns_a_known_function() -> None:
    torch.manual_seed(0)
    mixing = torch.randn(102, 7) / math.sqrt(102) / 3.0

    def observe_known_function(rows: int = ROBOTS) -> Any:
        obs = observe(rows)
        target = (obs["measured"][:, list(ESTIMATOR_INDICES)] - 1.0) @ mixing
        target[:, :4] = (target[:, :4] > 0.0).float()
        obs["estimator_target"] = target
        return obs

    algorithm = build(hidden=(8,), estimator={"epochs": 4}, num_learning_epochs=1)
    for _ in range(100):
        learn(algorithm, observe_known_function)
    fresh = observe_known_function()
    with torch.no_grad():
        contact, velocity = algorithm.get_policy().estimate(fresh)
    true_contact, true_velocity = fresh["estimator_target"].split([4, 3], dim=1)
    # A random estimate has half of the contacts right and a velocity error of one.
    assert float(((contact > 0.5) == (true_contact > 0.5)).float().mean()) > 0.85
    assert float((velocity - true_velocity).square().mean().sqrt()) < 0.3


def test_statistics_are_those_of_all_rollouts_and_the_first_ratio_is_one() -> None:
    algorithm = build()
    history = []
    for _ in range(3):
        roll_out(algorithm)
        stored = algorithm.storage
        actor = algorithm.get_policy()
        history.append(stored.observations.clone())
        actor(stored.observations.flatten(0, 1), stochastic_output=True)
        again = actor.get_output_log_prob(stored.actions.flatten(0, 1))
        torch.testing.assert_close(again, stored.actions_log_prob.flatten())
        algorithm.update()
    for model, group in ((algorithm.get_policy(), "measured"), (algorithm.critic, "critic")):
        samples = torch.cat([obs[group].flatten(0, 1) for obs in history])
        normalizer = model.obs_normalizer
        assert int(normalizer.count) == len(samples) == 3 * ROBOTS * STEPS
        torch.testing.assert_close(normalizer.mean, samples.mean(dim=0), rtol=1e-4, atol=1e-5)
        std = samples.std(dim=0, correction=0)
        torch.testing.assert_close(normalizer.std, std, rtol=1e-4, atol=1e-5)


# --- The jump input ------------------------------------------------------------------------------


def narrow_state(state: dict[str, Any]) -> dict[str, Any]:
    """Return the checkpoint of the same policy without jump inputs."""
    narrow: dict[str, Any] = {"iter": 9, "infos": {}}
    for key in checkpoint.NETWORKS:
        narrow[key] = {}
        for name, value in state[key].items():
            if not name.endswith(JUMP_WEIGHT):
                narrow[key][name] = value
    # The jump weights are behind weight and bias of the first layer of each network.
    actor_optimizer, estimator_optimizer = checkpoint.OPTIMIZERS
    narrow[actor_optimizer] = narrow_optimizer(state[actor_optimizer], jump_places=(3, 10))
    narrow[estimator_optimizer] = narrow_optimizer(state[estimator_optimizer], jump_places=(2,))
    return narrow


def narrow_optimizer(state: dict[str, Any], jump_places: tuple[int, ...]) -> dict[str, Any]:
    """Return the state of an optimizer without the moments of the jump inputs' weights."""
    (group,) = state["param_groups"]
    moments = {}
    for place in group["params"]:
        if place not in jump_places:
            moments[len(moments)] = state["state"][place]
    narrow_group = {**group, "params": list(range(len(moments)))}
    return {"state": moments, "param_groups": [narrow_group]}


def alike(a: EstimatorPPO, b: EstimatorPPO) -> bool:
    """Return whether actor and critic are the same, bit for bit."""
    same_actor = same(weights(a.get_policy()), weights(b.get_policy()))
    return same_actor and same(weights(a.critic), weights(b.critic))


def outputs(algorithm: EstimatorPPO, obs: Any) -> list[bytes]:
    """Return the bytes of all that the networks compute."""
    actor = algorithm.get_policy()
    with torch.inference_mode():
        contact, velocity = actor.estimate(obs)
        tensors = [actor(obs), algorithm.critic(obs), contact, velocity]
    return [tensor.numpy().tobytes() for tensor in tensors]


def jump_weights(algorithm: EstimatorPPO) -> list[Any]:
    """Return the weights of the jump inputs in all networks."""
    values = []
    for model in (algorithm.get_policy(), algorithm.critic):
        for name, value in model.state_dict().items():
            if name.endswith(JUMP_WEIGHT):
                values.append(value)
    return values


def test_fed_zeros_the_jump_input_stays_blank() -> None:
    """After updates on zeros its weights are zero, and the function is that without it."""
    algorithm = trained(2, jump=False, hidden=PAPER, num_learning_epochs=1)
    assert len(jump_weights(algorithm)) == 3
    for value in jump_weights(algorithm):
        assert not value.any()
    for threads in (1, 2):
        torch.set_num_threads(threads)
        for rows in (1, 2, 7, 64, 500):
            obs = observe(rows)
            with_jump = outputs(algorithm, obs)
            obs["jump"] = obs["jump"] * 0.0
            obs["critic_jump"] = obs["critic_jump"] * 0.0
            assert outputs(algorithm, obs) == with_jump, (rows, threads)
    # By PyTorch's own linear layer, too.
    layer = algorithm.get_policy().mlp[0]
    x = torch.randn(7, 53)
    plain = torch.nn.functional.linear(x[:, :52].contiguous(), layer.weight, layer.bias)
    assert torch.equal(layer(x), plain)
    learn(algorithm)
    for value in jump_weights(algorithm):
        assert value.any()


def test_the_moments_of_the_jump_inputs_begin_anew() -> None:
    """Their first step is one learning rate long, though all others have a history."""
    algorithm = trained(3, jump=False)
    algorithm.reset_jump_moments()
    rate = 1e-3
    for optimizer in (algorithm.optimizer, algorithm.estimator_optimizer):
        for group in optimizer.param_groups:
            group["lr"] = rate
            for parameter in group["params"]:
                parameter.grad = torch.ones_like(parameter)
        optimizer.step()
    for value in jump_weights(algorithm):
        torch.testing.assert_close(value, torch.full_like(value, -rate), rtol=1e-4, atol=0.0)


def test_a_checkpoint_without_jump_inputs_is_widened() -> None:
    before = trained(2, jump=False)
    state = {**copy.deepcopy(before.save()), "iter": 9, "infos": {}}
    narrow = narrow_state(state)
    assert not checkpoint.uses_jump_input(narrow)
    after = build()
    assert after.load(narrow)
    for rows in (1, 64):
        obs = observe(rows)
        assert outputs(after, obs) == outputs(before, obs)
    # The next update is that of the algorithm which had the inputs all along.
    for algorithm in (before, after):
        algorithm.reset_jump_moments()
        torch.manual_seed(4)
        learn(algorithm)
    assert alike(before, after)
    assert checkpoint.uses_jump_input(after.save())
    narrow["optimizer_state_dict"]["param_groups"][0]["params"].pop()
    with pytest.raises(ValueError, match="size"):
        build().load(narrow)


# --- Checkpoints ---------------------------------------------------------------------------------


def test_saved_and_loaded_it_continues_alike(tmp_path: Path) -> None:
    first = trained(1)
    second = build()
    path = tmp_path / "model_3.pt"
    checkpoint.write_checkpoint(path, {**first.save(), "iter": 3, "infos": {"note": "x"}})
    assert [file.name for file in tmp_path.iterdir()] == ["model_3.pt"]
    state = checkpoint.read_checkpoint(path)
    assert second.load(state)
    for algorithm in (first, second):
        torch.manual_seed(1)
        learn(algorithm)
    assert alike(first, second)
    assert first.learning_rate == second.learning_rate
    third = build()
    assert not third.load(state, {"actor": True})
    assert not third.estimator_optimizer.state


class Harmful:
    """Would write a file if it were unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.write_text, (self.path, "run")


def test_other_files_are_refused_and_run_no_code(tmp_path: Path) -> None:
    path = tmp_path / "model_1.pt"
    mark = tmp_path / "mark"
    torch.save({"actor_state_dict": Harmful(mark)}, path)
    with pytest.raises(ArtefactError, match="not a checkpoint"):
        checkpoint.read_checkpoint(path)
    assert not mark.exists()
    torch.save({"actor_state_dict": {}}, path)
    with pytest.raises(ArtefactError, match="critic_state_dict"):
        checkpoint.read_checkpoint(path)
    for content in (b"", b"text", path.read_bytes()[:300]):
        path.write_bytes(content)
        with pytest.raises(ArtefactError, match="not a checkpoint"):
            checkpoint.read_checkpoint(path)
    with pytest.raises(ArtefactError, match="no such file"):
        checkpoint.read_checkpoint(tmp_path / "none.pt")


def test_the_last_checkpoint_is_that_of_the_highest_iteration(tmp_path: Path) -> None:
    assert checkpoint.latest_checkpoint(tmp_path) is None
    for name in ("model_9.pt", "model_10.pt", "model_best.pt", "walk.pt"):
        (tmp_path / name).touch()
    assert checkpoint.latest_checkpoint(tmp_path) == tmp_path / "model_10.pt"


def test_a_number_that_is_not_finite_is_found_by_its_path() -> None:
    tree = {"a": [torch.ones(2), {"b": torch.tensor([1.0, math.nan])}], "c": 3}
    assert checkpoint.not_finite(tree) == "a/1/b"
    assert checkpoint.not_finite({"a": [torch.ones(2)], "c": None}) is None


# --- Several processes ---------------------------------------------------------------------------


def one_of_two(rank: int, port: int, folder: str) -> None:
    """A process of two: learns from data of its own and writes its weights."""
    torch.set_num_threads(1)
    torch.distributed.init_process_group(
        "gloo", init_method=f"tcp://127.0.0.1:{port}", rank=rank, world_size=2
    )
    torch.manual_seed(10 + rank)
    algorithm = build(multi_gpu={"global_rank": rank, "local_rank": rank, "world_size": 2})
    algorithm.broadcast_parameters()
    for _ in range(2):
        learn(algorithm)
    result = {
        "actor": weights(algorithm.get_policy()),
        "critic": weights(algorithm.critic),
        "data": {"measured": algorithm.storage.observations["measured"].clone()},
    }
    torch.save(result, Path(folder) / f"{rank}.pt")
    torch.distributed.destroy_process_group()


@pytest.mark.slow
def test_processes_stay_together(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    # Forked, they need not import PyTorch and mjlab again.
    arguments = (port, str(tmp_path))
    torch.multiprocessing.start_processes(one_of_two, arguments, nprocs=2, start_method="fork")
    first = torch.load(tmp_path / "0.pt", weights_only=True)
    second = torch.load(tmp_path / "1.pt", weights_only=True)
    assert not same(first["data"], second["data"])
    assert same(first["actor"], second["actor"])
    assert same(first["critic"], second["critic"])
    assert int(first["actor"]["obs_normalizer.count"]) == 2 * 2 * ROBOTS * STEPS
