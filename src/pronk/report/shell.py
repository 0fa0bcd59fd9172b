"""What every page of pronk shares: one frame, one look, pictures that lie in the page itself.

A page is a list of parts. Each part is made from artefacts by its own module and template; the
shell gives them a head, a table of contents and a foot. A page holds everything it shows and needs
no network.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from pronk import __version__
from pronk.evaluation.tables import Sheet
from pronk.report import style

_IMAGE_TYPES = {".gif": "image/gif", ".png": "image/png", ".svg": "image/svg+xml"}


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A figure of the page with its words."""

    src: str
    alt: str
    caption: str = ""


@dataclass(frozen=True, kw_only=True)
class Block:
    """A section: words, a picture, tables."""

    anchor: str
    title: str
    lines: tuple[str, ...] = ()
    picture: Picture | None = None
    sheets: tuple[Sheet, ...] = ()
    folded: tuple[Sheet, ...] = ()
    """Tables that are closed at first."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """One part of a page: finished HTML under a title."""

    anchor: str
    """Name that links inside the page lead to; also what the part's own anchors begin with."""
    title: str
    html: Markup


def picture(figure: Figure, alt: str, caption: str = "", *, dense: bool = False) -> Picture:
    """A figure as part of a page.

    Args:
        figure: Drawn at page width.
        alt: What it shows, for those who do not see it.
        caption: Words below it.
        dense: Thousands of marks: PNG is smaller than SVG.
    """
    src = style.png_uri(figure) if dense else style.data_uri(figure)
    return Picture(src=src, alt=alt, caption=caption)


def image(path: Path, alt: str, caption: str = "") -> Picture:
    """An image file as part of a page.

    Args:
        path: A `.gif`, `.png` or `.svg` file.
        alt: What it shows, for those who do not see it.
        caption: Words below it.
    """
    coded = base64.b64encode(path.read_bytes()).decode("ascii")
    return Picture(src=f"data:{_IMAGE_TYPES[path.suffix]};base64,{coded}", alt=alt, caption=caption)


def number(value: float | None, digits: int = 3) -> str:
    """A number for a table: fixed digits, a dash where it is unknown."""
    return f"{value:.{digits}f}" if value is not None and np.isfinite(value) else "–"


def interval(bounds: tuple[float, float], digits: int = 3) -> str:
    """An interval for a table; `held` for a number that was not fitted."""
    if bounds[0] == bounds[1]:
        return "held"
    return f"{number(bounds[0], digits)} to {number(bounds[1], digits)}"


def signs(text: str) -> str:
    """Text of a terminal's table in the signs of a page."""
    for typed, set_in in (("+-", "±"), (">=", "≥"), ("<=", "≤")):
        text = text.replace(typed, set_in)
    return "–" if text == "-" else text


def fill(template: str, **values: Any) -> Markup:
    """A filled-in template; what comes from `values` is escaped.

    Args:
        template: Its file name.
        values: What it names; a name it lacks is an error.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("pronk.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        number=number, interval=interval, signs=signs, words=style.joint_words
    )
    return Markup(environment.get_template(template).render(**values))


def page(title: str, parts: Sequence[Part], *, virtual: bool, sub: str, made_from: str) -> str:
    """A whole page as text.

    Args:
        title: Of the page.
        parts: In their order; with more than one the page begins with a list of them.
        virtual: Numbers on it come from the virtual robot.
        sub: A line below the title.
        made_from: What artefacts it rests on, for the foot.
    """
    return fill(
        "shell.html.j2",
        version=__version__,
        title=title,
        parts=parts,
        virtual=virtual,
        sub=sub,
        made_from=made_from,
    )
