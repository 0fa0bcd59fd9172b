"""PPO with the estimator beside it.

An iteration is PPO's update, then supervised steps of the estimator on the same rollout, then the
statistics of the normalization. In this order nothing that the actor's log-probabilities depend on
changes before PPO has used them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from mjlab.rl import RslRlPpoAlgorithmCfg
from rsl_rl.algorithms import PPO
from rsl_rl.storage import RolloutStorage
from torch import Tensor, nn

from pronk.errors import PronkError
from pronk.jump.train.rl.networks import JUMP_WEIGHT, EstimatorActor, JumpCritic, average

TARGET_GROUP = "estimator_target"
"""The group of observations that the estimator is trained on."""


@dataclass
class EstimatorPpoCfg(RslRlPpoAlgorithmCfg):
    """Configuration of PPO and of the estimator's training."""

    estimator_learning_rate: float = 1e-3
    """Of the estimator's own Adam; a phase sets it."""
    estimator_epochs: int = 2
    """Passes of the estimator over the samples of a rollout."""
    estimator_mini_batches: int = 12
    """Steps of the estimator in an epoch."""
    estimator_contact_coef: float = 1.0
    """Weight of the contacts' cross entropy [nat]."""
    estimator_velocity_coef: float = 1.0
    """Weight of the velocity's mean squared error [m^2/s^2]."""
    symmetry_cfg: dict[str, Any] | None = None
    """Arguments of `rsl_rl.extensions.Symmetry`, except its environment; None for none."""
    class_name: str = "pronk.jump.train.rl.ppo:EstimatorPPO"


class EstimatorPPO(PPO):
    """rsl_rl's PPO; the estimator inside the actor has an optimizer of its own."""

    _raw_actor: EstimatorActor
    _raw_critic: JumpCritic
    optimizer: torch.optim.Optimizer

    def __init__(
        self,
        actor: EstimatorActor,
        critic: JumpCritic,
        storage: RolloutStorage,
        *,
        estimator_learning_rate: float,
        estimator_epochs: int,
        estimator_mini_batches: int,
        estimator_contact_coef: float,
        estimator_velocity_coef: float,
        **cfg: Any,
    ) -> None:
        """Called by rsl_rl with the fields of `EstimatorPpoCfg`."""
        if TARGET_GROUP not in storage.observations.keys():  # noqa: SIM118 (a TensorDict)
            raise PronkError(
                f"the environment gives the groups {', '.join(storage.observations.keys())};"
                f" the estimator is trained on {TARGET_GROUP!r}."
            )
        if not (min(estimator_epochs, estimator_mini_batches) > 0 < estimator_learning_rate):
            raise PronkError(
                f"estimator_epochs is {estimator_epochs}, estimator_mini_batches "
                f"{estimator_mini_batches} and estimator_learning_rate "
                f"{estimator_learning_rate:g}; expected more than 0."
            )
        super().__init__(actor, critic, storage, **cfg)
        self._augments = self.symmetry is not None and not self.symmetry.use_mirror_loss
        if self._augments:
            # rsl_rl computes the mirror loss even where it is only logged: one more pass of the
            # actor over every mini-batch.
            self.symmetry.compute_loss = lambda _, batch, rows: batch.advantages.new_zeros(())
        self.estimator_epochs = estimator_epochs
        self.estimator_mini_batches = estimator_mini_batches
        self._coefficients = torch.tensor(
            [estimator_contact_coef, estimator_velocity_coef], device=self.device
        ).unbind()
        # PPO has put the whole actor under its optimizer; the estimator is part of the actor.
        estimator = list(actor.estimator.parameters())
        own = set(estimator)
        others = [p for p in (*actor.parameters(), *critic.parameters()) if p not in own]
        # On a GPU the fused kernel steps all parameters at once; PyTorch's default launches a dozen
        # kernels a step.
        fused: dict[str, Any] = {"fused": True} if estimator[0].is_cuda else {}
        kind: Any = type(self.optimizer)
        self.optimizer = kind(others, lr=self.learning_rate, **fused)
        self.estimator_optimizer = torch.optim.Adam(estimator, lr=estimator_learning_rate, **fused)

    def update(self) -> dict[str, float]:
        """Learn from the stored rollout; returns mean losses by name.

        PPO's, `estimator_contact` [nat] and `estimator_velocity` [m^2/s^2].
        """
        losses: dict[str, float] = super().update()
        if self._augments:
            del losses["symmetry"]
        # The storage is cleared by now, but only its cursor: the rollout is still there.
        losses.update(self._update_estimator())
        for model in (self._raw_actor, self._raw_critic):
            model.learn_normalization(self.storage.observations, self.gpu_world_size)
        return losses

    def _update_estimator(self) -> dict[str, float]:
        estimator, optimizer = self._raw_actor.estimator, self.estimator_optimizer
        parameters = list(estimator.parameters())
        observations = self.storage.observations
        with torch.no_grad():
            inputs = self._raw_actor.estimator_input(observations).flatten(0, 1)
        targets = observations[TARGET_GROUP].flatten(0, 1)
        history: list[Tensor] = []
        for _ in range(self.estimator_epochs):
            order = torch.randperm(len(inputs), device=inputs.device)
            for rows in order.tensor_split(self.estimator_mini_batches):
                losses = estimator.losses(inputs[rows], targets[rows])
                optimizer.zero_grad()
                torch.autograd.backward(losses, self._coefficients)
                if self.gpu_world_size > 1:
                    gradients = [p.grad for p in parameters if p.grad is not None]
                    together = nn.utils.parameters_to_vector(gradients)
                    average(together, self.gpu_world_size)
                    nn.utils.vector_to_parameters(together, gradients)
                nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
                optimizer.step()
                history += [loss.detach() for loss in losses]
        # PPO clips and reduces the gradients that it finds in the actor: leave none.
        optimizer.zero_grad()
        contact, velocity = torch.stack(history).view(-1, 2).mean(dim=0).tolist()
        return {"estimator_contact": contact, "estimator_velocity": velocity}

    def set_estimator_rate(self, rate: float) -> None:
        """Set the learning rate of the estimator."""
        for group in self.estimator_optimizer.param_groups:
            group["lr"] = rate

    def reset_jump_moments(self) -> None:
        """Begin the moments and step counts of the jump inputs' weights anew.

        With the step count of the other weights, zero moments would count as a long average, and
        the first step would be (1 - 0.9) / sqrt(1 - 0.999) = 3.2 learning rates long.
        """
        for parameter in self._jump_weights():
            self.optimizer.state.pop(parameter, None)
            self.estimator_optimizer.state.pop(parameter, None)

    def _jump_weights(self) -> set[Tensor]:
        models = (self._raw_actor, self._raw_critic)
        named = (pair for model in models for pair in model.named_parameters())
        return {parameter for name, parameter in named if name.endswith(JUMP_WEIGHT)}

    def save(self) -> dict[str, Any]:
        """State of the networks and both optimizers."""
        state: dict[str, Any] = super().save()
        state["estimator_optimizer_state_dict"] = self.estimator_optimizer.state_dict()
        return state

    def load(
        self,
        loaded_dict: Mapping[str, Any],
        load_cfg: Mapping[str, bool] | None = None,
        strict: bool = True,
    ) -> bool:
        """Load what `save` gave; `load_cfg` as rsl_rl has it, its `optimizer` means both.

        A state of networks without jump inputs is widened: they get weights of zero, and Adam keeps
        moments and step counts of every weight that was there.
        """
        state = dict(loaded_dict)
        if load_cfg is None or load_cfg.get("optimizer"):
            for name in ("optimizer", "estimator_optimizer"):
                key = f"{name}_state_dict"
                state[key] = self._widened(state[key], getattr(self, name))
            self.estimator_optimizer.load_state_dict(state[key])
        return bool(super().load(state, load_cfg, strict))

    def _widened(
        self, narrow: Mapping[str, Any], optimizer: torch.optim.Optimizer
    ) -> Mapping[str, Any]:
        """Number the parameters of an optimizer's state as `optimizer` does."""
        (group,) = narrow["param_groups"]
        wide, jump = optimizer.param_groups[0]["params"], self._jump_weights()
        kept = [i for i, parameter in enumerate(wide) if parameter not in jump]
        if len(group["params"]) != len(kept):
            return narrow  # of networks that have the inputs, or of others
        places = dict(zip(group["params"], kept, strict=True))
        moments = {places[i]: moment for i, moment in narrow["state"].items()}
        return {"state": moments, "param_groups": [{**group, "params": list(range(len(wide)))}]}
