"""What every command shares: where words go, progress, figures as JSON, finding logs.

Results go to standard output; progress and warnings go to standard error, so that a table can be
piped into a file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

JsonFile = Annotated[Path | None, tyro.conf.arg(name="json")]


def out() -> Console:
    """Standard output. Made anew each time, so that a redirected stream is found."""
    return Console(highlight=False, soft_wrap=True)


def err() -> Console:
    """Standard error."""
    return Console(stderr=True, highlight=False, soft_wrap=True)


def say(text: str) -> None:
    """Print one line to standard output, as it stands."""
    out().print(text, markup=False)


def warn(text: str) -> None:
    """Print one line to standard error."""
    err().print(f"warning: {text}", markup=False, style="yellow")


def wrote(*paths: Path) -> None:
    """Say what was written."""
    for path in paths:
        say(f"wrote {path}")


def following(*commands: str) -> None:
    """Say what to do next."""
    say("next:")
    for command in commands:
        say(f"  {command}")


def table(title: str, *columns: str) -> Table:
    """A table whose first column is a name and whose others are numbers."""
    made = Table(title=Text(title), title_justify="left", title_style="bold", header_style="bold")
    for i, column in enumerate(columns):
        made.add_column(Text(column), justify="left" if i == 0 else "right", no_wrap=i == 0)
    return made


def row(made: Table, *cells: str) -> None:
    """Add a row; brackets in a cell are brackets, not markup."""
    made.add_row(*(Text(cell) for cell in cells))


def show(made: Table) -> None:
    """Print a table; a stream that is not a terminal gets the width the table needs."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=160)
    console.print(made)


def number(value: float, digits: int = 2) -> str:
    """A number for a table; a dash where it is unknown."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _plain(value: Any) -> Any:
    """Numbers, text, lists and mappings that strict JSON can hold; unknown numbers are null."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_json(path: Path | None, figures: dict[str, Any]) -> None:
    """Write a command's figures, if a file was requested."""
    if path is None:
        return
    from pronk.files import write_text

    write_text(path, json.dumps(_plain(figures), indent=2, allow_nan=False) + "\n")
    wrote(path)


class Reporter:
    """Progress of one command: named stages, each from 0 to 1."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._tasks: dict[str, Any] = {}

    def __call__(self, stage: str, share: float) -> None:
        """Tell that `stage` has come as far as `share`, 0 to 1."""
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(stage, total=1.0)
        self._progress.update(self._tasks[stage], completed=min(max(share, 0.0), 1.0))

    def bar(self, stage: str) -> Callable[[float], None]:
        """The same for one stage, as a function of the share alone."""
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
    with Progress(*columns, console=err()) as shown:
        yield Reporter(shown)
