"""Read a log, whatever wrote it."""

from __future__ import annotations

import inspect
import multiprocessing
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from pronk.errors import LogError, PronkError
from pronk.logs.checks import check_joints, check_radians
from pronk.logs.columns import Names
from pronk.logs.csv_reader import read_csv
from pronk.logs.joint_log import SweepLog
from pronk.logs.mcap_reader import read_mcap
from pronk.logs.npz_reader import read_npz
from pronk.logs.pace_reader import read_pace
from pronk.logs.sage_reader import is_sage, read_sage
from pronk.logs.timing import check_claim, check_unit, examine
from pronk.robots.robot import Robot

_READERS: dict[str, Callable[..., SweepLog]] = {
    "mcap": read_mcap,
    "csv": read_csv,
    "sage": read_sage,
    "pace": read_pace,
    "npz": read_npz,
}
FORMATS = tuple(_READERS)
"""Formats that `read_log` knows."""

_SUFFIXES = {".mcap": "mcap", ".csv": "csv", ".pt": "pace", ".npz": "npz"}
_NO_LOGS = (".response.npz", ".prediction.npz", "match.npz")
"""What pronk writes beside logs."""
_WORTH_PROCESSES = 4
"""Fewest logs for which starting processes pays."""


def read_log(
    path: Path | str,
    *,
    robot: Robot | None = None,
    format: str | None = None,
    columns: Mapping[str, str] | None = None,
    unit: str | None = None,
    joint_names: Names | None = None,
    time_unit: str | None = None,
    rate_hz: float | None = None,
    drop_duplicates: bool | None = None,
    scale: Mapping[str, float] | None = None,
    measured_topic: str | None = None,
    command_topic: str | None = None,
    command_field: str | None = None,
) -> SweepLog:
    """Read a log: MCAP (pronk's or rosbag2), CSV, SAGE folder, PACE `.pt`, or NPZ.

    Args:
        path: File or folder.
        robot: The robot, to check the joint names against, or to name columns that have no names.
        format: One of `FORMATS`; told from the name if None.
        columns: The file's name for each column (CSV; see `read_csv`).
        unit: Unit of all angles, `rad` or `deg` (must be said for CSV).
        joint_names: Names of the columns in order, or new names by the file's own.
        time_unit: Unit of the timestamps: s, ms, us or ns.
        rate_hz: Rate that the file is claimed to have; it is an error if the stamps disagree.
        drop_duplicates: Drop rows that repeat the one before in full, and say so in the notes.
        scale: Radians per unit of joints whose unit is unknown (SAGE's Jaw), by joint name.
        measured_topic: Topic of the measured JointState (rosbag2).
        command_topic: Topic of the commands (rosbag2).
        command_field: Where in a command message the positions are (rosbag2).

    Returns:
        The log; `notes` say what was found.

    Raises:
        LogError: The file cannot be read or believed; the message says how to mend it.
        RobotError: The robot has no such joint; the message lists those it has.
    """
    path = Path(path)
    kind = format or _sniff(path)
    if kind not in _READERS:
        raise LogError(f"{path}: format {kind!r}; expected one of {', '.join(FORMATS)}.")
    if kind == "mcap" and path.is_dir():
        path = _only_mcap(path)
    given: dict[str, Any] = {
        "columns": columns,
        "unit": unit,
        "joint_names": joint_names,
        "time_unit": time_unit,
        "rate_hz": rate_hz,
        "drop_duplicates": drop_duplicates,
        "scale": scale,
        "measured_topic": measured_topic,
        "command_topic": command_topic,
        "command_field": command_field,
    }
    given = {name: value for name, value in given.items() if value is not None}
    claimed = given.pop("rate_hz", None) if kind == "mcap" else None
    accepted = inspect.signature(_READERS[kind]).parameters
    if wrong := [name for name in given if name not in accepted]:
        takes = ", ".join(name for name in accepted if name not in ("path", "robot"))
        raise LogError(
            f"{path}: {', '.join(wrong)} means nothing for the format {kind}; it takes {takes}."
        )
    try:
        return _read(path, kind, robot, given, claimed)
    except PronkError as error:
        # Names from the file itself may hold line breaks; a message is one sentence.
        raise type(error)(" ".join(str(error).split())) from error.__cause__


def _read(
    path: Path, kind: str, robot: Robot | None, given: dict[str, Any], claimed: float | None
) -> SweepLog:
    """Read by one reader, and check what all logs must pass."""
    who: Any = robot
    if kind == "mcap":
        who = robot.name if robot is not None else "unknown"
    log = _READERS[kind](path, robot=who, **given)
    if kind == "mcap":
        timing = examine(log.time)
        check_unit(log.time, str(path), "s")
        if claimed is not None:
            check_claim(timing, str(path), claimed)
        log = replace(log, notes=(*log.notes, timing.words()))
    if robot is not None:
        if log.robot not in (robot.name, "unknown"):
            raise LogError(
                f"{path}: recorded on {log.robot}, and {robot.name} is asked for; name the right "
                "robot."
            )
        check_joints(log, robot)
    for joint in log.joints:
        check_radians(log, joint)
    return log


def find_logs(paths: Iterable[Path | str]) -> list[Path]:
    """The logs that some paths stand for; a folder that is no log itself means those in it.

    Raises:
        LogError: Nothing was named, or a folder holds no log.
    """
    found: list[Path] = []
    for path in map(Path, paths):
        if not path.is_dir() or is_sage(path) or (path / "metadata.yaml").is_file():
            found.append(path)
            continue
        inside = sorted(p for p in path.iterdir() if is_sage(p) or _may_be_log(p))
        if not inside:
            raise LogError(
                f"{path}: no logs in this folder; expected {', '.join(_SUFFIXES)} or SAGE folders."
            )
        found += inside
    if not found:
        raise LogError("no logs were named; give at least one file or folder.")
    return found


def read_logs(paths: Iterable[Path | str], *, processes: int = 1, **options: Any) -> list[SweepLog]:
    """Read several logs; a folder that is not itself a log stands for the logs in it.

    Args:
        paths: Files and folders.
        processes: Read so many at a time; worth it from four long logs on.
        options: As for `read_log`.

    Raises:
        LogError: As `read_log`, or there is no log.
        RobotError: As `read_log`.
    """
    files = find_logs(paths)
    if processes < 2 or len(files) < _WORTH_PROCESSES:
        return [_read_with(path, options) for path in files]
    # Threads of the simulator do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        return [
            done.result() for done in [pool.submit(_read_with, path, options) for path in files]
        ]


def _read_with(path: Path, options: Mapping[str, Any]) -> SweepLog:
    return read_log(path, **options)


def _may_be_log(path: Path) -> bool:
    return path.suffix.lower() in _SUFFIXES and not path.name.endswith(_NO_LOGS)


def _sniff(path: Path) -> str:
    """Format from the name of a file or the content of a folder."""
    if not path.exists():
        raise LogError(f"{path}: no such file or folder.")
    if path.is_dir():
        if is_sage(path):
            return "sage"
        if any(path.glob("*.mcap")):
            return "mcap"
        raise LogError(
            f"{path}: a folder, but no SAGE recording (control.csv, state_motor.csv, "
            "joint_list.txt) and no MCAP file in it."
        )
    kind = _SUFFIXES.get(path.suffix.lower())
    if kind is None:
        raise LogError(
            f"{path}: the ending {path.suffix!r} names no known format; expected "
            f"{', '.join(_SUFFIXES)} or a SAGE folder, or say format= one of {', '.join(FORMATS)}."
        )
    return kind


def _only_mcap(folder: Path) -> Path:
    """The one MCAP file of a rosbag2 folder."""
    inside = sorted(folder.glob("*.mcap"))
    if len(inside) != 1:
        raise LogError(f"{folder}: {len(inside)} MCAP files in it; name the one to read.")
    return inside[0]
