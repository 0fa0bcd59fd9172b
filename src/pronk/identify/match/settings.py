"""Settings of a match."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pronk.errors import PronkError
from pronk.identify.response.response import Estimator


@dataclass(frozen=True, kw_only=True)
class MatchSettings:
    """How to match."""

    method: Literal["time", "paper"] = "time"
    """`time` fits gains, dry friction and delay in the time domain, all amplitudes together;
    `paper` compares the magnitude of the largest amplitude (F7 to F11)."""
    exhaustive: bool = False
    """Simulate every pair of the paper's grid (F7), instead of searching the linearized model and
    verifying by simulation at the optimum."""
    grid_points: int = 50
    """Points of each axis of the grid (paper F7)."""
    zero_armature: bool = True
    """Repeat the paper's search without rotor inertia (paper F13); method `paper` only."""
    coherence_min: float = 0.8
    """Frequencies below are left out of the fit; a joint with most of its band below is refused."""
    threads: int = 2
    """Threads of the simulator."""
    simulator: str = "mujoco"
    """`mujoco`, `FILE.py:NAME` or an entry point in `pronk.simulators` (see `load_simulator`)."""
    simulator_python: Path | None = None
    """Interpreter that the simulator runs in; this one if None."""
    estimator: Estimator = field(default_factory=Estimator)
    """Estimator, the same for the log and the simulation."""

    def __post_init__(self) -> None:
        """Refuse settings that cannot work.

        Raises:
            PronkError: A value is outside its range; the message gives the range.
        """
        for name, good, expected in (
            ("method", self.method in ("time", "paper"), "time or paper"),
            ("grid_points", self.grid_points >= 3, "3 or more"),
            ("coherence_min", 0.0 <= self.coherence_min < 1.0, "0 to below 1"),
            ("threads", self.threads >= 1, "1 or more"),
        ):
            if not good:
                raise PronkError(f"{name} is {getattr(self, name)!r}; expected {expected}.")
