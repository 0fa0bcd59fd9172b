"""Ranges of the velocity commands, which grow with the tracking performance of the robots.

With +-3 m/s from the first step a policy learns to stand, since the tracking reward has no slope so
far away (seen in a probe). Ranges that grew with the clock left one run in ten behind: it tracked
by .54 when they began to grow, by .36 at the end, and walked 1 m/s when 2 was commanded.
"""

from __future__ import annotations

import torch
from torch import Tensor

START = 0.35
"""Fraction of the ranges at first."""
FULL_RATE_TRACKING = 0.52
"""Mean of exp(-|e|^2 / 0.25), e the error of the horizontal velocity [m/s], from which on the
ranges grow at the full rate."""
NO_GROWTH_TRACKING = 0.36
"""The same mean up to which they do not grow; between the two the rate is linear. Without a
transition, a run that tracks by .51 would not grow."""
STEPS = 5000
"""Policy steps to the whole ranges at the full rate."""
_SMOOTHING = 0.01
"""Weight of a policy step in the mean tracking performance: a time constant of two seconds."""


DIRECTIONS = ("forward", "back", "left", "right")
"""Directions of fast commands, in the order of `fast_commands`."""


def fast_commands(velocity: Tensor, limits: Tensor, fraction: Tensor, least: float) -> Tensor:
    """Return which commands use much of the ranges, by direction.

    A command belongs to the direction in which it uses the larger share of its range.

    Args:
        velocity: Commanded forward and left velocity [m/s], (N, 2).
        limits: Half-widths of the whole ranges, forward and left first [m/s], (2,) or more.
        fraction: Fraction of the ranges in use, ().
        least: Least share of the range in use of that velocity [1].

    Returns:
        Bool, (4, N), in the order of `DIRECTIONS`.
    """
    share = velocity / (fraction * limits[:2])
    ahead, left = share.unbind(dim=-1)
    along_x = ahead.abs() >= left.abs()
    return torch.stack(
        (
            along_x & (ahead >= least),
            along_x & (ahead <= -least),
            ~along_x & (left >= least),
            ~along_x & (left <= -least),
        )
    )


class SpeedRanges:
    """Fraction of the velocity ranges in use, computed without waiting for the device.

    Robots are counted in one group or several. The group that tracks worst decides how fast the
    ranges grow: a Go2 that ran backwards and sideways, but stood when it was told to run forwards,
    had a good mean over all fast commands.
    """

    def __init__(self, device: torch.device | str, groups: int = 1) -> None:
        """Begin with the smallest ranges.

        Args:
            device: Device of the state.
            groups: Number of groups, G.
        """
        self.tracking = torch.zeros(groups, device=device)
        """Recent mean of the tracking kernel over the robots of each group. (G,)"""
        self.grown = torch.zeros((), device=device)
        """Policy steps at the full rate that give the present ranges. ()"""

    @property
    def fraction(self) -> Tensor:
        """Fraction of the ranges in use. ()."""
        return START + (1.0 - START) * (self.grown / STEPS).clamp_max(1.0)

    def advance(self, error: Tensor, counted: Tensor) -> None:
        """Advance by one policy step.

        Args:
            error: Error of the horizontal velocity [m/s], (N, 2).
            counted: Robots that count in each group, bool, (G, N): those outside jump mode, or the
                fast ones of them. The mean of a group without robots stays as it is.
        """
        # A robot with a state that is not finite counts as not tracking.
        kernel = torch.exp(error.square().sum(dim=-1) * -4.0).nan_to_num() * counted
        count = counted.sum(dim=-1)
        smoothing = _SMOOTHING * (count > 0)
        self.tracking.lerp_(kernel.sum(dim=-1) / count.clamp_min(1), smoothing)
        span = FULL_RATE_TRACKING - NO_GROWTH_TRACKING
        worst = self.tracking.amin()
        self.grown += ((worst - NO_GROWTH_TRACKING) / span).clamp(0.0, 1.0)
