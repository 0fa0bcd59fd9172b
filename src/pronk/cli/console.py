"""Output of the commands: tables, progress, figures as JSON; confirmations before a robot moves.

Results go to standard output; progress and warnings go to standard error, so that a table can be
piped into a file.
"""

from __future__ import annotations

import json
import math
import select
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from pronk.errors import HardwareError

if TYPE_CHECKING:
    from pronk.evaluation.tables import Sheet

JsonFile = Annotated[Path | None, tyro.conf.arg(name="json")]

_LOOK_S = 0.2


def out() -> Console:
    """Standard output; made anew each time, so that a redirected stream is found."""
    return Console(highlight=False, soft_wrap=True)


def err() -> Console:
    """Standard error."""
    return Console(stderr=True, highlight=False, soft_wrap=True)


def say(text: str) -> None:
    """Print one line to standard output."""
    out().print(text, markup=False)


def warn(text: str) -> None:
    """Print one line to standard error."""
    err().print(f"warning: {text}", markup=False, style="yellow")


def wrote(*paths: Path) -> None:
    """Print what was written."""
    for path in paths:
        say(f"wrote {path}")


def following(*commands: str) -> None:
    """Print what to do next."""
    say("\n  ".join(("next:", *commands)))


def table(title: str, *columns: str, rows: Iterable[Sequence[str]] = ()) -> Table:
    """Make a table whose first column is a name and whose others are numbers."""
    made = Table(title=Text(title), title_justify="left", title_style="bold", header_style="bold")
    for i, column in enumerate(columns):
        made.add_column(Text(column), justify="right" if i else "left", no_wrap=not i)
    for cells in rows:
        row(made, *cells)
    return made


def row(made: Table, *cells: str) -> None:
    """Add a row; brackets in a cell are not markup."""
    made.add_row(*(Text(cell) for cell in cells))


def show(made: Table) -> None:
    """Print a table; a stream that is not a terminal gets the width the table needs."""
    console = Console(highlight=False)
    (console if console.is_terminal else Console(highlight=False, width=200)).print(made)


def show_sheet(sheet: Sheet | None, title: str = "") -> None:
    """Print a table of the report package and its notes."""
    if sheet is not None:
        made = table(sheet.title or title, *sheet.columns, rows=sheet.rows)
        made.columns[-1].justify = "left" if sheet.columns[-1] == "equation" else "right"
        show(made)
        for note in sheet.notes:
            say(f"  {note}")


def show_rows(title: str, columns: Mapping[str, str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Print some fields of rows: heading (and digits, as in `peak [dB];2`) to name of a field."""
    from pronk.report.page import table

    cells = [[row[name] for name in columns.values()] for row in rows]
    show_sheet(table(" | ".join(columns), cells, title=title))


def number(value: float, digits: int = 2) -> str:
    """Format a number; a dash where it is unknown."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _plain(value: Any) -> Any:
    """Convert to what strict JSON can hold; numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def write_json(path: Path | None, figures: Mapping[str, Any]) -> None:
    """Write a command's figures, if a file was requested."""
    if path is not None:
        from pronk.files import write_text

        write_text(path, json.dumps(_plain(dict(figures)), indent=2, allow_nan=False) + "\n")
        wrote(path)


class Reporter:
    """Progress of one command: named stages, each from 0 to 1."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._tasks: dict[str, Any] = {}

    def __call__(self, stage: str, share: float) -> None:
        """Set the share of `stage` that is done, 0 to 1."""
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(stage, total=1.0)
        self._progress.update(self._tasks[stage], completed=min(max(share, 0.0), 1.0))

    def bar(self, stage: str) -> Callable[[float], None]:
        """Begin a stage; the result sets its share."""
        self(stage, 0.0)
        return lambda share: self(stage, share)


@contextmanager
def progress() -> Iterator[Reporter]:
    """Show progress on standard error inside the block."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=err()) as bars:
        yield Reporter(bars)


def confirm(robot: str, where: str) -> None:
    """Have the robot's name typed before a real one moves.

    Raises:
        HardwareError: Another word was typed.
    """
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

    def __init__(self) -> None:
        """No joint is clamped yet."""
        self._fixed: tuple[str, ...] = ()

    def __call__(self, joints: tuple[str, ...]) -> None:
        """Have these joints clamped and all others freed; returns when they are.

        Raises:
            HardwareError: Standard input has ended.
        """
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
