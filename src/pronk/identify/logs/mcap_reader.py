"""MCAP files: logs of pronk, and JointState recordings of ROS 2 (rosbag2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap_ros2.decoder import DecoderFactory

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.files import sha256
from pronk.identify.logs.columns import in_force, ordered
from pronk.identify.logs.joint_log import JointLog, LogOrigin
from pronk.identify.logs.mcap import Record, read_records
from pronk.identify.logs.mcap_log import read_sweep
from pronk.robots.robot import RobotSpec

JOINT_STATE = "sensor_msgs/msg/JointState"
MEASURED_TOPIC = "/joint_states"
"""Where ROS 2 publishes measured joint states by convention."""


def read_mcap(
    path: Path,
    *,
    robot: RobotSpec | None = None,
    measured_topic: str | None = None,
    command_topic: str | None = None,
    command_field: str = "position",
    joint_order: Sequence[str] | None = None,
) -> JointLog:
    """Read a log of pronk, or join the JointStates of a rosbag2 with the commands on another topic.

    A file that was cut anywhere gives the log of what came before, with `complete` False. The
    options are of rosbag2 alone. A bag does not say which topic is the command: `command_topic` is
    of JointStates, or of any messages with the positions at `command_field` (dots between names,
    numbers for indices, as in `points.0.positions`). `joint_order` names the joints of commands
    without names, as of `columns.ordered`.

    Header stamps are used where both topics have them, times of reception otherwise: two clocks
    are never mixed. The command in force at a state is the last one at or before it.
    """
    found, damage = read_records(path)
    if any(record.topic.startswith("/sweep/") for record in found):
        if measured_topic or command_topic or joint_order not in (None, "default"):
            raise LogError(
                f"{path}: a log of pronk needs no --measured-topic, --command-topic or "
                "--joint-order; leave them out."
            )
        return read_sweep(path, found, damage)
    measured_topic = measured_topic or MEASURED_TOPIC
    command_topic = _checked(path, found, measured_topic, command_topic)
    states, received = _decoded(path, found, measured_topic)
    commands, arrived = _decoded(path, found, command_topic)
    stamps = [np.array([_stamp(message) for message in each]) for each in (states, commands)]
    stamped = all((each > 0.0).all() for each in stamps)
    time, sent = stamps if stamped else (received, arrived)
    joints = tuple(str(name) for name in states[0].name)
    order = np.argsort(sent, kind="stable")
    index = in_force(sent[order], time)
    known = index >= 0
    if int(known.sum()) < 2:
        raise LogError(
            f"{path}: {int(known.sum())} states on {measured_topic} follow a command on "
            f"{command_topic}; at least 2 are needed."
        )

    def values(messages: Sequence[Any], topic: str, field: str) -> Array:
        rows = []
        for message in messages:
            names, numbers = _values(path, topic, message, field)
            what = f"{path}: the {len(numbers)} values of a message on {topic}"
            if len(numbers) != 1 or len(joints) != 1 or names:
                names = ordered(what, len(numbers), robot, joint_order, names)
            else:
                names = joints
            if missing := [joint for joint in joints if joint not in names]:
                raise LogError(f"{what} lack {', '.join(missing)}; they are {', '.join(names)}.")
            rows.append([numbers[names.index(joint)] for joint in joints])
        return np.array(rows)

    def measured(field: str) -> Array | None:
        """Velocity or effort; None where a state lacks it."""
        if any(len(getattr(state, field)) == 0 for state in states):
            return None
        matrix = values(states, measured_topic, field)[known]
        # Drivers fill what they do not measure with NaN.
        return None if np.isnan(matrix).any() else matrix

    notes = {
        f"{(~known).sum()} states before the first command were dropped": not known.all(),
        "message headers hold no stamps on both topics; times of reception were used": not stamped,
        f"the file is cut short ({damage})": bool(damage),
    }
    return JointLog(
        robot="unknown" if robot is None else robot.name,
        joints=joints,
        time=time[known] - time[known][0],
        command=values(commands, command_topic, command_field)[order][index[known]],
        position=values(states, measured_topic, "position")[known],
        velocity=measured("velocity"),
        torque=measured("effort"),
        notes=tuple(note for note, applies in notes.items() if applies),
        origin=LogOrigin(
            source=str(path),
            sha256=sha256(path),
            complete=not damage,
            metadata={"measured_topic": measured_topic, "command_topic": command_topic},
        ),
    )


def _checked(
    path: Path, found: Sequence[Record], measured_topic: str, command_topic: str | None
) -> str:
    """Return the topic of the commands; where one of both is wrong, a LogError lists all topics."""
    topics = {r.topic: r.schema.name if r.schema else r.encoding for r in found}
    listed = ", ".join(f"{topic} ({name})" for topic, name in sorted(topics.items()))
    if topics.get(measured_topic) != JOINT_STATE:
        raise LogError(
            f"{path}: no {JOINT_STATE} on {measured_topic}; it holds {listed}; name the topic "
            "with --measured-topic."
        )
    if command_topic is None:
        raise LogError(
            f"{path}: --command-topic is missing; the file holds {listed}; name the topic of the "
            "commands (and --command-field where the positions are not in `position`)."
        )
    if command_topic not in topics or command_topic == measured_topic:
        raise LogError(f"{path}: no commands on {command_topic}; it holds {listed}.")
    return command_topic


def _decoded(path: Path, found: Sequence[Record], topic: str) -> tuple[list[Any], Array]:
    """Messages of a topic, and when they were received [s]."""
    factory, messages = DecoderFactory(), []
    records = [record for record in found if record.topic == topic]
    for record in records:
        try:
            decode = factory.decoder_for(record.encoding, record.schema)
            messages.append(None if decode is None else decode(record.data))
        except Exception as error:
            # The decoder is generated from the file's own schema and may fail in any way.
            raise LogError(
                f"{path}: a message on {topic} cannot be decoded ({type(error).__name__})."
            ) from error
        if decode is None:
            raise LogError(
                f"{path}: messages on {topic} are encoded as {record.encoding!r} with schema "
                f"{record.schema.encoding if record.schema else 'none'!r}; expected cdr with "
                "ros2msg."
            )
    return messages, np.array([record.log_time * 1e-9 for record in records])


def _stamp(message: Any) -> float:
    """Stamp of the header [s]; 0 where there is none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0.0 if stamp is None else float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def _values(
    path: Path, topic: str, message: Any, field: str
) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Joint names of a message, if it has any, and the numbers of a field."""
    value = message
    for part in field.split("."):
        try:
            value = value[int(part)] if part.isdecimal() else getattr(value, part)
        except (AttributeError, IndexError, TypeError):
            slots = [s for s in getattr(value, "__slots__", ()) if not s.startswith("_")]
            raise LogError(
                f"{path}: messages on {topic} have no field {field!r} (at {part!r}"
                + (f"; there are {', '.join(slots)}" if slots else "")
                + "); name it with --command-field."
            ) from None
    try:
        numbers = tuple(math.nan if math.isinf(number) else float(number) for number in value)
    except TypeError:
        raise LogError(
            f"{path}: field {field!r} of the messages on {topic} is not a list of numbers; name "
            "another with --command-field."
        ) from None
    names = getattr(message, "name", None) or getattr(message, "joint_names", None) or ()
    return tuple(map(str, names)), numbers
