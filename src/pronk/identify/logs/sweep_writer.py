"""The log of a sweep in MCAP, written as it is recorded.

- `/sweep/header`, once, first: robot, joints, gains, pose, units, whether the robot is virtual;
- `/sweep/segment`, before its samples, so that a log that was cut has it;
- `/sweep/sample`, one per measured state: command in force, response, instantaneous frequency;
- `/sweep/end`, last: whether the sweep is complete, and if not, why.

Times in messages are on the clock of the machine; the log times of the messages are the wall clock,
set at the first segment or sample. Chunks are short and flushed as they fill, so that a power cut
costs half a second.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pronk.arrays import Array
from pronk.identify.logs.mcap import (
    BOOLEAN,
    INTEGER,
    NUMBER,
    NUMBERS,
    STRING,
    STRINGS,
    McapWriter,
)
from pronk.identify.logs.segment import Segment

SCHEMA = "pronk/sweep/1"
HEADER = "/sweep/header"
SEGMENT = "/sweep/segment"
SAMPLE = "/sweep/sample"
END = "/sweep/end"
TOPICS: dict[str, dict[str, Any]] = {
    HEADER: {
        "schema": STRING,
        "robot": STRING,
        "joints": STRINGS,
        "stiffness": NUMBERS,
        "damping": NUMBERS,
        "pose": NUMBERS,
        "units": STRINGS,
        "virtual": BOOLEAN,
        "metadata": {"type": "object"},
    },
    SEGMENT: {
        "kind": STRING,
        "joints": STRINGS,
        "start": NUMBER,
        "stop": NUMBER,
        "amplitude": NUMBER,
        "repeat": INTEGER,
        "band_hz": NUMBERS,
        "period_s": NUMBER,
        "clamped": STRINGS,
    },
    SAMPLE: {
        "t": NUMBER,
        "command": NUMBERS,
        "position": NUMBERS,
        "velocity": NUMBERS,
        "torque": NUMBERS,
        "frequency": NUMBER,
        "segment": INTEGER,
    },
    END: {"complete": BOOLEAN, "reason": STRING},
}
"""Properties of the messages of each topic, as JSON Schema has them."""
_FLUSH_SAMPLES = 256
"""Samples in a chunk: half a second at 500 Hz."""


@dataclass(frozen=True, kw_only=True)
class LogHeader:
    """What is known of a log before its first sample, as in `JointLog`."""

    robot: str
    """Name of the robot."""
    joints: tuple[str, ...]
    """Names of the columns."""
    stiffness: Sequence[float] | None = None
    """Stiffness on the drives [N m/rad], one number a joint; None if unknown."""
    damping: Sequence[float] | None = None
    """Damping on the drives [N m s/rad], one number a joint; None if unknown."""
    pose: Sequence[float] | None = None
    """Position that the signals are centred on [rad], one number a joint."""
    units: tuple[str, ...] | None = None
    """Unit of each column's position; all `rad` if None."""
    virtual: bool = False
    """True if the machine was the virtual robot."""
    metadata: dict[str, str] = field(default_factory=dict)
    """Named remarks on the recording."""


class McapLogWriter:
    """Writes a log as it is recorded, in its place: a recording that is interrupted must stay."""

    def __init__(self, path: Path, header: LogHeader) -> None:
        """Open `path`, which is replaced, and write the header."""
        self._file = McapWriter(path, TOPICS)
        self._samples_in_chunk = 0
        self._last_time = 0.0
        self._opened_s = time.time()
        """When the log was opened [s since 1970]."""
        self._wall_offset_s: float | None = None
        """Wall clock less the clock of the log [s]; None before its first time."""
        self._file.put(
            HEADER,
            self._opened_s,
            {
                "schema": SCHEMA,
                "robot": header.robot,
                "joints": header.joints,
                "stiffness": header.stiffness,
                "damping": header.damping,
                "pose": header.pose,
                "units": header.units,
                "virtual": header.virtual,
                "metadata": header.metadata,
            },
        )
        self.flush()

    def segment(self, segment: Segment) -> None:
        """Write a segment, before its samples."""
        self._file.put(SEGMENT, self._wall_time(segment.start), asdict(segment))
        self.flush()

    def sample(
        self,
        time: float,
        command: Sequence[float] | Array,
        position: Sequence[float] | Array,
        velocity: Sequence[float] | Array | None = None,
        torque: Sequence[float] | Array | None = None,
        frequency: float = math.nan,
        segment: int = -1,
    ) -> None:
        """Write one measured state.

        Args:
            time: Measured timestamp, on the clock of the log [s].
            command: Position command in force [rad], one number a joint.
            position: Measured position [rad], one number a joint.
            velocity: Measured velocity [rad/s], one number a joint, if there is any.
            torque: Measured torque [N m], one number a joint, if there is any.
            frequency: Instantaneous frequency of the signal [Hz]; NaN between segments.
            segment: Number of the segment, in the order written; -1 between segments.
        """
        body: dict[str, Any] = {"t": time, "command": command, "position": position}
        if velocity is not None:
            body["velocity"] = velocity
        if torque is not None:
            body["torque"] = torque
        body["frequency"] = frequency
        body["segment"] = segment
        self._file.put(SAMPLE, self._wall_time(time), body)
        self._last_time = time
        self._samples_in_chunk += 1
        if self._samples_in_chunk >= _FLUSH_SAMPLES:
            self.flush()

    def _wall_time(self, log_time: float) -> float:
        """Return the wall clock at a time of the log [s since 1970]."""
        if self._wall_offset_s is None:
            self._wall_offset_s = self._opened_s - log_time
        return log_time + self._wall_offset_s

    def flush(self) -> None:
        """Finish the chunk and pass everything to the operating system."""
        self._file.flush()
        self._samples_in_chunk = 0

    def end(self, *, complete: bool = True, reason: str = "") -> None:
        """Write the end and close the file; `reason` says why the log is not complete."""
        body = {"complete": complete, "reason": reason}
        self._file.put(END, self._wall_time(self._last_time), body)
        self._file.close()


def reason_of(error: BaseException | None) -> str:
    """Return why a log ends, in words; empty without an error."""
    if error is None:
        return ""
    return f"{type(error).__name__}: {error}".rstrip(": ")
