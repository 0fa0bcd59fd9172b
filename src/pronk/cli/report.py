"""`pronk report`: one HTML page of everything that a folder holds, or of one deployment's log."""

from __future__ import annotations

from pathlib import Path

import tyro

from pronk.cli import console


def report(folder: tyro.conf.Positional[Path]) -> console.Outcome:
    """Write one HTML page of all matches, trials and deployments in a folder, or of one log.

    Example:
        pronk report out

    Args:
        folder: Folder that matches and trials were written to, or one above; or the log
            of a deployment, .mcap.
    """
    from pronk.report import build

    with console.progress() as progress:
        page, parts = build.write_report(folder, progress)
    part_figures = [{"source": part.source, **part.figures} for part in parts]
    return console.Outcome(
        figures={"page": page, "parts": part_figures},
        wrote=[page],
        following=[f"open {page} in a browser"],
    )
