"""`pronk report`: one HTML page of everything that a folder holds, or of one deployment's log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pronk.cli import console


def report(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder that matches and trials were written to, or one above; or the log of a "
            "deployment, .mcap."
        ),
    ],
    json_file: console.JsonOption = None,
) -> None:
    """Write one HTML page of all matches, trials and deployments in a folder, or of one log."""
    from pronk.report import whole

    with console.progress() as shown:
        page, found = whole.write_report(folder, shown)
    console.wrote(page)
    console.write_json(
        json_file,
        {"page": page, "parts": [{"source": one.source, **one.figures} for one in found]},
    )
    console.following(f"open {page} in a browser")
