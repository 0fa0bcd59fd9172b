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


def _landed(run: TrialRun) -> float:
    return float(run.figures.success)


def _jumped(run: TrialRun) -> float:
    return float(run.figures.found)


def _fell(run: TrialRun) -> float:
    return float(run.figures.fell)


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
        meaning="upright 2 s after touchdown, and nothing but feet touched the ground; of all "
        "commanded jumps",
        value=_landed,
        is_share=True,
        digits=1,
    ),
    "jumped": JumpOutcome(
        name="jumped",
        unit="%",
        meaning="left the ground after the command; of all commanded jumps",
        value=_jumped,
        is_share=True,
        digits=1,
    ),
    "fell": JumpOutcome(
        name="fell",
        unit="%",
        meaning="fell at any time of the run; of all runs",
        value=_fell,
        is_share=True,
        digits=1,
    ),
    "height": JumpOutcome(
        name="height", unit="m", meaning="height of the trunk's way in the jump", value=_height
    ),
    "distance": JumpOutcome(
        name="distance", unit="m", meaning="way from lift-off to touchdown", value=_distance
    ),
    "along": JumpOutcome(
        name="along", unit="m", meaning="that way along the command", value=_along
    ),
    "gap": JumpOutcome(name="gap", unit="m", meaning="gap that the feet cleared", value=_gap),
    "velocity_error": JumpOutcome(
        name="velocity_error",
        unit="m/s",
        meaning="difference of mean and commanded velocity along the command before the jump",
        value=velocity_error,
    ),
    "energy": JumpOutcome(
        name="energy",
        unit="J",
        meaning="energy of the drives in the jump",
        value=_energy,
        digits=1,
    ),
}
"""Outcomes by their names in the file of a study."""
