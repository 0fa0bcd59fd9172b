"""Output of the commands: tables, progress, figures as JSON; confirmations before a robot moves.

Results go to standard output; progress and warnings go to standard error, so that a table can be
piped into a file.
"""

from __future__ import annotations

import json
import os
import select
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from pronk.errors import HardwareError
from pronk.files import write_text

if TYPE_CHECKING:
    from pronk.jump.trial.tables import Sheet

_LOOK_S = 0.2


def err() -> Console:
    """Standard error; made anew each time, so that a redirected stream is found."""
    return Console(stderr=True, highlight=False, soft_wrap=True)


def say(text: str) -> None:
    """Print one line to standard output."""
    Console(highlight=False, soft_wrap=True).print(text, markup=False)


def note(text: str, **look: Any) -> None:
    """Print one line to standard error."""
    err().print(text, markup=False, **look)


def warn(text: str) -> None:
    """Print a warning to standard error."""
    note(f"warning: {text}", style="yellow")


def following(*commands: str) -> None:
    """Print what to do next."""
    say("\n  ".join(("next:", *commands)))


JsonFile = Annotated[
    Path | None, tyro.conf.arg(name="json", help="Also write the figures to this file.")
]
"""The option `--json` of every command that returns an `Outcome`."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a command leaves when it has ended."""

    figures: Mapping[str, Any]
    """What `--json` writes; arrays become lists, and numbers that are not finite null."""
    wrote: Sequence[Path] = ()
    following: Sequence[str] = ()
    """Commands to run next."""
    status: int = 0

    def end(self, json_file: Path | None) -> int:
        """Print what was written and what to do next, write the figures; return the exit status."""
        for path in self.wrote:
            say(f"wrote {path}")
        if json_file is not None:
            encoded = msgspec.json.encode(dict(self.figures), enc_hook=_plain)
            write_text(json_file, json.dumps(msgspec.json.decode(encoded), indent=2) + "\n")
            say(f"wrote {json_file}")
        if self.following:
            following(*self.following)
        return self.status


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else os.fspath(value)


def table(
    title: str, columns: Iterable[str], rows: Iterable[Sequence[str]] = (), caption: str = ""
) -> Table:
    """Make a table of text without markup whose first column is a name, the others numbers."""
    made = Table(title=Text(title), title_style="bold", header_style="bold")
    made.caption = Text(caption) if caption else None
    made.title_justify = made.caption_justify = "left"
    for i, column in enumerate(columns):
        made.add_column(Text(column), justify="right" if i else "left", no_wrap=not i)
    for cells in rows:
        made.add_row(*map(Text, cells))
    return made


def show(made: Table) -> None:
    """Print a table; a stream that is not a terminal gets the width the table needs."""
    console = Console(highlight=False)
    (console if console.is_terminal else Console(highlight=False, width=200)).print(made)


def show_sheet(sheet: Sheet | None, title: str = "") -> None:
    """Print a table and its notes."""
    if sheet is not None:
        made = table(sheet.title or title, sheet.columns, sheet.rows)
        made.columns[-1].justify = "left" if sheet.columns[-1] == "equation" else "right"
        show(made)
        for note in sheet.notes:
            say(f"  {note}")


def show_table(columns: str, rows: Iterable[Sequence[Any]], *notes: str, title: str) -> None:
    """Print a table; arguments are those of `pronk.jump.trial.tables.table`."""
    from pronk.jump.trial.tables import table

    show_sheet(table(columns, rows, *notes, title=title))


def show_rows(title: str, columns: Mapping[str, str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Print some fields of rows: heading (and digits, as in `peak [dB];2`) to name of a field."""
    cells = [[row[name] for name in columns.values()] for row in rows]
    show_table(" | ".join(columns), cells, title=title)


class Reporter(Progress):
    """Progress of one command on standard error: named stages, each from 0 to 1."""

    def __call__(self, stage: str, share: float) -> None:
        """Set the share of `stage` that is done, 0 to 1."""
        known = [task.id for task in self.tasks if task.description == stage]
        task = known[0] if known else self.add_task(stage, total=1.0)
        self.update(task, completed=min(max(share, 0.0), 1.0))

    def bar(self, stage: str) -> Callable[[float], None]:
        """Begin a stage; the result sets its share."""
        self(stage, 0.0)
        return lambda share: self(stage, share)


def progress() -> Reporter:
    """Show progress inside a `with` block."""
    share = TextColumn("{task.percentage:>3.0f} %")
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), share)
    return Reporter(*columns, TimeElapsedColumn(), console=err())


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


class Person:
    """A person at the test rig who clamps joints and confirms it."""

    _fixed: tuple[str, ...] = ()

    def __call__(self, joints: tuple[str, ...]) -> None:
        """Have these joints clamped and all others freed; returns when they are."""
        if set(joints) == set(self._fixed):
            return
        free = [name for name in self._fixed if name not in joints]
        words = [f"fix {', '.join(joints)} mechanically where they are"] if joints else []
        words += [f"free {', '.join(free)}"] if free else []
        say(
            f"Please {', and '.join(words)}. The drives hold the pose meanwhile; keep "
            "clear of the legs afterwards. Press Enter when it is done."
        )
        # Polling lets a fault end the program meanwhile.
        while not select.select([sys.stdin], [], [], _LOOK_S)[0]:
            pass
        if not sys.stdin.readline():
            raise HardwareError(
                "standard input has ended, so no joint can be clamped; sweep joints that need no "
                "clamp (--joints), or run this from a terminal."
            )
        self._fixed = joints
