"""Clocks of a round: the virtual robot's beside the wall's, and what on this computer was late."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.deploy.log import DeployLog
from pronk.deploy.preflight import STATE_RATE_HZ
from pronk.hardware.twin import HITCH_S

Array = NDArray[np.float64]

_STEP_S = 0.02
"""Of a policy [s]."""


@dataclass(frozen=True, kw_only=True)
class Clock:
    """The virtual robot's, beside CLOCK_MONOTONIC."""

    zero: float
    """When it was at zero, as of the end [s]."""
    hitches: tuple[tuple[float, float, bool], ...] = ()
    """When the robot was late, by how much [s], and whether it let that time pass unlived."""

    def zero_at(self, end: float) -> float:
        """When it was at zero, as of a time [s]."""
        return self.zero - sum(
            late for when, late, slipped in self.hitches if slipped and when > end
        )


def own_clock(log: DeployLog) -> Clock:
    """Of a virtual robot in the servo's process, which numbers its states by its clock."""
    return Clock(zero=float(np.median(log.state_time - log.state_sequence / STATE_RATE_HZ)))


def disturbance(
    start: float,
    end: float,
    *,
    ticks: Array,
    steps: Array,
    hitches: Sequence[tuple[float, float, bool]],
) -> str:
    """What was late by more than half a policy step between two times; empty if nothing was.

    It looks at clocks alone, never at what came of the jump.

    Args:
        start: Of what counts [s].
        end: Of it [s].
        ticks: When the servo's ticks began [s].
        steps: When the policy's steps began, in charge or not [s].
        hitches: Of the virtual robot: when, how late [s], whether it slipped.
    """
    late = [
        f"the {who} paused for {1e3 * pause:.0f} ms"
        for who, times, most in (
            ("servo", ticks, HITCH_S),
            ("policy", steps, _STEP_S + HITCH_S),
        )
        if (pause := _pause(times, start, end)) > most
    ]
    late += [
        f"the virtual robot was {1e3 * by:.0f} ms late"
        for when, by, _ in hitches
        if start <= when <= end
    ]
    return ", ".join(late)


def _pause(times: Array, start: float, end: float) -> float:
    """Longest between two of the times that lie between start and end [s]."""
    inside = times[(times >= start) & (times <= end)]
    return float(np.diff(inside).max()) if len(inside) > 1 else 0.0
