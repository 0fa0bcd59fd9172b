"""Parts of a page for what else was tried: a verdict, and blocks of figures and tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from pronk.evaluation.bodies import Bodies
from pronk.evaluation.metrics import Figure
from pronk.evaluation.results import Results
from pronk.evaluation.tables import Sheet
from pronk.report import shell
from pronk.report.shell import Part, Picture


@dataclass(frozen=True, kw_only=True)
class Block:
    """A section: words, a picture, tables."""

    anchor: str
    title: str
    lines: tuple[str, ...] = ()
    picture: Picture | None = None
    sheets: tuple[Sheet, ...] = ()
    folded: tuple[Sheet, ...] = ()
    """Tables that open when asked for."""


def place(origin: Results | Bodies) -> str:
    """Where it was measured, in words."""
    return "virtual robot" if origin.virtual else "robot"


def part(
    blocks: Sequence[Block],
    *,
    anchor: str,
    title: str,
    says: str,
    origin: Results | Bodies,
    lines: Iterable[str] = (),
    doubt: bool = False,
    definitions: Iterable[Figure] = (),
) -> Part:
    """Put a part together.

    Args:
        blocks: Its sections.
        anchor: What the anchors of the part begin with.
        title: Of the part.
        says: The verdict, one sentence.
        origin: Where the numbers come from.
        lines: Below the verdict.
        doubt: The verdict is not what was hoped for.
        definitions: Of its figures.
    """
    versions = ", ".join(f"{name} {version}" for name, version in origin.versions.items())
    hashes = ", ".join(f"{subject.name} {subject.sha256[:12]}" for subject in origin.subjects)
    body = str(origin.sim_params.get("sha256", "unknown"))[:12]
    html = shell.fill(
        "extra.html.j2",
        at=f"{anchor}-" if anchor else "",
        says=says,
        lines=list(lines),
        doubt=doubt,
        blocks=blocks,
        definitions=list(definitions),
        origin=f"Measured on the {place(origin)}, seed {origin.seed}, body {body}; policies: "
        f"{hashes}; versions: {versions}.",
    )
    return Part(anchor=anchor, title=title, html=html)
