"""mjlab's reward manager with all terms weighed and summed together.

mjlab's own takes seven operations a term. On a GPU a step is bound by the number of operations, and
with thirty terms the difference was a fifth of a step. mjlab's environment names the class of its
manager itself, so `StackedRewardManager.install` puts this one in its place: the one patch of mjlab
that pronk makes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import torch
from mjlab.managers import RewardTermCfg
from mjlab.managers.reward_manager import RewardManager
from torch import Tensor

from pronk.jump.train.compiled import (
    RecordedFunction,
    Recorder,
    TensorFunction,
    compiled_step,
)
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.mdp.masks import robot_mask

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


class StackedRewardManager(RewardManager):
    """mjlab's reward manager, with the same configuration and logs, in fewer operations."""

    @classmethod
    def install(cls, env: ManagerBasedRlEnv) -> None:
        """Replace the reward manager of an environment, unless that is done or it has no terms."""
        manager = env.reward_manager
        if manager.active_terms and not isinstance(manager, cls):
            env.reward_manager = cls(env.cfg.rewards, env, scale_by_dt=env.cfg.scale_rewards_by_dt)
            env.manager_visualizers["reward_manager"] = env.reward_manager

    def __init__(
        self, cfg: dict[str, RewardTermCfg], env: ManagerBasedRlEnv, *, scale_by_dt: bool = True
    ) -> None:
        """Prepare the terms; arguments are those of mjlab's manager."""
        super().__init__(cfg, env, scale_by_dt=scale_by_dt)
        self._sums = torch.zeros(len(self._term_names), self.num_envs, device=self.device)
        """Sum of each term and robot in this episode. (terms, N)"""
        self._zero = torch.zeros(self.num_envs, device=self.device)
        self._weights: list[float] = []
        self._weight_tensor = torch.zeros(len(self._term_names), 1, device=self.device)
        self._scales: list[float] = []
        self._scale_tensor = torch.ones(len(self._term_names), device=self.device)
        self._calls: list[tuple[Callable[..., Tensor], dict[str, Any], bool]] = []
        self._recorded_step: RecordedFunction | None = None
        self._clear: TensorFunction = self._clear_sums

    def compile(self, record: Recorder) -> None:
        """Compile the terms together, and record them with their sums.

        Weights and factors in jump mode, which phases change, become tensors; all terms are
        computed, also those without a weight, so that no phase changes what is compiled.

        Args:
            record: Prepares a function to be recorded.
        """
        self._compiled_rates = compiled_step(self._rates)
        self._recorded_step = record(self._step)
        self._clear = record(self._clear_sums)

    def compute(self, dt: float) -> Tensor:
        """Compute the reward of a step.

        Args:
            dt: Duration of the step [s].

        Returns:
            The reward of each robot, (N,).
        """
        weights = [term.weight for term in self._term_cfgs]
        if weights != self._weights:
            self._weights = weights
            self._weight_tensor.copy_(torch.tensor(weights)[:, None])
        if self._recorded_step is not None:
            _ = motion_command(self._env).motion  # measured before, in a function of its own
            self._set_scale_tensor()
            (self._reward_buf,) = self._recorded_step()
            return self._reward_buf
        values = []
        for term in self._term_cfgs:
            value = term.func(self._env, **term.params) if term.weight else self._zero
            values.append(value)
        rates = _finite_rates(values, self._weight_tensor)
        scale = dt if self._scale_by_dt else 1.0
        self._sums.add_(rates, alpha=scale)
        self._step_reward = rates.T
        self._reward_buf = rates.sum(dim=0) * scale
        return self._reward_buf

    def _step(self, _: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """Compute the reward of each robot, (N,), by compiled terms, and add up the terms."""
        rates = self._compiled_rates(self._weight_tensor, self._scale_tensor)
        scale = motion_command(self._env).step_s if self._scale_by_dt else 1.0
        self._sums.add_(rates * scale)
        self._step_reward = rates.T
        return (rates.sum(dim=0) * scale,)

    def _set_scale_tensor(self) -> None:
        """Set the terms' factors in jump mode, (terms,); 1 where a term has none."""
        scales = [term.params.get("jump_scale", 1.0) for term in self._term_cfgs]
        if scales != self._scales:
            self._scales = scales
            self._calls = []
            for term in self._term_cfgs:
                constants = {name: x for name, x in term.params.items() if name != "jump_scale"}
                self._calls.append((term.func, constants, "jump_scale" in term.params))
            self._scale_tensor.copy_(torch.tensor(scales))

    def _rates(self, weights: Tensor, scales: Tensor) -> Tensor:
        """Compute all terms, weighed, with factors in jump mode that are tensors. (terms, N)."""
        values = []
        for i, (function, constants, has_scale) in enumerate(self._calls):
            if has_scale:
                values.append(function(self._env, jump_scale=scales[i], **constants))
            else:
                values.append(function(self._env, **constants))
        return _finite_rates(values, weights)

    def reset(self, env_ids: Tensor | slice | None = None) -> dict[str, Tensor]:
        """Begin new episodes.

        Args:
            env_ids: The robots whose episodes end; None for all.

        Returns:
            Mean rate of every term over the episodes that end, for the log.
        """
        robots = robot_mask(env_ids, self.num_envs, self.device)
        (means,) = self._clear({"robots": robots})
        for term in self._class_term_cfgs:
            term.func.reset(env_ids=env_ids)
        log = {}
        for name, mean in zip(self._term_names, means, strict=True):
            log[f"Episode_Reward/{name}"] = mean
        return log

    def _clear_sums(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """Clear the sums of `robots`, bool (N,); returns their mean rates, (terms,)."""
        robots = inputs["robots"]
        sums = torch.where(robots, self._sums, 0.0).sum(dim=1)
        self._sums.masked_fill_(robots, 0.0)
        return (sums / robots.sum().clamp_min(1) / self._env.max_episode_length_s,)


def _finite_rates(values: list[Tensor], weights: Tensor) -> Tensor:
    """Weigh the terms of a step, (N,) each, with weights (terms, 1). (terms, N)."""
    # A robot whose state is not finite ends its episode; its last reward must be finite.
    return torch.nan_to_num(torch.stack(values) * weights, nan=0.0, posinf=0.0, neginf=0.0)
