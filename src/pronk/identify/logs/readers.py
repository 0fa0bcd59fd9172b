"""Read a log of any known format; other packages add formats by entry points."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np

from pronk.errors import LogError, PronkError, RobotError
from pronk.files import check_regular
from pronk.identify.logs.bag import METADATA
from pronk.identify.logs.bag_reader import read_rosbag
from pronk.identify.logs.checks import (
    check_radians,
    check_rate,
    check_unit,
    examine_time,
    saturation_note,
    unwrapped,
)
from pronk.identify.logs.csv_npz_reader import read_csv, read_npz
from pronk.identify.logs.description import (
    description_path,
    read_description,
    with_description,
)
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.mcap_reader import read_mcap
from pronk.identify.logs.options import COLUMN_OPTIONS, NeedsOptionsError, ReadOptions
from pronk.identify.logs.pace_reader import read_pace
from pronk.identify.logs.sage_reader import is_sage, read_sage
from pronk.identify.logs.segmentation import MOVED_RAD
from pronk.plugins import load_entry_point
from pronk.processes import in_processes
from pronk.robots.robot import RobotSpec

GROUP = "pronk.readers"
"""Entry points of readers from other packages; each is a `Reader`."""
_ARTEFACT_ENDINGS = (".response.npz", ".prediction.npz", "/match.npz", ".3d.mcap")
"""Ends of the paths of what pronk writes beside logs."""
_WORTH_PROCESSES = 4
"""Fewest logs for which starting processes pays."""


@dataclass(frozen=True, kw_only=True)
class Reader:
    """A log format: how a file is recognised and read."""

    name: str
    """Name of the format, as `--format` takes it."""
    suffixes: tuple[str, ...]
    """Endings of file names, lower case, with the dot; empty for folders."""
    read: Callable[[Path, RobotSpec | None, ReadOptions], JointLog]
    """Reads a file, given the robot (if it is known) and the options; raises LogError if it is not
    of the format."""
    options: tuple[str, ...] = ()
    """Fields of `ReadOptions` that the format has, beside `format` and `rate_hz`. A reader of
    another package names its own here as well: they are in `ReadOptions.reader_options`."""


_BAG_OPTIONS = ("measured_topic", "command_topic", "command_field", *COLUMN_OPTIONS)
_BUILT_IN = (
    Reader(
        name="mcap",
        suffixes=(".mcap",),
        read=read_mcap,
        options=_BAG_OPTIONS,
    ),
    Reader(
        name="rosbag",
        suffixes=(".db3", ".bag"),
        read=read_rosbag,
        options=_BAG_OPTIONS,
    ),
    Reader(
        name="csv",
        suffixes=(".csv", ".csv.gz"),
        read=read_csv,
        options=("columns", *COLUMN_OPTIONS),
    ),
    Reader(name="sage", suffixes=(), read=read_sage, options=COLUMN_OPTIONS),
    Reader(name="pace", suffixes=(".pt",), read=read_pace, options=COLUMN_OPTIONS),
    Reader(name="npz", suffixes=(".npz",), read=read_npz, options=COLUMN_OPTIONS),
)


def readers() -> dict[str, Reader]:
    """Return the readers of pronk and of installed packages, by format.

    Raises:
        LogError: An entry point is no reader, or takes the name or a suffix of another.
    """
    by_format = {reader.name: reader for reader in _BUILT_IN}
    for point in entry_points(group=GROUP):
        try:
            reader = load_entry_point(point)
        except PronkError as error:  # The other formats can still be read.
            warnings.warn(str(error), stacklevel=2)
            continue
        if not isinstance(reader, Reader):
            raise LogError(
                f"entry point {point.value} of {GROUP} is no reader; expected a "
                "pronk.identify.logs.readers.Reader."
            )
        used_suffixes = _formats_by_suffix(by_format).keys() & set(reader.suffixes)
        if reader.name in by_format or used_suffixes:
            raise LogError(
                f"entry point {point.value} of {GROUP}: the format {reader.name!r} or one of its "
                f"suffixes {', '.join(reader.suffixes)} is taken already."
            )
        by_format[reader.name] = reader
    return by_format


def read_log(
    path: Path | str,
    *,
    robot: RobotSpec | None = None,
    options: ReadOptions | None = None,
    described: bool = True,
) -> JointLog:
    """Read a log: MCAP, a bag of ROS, CSV, SAGE folder, PACE `.pt`, NPZ, or a plug-in's.

    The log has its excitations, found in the commands where the file does not name them, and the
    remarks of its checks in `notes`.

        log = read_log("logs/FR_knee.mcap", robot=load_robot("mini_cheetah"))
        log = read_log("chirp.csv", options=ReadOptions(unit="deg"))
        loudest = log.excitations("FR_knee")[0]

    Args:
        path: File or folder.
        robot: The robot, to check the joint names against.
        options: Format, units and names, where the file does not tell them; see `ReadOptions`. They
            take precedence over those in the description beside the log, as in `chirp.log.yaml`.
        described: False to leave that description out.

    Returns:
        The log, in seconds and radians.

    Raises:
        LogError: The file cannot be read or is not plausible; the message names the remedy.
        RobotError: The robot has no such joint; the message lists those it has.
    """
    path = Path(path)
    check_regular(path, LogError)
    stated = ReadOptions() if options is None else options
    description = read_description(path) if described else None
    stated = with_description(stated, description)
    by_format = readers()
    format_name = stated.format or _format_of(path, by_format)
    if format_name not in by_format:
        raise LogError(f"{path}: format {format_name!r}; expected one of {', '.join(by_format)}.")
    reader = by_format[format_name]
    foreign_options = [name for name in stated.stated() if name not in reader.options]
    if foreign_options:
        raise LogError(
            f"{path}: {', '.join(foreign_options)} means nothing for the format {format_name}; it "
            f"takes {', '.join(reader.options)}."
        )
    try:
        log = reader.read(path, robot, stated)
        if not isinstance(log, JointLog):
            raise LogError(f"{path}: the reader {format_name} returned {type(log).__name__}.")
        notes: list[str] = []
        if robot is not None:
            log = _without_held_joints(path, log, robot)
        notes += _examine(path, log, robot, stated.rate_hz)
    except NeedsOptionsError as error:
        question = " ".join(error.question.split())
        if described:
            question += f"; `pronk log inspect {path}` guesses what it can and writes it down"
        raise NeedsOptionsError(path, question) from None
    except PronkError as error:
        # Names from the file itself may hold line breaks; a message is one sentence.
        raise type(error)(" ".join(str(error).split())) from error.__cause__
    except Exception as error:
        # Parsers fail in many ways on a damaged file.
        reason = f"{type(error).__name__} {' '.join(str(error).split())[:120]}".rstrip()
        raise LogError(f"{path}: not readable as {format_name} ({reason}).") from error
    if description is not None:
        notes.append(f"read as {description_path(path).name} says")
    # Angles that wrap would pass for excitations of half a turn.
    return unwrapped(replace(log, notes=(*log.notes, *notes))).segmented()


def _without_held_joints(path: Path, log: JointLog, robot: RobotSpec) -> JointLog:
    """Leave out joints that are held in the robot's model, such as a gripper's slides.

    Raises:
        LogError: The command of such a joint moves.
    """
    kept = [column for column, name in enumerate(log.joints) if name not in robot.held_joints]
    held = [name for name in log.joints if name in robot.held_joints]
    if not held:
        return log
    for name in held:
        if np.ptp(log.command[:, log.column(name)]) > MOVED_RAD:
            raise LogError(
                f"{path}: the command of {name} moves, a joint that is held in {robot.name}; "
                "record with it at rest, or leave its columns out."
            )
    if not kept:
        raise LogError(f"{path}: no joint but those that are held in {robot.name}.")
    columns = np.array(kept)
    return replace(
        log,
        joints=tuple(log.joints[column] for column in kept),
        command=log.command[:, columns],
        position=log.position[:, columns],
        velocity=None if log.velocity is None else log.velocity[:, columns],
        torque=None if log.torque is None else log.torque[:, columns],
        stiffness=None if log.stiffness is None else log.stiffness[columns],
        damping=None if log.damping is None else log.damping[columns],
        pose=None if log.pose is None else log.pose[columns],
        units=None if log.units is None else tuple(log.units[column] for column in kept),
        notes=(*log.notes, f"{', '.join(held)} are held in {robot.name} and left out"),
    )


def _unused_joint(log: JointLog, robot: RobotSpec) -> str:
    """Return a joint of the robot that the log does not have, for an example."""
    for name in robot.joint_names:
        if name not in log.joints:
            return name
    return robot.joint_names[0]


def _examine(
    path: Path, log: JointLog, robot: RobotSpec | None, rate_hz: float | None
) -> list[str]:
    """Check what all logs must pass; returns notes."""
    timing = examine_time(log.time)
    check_unit(log.time, str(path), "s")
    if rate_hz is not None:
        check_rate(timing, str(path), rate_hz)
    if robot is not None and log.robot not in (robot.name, "unknown"):
        raise LogError(
            f"{path}: recorded on {log.robot}, but the robot is {robot.name}; name the right robot."
        )
    notes = [timing.words()]
    for joint in log.joints:
        if robot is not None and joint not in robot.joint_names:
            raise RobotError(
                f"{path}: no joint {joint!r} in {robot.name}; it has "
                f"{', '.join(robot.joint_names)}; --joint-names renames joints, as in "
                f"--joint-names {joint}={_unused_joint(log, robot)}."
            )
        check_radians(log, joint)
        saturation = saturation_note(log, joint)
        if saturation:
            notes.append(saturation)
    return notes


def read_logs(
    paths: Iterable[Path | str],
    *,
    robot: RobotSpec | None = None,
    options: ReadOptions | None = None,
    processes: int = 1,
) -> list[JointLog]:
    """Read the logs that some paths stand for, several at a time.

    Args:
        paths: Files, and folders of logs, as `find_logs` takes them.
        robot: The robot, to check the joint names against.
        options: How the logs are read, alike for all of them.
        processes: Most processes that read at once.

    Returns:
        The logs, in the order of `find_logs`.

    Raises:
        LogError: As of `find_logs` and `read_log`.
    """
    files = find_logs(paths)
    if len(files) < _WORTH_PROCESSES:
        processes = 1
    read: Callable[[Path], JointLog] = partial(read_log, robot=robot, options=options)
    return in_processes(read, files, processes=processes, names=list(map(str, files)))


def find_logs(paths: Iterable[Path | str]) -> list[Path]:
    """Find the logs that some paths stand for; a folder that is no log means those in it.

    Raises:
        LogError: No path is given, or a folder has no logs.
    """
    suffixes = _formats_by_suffix(readers())
    logs: list[Path] = []
    for path in map(Path, paths):
        if not path.is_dir() or is_sage(path) or (path / METADATA).is_file():
            logs.append(path)
            continue
        logs_inside = []
        for entry in sorted(path.iterdir()):
            is_artefact = f"/{entry.name}".endswith(_ARTEFACT_ENDINGS)
            if is_sage(entry) or (_ending(entry) in suffixes and not is_artefact):
                logs_inside.append(entry)
        if not logs_inside:
            raise LogError(
                f"{path}: no logs in this folder; expected {', '.join(suffixes)} or SAGE folders."
            )
        logs += logs_inside
    if not logs:
        raise LogError("no logs were named; give at least one file or folder.")
    return logs


def _formats_by_suffix(by_format: Mapping[str, Reader]) -> dict[str, str]:
    """Names of the formats by the endings of their files."""
    formats = {}
    for reader in by_format.values():
        for suffix in reader.suffixes:
            formats[suffix] = reader.name
    return formats


def _format_of(path: Path, by_format: Mapping[str, Reader]) -> str:
    """Format by the name of a file or the content of a folder."""
    if not path.exists():
        raise LogError(f"{path}: no such file or folder.")
    if path.is_dir():
        if is_sage(path):
            return "sage"
        if any(path.glob("*.db3*")):
            return "rosbag"
        files = sorted(path.glob("*.mcap"))
        if len(files) > 1 and not (path / METADATA).exists():
            raise LogError(f"{path}: {len(files)} MCAP files in it; name the one to read.")
        if files:
            return "mcap"
        raise LogError(
            f"{path}: a folder, but no SAGE recording (control.csv, state_motor.csv, "
            "joint_list.txt) and no .mcap or .db3 file of a rosbag2 in it."
        )
    formats = _formats_by_suffix(by_format)
    suffix = _ending(path)
    if suffix not in formats:
        raise LogError(
            f"{path}: the ending {suffix!r} names no known format; expected "
            f"{', '.join(formats)} or a SAGE folder, or a format, one of {', '.join(by_format)}."
        )
    return formats[suffix]


def format_of(path: Path) -> str:
    """Return the format of a log by its name, or by the content of a folder.

    Raises:
        LogError: There is no such file, or its name says no format; the message lists them.
    """
    check_regular(path, LogError)
    return _format_of(path, readers())


def _ending(path: Path) -> str:
    """Ending of a file's name in lower case, with what stands before `.gz`."""
    endings = [suffix.lower() for suffix in path.suffixes]
    return "".join(endings[-2:] if endings[-1:] == [".gz"] else endings[-1:])
