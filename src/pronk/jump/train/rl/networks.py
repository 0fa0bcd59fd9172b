"""Actor with estimator, and critic, as rsl_rl runs them (paper N1 to N3).

Both read one group of observations that is normalized (`measured`, `critic`) and, behind it, one
that is not (`jump`, `critic_jump`). The jump inputs begin with zero weights and are fed zeros in
phase 1, so that they have no gradient and the function is that of a network without them, bit for
bit: the blank neuron of the paper's widening.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from mjlab.rl import RslRlModelCfg
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP, EmpiricalNormalization
from tensordict import TensorDict
from torch import Tensor, nn

from pronk.errors import PronkError
from pronk.policy.observation import (
    ACTOR_INDICES,
    ESTIMATE,
    ESTIMATE_SIZE,
    ESTIMATOR_INDICES,
    MEASURED_SIZE,
)

JUMP_WEIGHT = "jump_weight"
"""Last part of the name of a jump input's weights in a network's state."""

Observations = TensorDict | Mapping[str, Tensor]
"""Groups of observations by name, each (..., size)."""


@dataclass
class JumpCriticCfg(RslRlModelCfg):
    """Configuration of the critic; sizes of the paper (N2)."""

    hidden_dims: tuple[int, ...] = (1024, 512, 256)
    obs_normalization: bool = True
    class_name: str = "pronk.jump.train.rl.networks:JumpCritic"


@dataclass
class EstimatorActorCfg(JumpCriticCfg):
    """Configuration of the actor, which is as large, and the estimator in it."""

    distribution_cfg: dict[str, Any] | None = field(
        default_factory=lambda: {
            "class_name": "GaussianDistribution",
            "init_std": 1.0,
            "std_type": "scalar",
        }
    )
    estimator_hidden_dims: tuple[int, ...] = (256, 128)
    """Of the estimator (paper N1)."""
    class_name: str = "pronk.jump.train.rl.networks:EstimatorActor"


class JumpLinear(nn.Linear):
    """A linear layer whose last inputs have weights of their own, `jump_weight`, zero at first.

    y = (x[:in] weight^T + bias) + x[in:] jump_weight^T. With a zero `jump_weight` y is bit for bit
    that of `nn.Linear` for x[:in]. One matrix product over all inputs would not be: with one column
    more it is summed in another order. A state without `jump_weight` is loaded as one with zeros
    (Net2Net, paper N3).
    """

    def __init__(self, layer: nn.Linear, jump_size: int) -> None:
        super().__init__(layer.in_features - jump_size, layer.out_features)
        with torch.no_grad():
            self.weight.copy_(layer.weight[:, : self.in_features])
            self.bias.copy_(layer.bias)
        self.jump_weight = nn.Parameter(torch.zeros(layer.out_features, jump_size))

    def forward(self, x: Tensor) -> Tensor:
        """(..., in + jump) to (..., out)."""
        # A view with gaps between its rows may be multiplied by another kernel: hence contiguous.
        narrow = x[..., : self.in_features].contiguous()
        jump = x[..., self.in_features :]
        return super().forward(narrow) + nn.functional.linear(jump, self.jump_weight)

    def _load_from_state_dict(self, state: dict[str, Any], prefix: str, *rest: Any) -> None:
        state.setdefault(f"{prefix}{JUMP_WEIGHT}", torch.zeros_like(self.jump_weight))
        super()._load_from_state_dict(state, prefix, *rest)


class RolloutNormalization(EmpiricalNormalization):
    """rsl_rl's normalization, (x - mean) / (std + 0.01), updated once an iteration.

    rsl_rl 5.4.2 updates it in every environment step, in each process separately. Then PPO computes
    log-probabilities with other statistics than those that the actions were drawn with, and on
    several GPUs the processes drift apart.
    """

    @torch.no_grad()
    def learn(self, x: Tensor, world_size: int = 1) -> None:
        """Update with the samples of a rollout, (..., size), as many in every process."""
        x = x.flatten(0, -2)
        mean = average(x.mean(dim=0, keepdim=True), world_size)
        var = average((x - mean).square().mean(dim=0, keepdim=True), world_size)
        self.count += x.shape[0] * world_size
        rate = x.shape[0] * world_size / self.count
        delta = mean - self._mean
        self._mean += rate * delta
        # Variance of a mixture: that of each part, and that between their means.
        self._var += rate * (var - self._var + delta * (mean - self._mean))
        self._std.copy_(self._var.sqrt())


def average(value: Tensor, world_size: int) -> Tensor:
    """Mean of `value` over the processes, in place; every one must call with the same shape."""
    if world_size > 1:
        torch.distributed.all_reduce(value)
        value /= world_size
    return value


class JumpModel(MLPModel):
    """An MLP over a normalized group and a raw jump group behind it."""

    group: ClassVar[str]
    jump_group: ClassVar[str]
    jump_size: int

    def __init__(self, *args: Any, **cfg: Any) -> None:
        super().__init__(*args, **cfg)
        if self.obs_normalization:
            self.obs_normalizer = RolloutNormalization(self.obs_dim - self.jump_size)
        self.mlp[0] = JumpLinear(self.mlp[0], self.jump_size)

    def _get_obs_dim(
        self, obs: TensorDict, obs_groups: dict[str, list[str]], obs_set: str
    ) -> tuple[list[str], int]:
        groups, size = super()._get_obs_dim(obs, obs_groups, obs_set)
        if tuple(groups) != (self.group, self.jump_group):
            raise PronkError(
                f"{type(self).__name__} reads the groups {', '.join(groups)}; expected "
                f"{self.group} and {self.jump_group}, in this order."
            )
        self.jump_size = obs[self.jump_group].shape[-1]
        return groups, size

    def get_latent(
        self, obs: Observations, masks: Tensor | None = None, hidden_state: Any = None
    ) -> Tensor:
        """The network's input."""
        return torch.cat([self.obs_normalizer(obs[self.group]), obs[self.jump_group]], dim=-1)

    def update_normalization(self, obs: TensorDict) -> None:
        """No-op: rsl_rl calls it in every step; see `learn_normalization`."""

    def learn_normalization(self, obs: Observations, world_size: int = 1) -> None:
        """Update the statistics with the observations of a rollout."""
        if self.obs_normalization:
            self.obs_normalizer.learn(obs[self.group], world_size)


class Estimator(nn.Module):
    """Foot contacts and trunk velocity from the normalized measurement and the jump input.

    A small network beside the actor, trained on the simulator's state while PPO trains the actor
    that reads its estimate (paper N1; Ji et al. 2022). Its input is `ESTIMATOR_INDICES` of the
    normalized measurement, then the jump input, (..., 102 + jump_size).
    """

    def __init__(self, jump_size: int = 1, hidden_dims: Sequence[int] = (256, 128)) -> None:
        super().__init__()
        self.mlp = MLP(len(ESTIMATOR_INDICES) + jump_size, ESTIMATE_SIZE, list(hidden_dims), "elu")
        self.mlp[0] = JumpLinear(self.mlp[0], jump_size)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Contact probabilities (..., 4), velocity in the trunk's frame [m/s] (..., 3)."""
        contact, velocity = self.mlp(x).split(list(ESTIMATE.values()), dim=-1)
        return torch.sigmoid(contact), velocity

    def losses(self, x: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Mean cross entropy of the contacts [nat], mean squared velocity error [m^2/s^2].

        `target` has contacts (0 or 1), then velocity, (N, 7).
        """
        contact, velocity = self.mlp(x).split(list(ESTIMATE.values()), dim=-1)
        true_contact, true_velocity = target.split(list(ESTIMATE.values()), dim=-1)
        return (
            nn.functional.binary_cross_entropy_with_logits(contact, true_contact),
            nn.functional.mse_loss(velocity, true_velocity),
        )


class EstimatorActor(JumpModel):
    """The estimator and, behind it, the network that acts, which gets no gradient through it."""

    group = "measured"
    jump_group = "jump"

    def __init__(
        self, *args: Any, estimator_hidden_dims: Sequence[int] = (256, 128), **cfg: Any
    ) -> None:
        super().__init__(*args, **cfg)
        if self.obs_dim - self.jump_size != MEASURED_SIZE:
            raise PronkError(
                f"the measured vector has {self.obs_dim - self.jump_size} numbers; expected"
                f" {MEASURED_SIZE}, as in pronk.policy.observation."
            )
        self.estimator = Estimator(self.jump_size, estimator_hidden_dims)
        for name, indices in (("actor", ACTOR_INDICES), ("estimator", ESTIMATOR_INDICES)):
            self.register_buffer(f"_{name}_indices", torch.tensor(indices), persistent=False)

    def _get_latent_dim(self) -> int:
        return ESTIMATE_SIZE + len(ACTOR_INDICES) + self.jump_size

    def get_latent(
        self, obs: Observations, masks: Tensor | None = None, hidden_state: Any = None
    ) -> Tensor:
        """The acting network's input: estimate 7, current measurement 45, jump input."""
        measured = self.obs_normalizer(obs[self.group])
        with torch.no_grad():
            estimate = self.estimator(self._estimator_input(measured, obs))
        return torch.cat([*estimate, measured[..., self._actor_indices], obs[self.jump_group]], -1)

    def limit_noise(self, largest: float) -> None:
        """Lower the standard deviations of the actions to `largest` at most."""
        with torch.no_grad():
            self.distribution.std_param.clamp_(max=largest)

    def estimator_input(self, obs: Observations) -> Tensor:
        """The estimator's input, (..., 102 + jump)."""
        return self._estimator_input(self.obs_normalizer(obs[self.group]), obs)

    def estimate(self, obs: Observations) -> tuple[Tensor, Tensor]:
        """The estimator's output for observations."""
        return self.estimator(self.estimator_input(obs))

    def _estimator_input(self, measured: Tensor, obs: Observations) -> Tensor:
        return torch.cat([measured[..., self._estimator_indices], obs[self.jump_group]], dim=-1)


class JumpCritic(JumpModel):
    """The critic: the simulator's state, and the state of the jump."""

    group = "critic"
    jump_group = "critic_jump"
