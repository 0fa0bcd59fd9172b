"""mjlab's reward manager with all terms weighed and summed together.

mjlab's own takes seven operations a term. On a GPU a step is bound by the number of operations, and
with thirty terms the difference is a fifth of a step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from mjlab.managers.reward_manager import RewardManager
from torch import Tensor

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


class StackedRewardManager(RewardManager):
    """The same configuration and logs as mjlab's, in fewer operations."""

    @classmethod
    def install(cls, env: ManagerBasedRlEnv) -> None:
        """Use it in an environment; no-op where there is nothing to do."""
        manager = env.reward_manager
        if manager.active_terms and not isinstance(manager, cls):
            env.reward_manager = cls(env.cfg.rewards, env, scale_by_dt=env.cfg.scale_rewards_by_dt)
            env.manager_visualizers["reward_manager"] = env.reward_manager

    def __init__(self, *args: object, **kwargs: object) -> None:
        super().__init__(*args, **kwargs)
        self._sums = torch.zeros(len(self._term_names), self.num_envs, device=self.device)
        """Of each term and robot in this episode. (terms, N)"""
        self._zero = torch.zeros(self.num_envs, device=self.device)
        self._weights: list[float] = []

    def compute(self, dt: float) -> Tensor:
        """Reward of the step. (N,)."""
        terms = self._term_cfgs
        weights = [term.weight for term in terms]
        if weights != self._weights:
            self._weights = weights
            self._weight_tensor = torch.tensor(weights, device=self.device)[:, None]
        values = [t.func(self._env, **t.params) if t.weight else self._zero for t in terms]
        # A robot whose state is not finite ends its episode; its last reward must be finite.
        rates = torch.stack(values) * self._weight_tensor
        rates = torch.nan_to_num(rates, nan=0.0, posinf=0.0, neginf=0.0)
        scale = dt if self._scale_by_dt else 1.0
        self._sums.add_(rates, alpha=scale)
        self._step_reward = rates.T
        self._reward_buf = rates.sum(dim=0) * scale
        return self._reward_buf

    def reset(self, env_ids: Tensor | slice | None = None) -> dict[str, Tensor]:
        """Mean rate of every term over the episodes that end, for the log."""
        ids = slice(None) if env_ids is None else env_ids
        means = self._sums[:, ids].mean(dim=1) / self._env.max_episode_length_s
        self._sums[:, ids] = 0.0
        for term in self._class_term_cfgs:
            term.func.reset(env_ids=env_ids)
        return {f"Episode_Reward/{n}": m for n, m in zip(self._term_names, means, strict=True)}
