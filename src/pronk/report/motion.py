"""The motion of a robot in a log of any kind, on the wall clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import orjson
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.deploy.runtime.deploy_log import DeployLog, is_deploy_log, read_deploy_log
from pronk.deploy.runtime.log import TICK_TOPIC
from pronk.errors import LogError
from pronk.identify.logs.joint_log import START_NS, JointLog
from pronk.identify.logs.mcap import DamagedError, Record, records
from pronk.identify.logs.recording import STATE
from pronk.identify.logs.sweep_writer import SAMPLE
from pronk.robots.robot import RobotSpec

WALL_CLOCK_NS = 1_000_000_000 * 10**9
"""Log times above this are of a wall clock and not of a clock that started with the recording: the
year 2001 [ns]."""
CLOCKS = {SAMPLE: "t", TICK_TOPIC: "begun", STATE: "t"}
"""Topic of pronk's own logs to the field of its messages with the time on the clock of the log."""


@dataclass(frozen=True, kw_only=True)
class RobotMotion:
    """What a robot did: n instants of some joints."""

    joints: tuple[str, ...]
    """Names of the columns."""
    time_ns: NDArray[np.int64]
    """Instants since 1970, increasing [ns], shape (n,)."""
    position: Array
    """Measured positions [rad], shape (n, joints)."""
    command: Array
    """Commanded positions [rad], NaN where nothing was commanded, shape (n, joints)."""
    velocity: Array | None = None
    """Measured velocities [rad/s], shape (n, joints), if there are any."""
    torque: Array | None = None
    """Measured torques [N m], shape (n, joints), if there are any."""
    orientation: Array | None = None
    """Attitudes of the base, quaternions w, x, y, z, shape (n, 4), if there are any."""
    remarks: tuple[tuple[int, str], ...] = ()
    """Instants [ns] and sentences: excitations, changes of mode, faults."""
    notes: tuple[str, ...] = ()
    """Sentences on the clock and on what the log does not have."""


def read_motion(
    path: Path, robot: RobotSpec, read_joint_log: Callable[[], JointLog]
) -> RobotMotion:
    """Read the motion of a log.

    Args:
        path: The log: a policy's run or anything that `read_log` reads.
        robot: The robot.
        read_joint_log: Reads the file if it is no run of a policy.

    Raises:
        LogError: The log cannot be read, is of another robot, or its positions are not in radians.
    """
    if path.is_file() and is_deploy_log(path):
        return _of_deploy_log(read_deploy_log(path), robot)
    return _of_joint_log(path, read_joint_log(), robot)


def _of_joint_log(path: Path, log: JointLog, robot: RobotSpec) -> RobotMotion:
    """Return the motion of a log of joints."""
    _check_joints(path, log.joints, robot)
    for joint, unit in zip(log.joints, log.units or (), strict=False):
        if unit != "rad":
            raise LogError(
                f"{path}: the position of {joint} is in {unit} and not in radians; give "
                f"--scale {joint}=RADIANS_PER_UNIT."
            )
    notes = []
    offset_ns = _offset_ns(path)
    start_ns = int(log.origin.metadata.get(START_NS, 0))
    if start_ns > WALL_CLOCK_NS:
        offset_ns = start_ns
    if log.time[0] * 1e9 > WALL_CLOCK_NS:
        offset_ns = 0
    elif offset_ns is None:
        notes.append("no wall clock was read of the log; its end is put at the file's last change")
        offset_ns = path.stat().st_mtime_ns - round(log.time[-1] * 1e9)
    remarks = []
    for segment in log.segments:
        sentence = (
            f"excitation of {', '.join(segment.joints)}: {segment.kind}, "
            f"{segment.amplitude:.3g} rad, repeat {segment.repeat}"
        )
        remarks.append((offset_ns + round(segment.start * 1e9), sentence))
    return RobotMotion(
        joints=log.joints,
        time_ns=offset_ns + np.round(log.time * 1e9).astype(np.int64),
        position=log.position,
        command=log.command,
        velocity=log.velocity,
        torque=log.torque,
        remarks=tuple(remarks),
        notes=tuple(notes),
    )


def _of_deploy_log(log: DeployLog, robot: RobotSpec) -> RobotMotion:
    """Return the motion of a policy's run, without the ticks at which nothing was measured."""
    path = Path(log.source)
    _check_joints(path, log.joints, robot)
    ticks = log.ticks
    state = ticks.state
    rows = np.isfinite(state.position).all(axis=1)
    if not rows.any():
        raise LogError(f"{path}: no tick has a measured position; there is nothing to draw.")
    offset_ns = _offset_ns(path) or 0
    remarks = []
    for event in log.events:
        remarks.append((offset_ns + round(event.time * 1e9), f"{event.kind}: {event.text}"))
    return RobotMotion(
        joints=log.joints,
        time_ns=offset_ns + np.round(ticks.begun[rows] * 1e9).astype(np.int64),
        position=state.position[rows],
        command=ticks.sent[rows],
        velocity=state.velocity[rows],
        torque=state.torque[rows],
        orientation=state.orientation[rows],
        remarks=tuple(remarks),
        notes=("the position of the base was not measured; it stays where it is",),
    )


def _check_joints(path: Path, joints: tuple[str, ...], robot: RobotSpec) -> None:
    """Refuse a log with joints that a robot does not have."""
    strange = [joint for joint in joints if joint not in robot.joint_names]
    if strange:
        raise LogError(
            f"{path}: {robot.name} has no joint {', '.join(strange)}; its joints are "
            f"{', '.join(robot.joint_names)}."
        )


def _offset_ns(path: Path) -> int | None:
    """Return the wall clock less the clock of a log [ns]; None if its file does not have it."""
    if path.suffix != ".mcap":
        return None
    try:
        with path.open("rb") as file:
            for batch in records(file, path.stat().st_size):
                for record in batch:
                    if record.topic in CLOCKS:
                        return _offset_of(record)
    except (OSError, DamagedError):
        return None  # reading the log itself says what is wrong with the file
    return None


def _offset_of(record: Record) -> int | None:
    """Return the log time of a message less its time on the clock of the log [ns]."""
    if record.log_time < WALL_CLOCK_NS:
        return None
    body = orjson.loads(record.data)
    log_clock_s: float = body[CLOCKS[record.topic]]
    return record.log_time - round(log_clock_s * 1e9)
