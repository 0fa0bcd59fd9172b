"""Logs on a command line: which files are meant, and how they are to be read."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from pronk.errors import LogError, PronkError

if TYPE_CHECKING:
    from pronk.logs.joint_log import JointLog
    from pronk.robots.robot import Robot


@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """How logs are read. Each field is an option of every command that reads logs."""

    unit: str | None = None
    """Unit of all angles, rad or deg; required for CSV."""
    time_unit: str | None = None
    """Unit of the timestamps: s, ms, us or ns."""
    columns: tuple[str, ...] = ()
    """CSV: OURS=THEIRS, as in position.FR_knee=q3; repeat it."""
    joint_names: tuple[str, ...] = ()
    """THEIRS=OURS for joints of other names; repeat it."""
    scale: tuple[str, ...] = ()
    """JOINT=RADIANS per unit, for a joint that is not in radians; repeat it."""
    rate_hz: float | None = None
    """Rate that the log is expected to have; another one is an error."""
    log_format: Annotated[str | None, tyro.conf.arg(name="format")] = None
    """mcap, csv, sage, pace, npz or a plugin's; from the name if left out."""
    measured_topic: str | None = None
    """rosbag2: topic of the measured JointState; /joint_states if left out."""
    command_topic: str | None = None
    """rosbag2: topic of the commands."""
    command_field: str | None = None
    """rosbag2: field of the positions in a command message, as in points.0.positions."""
    reader_options: Annotated[tuple[str, ...], tyro.conf.arg(name="reader-option")] = ()
    """NAME=VALUE for a reader of another package; repeat it."""

    def options(self) -> dict[str, Any]:
        """Keyword arguments of `pronk.logs.readers.read_log`."""
        scale = {name: _float("--scale", value) for name, value in _pairs(self.scale, "--scale")}
        return {
            **dict(_pairs(self.reader_options, "--reader-option")),
            "unit": self.unit,
            "time_unit": self.time_unit,
            "columns": dict(_pairs(self.columns, "--columns")) or None,
            "joint_names": dict(_pairs(self.joint_names, "--joint-names")) or None,
            "scale": scale or None,
            "rate_hz": self.rate_hz,
            "format": self.log_format,
            "measured_topic": self.measured_topic,
            "command_topic": self.command_topic,
            "command_field": self.command_field,
        }


def _pairs(entries: Sequence[str] | None, option: str) -> list[tuple[str, str]]:
    found = []
    for entry in entries or ():
        name, equals, value = entry.partition("=")
        if not (name and equals and value):
            raise PronkError(f"{option} {entry!r}: expected NAME=VALUE.")
        found.append((name, value))
    return found


def _float(option: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise PronkError(f"{option}: {text!r} is not a number.") from None


def read(paths: Sequence[Path], reading: ReadingOptions, robot: Robot | None) -> list[JointLog]:
    """Read every log that some paths stand for, on all cores.

    Raises:
        LogError: As `pronk.logs.readers.read_logs`.
        RobotError: As `pronk.logs.readers.read_logs`.
    """
    from pronk.logs.readers import read_logs

    options = {name: value for name, value in reading.options().items() if value is not None}
    return read_logs(paths, processes=os.cpu_count() or 1, robot=robot, **options)


def excited_joints(log: JointLog) -> tuple[str, ...]:
    """Joints that a log asks: those of its segments, or those whose command moves.

    Raises:
        LogError: None is.
    """
    named = {name for segment in log.segments for name in segment.joints}
    moving = (log.command.max(axis=0) - log.command.min(axis=0)) > 0.0
    excited = tuple(
        name
        for name, moves in zip(log.joints, moving, strict=True)
        if (name in named if log.segments else moves)
    )
    if not excited:
        raise LogError(f"{log.source or 'log'}: no command moves, so no joint was excited.")
    return excited


def home(log: JointLog, out: Path | None) -> tuple[Path, str]:
    """Folder and stem of what is written about a log: beside it, or in `out`."""
    source = Path(log.source or "log")
    return (out if out is not None else source.parent), source.stem


def summary(logs: Sequence[JointLog]) -> Mapping[str, str]:
    """Name and hash of each log, for `--json`."""
    return {log.source: log.sha256 for log in logs}
