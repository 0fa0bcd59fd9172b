"""A guess at what a log holds: its columns, units and joints, with what cannot be told.

Columns are told by their names, units by names and by values. Where two readings of a file are
plausible the guess says both and takes none.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pronk.arrays import Array
from pronk.errors import LogError, PronkError
from pronk.identify.logs.checks import (
    LARGEST_COMMAND,
    LARGEST_POSITION,
    PLAUSIBLE_HZ,
    position_follows,
)
from pronk.identify.logs.columns import robot_names
from pronk.identify.logs.csv_npz_reader import QUANTITIES
from pronk.identify.logs.csv_table import CsvTable, read_table
from pronk.identify.logs.description import read_description, with_description
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.options import ANGLE_UNITS, TIME_UNITS, NeedsOptionsError, ReadOptions
from pronk.identify.logs.readers import format_of, read_log
from pronk.robots.robot import RobotSpec

_SAMPLES = 3
"""Rows of a log that a guess shows."""
_USUAL_HZ = (20.0, 5_000.0)
"""Rates that logs usually have [Hz], by which the unit of time is told where no name says it."""
_UNIT_FACTOR = 2.0
"""Largest factor between the travel of a position over its command's and the number of degrees in a
radian that makes them columns of two units: a joint amplifies its command at its resonance."""
_LEAST_DEGREES = 1.0
"""Travel below which a command is not in degrees: gears have more backlash [deg]."""
_LEAST_RADIANS = 0.02
"""Travel above which a command in radians excites a joint: as the smallest chirps do [rad]."""
_SOME_RADIANS = np.pi
"""Angle up to which a small motion is in radians for sure; most joints turn less far [rad]."""
_OUTLIERS = 0.005
"""Share of the samples at either end that does not tell the unit: encoders skip now and then."""
_RANGE_SLACK = 0.1
"""Share of a joint's range by which a log may leave it."""

_TIME_WORDS = frozenset(
    ("time", "t", "timestamp", "stamp", "ts", "clock", "elapsed", "zeit", "secs", "seconds", "sec")
)
_INDEX_WORDS = frozenset(("", "index", "n", "i", "k", "sample", "row", "frame", "no", "id"))
_COMMAND_WORDS = frozenset(
    (
        "cmd",
        "command",
        "commanded",
        "des",
        "desired",
        "ref",
        "reference",
        "target",
        "tgt",
        "goal",
        "set",
        "setpoint",
        "sp",
        "soll",
        "u",
    )
)
_POSITION_WORDS = frozenset(
    ("pos", "position", "q", "angle", "theta", "enc", "encoder", "y", "winkel")
)
_MEASURED_WORDS = frozenset(
    ("act", "actual", "meas", "measured", "ist", "fb", "feedback", "state", "real", "present")
)
_VELOCITY_WORDS = frozenset(("vel", "velocity", "dq", "qd", "qdot", "speed", "omega", "rate"))
_TORQUE_WORDS = frozenset(("tau", "torque", "effort", "trq", "moment"))
_OTHER_WORDS = frozenset(
    ("current", "amp", "amps", "voltage", "volt", "temp", "temperature", "kp", "kd", "acc", "error")
)
_VAGUE_COMMANDS = frozenset(("u", "set", "input"))
"""Names of commands that may be torques as well."""
_KINDS = {
    "other": _OTHER_WORDS,
    "velocity": _VELOCITY_WORDS,
    "torque": _TORQUE_WORDS,
    "command": _COMMAND_WORDS,
    "position": _POSITION_WORDS,
    "measured": _MEASURED_WORDS,
}
"""Words by what they say of a column."""
_ANGLE_WORDS = {
    "rad": "rad",
    "radian": "rad",
    "radians": "rad",
    "deg": "deg",
    "degree": "deg",
    "degrees": "deg",
    "grad": "deg",
    "°": "deg",
}
"""Units of angle by the words in names."""
_TIME_UNIT_WORDS = {
    "s": "s",
    "sec": "s",
    "secs": "s",
    "second": "s",
    "seconds": "s",
    "ms": "ms",
    "msec": "ms",
    "millis": "ms",
    "us": "us",
    "usec": "us",
    "micros": "us",
    "ns": "ns",
    "nsec": "ns",
    "nanos": "ns",
}
"""Units of time by the words in names."""


@dataclass(frozen=True, kw_only=True)
class GuessedColumn:
    """What one column of a file, or one quantity of a joint, is taken for."""

    name: str
    """Its name in the file."""
    reading: str
    """`time`, or a quantity and a joint, as in `position.knee`; "" if it is not read."""
    unit: str
    """Its unit, or "" where it is not known."""
    samples: tuple[str, ...]
    """Its first values as they stand in the file."""


@dataclass(frozen=True, kw_only=True)
class LogGuess:
    """How a log is read, and what a person has to say."""

    path: Path
    options: ReadOptions
    """Options as stated and as guessed."""
    columns: tuple[GuessedColumn, ...]
    reasons: tuple[str, ...]
    """Why units and columns are taken for what they are."""
    questions: tuple[str, ...]
    """What cannot be told, each with the option that says it; empty if the log can be read."""
    log: JointLog | None
    """The log as it is read, where nothing is open."""


@dataclass
class _Parts:
    """Parts of a column's name."""

    joint: str
    """What is left of the name when the words for quantity and unit are taken away."""
    quantity: str = ""
    """`time`, `index`, one of the quantities, or "" if the name says none."""
    unit: str = ""
    """Unit in the name."""
    words: list[str] = field(default_factory=list)
    """Words of the name in lower case."""


def inspect_log(path: Path, robot: RobotSpec | None, stated: ReadOptions) -> LogGuess:
    """Guess how a log is read; what is stated, or described beside it, is not guessed.

    Args:
        path: The log.
        robot: The robot, if it is known, for joints and their ranges.
        stated: Options that a person states.

    Returns:
        The guess, with the log where nothing is open.

    Raises:
        LogError: The file cannot be read at all.
    """
    options = with_description(stated, read_description(path))
    options = replace(options, format=options.format or format_of(path))
    if options.format == "csv":
        return _inspect_csv(path, robot, options)
    return _inspect_other(path, robot, options)


# --- CSV ----------------------------------------------------------------------------------------


def _inspect_csv(path: Path, robot: RobotSpec | None, options: ReadOptions) -> LogGuess:
    """Guess the columns of a table by their names, and the units by names and values."""
    table = read_table(path)
    questions: list[str] = []
    reasons = list(table.notes)
    parts = [_parts_of(table, index) for index in range(table.width)]
    readings = _stated_readings(table, options)
    joint_names: Mapping[str, str] | None = None
    columns_are_stated = False
    # What a person states of the columns is not doubted.
    if any(reading.startswith("position.") for reading in readings.values()):
        joint_names = options.joint_names
        columns_are_stated = True
    if not any(reading == "time" for reading in readings.values()):
        time = _time_column(table, parts, readings)
        if time is None:
            questions.append(
                "no column, or several, that could be the time; give --columns time=NAME"
            )
        else:
            readings[time] = "time"
    if not any(reading.startswith("position.") for reading in readings.values()):
        _guess_joints(table, parts, readings, robot, options, questions)
    chosen = {reading: _name(table, index) for index, reading in readings.items()}
    unit = options.unit or _angle_unit(table, parts, readings, robot, questions, reasons)
    time_unit = options.time_unit
    for index, reading in readings.items():
        if reading == "time" and time_unit is None:
            time_unit = _time_unit(table, index, parts[index], questions, reasons)
    guessed = replace(
        options,
        columns=chosen,
        unit=unit or None,
        time_unit=time_unit or None,
        joint_names=joint_names,
    )
    columns = []
    for index in range(table.width):
        reading = readings.get(index, "")
        shown_unit = ""
        if reading == "time":
            shown_unit = time_unit or ""
        elif reading.startswith("torque."):
            shown_unit = "N m"
        elif reading.startswith("velocity."):
            shown_unit = f"{unit}/s" if unit else ""
        elif reading:
            shown_unit = unit
        samples = [row[index].strip()[:16] for row in table.rows[:_SAMPLES]]
        columns.append(
            GuessedColumn(
                name=_name(table, index),
                reading=reading,
                unit=shown_unit,
                samples=tuple(samples),
            )
        )
    log = None
    if not questions:
        log = _read(path, robot, guessed, questions)
    if log is not None and not columns_are_stated:
        for joint in log.excited_joints:
            column = log.column(joint)
            command = log.command[:, column]
            name = chosen.get(f"command.{joint}", "")
            # In control engineering u is the input of a plant, often a torque.
            closely = name.casefold() in _VAGUE_COMMANDS
            if not position_follows(log.time, command, log.position[:, column], closely=closely):
                questions.append(
                    f"{name or 'the command'} may be no commanded position "
                    f"of {joint}, as the position does not follow it. So would look a drive at its "
                    "torque limit, and a joint that friction or a stop holds; say what the columns "
                    "are "
                    f"with --columns command.{joint}=NAME,position.{joint}=NAME (or torque.{joint})"
                )
    return LogGuess(
        path=path,
        options=guessed,
        columns=tuple(columns),
        reasons=tuple(reasons),
        questions=tuple(questions),
        log=log,
    )


def _name(table: CsvTable, index: int) -> str:
    """Name of a column, or its number where it has none of its own."""
    if table.header and table.header[index] and table.header.count(table.header[index]) == 1:
        return table.header[index]
    return str(index)


def _parts_of(table: CsvTable, index: int) -> _Parts:
    """Take a column's name apart: joint, quantity and unit."""
    name = table.header[index] if table.header else ""
    unit_text = table.units[index] if table.units else ""
    quantity, _, joint = name.partition(".")
    if quantity in QUANTITIES and joint:
        return _Parts(joint, quantity, _unit_in(unit_text), [])
    bracket = re.search(r"[\[(]\s*([^\])]+?)\s*[\])]", name)
    bare = name
    if bracket is not None:
        unit_text = unit_text or bracket.group(1)
        bare = name[: bracket.start()] + " " + name[bracket.end() :]
    # Words end where the case changes, at digits and at signs: q3Des has the words q, 3 and Des.
    found_words = list(re.finditer(r"[A-Z]+(?![a-z])|[A-Z]?[a-zäöüß]+|\d+|°", bare))
    words = [match.group().casefold() for match in found_words]
    parts = _Parts("", "", _unit_in(unit_text), words)
    if not words and table.header:
        parts.quantity = "index"
    unread = list(bare)
    kinds = set()
    for position, match in enumerate(found_words):
        word = words[position]
        is_unit = word in _ANGLE_WORDS or (position > 0 and word in _TIME_UNIT_WORDS)
        matched_kind = ""
        if is_unit and not parts.unit and len(words) > 1:
            parts.unit = word
            matched_kind = "unit"
        elif word in _TIME_UNIT_WORDS and parts.unit in _ANGLE_WORDS:
            matched_kind = "unit"  # Of rad/s or deg/s.
        else:
            for name_of_kind, kind_words in _KINDS.items():
                if word in kind_words:
                    matched_kind = name_of_kind
                    break
        if matched_kind:
            kinds.add(matched_kind)
            for character in range(*match.span()):
                unread[character] = "_"
    kinds.discard("unit")
    if "current" in words and "position" in kinds:
        kinds.discard("other")  # The current position is no electric current.
    first = words[0] if words else ""
    is_unit_of_time = len(words) == 1 and first in _TIME_UNIT_WORDS
    if is_unit_of_time or (0 < len(words) <= 2 and first in _TIME_WORDS):
        parts.quantity = "time"
        if is_unit_of_time:
            parts.unit = parts.unit or first
    elif len(words) == 1 and first in _INDEX_WORDS and not kinds:
        parts.quantity = "index"
    elif "other" in kinds or ("command" in kinds and kinds & {"velocity", "torque"}):
        # Commanded speeds and torques are not read.
        parts.quantity = ""
        parts.joint = ""
        return parts
    elif "velocity" in kinds:
        parts.quantity = "velocity"
    elif "torque" in kinds:
        parts.quantity = "torque"
    elif "command" in kinds:
        parts.quantity = "command"
    elif kinds:
        parts.quantity = "position"
    parts.joint = re.sub(r"[_\s./:-]{2,}", "_", "".join(unread)).strip("_ ./:-")
    return parts


def _unit_in(text: str) -> str:
    """Unit in the text of a bracket or of a row of units."""
    return text.strip().strip("[]()").casefold().removesuffix("/s").strip() if text else ""


def _stated_readings(table: CsvTable, options: ReadOptions) -> dict[int, str]:
    """What columns are read as, by their index, as a person states it.

    Raises:
        LogError: A stated column is not there.
    """
    stated = options.columns or {}
    if not isinstance(stated, Mapping):
        order = options.joint_order or "joint"
        joint = order if isinstance(order, str) else next(iter(order))
        if len(stated) != 3:
            raise LogError(
                f"{table.path}: --columns {','.join(stated)} without names; expected the three "
                "columns time, command and position of one joint."
            )
        names = ("time", f"command.{joint}", f"position.{joint}")
        stated = dict(zip(names, stated, strict=True))
    readings: dict[int, str] = {}
    for index, name in enumerate(table.header):
        quantity, _, joint = name.partition(".")
        if name == "time" or (quantity in QUANTITIES and joint):
            readings[index] = name
    for reading, name in stated.items():
        column = table.index(name)
        if column is None:
            raise LogError(f"{table.path}: no column called {name!r}; {table.names}.")
        readings = {index: other for index, other in readings.items() if other != reading}
        readings[column] = reading
    return readings


def _time_column(
    table: CsvTable, parts: Sequence[_Parts], readings: Mapping[int, str]
) -> int | None:
    """Index of the one column whose name or, without names, whose values are those of a time."""
    named = [index for index, part in enumerate(parts) if part.quantity == "time"]
    candidates = []
    for index in named if table.header else range(table.width):
        if index in readings:
            continue
        try:
            values, _ = table.timestamps(index)
        except LogError:
            continue
        if len(values) > 1 and (np.diff(values) > 0.0).all():
            candidates.append(index)
    if len(candidates) == 1:
        return candidates[0]
    return named[0] if len(named) == 1 else None


def _guess_joints(
    table: CsvTable,
    parts: Sequence[_Parts],
    readings: dict[int, str],
    robot: RobotSpec | None,
    options: ReadOptions,
    questions: list[str],
) -> None:
    """Guess the joint and the quantity of each column by its name; readings are added."""
    by_joint: dict[str, dict[str, list[int]]] = {}
    for index, part in enumerate(parts):
        if index not in readings and part.quantity in QUANTITIES:
            columns = by_joint.setdefault(part.joint or "joint", {})
            columns.setdefault(part.quantity, []).append(index)
    complete = {}
    for joint, columns in by_joint.items():
        if "position" in columns and ("command" in columns or "torque" in columns):
            complete[joint] = columns
    if not complete:
        listed = ", ".join(f"{k}: {_name(table, k)}" for k in range(table.width))
        questions.append(
            f"the names do not say which columns are command and position ({listed}); give "
            "--columns time=NAME,command.JOINT=NAME,position.JOINT=NAME"
        )
        return
    names = _names_of_joints(list(complete), robot, options, questions)
    for joint, columns in complete.items():
        for quantity, indices in columns.items():
            if len(indices) > 1:
                columns_named = ", ".join(_name(table, index) for index in indices)
                questions.append(
                    f"the {quantity} of {joint} may be any of {columns_named}; give --columns "
                    f"{quantity}.{names[joint]}=NAME with those of its other quantities"
                )
                continue
            readings[indices[0]] = f"{quantity}.{names[joint]}"


def _names_of_joints(
    joints: Sequence[str],
    robot: RobotSpec | None,
    options: ReadOptions,
    questions: list[str],
) -> dict[str, str]:
    """Names of joints by what the names of columns call them: stated, the robot's, or the same."""
    stated = options.joint_names or {}
    names = {}
    for joint in joints:
        plain = f"joint{joint}" if joint.isdecimal() else joint
        names[joint] = stated.get(joint, stated.get(plain, plain))
    if robot is None:
        return names
    matched = robot_names(joints, robot)
    unknown = []
    for joint in joints:
        if joint in stated or names[joint] in robot.joint_names:
            continue
        if joint in matched:
            names[joint] = matched[joint]
        elif len(robot.joints) == 1 and len(joints) == 1:
            names[joint] = robot.joint_names[0]
        else:
            unknown.append(joint)
    if unknown:
        questions.append(_naming_question(unknown, names, robot))
    return names


def _naming_question(unknown: Sequence[str], names: Mapping[str, str], robot: RobotSpec) -> str:
    """Ask which joints of the robot some joints of a log are, with an example to correct."""
    free = [name for name in robot.joint_names if name not in names.values()]
    pairs = []
    for joint in unknown:
        similar = [name for name in free if joint.casefold() in name.casefold()]
        choice = (similar or free or ["NAME"])[0]
        if choice in free:
            free.remove(choice)
        pairs.append(f"{joint}={choice}")
    return (
        f"{', '.join(unknown)}: no joint of {robot.name}, which has "
        f"{', '.join(robot.joint_names)}; say which is which, as in --joint-names {','.join(pairs)}"
    )


# --- Units --------------------------------------------------------------------------------------


def _angle_unit(
    table: CsvTable,
    parts: Sequence[_Parts],
    readings: Mapping[int, str],
    robot: RobotSpec | None,
    questions: list[str],
    reasons: list[str],
) -> str:
    """Unit of the angles by names, else by values; "" with a question if it cannot be told."""
    named: dict[str, str] = {}
    values: dict[str, Array] = {}
    for index, reading in readings.items():
        quantity, _, _ = reading.partition(".")
        if quantity not in ("command", "position"):
            continue
        unit = _ANGLE_WORDS.get(parts[index].unit)
        if unit:
            named[unit] = _name(table, index)
        values[reading] = table.numbers(index)
    if len(named) == 1:
        unit = next(iter(named))
        reasons.append(f"angles in {unit}: the name of {named[unit]} says so")
        if unit == "rad" and not _may_be_radians(values, robot):
            questions.append(
                "the names say rad and the values are larger than a joint turns; give --unit deg "
                "or --unit rad"
            )
        return unit
    if len(named) > 1:
        questions.append(
            f"{named['rad']} is in rad and {named['deg']} in deg by their names; convert one of "
            "them"
        )
        return ""
    if not values:
        return ""
    return unit_by_values(values, robot, questions, reasons)


def _may_be_radians(values: Mapping[str, Array], robot: RobotSpec | None) -> bool:
    """Return True if angles are such as joints reach, and those of the robot where it is known."""
    for reading, all_angles in values.items():
        quantity, _, joint = reading.partition(".")
        # A few wrong samples of an encoder are no degrees.
        low_end, high_end = np.quantile(all_angles, (_OUTLIERS, 1.0 - _OUTLIERS))
        angles = all_angles[(all_angles >= low_end) & (all_angles <= high_end)]
        if np.abs(angles).max() > LARGEST_POSITION:
            return False
        if quantity == "command" and 0.5 * np.ptp(angles) > LARGEST_COMMAND:
            return False
        if robot is not None and joint in robot.joint_names:
            low, high = robot.joint(joint).range
            slack = _RANGE_SLACK * (high - low)
            if angles.min() < low - slack or angles.max() > high + slack:
                return False
    return True


def _too_far(values: Mapping[str, Array], robot: RobotSpec | None) -> str:
    """Say which joint cannot be in radians, with its range where the robot is known."""
    for reading, angles in values.items():
        if _may_be_radians({reading: angles}, robot):
            continue
        quantity, _, joint = reading.partition(".")
        text = f"the {quantity} of {joint} goes from {angles.min():.3g} to {angles.max():.3g}"
        if robot is not None and joint in robot.joint_names:
            low, high = robot.joint(joint).range
            text += f", where {robot.name} has a range of {low:.3g} to {high:.3g}"
        return text
    return "they would turn too far"


def _joints_of_two_units(values: Mapping[str, Array], robot: RobotSpec | None) -> tuple[str, str]:
    """Find two joints of one file that cannot have the same unit.

    Args:
        values: Angles in the file's unit by `command.JOINT` and `position.JOINT`, shape (n,).
        robot: The robot, whose ranges rule radians out.

    Returns:
        A joint that cannot be in radians, and a commanded joint that cannot be in degrees; two
        empty names where there is no such pair.
    """
    by_joint: dict[str, dict[str, Array]] = {}
    for reading, angles in values.items():
        _, _, joint = reading.partition(".")
        by_joint.setdefault(joint, {})[reading] = angles
    in_degrees = ""
    in_radians = ""
    for joint, joint_values in by_joint.items():
        command = joint_values.get(f"command.{joint}")
        if command is None:
            continue
        travel = float(np.ptp(command))
        if not _may_be_radians(joint_values, robot):
            in_degrees = in_degrees or joint
        elif _LEAST_RADIANS < travel < _LEAST_DEGREES:
            in_radians = in_radians or joint
    if in_degrees and in_radians:
        return in_degrees, in_radians
    return "", ""


def _joint_of_two_units(values: Mapping[str, Array]) -> tuple[str, float]:
    """Find a joint whose position moves as if in degrees beside a command in radians, or reversed.

    Args:
        values: Angles in the file's unit by `command.JOINT` and `position.JOINT`, shape (n,).

    Returns:
        The joint, and the travel of its position over that of its command; an empty name and 1
        where there is none.
    """
    for reading, command in values.items():
        quantity, _, joint = reading.partition(".")
        position = values.get(f"position.{joint}")
        travel = float(np.ptp(command))
        if quantity != "command" or position is None or travel == 0.0:
            continue
        ratio = float(np.ptp(position)) / travel
        in_degrees = 1.0 / _UNIT_FACTOR < ratio * ANGLE_UNITS["deg"] < _UNIT_FACTOR
        command_in_degrees = 1.0 / _UNIT_FACTOR < ratio / ANGLE_UNITS["deg"] < _UNIT_FACTOR
        if in_degrees or (command_in_degrees and travel >= _LEAST_DEGREES):
            return joint, ratio
    return "", 1.0


def unit_by_values(
    values: Mapping[str, Array],
    robot: RobotSpec | None,
    questions: list[str],
    reasons: list[str],
) -> str:
    """Tell rad from deg by the size of commands and positions.

    Args:
        values: Angles in the file's unit by `command.JOINT` and `position.JOINT`, shape (n,).
        robot: The robot, whose ranges rule radians out.
        questions: Gets what cannot be told.
        reasons: Gets why a unit was taken.

    Returns:
        The unit, or "" where both are plausible or neither is.
    """
    travel = 0.0
    farthest = 0.0
    for reading, angles in values.items():
        farthest = max(farthest, float(np.abs(angles).max()))
        if reading.startswith("command.") or travel == 0.0:
            travel = max(travel, float(np.ptp(angles)))
    joint, ratio = _joint_of_two_units(values)
    if joint:
        questions.append(
            f"the position of {joint} moves {ratio:.3g} times as far as its command; if one of the "
            "two is in degrees and the other in radians, convert one; if the command is a torque, "
            f"name the right column with --columns; if {joint} was held, or its position is that "
            "of the motor before a gear, give --unit rad or --unit deg"
        )
        return ""
    joint_in_degrees, joint_in_radians = _joints_of_two_units(values, robot)
    if joint_in_degrees:
        questions.append(
            f"{joint_in_degrees} turns too far for radians and {joint_in_radians} would hardly "
            "move in degrees, so the file may have both units; give --unit rad --scale "
            f"{joint_in_degrees}={ANGLE_UNITS['deg']:.6f}, for each joint that is in degrees, or "
            "--unit deg if all are"
        )
        return ""
    may_be_radians = _may_be_radians(values, robot)
    may_be_degrees = travel >= _LEAST_DEGREES or farthest > _SOME_RADIANS
    sizes = f"travel {travel:.3g}, farthest {farthest:.3g}"
    if may_be_radians and not may_be_degrees:
        reasons.append(f"angles in rad: in degrees they would hardly move ({sizes})")
        return "rad"
    if may_be_degrees and not may_be_radians:
        reasons.append(f"angles in deg: in radians they would turn too far ({sizes})")
        return "deg"
    if may_be_radians:
        questions.append(
            f"angles in rad or in deg are both plausible ({sizes}); give --unit rad or --unit deg"
        )
        return ""
    questions.append(
        f"neither unit fits: in degrees the joints would hardly move ({sizes}), and in radians "
        f"{_too_far(values, robot)}; check its column, its sign and its zero, or give --unit rad "
        "or --unit deg"
    )
    return ""


def _time_unit(
    table: CsvTable, index: int, part: _Parts, questions: list[str], reasons: list[str]
) -> str:
    """Unit of the time by its name and its intervals; "" with a question if it cannot be told."""
    values, is_date = table.timestamps(index)
    if is_date:
        reasons.append("times are dates or times of day")
        return ""
    step = float(np.median(np.diff(values)))
    if not step > 0.0:
        questions.append("the times do not increase; name another column with --columns time=NAME")
        return ""
    plausible = _units_within(step, PLAUSIBLE_HZ)
    unit = _TIME_UNIT_WORDS.get(part.unit, "")
    if unit in plausible:
        reasons.append(f"times in {unit}: the name of {_name(table, index)} says so")
        return unit
    likely = _units_within(step, _USUAL_HZ)
    choices = likely or plausible
    if unit or len(choices) != 1:
        rates = []
        for name, seconds in TIME_UNITS.items():
            rates.append(f"{1.0 / (step * seconds):.4g} Hz in {name}")
        questions.append(
            f"the unit of the times cannot be told (steps of {step:.4g}: {', '.join(rates)}); give "
            "--time-unit s, ms, us or ns"
        )
        return ""
    rate_hz = 1.0 / (step * TIME_UNITS[choices[0]])
    reasons.append(f"times in {choices[0]}: steps of {step:.4g} are then {rate_hz:.4g} Hz")
    return choices[0]


def _units_within(step: float, rates_hz: tuple[float, float]) -> list[str]:
    """Units of time in which a step gives a rate between two others [Hz]."""
    units = []
    for unit, seconds in TIME_UNITS.items():
        if rates_hz[0] <= 1.0 / (step * seconds) <= rates_hz[1]:
            units.append(unit)
    return units


# --- Other formats --------------------------------------------------------------------------------


def _inspect_other(path: Path, robot: RobotSpec | None, options: ReadOptions) -> LogGuess:
    """Read a log whose format names its columns; its unit is told by the values if need be."""
    questions: list[str] = []
    reasons: list[str] = []
    guessed = options
    log = None
    try:
        log = read_log(path, robot=robot, options=options, described=False)
    except NeedsOptionsError as error:
        if options.unit is None and "--unit" in error.question:
            guessed, log = _with_guessed_unit(path, robot, options, questions, reasons)
        else:
            questions.append(error.question)
    except PronkError as error:
        questions.append(str(error).removeprefix(f"{path}: ").rstrip("."))
    columns: list[GuessedColumn] = []
    if log is not None:
        metadata = log.origin.metadata
        if "measured_topic" in metadata:
            guessed = replace(
                guessed,
                measured_topic=metadata["measured_topic"],
                command_topic=metadata["command_topic"],
            )
        quantities = {"command": log.command, "position": log.position}
        for joint in log.joints:
            for quantity, table in quantities.items():
                values = table[:_SAMPLES, log.column(joint)]
                columns.append(
                    GuessedColumn(
                        name=joint,
                        reading=f"{quantity}.{joint}",
                        unit=log.unit(joint),
                        samples=tuple(f"{value:.6g}" for value in values),
                    )
                )
    return LogGuess(
        path=path,
        options=guessed,
        columns=tuple(columns),
        reasons=tuple(reasons),
        questions=tuple(questions),
        log=log if not questions else None,
    )


def _with_guessed_unit(
    path: Path,
    robot: RobotSpec | None,
    options: ReadOptions,
    questions: list[str],
    reasons: list[str],
) -> tuple[ReadOptions, JointLog | None]:
    """Options with the unit that the values show, and the log read with them."""
    in_degrees = replace(options, unit="deg")
    log = _read(path, robot, in_degrees, questions)
    if log is None:
        return options, None
    values = {}
    for joint in log.joints:
        column = log.column(joint)
        values[f"command.{joint}"] = np.rad2deg(log.command[:, column])
        values[f"position.{joint}"] = np.rad2deg(log.position[:, column])
    unit = unit_by_values(values, robot, questions, reasons)
    if not unit:
        return options, log
    guessed = replace(options, unit=unit)
    return guessed, _read(path, robot, guessed, questions)


def _read(
    path: Path, robot: RobotSpec | None, options: ReadOptions, questions: list[str]
) -> JointLog | None:
    """Read a log; what is in the way becomes a question."""
    try:
        return read_log(path, robot=robot, options=options, described=False)
    except NeedsOptionsError as error:
        questions.append(error.question)
    except PronkError as error:
        questions.append(str(error).removeprefix(f"{path}: ").rstrip("."))
    return None
