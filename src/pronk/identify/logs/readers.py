"""Read a log of any known format; other packages add formats by entry points."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import msgspec

from pronk.errors import LogError, PronkError
from pronk.identify.logs.checks import (
    check_radians,
    check_rate,
    check_unit,
    examine,
    saturation_note,
)
from pronk.identify.logs.columns import Columns, import_columns
from pronk.identify.logs.csv_npz_reader import read_csv, read_npz
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.mcap_reader import read_mcap
from pronk.identify.logs.pace_reader import read_pace
from pronk.identify.logs.sage_reader import is_sage, read_sage
from pronk.plugins import load_entry_point
from pronk.processes import in_processes
from pronk.robots.robot import RobotSpec

GROUP = "pronk.readers"
"""Entry points of readers from other packages; each is a function decorated with `reader`."""
_TYPES = {"int": int, "float": float, "bool": bool}


def _options(function: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Parameters that are options of a format: all but what is read and the robot."""
    _, *found = inspect.signature(function).parameters.items()
    return {name: parameter for name, parameter in found if name != "robot"}


@dataclass(frozen=True, kw_only=True)
class Reader:
    """A log format: how a file is recognised and read."""

    name: str
    suffixes: tuple[str, ...]
    """Endings of file names, lower case, with the dot; empty for folders."""
    function: Callable[..., JointLog | Columns]
    """`function(path, *, robot, **options)`; its keyword parameters are options of the format."""

    @property
    def options(self) -> Mapping[str, inspect.Parameter]:
        """Options by name; those of `import_columns` among them where the reader uses it."""
        returns = str(inspect.signature(self.function).return_annotation)
        shared = _options(import_columns) if "Columns" in returns else {}
        return _options(self.function) | shared

    def read(self, path: Path, *, robot: RobotSpec | None = None, **options: Any) -> JointLog:
        """Read a file; a reader that returns `Columns` has them checked and converted."""
        own = {name: options.pop(name) for name in _options(self.function) if name in options}
        found = self.function(path, robot=robot, **own)
        return import_columns(found, robot, **options) if isinstance(found, Columns) else found


def reader(name: str, *suffixes: str) -> Callable[[Callable[..., JointLog | Columns]], Reader]:
    """Declare a function as the reader of a format, as `--format` takes it, and of its suffixes."""
    return lambda function: Reader(name=name, suffixes=suffixes, function=function)


_BUILT_IN = (
    reader("mcap", ".mcap")(read_mcap),
    reader("csv", ".csv")(read_csv),
    reader("sage")(read_sage),
    reader("pace", ".pt")(read_pace),
    reader("npz", ".npz")(read_npz),
)


def readers() -> dict[str, Reader]:
    """Return the readers of pronk and of installed packages, by format.

    An entry point that is no reader, or takes the name or a suffix of another, is a LogError.
    """
    found = {each.name: each for each in _BUILT_IN}
    for point in entry_points(group=GROUP):
        try:
            each = load_entry_point(point)
        except PronkError as error:  # The other formats can still be read.
            warnings.warn(str(error), stacklevel=2)
            continue
        if not isinstance(each, Reader):
            raise LogError(
                f"entry point {point.value} of {GROUP} is no reader; decorate a function with "
                "pronk.identify.logs.readers.reader."
            )
        if each.name in found or _suffixes(found).keys() & set(each.suffixes):
            raise LogError(
                f"entry point {point.value} of {GROUP}: the format {each.name!r} or one of its "
                f"suffixes {', '.join(each.suffixes)} is taken already."
            )
        found[each.name] = each
    return found


_NO_LOGS = (".response.npz", ".prediction.npz", "/match.npz")
"""What pronk writes beside logs."""
_WORTH_PROCESSES = 4
"""Fewest logs for which starting processes pays."""


def read_log(
    path: Path | str,
    *,
    robot: RobotSpec | None = None,
    format: str | None = None,
    rate_hz: float | None = None,
    **options: Any,
) -> JointLog:
    """Read a log: MCAP (pronk's or rosbag2), CSV, SAGE folder, PACE `.pt`, NPZ, or a plugin's.

    Args:
        path: File or folder.
        robot: The robot, to check the joint names against.
        format: One of `readers()`; from the name if None.
        rate_hz: Expected rate; an error if the timestamps disagree.
        options: Of the format: those of `import_columns`, `columns` of `read_csv`, and those of
            `read_mcap` for rosbag2.

    Raises:
        LogError: The file cannot be read or is not plausible; the message names the remedy.
        RobotError: The robot has no such joint; the message lists those it has.
    """
    path, known = Path(path), readers()
    kind = format or _sniff(path, known)
    if kind not in known:
        raise LogError(f"{path}: format {kind!r}; expected one of {', '.join(known)}.")
    if kind == "mcap" and path.is_dir():
        inside = sorted(path.glob("*.mcap"))
        if len(inside) != 1:
            raise LogError(f"{path}: {len(inside)} MCAP files in it; name the one to read.")
        path = inside[0]
    chosen = known[kind]
    given = {name: value for name, value in options.items() if value is not None}
    if wrong := [name for name in given if name not in chosen.options]:
        raise LogError(
            f"{path}: {', '.join(wrong)} means nothing for the format {kind}; it takes "
            f"{', '.join(chosen.options)}."
        )
    try:
        given = {name: _typed(path, chosen, name, value) for name, value in given.items()}
        log = chosen.read(path, robot=robot, **given)
        if not isinstance(log, JointLog):
            raise LogError(f"{path}: the reader {kind} returned {type(log).__name__}.")
        notes = _examined(path, log, robot, rate_hz)
        return replace(log, notes=(*log.notes, *notes)).segmented()
    except PronkError as error:
        # Names from the file itself may hold line breaks; a message is one sentence.
        raise type(error)(" ".join(str(error).split())) from error.__cause__


def _typed(path: Path, chosen: Reader, name: str, value: Any) -> Any:
    """Convert an option given as text to the type that a reader declares, where it does."""
    declared = chosen.options[name].annotation
    kind = _TYPES.get(getattr(declared, "__name__", declared))
    if kind is None or not isinstance(value, str):
        return value
    try:
        return msgspec.convert(value, kind, strict=False)
    except msgspec.ValidationError:
        raise LogError(
            f"{path}: option {name} of the format {chosen.name} is {value!r}; expected "
            f"{kind.__name__}."
        ) from None


def _examined(
    path: Path, log: JointLog, robot: RobotSpec | None, rate_hz: float | None
) -> list[str]:
    """Check what all logs must pass; returns notes."""
    timing = examine(log.time)
    check_unit(log.time, str(path), "s")
    if rate_hz is not None:
        check_rate(timing, str(path), rate_hz)
    notes = [timing.words()]
    if robot is not None and log.robot not in (robot.name, "unknown"):
        raise LogError(
            f"{path}: recorded on {log.robot}, but the robot is {robot.name}; name the right robot."
        )
    for joint in log.joints:
        if robot is not None:
            robot.joint(joint)
        check_radians(log, joint)
        notes.append(saturation_note(log, joint))
    return [note for note in notes if note]


def find_logs(paths: Iterable[Path | str]) -> list[Path]:
    """The logs that some paths stand for; a folder that is no log itself means those in it."""
    suffixes = _suffixes(readers())
    found: list[Path] = []
    for path in map(Path, paths):
        if not path.is_dir() or is_sage(path) or (path / "metadata.yaml").is_file():
            found.append(path)
            continue
        inside = sorted(
            p
            for p in path.iterdir()
            if is_sage(p) or (p.suffix.lower() in suffixes and not f"/{p.name}".endswith(_NO_LOGS))
        )
        if not inside:
            raise LogError(
                f"{path}: no logs in this folder; expected {', '.join(suffixes)} or SAGE folders."
            )
        found += inside
    if not found:
        raise LogError("no logs were named; give at least one file or folder.")
    return found


def read_logs(paths: Iterable[Path | str], *, processes: int = 1, **options: Any) -> list[JointLog]:
    """Read the logs that `find_logs` finds, several at a time; `options` as for `read_log`."""
    files = find_logs(paths)
    read: Callable[[Path], JointLog] = partial(read_log, **options)
    return in_processes(read, files, processes=processes if len(files) >= _WORTH_PROCESSES else 1)


def _suffixes(known: Mapping[str, Reader]) -> dict[str, str]:
    return {suffix: each.name for each in known.values() for suffix in each.suffixes}


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
    if (suffix := path.suffix.lower()) not in suffixes:
        raise LogError(
            f"{path}: the ending {path.suffix!r} names no known format; expected "
            f"{', '.join(suffixes)} or a SAGE folder, or a format, one of {', '.join(known)}."
        )
    return suffixes[suffix]
