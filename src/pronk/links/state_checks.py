"""Check that states come often enough before a robot is commanded.

What the states contain is checked by `pronk.runtime.preflight`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pronk.errors import HardwareError
from pronk.links.machine import State

WINDOW_S = 0.2
"""How long states are watched [s]."""


@dataclass(frozen=True, kw_only=True)
class Freshness:
    """How fresh states must be before anything moves."""

    share: float = 0.9
    """Of the expected number of states that must have come."""
    longest_gap_s: float = 0.02
    """Between two states [s]."""


def check_rate(
    robot: str, states: Sequence[State], rate_hz: float, fresh: Freshness | None = None
) -> None:
    """Check that the states of `WINDOW_S` come often enough and without gaps.

    Raises:
        HardwareError: They do not.
    """
    wanted = fresh or Freshness()
    expected = rate_hz * WINDOW_S
    gap = float(np.diff([state.time for state in states]).max()) if len(states) > 1 else np.inf
    if len(states) < wanted.share * expected or gap > wanted.longest_gap_s:
        raise HardwareError(
            f"{robot} sent {len(states)} fresh states in {WINDOW_S * 1e3:.0f} ms with a longest "
            f"gap of {gap * 1e3:.0f} ms, expected about {expected:.0f} with none above "
            f"{wanted.longest_gap_s * 1e3:.0f} ms; check the network and that this computer is "
            "not busy."
        )
