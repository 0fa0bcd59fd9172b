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
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import orjson
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.files import sha256, written_whole
from pronk.logs.joint_log import JointLog, Segment
from pronk.logs.mcap import (
    BOOLEAN,
    INTEGER,
    NUMBER,
    NUMBERS,
    STRING,
    STRINGS,
    DamagedError,
    McapWriter,
    Record,
    records,
)
from pronk.logs.rosbag_reader import read_joint_states
from pronk.robots.robot import RobotSpec

Array = NDArray[np.float64]
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


@dataclass(frozen=True, kw_only=True)
class LogHeader:
    """What is known of a log before its first sample. Fields as in JointLog."""

    robot: str
    joints: tuple[str, ...]
    stiffness: Sequence[float] | None = None
    damping: Sequence[float] | None = None
    pose: Sequence[float] | None = None
    units: tuple[str, ...] = ()
    virtual: bool = False
    metadata: dict[str, str] = field(default_factory=dict)


class McapLogWriter:
    """Writes a log as it is recorded. Leaving the context by an error ends it as cut short.

    The file is not written aside and renamed: a recording that is interrupted must stay.
    """

    def __init__(self, path: Path, header: LogHeader) -> None:
        """Open `path`, which is replaced, and write the header."""
        self._file = McapWriter(path, TOPICS)
        self._pending = self._segments = 0
        self._ended = False
        self._last = 0.0
        self._put(HEADER, 0.0, {"schema": SCHEMA, **vars(header)})
        self.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.end(complete=error is None, reason=reason_of(error))

    def segment(self, segment: Segment) -> int:
        """Write a segment, before its samples; returns its number."""
        self._put(SEGMENT, segment.start, vars(segment))
        self.flush()
        self._segments += 1
        return self._segments - 1

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
        if velocity is not None:
            body["velocity"] = velocity
        if torque is not None:
            body["torque"] = torque
        body["frequency"] = frequency
        body["segment"] = segment
        self._put(SAMPLE, time, body)
        self._pending += 1
        if self._pending >= _FLUSH_SAMPLES:
            self.flush()

    def flush(self) -> None:
        """Finish the chunk and hand everything to the operating system."""
        self._file.flush()
        self._pending = 0

    def end(self, *, complete: bool = True, reason: str = "") -> None:
        """Write the end and close the file; ending twice has no effect."""
        if self._ended:
            return
        self._ended = True
        self._put(END, self._last, {"complete": complete, "reason": reason})
        self._file.close()

    def _put(self, topic: str, time: float, body: dict[str, Any]) -> None:
        self._last = time
        self._file.put(topic, time, body)


def reason_of(error: BaseException | None) -> str:
    """Why a log ends, in words; empty without an error."""
    return "" if error is None else f"{type(error).__name__}: {error}".rstrip(": ")


def write_mcap(path: Path, log: JointLog) -> None:
    """Write a log that is in memory, whole or not at all."""

    def listed(values: Array | None) -> list[float] | None:
        return None if values is None else values.tolist()

    header = LogHeader(
        robot=log.robot,
        joints=log.joints,
        stiffness=listed(log.stiffness),
        damping=listed(log.damping),
        pose=listed(log.pose),
        units=log.units,
        virtual=log.virtual,
        metadata=log.metadata,
    )
    number = np.full(len(log.time), -1)
    for i, segment in enumerate(log.segments):
        number[(log.time >= segment.start) & (log.time <= segment.stop)] = i
    with written_whole(path) as aside, McapLogWriter(aside, header) as writer:
        for segment in log.segments:
            writer.segment(segment)
        rows = [
            log.time.tolist(),
            log.command.tolist(),
            log.position.tolist(),
            [None] * len(log.time) if log.velocity is None else log.velocity.tolist(),
            [None] * len(log.time) if log.torque is None else log.torque.tolist(),
            [math.nan] * len(log.time) if log.frequency is None else log.frequency.tolist(),
            number.tolist(),
        ]
        for row in zip(*rows, strict=True):
            writer.sample(*row)
        reason = "" if log.complete else "the log was already cut short"
        writer.end(complete=log.complete, reason=reason)


def read_mcap(
    path: Path,
    *,
    robot: RobotSpec | None = None,
    measured_topic: str | None = None,
    command_topic: str | None = None,
    command_field: str = "position",
) -> JointLog:
    """Read a log of pronk, or the JointState messages of a rosbag2 MCAP.

    A file that was cut anywhere gives the log of what came before, with `complete` False.

    Args:
        path: The file.
        robot: The robot, for a file that does not name it.
        measured_topic: Topic of the measured sensor_msgs/msg/JointState (rosbag2 only).
        command_topic: Topic of the commands (rosbag2 only).
        command_field: Where in a command message the positions are, dots between names
            (rosbag2 only), for instance `points.0.positions`.

    Raises:
        LogError: Not MCAP, nothing usable in it, or a topic that is not there.
    """
    found, damage = _gather(path)
    if any(record.topic.startswith("/sweep/") for record in found):
        if measured_topic or command_topic:
            raise LogError(
                f"{path}: a log of pronk needs no measured_topic or command_topic; leave them out."
            )
        return _from_pronk(path, found, damage)
    return read_joint_states(
        path,
        found,
        damage,
        robot="unknown" if robot is None else robot.name,
        measured_topic=measured_topic,
        command_topic=command_topic,
        command_field=command_field,
    )


def _gather(path: Path) -> tuple[list[Record], str]:
    """Every readable message, and what ended the reading early ("" if nothing did)."""
    found: list[Record] = []
    damage = ""
    try:
        with path.open("rb") as stream:
            for batch in records(stream, path.stat().st_size):
                found += batch
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except DamagedError as error:
        if not found:
            raise LogError(f"{path}: not a readable MCAP file ({error}).") from None
        damage = str(error)
    if not found:
        raise LogError(f"{path}: an MCAP file without messages; record or export it again.")
    return found, damage


def _from_pronk(path: Path, found: Iterable[Record], damage: str) -> JointLog:
    try:
        return _assemble(path, found, damage)
    except LogError:
        raise
    except (orjson.JSONDecodeError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise LogError(
            f"{path}: its messages are not those of {SCHEMA} ({type(error).__name__}: "
            f"{' '.join(str(error).split())[:200]})."
        ) from None


def _assemble(path: Path, found: Iterable[Record], damage: str) -> JointLog:
    header: dict[str, Any] = {}
    segments: list[Segment] = []
    samples: list[bytes] = []
    end: dict[str, Any] = {}
    for record in found:
        if record.topic == SAMPLE:
            samples.append(record.data)
        elif record.topic == SEGMENT:
            segments.append(_segment(orjson.loads(record.data)))
        elif record.topic == HEADER:
            header = orjson.loads(record.data)
        elif record.topic == END:
            end = orjson.loads(record.data)
    if header.get("schema") != SCHEMA:
        raise LogError(f"{path}: schema {header.get('schema')!r}; this pronk reads {SCHEMA!r}.")
    if len(samples) < 2:
        raise LogError(f"{path}: cut after {len(samples)} samples; nothing to read, record again.")
    # One parse of all samples together: four times faster than one by one.
    rows = orjson.loads(b"[" + b",".join(samples) + b"]")
    time = np.array([row["t"] for row in rows], dtype=np.float64)
    # None becomes NaN.
    frequency = np.array([row["frequency"] for row in rows], dtype=np.float64)
    complete = bool(end.get("complete", False)) and not damage
    notes = []
    if damage or not end:
        notes.append(
            f"the file is cut short after {time[-1]:.3f} s ({damage or 'no end was written'}); "
            "what was recorded before is whole"
        )
    elif not complete:
        notes.append(f"the recording was cut short ({end.get('reason') or 'no reason given'})")

    def matrix(name: str) -> Array | None:
        if name not in rows[0]:
            return None
        return np.array([row[name] for row in rows], dtype=np.float64)

    def vector(name: str) -> Array | None:
        values = header.get(name)
        return None if values is None else np.array(values, dtype=np.float64)

    command, position = matrix("command"), matrix("position")
    if command is None or position is None:
        raise LogError(f"{path}: its samples hold no command or no position.")
    return JointLog(
        robot=str(header["robot"]),
        joints=tuple(header["joints"]),
        time=time,
        command=command,
        position=position,
        velocity=matrix("velocity"),
        torque=matrix("torque"),
        frequency=None if np.isnan(frequency).all() else frequency,
        segments=tuple(_begun(segments, float(time[-1]))),
        stiffness=vector("stiffness"),
        damping=vector("damping"),
        pose=vector("pose"),
        units=tuple(header.get("units") or ()),
        virtual=bool(header.get("virtual")),
        source=str(path),
        sha256=sha256(path),
        complete=complete,
        notes=tuple(notes),
        metadata={str(k): str(v) for k, v in (header.get("metadata") or {}).items()},
    )


def _segment(body: dict[str, Any]) -> Segment:
    low, high = body["band_hz"]
    numbers = {name: float(body[name]) for name in ("start", "stop")}
    amplitude, period = body["amplitude"], body["period_s"]
    return Segment(
        kind=str(body["kind"]),
        joints=tuple(body["joints"]),
        **numbers,
        amplitude=math.nan if amplitude is None else float(amplitude),
        repeat=int(body["repeat"]),
        band_hz=(float(low), float(high)),
        period_s=None if period is None else float(period),
        clamped=tuple(body["clamped"]),
    )


def _begun(segments: Iterable[Segment], last: float) -> Iterable[Segment]:
    """Segments that had begun by the last sample, ended there if they were cut."""
    for segment in segments:
        if segment.start < last:
            yield replace(segment, stop=min(segment.stop, last))
