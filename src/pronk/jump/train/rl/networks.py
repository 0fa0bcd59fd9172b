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
ESTIMATOR_HIDDEN_DIMS = (256, 128)
"""Sizes of the estimator's hidden layers (paper N1)."""

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
    """Configuration of the actor, which is as large, with the estimator in it."""

    distribution_cfg: dict[str, Any] | None = field(
        default_factory=lambda: {
            "class_name": "GaussianDistribution",
            "init_std": 1.0,
            "std_type": "scalar",
        }
    )
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

    def _load_from_state_dict(
        self,
        state_dict: dict[str, Any],
        prefix: str,
        local_metadata: dict[str, Any],
        strict: bool,
        missing_keys: list[str],
        unexpected_keys: list[str],
        error_msgs: list[str],
    ) -> None:
        """Load the weights, `jump_weight` as zeros where the state has none."""
        state_dict.setdefault(f"{prefix}{JUMP_WEIGHT}", torch.zeros_like(self.jump_weight))
        super()._load_from_state_dict(
            state_dict, prefix, local_metadata, strict, missing_keys, unexpected_keys, error_msgs
        )


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
    """Average a tensor over the processes, in place.

    Args:
        value: The tensor; every process must call with one of the same shape.
        world_size: Number of processes.

    Returns:
        The same tensor.
    """
    if world_size > 1:
        torch.distributed.all_reduce(value)
        value /= world_size
    return value


class JumpModel(MLPModel):
    """An MLP over a normalized group of observations and a raw jump group behind it."""

    group: ClassVar[str]
    jump_group: ClassVar[str]
    jump_size: int

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        hidden_dims: Sequence[int] = (1024, 512, 256),
        activation: str = "elu",
        obs_normalization: bool = True,
        distribution_cfg: dict[str, Any] | None = None,
    ) -> None:
        """Build the network; arguments are those of `rsl_rl.models.MLPModel`."""
        super().__init__(
            obs,
            obs_groups,
            obs_set,
            output_dim,
            hidden_dims,
            activation,
            obs_normalization,
            distribution_cfg,
        )
        if self.obs_normalization:
            self.obs_normalizer = RolloutNormalization(self.obs_dim - self.jump_size)
        self.mlp[0] = JumpLinear(self.mlp[0], self.jump_size)

    def _get_obs_dim(
        self, obs: TensorDict, obs_groups: dict[str, list[str]], obs_set: str
    ) -> tuple[list[str], int]:
        """Return the groups that the network reads and the number of their numbers."""
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
        """Return the network's input, the normalized group and the jump group."""
        return torch.cat([self.obs_normalizer(obs[self.group]), obs[self.jump_group]], dim=-1)

    def update_normalization(self, obs: TensorDict) -> None:
        """Do nothing: rsl_rl calls it in every step; see `learn_normalization`."""

    def learn_normalization(self, obs: Observations, world_size: int = 1) -> None:
        """Update the statistics with the observations of a rollout."""
        if self.obs_normalization:
            self.obs_normalizer.learn(obs[self.group], world_size)


class StateEstimator(nn.Module):
    """Foot contacts and trunk velocity from the normalized measurement and the jump input.

    A small network beside the actor, trained on the simulator's state while PPO trains the actor
    that reads its estimate (paper N1; Ji et al. 2022). Its input is `ESTIMATOR_INDICES` of the
    normalized measurement, then the jump input, (..., 102 + jump_size).
    """

    def __init__(self, jump_size: int = 1) -> None:
        super().__init__()
        input_size = len(ESTIMATOR_INDICES) + jump_size
        self.mlp = MLP(input_size, ESTIMATE_SIZE, list(ESTIMATOR_HIDDEN_DIMS), "elu")
        self.mlp[0] = JumpLinear(self.mlp[0], jump_size)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return contact probabilities (..., 4) and the velocity in the trunk's frame [m/s]."""
        contact, velocity = self.mlp(x).split(list(ESTIMATE.values()), dim=-1)
        return torch.sigmoid(contact), velocity

    def losses(self, x: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the losses of a batch.

        Args:
            x: Inputs, (N, 102 + jump_size).
            target: True contacts (0 or 1), then the true velocity [m/s], (N, 7).

        Returns:
            Mean cross entropy of the contacts [nat] and mean squared velocity error [m^2/s^2].
        """
        contact, velocity = self.mlp(x).split(list(ESTIMATE.values()), dim=-1)
        true_contact, true_velocity = target.split(list(ESTIMATE.values()), dim=-1)
        contact_loss = nn.functional.binary_cross_entropy_with_logits(contact, true_contact)
        velocity_loss = nn.functional.mse_loss(velocity, true_velocity)
        return contact_loss, velocity_loss


class EstimatorActor(JumpModel):
    """The estimator and, behind it, the network that acts, which gets no gradient through it."""

    group = "measured"
    jump_group = "jump"

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        hidden_dims: Sequence[int] = (1024, 512, 256),
        activation: str = "elu",
        obs_normalization: bool = True,
        distribution_cfg: dict[str, Any] | None = None,
    ) -> None:
        """Build both networks; arguments are those of `rsl_rl.models.MLPModel`."""
        super().__init__(
            obs,
            obs_groups,
            obs_set,
            output_dim,
            hidden_dims,
            activation,
            obs_normalization,
            distribution_cfg,
        )
        measured_size = self.obs_dim - self.jump_size
        if measured_size != MEASURED_SIZE:
            raise PronkError(
                f"the measured vector has {measured_size} numbers; expected {MEASURED_SIZE}, as in "
                "pronk.policy.observation."
            )
        self.estimator = StateEstimator(self.jump_size)
        actor_indices = torch.tensor(ACTOR_INDICES)
        estimator_indices = torch.tensor(ESTIMATOR_INDICES)
        self.register_buffer("_actor_indices", actor_indices, persistent=False)
        self.register_buffer("_estimator_indices", estimator_indices, persistent=False)

    def _get_latent_dim(self) -> int:
        """Return the size of the acting network's input."""
        return ESTIMATE_SIZE + len(ACTOR_INDICES) + self.jump_size

    def get_latent(
        self, obs: Observations, masks: Tensor | None = None, hidden_state: Any = None
    ) -> Tensor:
        """Return the acting network's input: estimate 7, current measurement 45, jump input."""
        measured = self.obs_normalizer(obs[self.group])
        with torch.no_grad():
            contact, velocity = self.estimator(self._estimator_input(measured, obs))
        current = measured[..., self._actor_indices]
        return torch.cat([contact, velocity, current, obs[self.jump_group]], -1)

    def limit_noise(self, largest: float) -> None:
        """Lower the standard deviations of the actions to `largest` at most."""
        with torch.no_grad():
            self.distribution.std_param.clamp_(max=largest)

    def estimator_input(self, obs: Observations) -> Tensor:
        """Return the estimator's input for observations, (..., 102 + jump_size)."""
        return self._estimator_input(self.obs_normalizer(obs[self.group]), obs)

    def estimate(self, obs: Observations) -> tuple[Tensor, Tensor]:
        """Return the estimator's output for observations."""
        return self.estimator(self.estimator_input(obs))

    def _estimator_input(self, measured: Tensor, obs: Observations) -> Tensor:
        """Return the estimator's input from the normalized measurement."""
        return torch.cat([measured[..., self._estimator_indices], obs[self.jump_group]], dim=-1)


class JumpCritic(JumpModel):
    """The critic: the simulator's state, and the state of the jump."""

    group = "critic"
    jump_group = "critic_jump"
