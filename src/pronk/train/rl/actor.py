"""Actor and critic as rsl_rl runs them, each able to take the jump input later.

Both read one group of observations that is normalised (`measured`, `critic`) and, from phase 2
on, one that is not (`jump`, `critic_jump`). So the statistics need no widening, only the first
layers do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from mjlab.rl import RslRlModelCfg
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor

from pronk.errors import PronkError
from pronk.policy.layout import ACTOR_INDICES, ACTOR_SIZE, ESTIMATOR_INDICES, MEASURED_SIZE
from pronk.train.rl.estimator import Estimator
from pronk.train.rl.jump_linear import split_jump_inputs
from pronk.train.rl.normalization import RolloutNormalization

HIDDEN_DIMS = (1024, 512, 256)
"""Of actor and critic (paper N2)."""

Observations = TensorDict | Mapping[str, Tensor]
"""Groups of observations by name, each (..., size)."""


@dataclass
class EstimatorActorCfg(RslRlModelCfg):
    """Configuration of the actor and the estimator in it."""

    hidden_dims: tuple[int, ...] = HIDDEN_DIMS
    obs_normalization: bool = True
    distribution_cfg: dict[str, Any] | None = field(
        default_factory=lambda: {
            "class_name": "GaussianDistribution",
            "init_std": 1.0,
            "std_type": "scalar",
        }
    )
    estimator_hidden_dims: tuple[int, ...] = (256, 128)
    """Of the estimator (paper N1)."""
    class_name: str = "pronk.train.rl.actor:EstimatorActor"


@dataclass
class JumpCriticCfg(RslRlModelCfg):
    """Configuration of the critic."""

    hidden_dims: tuple[int, ...] = HIDDEN_DIMS
    obs_normalization: bool = True
    class_name: str = "pronk.train.rl.actor:JumpCritic"


class JumpModel(MLPModel):
    """An MLP over a normalised group and, if requested, a raw jump group behind it."""

    group: ClassVar[str]
    """The group that is normalised."""
    jump_group: ClassVar[str]
    """The group that is not."""
    jump_size: int
    """Number of jump inputs; 0 in phase 1."""

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        **cfg: Any,
    ) -> None:
        """Called by rsl_rl.

        Args:
            obs: An observation, for its sizes.
            obs_groups: Groups by set; those of `obs_set` are (group,) or (group, jump group).
            obs_set: Which set this model reads.
            output_dim: Number of outputs.
            cfg: As `rsl_rl.models.MLPModel` takes it.

        Raises:
            PronkError: The set is another.
        """
        super().__init__(obs, obs_groups, obs_set, output_dim, **cfg)
        if self.obs_normalization:
            self.obs_normalizer = RolloutNormalization(self.obs_dim - self.jump_size)
        split_jump_inputs(self.mlp, self.jump_size)

    def _get_obs_dim(
        self, obs: TensorDict, obs_groups: dict[str, list[str]], obs_set: str
    ) -> tuple[list[str], int]:
        groups, size = super()._get_obs_dim(obs, obs_groups, obs_set)
        narrow = (self.group,)
        if tuple(groups) not in (narrow, (*narrow, self.jump_group)):
            raise PronkError(
                f"{type(self).__name__} reads the groups {', '.join(groups)}; expected"
                f" {self.group}, or {self.group} and {self.jump_group} in this order."
            )
        self.jump_size = size - obs[self.group].shape[-1]
        return groups, size

    def get_latent(
        self, obs: Observations, masks: Tensor | None = None, hidden_state: Any = None
    ) -> Tensor:
        """The network's input: the normalised group, then the jump group as it is."""
        return torch.cat([self.obs_normalizer(obs[self.group]), *self._jump(obs)], dim=-1)

    def update_normalization(self, obs: TensorDict) -> None:
        """Do nothing: rsl_rl calls at every step; see `learn_normalization`."""

    def learn_normalization(self, obs: Observations, world_size: int = 1) -> None:
        """Take the observations of a rollout into the statistics; no-op without normalization.

        Args:
            obs: With the normalised group, (..., size).
            world_size: Number of processes; all of them must call.
        """
        if self.obs_normalization:
            self.obs_normalizer.learn(obs[self.group], world_size)

    def _jump(self, obs: Observations) -> list[Tensor]:
        return [obs[self.jump_group]] if self.jump_size else []


class EstimatorActor(JumpModel):
    """The estimator and, behind it, the network that acts.

    Its input is the estimate (4 contact probabilities, 3 velocities), the current part of the
    normalised measurement (45), and the jump input if there is one. No gradient of PPO goes
    through the estimate: the estimator answers to the truth alone.
    """

    group = "measured"
    jump_group = "jump"

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        estimator_hidden_dims: Sequence[int] = (256, 128),
        **cfg: Any,
    ) -> None:
        """Called by rsl_rl; see `JumpModel`.

        Args:
            obs: An observation, for its sizes.
            obs_groups: Groups by set.
            obs_set: Which set this model reads.
            output_dim: Number of actions.
            estimator_hidden_dims: Width of each hidden layer of the estimator.
            cfg: As `rsl_rl.models.MLPModel` takes it.
        """
        super().__init__(obs, obs_groups, obs_set, output_dim, **cfg)
        self.estimator = Estimator(jump_size=self.jump_size, hidden_dims=estimator_hidden_dims)
        for name, indices in (("actor", ACTOR_INDICES), ("estimator", ESTIMATOR_INDICES)):
            self.register_buffer(f"_{name}_indices", torch.tensor(indices), persistent=False)

    def _get_obs_dim(
        self, obs: TensorDict, obs_groups: dict[str, list[str]], obs_set: str
    ) -> tuple[list[str], int]:
        groups, size = super()._get_obs_dim(obs, obs_groups, obs_set)
        if size - self.jump_size != MEASURED_SIZE:
            raise PronkError(
                f"the measured vector has {size - self.jump_size} numbers; expected"
                f" {MEASURED_SIZE}, as pronk.policy.layout has them."
            )
        return groups, size

    def _get_latent_dim(self) -> int:
        return ACTOR_SIZE + self.jump_size

    def get_latent(
        self, obs: Observations, masks: Tensor | None = None, hidden_state: Any = None
    ) -> Tensor:
        """The acting network's input, (..., 52 + jump)."""
        measured = self.obs_normalizer(obs[self.group])
        with torch.no_grad():
            estimate = self.estimator.estimate(self._estimator_input(measured, obs))
        own = measured[..., self._actor_indices]
        return torch.cat([*estimate, own, *self._jump(obs)], dim=-1)

    def limit_noise(self, largest: float) -> None:
        """Explore no more than that from now on.

        Args:
            largest: Standard deviation of an action.
        """
        with torch.no_grad():
            self.distribution.std_param.clamp_(max=largest)

    def estimator_input(self, obs: Observations) -> Tensor:
        """What the estimator reads, (..., 102 + jump)."""
        return self._estimator_input(self.obs_normalizer(obs[self.group]), obs)

    def estimate(self, obs: Observations) -> tuple[Tensor, Tensor]:
        """Contact probabilities (..., 4), trunk velocity in the trunk's frame [m/s] (..., 3)."""
        return self.estimator.estimate(self.estimator_input(obs))

    def _estimator_input(self, measured: Tensor, obs: Observations) -> Tensor:
        return torch.cat([measured[..., self._estimator_indices], *self._jump(obs)], dim=-1)


class JumpCritic(JumpModel):
    """The critic: the truth, and from phase 2 on the state of the jump."""

    group = "critic"
    jump_group = "critic_jump"
