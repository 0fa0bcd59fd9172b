"""Settings of a match."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from pronk.errors import PronkError
from pronk.identify.response.response import Estimator


@dataclass(frozen=True, kw_only=True)
class MatchSettings:
    """Settings that a match rarely needs changed."""

    fitted: tuple[str, ...] = ()
    """Parameters that mode `drive` fits, out of `pronk.identify.match.parameters.FREE`; damping,
    armature, dry friction and delay if empty."""
    grid_points: int = 50
    """Points of each axis of the grid of method `paper` (paper F7)."""
    zero_armature: bool = True
    """Repeat the search of method `paper` without rotor inertia (paper F13)."""
    coherence_min: float = 0.8
    """Coherence below which a frequency is left out of the comparison; a joint with most of its
    band below is refused. Not used for joints that moved together (`match_chains`)."""
    gain_uncertainty: float = 0.2
    """Relative uncertainty of the stated stiffness and of the torque constant in mode `drive`,
    part of its intervals. On the AK80-6 recordings the measured torques are 0.8 of the commanded
    ones."""
    threads: int = 2
    """Threads of MuJoCo."""
    simulator_python: Path | None = None
    """Interpreter in which another simulator than MuJoCo runs; this interpreter if None."""
    estimator: Estimator = field(default_factory=Estimator)
    """Estimator of the responses, the same for the log and the simulation."""

    def __post_init__(self) -> None:
        """Refuse settings that cannot work.

        Raises:
            PronkError: A value is outside its range; the message gives the range.
        """
        if self.grid_points < 3:
            raise PronkError(f"grid_points is {self.grid_points}; expected 3 or more.")
        if not 0.0 <= self.coherence_min < 1.0:
            raise PronkError(f"coherence_min is {self.coherence_min}; expected 0 to below 1.")
        if not 0.0 <= self.gain_uncertainty < 1.0:
            raise PronkError(
                f"gain_uncertainty (--gain-uncertainty) is {self.gain_uncertainty}; expected a "
                "share from 0 to below 1, as in 0.2."
            )
        if self.threads < 1:
            raise PronkError(f"threads is {self.threads}; expected 1 or more.")
