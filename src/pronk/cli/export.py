"""`pronk export`: the gains as configuration of a simulator."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from pronk.cli import console


class Target(StrEnum):
    """What reads the exported file."""

    MJLAB = "mjlab"
    MJCF = "mjcf"
    ISAACLAB = "isaaclab"


def export(
    gains: Annotated[Path, typer.Argument(help="gains.yaml of `pronk match`.")],
    to: Annotated[Target, typer.Option("--to", help="What shall read it.")],
    out: Annotated[Path, typer.Option("--out", help="The file to write.")],
    json_file: console.JsonOption = None,
) -> None:
    """Write matched gains as actuator configuration of mjlab, MuJoCo or Isaac Lab."""
    from pronk.files import write_text
    from pronk.match import gains as gains_file
    from pronk.match.export import export_text

    text = export_text(gains_file.load(gains), to.value)
    write_text(out, text)
    console.wrote(out)
    console.write_json(json_file, {"written": out, "to": to.value})
