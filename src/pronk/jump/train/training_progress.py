"""The file `progress.json` in the folder of a run: how far a training is, for those who watch many.

The runner writes it every few seconds and after the last iteration; it needs no PyTorch to read.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path

import msgspec

from pronk.files import write_text

PROGRESS_FILE = "progress.json"
"""Name of the file in the folder of a run."""
SCHEMA = "pronk/progress/1"


@dataclass(frozen=True, kw_only=True)
class TrainingProgress:
    """How far a training is."""

    phase: str
    """Phase of the last iteration."""
    iteration: int
    """Number of finished iterations."""
    iterations: int
    """Number of iterations of all phases."""
    steps_per_second: float
    """Environment steps per second of the last iteration."""
    seconds_left: float
    """Duration of the iterations that are left, as long as the last one each [s]."""
    reward: float | None = None
    """Mean sum of rewards of the last episodes; None before the first has ended."""
    episode_steps: float | None = None
    """Mean length of the last episodes [policy steps]; None before the first has ended."""
    speed_range: float | None = None
    """Share of the range of commanded velocities that is in use [1]."""

    @property
    def share(self) -> float:
        """Share of the iterations that are finished, 0 to 1."""
        return self.iteration / max(self.iterations, 1)


def write_progress(folder: Path, progress: TrainingProgress) -> None:
    """Write the progress of a run to its folder, whole or not at all."""
    body: dict[str, object] = {"schema": SCHEMA}
    for name, value in asdict(progress).items():
        is_unknown = isinstance(value, float) and not math.isfinite(value)
        body[name] = None if is_unknown else value
    write_text(folder / PROGRESS_FILE, json.dumps(body) + "\n")


def read_progress(folder: Path) -> TrainingProgress | None:
    """Read the progress of a run; None where there is none, or the file cannot be used."""
    try:
        body = json.loads((folder / PROGRESS_FILE).read_text(encoding="utf-8"))
        if body.pop("schema") != SCHEMA:
            return None
        return msgspec.convert(body, TrainingProgress)
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return None
