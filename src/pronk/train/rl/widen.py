"""Widening: a walking policy gets the jump input and goes on as if nothing had happened.

Net2Net (paper N3): actor, critic and estimator get the jump inputs with zero weights, so what they
say stays the same bit for bit (see `jump_linear`) whatever the new inputs are, and training moves
the weights away from zero. Everything else that learning has gathered is kept: the statistics of
the normalisation, which do not cover the jump inputs; the spread of the actions; the learning
rates; and Adam's moments and step counts of every weight that was there.

The new weights are parameters of their own, so they begin with an Adam of their own: zero moments
and a step count of zero. With the count of the old weights their zero moments would pass for a
long average, and their first step would be (1 - 0.9) / sqrt(1 - 0.999) = 3.2 learning rates long
instead of one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from pronk.errors import PronkError
from pronk.train.rl.jump_linear import JUMP_WEIGHT
from pronk.train.rl.ppo import EstimatorPPO

_NETWORKS = ("actor_state_dict", "critic_state_dict")
_OPTIMIZERS = ("optimizer_state_dict", "estimator_optimizer_state_dict")


def widen_state(
    narrow: Mapping[str, Any], wide: EstimatorPPO, *, action_std: float | None = None
) -> dict[str, Any]:
    """The state of an algorithm without jump inputs as one with them can load it.

    `wide.load(widen_state(narrow.save(), wide))` is the widening. Nothing that is given is changed
    and nothing that is returned shares memory with it.

    Args:
        narrow: What `EstimatorPPO.save` gave in phase 1, or the same read from a checkpoint;
            entries that are not the algorithm's are handed on as they are.
        wide: Algorithm with jump inputs, of the same networks otherwise; only looked at.
        action_std: Standard deviation of every action to explore anew with; None keeps the learned
            ones.

    Raises:
        PronkError: The state is not one of phase 1, `wide` has no jump inputs, the networks differ
            in more than the jump inputs, or `action_std` is not above 0.
    """
    missing = [key for key in (*_NETWORKS, *_OPTIMIZERS) if key not in narrow]
    if missing:
        raise PronkError(
            f"the state to widen has no {', '.join(missing)}; expected what EstimatorPPO.save gives"
            " at the end of phase 1."
        )
    template = wide.save()
    state = dict(narrow)
    for key in _NETWORKS:
        state[key] = _widen_network(narrow[key], template[key], key.removesuffix("_state_dict"))
    anew = set()
    if action_std is not None:
        anew = _set_action_std(state["actor_state_dict"], action_std)
    for key, optimizer in zip(_OPTIMIZERS, (wide.optimizer, wide.estimator_optimizer), strict=True):
        state[key] = _widen_optimizer(narrow[key], _names(optimizer, wide), anew)
    return state


def _widen_network(
    narrow: Mapping[str, Tensor], wide: Mapping[str, Tensor], name: str
) -> dict[str, Tensor]:
    new = [key for key in wide if _is_new(key)]
    if not new:
        raise PronkError(
            f"the {name} to widen into has no jump inputs; build it with the observation groups of"
            " phase 2."
        )
    already = [key for key in narrow if _is_new(key)]
    if already:
        raise PronkError(f"the {name} has jump inputs already ({already[0]}); nothing to widen.")
    differing = sorted(set(narrow) ^ (set(wide) - set(new)))
    differing += [key for key in narrow if key in wide and narrow[key].shape != wide[key].shape]
    if differing:
        key = differing[0]
        raise PronkError(
            f"{name} {key} is {_shape(narrow, key)} in the state and {_shape(wide, key)} in the"
            " network to widen into; expected networks that differ in the jump inputs alone."
        )
    widened = {key: value.detach().clone() for key, value in narrow.items()}
    return {key: widened.get(key, torch.zeros_like(value)) for key, value in wide.items()}


def _set_action_std(actor: dict[str, Tensor], action_std: float) -> set[str]:
    """Set it in place; names of the parameters whose moments no longer mean anything."""
    if not action_std > 0.0:
        raise PronkError(f"action_std is {action_std:g}; expected more than 0.")
    values = {
        "distribution.std_param": action_std,
        "distribution.log_std_param": math.log(action_std),
    }
    found = [key for key in values if key in actor]
    if not found:
        raise PronkError(f"the actor has none of {', '.join(values)}; leave action_std out.")
    for key in found:
        actor[key].fill_(values[key])
    return {f"actor.{key}" for key in found}


def _widen_optimizer(
    narrow: Mapping[str, Any], names: list[str], anew: Iterable[str]
) -> dict[str, Any]:
    """Number the parameters as the wide optimizer does; those that are new have no state.

    torch begins a parameter without state at zero moments and step 0.
    """
    (group,) = narrow["param_groups"]
    old = [name for name in names if not _is_new(name)]
    if len(old) != len(group["params"]):
        raise PronkError(
            f"the optimizer's state is of {len(group['params'])} parameters; expected {len(old)}:"
            " those of the networks without the jump inputs."
        )
    index = dict(zip(old, group["params"], strict=True))
    moments = {
        i: {key: _copy(value) for key, value in narrow["state"][index[name]].items()}
        for i, name in enumerate(names)
        if name in index and name not in anew and index[name] in narrow["state"]
    }
    return {"state": moments, "param_groups": [{**group, "params": list(range(len(names)))}]}


def _names(optimizer: torch.optim.Optimizer, algorithm: EstimatorPPO) -> list[str]:
    """Names of an optimizer's parameters, in its order."""
    networks = {"actor": algorithm.get_policy(), "critic": algorithm.get_critic()}
    known = {p: name for name, p in nn.ModuleDict(networks).named_parameters()}
    (group,) = optimizer.param_groups
    return [known[parameter] for parameter in group["params"]]


def _is_new(name: str) -> bool:
    return name.rpartition(".")[2] == JUMP_WEIGHT


def _shape(state: Mapping[str, Tensor], key: str) -> str:
    return str(tuple(state[key].shape)) if key in state else "missing"


def _copy(value: Any) -> Any:
    return value.detach().clone() if isinstance(value, Tensor) else value
