"""Options with which a log is read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pronk.errors import LogError

ANGLE_UNITS = {"rad": 1.0, "deg": np.pi / 180.0}
"""Radians in each unit of angle."""
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds in each unit of time."""
COLUMN_OPTIONS = (
    "unit",
    "time_unit",
    "joint_names",
    "joint_order",
    "drop_duplicates",
    "scale",
)
"""Options of every format that is a table of columns."""


class NeedsOptionsError(LogError):
    """A log that cannot be read without options; `question` says which, without the path."""

    def __init__(self, path: object, question: str) -> None:
        super().__init__(f"{path}: {question}.")
        self.path = str(path)
        self.question = question

    def __reduce__(self) -> tuple[type[NeedsOptionsError], tuple[str, str]]:
        """Build the error again in another process."""
        return NeedsOptionsError, (self.path, self.question)


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """How a log is read; an option that its format does not have is refused."""

    format: str | None = None
    """Name of the format, one of `readers()`; by the name of the file if None."""
    rate_hz: float | None = None
    """Rate that the timestamps are expected to have [Hz]; another one is an error."""
    unit: str | None = None
    """Unit of all angles, one of `ANGLE_UNITS`; required where the format does not define it."""
    time_unit: str | None = None
    """Unit of the timestamps, one of `TIME_UNITS`; that of the format if None."""
    joint_names: Mapping[str, str] | None = None
    """New names of joints by their names in the file."""
    joint_order: str | Sequence[str] | None = None
    """Joints of columns without names, in the order of the file: names, text with commas between
    the names, or `default` for the robot's own order."""
    drop_duplicates: bool = False
    """True to drop rows that repeat the one before in full."""
    scale: Mapping[str, float] | None = None
    """Radians per unit of the joints whose position is on another scale, by (new) joint name. It
    holds for the command and the position; the velocity is left as it is."""
    columns: Mapping[str, str] | Sequence[str] | None = None
    """The CSV file's own column names, or numbers from 0, by those of pronk, as in
    `{"position.FR_knee": "q3"}`; or those of time, command and position of a single joint."""
    measured_topic: str | None = None
    """Topic of the measured states in a bag; guessed by its type if None."""
    command_topic: str | None = None
    """Topic of the commands in a bag; guessed by its type if None."""
    command_field: str | None = None
    """Field of the positions in a command message, as in `points.0.positions` (dots between names,
    numbers for indices); that of the type if None."""
    reader_options: Mapping[str, str] = field(default_factory=dict)
    """Options of a reader from another package, as text by name."""

    def __post_init__(self) -> None:
        """Refuse units, rates and scales that cannot be, with a LogError."""
        if self.unit is not None and self.unit not in ANGLE_UNITS:
            raise LogError(f"--unit {self.unit}; expected one of {', '.join(ANGLE_UNITS)}.")
        if self.time_unit is not None and self.time_unit not in TIME_UNITS:
            raise LogError(
                f"--time-unit {self.time_unit}; expected one of {', '.join(TIME_UNITS)}."
            )
        if self.rate_hz is not None and not (np.isfinite(self.rate_hz) and self.rate_hz > 0.0):
            raise LogError(f"--rate-hz {self.rate_hz}; expected a positive number.")
        for joint, factor in (self.scale or {}).items():
            if not (np.isfinite(factor) and factor != 0.0):
                raise LogError(f"--scale of {joint} is {factor}; expected a number other than 0.")

    def stated(self) -> tuple[str, ...]:
        """Names of the options of a format that are stated, those of a plug-in reader included."""
        values = {
            "unit": self.unit,
            "time_unit": self.time_unit,
            "joint_names": self.joint_names,
            "joint_order": self.joint_order,
            "drop_duplicates": self.drop_duplicates,
            "scale": self.scale,
            "columns": self.columns,
            "measured_topic": self.measured_topic,
            "command_topic": self.command_topic,
            "command_field": self.command_field,
        }
        names = [name for name, value in values.items() if value]
        return (*names, *self.reader_options)
