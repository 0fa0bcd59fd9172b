"""JointLog read from MCAP: pronk's own, up to wherever it was cut or damaged, or a rosbag2's."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import orjson
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.files import sha256
from pronk.logs.joint_log import JointLog, Segment
from pronk.logs.mcap_format import END, HEADER, SAMPLE, SCHEMA, SEGMENT
from pronk.logs.mcap_stream import DamagedError, Record, records
from pronk.logs.rosbag_reader import read_joint_states
from pronk.robots.robot import Robot

Array = NDArray[np.float64]


def read_mcap(
    path: Path,
    *,
    robot: Robot | None = None,
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
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    found, damage = _gather(path, io.BytesIO(data), len(data))
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


def _gather(path: Path, stream: IO[bytes], size: int) -> tuple[list[Record], str]:
    """Every readable message, and what ended the reading early ("" if nothing did)."""
    found: list[Record] = []
    try:
        for batch in records(stream, size):
            found += batch
    except DamagedError as error:
        if not found:
            raise LogError(f"{path}: not a readable MCAP file ({error}).") from None
        return found, str(error)
    if not found:
        raise LogError(f"{path}: an MCAP file without messages; record or export it again.")
    return found, ""


def _from_pronk(path: Path, found: Iterable[Record], damage: str) -> JointLog:
    try:
        return _assemble(path, found, damage)
    except LogError:
        raise
    except (orjson.JSONDecodeError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise LogError(
            f"{path}: its messages are not those of {SCHEMA} ({type(error).__name__}: "
            f"{_line(error)})."
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
    frequency = np.array(
        [math.nan if row["frequency"] is None else row["frequency"] for row in rows],
        dtype=np.float64,
    )
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
    amplitude, period = body["amplitude"], body["period_s"]
    low, high = body["band_hz"]
    return Segment(
        kind=str(body["kind"]),
        joints=tuple(body["joints"]),
        start=float(body["start"]),
        stop=float(body["stop"]),
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


def _line(error: BaseException) -> str:
    """An error's words on one line."""
    return " ".join(str(error).split())[:200]
