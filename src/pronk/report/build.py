"""One page of everything that a folder and the folders in it hold.

What is looked for, and by which file: trials (`summary.json`), what was tried beside the jumps
(`walk.json`, `crossing.json`, `variation.json`, `bodies.json`), logs of deployments (`*.mcap`) and
matches (`match.npz`). Parts that are not there are left out; one that is damaged is an error, since
a page that silently lacks it would be read as whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from pronk.errors import ArtefactError, LogError
from pronk.evaluation import bodies, results
from pronk.evaluation.bodies import Bodies
from pronk.evaluation.criteria import trial_checks
from pronk.evaluation.crossing import CROSSING
from pronk.evaluation.results import SUMMARY, Results
from pronk.evaluation.variation import VARIATION
from pronk.evaluation.walk import WALK
from pronk.files import write_text
from pronk.match import gains as gains_file
from pronk.match import result as result_file
from pronk.report import deploy_page, match_page, trial_page
from pronk.report.extra_pages import bodies_part, crossing_part, variation_part, walk_part
from pronk.report.shell import Part, page
from pronk.runtime.log import is_deploy_log

NAME = "report.html"


@dataclass(frozen=True, kw_only=True)
class Found:
    """Something that was found, read, and can be drawn."""

    source: str
    """The file, below the folder of the page."""
    virtual: bool
    """Measured on the virtual robot."""
    draw: Callable[[], Part]
    figures: Mapping[str, Any] = field(default_factory=dict)
    """What `--json` gives of it."""


def folders(root: Path, name: str) -> list[Path]:
    """Folders below `root`, itself included, that hold a file of this name; upper ones first.

    What belongs to a `bodies.json` is left to the part that is made of that.
    """
    inside = {path.parent / bodies.FOLDER for path in root.rglob(bodies.FILE)}
    found = [
        path.parent
        for path in root.rglob(name)
        if path.is_file() and inside.isdisjoint(path.parents)
    ]
    return sorted(found, key=lambda path: (len(path.parts), path))


def _named(root: Path, name: str, anchor: str) -> Iterator[tuple[Path, str, str, str]]:
    """Folder, source, anchor, and what to add to the title, for every file of one name."""
    found = folders(root, name)
    for i, folder in enumerate(found):
        where = str(folder.relative_to(root)) if folder != root else "here"
        added = f": {where}" if len(found) > 1 else ""
        yield folder, str((folder / name).relative_to(root)), f"{anchor}{i or ''}", added


def _trials(root: Path, progress: Callable[[float], None]) -> Iterator[Found]:
    for folder, source, anchor, added in _named(root, SUMMARY, "trial"):
        material = trial_page.read(folder, root, progress)
        yield Found(
            source=source,
            virtual=material.trial.virtual,
            draw=partial(trial_page.part, material, anchor=anchor, title=f"Trial{added}"),
            figures={"checks": [check.row() for check in trial_checks(material.trial)]},
        )


R = TypeVar("R", Results, Bodies)


def _extra(
    root: Path,
    anchor: str,
    title: str,
    file: str,
    load: Callable[[Path], R],
    make: Callable[..., Part],
) -> Iterator[Found]:
    """What was tried beside the jumps, from every file of one kind.

    Args:
        root: Where to look.
        anchor: What the anchors of the parts begin with.
        title: Of the parts.
        file: Name of the files.
        load: Reads one, from its folder.
        make: Makes the part of what was read.
    """
    for folder, source, name, added in _named(root, file, anchor):
        read = load(folder)
        yield Found(
            source=source,
            virtual=read.virtual,
            draw=partial(make, read, anchor=name, title=f"{title}{added}"),
        )


def _extras(root: Path) -> Iterator[Found]:
    for anchor, title, kind, make in (
        ("walk", "Walking", WALK, walk_part),
        ("crossing", "Crossing gaps and steps", CROSSING, crossing_part),
        ("variation", "Variation", VARIATION, variation_part),
    ):
        load = partial(results.load, kind=kind)
        yield from _extra(root, anchor, title, kind.summary, load, make)
    yield from _extra(root, "bodies", "Randomized robots", bodies.FILE, bodies.load, bodies_part)


def _matches(root: Path) -> Iterator[Found]:
    for folder, source, anchor, added in _named(root, "match.npz", "match"):
        path = match_page.find_gains(folder)
        result = result_file.load(folder / "match.npz", gains_file.load(path))
        yield Found(
            source=source,
            virtual=result.gains.virtual,
            draw=partial(
                match_page.part,
                result,
                folder,
                path.name,
                anchor=anchor,
                title=f"Match of {result.gains.robot}{added}",
            ),
            figures=match_page.verdict(result),
        )


def _deployments(root: Path) -> Iterator[Found]:
    """Of the logs in a folder, or of one log."""
    logs = [root] if root.is_file() else sorted(filter(is_deploy_log, root.rglob("*.mcap")))
    for i, path in enumerate(logs):
        source = path.name if root.is_file() else str(path.relative_to(root))
        try:
            material = deploy_page.read(path)
        except LogError:
            # A link that never opened leaves a log without a tick beside others that have some.
            if len(logs) == 1:
                raise
            continue
        title = f"Deployment: {source}" if len(logs) > 1 else "Deployment"
        yield Found(
            source=source,
            virtual=material.log.virtual,
            draw=partial(deploy_page.part, material, anchor=f"deploy{i or ''}", title=title),
            figures=deploy_page.figures(material),
        )


def find(root: Path, progress: Callable[[float], None] = lambda share: None) -> list[Found]:
    """Everything in the folder tree that can be drawn, read and in the order of the page.

    Args:
        root: The folder, or the log of one deployment.
        progress: Called with the share of a trial's captures that is read, 0 to 1.

    Raises:
        ArtefactError: No such folder, nothing in it, or something damaged.
        LogError: A damaged log, or a file that is none of a deployment.
    """
    if root.is_file():
        return list(_deployments(root))
    if not root.is_dir():
        raise ArtefactError(
            f"{root}: no such folder; give one that `pronk match --out` or `pronk trial --out` "
            "wrote to, or the log of a deployment."
        )
    # Captures are the slowest to read: what is small is read first.
    matches, extras = list(_matches(root)), list(_extras(root))
    deployments = list(_deployments(root))
    found = [*_trials(root, progress), *extras, *deployments, *matches]
    if not found:
        raise ArtefactError(
            f"{root}: nothing to report; neither {SUMMARY} (`pronk trial POLICY --out DIR`) nor "
            "match.npz (`pronk match LOG... --out`) nor the log of a deployment (`pronk deploy "
            "--log`) is in it or in a folder in it."
        )
    return found


def write_report(
    root: Path, progress: Callable[[str, float], None] = lambda stage, share: None
) -> tuple[Path, list[Found]]:
    """Write the page of everything in `root`; returns its path and what is on it.

    Args:
        root: The folder, which gets `report.html`, or the log of one deployment, which gets a page
            of its name beside it.
        progress: Called with the stage, `read` or `draw`, and the share of it that is done, 0 to 1.

    Raises:
        ArtefactError: As `find`.
        LogError: The same.
    """
    progress("read", 0.0)
    found = find(root, partial(progress, "read"))
    progress("read", 1.0)
    parts = []
    for i, one in enumerate(found):
        progress("draw", i / len(found))
        parts.append(one.draw())
    written = root.with_suffix(".html") if root.is_file() else root / NAME
    write_text(
        written,
        page(
            "report" if len(parts) > 1 else parts[0].title,
            parts,
            virtual=any(one.virtual for one in found),
            sub="From the sweep to the jump: what was measured, and what it rests on.",
            made_from=", ".join(one.source for one in found),
        ),
    )
    progress("draw", 1.0)
    return written, found
