"""Outcomes of a study: one number a jump."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pronk.jump.trial.condition_trial import velocity_error
from pronk.jump.trial.results import TrialRun


@dataclass(frozen=True, kw_only=True)
class JumpOutcome:
    """What is asked of every jump."""

    name: str
    unit: str
    meaning: str
    value: Callable[[TrialRun], float]
    """Number of a jump; NaN where there is none. Of a share 1 or 0."""
    is_share: bool = False
    """True for a share of the jumps, which tables give in percent."""
    digits: int = 3

    @property
    def scale(self) -> float:
        """Factor from the number to the unit of tables."""
        return 100.0 if self.is_share else 1.0

    @property
    def label(self) -> str:
        """Name and unit."""
        return f"{self.name.replace('_', ' ')} [{self.unit}]"


_OF_JUMPS = "; of the jumps that left the ground"
"""Which of the commanded jumps have a figure of the flight: those that `jumped` counts."""


def _landed(run: TrialRun) -> float:
    return float(run.figures.success)


def _jumped(run: TrialRun) -> float:
    return float(run.figures.found)


def _fell(run: TrialRun) -> float:
    return float(run.figures.fell) if run.figures.stood else math.nan


def _height(run: TrialRun) -> float:
    return float(run.figures.height) if run.figures.found else math.nan


def _distance(run: TrialRun) -> float:
    return float(run.figures.flight.distance) if run.figures.found else math.nan


def _along(run: TrialRun) -> float:
    return float(run.figures.flight.along) if run.figures.found else math.nan


def _gap(run: TrialRun) -> float:
    return float(run.figures.flight.gap) if run.figures.found else math.nan


def _energy(run: TrialRun) -> float:
    return float(run.figures.loads.energy) if run.figures.found else math.nan


OUTCOMES: Mapping[str, JumpOutcome] = {
    "landed": JumpOutcome(
        name="landed",
        unit="%",
        meaning="share of all commanded jumps after which the robot stood upright 2 s after "
        "touchdown, and nothing but feet had touched the ground",
        value=_landed,
        is_share=True,
        digits=1,
    ),
    "jumped": JumpOutcome(
        name="jumped",
        unit="%",
        meaning="share of all commanded jumps in which the robot left the ground within 1.5 s "
        "after the jump command, for 60 ms or longer, and its trunk rose more than 3 cm over its "
        "standing height",
        value=_jumped,
        is_share=True,
        digits=1,
    ),
    "fell": JumpOutcome(
        name="fell",
        unit="%",
        meaning="share of the runs in which the robot fell, before, in or after the jump; runs in "
        "which its drives could not hold it up to begin with do not count",
        value=_fell,
        is_share=True,
        digits=1,
    ),
    "height": JumpOutcome(
        name="height",
        unit="m",
        meaning="vertical travel of the trunk, from its lowest to its highest point between the "
        f"jump command and 0.5 s after touchdown{_OF_JUMPS}",
        value=_height,
    ),
    "distance": JumpOutcome(
        name="distance",
        unit="m",
        meaning=f"horizontal distance of the trunk from lift-off to touchdown{_OF_JUMPS}",
        value=_distance,
    ),
    "along": JumpOutcome(
        name="along",
        unit="m",
        meaning="part of the horizontal distance from lift-off to touchdown in the commanded "
        f"direction{_OF_JUMPS} with a commanded velocity",
        value=_along,
    ),
    "gap": JumpOutcome(
        name="gap",
        unit="m",
        meaning="length of the ground, in the direction of the flight, between the last footholds "
        f"before lift-off and the first ones after touchdown{_OF_JUMPS}",
        value=_gap,
    ),
    "velocity_error": JumpOutcome(
        name="velocity_error",
        unit="m/s",
        meaning="absolute difference of mean and commanded velocity in the commanded direction, "
        "from 1 s after the velocity command to the jump command",
        value=velocity_error,
    ),
    "energy": JumpOutcome(
        name="energy",
        unit="J",
        meaning="electrical energy that the drives took from the battery between the jump command "
        f"and 0.5 s after touchdown, less what they returned{_OF_JUMPS}",
        value=_energy,
        digits=1,
    ),
}
"""Outcomes by their names in the file of a study."""
