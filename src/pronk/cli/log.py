"""`pronk log`: guess how a log is read, and write it down beside the log."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from pronk.cli import console
from pronk.cli.options import Reading
from pronk.errors import LogError
from pronk.tables import Column, Table

if TYPE_CHECKING:
    from pronk.identify.logs.inspection import LogGuess

LogAction = Literal["inspect"]


def log(
    action: tyro.conf.Positional[LogAction],
    path: tyro.conf.Positional[Path],
    robot: str | None = None,
    yes: bool = False,
    reading: Reading = Reading(),  # noqa: B008
) -> console.Outcome:
    """Guess how a log is read, show it, and write it beside the log for every later command.

    Columns, units, rate and joints are told by names and values. Where two readings are plausible
    both are named, and an option decides.

    Example:
        pronk log inspect chirp.csv --robot robot.yaml --unit deg --yes

    Args:
        action: inspect: guess, show, and with --yes write chirp.log.yaml beside chirp.csv.
        path: The log.
        robot: A name, or a path to a robot.yaml, MJCF or URDF, for the names of the joints.
        yes: Write the description.
        reading: How logs are read; what is stated is not guessed.
    """
    from pronk.identify.logs.description import description_path, write_description
    from pronk.identify.logs.inspection import inspect_log
    from pronk.robots import load_robot

    robot_spec = load_robot(robot) if robot else None
    guess = inspect_log(path, robot_spec, reading.options())
    console.show(guess_table(guess))
    for reason in guess.reasons:
        console.say(f"note: {reason}")
    excited: tuple[str, ...] = ()
    if guess.log is not None:
        excited = guess.log.excited_joints
        for remark in guess.log.notes:
            console.say(f"note: {remark}")
        console.say(f"excited: {', '.join(excited) or 'no joint'}")
    figures = {
        "columns": {column.name: column.reading for column in guess.columns if column.reading},
        "unit": guess.options.unit,
        "time_unit": guess.options.time_unit,
        "questions": guess.questions,
        "excited": excited,
    }
    if guess.questions:
        for question in guess.questions:
            console.say(f"open: {question}")
        if yes:
            raise LogError(
                f"{path}: nothing was written, as not everything can be told: "
                f"{'; '.join(guess.questions)}."
            )
        return console.Outcome(figures=figures)
    robot_words = f" --robot {shlex.quote(robot)}" if robot else ""
    command = f"pronk response {shlex.quote(str(path))}{robot_words}"
    if not yes:
        repeated = f"pronk log inspect {shlex.quote(str(path))}{robot_words}{reading.words()} --yes"
        console.say(f"nothing was written; --yes writes {description_path(path)}")
        return console.Outcome(figures=figures, following=[repeated])
    written = write_description(path, guess.options)
    return console.Outcome(figures=figures, wrote=[written], following=[command])


def guess_table(guess: LogGuess) -> Table:
    """Return the table of a guess: each column with what it is taken for and its first values."""
    rows = []
    for column in guess.columns:
        samples = [*column.samples, "", "", ""][:3]
        reading = column.reading or "not read"
        rows.append((column.name, reading, column.unit or None, *samples))
    return Table(
        title=f"Guess at {guess.path.name} ({guess.options.format})",
        columns=(
            Column(heading="in the file"),
            Column(heading="read as"),
            Column(heading="unit"),
            Column(heading="1st row"),
            Column(heading="2nd row"),
            Column(heading="3rd row"),
        ),
        rows=tuple(rows),
    )
