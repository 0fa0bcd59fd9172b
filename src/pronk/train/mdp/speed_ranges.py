"""How wide the velocity ranges are: they grow as well as the robots keep their velocities."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pronk.errors import ArtefactError, PronkError

_FORGETS = 0.01
"""Share of a policy step in the mean of how well velocities are kept: two seconds or so."""


@dataclass(frozen=True, kw_only=True)
class Growth:
    """From a part of the ranges to the whole.

    Ranges that grew with the clock left one run in ten behind: it kept its velocities by .54 when
    they began to grow, by .36 at the end, and walked 1 m/s when commanded 2.
    """

    start: float = 0.35
    """Part of the ranges at first."""
    keep: float = 0.52
    """Mean of exp(-|e|^2 / 0.25), e the error of the horizontal velocity [m/s], from which on they
    grow at full rate."""
    lose: float = 0.36
    """The same mean up to which they do not grow; between the two the rate grows linearly. With
    nothing in between, a run that keeps its velocities by .51 would stay where it is."""
    steps: int = 5000
    """Policy steps in which they grow to the whole at full rate."""

    def __post_init__(self) -> None:
        """Refuse what cannot grow."""
        if not 0.0 < self.start <= 1.0:
            raise PronkError(f"ranges begin with a part of {self.start}; above 0, and 1 at most.")
        if not 0.0 <= self.lose < self.keep < 1.0:
            raise PronkError(
                f"ranges stay up to {self.lose} and grow at full rate from {self.keep}; expected "
                "0 or more, and more, but less than 1."
            )
        if self.steps < 1:
            raise PronkError(f"ranges grow in {self.steps} policy steps; 1 or more.")


class SpeedRanges:
    """What part of the ranges is in use; nothing here waits for the device."""

    def __init__(self, growth: Growth, device: torch.device | str) -> None:
        self._growth = growth
        self.kept = torch.zeros((), device=device)
        """How well velocities were kept of late, over all robots. ()"""
        self.grown = torch.zeros((), device=device)
        """Policy steps at full rate in which they would have grown as far. ()"""

    @property
    def part(self) -> Tensor:
        """Part of the ranges in use. ()."""
        start = self._growth.start
        return start + (1.0 - start) * (self.grown / self._growth.steps).clamp_max(1.0)

    def advance(self, error: Tensor, walks: Tensor) -> None:
        """One policy step further.

        Args:
            error: Of the horizontal velocity [m/s]. (N, 2)
            walks: Robots that count: who jumps is requested something else. Bool, (N,)
        """
        # A robot whose physics went wrong keeps nothing.
        kernel = torch.exp(error.square().sum(dim=-1) * -4.0).nan_to_num() * walks
        self.kept.lerp_(kernel.sum() / walks.sum().clamp_min(1), _FORGETS)
        law = self._growth
        self.grown += ((self.kept - law.lose) / (law.keep - law.lose)).clamp(0.0, 1.0)

    def resume(self, tree: Mapping[str, Any]) -> None:
        """Continue with the ranges of a checkpoint.

        Args:
            tree: Of the checkpoint; "speed_ranges" is `grown`.

        Raises:
            ArtefactError: It is of another version of pronk.
        """
        if "speed_ranges" not in tree:
            raise ArtefactError(
                "the checkpoint has no speed_ranges; it is of another version of pronk."
            )
        self.grown.copy_(tree["speed_ranges"])
