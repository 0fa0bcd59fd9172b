"""A log of a policy's run as arrays."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from pronk.arrays import Array, Mask
from pronk.deploy.runtime.log import (
    END_TOPIC,
    EVENT_TOPIC,
    HEADER_TOPIC,
    SCHEMA,
    STEP_TOPIC,
    TICK_TOPIC,
)
from pronk.deploy.runtime.records import STEP, TICK, VIRTUAL, Event
from pronk.errors import LogError
from pronk.files import sha256
from pronk.identify.logs.mcap import DamagedError, Record, records
from pronk.policy.observation import JOINTS

MAX_BYTES = 16 * 2**30
"""Largest size that a log may unpack to, four hours [bytes]. It is parsed chunk by chunk and only
its numbers are kept."""
_FOREIGN_ERRORS = (KeyError, TypeError, ValueError, AttributeError, OverflowError)
"""Errors that are raised when messages of another kind are read."""

IntArray = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class StateLog:
    """Newest state at each of T ticks; NaN where nothing was measured, joints in file order."""

    time: Array
    """Times of CLOCK_MONOTONIC [s], (T,)."""
    sequence: IntArray
    """Numbers of the states, (T,)."""
    robot_time: Array
    """Times of the robot's own clock [s], (T,)."""
    bus_voltage: Array
    """Voltages of the battery [V], (T,)."""
    position: Array
    """Joint positions [rad], (T, joints)."""
    velocity: Array
    """Joint velocities [rad/s], (T, joints)."""
    torque: Array
    """Joint torques as the robot reports them [N m], (T, joints)."""
    temperature: Array
    """Temperatures of the motors [deg C], (T, joints)."""
    gyro: Array
    """Angular velocities of the trunk in its own frame [rad/s], (T, 3)."""
    accelerometer: Array
    """Specific forces of the trunk in its own frame [m/s^2], (T, 3)."""
    orientation: Array
    """Attitudes of the trunk, quaternions w, x, y, z, (T, 4)."""


@dataclass(frozen=True, kw_only=True)
class ActionLog:
    """Action of the policy in force at each of T ticks."""

    number: IntArray
    """Numbers of the actions, -1 for none, (T,)."""
    state_sequence: IntArray
    """Numbers of the states that they were computed from, -1 for none, (T,)."""


@dataclass(frozen=True, kw_only=True)
class TickLog:
    """T ticks of the servo. Times are on CLOCK_MONOTONIC."""

    state: StateLog
    """Newest state at each tick."""
    tick: IntArray
    """Numbers of the ticks, (T,)."""
    mode: IntArray
    """`Mode` after each tick, (T,)."""
    damped: Mask
    """Whether damping was sent, (T,)."""
    level: IntArray
    """`FilterAction`, (T,)."""
    reason: IntArray
    """`Reason`, (T,)."""
    action: ActionLog
    """Action of the policy that was in force."""
    deadline: Array
    """Times at which the ticks were due [s], (T,)."""
    begun: Array
    """Times at which the ticks began [s], (T,)."""
    done: Array
    """Times at which their commands were on the wire [s], (T,)."""
    blend: Array
    """Share of the policy in the targets, (T,)."""
    stiffness: Array
    """Share of the drives' stiffness, (T,)."""
    latency: Array
    """Times from the state of a new action to its command on the wire [s]; NaN without a new
    action, (T,)."""
    desired: Array
    """Targets before the safety filter [rad]; NaN where damped, (T, joints)."""
    sent: Array
    """Targets after the safety filter [rad]; NaN where damped, (T, joints)."""

    @property
    def lateness(self) -> Array:
        """Times from the deadline of each tick to its begin [s], (T,)."""
        return np.asarray(self.begun - self.deadline)

    @property
    def work(self) -> Array:
        """Times from the begin of each tick until its command was on the wire [s], (T,)."""
        return np.asarray(self.done - self.begun)

    @property
    def state_age(self) -> Array:
        """Ages of the newest state at the begin of each tick [s], (T,)."""
        return np.asarray(self.begun - self.state.time)

    @classmethod
    def of(cls, table: NDArray[Any]) -> TickLog:
        """Take the columns of a table of `TICK`."""
        state = StateLog(
            time=table["time"],
            sequence=table["sequence"],
            robot_time=table["robot_time"],
            bus_voltage=table["bus_voltage"],
            position=table["position"],
            velocity=table["velocity"],
            torque=table["torque"],
            temperature=table["temperature"],
            gyro=table["gyro"],
            accelerometer=table["accelerometer"],
            orientation=table["orientation"],
        )
        return cls(
            state=state,
            tick=table["tick"],
            mode=table["mode"],
            damped=table["damped"].astype(bool),
            level=table["level"],
            reason=table["reason"],
            action=ActionLog(number=table["action"], state_sequence=table["action_state"]),
            deadline=table["deadline"],
            begun=table["begun"],
            done=table["done"],
            blend=table["blend"],
            stiffness=table["stiffness"],
            latency=table["latency"],
            desired=table["desired"],
            sent=table["sent"],
        )


@dataclass(frozen=True, kw_only=True)
class NetworkLog:
    """Input and outputs of the network in each of P steps."""

    observation: NDArray[np.float32]
    """Observations, (P, observations)."""
    action: NDArray[np.float32]
    """Actions, (P, joints)."""
    contact: NDArray[np.float32]
    """Estimated probabilities of contact, (P, 4)."""
    linear_velocity: NDArray[np.float32]
    """Estimated velocities of the trunk [m/s], (P, 3)."""


@dataclass(frozen=True, kw_only=True)
class StepLog:
    """P steps of the policy. Times are on CLOCK_MONOTONIC."""

    sequence: IntArray
    """Numbers of the actions, (P,)."""
    state_sequence: IntArray
    """Numbers of the states that they were computed from, (P,)."""
    live: Mask
    """Whether the policy gave the targets, (P,)."""
    jump: Mask
    """Jump inputs, (P,)."""
    deadline: Array
    """Times at which the steps were due [s], (P,)."""
    begun: Array
    """Times at which the steps began [s], (P,)."""
    observed: Array
    """Times at which the state and the command were read [s], (P,)."""
    inferred: Array
    """Times at which the network was done [s], (P,)."""
    done: Array
    """Times at which the actions were given to the servo [s], (P,)."""
    state_time: Array
    """Times of the states [s], (P,)."""
    command: Array
    """Velocity commands: forward, left [m/s], yaw rate [rad/s], (P, 3)."""
    target: Array
    """Joint targets [rad], (P, joints)."""
    network: NetworkLog
    """Input and outputs of the network."""

    @property
    def lateness(self) -> Array:
        """Times from the deadline of each step to its begin [s], (P,)."""
        return np.asarray(self.begun - self.deadline)

    @property
    def decision(self) -> Array:
        """Times in which the observation was built and the network run [s], (P,)."""
        return np.asarray(self.inferred - self.observed)

    @classmethod
    def of(cls, table: NDArray[Any]) -> StepLog:
        """Take the columns of a table of `STEP`."""
        return cls(
            sequence=table["sequence"],
            state_sequence=table["state_sequence"],
            live=table["live"].astype(bool),
            jump=table["jump"].astype(bool),
            deadline=table["deadline"],
            begun=table["begun"],
            observed=table["observed"],
            inferred=table["inferred"],
            done=table["done"],
            state_time=table["state_time"],
            command=table["command"],
            target=table["target"],
            network=NetworkLog(
                observation=table["observation"],
                action=table["action"],
                contact=table["contact"],
                linear_velocity=table["linear_velocity"],
            ),
        )


@dataclass(frozen=True, kw_only=True)
class DeployLog:
    """A run of a policy."""

    header: dict[str, Any]
    """Robot, joints, link, policy, limits, timing and versions of the run."""
    ticks: TickLog
    """Ticks of the servo."""
    steps: StepLog
    """Steps of the policy."""
    events: tuple[Event, ...]
    """Events in the order written."""
    complete: bool
    """True if the end was written and no record was lost."""
    figures: dict[str, Any]
    """Figures of the run, from the end; empty if the log was cut."""
    damage: str
    """What ended the reading early; empty if nothing did."""
    source: str
    """Path of the file."""
    sha256: str
    """SHA-256 of the file."""

    @property
    def virtual(self) -> bool:
        """Whether the robot was the virtual one."""
        return any(event.kind == "robot" and event.text == VIRTUAL for event in self.events)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, in file order."""
        return tuple(self.header["joints"])


def is_deploy_log(path: Path) -> bool:
    """Whether the first message of a file is the header of a deployment's log."""
    with suppress(OSError, DamagedError), path.open("rb") as file:
        for batch in records(file, path.stat().st_size):
            return batch[0].topic == HEADER_TOPIC
    return False


def read_deploy_log(path: Path) -> DeployLog:
    """Read a log; one that was cut anywhere gives what came before.

    Raises:
        LogError: Not a deployment's log, or cut before its first tick.
    """
    try:
        messages, damage = _read_messages(path)
        return _log_of(messages, damage, path)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except _FOREIGN_ERRORS as error:
        raise LogError(
            f"{path}: its messages are not those of {SCHEMA} ({type(error).__name__})."
        ) from None


class _Messages:
    """Messages of a log by topic, ticks and steps as tables."""

    def __init__(self) -> None:
        self.headers: list[dict[str, Any]] = []
        self.ticks: list[NDArray[Any]] = [np.empty(0, TICK)]
        self.steps: list[NDArray[Any]] = [np.empty(0, STEP)]
        self.events: list[dict[str, Any]] = []
        self.ends: list[dict[str, Any]] = []

    def add(self, batch: list[Record]) -> None:
        """Add the messages of a chunk."""
        self.headers += _rows(batch, HEADER_TOPIC)
        self.events += _rows(batch, EVENT_TOPIC)
        self.ends += _rows(batch, END_TOPIC)
        ticks = _rows(batch, TICK_TOPIC)
        if ticks:
            self.ticks.append(_table(ticks, TICK))
        steps = _rows(batch, STEP_TOPIC)
        if steps:
            self.steps.append(_table(steps, STEP))


def _rows(batch: list[Record], topic: str) -> list[dict[str, Any]]:
    """Return the messages of a topic; one parse for all of them, which is four times faster."""
    data = [record.data for record in batch if record.topic == topic]
    rows: list[dict[str, Any]] = orjson.loads(b"[" + b",".join(data) + b"]")
    return rows


def _table(rows: list[dict[str, Any]], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return messages as records; null becomes NaN.

    Raises one of `_FOREIGN_ERRORS` for other messages.
    """
    table = np.zeros(len(rows), dtype=dtype)
    for name in dtype.names or ():
        field = dtype[name]
        values = np.array([row[name] for row in rows], dtype=field.base)
        if values.shape != (len(rows), *field.shape):
            raise ValueError(f"{name} has the shape {values.shape[1:]}")
        table[name] = values
    return table


def _read_messages(path: Path) -> tuple[_Messages, str]:
    """Return the messages of a file, and why reading ended early ("" if it did not)."""
    messages = _Messages()
    try:
        with path.open("rb") as file:
            for batch in records(file, path.stat().st_size, MAX_BYTES):
                messages.add(batch)
    except DamagedError as error:
        return messages, str(error)
    return messages, ""


def _log_of(messages: _Messages, damage: str, path: Path) -> DeployLog:
    """Make the log of the messages of a file."""
    if not messages.headers:
        raise LogError(
            f"{path}: not a log of a deployment; `pronk deploy POLICY --log FILE` writes one."
        )
    header = messages.headers[0]
    if header.get("schema") != SCHEMA:
        raise LogError(f"{path}: schema {header.get('schema')!r}; this pronk reads {SCHEMA!r}.")
    _check_header(header, path)
    ticks = np.concatenate(messages.ticks)
    if not len(ticks):
        raise LogError(f"{path}: cut before the first tick; nothing to read.")
    steps = np.concatenate(messages.steps)
    end: dict[str, Any] = messages.ends[0] if messages.ends else {}
    return DeployLog(
        header=header,
        ticks=TickLog.of(ticks),
        steps=StepLog.of(steps),
        events=tuple(Event(**row) for row in messages.events),
        complete=bool(end.get("complete", False)) and not damage,
        figures=end.get("figures", {}),
        damage=damage,
        source=str(path),
        sha256=sha256(path),
    )


def _check_header(header: dict[str, Any], path: Path) -> None:
    """Refuse a header whose joints or limits are not those of the ticks.

    Raises:
        LogError: Another number of joints or of limits, a joint named twice, or a limit that is no
            number. A header of another kind raises one of `_FOREIGN_ERRORS`.
    """
    joints = header["joints"]
    if not isinstance(joints, list) or len(joints) != JOINTS or len(set(joints)) != JOINTS:
        raise LogError(
            f"{path}: its header names {len(joints)} joints, {len(set(joints))} of them different; "
            f"a log has {JOINTS}. The header is damaged."
        )
    limits = header.get("limits", {})
    parts = {name: limits.get(name, {}) for name in ("joints", "operating", "ages")}
    for name, part in parts.items():
        if not isinstance(part, dict):
            raise LogError(
                f"{path}: limits.{name} of its header is {part!r}; expected limits by name. The "
                "header is damaged."
            )
    for name in ("speed", "torque"):
        joint_limits = parts["joints"].get(name)
        if joint_limits is not None and np.shape(np.array(joint_limits, float)) != (JOINTS,):
            raise LogError(
                f"{path}: limits.joints.{name} of its header are not those of {JOINTS} joints. "
                "The header is damaged."
            )
    used_limits = (("operating", "temperature"), ("operating", "tilt"), ("ages", "damp_s"))
    for name, limit_name in used_limits:
        limit = parts[name].get(limit_name)
        # A limit that is infinite, as the tilt of a hung robot, is null in a log.
        if limit is not None and not isinstance(limit, int | float):
            raise LogError(
                f"{path}: limits.{name}.{limit_name} of its header is {limit!r}; expected a "
                "number. The header is damaged."
            )
