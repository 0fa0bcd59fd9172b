"""Settings of a match; the defaults are the paper's choices."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from pronk.errors import PronkError
from pronk.response.response import Estimator
from pronk.simulators.mujoco import DEVICES


@dataclass(frozen=True, kw_only=True)
class MatchSettings:
    """How to match."""

    method: Literal["grid", "quick"] = "grid"
    """`grid` simulates every pair (paper F7); `quick` searches the linearized model and verifies
    by simulation at the optimum."""
    grid_points: int = 50
    """Points of each axis of the grid (paper F7)."""
    grid_weighting: Literal["none", "coherence"] = "none"
    """Weights of the frequencies in the grid search; the paper names none (F10)."""
    use_phase: bool = False
    """Let the refinement see the phase too, with a free delay; the paper disregards it (F9)."""
    zero_armature: bool = True
    """Repeat the search without rotor inertia (paper F13)."""
    coherence_min: float = 0.8
    """Frequencies below are left out of the fit; a joint with most of its band below is refused."""
    level: float = 0.95
    """Level of the intervals."""
    interval: Literal["student", "bootstrap"] = "student"
    """Intervals over repeats: Student's t, or a bootstrap where there are eight or more."""
    threads: int = 2
    """Threads of the simulator."""
    device: str = "cpu"
    """Where the grid is simulated: `cpu` (all of it in double precision), `cuda` (MuJoCo Warp on a
    GPU; needs `pronk[train]`), or `warp-cpu` (the same arithmetic on the processor, slow)."""
    simulator: str = "mujoco"
    """`mujoco`, `FILE.py:NAME` or an entry point in `pronk.simulators` (see `load_simulator`)."""
    estimator: Estimator = field(default_factory=Estimator)
    """Estimator, the same for the log and the simulation."""

    def __post_init__(self) -> None:
        """Refuse settings that cannot work.

        Raises:
            PronkError: A value is outside its range; the message gives the range.
        """
        if self.method not in ("grid", "quick"):
            raise PronkError(f"method {self.method!r}; expected grid or quick.")
        if self.grid_weighting not in ("none", "coherence"):
            raise PronkError(f"grid_weighting {self.grid_weighting!r}; expected none or coherence.")
        if self.interval not in ("student", "bootstrap"):
            raise PronkError(f"interval {self.interval!r}; expected student or bootstrap.")
        if self.grid_points < 3:
            raise PronkError(f"grid_points is {self.grid_points}; expected 3 or more.")
        if not 0.0 <= self.coherence_min < 1.0:
            raise PronkError(f"coherence_min is {self.coherence_min}; expected 0 to below 1.")
        if not 0.0 < self.level < 1.0:
            raise PronkError(f"level is {self.level}; expected between 0 and 1, for instance 0.95.")
        if self.device not in DEVICES:
            raise PronkError(f"device {self.device!r}; expected one of {', '.join(DEVICES)}.")
        if self.threads < 1:
            raise PronkError(f"threads is {self.threads}; expected 1 or more.")
