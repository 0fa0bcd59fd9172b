"""Output of the commands: tables, progress, figures as JSON; confirmations before a robot moves.

Results go to standard output. Progress and warnings go to standard error, so that a table can be
piped into a file.
"""

from __future__ import annotations

import errno
import json
import math
import os
import select
import sys
import textwrap
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table as RichTable
from rich.text import Text

from pronk.errors import HardwareError
from pronk.exit_status import ExitStatus
from pronk.files import write_text
from pronk.robots import ROBOT_NAMES
from pronk.tables import Column, Table

_PIPED_WIDTH = 200
"""Characters of a line where standard output is not a terminal."""
_LONG_TEXT = 24
"""Characters of a cell from which on a column of text is set to the left and may be folded."""
_HEADING_WIDTH = 10
"""Characters of a line of a heading at least."""
_BETWEEN_COLUMNS = 2
"""Characters between two columns."""
_LINE_S = 60.0
"""Time between two lines of progress where standard error is not a terminal [s]."""
_POLL_S = 0.2
"""Time between two looks at standard input while a person works at the rig [s]."""


class PipeConsole(Console):
    """A console that lets the caller know that the reader of a pipe has closed it."""

    def on_broken_pipe(self) -> None:
        """Raise the error again: rich would end the program with a status of its own."""
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))


def err() -> Console:
    """Return standard error, made anew each time, so that a redirected stream is found."""
    return PipeConsole(stderr=True, highlight=False, soft_wrap=True)


def say(text: str) -> None:
    """Print a sentence to standard output; a terminal gets it in lines that fit."""
    console = PipeConsole(highlight=False, soft_wrap=True)
    for line in _fitting_lines(text, console):
        console.print(line, markup=False)


def say_verbatim(text: str) -> None:
    """Print a line that is copied, such as a command, to standard output in one piece."""
    PipeConsole(highlight=False, soft_wrap=True).print(text, markup=False)


def note(text: str, style: str | None = None) -> None:
    """Print a sentence to standard error; a terminal gets it in lines that fit."""
    console = err()
    for line in _fitting_lines(text, console):
        console.print(line, markup=False, style=style)


def warn(text: str) -> None:
    """Print a warning to standard error."""
    note(f"warning: {text}", style="yellow")


def robot_words(robot: str | None) -> list[str]:
    """Return the option that names a robot to a command which finds only its name in a policy.

    Args:
        robot: A robot, as of `load_robot`; None for the one that a command takes without it.
    """
    if robot is None or robot in ROBOT_NAMES:
        return []
    return ["--robot", robot]


def following(*commands: str) -> None:
    """Print what to do next."""
    say_verbatim("\n  ".join(("next:", *commands)))


JsonFile = Annotated[
    Path | None, tyro.conf.arg(name="json", help="Also write the figures to this file.")
]
"""The option `--json` of every command that returns an `Outcome`."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of a command that has ended."""

    figures: Mapping[str, Any]
    """Numbers that `--json` writes; arrays become lists, and numbers that are not finite null."""
    wrote: Sequence[Path] = ()
    """Files that were written."""
    pages_of: Sequence[Path] = ()
    """Artefacts whose pages are written when the command has ended, for instance `match.npz`."""
    following: Sequence[str] = ()
    """Commands to run next."""
    status: ExitStatus = ExitStatus.DONE
    """Exit status."""

    def end(self, json_file: Path | None) -> int:
        """Print what was written and what to do next, write the figures; return the exit status."""
        for path in self.wrote:
            say_verbatim(f"wrote {path}")
        if json_file is not None:
            encoded = msgspec.json.encode(dict(self.figures), enc_hook=_json_value)
            write_text(json_file, json.dumps(msgspec.json.decode(encoded), indent=2) + "\n")
            say_verbatim(f"wrote {json_file}")
        if self.following:
            following(*self.following)
        return self.status


def _json_value(value: Any) -> Any:
    """Return arrays as lists and paths as text."""
    return value.tolist() if hasattr(value, "tolist") else os.fspath(value)


def show(table: Table, *, wide: bool = False) -> None:
    """Print a table and its notes so that nothing is cut, whatever the width of the terminal.

    Columns that do not fit beside the others stand below them, with the first column again. A
    stream that is not a terminal has lines of 200 characters, unless the variable COLUMNS says how
    long they are.

    Args:
        table: The table.
        wide: True to print the columns that are details as well.
    """
    if not wide:
        if table.is_detail:
            return
        table = table.without_details()
    console = PipeConsole(highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console = PipeConsole(highlight=False, width=_PIPED_WIDTH)
    console.print(Text(table.title, style="bold"))
    for number, block in enumerate(column_blocks(table, console.width)):
        if number > 0:
            console.print()
        console.print(_rich_table(block))
    for sentence in table.notes:
        for line in _fitting_lines(sentence, console, indent=2):
            say(line)


def column_blocks(table: Table, width: int) -> list[Table]:
    """Return a table as one or more that are no wider than a terminal.

    Each begins with the first column of the table. A single column that is wider by itself is
    folded when it is printed.

    Args:
        table: The table.
        width: Characters of a line.
    """
    text_rows = table.text_rows()
    widths = []
    for index, column in enumerate(table.columns):
        cells = [text_row[index] for text_row in text_rows]
        widths.append(_least_width(column, cells, is_name=index == 0))
    blocks: list[list[int]] = []
    used = width + 1
    for index in range(1, len(table.columns)):
        if used + _BETWEEN_COLUMNS + widths[index] > width:
            blocks.append([0])
            used = widths[0]
        blocks[-1].append(index)
        used += _BETWEEN_COLUMNS + widths[index]
    if len(blocks) < 2:
        return [table]
    return [table.with_columns(block) for block in blocks]


def _least_width(column: Column, cells: Sequence[str], *, is_name: bool) -> int:
    """Return how many characters a column needs; a name or a long text may be folded at spaces."""
    longest = max(map(len, cells), default=0)
    heading = textwrap.wrap(column.heading, max(longest, _HEADING_WIDTH), break_long_words=False)
    heading_width = max(map(len, heading), default=0)
    if column.unit:
        heading_width = max(heading_width, len(f"[{column.unit}]"))
    if not is_name and longest <= _LONG_TEXT:
        return max(heading_width, longest)
    return max(heading_width, _longest_word(cells), min(longest, _LONG_TEXT))


def _longest_word(cells: Sequence[str]) -> int:
    """Return the characters of the longest word in some cells."""
    longest = 0
    for cell in cells:
        for word in cell.split():
            longest = max(longest, len(word))
    return longest


def _rich_table(table: Table) -> RichTable:
    """Return a table as it is printed below its title."""
    rich_table = RichTable(
        header_style="bold",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
        show_edge=False,
    )
    text_rows = table.text_rows()
    for index, column in enumerate(table.columns):
        is_name = index == 0
        cells = [text_row[index] for text_row in text_rows]
        longest = max(map(len, cells), default=0)
        is_long = longest > _LONG_TEXT
        heading = textwrap.fill(
            column.heading, max(longest, _HEADING_WIDTH), break_long_words=False
        )
        if column.unit:
            heading += f"\n[{column.unit}]"
        rich_table.add_column(
            Text(heading),
            justify="left" if is_name or is_long else "right",
            overflow="fold",
            no_wrap=not (is_name or is_long),
            min_width=_longest_word([*cells, *heading.split()]),
        )
    for text_row in text_rows:
        rich_table.add_row(*map(Text, text_row))
    return rich_table


def _fitting_lines(text: str, console: Console, indent: int = 0) -> list[str]:
    """Return a sentence as lines that fit a terminal; as one line where there is none.

    Words are not broken, so that a path can be copied.
    """
    space = indent * " "
    if not console.is_terminal:
        return [f"{space}{text}"]
    lines = []
    for line in text.split("\n"):
        lines += textwrap.wrap(
            line,
            console.width,
            initial_indent=space,
            subsequent_indent=space,
            break_long_words=False,
            break_on_hyphens=False,
        ) or [""]
    return lines


class LiveTable:
    """A table on standard error that changes in place; without a terminal, a line now and then."""

    def __init__(self) -> None:
        self._live: Live | None = None
        self._said_at = -math.inf

    def __enter__(self) -> LiveTable:
        """Begin to show."""
        console = err()
        if console.is_terminal:
            self._live = Live(console=console, auto_refresh=False, transient=True)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the table from the terminal."""
        if self._live is not None:
            self._live.stop()

    def update(self, line: str, table: Callable[[int], Table]) -> None:
        """Show how far the work is.

        Args:
            line: What a stream without a terminal gets, once every `_LINE_S`.
            table: Makes the table, of the number of rows at most that it is given.
        """
        moment = time.monotonic()
        if self._live is None:
            if moment - self._said_at >= _LINE_S:
                self._said_at = moment
                note(line)
            return
        if moment - self._said_at < 1.0:
            return
        self._said_at = moment
        rows = max(self._live.console.size.height - 6, 3)
        self._live.update(Group(_rich_table(table(rows)), Text(line)), refresh=True)


class Reporter(Progress):
    """Progress of one command on standard error: named stages, each from 0 to 1."""

    def __call__(self, stage: str, share: float) -> None:
        """Set the share of a stage that is done, 0 to 1."""
        task_id = None
        for task in self.tasks:
            if task.description == stage:
                task_id = task.id
        if task_id is None:
            task_id = self.add_task(stage, total=1.0)
        self.update(task_id, completed=min(max(share, 0.0), 1.0))

    def bar(self, stage: str) -> Callable[[float], None]:
        """Begin a stage; return a function that sets its share."""
        self(stage, 0.0)
        return lambda share: self(stage, share)


def progress() -> Reporter:
    """Show progress inside a `with` block."""
    return Reporter(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        console=err(),
    )


def confirm(robot: str, where: str) -> None:
    """Have the robot's name typed before a real one moves; HardwareError for another word."""
    say(
        f"A real {robot} at {where} is about to move. Keep people out of its reach; the first "
        "time, hang it up."
    )
    try:
        typed = input(f"Type the robot's name ({robot}) to go on: ").strip()
    except EOFError:
        typed = ""
    if typed != robot:
        raise HardwareError(f"that was not {robot!r}; nothing was moved.")


class RigOperator:
    """A person at the test rig who clamps joints and confirms it."""

    def __init__(self) -> None:
        self._clamped: tuple[str, ...] = ()

    def __call__(self, joints: tuple[str, ...]) -> None:
        """Have these joints clamped and all others freed; return when they are.

        Raises:
            HardwareError: Standard input has ended.
        """
        if set(joints) == set(self._clamped):
            return
        instructions = []
        if joints:
            instructions.append(f"fix {', '.join(joints)} mechanically where they are")
        to_free = [name for name in self._clamped if name not in joints]
        if to_free:
            instructions.append(f"free {', '.join(to_free)}")
        say(
            f"Please {', and '.join(instructions)}. The drives hold the pose meanwhile; keep "
            "clear of the legs afterwards. Press Enter when it is done."
        )
        # Polling lets a fault end the program meanwhile.
        while not select.select([sys.stdin], [], [], _POLL_S)[0]:
            pass
        if not sys.stdin.readline():
            raise HardwareError(
                "standard input has ended, so no joint can be clamped; sweep joints that need no "
                "clamp (--joints), or run this from a terminal."
            )
        self._clamped = joints
