"""Widening: the same outputs bit for bit, and learning that goes on where it was."""

from __future__ import annotations

import copy
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

from pronk.errors import PronkError
from pronk.train.rl.jump_linear import JumpLinear
from pronk.train.rl.ppo import EstimatorPPO
from pronk.train.rl.widen import widen_state
from small_ppo import (
    build,
    observe,
    one_thread,  # noqa: F401
    roll_out,
    same,
    weights,
)

pytestmark = [pytest.mark.train, pytest.mark.usefixtures("one_thread")]

PAPER = (1024, 512, 256)


def trained(**cfg: Any) -> EstimatorPPO:
    """Phase 1 after two iterations: moments and statistics are no longer those of the start."""
    algorithm = build(**cfg)
    for _ in range(2):
        roll_out(algorithm)
        algorithm.update()
    return algorithm


def widened(narrow: EstimatorPPO, **cfg: Any) -> EstimatorPPO:
    wide = build(jump=True, **cfg)
    wide.load(widen_state(narrow.save(), wide))
    return wide


def outputs(algorithm: EstimatorPPO, obs: Any) -> list[bytes]:
    actor, critic = algorithm.get_policy(), algorithm.get_critic()
    with torch.inference_mode():
        found = [actor(obs), critic(obs), *actor.estimate(obs)]
    return [value.cpu().numpy().tobytes() for value in found]


def test_jump_linear_is_the_layer_it_splits() -> None:
    whole = torch.nn.Linear(10, 6)
    split = JumpLinear(whole, 3)
    x = torch.randn(4, 10)
    torch.testing.assert_close(split(x), whole(x))
    assert split.jump_weight.shape == (6, 3)
    assert split.in_features == 7


@pytest.mark.parametrize(
    "device",
    [
        "cpu",
        pytest.param(
            "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
        ),
    ],
)
def test_outputs_stay_the_same_bit_for_bit(device: str) -> None:
    narrow = trained(hidden=PAPER, device=device)
    wide = widened(narrow, hidden=PAPER, device=device)
    for threads in (1, 2):
        torch.set_num_threads(threads)
        for rows in (1, 2, 3, 7, 64, 500):
            obs = observe(rows).to(device)
            before = outputs(narrow, obs)
            for jump in (0.0, 1.0):
                obs["jump"] = torch.full((rows, 1), jump, device=device)
                assert outputs(wide, obs) == before, (rows, jump, threads)


def test_what_was_learned_is_kept() -> None:
    narrow = trained()
    wide = widened(narrow)
    for old, new in (
        (narrow.get_policy(), wide.get_policy()),
        (narrow.get_critic(), wide.get_critic()),
    ):
        kept = weights(new)
        added = {name: kept.pop(name) for name in list(kept) if name.endswith("jump_weight")}
        assert same(kept, weights(old))
        assert added
        assert all(not value.any() for value in added.values())
    assert wide.learning_rate == narrow.learning_rate


def named(algorithm: EstimatorPPO) -> dict[str, torch.nn.Parameter]:
    models = {"actor": algorithm.get_policy(), "critic": algorithm.get_critic()}
    return dict(torch.nn.ModuleDict(models).named_parameters())


def optimizer_of(name: str, algorithm: EstimatorPPO) -> torch.optim.Optimizer:
    estimator = name.startswith("actor.estimator.")
    return algorithm.estimator_optimizer if estimator else algorithm.optimizer


def test_next_step_of_adam_by_hand() -> None:
    narrow = trained()
    wide = widened(narrow)
    old, new = named(narrow), named(wide)
    before = {name: parameter.detach().clone() for name, parameter in new.items()}
    for parameter in new.values():
        parameter.grad = torch.randn_like(parameter)
    expected = {}
    for name, parameter in new.items():
        grad = parameter.grad
        step, mean, square = 0.0, torch.zeros_like(grad), torch.zeros_like(grad)
        if name in old:
            state = optimizer_of(name, narrow).state[old[name]]
            step = float(state["step"])
            mean, square = state["exp_avg"].clone(), state["exp_avg_sq"].clone()
            assert step > 0
        step += 1.0
        mean = (0.9 * mean + 0.1 * grad) / (1.0 - 0.9**step)
        square = (0.999 * square + 0.001 * grad**2) / (1.0 - 0.999**step)
        rate = optimizer_of(name, wide).param_groups[0]["lr"]
        expected[name] = before[name] - rate * mean / (square.sqrt() + 1e-8)
    wide.optimizer.step()
    wide.estimator_optimizer.step()
    added = [name for name in new if name not in old]
    assert len(added) == 3
    for name, parameter in new.items():
        torch.testing.assert_close(parameter.detach(), expected[name], msg=name)


def test_jump_weights_learn() -> None:
    wide = widened(trained())
    roll_out(wide)
    wide.update()
    added = {name: p for name, p in named(wide).items() if name.endswith("jump_weight")}
    assert set(added) == {
        "actor.mlp.0.jump_weight",
        "actor.estimator.mlp.0.jump_weight",
        "critic.mlp.0.jump_weight",
    }
    assert all(parameter.detach().any() for parameter in added.values())


def test_nothing_is_shared_with_what_was_given() -> None:
    narrow, wide = trained(), build(jump=True)
    state = narrow.save()
    before = copy.deepcopy(state)
    wide.load(widen_state(state, wide, action_std=0.5))
    for _ in range(2):
        roll_out(wide)
        wide.update()
    torch.testing.assert_close(narrow.save(), before, rtol=0, atol=0)


def test_exploration_can_begin_anew() -> None:
    narrow, wide = trained(), build(jump=True)
    wide.load(widen_state(narrow.save(), wide, action_std=0.7))
    std = wide.get_policy().distribution.std_param
    torch.testing.assert_close(std.detach(), torch.full((12,), 0.7))
    assert std not in wide.optimizer.state
    with pytest.raises(PronkError, match=r"action_std is 0; expected more than 0"):
        widen_state(narrow.save(), wide, action_std=0.0)


def test_state_made_in_inference_mode() -> None:
    # A training loop may leave inference tensors behind, which nobody may write to afterwards.
    narrow = trained()
    with torch.inference_mode():
        state = {
            name: {k: v.clone() for k, v in part.items()} if name.endswith("r_state_dict") else part
            for name, part in narrow.save().items()
            if not name.startswith(("optimizer", "estimator"))
        }
    state = {**narrow.save(), **state}
    wide = build(jump=True)
    wide.load(widen_state(state, wide))
    roll_out(wide)
    wide.update()


def test_before_the_first_update() -> None:
    narrow = build()
    wide = widened(narrow)
    assert not wide.optimizer.state
    assert outputs(narrow, observe()) != outputs(build(), observe())
    obs = observe()
    assert outputs(wide, obs) == outputs(narrow, obs)


def test_other_entries_are_handed_on() -> None:
    narrow, wide = build(), build(jump=True)
    assert widen_state({**narrow.save(), "iter": 7}, wide)["iter"] == 7


def test_what_does_not_fit_is_refused() -> None:
    narrow, wide = build(), build(jump=True)
    state = narrow.save()
    with pytest.raises(PronkError, match=r"the actor to widen into has no jump inputs; build it"):
        widen_state(state, build())
    with pytest.raises(PronkError, match=r"the actor has jump inputs already \(mlp.0.jump_weight"):
        widen_state(wide.save(), wide)
    with pytest.raises(PronkError, match=r"actor mlp.0.weight is \(32, 52\) in .* and \(16, 52\)"):
        widen_state(state, build(jump=True, hidden=(16, 16)))
    with pytest.raises(PronkError, match=r"actor mlp.6.bias is missing in the state and \(12,\)"):
        widen_state(state, build(jump=True, hidden=(32, 16, 16)))
    with pytest.raises(PronkError, match=r"has no estimator_optimizer_state_dict; expected what"):
        widen_state({k: v for k, v in state.items() if not k.startswith("estimator")}, wide)
    swapped = {**state, "optimizer_state_dict": state["estimator_optimizer_state_dict"]}
    with pytest.raises(PronkError, match=r"state is of 6 parameters; expected 13"):
        widen_state(swapped, wide)
