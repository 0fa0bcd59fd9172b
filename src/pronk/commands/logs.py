"""Options that say how logs are to be read, the same for every command that reads them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pronk.errors import LogError

if TYPE_CHECKING:
    from pronk.robots.robot import Robot
    from pronk.sweep.log import SweepLog

LogsArgument = Annotated[
    list[Path], typer.Argument(help="Logs; a folder means all logs in it.", metavar="LOG...")
]
RobotOption = Annotated[str, typer.Option("--robot", help="Robot, for instance mini_cheetah.")]
