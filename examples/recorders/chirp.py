"""The command of the recorders beside this file, and the CSV file that they write."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

DURATION_S = 20.0
"""Length of a chirp; a second of standstill follows."""
PAUSE_S = 1.0


def chirp(
    time_s: float, amplitude_rad: float, *, low_hz: float = 0.2, high_hz: float = 12.0
) -> float:
    """Return the command relative to the pose [rad]; it fades in and out over a second."""
    if not 0.0 <= time_s <= DURATION_S:
        return 0.0
    phase = 2.0 * math.pi * (low_hz * time_s + 0.5 * (high_hz - low_hz) / DURATION_S * time_s**2)
    fade = min(1.0, time_s, DURATION_S - time_s)
    return amplitude_rad * fade * math.sin(phase)


def command_at(time_s: float, amplitudes_rad: Sequence[float], high_hz: float) -> float | None:
    """Return the command of the whole recording relative to the pose [rad]; None at its end."""
    length_s = PAUSE_S + DURATION_S
    number = int(time_s // length_s)
    if number >= len(amplitudes_rad):
        return None
    return chirp(time_s - number * length_s - PAUSE_S, amplitudes_rad[number], high_hz=high_hz)


def write_csv(path: Path, joint: str, rows: Sequence[tuple[float, float, float]]) -> None:
    """Write time [s], command and position [rad] of one joint, by the names that pronk guesses."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time", f"command.{joint}", f"position.{joint}"])
        for time_s, command, position in rows:
            writer.writerow([f"{time_s:.6f}", f"{command:.6f}", f"{position:.6f}"])
