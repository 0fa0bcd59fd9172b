"""JointLog written as MCAP, as it happens.

Chunks are short and flushed as they fill, so that a power cut costs half a second, never the log.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
import orjson
from mcap.writer import CompressionType, IndexType, Writer
from numpy.typing import NDArray

from pronk.files import written_whole
from pronk.logs.joint_log import JointLog, Segment
from pronk.logs.mcap_format import END, HEADER, SAMPLE, SCHEMA, SCHEMAS, SEGMENT, LogHeader

Array = NDArray[np.float64]

Floats = Sequence[float] | Array

_FLUSH_SAMPLES = 256
"""Samples in a chunk: half a second at 500 Hz."""


class McapLogWriter:
    """Writes a log as it happens. A context manager; leaving it by an error ends it as cut short.

    The file is not written aside and renamed: a recording that is interrupted must stay.
    """

    def __init__(self, path: Path, header: LogHeader) -> None:
        """Open `path`, which is replaced, and write the header.

        Args:
            path: File to write.
            header: What is known beforehand.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._stream: IO[bytes] = path.open("wb")
        self._writer = Writer(
            self._stream, compression=CompressionType.ZSTD, index_types=IndexType.ALL
        )
        self._writer.start(profile="", library="pronk")
        self._channels: dict[str, int] = {}
        for topic, properties in SCHEMAS.items():
            name = "pronk." + topic.removeprefix("/").replace("/", ".")
            schema = {"title": name, "type": "object", "properties": properties}
            schema_id = self._writer.register_schema(name, "jsonschema", orjson.dumps(schema))
            self._channels[topic] = self._writer.register_channel(topic, "json", schema_id)
        self._pending = 0
        self._segments = 0
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
        """End the log: whole if the block succeeded, cut short with the reason otherwise."""
        self.end(complete=error is None, reason=reason_of(error))

    def segment(self, segment: Segment) -> int:
        """Announce a question, before its samples; returns its number."""
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

        Args:
            time: Measured timestamp [s].
            command: Position command in force [rad], one per joint.
            position: Measured position [rad], one per joint.
            velocity: Measured velocity [rad/s], one per joint.
            torque: Measured torque [N m], one per joint.
            frequency: Instantaneous frequency [Hz]; NaN between questions.
            segment: Number of the question; -1 between questions.
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
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._pending = 0

    def end(self, *, complete: bool = True, reason: str = "") -> None:
        """Write the end and close the file; ending twice does no harm."""
        if self._ended:
            return
        self._ended = True
        self._put(END, self._last, {"complete": complete, "reason": reason})
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()

    def _put(self, topic: str, time: float, body: dict[str, Any]) -> None:
        self._last = time
        stamp = max(0, round(time * 1e9))
        # NaN and infinity become null.
        data = orjson.dumps(body, option=orjson.OPT_SERIALIZE_NUMPY)
        self._writer.add_message(self._channels[topic], stamp, data, stamp)


def reason_of(error: BaseException | None) -> str:
    """Why a log ends, in words; empty if nothing went wrong."""
    return "" if error is None else f"{type(error).__name__}: {error}".rstrip(": ")


def write_mcap(path: Path, log: JointLog) -> None:
    """Write a log that is already there, whole or not at all."""

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
