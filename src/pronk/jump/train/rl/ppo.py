"""PPO with the estimator beside it.

An iteration is PPO's update, then supervised steps of the estimator on the same rollout, then the
statistics of the normalization. In this order nothing that the actor's log-probabilities depend on
changes before PPO has used them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from mjlab.rl import RslRlPpoAlgorithmCfg
from rsl_rl.algorithms import PPO
from rsl_rl.extensions import Symmetry
from tensordict import TensorDict
from torch import Tensor, nn

from pronk.errors import PronkError
from pronk.jump.train.rl.networks import JUMP_WEIGHT, EstimatorActor, JumpCritic, average

TARGET_GROUP = "estimator_target"
"""The group of observations that the estimator is trained on."""


@dataclass(kw_only=True)
class EstimatorTrainingCfg:
    """Configuration of the estimator's training."""

    learning_rate: float = 1e-3
    """Learning rate of the estimator's own Adam; a phase sets it."""
    epochs: int = 2
    """Passes of the estimator over the samples of a rollout."""
    mini_batches: int = 12
    """Steps of the estimator in an epoch."""
    contact_coef: float = 1.0
    """Weight of the contacts' cross entropy [nat]."""
    velocity_coef: float = 1.0
    """Weight of the velocity's mean squared error [m^2/s^2]."""

    def __post_init__(self) -> None:
        """Refuse numbers with which nothing would be learned."""
        if not (self.epochs > 0 and self.mini_batches > 0 and self.learning_rate > 0.0):
            raise PronkError(
                f"the estimator has {self.epochs} epochs, {self.mini_batches} mini-batches and a "
                f"learning rate of {self.learning_rate:g}; expected more than 0 of each."
            )


@dataclass
class EstimatorPpoCfg(RslRlPpoAlgorithmCfg):
    """Configuration of PPO and of the estimator's training."""

    estimator: EstimatorTrainingCfg = field(default_factory=EstimatorTrainingCfg)
    """Training of the estimator."""
    symmetry_cfg: dict[str, Any] | None = None
    """Arguments of `rsl_rl.extensions.Symmetry`, except its environment; None for none."""
    class_name: str = "pronk.jump.train.rl.ppo:EstimatorPPO"


class MirrorAugmentation(Symmetry):
    """rsl_rl's symmetry extension for data augmentation alone.

    rsl_rl computes the mirror loss also where it is only logged, which is one more pass of the
    actor over every mini-batch. An update has six passes otherwise (actor and critic, forward, and
    backward at twice the work), and updates take a third of the training time on a GPU.
    """

    def compute_loss(self, actor: nn.Module, batch: Any, original_batch_size: int) -> Tensor:
        """Return zero in place of the mirror loss."""
        return batch.advantages.new_zeros(())


class EstimatorPPO(PPO):
    """rsl_rl's PPO; the estimator inside the actor has an optimizer of its own."""

    _raw_actor: EstimatorActor
    _raw_critic: JumpCritic
    optimizer: torch.optim.Optimizer
    estimator_cfg: EstimatorTrainingCfg
    estimator_optimizer: torch.optim.Optimizer

    @staticmethod
    def construct_algorithm(
        obs: TensorDict, env: Any, cfg: dict[str, Any], device: str
    ) -> EstimatorPPO:
        """Construct the algorithm, as rsl_rl's runner does.

        Args:
            obs: Observations of the environment by group.
            env: The environment, of which the number of robots and of actions is read.
            cfg: Configuration of the runner; its entry `algorithm` has the fields of
                `EstimatorPpoCfg`.
            device: Device of networks and storage.

        Returns:
            The algorithm.

        Raises:
            PronkError: An impossible configuration, or observations without a target for the
                estimator.
        """
        groups = [str(name) for name in obs.keys()]  # noqa: SIM118 (a TensorDict)
        if TARGET_GROUP not in groups:
            raise PronkError(
                f"the environment gives the groups {', '.join(groups)}; the estimator is trained "
                f"on {TARGET_GROUP!r}."
            )
        estimator_cfg = EstimatorTrainingCfg(**cfg["algorithm"].pop("estimator"))
        # The class that this constructs is the one that the configuration names.
        algorithm: EstimatorPPO = PPO.construct_algorithm(obs, env, cfg, device)
        algorithm.separate_estimator(estimator_cfg)
        symmetry = algorithm.symmetry
        if symmetry is not None and not symmetry.use_mirror_loss:
            algorithm.symmetry = MirrorAugmentation(**cfg["algorithm"]["symmetry_cfg"])
        return algorithm

    def separate_estimator(self, estimator_cfg: EstimatorTrainingCfg) -> None:
        """Give the estimator an optimizer of its own.

        PPO has put the whole actor, of which the estimator is a part, under its optimizer.
        """
        self.estimator_cfg = estimator_cfg
        estimator_parameters = list(self._raw_actor.estimator.parameters())
        estimator_ids = {id(parameter) for parameter in estimator_parameters}
        ppo_parameters = []
        for model in (self._raw_actor, self._raw_critic):
            for parameter in model.parameters():
                if id(parameter) not in estimator_ids:
                    ppo_parameters.append(parameter)
        # On a GPU the fused kernel steps all parameters at once; PyTorch's default launches a dozen
        # kernels a step.
        options: dict[str, Any] = {}
        if estimator_parameters[0].is_cuda:
            options["fused"] = True
        optimizer_class: Any = type(self.optimizer)
        self.optimizer = optimizer_class(ppo_parameters, lr=self.learning_rate, **options)
        self.estimator_optimizer = torch.optim.Adam(
            estimator_parameters, lr=estimator_cfg.learning_rate, **options
        )

    def update(self) -> dict[str, float]:
        """Learn from the stored rollout.

        Returns:
            Mean losses by name: PPO's, `estimator_contact` [nat] and `estimator_velocity`
            [m^2/s^2].
        """
        losses: dict[str, float] = super().update()
        if isinstance(self.symmetry, MirrorAugmentation):
            del losses["symmetry"]
        # The storage is cleared by now, but only its cursor: the rollout is still there.
        losses.update(self._update_estimator())
        for model in (self._raw_actor, self._raw_critic):
            model.learn_normalization(self.storage.observations, self.gpu_world_size)
        return losses

    def _update_estimator(self) -> dict[str, float]:
        """Take the supervised steps of an iteration; returns the mean losses by name."""
        cfg = self.estimator_cfg
        estimator = self._raw_actor.estimator
        optimizer = self.estimator_optimizer
        parameters = list(estimator.parameters())
        observations = self.storage.observations
        with torch.no_grad():
            inputs = self._raw_actor.estimator_input(observations).flatten(0, 1)
        targets = observations[TARGET_GROUP].flatten(0, 1)
        coefficients = torch.tensor(
            [cfg.contact_coef, cfg.velocity_coef], device=self.device
        ).unbind()
        history: list[Tensor] = []
        for _ in range(cfg.epochs):
            order = torch.randperm(len(inputs), device=inputs.device)
            for rows in order.tensor_split(cfg.mini_batches):
                contact_loss, velocity_loss = estimator.losses(inputs[rows], targets[rows])
                optimizer.zero_grad()
                torch.autograd.backward((contact_loss, velocity_loss), coefficients)
                if self.gpu_world_size > 1:
                    gradients = [p.grad for p in parameters if p.grad is not None]
                    gradient_vector = nn.utils.parameters_to_vector(gradients)
                    average(gradient_vector, self.gpu_world_size)
                    nn.utils.vector_to_parameters(gradient_vector, gradients)
                nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
                optimizer.step()
                history.append(torch.stack((contact_loss, velocity_loss)).detach())
        # PPO clips and reduces the gradients that it finds in the actor: leave none.
        optimizer.zero_grad()
        mean_contact_loss, mean_velocity_loss = torch.stack(history).mean(dim=0).tolist()
        return {
            "estimator_contact": mean_contact_loss,
            "estimator_velocity": mean_velocity_loss,
        }

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
        """Return the weights of the jump inputs in all networks."""
        jump_weights = set()
        for model in (self._raw_actor, self._raw_critic):
            for name, parameter in model.named_parameters():
                if name.endswith(JUMP_WEIGHT):
                    jump_weights.add(parameter)
        return jump_weights

    def save(self) -> dict[str, Any]:
        """Return the state of the networks and both optimizers."""
        state: dict[str, Any] = super().save()
        state["estimator_optimizer_state_dict"] = self.estimator_optimizer.state_dict()
        return state

    def load(
        self,
        loaded_dict: Mapping[str, Any],
        load_cfg: Mapping[str, bool] | None = None,
        strict: bool = True,
    ) -> bool:
        """Load what `save` returned.

        A state of networks without jump inputs is widened: they get weights of zero, and Adam keeps
        moments and step counts of every weight that was there.

        Args:
            loaded_dict: The state.
            load_cfg: Parts to load, as rsl_rl has them; `optimizer` means both optimizers. None
                for everything.
            strict: Whether all weights must be there.

        Returns:
            Whether training continues with the iteration of the state.
        """
        state = dict(loaded_dict)
        if load_cfg is None or load_cfg.get("optimizer"):
            state["optimizer_state_dict"] = self._widened(
                state["optimizer_state_dict"], self.optimizer
            )
            estimator_state = self._widened(
                state["estimator_optimizer_state_dict"], self.estimator_optimizer
            )
            self.estimator_optimizer.load_state_dict(dict(estimator_state))
        return bool(super().load(state, load_cfg, strict))

    def _widened(
        self, narrow: Mapping[str, Any], optimizer: torch.optim.Optimizer
    ) -> Mapping[str, Any]:
        """Number the parameters of an optimizer's state as `optimizer` does."""
        (group,) = narrow["param_groups"]
        parameters = optimizer.param_groups[0]["params"]
        jump_weights = self._jump_weights()
        places = []
        for place, parameter in enumerate(parameters):
            if parameter not in jump_weights:
                places.append(place)
        if len(group["params"]) != len(places):
            return narrow  # of networks that have the jump inputs, or of other networks
        place_of = dict(zip(group["params"], places, strict=True))
        moments = {}
        for number, moment in narrow["state"].items():
            moments[place_of[number]] = moment
        wide_group = {**group, "params": list(range(len(parameters)))}
        return {"state": moments, "param_groups": [wide_group]}
