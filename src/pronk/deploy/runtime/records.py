"""Records that the processes of a run exchange: one NumPy structured type for each.

Times are CLOCK_MONOTONIC in seconds, the same for all processes of a computer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pronk.deploy.links.remote import REMOTE_BYTES
from pronk.deploy.runtime.reasons import FilterAction, Reason
from pronk.policy.observation import JOINTS, MEASURED_SIZE
from pronk.robots.machine import State

Record = np.ndarray[Any, Any] | np.void
"""One record of a structured type."""

_INT = "<i8"
_FLOAT = "<f8"
_FLOAT32 = "<f4"
TEXT_SIZE = 240
"""Longest text of a record."""
_TEXT = f"S{TEXT_SIZE}"


def _state_fields(joints: int) -> list[Any]:
    """Fields of a `State`; NaN where nothing was measured."""
    return [
        ("sequence", _INT),
        ("time", _FLOAT),
        ("bus_voltage", _FLOAT),
        ("robot_time", _FLOAT),
        ("position", _FLOAT, (joints,)),
        ("velocity", _FLOAT, (joints,)),
        ("torque", _FLOAT, (joints,)),
        ("temperature", _FLOAT, (joints,)),
        ("gyro", _FLOAT, (3,)),
        ("accelerometer", _FLOAT, (3,)),
        ("orientation", _FLOAT, (4,)),
    ]


def state_dtype(joints: int) -> np.dtype[Any]:
    """Return the record of the servo to all, written at every tick.

    The newest state; `now`, the time of this tick, and `start`, that of tick 0; `progress`, the
    share of a sweep that is done; the mode, and `mode_count`, the number of mode changes so far;
    `remote`, the bytes of the robot's wireless remote, zero where the link carries none.
    """
    return np.dtype(
        [
            *_state_fields(joints),
            ("now", _FLOAT),
            ("start", _FLOAT),
            ("progress", _FLOAT),
            ("mode", _INT),
            ("mode_count", _INT),
            ("remote", "u1", (REMOTE_BYTES,)),
        ]
    )


ACTIONS = np.dtype(
    [
        ("sequence", _INT),
        ("state_sequence", _INT),
        ("mode_count", _INT),
        ("state_time", _FLOAT),
        ("made", _FLOAT),
        ("valid_for", _FLOAT),
        ("position", _FLOAT, (JOINTS,)),
    ]
)
"""Record of the policy to the servo: joint targets, and the `mode_count` for which the policy's
history was last reset, which is that of the state record except in the first step of HALT."""

STANDBY = np.dtype([("time", _FLOAT)])
"""Record of the standby process to servo and operator: when it began to damp [s]."""

OPERATOR = np.dtype(
    [
        ("time", _FLOAT),
        ("held", _INT),
        ("jump", _INT),
        ("command", _FLOAT, (3,)),
    ]
)
"""Record of the operator to servo and policy: dead-man button, jump input and velocity command."""

REQUEST = np.dtype([("request", _INT)])
"""Record of the operator to the servo: a request, a number of `OperatorRequest`."""

TICK = np.dtype(
    [
        *_state_fields(JOINTS),
        ("tick", _INT),
        ("mode", _INT),
        ("damped", _INT),
        ("level", _INT),
        ("reason", _INT),
        ("action", _INT),
        ("action_state", _INT),
        ("deadline", _FLOAT),
        ("begun", _FLOAT),
        ("done", _FLOAT),
        ("blend", _FLOAT),
        ("stiffness", _FLOAT),
        ("latency", _FLOAT),
        ("desired", _FLOAT, (JOINTS,)),
        ("sent", _FLOAT, (JOINTS,)),
    ]
)
"""Record of the servo to the logger, written at every tick of a policy's run: the state, the
targets before (`desired`) and after (`sent`) the safety filter. `blend` is the policy's share of
the target, `stiffness` the share of the drives' stiffness, `action` the number of the policy's
action in force (-1: none) and `action_state` that of its state, `latency` the time from the state
of a new action to its command on the wire (NaN: no new action)."""

STEP = np.dtype(
    [
        ("sequence", _INT),
        ("state_sequence", _INT),
        ("live", _INT),
        ("jump", _INT),
        ("deadline", _FLOAT),
        ("begun", _FLOAT),
        ("observed", _FLOAT),
        ("inferred", _FLOAT),
        ("done", _FLOAT),
        ("state_time", _FLOAT),
        ("command", _FLOAT, (3,)),
        ("target", _FLOAT, (JOINTS,)),
        ("observation", _FLOAT32, (MEASURED_SIZE,)),
        ("action", _FLOAT32, (JOINTS,)),
        ("contact", _FLOAT32, (4,)),
        ("linear_velocity", _FLOAT32, (3,)),
    ]
)
"""Record of the policy to the logger, written at every step."""


class SampleKind(IntEnum):
    """What a record of a sweep holds."""

    SAMPLE = 0
    """A measured state with the command in force."""
    OPEN = 1
    """A log begins; `number` is its index in the task, `text` the kind of torque."""
    SEGMENT = 2
    """An excitation begins; `number` is its index in the log."""
    END = 3
    """The log ends; `text` is the reason, empty if it is complete."""


def sample_dtype(joints: int) -> np.dtype[Any]:
    """Return the record of the servo to the logger during a sweep, in the order of its log.

    `kind` is a `SampleKind`; `number` of a sample is the index of its excitation, -1 between
    excitations.
    """
    return np.dtype(
        [
            ("kind", _INT),
            ("number", _INT),
            ("virtual", _INT),
            ("time", _FLOAT),
            ("frequency", _FLOAT),
            ("command", _FLOAT, (joints,)),
            ("position", _FLOAT, (joints,)),
            ("velocity", _FLOAT, (joints,)),
            ("torque", _FLOAT, (joints,)),
            ("text", _TEXT),
        ]
    )


EVENT = np.dtype(
    [
        ("time", _FLOAT),
        ("reason", _INT),
        ("level", _INT),
        ("kind", "S16"),
        ("text", _TEXT),
    ]
)
"""Record of servo or policy to logger and operator: something happened; `kind` as in `Event`."""
VIRTUAL = "the virtual robot"
"""Text of the event `robot` of a virtual robot."""
REAL = "a real robot"
"""Text of the event `robot` of a real robot."""


def event_record(
    time: float, event_kind: str, text: str, *, reason: int = 0, level: int = 0
) -> np.ndarray[Any, Any]:
    """Make a record of `EVENT`; the text is cut to `TEXT_SIZE` characters."""
    record = np.zeros((), dtype=EVENT)
    record["time"] = time
    record["kind"] = event_kind
    record["reason"] = reason
    record["level"] = level
    record["text"] = text.encode("ascii", "replace")[:TEXT_SIZE]
    return record


def put_state(record: NDArray[Any], state: State) -> None:
    """Write a state on CLOCK_MONOTONIC into a record that has its fields; NaN for None."""
    record["sequence"] = state.sequence
    record["time"] = state.time
    record["bus_voltage"] = state.bus_voltage
    record["robot_time"] = np.nan if state.robot_time is None else state.robot_time
    record["position"] = state.position
    record["velocity"] = state.velocity
    record["torque"] = state.torque
    record["temperature"] = np.nan if state.temperature is None else state.temperature
    record["gyro"] = state.gyro
    record["accelerometer"] = state.accelerometer
    record["orientation"] = state.orientation


def get_state(record: np.void) -> State:
    """Read the state in a record."""
    robot_time: float | None = float(record["robot_time"])
    if robot_time is not None and math.isnan(robot_time):
        robot_time = None
    temperature = record["temperature"]
    if np.isnan(temperature).all():
        temperature = None
    return State(
        time=float(record["time"]),
        sequence=int(record["sequence"]),
        position=record["position"],
        velocity=record["velocity"],
        torque=record["torque"],
        gyro=record["gyro"],
        accelerometer=record["accelerometer"],
        bus_voltage=float(record["bus_voltage"]),
        orientation=record["orientation"],
        robot_time=robot_time,
        temperature=temperature,
    )


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that happened, as the operator's program and the log's reader have it."""

    time: float
    """Time of CLOCK_MONOTONIC [s]."""
    kind: str
    """`mode`, `fault`, `refused`, `notice`, `lost`, `system`, `robot`, `policy`, `clamp` or
    `log`."""
    text: str
    """One line for people; the name of the mode for `mode`."""
    reason: str = Reason.NONE.name
    """Name of a `Reason`."""
    level: str = FilterAction.PASS.name
    """Name of a `FilterAction`."""

    @classmethod
    def of(cls, record: np.void) -> Self:
        """Read a record of `EVENT`."""
        return cls(
            time=float(record["time"]),
            kind=bytes(record["kind"]).decode("ascii"),
            text=bytes(record["text"]).decode("ascii"),
            reason=Reason(int(record["reason"])).name,
            level=FilterAction(int(record["level"])).name,
        )
