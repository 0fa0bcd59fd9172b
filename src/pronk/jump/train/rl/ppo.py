"""PPO with the estimator beside it.

An iteration is PPO's update, then supervised steps of the estimator on the same rollout, then the
statistics of the normalization. In this order nothing that the actor's log-probabilities depend on
changes before PPO has used them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from mjlab.rl import RslRlPpoAlgorithmCfg
from rsl_rl.algorithms import PPO
from rsl_rl.extensions import Symmetry
from rsl_rl.modules import GaussianDistribution
from tensordict import TensorDict
from torch import Tensor, nn

from pronk.errors import PronkError
from pronk.jump.train.compiled import RecordedFunction, compiled, compiled_step
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
    learning_rate: float
    estimator_cfg: EstimatorTrainingCfg
    estimator_optimizer: torch.optim.Optimizer
    _compiled_losses: Callable[..., tuple[Tensor, ...]] | None = None
    _compiled_estimator_losses: Callable[..., tuple[Tensor, Tensor]] | None = None
    _recorded_policy: RecordedFunction | None = None
    _recorded_step: RecordedFunction | None = None
    _recorded_estimator_step: RecordedFunction | None = None

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

    def compile(self, mode: str | None = None) -> None:
        """Compile the policy's step and the losses with `torch.compile`.

        rsl_rl calls it, and compiles actor and critic alone. Configurations that the functions here
        do not know are left as they are.

        Args:
            mode: None for nothing.
        """
        is_known = (
            type(self._raw_actor.distribution) is GaussianDistribution
            and self._raw_actor.distribution.std_type == "scalar"
            and not self.use_clipped_value_loss
            and not self.normalize_advantage_per_mini_batch
            and self.rnd is None
            and not (self.symmetry is not None and self.symmetry.use_mirror_loss)
            and self.schedule == "adaptive"
        )
        if mode is None or not is_known:
            return
        policy_step = compiled_step(self._policy_step)
        self._recorded_policy = RecordedFunction(policy_step, self.device)
        self._compiled_losses = compiled(self._losses)
        self._compiled_estimator_losses = compiled(self._raw_actor.estimator.losses)
        if self.gpu_world_size == 1:
            # Processes exchange gradients in a step, which is not recorded.
            self._recorded_step = RecordedFunction(self._step, self.device)
            self._recorded_estimator_step = RecordedFunction(self._estimator_step, self.device)

    @property
    def is_compiled(self) -> bool:
        """Whether `compile` has compiled the policy's step and the losses."""
        return self._recorded_policy is not None

    def act(self, obs: TensorDict) -> Tensor:
        """Draw actions, (N, 12), and remember what PPO needs of the step.

        Args:
            obs: Observations by group.
        """
        if self._recorded_policy is None:
            actions: Tensor = super().act(obs)
            return actions
        if self.storage.step == 0:
            self._recorded_policy.begin()
        groups = _tensors(obs)
        size = self.storage.actions.shape[-1]
        groups["noise"] = torch.randn(len(obs), size, device=self.device)
        actions, values, log_prob, mean, std = self._recorded_policy(groups)
        transition = self.transition
        transition.actions = actions
        transition.values = values
        transition.actions_log_prob = log_prob
        transition.distribution_params = (mean, std)
        transition.observations = obs
        # The logger reads the standard deviation.
        self._raw_actor.distribution.update(mean)
        return actions

    def _policy_step(self, obs: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """Compute a step of actor and critic.

        Args:
            obs: Observations by group, (N, size) each, and `noise`, numbers drawn from the normal
                distribution, (N, 12).

        Returns:
            Actions (N, 12), values (N, 1), log-probabilities of the actions (N,), mean and standard
            deviation of the distribution (N, 12).
        """
        mean, std = self._action_distribution(obs)
        actions = mean + std * obs["noise"]
        return actions, self._raw_critic(obs), _log_prob(actions, mean, std), mean, std

    def _action_distribution(self, obs: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation of the actions, (N, 12) each."""
        actor = self._raw_actor
        mean = actor.mlp(actor.get_latent(obs))
        std = actor.distribution.std_param.clamp(*actor.distribution.std_range)
        return mean, std.expand_as(mean)

    def _losses(self, batch: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Compute PPO's losses of a mini-batch.

        Args:
            batch: Of M samples and, behind them, mirror images: observations by group, (M, size)
                each, `actions`, (M, 12), `log_prob`, `advantages`, `returns`, (M, 1); of the n
                samples alone `mean` and `std`, (n, 12).

        Returns:
            Surrogate loss, value loss, and of the samples alone entropy [nat] and divergence [nat].
        """
        mean, std = self._action_distribution(batch)
        log_prob = _log_prob(batch["actions"], mean, std)
        ratio = torch.exp(log_prob - batch["log_prob"].squeeze(-1))
        advantages = batch["advantages"].squeeze(-1)
        clipped_ratio = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
        surrogate = torch.maximum(-advantages * ratio, -advantages * clipped_ratio).mean()
        value = (batch["returns"] - self._raw_critic(batch)).square().mean()
        count = len(batch["mean"])
        new_std = std[:count]
        entropy = (0.5 + 0.5 * math.log(2.0 * math.pi) + new_std.log()).sum(dim=-1).mean()
        divergence = _divergence(
            batch["mean"], batch["std"], mean[:count].detach(), new_std.detach()
        )
        return surrogate, value, entropy, divergence.mean()

    def _step(self, batch: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """Take PPO's step for a mini-batch; the learning rate is a tensor, which follows.

        Args:
            batch: As `_losses` has it.

        Returns:
            Value loss, surrogate loss and entropy [nat].
        """
        assert self._compiled_losses is not None
        assert self.desired_kl is not None
        surrogate, value, entropy, divergence = self._compiled_losses(batch)
        loss = surrogate + self.value_loss_coef * value - self.entropy_coef * entropy
        self.optimizer.zero_grad()
        loss.backward()
        divergence = average(divergence.detach(), self.gpu_world_size)
        slower = divergence > 2.0 * self.desired_kl
        faster = (divergence < 0.5 * self.desired_kl) & (divergence > 0.0)
        factor = torch.where(slower, 1.0 / 1.5, torch.where(faster, 1.5, 1.0))
        self.optimizer.param_groups[0]["lr"].mul_(factor).clamp_(1e-5, 1e-2)
        if self.gpu_world_size > 1:
            self.reduce_parameters()
        for model in (self._raw_actor, self._raw_critic):
            nn.utils.clip_grad_norm_(model.parameters(), self.max_grad_norm)
        self.optimizer.step()
        return value.detach(), surrogate.detach(), entropy.detach()

    def _update_networks(self) -> dict[str, float]:
        """Take PPO's steps as rsl_rl does, without waiting for the device.

        The learning rate, which follows the divergence, and the losses stay on the device.

        Returns:
            Mean losses by name.
        """
        (group,) = self.optimizer.param_groups
        group["lr"] = torch.tensor(self.learning_rate, device=self.device)
        history = []
        batches = self.storage.mini_batch_generator(self.num_mini_batches, self.num_learning_epochs)
        with recorded(self._recorded_step, self._step, self.optimizer) as step:
            for samples in batches:
                old_mean, old_std = samples.old_distribution_params
                if self.symmetry is not None:
                    self.symmetry.augment_batch(samples, len(old_mean))
                batch = _tensors(samples.observations)
                batch["actions"] = samples.actions
                batch["log_prob"] = samples.old_actions_log_prob
                batch["advantages"] = samples.advantages
                batch["returns"] = samples.returns
                batch["mean"] = old_mean
                batch["std"] = old_std
                history.append(torch.stack(step(batch)))
        means = torch.stack(history).mean(dim=0).tolist()
        self.learning_rate = float(group["lr"])
        group["lr"] = self.learning_rate
        self.storage.clear()
        return dict(zip(("value", "surrogate", "entropy"), means, strict=True))

    def update(self) -> dict[str, float]:
        """Learn from the stored rollout.

        Returns:
            Mean losses by name: PPO's, `estimator_contact` [nat] and `estimator_velocity`
            [m^2/s^2].
        """
        losses: dict[str, float]
        if self._compiled_losses is None:
            losses = super().update()
            if isinstance(self.symmetry, MirrorAugmentation):
                del losses["symmetry"]
        else:
            losses = self._update_networks()
        # The storage is cleared by now, but only its cursor: the rollout is still there.
        losses.update(self._update_estimator())
        for model in (self._raw_actor, self._raw_critic):
            model.learn_normalization(self.storage.observations, self.gpu_world_size)
        return losses

    def _update_estimator(self) -> dict[str, float]:
        """Take the supervised steps of an iteration; returns the mean losses by name."""
        cfg = self.estimator_cfg
        observations = self.storage.observations
        with torch.no_grad():
            inputs = self._raw_actor.estimator_input(observations).flatten(0, 1)
        targets = observations[TARGET_GROUP].flatten(0, 1)
        coefficients = torch.tensor([cfg.contact_coef, cfg.velocity_coef], device=self.device)
        history: list[Tensor] = []
        with recorded(
            self._recorded_estimator_step, self._estimator_step, self.estimator_optimizer
        ) as step:
            for _ in range(cfg.epochs):
                order = torch.randperm(len(inputs), device=inputs.device)
                for rows in order.tensor_split(cfg.mini_batches):
                    batch = {
                        "input": inputs[rows],
                        "target": targets[rows],
                        "coefficients": coefficients,
                    }
                    history.append(torch.stack(step(batch)))
        # PPO clips and reduces the gradients that it finds in the actor: leave none.
        self.estimator_optimizer.zero_grad()
        mean_contact_loss, mean_velocity_loss = torch.stack(history).mean(dim=0).tolist()
        return {
            "estimator_contact": mean_contact_loss,
            "estimator_velocity": mean_velocity_loss,
        }

    def _estimator_step(self, batch: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """Take a supervised step of the estimator.

        Args:
            batch: `input`, (M, size), `target`, (M, 7), and `coefficients` of both losses, (2,).

        Returns:
            Contact loss [nat] and velocity loss [m^2/s^2].
        """
        estimator = self._raw_actor.estimator
        parameters = list(estimator.parameters())
        losses = self._compiled_estimator_losses or estimator.losses
        contact_loss, velocity_loss = losses(batch["input"], batch["target"])
        self.estimator_optimizer.zero_grad()
        torch.autograd.backward((contact_loss, velocity_loss), batch["coefficients"].unbind())
        if self.gpu_world_size > 1:
            gradients = [p.grad for p in parameters if p.grad is not None]
            gradient_vector = nn.utils.parameters_to_vector(gradients)
            average(gradient_vector, self.gpu_world_size)
            nn.utils.vector_to_parameters(gradient_vector, gradients)
        nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
        self.estimator_optimizer.step()
        return contact_loss.detach(), velocity_loss.detach()

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


@contextmanager
def recorded(
    recorded_step: RecordedFunction | None,
    step: Callable[[Mapping[str, Tensor]], tuple[Tensor, ...]],
    optimizer: torch.optim.Optimizer,
) -> Iterator[Callable[[Mapping[str, Tensor]], tuple[Tensor, ...]]]:
    """Give the step of an update: as it is recorded, or as it is where nothing is recorded.

    Args:
        recorded_step: The recorded step, or None.
        step: The step as it is.
        optimizer: The step's optimizer, which has to know inside the block that it is recorded.
    """
    if recorded_step is None or not recorded_step.records:
        yield step
        return
    (group,) = optimizer.param_groups
    recorded_step.begin()
    group["capturable"] = True
    try:
        yield recorded_step
    finally:
        # Adam refuses it on a CPU, where a checkpoint may be loaded.
        group["capturable"] = False


def _tensors(obs: TensorDict) -> dict[str, Tensor]:
    """Return groups of observations as a dictionary."""
    groups: dict[str, Tensor] = obs.to_dict()
    return groups


def _log_prob(actions: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Return the log-probability density of actions that are normally distributed. (N,)."""
    densities = -0.5 * ((actions - mean) / std).square() - std.log() - 0.5 * math.log(2.0 * math.pi)
    return densities.sum(dim=-1)


def _divergence(mean: Tensor, std: Tensor, new_mean: Tensor, new_std: Tensor) -> Tensor:
    """Return the Kullback-Leibler divergence of new normal distributions from old ones. (N,)."""
    ratio = (std / new_std).square()
    distance = ((mean - new_mean) / new_std).square()
    return 0.5 * (ratio + distance - 1.0 - ratio.log()).sum(dim=-1)
