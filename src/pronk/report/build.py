"""The page of everything that a folder and the folders in it hold, or of one deployment's log.

Parts without an artefact are left out; a damaged artefact is an error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from pronk.deploy.runtime.deploy_log import is_deploy_log
from pronk.errors import ArtefactError, LogError
from pronk.files import write_text
from pronk.jump.trial.results import SUMMARY
from pronk.report import deploy_page, match_page, trial_page
from pronk.report.page import Part, page

NAME = "report.html"
LOGS = "*.mcap"
KINDS: dict[str, Callable[[Path], Part]] = {
    SUMMARY: trial_page.part,
    LOGS: deploy_page.deploy_part,
    "match.npz": match_page.part,
}
"""How the part of each file is made, in the order of the page."""


def artefacts(root: Path, pattern: str) -> list[Path]:
    """Return the files below `root`, upper ones first."""
    if root.is_file():
        return [root] if pattern == LOGS else []
    found = [path for path in root.rglob(pattern) if path.is_file()]
    found = [path for path in found if pattern != LOGS or is_deploy_log(path)]
    return sorted(found, key=lambda path: (len(path.parts), path))


def write_artefact_page(artefact: Path) -> Path:
    """Write the page of one artefact beside it, for instance `match.html` of `match.npz`."""
    artefact_part = replace(KINDS[artefact.name](artefact), source=artefact.name)
    page_path = artefact.with_suffix(".html")
    write_text(page_path, page(artefact_part.title, [artefact_part]))
    return page_path


def write_report(
    root: Path, progress: Callable[[str, float], None] = lambda stage, share: None
) -> tuple[Path, list[Part]]:
    """Write the page of everything in `root`; return its path and its parts.

    `root` is a folder, which gets `report.html`, or the log of one deployment, which gets a page of
    its name beside it. What is missing or damaged is an ArtefactError or LogError.
    """
    if not root.exists():
        raise ArtefactError(
            f"{root}: no such folder; give one that `pronk match --out` or `pronk trial --out` "
            "wrote to, or the log of a deployment."
        )
    parts = []
    base = root if root.is_dir() else root.parent
    for n, (pattern, make) in enumerate(KINDS.items()):
        progress("report", n / len(KINDS))
        paths = artefacts(root, pattern)
        for i, path in enumerate(paths):
            where = path.relative_to(base)
            try:
                part = replace(make(path), source=str(where), number=i)
            except LogError:
                # A link that never opened leaves a log without a tick beside others with ticks.
                if len(paths) == 1:
                    raise
                continue
            if len(paths) > 1:
                own = where if pattern == LOGS else where.parent
                part = replace(part, title=f"{part.title}: {own}")
            parts.append(part)
    if not parts:
        raise ArtefactError(
            f"{root}: nothing to report; neither {SUMMARY} (`pronk trial POLICY --out DIR`) nor "
            "match.npz (`pronk match LOG... --out`) nor the log of a deployment (`pronk deploy "
            "--log`) is in it or in a folder in it."
        )
    written = root.with_suffix(".html") if root.is_file() else root / NAME
    write_text(written, page("report" if len(parts) > 1 else parts[0].title, parts))
    progress("report", 1.0)
    return written, parts
