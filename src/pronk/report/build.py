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
from pronk.jump.study.study_results import STUDY_FILE
from pronk.jump.trial.results import SUMMARY
from pronk.progress import Progress, no_progress
from pronk.report import deploy_page, match_page, study_page, trial_page
from pronk.report.page import Part, page

PAGE_NAME = "report.html"
LOGS = "*.mcap"
PART_MAKERS: dict[str, Callable[[Path], Part]] = {
    "match.npz": match_page.match_part,
    SUMMARY: trial_page.trial_part,
    STUDY_FILE: study_page.study_part,
    LOGS: deploy_page.deploy_part,
}
"""How the part of each file is made, in the order of the page."""


def artefacts(root: Path, pattern: str) -> list[Path]:
    """Return the files of a pattern in a folder and the folders in it, upper ones first.

    Of `*.mcap` files those of deployments are returned; a log given by itself is returned as it is.
    """
    if root.is_file():
        return [root] if pattern == LOGS else []
    paths = []
    for path in root.rglob(pattern):
        if path.is_file() and (pattern != LOGS or is_deploy_log(path)):
            paths.append(path)
    return sorted(paths, key=lambda path: (len(path.parts), path))


def write_artefact_page(artefact: Path) -> Path:
    """Write the page of one artefact beside it, for instance `match.html` of `match.npz`."""
    part = replace(PART_MAKERS[artefact.name](artefact), source=artefact.name)
    page_path = artefact.with_suffix(".html")
    write_text(page_path, page(part.title, [part]))
    return page_path


def write_report(root: Path, progress: Progress = no_progress) -> tuple[Path, list[Part]]:
    """Write the page of everything in a folder.

    Args:
        root: A folder, which gets `report.html`, or the log of one deployment, which gets a page of
            its name beside it.
        progress: Called with the stage and the share of it that is done, 0 to 1.

    Returns:
        The path of the page, and its parts.

    Raises:
        ArtefactError: There is nothing to report, or an artefact is damaged.
        LogError: The log is damaged, or has no tick.
    """
    if not root.exists():
        raise ArtefactError(
            f"{root}: no such folder; give one that `pronk match --out` or `pronk trial --out` "
            "wrote to, or the log of a deployment."
        )
    parts: list[Part] = []
    for number, pattern in enumerate(PART_MAKERS):
        progress("report", number / len(PART_MAKERS))
        parts += _parts(root, pattern)
    if not parts:
        raise ArtefactError(
            f"{root}: nothing to report; neither {SUMMARY} (`pronk trial POLICY --out DIR`) nor "
            f"{STUDY_FILE} (`pronk study FILE --out DIR`) nor match.npz (`pronk match LOG... "
            "--out`) nor the log of a deployment (`pronk deploy --log`) is in it or in a folder in "
            "it."
        )
    page_path = root.with_suffix(".html") if root.is_file() else root / PAGE_NAME
    title = parts[0].title if len(parts) == 1 else "report"
    write_text(page_path, page(title, parts))
    progress("report", 1.0)
    return page_path, parts


def _parts(root: Path, pattern: str) -> list[Part]:
    """Make the part of each artefact of a pattern; several are told apart by their paths."""
    base = root if root.is_dir() else root.parent
    paths = artefacts(root, pattern)
    parts = []
    for number, path in enumerate(paths):
        relative = path.relative_to(base)
        try:
            part = PART_MAKERS[pattern](path)
        except LogError:
            # A link that never opened leaves a log without a tick beside others with ticks.
            if len(paths) == 1:
                raise
            continue
        title = part.title
        if len(paths) > 1:
            title = f"{title}: {relative if pattern == LOGS else relative.parent}"
        parts.append(replace(part, title=title, source=str(relative), number=number))
    return parts
