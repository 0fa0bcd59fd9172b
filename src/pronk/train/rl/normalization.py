"""Running mean and spread of an observation, learned once an iteration from the whole rollout.

rsl_rl 5.4.2 learns at every environment step, on every process for itself. Two defects follow:
PPO computes its log-probabilities anew with other statistics than those the actions were drawn
with, so the first importance ratio is not one; and on several GPUs the processes drift apart.
Learned once, between two rollouts and from the data of all processes, neither can happen.
"""

from __future__ import annotations

import torch
from rsl_rl.modules import EmpiricalNormalization
from torch import Tensor


class RolloutNormalization(EmpiricalNormalization):
    """rsl_rl's normalization, (x - mean) / (std + 0.01), with statistics over all processes."""

    @torch.no_grad()
    def learn(self, x: Tensor, world_size: int = 1) -> None:
        """Take the samples of a rollout into the statistics.

        Args:
            x: Samples of this process, (..., size); as many on every process.
            world_size: Number of processes; all of them must call.
        """
        x = x.flatten(0, -2)
        mean = average(x.mean(dim=0, keepdim=True), world_size)
        var = average((x - mean).square().mean(dim=0, keepdim=True), world_size)
        self.count += x.shape[0] * world_size
        rate = x.shape[0] * world_size / self.count
        delta = mean - self._mean
        self._mean += rate * delta
        # Spread of a mixture: that of each part, and that between their means.
        self._var += rate * (var - self._var + delta * (mean - self._mean))
        self._std.copy_(self._var.sqrt())


def average(value: Tensor, world_size: int) -> Tensor:
    """Mean of `value` over the processes, in place; every one must call with the same shape."""
    if world_size > 1:
        torch.distributed.all_reduce(value)
        value /= world_size
    return value
