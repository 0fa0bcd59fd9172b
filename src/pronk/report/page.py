"""The page: parts, each a template of its kind filled with tables and figures.

A page holds everything it shows and needs no network.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jinja2
import msgspec
from markupsafe import Markup

from pronk.report.charts import chart_library
from pronk.tables import counted
from pronk.version import VERSION


@dataclass(frozen=True, kw_only=True)
class Part:
    """One artefact on the page."""

    kind: str
    """Kind of the artefact; its template is `templates/KIND.html.j2`."""
    title: str
    virtual: bool
    """True if it was measured on the virtual robot."""
    summary: str
    """Outcome in one sentence."""
    warning: bool = False
    """True if a result is not as expected."""
    content: Mapping[str, Any]
    """Variables of the template."""
    figures: Mapping[str, Any] = field(default_factory=dict)
    """Numbers of it that `--json` writes."""
    source: str = ""
    """Path of the artefact, relative to the folder of the page."""
    number: int = 0
    """Number among the parts of its kind on the page."""

    @property
    def anchor(self) -> str:
        """Text with which the anchors of all its sections begin."""
        return f"{self.kind}{self.number or ''}"


_PRINTED_SIGNS = {"+-": "±", ">=": "≥", "<=": "≤"}
_LONG_TEXT = 24
"""Characters of a cell from which on a column of text is set to the left."""


def _signs(text: str) -> str:
    """Return text with printed signs; a cell of a dash alone with a longer one."""
    if text == "-":
        return "–"
    for typed, printed in _PRINTED_SIGNS.items():
        text = text.replace(typed, printed)
    return text


def _words(name: str) -> str:
    """Return a name with spaces."""
    return name.replace("_", " ")


def _alignment(text_rows: Sequence[Sequence[str]], column: int) -> str:
    """Return the class of a column's cells: `left` for long text."""
    if any(len(text_row[column]) > _LONG_TEXT for text_row in text_rows):
        return "left"
    return ""


def _as_json(value: Any) -> Markup:
    """Return a value as JSON that can stand in a script element of a page."""
    text = msgspec.json.encode(value).decode("utf-8")
    # An element of a page ends at "</", also within a text of JSON.
    return Markup(text.replace("<", "\\u003c").replace("&", "\\u0026"))


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
    environment.filters["words"] = _words
    environment.filters["counted"] = counted
    environment.filters["align"] = _alignment
    environment.filters["as_json"] = _as_json
    rendered = []
    for part in parts:
        template = environment.get_template(f"{part.kind}.html.j2")
        html = template.render(part.content, part=part, many=len(parts) > 1, sections=[])
        rendered.append(html)
    charts = any(part.content.get("charts") for part in parts)
    template = environment.get_template("page.html.j2")
    return template.render(
        version=VERSION,
        title=title,
        parts=parts,
        rendered=rendered,
        charts=charts,
        library=chart_library() if charts else "",
    )
