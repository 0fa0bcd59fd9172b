"""JointLog in MCAP: written as it is recorded, and read up to wherever the file was cut.

- `/sweep/header`, once, first: robot, joints, gains, pose, units, whether the robot is virtual;
- `/sweep/segment`, before its samples, so that a cut log has it;
- `/sweep/sample`, one per measured state: command in force, response, instantaneous frequency;
- `/sweep/end`, last: whether the sweep is complete, and if not, why.

Chunks are short and flushed as they fill, so that a power cut costs half a second.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.files import sha256
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.mcap import (
    BOOLEAN,
    INTEGER,
    NUMBER,
    NUMBERS,
    STRING,
    STRINGS,
    McapWriter,
    Record,
)
from pronk.identify.logs.segment import Segment

Floats = Sequence[float] | Array

SCHEMA = "pronk/sweep/1"
HEADER, SEGMENT, SAMPLE, END = "/sweep/header", "/sweep/segment", "/sweep/sample", "/sweep/end"
TOPICS: dict[str, dict[str, Any]] = {
    HEADER: {"schema": STRING, "robot": STRING, "joints": STRINGS}
    | {"stiffness": NUMBERS, "damping": NUMBERS, "pose": NUMBERS, "units": STRINGS}
    | {"virtual": BOOLEAN, "metadata": {"type": "object"}},
    SEGMENT: {"kind": STRING, "joints": STRINGS, "start": NUMBER, "stop": NUMBER}
    | {"amplitude": NUMBER, "repeat": INTEGER, "band_hz": NUMBERS, "period_s": NUMBER}
    | {"clamped": STRINGS},
    SAMPLE: {"t": NUMBER, "command": NUMBERS, "position": NUMBERS, "velocity": NUMBERS}
    | {"torque": NUMBERS, "frequency": NUMBER, "segment": INTEGER},
    END: {"complete": BOOLEAN, "reason": STRING},
}
_FLUSH_SAMPLES = 256
"""Samples in a chunk: half a second at 500 Hz."""
_BLOCK = 128
"""Samples that are parsed together; their lists are too few to start Python's garbage collector."""


@dataclass(frozen=True, kw_only=True)
class LogHeader:
    """What is known of a log before its first sample. Fields as in JointLog."""

    robot: str
    joints: tuple[str, ...]
    stiffness: Sequence[float] | None = None
    damping: Sequence[float] | None = None
    pose: Sequence[float] | None = None
    units: tuple[str, ...] | None = None
    virtual: bool = False
    metadata: dict[str, str] = field(default_factory=dict)


class McapLogWriter:
    """Writes a log as it is recorded, in its place: a recording that is interrupted must stay."""

    def __init__(self, path: Path, header: LogHeader) -> None:
        """Open `path`, which is replaced, and write the header."""
        self._file = McapWriter(path, TOPICS)
        self._pending, self._last = 0, 0.0
        self._file.put(HEADER, 0.0, {"schema": SCHEMA, **vars(header)})
        self.flush()

    def segment(self, segment: Segment) -> None:
        """Write a segment, before its samples."""
        self._file.put(SEGMENT, segment.start, vars(segment))
        self.flush()

    def sample(
        self,
        time: float,
        command: Floats,
        position: Floats,
        velocity: Floats | None = None,
        torque: Floats | None = None,
        frequency: float = math.nan,
        segment: int = -1,
    ) -> None:
        """Write one measured state.

        One number a joint [rad, rad/s, N m]; `frequency` is NaN and `segment` -1 between segments.
        """
        body: dict[str, Any] = {"t": time, "command": command, "position": position}
        optional = {"velocity": velocity, "torque": torque}
        body |= {name: values for name, values in optional.items() if values is not None}
        self._file.put(SAMPLE, time, body | {"frequency": frequency, "segment": segment})
        self._last = time
        self._pending += 1
        if self._pending >= _FLUSH_SAMPLES:
            self.flush()

    def flush(self) -> None:
        """Finish the chunk and pass everything to the operating system."""
        self._file.flush()
        self._pending = 0

    def end(self, *, complete: bool = True, reason: str = "") -> None:
        """Write the end and close the file."""
        self._file.put(END, self._last, {"complete": complete, "reason": reason})
        self._file.close()


def reason_of(error: BaseException | None) -> str:
    """Why a log ends, in words; empty without an error."""
    return "" if error is None else f"{type(error).__name__}: {error}".rstrip(": ")


def read_sweep(path: Path, found: Iterable[Record], damage: str) -> JointLog:
    """Make the log of the messages of a file, with `complete` False if it was cut anywhere.

    `damage` says why reading ended early, or is "".
    """
    try:
        return _read_sweep(path, found, damage)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise LogError(f"{path}: its messages are not those of {SCHEMA} ({reason}).") from None


class _Sample(msgspec.Struct, gc=False):
    t: float
    command: list[float]
    position: list[float]
    velocity: list[float] | None = None
    torque: list[float] | None = None
    frequency: float | None = None


def _columns(samples: Sequence[bytes]) -> dict[str, Any]:
    """Fields of samples, a row for each; None for velocity or torque if the first has none."""
    rows = msgspec.json.decode(b"[" + b",".join(samples) + b"]", type=list[_Sample])
    found: dict[str, Any] = {}
    for name in _Sample.__struct_fields__:
        values = [getattr(row, name) for row in rows]
        lacking = values[0] is None and name != "frequency"  # Frequencies of None become NaN.
        found[name] = None if lacking else np.array(values, dtype=np.float64)
    return found


def _read_samples(samples: Sequence[bytes]) -> dict[str, Any]:
    """Same as `_columns`, by blocks: their many lists are gone before they cost time and memory."""
    parts: dict[str, list[Any]] = {name: [] for name in _Sample.__struct_fields__}
    try:
        for first in range(0, len(samples), _BLOCK):
            block = samples[first : first + _BLOCK]
            for name, values in _columns(block).items():
                parts[name].append(values)
            if len(parts["t"][-1]) != len(block):
                return _columns(samples)
        return {n: None if v[0] is None else np.concatenate(v) for n, v in parts.items()}
    except (msgspec.MsgspecError, ValueError, TypeError, IndexError):
        return _columns(samples)  # It names the place in the file.


def _read_sweep(path: Path, found: Iterable[Record], damage: str) -> JointLog:
    by_topic: dict[str, list[bytes]] = {topic: [] for topic in TOPICS}
    for record in found:
        by_topic.setdefault(record.topic, []).append(record.data)
    header, ends = (by_topic[topic][-1:] or [b"{}"] for topic in (HEADER, END))
    schema = msgspec.json.decode(header[0], type=dict[str, Any]).get("schema")
    if schema != SCHEMA:
        raise LogError(f"{path}: schema {schema!r}; this pronk reads {SCHEMA!r}.")
    if (count := len(by_topic[SAMPLE])) < 2:
        raise LogError(f"{path}: cut after {count} samples; nothing to read, record again.")
    columns = _read_samples(by_topic[SAMPLE])
    time, frequency = columns.pop("t"), columns.pop("frequency")
    last = float(time[-1])
    end = msgspec.json.decode(ends[0], type=dict[str, Any])
    complete = bool(end.get("complete", False)) and not damage
    notes = []
    if damage or not end:
        notes.append(
            f"the file is cut short after {last:.3f} s ({damage or 'no end was written'}); "
            "what was recorded before is whole"
        )
    elif not complete:
        notes.append(f"the recording was cut short ({end.get('reason') or 'no reason given'})")

    # Not vars: it lacks the defaults of what the file leaves out.
    known = msgspec.json.decode(header[0], type=LogHeader)
    about = {entry.name: getattr(known, entry.name) for entry in fields(LogHeader)}
    arrays = {name: about.pop(name) for name in ("stiffness", "damping", "pose")}
    arrays = {n: None if v is None else np.array(v, dtype=np.float64) for n, v in arrays.items()}
    segments = [_segment(data) for data in by_topic[SEGMENT]]
    if len(set(segments)) < len(segments):
        raise LogError(f"{path}: damaged: it has the same segment twice; record again.")
    return JointLog(
        **about,
        **arrays,
        **columns,
        time=time,
        frequency=None if np.isnan(frequency).all() else frequency,
        # Segments that had begun by the last sample, ended there if they were cut.
        segments=tuple(
            replace(segment, stop=min(segment.stop, last))
            for segment in segments
            if segment.start < last
        ),
        source=str(path),
        sha256=sha256(path),
        complete=complete,
        notes=tuple(notes),
    )


def _segment(data: bytes) -> Segment:
    body = msgspec.json.decode(data, type=dict[str, Any])
    if body.get("amplitude") is None:
        body["amplitude"] = math.nan
    return msgspec.convert(body, Segment)
