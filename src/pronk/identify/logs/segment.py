"""Segment: when a log excites which joints, and with which signal."""

from __future__ import annotations

from dataclasses import dataclass

from pronk.errors import LogError

SIGNAL_KINDS = ("chirp", "log_chirp", "multisine", "sine_steps", "unknown")
"""Kinds of excitation signals; `unknown` for one that was found in the commands."""


@dataclass(frozen=True, kw_only=True)
class Segment:
    """One excitation: a signal sent to some joints between two instants of the log."""

    kind: str
    """Kind of the signal, one of `SIGNAL_KINDS`."""
    joints: tuple[str, ...]
    """Names of the excited joints (several only with uncorrelated signals)."""
    start: float
    """First instant, on the clock of `JointLog.time` [s]."""
    stop: float
    """Last instant, settling included [s]."""
    amplitude: float
    """Peak of the command about the pose [rad]; NaN if unknown."""
    repeat: int = 0
    """Number of this repeat of the same excitation, from 0."""
    band_hz: tuple[float, float] = (0.0, 0.0)
    """Lowest and highest excited frequency [Hz]."""
    period_s: float | None = None
    """Period of a periodic signal [s]; None for chirps."""
    clamped: tuple[str, ...] = ()
    """Names of the joints that were fixed mechanically during the excitation."""

    def __post_init__(self) -> None:
        """Refuse an unknown kind and a segment that ends before it starts."""
        if self.kind not in SIGNAL_KINDS:
            raise LogError(
                f"segment kind {self.kind!r}; expected one of {', '.join(SIGNAL_KINDS)}."
            )
        if not self.stop > self.start:
            raise LogError(f"a segment ends at {self.stop} s, before it starts at {self.start} s.")
