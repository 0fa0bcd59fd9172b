"""The page builder: parts of sections of paragraphs, tables and pictures, filled into one template.

A page holds everything it shows and needs no network.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jinja2
import numpy as np
from matplotlib.figure import Figure

from pronk import __version__
from pronk.evaluation.tables import Sheet
from pronk.report import style


@dataclass(frozen=True, kw_only=True)
class Picture:
    """An image that lies in the page itself."""

    src: str
    """A `data:` address."""
    alt: str
    caption: str = ""


class Fold:
    """Content that is closed at first; left out if empty."""

    def __init__(self, summary: str, *content: Content | None) -> None:
        """Set the line that opens it, and its content without None."""
        self.summary, self.content = summary, [one for one in content if one]

    def __len__(self) -> int:
        """Return the number of its items."""
        return len(self.content)


@dataclass(frozen=True)
class Code:
    """Commands to copy."""

    text: str


Content = str | Picture | Sheet | Fold | Code
"""A string is a paragraph; one of class `markupsafe.Markup` is HTML as it is."""


class Section:
    """A heading with what stands below it."""

    def __init__(self, anchor: str, title: str, *content: Content | None) -> None:
        """Leave out what is None or empty.

        Args:
            anchor: Name within the part.
            title: Heading.
            content: In the order of the page.
        """
        self.anchor, self.title = anchor, title
        self.content = [one for one in content if one]


@dataclass(frozen=True, kw_only=True)
class Part:
    """One artefact on the page: a summary, then sections."""

    anchor: str
    """Begins the anchors of all its sections."""
    title: str
    source: str
    """The file it is made from, below the folder of the page."""
    virtual: bool
    """Measured on the virtual robot."""
    summary: str
    """One sentence."""
    lines: Sequence[str] = ()
    """Paragraphs below it."""
    warning: bool = False
    """A result is not as expected."""
    sections: Sequence[Section | None]
    note: str = ""
    """What the part rests on: seeds, hashes, versions."""
    figures: Mapping[str, Any] = field(default_factory=dict)
    """What `--json` gives of it."""


def picture(figure: Figure, alt: str, *, dense: bool = False) -> Picture:
    """Return a figure as part of a page.

    Args:
        figure: Drawn at page width.
        alt: Text alternative.
        dense: It has thousands of marks: PNG is smaller than SVG.
    """
    kind = "png" if dense else "svg"
    return Picture(src=style.data_uri(style.render(figure, kind), kind), alt=alt)


def table(
    rows: Iterable[Mapping[str, str]], title: str = "", notes: tuple[str, ...] = ()
) -> Sheet | None:
    """Return a table of rows by column name, or None without a row."""
    rows = list(rows)
    if not rows:
        return None
    return Sheet(
        title=title,
        columns=tuple(rows[0]),
        rows=tuple(tuple(row.values()) for row in rows),
        notes=notes,
    )


def number(value: float | None, digits: int = 3) -> str:
    """Format a number; a dash where it is unknown."""
    return f"{value:.{digits}f}" if value is not None and np.isfinite(value) else "-"


def interval(bounds: tuple[float, float], digits: int = 3) -> str:
    """Format an interval; `held` for a number that was not fitted."""
    if bounds[0] == bounds[1]:
        return "held"
    return f"{number(bounds[0], digits)} to {number(bounds[1], digits)}"


def _signs(text: str) -> str:
    for typed, printed in (("+-", "±"), (">=", "≥"), ("<=", "≤")):
        text = text.replace(typed, printed)
    return "–" if text == "-" else text


def page(title: str, parts: Sequence[Part]) -> str:
    """Return a whole page as HTML; text of the parts is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("pronk.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["signs"] = _signs
    template = environment.get_template("page.html.j2")
    return template.render(version=__version__, title=title, parts=parts)
