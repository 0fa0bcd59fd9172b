"""Joint states and commands in bags of ROS, joined by the names of the joints.

States are JointStates, states of a joint trajectory controller, or Unitree's LowState; commands are
these, Unitree's LowCmd, arrays of numbers, or trajectories of one point. Several publishers of one
topic, each with joints of its own, are merged by name. A joint without a command is left out.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.errors import LogError, printable
from pronk.files import sha256
from pronk.identify.logs.bag import MessageDecoder, bag_files, message_type, read_bag
from pronk.identify.logs.checks import position_follows
from pronk.identify.logs.columns import (
    Columns,
    command_index,
    import_columns,
    ordered_joints,
    robot_names,
)
from pronk.identify.logs.joint_log import START_NS, JointLog, LogOrigin
from pronk.identify.logs.mcap import Record, Wanted
from pronk.identify.logs.options import NeedsOptionsError, ReadOptions
from pronk.identify.logs.recording import RECORDING_PREFIX
from pronk.identify.logs.segmentation import MOVED_RAD
from pronk.identify.logs.unitree import COMMAND_TYPES, PARALLEL_MODE, STATE_TYPES, motor_joints
from pronk.robots.robot import RobotSpec

JOINT_STATE = "sensor_msgs/msg/JointState"
"""Type of the messages that hold joint states in ROS."""
CONTROLLER_STATES = (
    "control_msgs/msg/JointTrajectoryControllerState",
    "pr2_controllers_msgs/msg/JointTrajectoryControllerState",
)
"""Types that hold the reference and the measured state of a joint trajectory controller."""
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
"""Type of trajectories that a controller interpolates."""
NUMBERS = (
    "std_msgs/msg/Float64MultiArray",
    "std_msgs/msg/Float32MultiArray",
    "std_msgs/msg/Float64",
    "std_msgs/msg/Float32",
)
"""Types of numbers without names, which forward command controllers take."""
MEASURED_TYPES = (JOINT_STATE, *STATE_TYPES, *CONTROLLER_STATES)
"""Types of topics that can hold measured states."""
_USUAL_TOPICS = ("/joint_states", "/lowstate", "/lowcmd")
"""Topics that are taken where several of one type are recorded."""
_NO_POSITIONS = ("effort", "torque", "current", "velocity", "twist", "speed")
"""Words in the names of topics whose numbers are no positions."""
_LARGEST_CLOCK_OFFSET_NS = 20_000_000
"""Largest difference between how long after their header stamps the messages of two topics are
received [ns]. Messages on one machine take 1 ms or so, and clocks of two machines differ at
will."""
_LEAST_DISTINCT_STAMPS = 0.2
"""Share of header stamps that differ from one another; several publishers may stamp alike."""
_CONSTANT_SHARE = 0.5
"""Share of the travel of a command that has to lie where the gains do not change."""
_FEED_FORWARD = 1e-3
"""Range of the target speed [rad/s] or the added torque [N m] below which it is constant."""


@dataclass(frozen=True)
class _Sample:
    """What one message says of its joints; None for what it does not have."""

    joints: tuple[str, ...]
    position: Sequence[float]
    velocity: Sequence[float] | None = None
    effort: Sequence[float] | None = None
    gains: Sequence[Sequence[float]] | None = None


@dataclass
class _Series:
    """Messages with the same joints, in order of time."""

    joints: tuple[str, ...]
    """Names of the columns."""
    time: NDArray[np.int64]
    """Times of the messages [ns], shape (n,)."""
    position: Array
    """Positions [unit of angle], shape (n, joints)."""
    velocity: Array | None
    """Velocities, shape (n, joints), if all messages have them."""
    effort: Array | None
    """Torques [N m], shape (n, joints), if all messages have them."""
    gains: Array | None
    """Stiffness, damping, target speed and added torque of a command, shape (n, 4, joints)."""


@dataclass(frozen=True)
class _Topics:
    """Topics of a bag that hold the states and the commands."""

    measured: str
    command: str
    types: Mapping[str, str]
    """Type of the messages by topic."""
    notes: tuple[str, ...]

    @property
    def measured_type(self) -> str:
        """Type of the states."""
        return self.types[self.measured]

    @property
    def command_type(self) -> str:
        """Type of the commands."""
        return self.types[self.command]


def read_rosbag(path: Path, robot: RobotSpec | None, options: ReadOptions) -> JointLog:
    """Read a bag of ROS 1 or ROS 2: a file `.mcap`, `.db3` or `.bag`, or the folder of a rosbag2.

    Raises:
        LogError: The bag cannot be read, or its states and commands cannot be joined.
    """
    records, damage = read_bag(path, wanted_messages(options))
    return join_topics(path, records, damage, robot, options)


def wanted_messages(options: ReadOptions) -> Wanted:
    """Return what says which messages of a bag are read: by their types, and of stated topics."""
    types = frozenset((*MEASURED_TYPES, *COMMAND_TYPES, *NUMBERS, TRAJECTORY))
    topics = (options.measured_topic, options.command_topic)

    def is_wanted(record: Record) -> bool:
        type_name = "" if record.schema is None else message_type(record.schema)
        is_own = record.topic.startswith(("/sweep/", RECORDING_PREFIX))
        return is_own or type_name in types or record.topic in topics

    return is_wanted


def join_topics(
    path: Path,
    records: Sequence[Record],
    damage: str,
    robot: RobotSpec | None,
    options: ReadOptions,
) -> JointLog:
    """Make a log of the states and the commands in a bag.

    Times are the header stamps where both topics have them on one clock, as reception adds the
    jitter of the network and of the recorder; otherwise times of reception, which are of one clock.
    The command in force at a state is the last one at or before it.

    Args:
        path: The bag, for messages and its hash.
        records: Its messages.
        damage: Why reading the bag ended early, or "".
        robot: The robot, if it is known, for the names of its joints.
        options: Topics, field and names of the commands, unit.

    Returns:
        The log, with the gains of the commands where they have any.

    Raises:
        LogError: Topics, fields or names do not fit one another; the message names the option.
    """
    topics = _choose_topics(path, records, options)
    notes = list(topics.notes)
    decoder = MessageDecoder(path)
    state_records = [record for record in records if record.topic == topics.measured]
    command_records = [record for record in records if record.topic == topics.command]
    motor_names = _joints_of_motors(path, topics, decoder, state_records, robot, options)
    # A message is kept as the few numbers that are read of it.
    states = []
    state_stamps = []
    for record in state_records:
        message = decoder.decode(record)
        states.append(_measured_sample(path, topics, message, motor_names, options))
        state_stamps.append(_stamp(message))
    state_joints: list[str] = []
    for joints in dict.fromkeys(state.joints for state in states):
        state_joints += [joint for joint in joints if joint not in state_joints]
    command_reader = _CommandReader(path, topics, tuple(state_joints), robot, options, motor_names)
    commands = []
    command_stamps = []
    for record in command_records:
        message = decoder.decode(record)
        commands.append(command_reader.sample(message))
        command_stamps.append(_stamp(message))
    state_time, command_time, clock = _times(
        np.array([record.log_time for record in state_records], dtype=np.int64),
        np.array(state_stamps, dtype=np.int64),
        np.array([record.log_time for record in command_records], dtype=np.int64),
        np.array(command_stamps, dtype=np.int64),
    )
    notes.append(clock)
    state_series = _series(states, state_time)
    command_series = _series(commands, command_time)
    if not state_series or not command_series:
        raise LogError(f"{path}: no positions on {topics.measured} or on {topics.command}.")
    log = _join(path, state_series, command_series, notes, robot, options)
    columns = log.columns
    if options.command_topic is None and topics.command_type in NUMBERS:
        _check_guess(path, topics.command, columns)
    hashes = [sha256(file) for file in bag_files(path)]
    digest = hashes[0]
    if path.is_dir():
        digest = hashlib.sha256("".join(hashes).encode()).hexdigest()
    if damage:
        notes.append(f"the file is cut short ({damage})")
    origin = LogOrigin(
        source=str(path),
        sha256=digest,
        complete=not damage,
        metadata={
            **columns.origin.metadata,
            "measured_topic": topics.measured,
            "command_topic": topics.command,
        },
    )
    columns = replace(columns, origin=origin, notes=tuple(notes))
    names = {}
    for logged_name, ours in (options.joint_names or {}).items():
        # Names of joints that were left out are no mistake.
        if logged_name in columns.joints or logged_name not in state_joints:
            names[logged_name] = ours
    read = import_columns(
        columns, robot, replace(options, joint_order=None, joint_names=names or None)
    )
    return replace(read, stiffness=log.stiffness, damping=log.damping)


@dataclass(frozen=True)
class _Joined:
    """Columns of a log, and the gains of its commands by column, where they have any."""

    columns: Columns
    stiffness: Array | None
    damping: Array | None


# --- Topics -------------------------------------------------------------------------------------


def _choose_topics(path: Path, records: Sequence[Record], options: ReadOptions) -> _Topics:
    """Topics of the states and the commands: stated ones, or guessed from the types.

    Raises:
        LogError: A stated topic is not there or of no use, or several could be meant; the message
            lists all topics.
    """
    types: dict[str, str] = {}
    for record in records:
        types[record.topic] = (
            message_type(record.schema) if record.schema is not None else record.encoding
        )
    listed = ", ".join(f"{topic} ({types[topic]})" for topic in sorted(types))
    listed = printable(listed[:2000])
    notes = []
    measured = options.measured_topic
    if measured is None:
        measured = _guess_measured(types, options.command_topic)
        if not measured:
            raise NeedsOptionsError(
                path,
                "no topic, or several, that could hold measured states; it holds "
                f"{listed}; name one with --measured-topic (types that are read: "
                f"{', '.join(MEASURED_TYPES)})",
            )
        notes.append(f"states are read from {measured} ({types[measured]})")
    if types.get(measured) not in MEASURED_TYPES:
        raise LogError(
            f"{path}: no measured states on {measured}; it holds {listed}; name another topic with "
            f"--measured-topic (types that are read: {', '.join(MEASURED_TYPES)})."
        )
    command = options.command_topic
    if command is None:
        command = _guess_command(types, measured)
        if not command:
            raise NeedsOptionsError(
                path,
                "--command-topic is missing, as no topic, or several, could hold the "
                f"commands to {measured}; it holds {listed}; name the topic of the commands (and "
                "--command-field where the positions are in a field of another name)",
            )
        notes.append(f"commands are read from {command} ({types[command]})")
    is_both = types[measured] in CONTROLLER_STATES
    if command not in types or (command == measured and not is_both):
        raise LogError(f"{path}: no commands on {command}; it holds {listed}.")
    return _Topics(measured, command, types, tuple(notes))


def _guess_measured(types: Mapping[str, str], command: str | None) -> str:
    """Topic that alone can hold the measured states, or ""."""
    unitree = _only(types, STATE_TYPES)
    if unitree and _only(types, COMMAND_TYPES) and command is None:
        return unitree
    other_types = {topic: type_name for topic, type_name in types.items() if topic != command}
    states = _only(other_types, (JOINT_STATE,)) or _only(
        {
            topic: type_name
            for topic, type_name in other_types.items()
            if topic.endswith("joint_states")
        },
        (JOINT_STATE,),
    )
    return states or unitree or _only(types, CONTROLLER_STATES)


def _guess_command(types: Mapping[str, str], measured: str) -> str:
    """Topic that alone can hold the commands to the measured joints, or ""."""
    measured_type = types[measured]
    if measured_type in CONTROLLER_STATES:
        return measured
    if measured_type in STATE_TYPES:
        return _only(types, COMMAND_TYPES)
    candidates = {}
    for topic, other in types.items():
        is_position = not any(word in topic.lower() for word in _NO_POSITIONS)
        if topic != measured and is_position and other in (JOINT_STATE, *NUMBERS):
            candidates[topic] = other
    if candidates:
        return next(iter(candidates)) if len(candidates) == 1 else ""
    return _only(types, CONTROLLER_STATES) or _only(types, (TRAJECTORY,))


def _only(types: Mapping[str, str], kinds: Sequence[str]) -> str:
    """The topic of some types if there is one alone, or the usual one among them; or ""."""
    topics = [topic for topic, type_name in types.items() if type_name in kinds]
    usual = [topic for topic in topics if topic in _USUAL_TOPICS]
    if len(topics) > 1 and len(usual) == 1:
        return usual[0]
    return topics[0] if len(topics) == 1 else ""


# --- Messages -----------------------------------------------------------------------------------


def _stamp(message: Any) -> int:
    """Stamp of a message's header [ns]; 0 if it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None:
        return 0
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _times(
    received: NDArray[np.int64],
    stamps: NDArray[np.int64],
    command_received: NDArray[np.int64],
    command_stamps: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], str]:
    """Times of states and commands on one clock, and which clock it is in words.

    Args:
        received: When the states were received [ns], shape (states,).
        stamps: Header stamps of the states [ns], 0 where there are none.
        command_received: When the commands were received [ns], shape (commands,).
        command_stamps: Header stamps of the commands [ns], 0 where there are none.
    """
    if not (stamps > 0).all() or not (command_stamps > 0).all():
        reason = "message headers hold no stamps on both topics"
    elif len(np.unique(stamps)) < _LEAST_DISTINCT_STAMPS * len(stamps):
        reason = "the header stamps of the states stand still"
    else:
        latency = float(np.median(received - stamps))
        command_latency = float(np.median(command_received - command_stamps))
        difference_ns = abs(latency - command_latency)
        if difference_ns <= _LARGEST_CLOCK_OFFSET_NS:
            words = "times are the header stamps, which do not hold the jitter of the recorder"
            return stamps, command_stamps, words
        reason = (
            f"the header stamps of the two topics are {1e-9 * difference_ns:.3f} s apart, as of "
            "two clocks"
        )
    words = f"{reason}; times of reception were used, with the jitter of the recorder"
    return received, command_received, words


def _joints_of_motors(
    path: Path,
    topics: _Topics,
    decoder: MessageDecoder,
    records: Sequence[Record],
    robot: RobotSpec | None,
    options: ReadOptions,
) -> tuple[str, ...]:
    """Joints of the motors in Unitree's messages; none for other types."""
    if topics.measured_type not in STATE_TYPES and topics.command_type not in COMMAND_TYPES:
        return ()
    used_motors = 0
    in_parallel = False
    if topics.measured_type in STATE_TYPES:
        for record in records[:: max(1, len(records) // 50)]:
            state = decoder.decode(record)
            in_parallel |= int(getattr(state, "mode_pr", 0)) == PARALLEL_MODE
            for index, motor in enumerate(_motors(state)):
                if float(motor.q) != 0.0:
                    used_motors = max(used_motors, index + 1)
    if in_parallel and options.joint_order is None:
        raise LogError(
            f"{path}: {topics.measured} says mode_pr {PARALLEL_MODE}: ankles and waist are "
            "positions of the motors A and B of their linkages, not of pitch and roll; record with "
            "mode_pr 0, or give --joint-order NAME,NAME,... if you mean the motors."
        )
    try:
        return motor_joints(topics.measured_type, used_motors, robot, options.joint_order)
    except LogError as error:
        raise LogError(f"{path}: {error}") from None


def _motors(message: Any) -> Sequence[Any]:
    """Motors of a state or a command of Unitree's, by the names of ROS 2 or of ROS 1."""
    for name in ("motor_state", "motorState", "motor_cmd", "motorCmd"):
        motors = getattr(message, name, None)
        if motors is not None:
            return list(motors)
    raise LogError("a message of Unitree's without motors.")


def _motor_number(motor: Any, *names: str) -> float:
    """A number of a motor by the first of some names that it has; NaN if it has none."""
    for name in names:
        value = getattr(motor, name, None)
        if value is not None:
            return float(value)
    return math.nan


def _measured_sample(
    path: Path,
    topics: _Topics,
    message: Any,
    motor_names: tuple[str, ...],
    options: ReadOptions,
) -> _Sample:
    """What a state says of its joints."""
    if topics.measured_type in STATE_TYPES:
        motors = _motors(message)[: len(motor_names)]
        return _Sample(
            motor_names[: len(motors)],
            [float(motor.q) for motor in motors],
            [_motor_number(motor, "dq") for motor in motors],
            [_motor_number(motor, "tau_est", "tauEst") for motor in motors],
        )
    state = message
    names = getattr(message, "name", None)
    if topics.measured_type in CONTROLLER_STATES:
        state = _first_field(message, ("feedback", "actual"))
        names = message.joint_names
    positions = _numbers(path, state, topics.measured, _field_of(state), "--measured-topic")
    joints = tuple(str(name) for name in names or ())
    if not joints:
        values = f"{path}: the {len(positions)} values of a message on {topics.measured}"
        joints = ordered_joints(values, len(positions), None, options.joint_order)
    if len(joints) != len(positions):
        raise LogError(
            f"{path}: a message on {topics.measured} has {len(joints)} names and "
            f"{len(positions)} positions."
        )
    velocity = getattr(state, "velocity", getattr(state, "velocities", ()))
    effort = getattr(state, "effort", ())
    has_velocity = len(velocity) == len(joints)
    has_effort = len(effort) == len(joints)
    return _Sample(
        joints,
        positions,
        [float(value) for value in velocity] if has_velocity else None,
        [float(value) for value in effort] if has_effort else None,
    )


def _field_of(state: Any) -> str:
    """Name of the positions in a JointState or a point of a trajectory."""
    return "position" if hasattr(state, "position") else "positions"


def _first_field(message: Any, names: Sequence[str]) -> Any:
    """The first of some fields that a message has and that holds positions."""
    for name in names:
        value = getattr(message, name, None)
        if value is not None and len(getattr(value, "positions", ())):
            return value
    raise LogError(f"a message of a controller's state has no positions in {' or '.join(names)}.")


class _CommandReader:
    """Reads the commands of one topic, each a number a joint."""

    def __init__(
        self,
        path: Path,
        topics: _Topics,
        state_joints: tuple[str, ...],
        robot: RobotSpec | None,
        options: ReadOptions,
        motor_names: tuple[str, ...],
    ) -> None:
        """Remember the bag, its topics, the joints of its states, and how names are given."""
        self._path = path
        self._topic = topics.command
        self._type = topics.command_type
        self._state_joints = state_joints
        self._robot = robot
        self._order = options.joint_order
        self._field = options.command_field
        self._motor_names = motor_names

    def sample(self, message: Any) -> _Sample:
        """Read one command; a LogError names the option that is missing."""
        if self._type in COMMAND_TYPES:
            return self._of_motors(message)
        named = message
        field = self._field
        if field is None and self._type in CONTROLLER_STATES:
            value = _first_field(message, ("reference", "desired"))
            numbers = _numbers(self._path, value, self._topic, "positions", "--command-field")
        else:
            if field is None and self._type == TRAJECTORY:
                if len(message.points) > 1:
                    raise LogError(
                        f"{self._path}: a trajectory of {len(message.points)} points on "
                        f"{self._topic}, between which the controller interpolates; record the "
                        "state of the controller, and name it with --command-topic."
                    )
                field = "points.0.positions"
            elif field is None and self._type in NUMBERS:
                field = "data"
            numbers = _numbers(
                self._path, message, self._topic, field or "position", "--command-field"
            )
        names = getattr(named, "name", None) or getattr(named, "joint_names", None) or ()
        joints = tuple(str(name) for name in names)
        if joints:
            if len(joints) != len(numbers):
                raise LogError(
                    f"{self._path}: a message on {self._topic} has {len(joints)} names and the "
                    f"{len(numbers)} values of {field or 'position'}; name another field with "
                    "--command-field."
                )
            return _Sample(joints, numbers)
        if len(numbers) == 1 and len(self._state_joints) == 1 and self._order is None:
            return _Sample(self._state_joints, numbers)
        values = f"{self._path}: the {len(numbers)} values of a message on {self._topic}"
        joints = ordered_joints(values, len(numbers), self._robot, self._order)
        missing = [joint for joint in joints if joint not in self._in_states()]
        if missing:
            raise LogError(
                f"{values} are for {', '.join(joints)} by --joint-order, and the states lack "
                f"{', '.join(missing)}; they are of {', '.join(self._state_joints)}."
            )
        by_robot_name = self._in_states()
        return _Sample(tuple(by_robot_name[joint] for joint in joints), numbers)

    def _in_states(self) -> dict[str, str]:
        """Names in the states by these and, where a robot is known, by its own names."""
        names = {joint: joint for joint in self._state_joints}
        for logged_name, ours in robot_names(self._state_joints, self._robot).items():
            names.setdefault(ours, logged_name)
        return names

    def _of_motors(self, message: Any) -> _Sample:
        """Read a command of Unitree's, with its gains, target speeds and added torques."""
        motors = _motors(message)[: len(self._motor_names)]
        gains = []
        for names in (("kp", "Kp"), ("kd", "Kd"), ("dq",), ("tau",)):
            gains.append([_motor_number(motor, *names) for motor in motors])
        positions = [float(motor.q) for motor in motors]
        return _Sample(self._motor_names[: len(motors)], positions, gains=gains)


def _numbers(path: Path, message: Any, topic: str, field: str, option: str) -> list[float]:
    """Numbers of a field, whose parts are names or indices with dots between them."""
    value = message
    for part in field.split("."):
        try:
            value = value[int(part)] if part.isdecimal() else getattr(value, part)
        except (AttributeError, IndexError, TypeError):
            choices = ""
            if dataclasses.is_dataclass(value):
                names = [entry.name for entry in dataclasses.fields(value)]
                choices = f"; there are {', '.join(names)}"
            raise LogError(
                f"{path}: messages on {topic} have no field {field!r} (at {part!r}{choices}); name "
                f"it with {option}."
            ) from None
    if isinstance(value, int | float):
        return [float(value)]
    try:
        return [float(number) for number in value]
    except (TypeError, ValueError):
        raise LogError(
            f"{path}: field {field!r} of the messages on {topic} is not a list of numbers; name "
            f"another with {option}."
        ) from None


# --- Series -------------------------------------------------------------------------------------


def _series(samples: Sequence[_Sample], times: NDArray[np.int64]) -> list[_Series]:
    """Messages by the joints that they name, each kind in order of time."""
    by_joints: dict[frozenset[str], list[int]] = {}
    for index, sample in enumerate(samples):
        if sample.joints:
            by_joints.setdefault(frozenset(sample.joints), []).append(index)
    series = []
    for indices in by_joints.values():
        indices.sort(key=lambda index: int(times[index]))
        joints = samples[indices[0]].joints
        if len(set(joints)) != len(joints):
            raise LogError(f"a message names a joint twice: {', '.join(joints)}.")
        rows = []
        velocities: list[list[float]] | None = []
        efforts: list[list[float]] | None = []
        gains = []
        for index in indices:
            sample = samples[index]
            order = [sample.joints.index(joint) for joint in joints]
            rows.append([sample.position[k] for k in order])
            velocities = _appended(velocities, sample.velocity, order)
            efforts = _appended(efforts, sample.effort, order)
            if sample.gains is not None:
                gains.append(sample.gains)
        series.append(
            _Series(
                joints=joints,
                time=times[indices],
                position=np.array(rows, dtype=np.float64),
                velocity=_measured(velocities),
                effort=_measured(efforts),
                gains=np.array(gains, dtype=np.float64) if gains else None,
            )
        )
    return series


def _appended(
    rows: list[list[float]] | None, values: Sequence[float] | None, order: Sequence[int]
) -> list[list[float]] | None:
    """Rows with one more; None once a message lacks the quantity."""
    if rows is None or values is None:
        return None
    rows.append([values[k] for k in order])
    return rows


def _measured(rows: list[list[float]] | None) -> Array | None:
    """Rows as an array; None where the quantity is missing or drivers fill it with NaN."""
    if rows is None:
        return None
    table = np.array(rows, dtype=np.float64)
    return table if np.isfinite(table).all() else None


@dataclass
class _JointCommand:
    """Commands to one joint in order of time."""

    time: NDArray[np.int64]
    """Times of the commands [ns], shape (n,)."""
    position: Array
    """Commanded positions, shape (n,)."""
    gains: Array | None
    """Stiffness, damping, target speed and added torque, shape (n, 4), if they are commanded."""


def _joint_commands(series: Sequence[_Series]) -> dict[str, _JointCommand]:
    """Commands by joint; NaN and infinity command nothing."""
    commands: dict[str, _JointCommand] = {}
    for part in series:
        for column, joint in enumerate(part.joints):
            finite = np.isfinite(part.position[:, column])
            gains = None if part.gains is None else part.gains[finite, :, column]
            command = _JointCommand(part.time[finite], part.position[finite, column], gains)
            earlier = commands.get(joint)
            if earlier is not None:
                time = np.concatenate([earlier.time, command.time])
                order = np.argsort(time, kind="stable")
                position = np.concatenate([earlier.position, command.position])
                both_gains = None
                if earlier.gains is not None and command.gains is not None:
                    both_gains = np.concatenate([earlier.gains, command.gains])[order]
                command = _JointCommand(time[order], position[order], both_gains)
            commands[joint] = command
    return {joint: command for joint, command in commands.items() if len(command.time)}


def _join(
    path: Path,
    state_series: Sequence[_Series],
    command_series: Sequence[_Series],
    notes: list[str],
    robot: RobotSpec | None,
    options: ReadOptions,
) -> _Joined:
    """Join states and commands by the names of the joints; remarks are added to the notes."""
    commands = _joint_commands(command_series)
    without_stiffness = []
    for joint, joint_command in list(commands.items()):
        gains_of_joint = joint_command.gains
        if gains_of_joint is not None and not (gains_of_joint[:, 0] > 0.0).any():
            without_stiffness.append(joint)
            del commands[joint]
    moving = []
    for joint, joint_command in commands.items():
        active = joint_command.position
        if joint_command.gains is not None:
            active = active[joint_command.gains[:, 0] > 0.0]
        if np.ptp(active) > MOVED_RAD:
            moving.append(joint)
    base = _base_series(path, state_series, moving)
    names_in_robot = robot_names(list(commands), robot)
    joints = []
    no_command = []
    for series in (base, *(part for part in state_series if part is not base)):
        for joint in series.joints:
            if joint in joints or joint in no_command or joint in without_stiffness:
                continue
            if joint in commands:
                joints.append(joint)
            else:
                no_command.append(joint)
    no_state = [joint for joint in commands if joint not in joints]
    moving_without_state = [joint for joint in no_state if joint in moving]
    if moving_without_state or not joints:
        names = ", ".join(moving_without_state or no_state)
        stated = ", ".join(joint for series in state_series for joint in series.joints)
        raise LogError(
            f"{path}: commands for {names or 'no joint'} and no state of that name; the states are "
            f"of {stated}; the names have to be the same (record both with one set of names)."
        )
    if robot is not None:
        renamed = {**names_in_robot, **(options.joint_names or {})}
        foreign = []
        for joint in joints:
            is_foreign = renamed.get(joint, joint) not in robot.joint_names
            if is_foreign and joint not in moving:
                foreign.append(joint)
        joints = [joint for joint in joints if joint not in foreign]
        if foreign:
            notes.append(f"{', '.join(foreign)} are no joints of {robot.name} and left out")
    if no_command:
        notes.append(f"{', '.join(no_command)} have no command and are left out")
    if without_stiffness:
        notes.append(f"{', '.join(without_stiffness)} had no stiffness and are left out")
    if no_state:
        notes.append(f"commands for {', '.join(no_state)} have no state and are left out")
    if not joints:
        raise LogError(f"{path}: no joint of {robot.name if robot else 'the bag'} has a command.")

    # Joints of other publishers are at rest; their positions are taken at the times of the base.
    time = base.time
    position = np.empty((len(time), len(joints)))
    velocity = None if base.velocity is None else np.empty_like(position)
    effort = None if base.effort is None else np.empty_like(position)
    merged = []
    for column, joint in enumerate(joints):
        if joint in base.joints:
            source = base.joints.index(joint)
            position[:, column] = base.position[:, source]
            if velocity is not None and base.velocity is not None:
                velocity[:, column] = base.velocity[:, source]
            if effort is not None and base.effort is not None:
                effort[:, column] = base.effort[:, source]
            continue
        merged.append(joint)
        velocity = None
        effort = None
        for series in state_series:
            if joint in series.joints:
                values = series.position[:, series.joints.index(joint)]
                relative = (time - series.time[0]).astype(np.float64)
                grid = (series.time - series.time[0]).astype(np.float64)
                position[:, column] = np.interp(relative, grid, values)
    if merged:
        notes.append(
            f"states of {', '.join(merged)} come in messages of their own and are interpolated to "
            "the times of the others"
        )
    indices = np.empty((len(time), len(joints)), dtype=np.intp)
    for column, joint in enumerate(joints):
        indices[:, column] = command_index(commands[joint].time, time)
    chosen = (indices >= 0).all(axis=1)
    if int(chosen.sum()) < 2:
        raise LogError(
            f"{path}: {int(chosen.sum())} states follow a command to every joint "
            f"({', '.join(joints)}); at least 2 are needed."
        )
    if not chosen.all():
        notes.append(f"{(~chosen).sum()} states before the first command were dropped")
    command = np.empty((int(chosen.sum()), len(joints)))
    gains = np.full((4, *command.shape), np.nan)
    for column, joint in enumerate(joints):
        index = indices[chosen, column]
        command[:, column] = commands[joint].position[index]
        joint_gains = commands[joint].gains
        if joint_gains is not None:
            gains[:, :, column] = joint_gains[index].T
    rows = np.arange(len(command))
    stiffness = None
    damping = None
    if np.isfinite(gains[:2]).all():
        rows = _constant_gains(path, joints, command, gains, notes)
        stiffness = gains[0, rows[0]]
        damping = gains[1, rows[0]]
    kept = np.flatnonzero(chosen)[rows]
    columns = Columns(
        origin=LogOrigin(source=str(path), metadata={START_NS: str(int(time[kept[0]]))}),
        joints=tuple(joints),
        # Before the unit is changed: nanoseconds since 1970 do not fit into one number.
        time=(time[kept] - time[kept[0]]) * 1e-9,
        command=command[rows],
        position=position[kept],
        velocity=None if velocity is None else velocity[kept],
        torque=None if effort is None else effort[kept],
        unit="rad",
    )
    return _Joined(columns, stiffness, damping)


def _check_guess(path: Path, topic: str, columns: Columns) -> None:
    """Refuse numbers without a type that do not move as positions do, with a LogError.

    The topic of a forward command controller holds positions, velocities or torques alike.
    """
    assert columns.command is not None
    for column, joint in enumerate(columns.joints):
        command = columns.command[:, column]
        position = columns.position[:, column]
        if np.ptp(command) > MOVED_RAD and not position_follows(columns.time, command, position):
            raise LogError(
                f"{path}: the numbers on {topic} were taken for positions and may be torques or "
                f"velocities: for {joint} they travel {np.ptp(command):.3g} about "
                f"{np.median(command):.3g} and its position {np.ptp(position):.3g} about "
                f"{np.median(position):.3g}; if they are positions, say so with --command-topic "
                f"{topic}."
            )


def _base_series(path: Path, series: Sequence[_Series], moving: Sequence[str]) -> _Series:
    """States whose times the log has: those of the joints that are excited.

    Raises:
        LogError: Joints of several publishers are excited, whose states are at different times.
    """
    bases: list[_Series] = []
    for joint in moving:
        with_joint = [part for part in series if joint in part.joints]
        if with_joint and not any(joint in part.joints for part in bases):
            bases.append(max(with_joint, key=lambda part: len(part.time)))
    if not bases:
        return max(series, key=lambda part: len(part.time))
    if len(bases) > 1:
        groups = "; ".join(", ".join(part.joints) for part in bases)
        raise LogError(
            f"{path}: joints of {len(bases)} publishers are excited, whose states come at "
            f"different times ({groups}); record them one after another, a bag each."
        )
    return bases[0]


def _constant_gains(
    path: Path,
    joints: Sequence[str],
    command: Array,
    gains: Array,
    notes: list[str],
) -> NDArray[np.intp]:
    """Rows of the longest stretch in which no gain changes.

    Args:
        path: The bag, for messages.
        joints: Names of the columns.
        command: Commanded positions, shape (n, joints).
        gains: Stiffness, damping, target speed and added torque, shape (4, n, joints).
        notes: Gets a remark on what is left out.

    Raises:
        LogError: Gains change while a joint is excited, or its target speed or its added torque
            does, which a position command does not say.
    """
    changes = (np.diff(gains[:2], axis=1) != 0.0).any(axis=(0, 2))
    edges = np.concatenate(([0], np.flatnonzero(changes) + 1, [len(command)]))
    longest = int(np.argmax(np.diff(edges)))
    rows = np.arange(edges[longest], edges[longest + 1])
    if len(rows) < 2:
        raise LogError(f"{path}: the gains change with every command; record with constant gains.")
    for column, joint in enumerate(joints):
        active = command[gains[0, :, column] > 0.0, column]
        travel = float(np.ptp(active))
        if travel <= MOVED_RAD:
            continue
        if np.ptp(command[rows, column]) < _CONSTANT_SHARE * travel:
            raise LogError(
                f"{path}: the gains in the commands change while {joint} moves (stiffness "
                f"{gains[0, :, column].min():g} to {gains[0, :, column].max():g} N m/rad, damping "
                f"{gains[1, :, column].min():g} to {gains[1, :, column].max():g} N m s/rad); "
                "record with constant gains, or cut the bag."
            )
        for row, addition in ((2, "target speed"), (3, "added torque")):
            values = gains[row, rows, column]
            if np.isfinite(values).all() and np.ptp(values) > _FEED_FORWARD:
                raise LogError(
                    f"{path}: the {addition} in the commands to {joint} changes, so that its drive "
                    f"follows more than the position; record with a constant {addition}."
                )
    if len(rows) < len(command):
        notes.append(
            f"{len(command) - len(rows)} states at other gains than those of the longest stretch "
            "were dropped"
        )
    return rows
