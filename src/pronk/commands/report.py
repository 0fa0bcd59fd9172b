"""`pronk report`: one HTML page of what a folder holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pronk.commands import console


def report(
    folder: Annotated[Path, typer.Argument(help="Folder with gains.yaml and match.npz.")],
    json_file: console.JsonOption = None,
) -> None:
    """Write one HTML page of a match; it opens without a network."""
    from pronk.match import gains as gains_file
    from pronk.match import result as result_file
    from pronk.report.page import find_gains, verdict, write_page

    with console.progress() as shown:
        bar = shown.bar("page")
        page = write_page(folder)
        bar(1.0)
    found = result_file.load(folder / "match.npz", gains_file.load(find_gains(folder)))
    console.wrote(page)
    console.write_json(json_file, {"page": page} | verdict(found))
    console.following(f"open {page} in a browser")
