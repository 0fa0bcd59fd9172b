"""JointState recordings of ROS 2 (rosbag2 in MCAP) as a JointLog.

A bag does not say which topic is the command, so the command topic must be named.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.files import sha256
from pronk.logs.columns import in_force
from pronk.logs.joint_log import JointLog
from pronk.logs.mcap import Record

Array = NDArray[np.float64]

JOINT_STATE = "sensor_msgs/msg/JointState"
MEASURED_TOPIC = "/joint_states"
"""Where ROS 2 publishes measured joint states by convention."""


def read_joint_states(
    path: Path,
    found: Sequence[Record],
    damage: str,
    *,
    robot: str,
    measured_topic: str | None,
    command_topic: str | None,
    command_field: str,
) -> JointLog:
    """Join the measured states of one topic with the commands of another.

    Header stamps are used where both topics have them, times of reception otherwise: two clocks
    are never mixed. The command in force at a state is the last one at or before it.

    Args:
        path: The file, for messages.
        found: Its messages.
        damage: Why reading ended early, or "".
        robot: Name of the robot.
        measured_topic: Topic of the measured JointState; `/joint_states` if None.
        command_topic: Topic of the commands: JointState, or any message with the field below.
        command_field: Positions in a command message, dots between names, numbers for indices.

    Raises:
        LogError: A topic is missing or holds something else; the message lists what there is.
    """
    topics = {r.topic: r.schema.name if r.schema else r.encoding for r in found}
    listed = ", ".join(f"{topic} ({name})" for topic, name in sorted(topics.items()))
    measured_topic = measured_topic or MEASURED_TOPIC
    if topics.get(measured_topic) != JOINT_STATE:
        raise LogError(
            f"{path}: no {JOINT_STATE} on {measured_topic}; it holds {listed}; name the topic "
            "with measured_topic."
        )
    if command_topic is None:
        raise LogError(
            f"{path}: command_topic is missing; the file holds {listed}; name the topic of the "
            "commands (and command_field where the positions are not in `position`)."
        )
    if command_topic not in topics or command_topic == measured_topic:
        raise LogError(f"{path}: no commands on {command_topic}; it holds {listed}.")
    decode = _decoder(path)
    states = [(r, decode(r)) for r in found if r.topic == measured_topic]
    commands = [(r, decode(r)) for r in found if r.topic == command_topic]
    stamped = all(_stamp(message) > 0.0 for _, message in (*states, *commands))

    def times(pairs: list[tuple[Record, Any]]) -> Array:
        return np.array([_stamp(m) if stamped else r.log_time * 1e-9 for r, m in pairs])

    joints = tuple(str(name) for name in states[0][1].name)
    time, sent = times(states), times(commands)
    wanted = np.array(
        [_command(path, command_topic, command_field, m, joints) for _, m in commands]
    )
    order = np.argsort(sent, kind="stable")
    index = in_force(sent[order], time)
    known = index >= 0
    if int(known.sum()) < 2:
        raise LogError(
            f"{path}: {int(known.sum())} states on {measured_topic} follow a command on "
            f"{command_topic}; at least 2 are needed."
        )

    def measured(name: str) -> Array | None:
        """One field of every state, shape (n, joints); None where a state lacks it."""
        if any(len(getattr(message, name)) == 0 for _, message in states):
            return None
        rows = [_by_name(path, measured_topic, m.name, getattr(m, name), joints) for _, m in states]
        matrix = np.array(rows)[known]
        # Drivers fill what they do not measure with NaN.
        return None if name != "position" and np.isnan(matrix).any() else matrix

    position = measured("position")
    if position is None:
        raise LogError(f"{path}: the states on {measured_topic} hold no positions.")
    notes = {
        f"{(~known).sum()} states before the first command were dropped": not known.all(),
        "message headers hold no stamps on both topics; times of reception were used": not stamped,
        f"the file is cut short ({damage})": bool(damage),
    }
    return JointLog(
        robot=robot,
        joints=joints,
        time=time[known] - time[known][0],
        command=wanted[order][index[known]],
        position=position,
        velocity=measured("velocity"),
        torque=measured("effort"),
        source=str(path),
        sha256=sha256(path),
        complete=not damage,
        notes=tuple(note for note, applies in notes.items() if applies),
        metadata={"measured_topic": measured_topic, "command_topic": command_topic},
    )


def _decoder(path: Path) -> Callable[[Record], Any]:
    factory = DecoderFactory()

    def decode(record: Record) -> Any:
        try:
            decoder = factory.decoder_for(record.encoding, record.schema)
            if decoder is not None:
                return decoder(record.data)
        except Exception as error:
            # The decoder is generated from the file's own schema and may fail in any way.
            raise LogError(
                f"{path}: a message on {record.topic} cannot be decoded ({type(error).__name__})."
            ) from error
        raise LogError(
            f"{path}: messages on {record.topic} are encoded as {record.encoding!r} with schema "
            f"{record.schema.encoding if record.schema else 'none'!r}; expected cdr with ros2msg."
        )

    return decode


def _stamp(message: Any) -> float:
    """Stamp of the header [s]; 0 where there is none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0.0 if stamp is None else float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def _by_name(
    path: Path, topic: str, names: Sequence[str], values: Sequence[float], joints: Sequence[str]
) -> list[float]:
    """Values in the order of `joints`."""
    if names and len(names) == len(values):
        each = dict(zip(names, values, strict=True))
        if missing := [joint for joint in joints if joint not in each]:
            raise LogError(
                f"{path}: a message on {topic} lacks {', '.join(missing)}; it names "
                f"{', '.join(names)}."
            )
        return [float(each[joint]) for joint in joints]
    if len(values) != len(joints):
        raise LogError(
            f"{path}: a message on {topic} holds {len(values)} values; expected {len(joints)} "
            f"({', '.join(joints)})."
        )
    return [float(value) for value in values]


def _command(
    path: Path, topic: str, field: str, message: Any, joints: Sequence[str]
) -> list[float]:
    """Positions of one command message."""
    value = message
    for part in field.split("."):
        try:
            value = value[int(part)] if part.isdecimal() else getattr(value, part)
        except (AttributeError, IndexError, TypeError):
            slots = [s for s in getattr(value, "__slots__", ()) if not s.startswith("_")]
            raise LogError(
                f"{path}: commands on {topic} have no field {field!r} (at {part!r}"
                + (f"; there are {', '.join(slots)}" if slots else "")
                + "); name it with command_field."
            ) from None
    names = getattr(message, "name", None) or getattr(message, "joint_names", None) or []
    try:
        return _by_name(path, topic, list(names), [_number(v) for v in value], joints)
    except TypeError:
        raise LogError(
            f"{path}: field {field!r} of the commands on {topic} is not a list of numbers; name "
            "another with command_field."
        ) from None


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError
    return float(value) if math.isfinite(value) else math.nan
