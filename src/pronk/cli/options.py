"""Options of the commands that read logs."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import tyro

from pronk.errors import PronkError

if TYPE_CHECKING:
    from pronk.identify.logs.joint_log import JointLog
    from pronk.identify.logs.options import ReadOptions
    from pronk.robots.robot import RobotSpec

Value = TypeVar("Value")


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How logs are read."""

    unit: str | None = None
    """Unit of all angles, rad or deg; required for CSV, if chirp.log.yaml does not say it."""
    time_unit: str | None = None
    """Unit of the timestamps: s, ms, us or ns."""
    columns: tuple[str, ...] = ()
    """CSV: OURS=THEIRS, as in position.FR_knee=q3; a name or a number from 0; with commas between
    several, or repeat it. Three columns without names are time, command, position of one joint."""
    joint_names: tuple[str, ...] = ()
    """THEIRS=OURS for joints of other names, as in motor_3=FR_knee,motor_4=FL_knee; with commas
    between several, or repeat it."""
    joint_order: str | None = None
    """NAME,NAME,... of columns or messages without joint names; default for the robot's order."""
    drop_duplicates: bool = False
    """Drop rows that repeat the one before in full."""
    scale: tuple[str, ...] = ()
    """JOINT=RADIANS per unit, for a joint that is not in radians; repeat it."""
    rate_hz: float | None = None
    """Rate that the log is expected to have; another one is an error."""
    log_format: Annotated[str | None, tyro.conf.arg(name="format")] = None
    """mcap, rosbag, csv, sage, pace, npz or a plugin's; from the name if left out."""
    measured_topic: str | None = None
    """Bags: topic of the measured states; guessed by its type if left out."""
    command_topic: str | None = None
    """Bags: topic of the commands; guessed by its type if left out."""
    command_field: str | None = None
    """Bags: field of the positions in a command message, as in points.0.positions."""
    reader_options: Annotated[tuple[str, ...], tyro.conf.arg(name="reader-option")] = ()
    """NAME=VALUE for a reader of another package; repeat it."""

    def options(self) -> ReadOptions:
        """Return the options as the readers take them."""
        from pronk.identify.logs.options import ReadOptions

        return ReadOptions(
            format=self.log_format,
            rate_hz=self.rate_hz,
            unit=self.unit,
            time_unit=self.time_unit,
            joint_names=named_values("--joint-names", self.joint_names, str) or None,
            joint_order=self.joint_order,
            drop_duplicates=self.drop_duplicates,
            scale=named_values("--scale", self.scale, float),
            columns=_columns(self.columns),
            measured_topic=self.measured_topic,
            command_topic=self.command_topic,
            command_field=self.command_field,
            reader_options=named_values("--reader-option", self.reader_options, str),
        )

    def words(self) -> str:
        """Return the options as they are typed, with a space in front; empty for none."""
        words = []
        single = {
            "--unit": self.unit,
            "--time-unit": self.time_unit,
            "--joint-order": self.joint_order,
            "--rate-hz": None if self.rate_hz is None else f"{self.rate_hz:g}",
            "--format": self.log_format,
            "--measured-topic": self.measured_topic,
            "--command-topic": self.command_topic,
            "--command-field": self.command_field,
        }
        for option, value in single.items():
            if value is not None:
                words += [option, value]
        repeated = {
            "--columns": self.columns,
            "--joint-names": self.joint_names,
            "--scale": self.scale,
            "--reader-option": self.reader_options,
        }
        for option, values in repeated.items():
            for value in values:
                words += [option, value]
        if self.drop_duplicates:
            words.append("--drop-duplicates")
        return "".join(f" {shlex.quote(word)}" for word in words)

    def read(self, paths: Sequence[Path], robot: RobotSpec | None) -> list[JointLog]:
        """Read every log that some paths stand for, on all cores."""
        from pronk.identify.logs.readers import read_logs

        processes = os.cpu_count() or 1
        return read_logs(paths, robot=robot, options=self.options(), processes=processes)


def check_seed(seed: int) -> None:
    """Refuse a seed that no generator of random numbers takes: PronkError."""
    if seed < 0:
        raise PronkError(f"--seed {seed}; expected 0 or more.")


def require_distinct_names(logs: Sequence[JointLog], folder: Path | None) -> None:
    """Refuse logs of which the results of one would replace those of another.

    Args:
        logs: The logs; the files of their results have their names without the ending.
        folder: Folder of the results; that of each log if None.

    Raises:
        PronkError: Two logs have the same name in the same folder of results.
    """
    sources: dict[Path, str] = {}
    for log in logs:
        source = Path(log.source or "log")
        begin = (source.parent if folder is None else folder) / source.stem
        other = sources.setdefault(begin, log.source)
        if other != log.source:
            raise PronkError(
                f"the results of {other} and {log.source} would both be written to {begin}.*; "
                "rename one of them, or give them one at a time, each with its own --out."
            )


def _columns(entries: Sequence[str]) -> Mapping[str, str] | Sequence[str]:
    """Return the names of CSV columns by those of pronk, or names that stand alone."""
    text = ",".join(entries)
    if "=" not in text and text:
        columns = [name.strip() for name in text.split(",")]
        if not all(columns) or len(columns) < 2:
            raise PronkError(
                f"--columns {text!r}: expected NAME=VALUE, as in position.FR_knee=q3, or the "
                "columns of time, command and position, as in 0,1,2."
            )
        return columns
    return named_values("--columns", entries, str)


def named_values(
    option: str,
    entries: Sequence[str],
    convert: Callable[[str], Value],
    form: str = "NAME=VALUE",
) -> dict[str, Value]:
    """Return the values of an option NAME=VALUE by name.

    The option is repeated, or has commas between its values; a piece without an equals sign belongs
    to the value before it.

    Args:
        option: The option, for the message.
        entries: Its words.
        convert: Makes a value of its text; a ValueError says what was expected.
        form: Form of an entry, for the message.

    Raises:
        PronkError: An entry is not NAME=VALUE, or its value is impossible.
    """
    pieces: list[str] = []
    for entry in entries:
        for position, piece in enumerate(entry.split(",")):
            if position and "=" not in piece:
                pieces[-1] += f",{piece}"
            else:
                pieces.append(piece)
    values = {}
    for entry in pieces:
        name, _, text = entry.partition("=")
        if not name or not text:
            raise PronkError(f"{option} {entry!r}: expected {form}.")
        try:
            values[name] = convert(text)
        except ValueError as error:
            raise PronkError(f"{option} {entry!r}: {error}.") from None
    return values


_DRIVE_GAINS_FORM = "JOINT=STIFFNESS,DAMPING, the stiffness above 0, as in knee=25,.5"
"""Form of the gains of a drive on the command line."""


def drive_gains(
    entries: Sequence[str], option: str = "--drive-gains"
) -> dict[str, tuple[float, float]] | Literal["default"] | None:
    """Return stiffness [N m/rad] and damping [N m s/rad] by joint of JOINT=STIFFNESS,DAMPING.

    The single word `default` is returned as it is; None stands for no entry.
    """
    if tuple(entries) == ("default",):
        return "default"
    return named_values(option, entries, _stiffness_and_damping, _DRIVE_GAINS_FORM) or None


def _stiffness_and_damping(text: str) -> tuple[float, float]:
    """Return the two numbers of STIFFNESS,DAMPING; ValueError if they are impossible."""
    expected = f"expected {_DRIVE_GAINS_FORM}"
    words = text.split(",")
    if len(words) != 2:
        raise ValueError(expected)
    stiffness = float(words[0])
    damping = float(words[1])
    if not 0.0 < stiffness < 1e6 or not 0.0 <= damping < 1e6:
        raise ValueError(expected)
    return stiffness, damping
