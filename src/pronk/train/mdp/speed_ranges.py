"""Ranges of the velocity commands, which grow with the tracking performance of the robots.

With +-3 m/s from the first step a policy learns to stand, since the tracking reward has no slope so
far away (seen in a probe).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pronk.errors import PronkError

_SMOOTHING = 0.01
"""Weight of a policy step in the mean tracking performance: a time constant of two seconds."""


@dataclass(frozen=True, kw_only=True)
class Growth:
    """Growth of the ranges from a fraction to the whole.

    Ranges that grew with the clock left one run in ten behind: it tracked by .54 when they began to
    grow, by .36 at the end, and walked 1 m/s when 2 was commanded.
    """

    start: float = 0.35
    """Fraction of the ranges at first."""
    full_rate_tracking: float = 0.52
    """Mean of exp(-|e|^2 / 0.25), e the error of the horizontal velocity [m/s], from which on the
    ranges grow at the full rate."""
    no_growth_tracking: float = 0.36
    """The same mean up to which they do not grow; between the two the rate is linear. Without a
    transition, a run that tracks by .51 would not grow."""
    steps: int = 5000
    """Policy steps to the whole ranges at the full rate."""

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        low, high = self.no_growth_tracking, self.full_rate_tracking
        if not (0.0 < self.start <= 1.0 and 0.0 <= low < high < 1.0 and self.steps >= 1):
            raise PronkError(
                f"growth of the speed ranges has start {self.start}, no_growth_tracking {low}, "
                f"full_rate_tracking {high}, steps {self.steps}; expected start above 0 to 1, "
                "0 <= no_growth_tracking < full_rate_tracking < 1, steps 1 or more."
            )


class SpeedRanges:
    """Fraction of the velocity ranges in use, computed without waiting for the device."""

    def __init__(self, growth: Growth, device: torch.device | str) -> None:
        self._growth = growth
        self.tracking = torch.zeros((), device=device)
        """Recent mean of the tracking kernel over all robots. ()"""
        self.grown = torch.zeros((), device=device)
        """Policy steps at the full rate that give the present ranges. ()"""

    @property
    def fraction(self) -> Tensor:
        """Fraction of the ranges in use. ()."""
        start = self._growth.start
        return start + (1.0 - start) * (self.grown / self._growth.steps).clamp_max(1.0)

    def advance(self, error: Tensor, counted: Tensor) -> None:
        """Advance by one policy step.

        `error` is of the horizontal velocity [m/s], (N, 2); `counted` are the robots outside jump
        mode, bool, (N,).
        """
        # A robot with a state that is not finite counts as not tracking.
        kernel = torch.exp(error.square().sum(dim=-1) * -4.0).nan_to_num() * counted
        self.tracking.lerp_(kernel.sum() / counted.sum().clamp_min(1), _SMOOTHING)
        low, high = self._growth.no_growth_tracking, self._growth.full_rate_tracking
        self.grown += ((self.tracking - low) / (high - low)).clamp(0.0, 1.0)
