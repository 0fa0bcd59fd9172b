"""The concurrent estimator: foot contacts and trunk velocity from what the robot can measure.

A small network beside the actor, trained by supervision on the simulator's truth while PPO trains
the actor that reads it (paper N1; Ji et al. 2022).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from rsl_rl.modules import MLP
from torch import Tensor, nn

from pronk.policy.layout import ESTIMATE, ESTIMATE_SIZE, ESTIMATOR_SIZE
from pronk.train.rl.jump_linear import split_jump_inputs


class Estimator(nn.Module):
    """Normalised measurement, and the jump input if there is one, to contacts and velocity."""

    def __init__(
        self,
        *,
        jump_size: int = 0,
        hidden_dims: Sequence[int] = (256, 128),
        activation: str = "elu",
    ) -> None:
        """Begin with random weights.

        Args:
            jump_size: Number of jump inputs behind the measurement.
            hidden_dims: Width of each hidden layer.
            activation: Between the layers, by rsl_rl's name.
        """
        super().__init__()
        self.mlp = MLP(ESTIMATOR_SIZE + jump_size, ESTIMATE_SIZE, list(hidden_dims), activation)
        split_jump_inputs(self.mlp, jump_size)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Raw outputs.

        Args:
            x: Normalised `ESTIMATOR_INDICES` of the measurement, then the jump inputs,
                (..., 102 + jump_size).

        Returns:
            Logits of the contacts (..., 4) and trunk velocity in the trunk's frame [m/s] (..., 3).
        """
        contact, velocity = self.mlp(x).split(list(ESTIMATE.values()), dim=-1)
        return contact, velocity

    def estimate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """As `forward`, with probabilities instead of logits."""
        contact, velocity = self(x)
        return torch.sigmoid(contact), velocity


def estimator_losses(estimate: tuple[Tensor, Tensor], target: Tensor) -> tuple[Tensor, Tensor]:
    """How far an estimate is from the truth.

    Args:
        estimate: Logits of the contacts (N, 4), velocity [m/s] (N, 3), as `Estimator` gives them.
        target: Contacts (0 or 1), then velocity, (N, 7).

    Returns:
        Mean cross entropy of the contacts [nat], mean squared error of the velocity [m^2/s^2].
    """
    contact, velocity = estimate
    true_contact, true_velocity = target.split(list(ESTIMATE.values()), dim=-1)
    return (
        nn.functional.binary_cross_entropy_with_logits(contact, true_contact),
        nn.functional.mse_loss(velocity, true_velocity),
    )
