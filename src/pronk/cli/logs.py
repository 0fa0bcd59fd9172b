"""Logs on a command line: which files are meant, and how they are to be read."""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pronk.errors import LogError, PronkError

if TYPE_CHECKING:
    from pronk.logs.joint_log import SweepLog
    from pronk.robots.robot import Robot

LogsArgument = Annotated[
    list[Path], typer.Argument(help="Logs; a folder means all logs in it.", metavar="LOG...")
]
RobotOption = Annotated[str, typer.Option("--robot", help="Robot, for instance mini_cheetah.")]


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How logs are to be read. A field is an option of every command that reads logs."""

    unit: Annotated[
        str | None, typer.Option(help="Unit of all angles, rad or deg; must be said for CSV.")
    ] = None
    time_unit: Annotated[
        str | None, typer.Option(help="Unit of the timestamps: s, ms, us or ns.")
    ] = None
    columns: Annotated[
        list[str] | None,
        typer.Option(help="CSV: OURS=THEIRS, as in position.FR_knee=q3; repeat it."),
    ] = None
    joint_names: Annotated[
        list[str] | None, typer.Option(help="THEIRS=OURS for joints of other names; repeat it.")
    ] = None
    scale: Annotated[
        list[str] | None,
        typer.Option(help="JOINT=RADIANS per unit, for a joint that is not in radians; repeat it."),
    ] = None
    rate_hz: Annotated[
        float | None, typer.Option(help="Rate the log is said to have; an error if it has not.")
    ] = None
    log_format: Annotated[
        str | None,
        typer.Option(
            "--format", help="mcap, csv, sage, pace or npz; told from the name if left out."
        ),
    ] = None

    def options(self) -> dict[str, Any]:
        """Keyword arguments of `pronk.logs.readers.read_log`."""
        scale = {name: _float("--scale", value) for name, value in _pairs(self.scale, "--scale")}
        return {
            "unit": self.unit,
            "time_unit": self.time_unit,
            "columns": dict(_pairs(self.columns, "--columns")) or None,
            "joint_names": dict(_pairs(self.joint_names, "--joint-names")) or None,
            "scale": scale or None,
            "rate_hz": self.rate_hz,
            "format": self.log_format,
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


def reads_logs(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of `Reading`; it takes them together as its argument `reading`."""
    own = inspect.signature(command, eval_str=True)
    hints = inspect.get_annotations(Reading, eval_str=True)
    added = [
        inspect.Parameter(
            field.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=hints[field.name]
        )
        for field in fields(Reading)
    ]
    kept = [p for p in own.parameters.values() if p.name != "reading"]

    @functools.wraps(command)
    def wrapped(**given: Any) -> None:
        reading = Reading(**{field.name: given.pop(field.name) for field in fields(Reading)})
        command(**given, reading=reading)

    parameters = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in kept] + added
    wrapped.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
    wrapped.__annotations__ = {p.name: p.annotation for p in parameters}
    return wrapped


def read(paths: Sequence[Path], reading: Reading, robot: Robot | None) -> list[SweepLog]:
    """Read every log that some paths stand for, on all cores.

    Raises:
        LogError: As `pronk.logs.readers.read_logs`.
        RobotError: As `pronk.logs.readers.read_logs`.
    """
    from pronk.logs.readers import read_logs

    options = {name: value for name, value in reading.options().items() if value is not None}
    return read_logs(paths, processes=os.cpu_count() or 1, robot=robot, **options)


def asked_joints(log: SweepLog) -> tuple[str, ...]:
    """Joints that a log asks: those of its segments, or those whose command moves.

    Raises:
        LogError: None is.
    """
    named = {name for segment in log.segments for name in segment.joints}
    moving = (log.command.max(axis=0) - log.command.min(axis=0)) > 0.0
    asked = tuple(
        name
        for name, moves in zip(log.joints, moving, strict=True)
        if (name in named if log.segments else moves)
    )
    if not asked:
        raise LogError(f"{log.source or 'log'}: no command moves, so no joint was asked anything.")
    return asked


def home(log: SweepLog, out: Path | None) -> tuple[Path, str]:
    """Folder and stem of what is written about a log: beside it, or in `out`."""
    source = Path(log.source or "log")
    return (out if out is not None else source.parent), source.stem


def summary(logs: Sequence[SweepLog]) -> Mapping[str, str]:
    """Name and hash of each log, for `--json`."""
    return {log.source: log.sha256 for log in logs}
