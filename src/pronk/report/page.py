"""The page: parts, each a template of its kind filled with tables and figures.

A page holds everything it shows and needs no network.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jinja2

from pronk.version import VERSION


@dataclass(frozen=True, kw_only=True)
class Part:
    """One artefact on the page."""

    kind: str
    """Its template is `templates/KIND.html.j2`."""
    title: str
    virtual: bool
    """Measured on the virtual robot."""
    summary: str
    """One sentence."""
    warning: bool = False
    """A result is not as expected."""
    content: Mapping[str, Any]
    """Variables of the template."""
    figures: Mapping[str, Any] = field(default_factory=dict)
    """What `--json` gives of it."""
    source: str = ""
    """The file it is made from, below the folder of the page."""
    number: int = 0
    """Among the parts of its kind on the page."""

    @property
    def anchor(self) -> str:
        """Begins the anchors of all its sections."""
        return f"{self.kind}{self.number or ''}"


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
        extensions=["jinja2.ext.do"],
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["signs"] = _signs
    environment.filters["words"] = lambda name: name.replace("_", " ")
    # Columns of text are set to the left.
    environment.filters["align"] = lambda rows, i: "left" * any(len(row[i]) > 24 for row in rows)
    rendered = [
        environment.get_template(f"{part.kind}.html.j2").render(
            part.content, part=part, many=len(parts) > 1, sections=[]
        )
        for part in parts
    ]
    template = environment.get_template("page.html.j2")
    return template.render(version=VERSION, title=title, parts=parts, rendered=rendered)
