"""Read a log of any known format; other packages add formats by entry points."""

from __future__ import annotations

import inspect
import multiprocessing
import warnings
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import msgspec

from pronk import plugins
from pronk.errors import LogError, PronkError
from pronk.logs.checks import check_joints, check_radians
from pronk.logs.csv_reader import read_csv
from pronk.logs.joint_log import JointLog
from pronk.logs.mcap_log import read_mcap
from pronk.logs.npz_reader import read_npz
from pronk.logs.pace_reader import read_pace
from pronk.logs.sage_reader import is_sage, read_sage
from pronk.logs.timing import check_claim, check_unit, examine
from pronk.robots.robot import Robot

GROUP = "pronk.readers"
"""Entry points of readers from other packages; each is a function decorated with `reader`."""


@dataclass(frozen=True, kw_only=True)
class Reader:
    """A log format: how a file is recognised and read."""

    name: str
    suffixes: tuple[str, ...]
    """Endings of file names, lower case, with the dot; empty for folders."""
    read: Callable[..., JointLog]
    """`read(path, *, robot, **options)`; its keyword parameters are the options of the format."""

    @property
    def options(self) -> tuple[str, ...]:
        """Names of the options."""
        parameters = inspect.signature(self.read).parameters
        return tuple(name for name in parameters if name not in ("path", "robot"))


def reader(name: str, *suffixes: str) -> Callable[[Callable[..., JointLog]], Reader]:
    """Declare a function as the reader of a format.

    Args:
        name: Of the format, as `--format` takes it.
        suffixes: Endings of its files, such as `.csv`.
    """
    return lambda read: Reader(name=name, suffixes=suffixes, read=read)


_BUILT_IN = (
    reader("mcap", ".mcap")(read_mcap),
    reader("csv", ".csv")(read_csv),
    reader("sage")(read_sage),
    reader("pace", ".pt")(read_pace),
    reader("npz", ".npz")(read_npz),
)


def readers() -> dict[str, Reader]:
    """Return the readers of pronk and of installed packages, by format.

    Raises:
        LogError: An entry point is not a reader, or takes the name or a suffix of another.
    """
    found = {each.name: each for each in _BUILT_IN}
    taken = {suffix: each.name for each in _BUILT_IN for suffix in each.suffixes}
    for point in entry_points(group=GROUP):
        try:
            each = plugins.load(point)
        except PronkError as error:  # The other formats can still be read.
            warnings.warn(str(error), stacklevel=2)
            continue
        if not isinstance(each, Reader):
            raise LogError(
                f"entry point {point.value} of {GROUP} is no reader; decorate a function with "
                "pronk.logs.readers.reader."
            )
        if each.name in found or taken.keys() & set(each.suffixes):
            raise LogError(
                f"entry point {point.value} of {GROUP}: the format {each.name!r} or one of its "
                f"suffixes {', '.join(each.suffixes)} is taken already."
            )
        found[each.name] = each
        taken |= dict.fromkeys(each.suffixes, each.name)
    return found


_NO_LOGS = (".response.npz", ".prediction.npz", "match.npz")
"""What pronk writes beside logs."""
_WORTH_PROCESSES = 4
"""Fewest logs for which starting processes pays."""


def read_log(
    path: Path | str,
    *,
    robot: Robot | None = None,
    format: str | None = None,
    rate_hz: float | None = None,
    **options: Any,
) -> JointLog:
    """Read a log: MCAP (pronk's or rosbag2), CSV, SAGE folder, PACE `.pt`, NPZ, or a plugin's.

    Args:
        path: File or folder.
        robot: The robot, to check the joint names against, or to name columns that have no names.
        format: One of `readers()`; from the name if None.
        rate_hz: Rate that the file is expected to have; an error if the timestamps disagree.
        options: Of the format: `columns`, `unit`, `joint_names`, `time_unit`, `drop_duplicates`
            (CSV, NPZ and others), `scale` (SAGE), `measured_topic`, `command_topic`,
            `command_field` (rosbag2); see the function that reads it.

    Returns:
        The log; `notes` list what was found.

    Raises:
        LogError: The file cannot be read or is not plausible; the message names the remedy.
        RobotError: The robot has no such joint; the message lists those it has.
    """
    path = Path(path)
    known = readers()
    kind = format or _sniff(path, known)
    if kind not in known:
        raise LogError(f"{path}: format {kind!r}; expected one of {', '.join(known)}.")
    if kind == "mcap" and path.is_dir():
        path = _only_mcap(path)
    given = {name: value for name, value in options.items() if value is not None}
    takes = known[kind].options
    if "rate_hz" in takes and rate_hz is not None:
        given["rate_hz"] = rate_hz
    if wrong := [name for name in given if name not in takes]:
        raise LogError(
            f"{path}: {', '.join(wrong)} means nothing for the format {kind}; it takes "
            f"{', '.join(takes)}."
        )
    given = _converted(path, known[kind], given)
    try:
        return _read(path, known[kind], robot, given, rate_hz)
    except PronkError as error:
        # Names from the file itself may hold line breaks; a message is one sentence.
        raise type(error)(" ".join(str(error).split())) from error.__cause__


def _converted(path: Path, chosen: Reader, given: dict[str, Any]) -> dict[str, Any]:
    """Convert options given as text to the types that a reader declares, where it does."""
    parameters = inspect.signature(chosen.read, eval_str=True).parameters
    found = dict(given)
    for name, value in given.items():
        kind = parameters[name].annotation
        if isinstance(value, str) and kind in (int, float, bool):
            try:
                found[name] = msgspec.convert(value, kind, strict=False)
            except msgspec.ValidationError:
                raise LogError(
                    f"{path}: option {name} of the format {chosen.name} is {value!r}; expected "
                    f"{kind.__name__}."
                ) from None
    return found


def _read(
    path: Path, chosen: Reader, robot: Robot | None, given: dict[str, Any], rate_hz: float | None
) -> JointLog:
    """Read by one reader, and check what all logs must pass."""
    log = chosen.read(path, robot=robot, **given)
    if not isinstance(log, JointLog):
        raise LogError(f"{path}: the reader {chosen.name} returned {type(log).__name__}.")
    if "rate_hz" not in chosen.options:
        timing = examine(log.time)
        check_unit(log.time, str(path), "s")
        if rate_hz is not None:
            check_claim(timing, str(path), rate_hz)
        log = replace(log, notes=(*log.notes, timing.words()))
    if robot is not None:
        if log.robot not in (robot.name, "unknown"):
            raise LogError(
                f"{path}: recorded on {log.robot}, but the robot is {robot.name}; name the right "
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
    suffixes = _suffixes(readers())
    found: list[Path] = []
    for path in map(Path, paths):
        if not path.is_dir() or is_sage(path) or (path / "metadata.yaml").is_file():
            found.append(path)
            continue
        inside = sorted(p for p in path.iterdir() if is_sage(p) or _may_be_log(p, suffixes))
        if not inside:
            raise LogError(
                f"{path}: no logs in this folder; expected {', '.join(suffixes)} or SAGE folders."
            )
        found += inside
    if not found:
        raise LogError("no logs were named; give at least one file or folder.")
    return found


def read_logs(paths: Iterable[Path | str], *, processes: int = 1, **options: Any) -> list[JointLog]:
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


def _read_with(path: Path, options: Mapping[str, Any]) -> JointLog:
    return read_log(path, **options)


def _suffixes(known: Mapping[str, Reader]) -> dict[str, str]:
    return {suffix: each.name for each in known.values() for suffix in each.suffixes}


def _may_be_log(path: Path, suffixes: Mapping[str, str]) -> bool:
    return path.suffix.lower() in suffixes and not path.name.endswith(_NO_LOGS)


def _sniff(path: Path, known: Mapping[str, Reader]) -> str:
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
    suffixes = _suffixes(known)
    kind = suffixes.get(path.suffix.lower())
    if kind is None:
        raise LogError(
            f"{path}: the ending {path.suffix!r} names no known format; expected "
            f"{', '.join(suffixes)} or a SAGE folder, or a format, one of {', '.join(known)}."
        )
    return kind


def _only_mcap(folder: Path) -> Path:
    """The one MCAP file of a rosbag2 folder."""
    inside = sorted(folder.glob("*.mcap"))
    if len(inside) != 1:
        raise LogError(f"{folder}: {len(inside)} MCAP files in it; name the one to read.")
    return inside[0]
