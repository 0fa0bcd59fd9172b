"""A recording of a robot under another program: states and commands as they came over the wire.

- `/record/header`, once, first: robot, joints, link, topics, whether the robot is virtual;
- `/record/state`, one per measured state: positions, velocities, torques;
- `/record/command`, one per command: targets, gains and torques as they were sent;
- `/record/end`, last: whether the recording is complete, and if not, why.

Each message has the time `t` at which it arrived and, where the wire says it, the time `sent` on
the clock of its sender. Arrival is late by the network and by a busy computer, and never early, so
that the least lateness tells how the sender's clock stands to the recorder's.

`read_recording` makes a `JointLog` of the longest time in which stiffness and damping on the wire
stayed the same: gains can be matched to no others. Before it other gains were ramped up, after it
the joints were damped.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array, Mask
from pronk.errors import LogError
from pronk.files import sha256
from pronk.identify.logs.columns import command_index
from pronk.identify.logs.joint_log import JointLog, LogOrigin
from pronk.identify.logs.mcap import (
    BOOLEAN,
    NUMBER,
    NUMBERS,
    STRING,
    STRINGS,
    McapWriter,
    Record,
)

RECORDING_SCHEMA = "pronk/record/1"
RECORDING_PREFIX = "/record/"
_HEADER = "/record/header"
STATE = "/record/state"
_COMMAND = "/record/command"
_END = "/record/end"
RECORDING_TOPICS: dict[str, dict[str, Any]] = {
    _HEADER: {
        "schema": STRING,
        "robot": STRING,
        "joints": STRINGS,
        "virtual": BOOLEAN,
        "has_torque": BOOLEAN,
        "metadata": {"type": "object"},
    },
    STATE: {
        "t": NUMBER,
        "sent": NUMBER,
        "position": NUMBERS,
        "velocity": NUMBERS,
        "torque": NUMBERS,
    },
    _COMMAND: {
        "t": NUMBER,
        "sent": NUMBER,
        "position": NUMBERS,
        "velocity": NUMBERS,
        "stiffness": NUMBERS,
        "damping": NUMBERS,
        "torque": NUMBERS,
    },
    _END: {"complete": BOOLEAN, "reason": STRING},
}
"""Properties of the messages of each topic, as JSON Schema has them."""
WireDrive = tuple[Array, Array, Array]
"""Stiffness, damping and torque of a command."""
_FLUSH_MESSAGES = 512
"""Messages in a chunk: half a second of states and commands at 500 Hz."""
_SHORTEST_S = 2.0
"""Shortest time with the same gains of which a log is made [s]."""
_SILENCE_S = 0.5
"""Time after a command in which it counts as being in force [s]; other programs send every few
milliseconds."""
_DRIFTING_S = 6.0
"""Time from which on the drift between two clocks is taken into account [s]: quartz clocks differ
by 50 millionths, 0.3 ms in this time, which is what the least lateness is known to."""
_LARGEST_DRIFT = 2e-4
"""Largest relative drift between two quartz clocks."""
_CLOCK_SET_S = 0.2
"""Change of the least lateness between the halves of a recording, or step back of the times of
sending, from which on a clock was set meanwhile or two senders have two clocks [s]. A recorder that
stood still is no such change: what it hears afterwards was sent in order."""
_LATE_S = 0.02
"""Median lateness of the messages from which on the log says so [s]: ten times what a network and a
computer that is not busy take."""


@dataclass(frozen=True, kw_only=True)
class RecordingHeader:
    """What is known of a recording before its first message."""

    robot: str
    """Name of the robot."""
    joints: tuple[str, ...]
    """Names of the joints."""
    virtual: bool = False
    """True if the machine was the virtual robot."""
    has_torque: bool = False
    """True if the states carry torques."""
    metadata: dict[str, str] = field(default_factory=dict)
    """Named remarks: link, topics."""


class RecordingWriter:
    """Writes a recording as it comes, in its place: one that is interrupted must stay."""

    def __init__(self, path: Path, header: RecordingHeader) -> None:
        """Open `path`, which is replaced, and write the header."""
        self._file = McapWriter(path, RECORDING_TOPICS)
        self._in_chunk = 0
        self._wall_offset_s = time.time() - time.monotonic()
        """Wall clock less the monotonic clock [s]."""
        self._last = time.monotonic()
        body = {
            "schema": RECORDING_SCHEMA,
            "robot": header.robot,
            "joints": header.joints,
            "virtual": header.virtual,
            "has_torque": header.has_torque,
            "metadata": header.metadata,
        }
        self._put(_HEADER, self._last, body)
        self._flush()

    def state(
        self, arrived: float, sent: float | None, position: Array, velocity: Array, torque: Array
    ) -> None:
        """Write a state.

        Args:
            arrived: When it came, on the monotonic clock [s].
            sent: When it was sent, on the sender's clock [s]; None if that is not known.
            position: Positions [rad], shape (joints,).
            velocity: Velocities [rad/s], shape (joints,).
            torque: Torques [N m], shape (joints,).
        """
        body: dict[str, Any] = {"t": arrived, "sent": sent, "position": position}
        body["velocity"] = velocity
        body["torque"] = torque
        self._put(STATE, arrived, body)

    def command(
        self, arrived: float, sent: float | None, targets: tuple[Array, Array], drive: WireDrive
    ) -> None:
        """Write a command.

        Args:
            arrived: When it came, on the monotonic clock [s].
            sent: When it was sent, on the sender's clock [s]; None if that is not known.
            targets: Positions [rad] and velocities [rad/s], shape (joints,) each.
            drive: Stiffness [N m/rad], damping [N m s/rad] and torque [N m], shape (joints,) each.
        """
        body: dict[str, Any] = {"t": arrived, "sent": sent}
        body["position"], body["velocity"] = targets
        body["stiffness"], body["damping"], body["torque"] = drive
        self._put(_COMMAND, arrived, body)

    def end(self, *, complete: bool = True, reason: str = "") -> None:
        """Write the end and close the file; `reason` says why the recording is not complete."""
        self._put(_END, self._last, {"complete": complete, "reason": reason})
        self._file.close()

    def _put(self, topic: str, instant: float, body: Mapping[str, Any]) -> None:
        self._last = instant
        self._file.put(topic, instant + self._wall_offset_s, body)
        self._in_chunk += 1
        if self._in_chunk >= _FLUSH_MESSAGES:
            self._flush()

    def _flush(self) -> None:
        """Finish the chunk and pass everything to the operating system."""
        self._file.flush()
        self._in_chunk = 0


class _StateMessage(msgspec.Struct, gc=False):
    """A message on `/record/state`."""

    t: float
    position: list[float]
    velocity: list[float]
    torque: list[float]
    sent: float | None = None


class _CommandMessage(msgspec.Struct, gc=False):
    """A message on `/record/command`."""

    t: float
    position: list[float]
    velocity: list[float]
    stiffness: list[float]
    damping: list[float]
    torque: list[float]
    sent: float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class _Commands:
    """The commands of a recording, m of them."""

    time: Array
    """When each was sent, on the recorder's clock [s], shape (m,)."""
    position: Array
    """Targets [rad], shape (m, joints)."""
    velocity: Array
    """Targets [rad/s], shape (m, joints)."""
    gains: Array
    """Stiffness, then damping of all joints, shape (m, 2 joints)."""
    torque: Array
    """Torques [N m], shape (m, joints)."""


def read_recording(path: Path, messages: Sequence[Record], damage: str) -> JointLog:
    """Make a log of the messages of a recording.

    Args:
        path: The file, for messages and its hash.
        messages: Its messages, in the order written.
        damage: Why reading the file ended early, or "".

    Returns:
        The longest part with the same stiffness and damping throughout, a row for each state, with
        the command in force.

    Raises:
        LogError: The messages are not those of `RECORDING_SCHEMA`, or no part has the same gains
            for long enough.
    """
    data: dict[str, list[bytes]] = {topic: [] for topic in RECORDING_TOPICS}
    for message in messages:
        if message.topic in data:
            data[message.topic].append(message.data)
    if not data[_HEADER]:
        raise LogError(f"{path}: no {_HEADER}; a recording begins with one.")
    try:
        schema = msgspec.json.decode(data[_HEADER][0], type=dict[str, Any]).get("schema")
        if schema != RECORDING_SCHEMA:
            raise LogError(f"{path}: schema {schema!r}; this pronk reads {RECORDING_SCHEMA!r}.")
        header = msgspec.json.decode(data[_HEADER][0], type=RecordingHeader)
        states = [msgspec.json.decode(body, type=_StateMessage) for body in data[STATE]]
        sent = [msgspec.json.decode(body, type=_CommandMessage) for body in data[_COMMAND]]
        end: dict[str, Any] = {}
        if data[_END]:
            end = msgspec.json.decode(data[_END][-1], type=dict[str, Any])
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise LogError(
            f"{path}: its messages are not those of {RECORDING_SCHEMA} ({reason})."
        ) from None
    if len(states) < 2 or not sent:
        raise LogError(
            f"{path}: {len(states)} states and {len(sent)} commands; expected both. Record while "
            "the other program commands the joints."
        )
    width = len(header.joints)
    notes = []
    try:
        position = _rows([state.position for state in states], width)
        velocity = _rows([state.velocity for state in states], width)
        torque = _rows([state.torque for state in states], width)
        commands = _commands(sent, width)
    except ValueError as error:
        raise LogError(f"{path}: damaged: {error}; record again.") from None
    times = _sent_times([state.t for state in states], [state.sent for state in states])
    late_s = max(
        float(np.median(np.array([state.t for state in states]) - times)),
        float(np.median(np.sort([command.t for command in sent]) - commands.time)),
    )
    if late_s > _LATE_S:
        notes.append(
            f"half of the messages came {1e3 * late_s:.0f} ms late or more: the computer that "
            "recorded was busy, and commands and states may be apart by as much; record again on a "
            "quiet computer if the delay matters"
        )
    increasing = _increasing(times)
    rows = np.flatnonzero(increasing)
    if len(rows) < len(states):
        notes.append(f"{len(states) - len(rows)} states that came out of order were dropped")
    times = times[rows]
    part, gains = _longest_part(path, times, commands)
    if damage or not end:
        notes.append(f"the file is cut short ({damage or 'no end was written'})")
    elif not end.get("complete", False):
        notes.append(f"the recording was cut short ({end.get('reason') or 'no reason given'})")
    stiffness = gains[:width]
    damping = gains[width:]
    joints = np.flatnonzero(stiffness > 0.0)
    free = [header.joints[k] for k in np.flatnonzero(stiffness == 0.0)]
    if free:
        notes.append(f"no position is commanded of {', '.join(free)}: left out")
    duration = float(times[part[-1]] - times[part[0]])
    whole = float(times[-1] - times[0])
    if duration < 0.99 * whole:
        notes.append(
            f"{duration:.1f} s of {whole:.1f} s: the longest part with the same stiffness and "
            "damping on the wire"
        )
    index = command_index(commands.time, times[part])
    command = commands.position[index]
    beside = damping * commands.velocity[index] + commands.torque[index]
    moved = [header.joints[k] for k in joints if np.ptp(beside[:, k]) > 0.0 or beside[0, k] != 0.0]
    if moved:
        notes.append(
            f"torques and velocities commanded of {', '.join(moved)} count as a shift of the "
            "position, over the stiffness on the wire"
        )
    command = command[:, joints] + beside[:, joints] / stiffness[joints]
    picked = rows[part]
    return JointLog(
        robot=header.robot,
        joints=tuple(header.joints[k] for k in joints),
        time=times[part],
        command=command,
        position=position[picked][:, joints],
        velocity=velocity[picked][:, joints],
        torque=torque[picked][:, joints] if header.has_torque else None,
        stiffness=stiffness[joints],
        damping=damping[joints],
        units=("rad",) * len(joints),
        notes=tuple(notes),
        origin=LogOrigin(
            source=str(path),
            sha256=sha256(path),
            virtual=header.virtual,
            complete=not damage and bool(end.get("complete", False)),
            metadata=header.metadata,
        ),
    )


def _rows(lists: Sequence[Sequence[float]], width: int) -> Array:
    """Return lists as rows of numbers; ValueError where one has another length."""
    if any(len(numbers) != width for numbers in lists):
        raise ValueError(f"a message has another number of values than {width}, the joints")
    return np.array(lists, dtype=np.float64)


def _commands(messages: Sequence[_CommandMessage], width: int) -> _Commands:
    """Return commands as arrays, in order of time."""
    times = _sent_times([command.t for command in messages], [command.sent for command in messages])
    order = np.argsort(times, kind="stable")
    stiffness = _rows([command.stiffness for command in messages], width)
    damping = _rows([command.damping for command in messages], width)
    return _Commands(
        time=times[order],
        position=_rows([command.position for command in messages], width)[order],
        velocity=_rows([command.velocity for command in messages], width)[order],
        gains=np.column_stack([stiffness, damping])[order],
        torque=_rows([command.torque for command in messages], width)[order],
    )


def _sent_times(arrived: Sequence[float], sent: Sequence[float | None]) -> Array:
    """Return when messages were sent, on the recorder's clock [s], shape (n,).

    The least lateness in each half of the recording is taken for none. Where the sender's clock is
    not known, or was set meanwhile, messages count as sent when they arrived.

    Args:
        arrived: When each came, on the recorder's clock [s].
        sent: When each was sent, on the sender's clock [s].
    """
    arrivals = np.array(arrived, dtype=np.float64)
    if any(stamp is None for stamp in sent) or len(arrivals) < 2:
        return arrivals
    stamps = np.array(sent, dtype=np.float64)
    lateness = arrivals - stamps
    in_first_half = stamps <= 0.5 * (stamps[0] + stamps[-1])
    if np.diff(stamps).min() < -_CLOCK_SET_S or in_first_half.all() or not in_first_half.any():
        return arrivals
    first = int(np.argmin(np.where(in_first_half, lateness, np.inf)))
    last = int(np.argmin(np.where(in_first_half, np.inf, lateness)))
    change = float(lateness[last] - lateness[first])
    if abs(change) > _CLOCK_SET_S:
        return arrivals
    between_s = float(stamps[last] - stamps[first])
    if stamps[-1] - stamps[0] < _DRIFTING_S or abs(change) > _LARGEST_DRIFT * between_s:
        return np.asarray(stamps + lateness.min())
    drift = change / between_s
    return np.asarray(stamps + lateness[first] + drift * (stamps - stamps[first]))


def _increasing(times: Array) -> Mask:
    """Mark the instants that are later than all before them, shape (n,)."""
    latest = np.maximum.accumulate(times)
    return np.concatenate(([True], times[1:] > latest[:-1]))


def _longest_part(path: Path, times: Array, commands: _Commands) -> tuple[NDArray[np.intp], Array]:
    """Find the longest run of states with the same gains in force.

    Args:
        path: The file, for the message.
        times: Instants of the states [s], shape (n,).
        commands: The commands.

    Returns:
        Indices of the states, and their gains, shape (2 joints,).

    Raises:
        LogError: No run is long enough.
    """
    index = command_index(commands.time, times)
    gains, number_of_command = np.unique(commands.gains, axis=0, return_inverse=True)
    number: NDArray[np.intp] = number_of_command.reshape(-1)[np.maximum(index, 0)]
    width = commands.position.shape[1]
    # Numbers of gains are 0 or more; -1 stands for states without a position command in force.
    controlled = (gains[:, :width] > 0.0).sum(axis=1)[number] > 0
    fresh = (index >= 0) & (times - commands.time[np.maximum(index, 0)] < _SILENCE_S)
    number = np.where(controlled & fresh, number, -1)
    ends = np.flatnonzero(np.diff(number)) + 1
    best = np.arange(0)
    longest_s = -1.0
    for run in np.split(np.arange(len(times)), ends):
        length_s = float(times[run[-1]] - times[run[0]])
        if number[run[0]] >= 0 and length_s > longest_s:
            best = run
            longest_s = length_s
    if longest_s < _SHORTEST_S:
        kinds = len(set(number[number >= 0].tolist()))
        longest = "none" if longest_s < 0.0 else f"{longest_s:.1f} s"
        raise LogError(
            f"{path}: the longest part with the same stiffness and damping on the wire is "
            f"{longest}, of {kinds} different ones; expected {_SHORTEST_S:g} s or more. Record a "
            "controller that keeps its gains while it moves the joints."
        )
    return best, gains[number[best[0]]]
