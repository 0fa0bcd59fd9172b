"""What goes from process to process, as records of shared memory.

Times are CLOCK_MONOTONIC in seconds, the same for all processes of a machine.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np

from pronk.links.machine import State
from pronk.policy.layout import JOINTS, MEASURED_SIZE


class Mode(IntEnum):
    """What the servo is doing."""

    IDLE = 0
    """Connected or not; nothing is sent."""
    PREFLIGHT = 1
    """Looking at the states; nothing is sent."""
    DAMP = 2
    """Joints damped, waiting."""
    STAND = 3
    """On the way up, and standing there."""
    POLICY = 4
    """The policy decides."""
    HALT = 5
    """The policy decides, told to stand still, before it sits down."""
    SIT = 6
    """On the way down."""
    FAULT = 7
    """Joints damped by a fault."""
    ENDED = 8
    """The link is closed."""


class Wish(IntEnum):
    """What the operator asks for."""

    NONE = 0
    DAMP = 1
    """At once."""
    STAND = 2
    WALK = 3
    """Let the policy decide."""
    SIT = 4
    """Stop, sit down, damp."""
    RESET = 5
    """The cause of a latched fault is gone."""
    QUIT = 6
    """Damp and leave."""


_STATE: list[Any] = [
    ("sequence", "<i8"),
    ("time", "<f8"),
    ("position", "<f8", JOINTS),
    ("velocity", "<f8", JOINTS),
    ("torque", "<f8", JOINTS),
    ("gyro", "<f8", 3),
    ("accelerometer", "<f8", 3),
    ("orientation", "<f8", 4),
    ("bus_voltage", "<f8"),
    ("robot_time", "<f8"),
    ("temperature", "<f8", JOINTS),
]

NEWS = np.dtype([*_STATE, ("now", "<f8"), ("start", "<f8"), ("mode", "<i8"), ("entry", "<i8")])
"""Servo to all, every tick: the newest state, the time of tick 0, the mode and how often it has
changed."""

ORDERS = np.dtype(
    [
        ("sequence", "<i8"),
        ("state_sequence", "<i8"),
        ("state_time", "<f8"),
        ("made", "<f8"),
        ("valid_for", "<f8"),
        ("entry", "<i8"),
        ("position", "<f8", JOINTS),
    ]
)
"""Policy to servo: joint targets; `entry` is that of the news they answer."""

STICK = np.dtype(
    [
        ("time", "<f8"),
        ("wish", "<i8"),
        ("wishes", "<i8"),
        ("held", "<i8"),
        ("command", "<f8", 3),
        ("jump", "<i8"),
        ("seconds", "<f8"),
    ]
)
"""Operator to servo and policy: the last wish and how many there were, whether the dead-man button
is held, velocity command and jump input."""

TICK = np.dtype(
    [
        *_STATE,
        ("tick", "<i8"),
        ("deadline", "<f8"),
        ("begun", "<f8"),
        ("done", "<f8"),
        ("mode", "<i8"),
        ("blend", "<f8"),
        ("asked", "<f8", JOINTS),
        ("sent", "<f8", JOINTS),
        ("stiffness", "<f8"),
        ("damped", "<i8"),
        ("level", "<i8"),
        ("reason", "<i8"),
        ("order", "<i8"),
        ("order_state", "<i8"),
        ("latency", "<f8"),
    ]
)
"""Servo to logger, every tick: what it saw, was asked and did. `blend` is the policy's share,
`stiffness` the share of the drives' own, `order` the number of the policy's order in force (-1:
none), `latency` from the state that a new order answers to its command on the wire (NaN: no new
order)."""

STEP = np.dtype(
    [
        ("sequence", "<i8"),
        ("deadline", "<f8"),
        ("begun", "<f8"),
        ("observed", "<f8"),
        ("inferred", "<f8"),
        ("done", "<f8"),
        ("state_sequence", "<i8"),
        ("state_time", "<f8"),
        ("live", "<i8"),
        ("command", "<f8", 3),
        ("jump", "<i8"),
        ("observation", "<f4", MEASURED_SIZE),
        ("action", "<f4", JOINTS),
        ("target", "<f8", JOINTS),
        ("contact", "<f4", 4),
        ("linear_velocity", "<f4", 3),
    ]
)
"""Policy to logger, every step."""

VIRTUAL, REAL = "the virtual robot", "a real robot"
"""Text of the event `robot`."""
TEXT = 240
EVENT = np.dtype(
    [("time", "<f8"), ("kind", "S16"), ("reason", "<i8"), ("level", "<i8"), ("text", f"S{TEXT}")]
)
"""Servo or policy to logger and operator: something happened."""


def event(
    time: float, kind: str, text: str, *, reason: int = 0, level: int = 0
) -> np.ndarray[Any, Any]:
    """An event's record; the text is cut to what fits."""
    record = np.zeros((), dtype=EVENT)
    record["time"], record["kind"], record["reason"], record["level"] = time, kind, reason, level
    record["text"] = text.encode("ascii", "replace")[:TEXT]
    return record


def put_state(record: np.ndarray[Any, Any], state: State, offset: float) -> None:
    """Write a state into a record that begins with one.

    Args:
        record: Of `NEWS` or `TICK`.
        state: On the machine's clock.
        offset: CLOCK_MONOTONIC less the machine's clock [s].
    """
    for name in (
        "sequence",
        "position",
        "velocity",
        "torque",
        "gyro",
        "accelerometer",
        "orientation",
        "bus_voltage",
    ):
        record[name] = getattr(state, name)
    record["time"] = state.time + offset
    record["robot_time"] = np.nan if state.robot_time is None else state.robot_time
    record["temperature"] = np.nan if state.temperature is None else state.temperature


def get_state(record: np.void) -> State:
    """The state in a record, on CLOCK_MONOTONIC."""
    known = not np.isnan(record["temperature"]).all()
    robot_time = float(record["robot_time"])
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
        robot_time=None if np.isnan(robot_time) else robot_time,
        temperature=record["temperature"] if known else None,
    )
