"""MCAP files: logs of pronk, and JointState recordings of ROS 2 (rosbag2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pronk.arrays import Array, Mask
from pronk.errors import LogError
from pronk.files import sha256
from pronk.identify.logs.columns import command_index, ordered_joints
from pronk.identify.logs.joint_log import JointLog, LogOrigin
from pronk.identify.logs.mcap import Record, read_records
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.sweep_reader import read_sweep
from pronk.robots.robot import RobotSpec

JOINT_STATE = "sensor_msgs/msg/JointState"
"""Type of the messages that hold measured joint states in ROS 2."""
MEASURED_TOPIC = "/joint_states"
"""Topic on which ROS 2 publishes measured joint states by convention."""


def read_mcap(path: Path, robot: RobotSpec | None, options: ReadOptions) -> JointLog:
    """Read a log of pronk or a rosbag2.

    A file that was cut anywhere gives the log of what came before, with `complete` False. The
    options for topics, fields and the joint order are of rosbag2 alone.

    Raises:
        LogError: The file is no MCAP file, or holds neither kind of log.
    """
    messages, damage = read_records(path)
    if any(message.topic.startswith("/sweep/") for message in messages):
        named_order = options.joint_order not in (None, "default")
        if options.measured_topic or options.command_topic or named_order:
            raise LogError(
                f"{path}: a log of pronk needs no --measured-topic, --command-topic or "
                "--joint-order; leave them out."
            )
        return read_sweep(path, messages, damage)
    return _read_rosbag(path, messages, damage, robot, options)


def _read_rosbag(
    path: Path,
    messages: Sequence[Record],
    damage: str,
    robot: RobotSpec | None,
    options: ReadOptions,
) -> JointLog:
    """Join the JointStates of a rosbag2 with the commands on another topic.

    Commands are JointStates as well, or any messages with the positions in one field. Header
    stamps are used where both topics have them, times of reception otherwise: two clocks are never
    mixed. The command in force at a state is the last one at or before it.
    """
    measured_topic = options.measured_topic or MEASURED_TOPIC
    command_topic = _command_topic(path, messages, measured_topic, options.command_topic)
    states, state_times = _decode(path, messages, measured_topic)
    commands, command_times = _decode(path, messages, command_topic)
    state_stamps = np.array([_stamp(state) for state in states])
    command_stamps = np.array([_stamp(command) for command in commands])
    stamped = bool((state_stamps > 0.0).all() and (command_stamps > 0.0).all())
    if stamped:
        state_times = state_stamps
        command_times = command_stamps
    order = np.argsort(command_times, kind="stable")
    index = command_index(command_times[order], state_times)
    commanded = index >= 0
    if int(commanded.sum()) < 2:
        raise LogError(
            f"{path}: {int(commanded.sum())} states on {measured_topic} follow a command on "
            f"{command_topic}; at least 2 are needed."
        )
    joints = tuple(str(name) for name in states[0].name)
    table = _MessageTable(path, joints, robot, options.joint_order)
    command_field = options.command_field or "position"
    command = table.rows(commands, command_topic, command_field)[order]
    position = table.rows(states, measured_topic, "position")
    velocity = table.optional_rows(states, measured_topic, "velocity", commanded)
    torque = table.optional_rows(states, measured_topic, "effort", commanded)
    notes = []
    if not commanded.all():
        notes.append(f"{(~commanded).sum()} states before the first command were dropped")
    if not stamped:
        notes.append("message headers hold no stamps on both topics; times of reception were used")
    if damage:
        notes.append(f"the file is cut short ({damage})")
    time = state_times[commanded]
    return JointLog(
        robot="unknown" if robot is None else robot.name,
        joints=joints,
        time=time - time[0],
        command=command[index[commanded]],
        position=position[commanded],
        velocity=velocity,
        torque=torque,
        notes=tuple(notes),
        origin=LogOrigin(
            source=str(path),
            sha256=sha256(path),
            complete=not damage,
            metadata={"measured_topic": measured_topic, "command_topic": command_topic},
        ),
    )


def _command_topic(
    path: Path, messages: Sequence[Record], measured_topic: str, command_topic: str | None
) -> str:
    """Return the topic of the commands; if either topic is wrong, a LogError lists all topics."""
    kinds = {}
    for message in messages:
        kinds[message.topic] = message.schema.name if message.schema else message.encoding
    listed = ", ".join(f"{topic} ({kinds[topic]})" for topic in sorted(kinds))
    if kinds.get(measured_topic) != JOINT_STATE:
        raise LogError(
            f"{path}: no {JOINT_STATE} on {measured_topic}; it holds {listed}; name the topic "
            "with --measured-topic."
        )
    if command_topic is None:
        raise LogError(
            f"{path}: --command-topic is missing; the file holds {listed}; name the topic of the "
            "commands (and --command-field where the positions are not in `position`)."
        )
    if command_topic not in kinds or command_topic == measured_topic:
        raise LogError(f"{path}: no commands on {command_topic}; it holds {listed}.")
    return command_topic


def _decode(path: Path, messages: Sequence[Record], topic: str) -> tuple[list[Any], Array]:
    """Decode the messages of a topic; also returns when they were received [s]."""
    from mcap_ros2.decoder import DecoderFactory  # needed for rosbag2 alone

    factory = DecoderFactory()
    decoded = []
    received = []
    for message in messages:
        if message.topic != topic:
            continue
        try:
            decode = factory.decoder_for(message.encoding, message.schema)
            content = None if decode is None else decode(message.data)
        except Exception as error:
            # The decoder is generated from the file's own schema and may fail in any way.
            raise LogError(
                f"{path}: a message on {topic} cannot be decoded ({type(error).__name__})."
            ) from error
        if decode is None:
            schema = message.schema.encoding if message.schema else "none"
            raise LogError(
                f"{path}: messages on {topic} are encoded as {message.encoding!r} with schema "
                f"{schema!r}; expected cdr with ros2msg."
            )
        decoded.append(content)
        received.append(message.log_time * 1e-9)
    return decoded, np.array(received)


def _stamp(message: Any) -> float:
    """Stamp of a message's header [s]; 0 if it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None:
        return 0.0
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


class _MessageTable:
    """Reads a field of messages as a row of one number a joint."""

    def __init__(
        self,
        path: Path,
        joints: tuple[str, ...],
        robot: RobotSpec | None,
        joint_order: str | Sequence[str] | None,
    ) -> None:
        """Read the joints of the first state, in its order; see `ReadOptions.joint_order`."""
        self._path = path
        self._joints = joints
        self._robot = robot
        self._joint_order = joint_order

    def rows(self, messages: Sequence[Any], topic: str, field: str) -> Array:
        """Read a field of messages, shape (messages, joints)."""
        return np.array([self._row(message, topic, field) for message in messages])

    def optional_rows(
        self, states: Sequence[Any], topic: str, field: str, chosen: Mask
    ) -> Array | None:
        """Read velocity or effort of the chosen states; None where a state lacks it."""
        if any(len(getattr(state, field)) == 0 for state in states):
            return None
        table = self.rows(states, topic, field)[chosen]
        # Drivers fill what they do not measure with NaN.
        return None if np.isnan(table).any() else table

    def _row(self, message: Any, topic: str, field: str) -> list[float]:
        numbers = self._numbers(message, topic, field)
        names = getattr(message, "name", None) or getattr(message, "joint_names", None) or ()
        joints = tuple(str(name) for name in names)
        values = f"{self._path}: the {len(numbers)} values of a message on {topic}"
        if len(numbers) == 1 and len(self._joints) == 1 and not joints:
            joints = self._joints
        else:
            joints = ordered_joints(values, len(numbers), self._robot, self._joint_order, joints)
        missing = [joint for joint in self._joints if joint not in joints]
        if missing:
            raise LogError(f"{values} lack {', '.join(missing)}; they are {', '.join(joints)}.")
        return [numbers[joints.index(joint)] for joint in self._joints]

    def _numbers(self, message: Any, topic: str, field: str) -> list[float]:
        """Numbers of a field, whose parts are names or indices with dots between them."""
        value = message
        for part in field.split("."):
            try:
                value = value[int(part)] if part.isdecimal() else getattr(value, part)
            except (AttributeError, IndexError, TypeError):
                slots = getattr(value, "__slots__", ())
                names = [slot for slot in slots if not slot.startswith("_")]
                choices = ""
                if names:
                    choices = f"; there are {', '.join(names)}"
                raise LogError(
                    f"{self._path}: messages on {topic} have no field {field!r} (at "
                    f"{part!r}{choices}); name it with --command-field."
                ) from None
        numbers = []
        try:
            for number in value:
                numbers.append(math.nan if math.isinf(number) else float(number))
        except TypeError:
            raise LogError(
                f"{self._path}: field {field!r} of the messages on {topic} is not a list of "
                "numbers; name another with --command-field."
            ) from None
        return numbers
