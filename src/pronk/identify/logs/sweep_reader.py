"""The log of a sweep in MCAP, read up to where the recording or the file was cut.

`pronk.identify.logs.sweep_writer` writes it and describes its topics.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.files import sha256
from pronk.identify.logs.joint_log import JointLog, LogOrigin
from pronk.identify.logs.mcap import Record
from pronk.identify.logs.segment import Segment
from pronk.identify.logs.sweep_writer import (
    END,
    HEADER,
    SAMPLE,
    SCHEMA,
    SEGMENT,
    TOPICS,
    LogHeader,
)

_BLOCK = 128
"""Samples that are parsed together; their lists are too few to start Python's garbage collector,
which would take as long as the parsing."""
_WHOLE = 0.95
"""Share of an excitation from which on it counts as whole: what is missing is its rest."""


def read_sweep(path: Path, messages: Iterable[Record], damage: str) -> JointLog:
    """Make a log of the messages of a file.

    Args:
        path: The file, for messages and its hash.
        messages: Its messages, in the order written.
        damage: Why reading the file ended early, or "".

    Returns:
        The log, with `complete` False if the recording or the file was cut.

    Raises:
        LogError: The messages are not those of `SCHEMA`, or too few.
    """
    data: dict[str, list[bytes]] = {topic: [] for topic in TOPICS}
    for message in messages:
        if message.topic in data:
            data[message.topic].append(message.data)
    try:
        return _joint_log(path, data, damage)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise LogError(f"{path}: its messages are not those of {SCHEMA} ({reason}).") from None


def _joint_log(path: Path, data: Mapping[str, Sequence[bytes]], damage: str) -> JointLog:
    """Make a log of the encoded messages of each topic."""
    if not data[HEADER]:
        raise LogError(f"{path}: schema None; this pronk reads {SCHEMA!r}.")
    schema = msgspec.json.decode(data[HEADER][-1], type=dict[str, Any]).get("schema")
    if schema != SCHEMA:
        raise LogError(f"{path}: schema {schema!r}; this pronk reads {SCHEMA!r}.")
    if len(data[SAMPLE]) < 2:
        raise LogError(
            f"{path}: cut after {len(data[SAMPLE])} samples; nothing to read, record again."
        )
    header = msgspec.json.decode(data[HEADER][-1], type=LogHeader)
    samples = _read_samples(data[SAMPLE])
    end_time = float(samples.time[-1])
    complete = False
    notes = []
    if damage or not data[END]:
        notes.append(
            f"the file is cut short after {end_time:.3f} s ({damage or 'no end was written'}); "
            "what was recorded before is whole"
        )
    else:
        end = msgspec.json.decode(data[END][-1], type=dict[str, Any])
        complete = bool(end.get("complete", False))
        if not complete:
            notes.append(f"the recording was cut short ({end.get('reason') or 'no reason given'})")
    segments = [_read_segment(message) for message in data[SEGMENT]]
    if len(set(segments)) < len(segments):
        raise LogError(f"{path}: damaged: it has the same segment twice; record again.")
    recorded: list[Segment] = []
    for segment in segments:
        if segment.start >= end_time:
            continue
        # A segment that was cut ends with the last sample.
        shortened = replace(segment, stop=min(segment.stop, end_time))
        recorded_s = shortened.stop - shortened.start
        is_cut = recorded_s < _WHOLE * (segment.stop - segment.start)
        if is_cut and any(segment.joints == earlier.joints for earlier in recorded):
            # The others would be read as coarsely as it is, and one that stands still yet not.
            notes.append(
                f"the excitation of {', '.join(segment.joints)} that was cut after "
                f"{recorded_s:.1f} s is left out, as whole ones were recorded before"
            )
            continue
        recorded.append(shortened)
    return JointLog(
        robot=header.robot,
        joints=header.joints,
        time=samples.time,
        command=samples.command,
        position=samples.position,
        velocity=samples.velocity,
        torque=samples.torque,
        frequency=None if np.isnan(samples.frequency).all() else samples.frequency,
        segments=tuple(recorded),
        stiffness=_array(header.stiffness),
        damping=_array(header.damping),
        pose=_array(header.pose),
        units=header.units,
        notes=tuple(notes),
        origin=LogOrigin(
            source=str(path),
            sha256=sha256(path),
            virtual=header.virtual,
            complete=complete,
            metadata=header.metadata,
        ),
    )


def _array(numbers: Sequence[float] | None) -> Array | None:
    return None if numbers is None else np.array(numbers, dtype=np.float64)


def _read_segment(message: bytes) -> Segment:
    body = msgspec.json.decode(message, type=dict[str, Any])
    if body.get("amplitude") is None:
        body["amplitude"] = math.nan
    return msgspec.convert(body, Segment)


class _Sample(msgspec.Struct, gc=False):
    """The fields of a message on `/sweep/sample` that a log holds."""

    t: float
    command: list[float]
    position: list[float]
    velocity: list[float] | None = None
    torque: list[float] | None = None
    frequency: float | None = None


class _Samples(NamedTuple):
    """Samples as arrays, a row each; None for velocity or torque if the first sample has none."""

    time: Array
    command: Array
    position: Array
    velocity: Array | None
    torque: Array | None
    frequency: Array


def _read_samples(messages: Sequence[bytes]) -> _Samples:
    """Parse samples block by block, so that their many lists live only for a moment."""
    times = []
    commands = []
    positions = []
    velocities = []
    torques = []
    frequencies = []
    for first in range(0, len(messages), _BLOCK):
        encoded = messages[first : first + _BLOCK]
        try:
            block = _read_block(encoded)
        except (msgspec.MsgspecError, ValueError, TypeError) as error:
            raise ValueError(f"samples {first} to {first + len(encoded) - 1}: {error}") from None
        times.append(block.time)
        commands.append(block.command)
        positions.append(block.position)
        velocities.append(block.velocity)
        torques.append(block.torque)
        frequencies.append(block.frequency)
    return _Samples(
        time=np.concatenate(times),
        command=np.concatenate(commands),
        position=np.concatenate(positions),
        velocity=_joined(velocities),
        torque=_joined(torques),
        frequency=np.concatenate(frequencies),
    )


def _read_block(messages: Sequence[bytes]) -> _Samples:
    samples = msgspec.json.decode(b"[" + b",".join(messages) + b"]", type=list[_Sample])
    if len(samples) != len(messages):
        raise ValueError(f"{len(samples)} samples in {len(messages)} messages")
    times = []
    commands = []
    positions = []
    velocities = []
    torques = []
    frequencies = []
    for sample in samples:
        times.append(sample.t)
        commands.append(sample.command)
        positions.append(sample.position)
        velocities.append(sample.velocity)
        torques.append(sample.torque)
        frequencies.append(sample.frequency)
    return _Samples(
        time=np.array(times, dtype=np.float64),
        command=np.array(commands, dtype=np.float64),
        position=np.array(positions, dtype=np.float64),
        velocity=_optional(velocities),
        torque=_optional(torques),
        # A frequency of None becomes NaN.
        frequency=np.array(frequencies, dtype=np.float64),
    )


def _optional(rows: Sequence[Sequence[float] | None]) -> Array | None:
    """Rows of a quantity as an array; None if the first sample has none of it."""
    return None if rows[0] is None else np.array(rows, dtype=np.float64)


def _joined(blocks: Sequence[Array | None]) -> Array | None:
    """Blocks of a quantity one after another; None if the first block has none of it."""
    arrays = [block for block in blocks if block is not None]
    if blocks[0] is None:
        return None
    if len(arrays) < len(blocks):
        raise ValueError("some samples lack the velocity or the torque that others have")
    return np.concatenate(arrays)
