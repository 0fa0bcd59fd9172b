"""`pronk report`: one HTML page of everything that a folder holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pronk.commands import console


def report(
    folder: Annotated[
        Path, typer.Argument(help="Folder that matches and trials were written to, or one above.")
    ],
    json_file: console.JsonOption = None,
) -> None:
    """Write one HTML page of every match and trial in a folder; it opens without a network."""
    from pronk.report import whole

    with console.progress() as shown:
        page, found = whole.write_report(folder, shown)
    console.wrote(page)
    console.write_json(
        json_file,
        {"page": page, "parts": [{"source": one.source, **one.figures} for one in found]},
    )
    console.following(f"open {page} in a browser")
