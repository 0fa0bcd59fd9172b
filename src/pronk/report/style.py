"""One look for every figure: page width, light ground, colours that survive colour blindness.

Colours are those of Okabe and Ito (*Color Universal Design*, 2008): blue and vermillion stay apart
under the common colour-vision deficiencies, and every curve also has its own dash, so the figures
read in grey as well. Figures are built on `matplotlib.figure.Figure` directly: no display, no
global state.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

from pronk.files import written_whole

MEASURED = "#1a1a1a"
MEASURED_WIDE = "#909090"
NAIVE = "#D55E00"
MATCHED = "#0072B2"
ZERO_ARMATURE = "#009E73"
COMMAND = "#3d3d3d"
PAPER = "#CC79A7"
BAND = "#f3efe2"

PAGE_WIDTH_IN = 10.0
"""Every figure is as wide as the page: 10 in at 96 px/in is the 960 px column of the page."""

LEG_MARKERS = {"FR": "o", "FL": "s", "HR": "^", "HL": "D"}
"""Marker of each leg, in file order; other robots' joints take the first."""

NAIVE_LINE: dict[str, Any] = {"color": NAIVE, "linestyle": (0, (5, 2)), "linewidth": 1.5}
MATCHED_LINE: dict[str, Any] = {"color": MATCHED, "linestyle": "-", "linewidth": 1.4}
MEASURED_LINE: dict[str, Any] = {"color": MEASURED_WIDE, "linestyle": "-", "linewidth": 3.4}
"""Wide and grey, so that a good match shows as a thin line inside it."""
ZERO_LINE: dict[str, Any] = {
    "color": ZERO_ARMATURE,
    "linestyle": (0, (6, 2, 1, 2)),
    "linewidth": 1.6,
}

_RC = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#666666",
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    # The same figure gives the same bytes.
    "svg.hashsalt": "pronk",
    "svg.fonttype": "path",
    "image.composite_image": False,
}


@contextmanager
def styled() -> Iterator[None]:
    """Draw with pronk's look inside the block, leaving matplotlib's settings as they were."""
    with mpl.rc_context(_RC):  # type: ignore[arg-type]
        yield


def decibel(gain: Any) -> Any:
    """`20 log10(gain)`, floored at -200 dB so that a zero can be drawn."""
    return 20.0 * np.log10(np.maximum(np.abs(gain), 1e-10))


def joint_words(name: str) -> str:
    """A joint's name for a title: `FR_hip_roll` becomes `FR hip roll`."""
    return name.replace("_", " ")


def leg_of(name: str) -> str:
    """The leg part of `LEG_JOINT`, or an empty string for a robot without legs."""
    head = name.split("_", 1)[0]
    return head if head in LEG_MARKERS else ""


def frequency_axis(axes: Axes, low_hz: float, high_hz: float) -> None:
    """Logarithmic frequency axis with plain numbers at 0.1, 0.2, 0.5, 1, ... Hz."""
    axes.set_xscale("log")
    axes.set_xlim(low_hz, high_hz)
    ticks = [
        base * 10.0**power
        for power in range(-3, 4)
        for base in (1, 2, 5)
        if low_hz * 0.999 <= base * 10.0**power <= high_hz * 1.001
    ]
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def svg(figure: Figure) -> bytes:
    """The figure as SVG bytes, without a date in it."""
    buffer = io.BytesIO()
    with styled():
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def data_uri(figure: Figure) -> str:
    """The figure as a `data:` address for the `src` of an image."""
    return "data:image/svg+xml;base64," + base64.b64encode(svg(figure)).decode("ascii")


def png(figure: Figure, dpi: float = 130.0) -> bytes:
    """The figure as PNG bytes, for figures whose SVG would be large."""
    buffer = io.BytesIO()
    with styled():
        figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


def png_uri(figure: Figure) -> str:
    """The figure as a `data:` address of a PNG image."""
    return "data:image/png;base64," + base64.b64encode(png(figure)).decode("ascii")


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as SVG or PNG, by the suffix of `path`, whole or not at all."""
    with styled(), written_whole(path) as aside:
        if path.suffix == ".svg":
            aside.write_bytes(svg(figure))
        else:
            figure.savefig(aside, format=path.suffix.lstrip("."), dpi=150)
    return path


def grid_of_joints(names: Sequence[str]) -> list[list[str]]:
    """Joint names in rows: one row per joint group where they are equally long, else threes."""
    groups: dict[str, list[str]] = {}
    for name in names:
        leg = leg_of(name)
        groups.setdefault(name.removeprefix(f"{leg}_") if leg else "", []).append(name)
    rows = list(groups.values())
    if "" not in groups and len({len(row) for row in rows}) == 1 and len(rows[0]) > 1:
        return rows
    return [list(names[i : i + 3]) for i in range(0, len(names), 3)]


def small_multiples(
    rows: list[list[str]], *, height: float, sharey: bool | Literal["row"] = True
) -> tuple[Figure, dict[str, Axes]]:
    """A figure with one panel per name; call inside `styled`.

    Args:
        rows: Names by row; short rows leave their last places empty.
        height: Height of a row [in].
        sharey: Panels share the vertical axis, all of them or those of a row.
    """
    width = max(len(row) for row in rows)
    figure = Figure(figsize=(PAGE_WIDTH_IN, height * len(rows) + 0.7), layout="constrained")
    grid = figure.subplots(len(rows), width, sharex=True, sharey=sharey, squeeze=False)
    panels = {}
    for r, row in enumerate(rows):
        for c in range(width):
            if c < len(row):
                panels[row[c]] = grid[r, c]
            else:
                grid[r, c].set_visible(False)
    return figure, panels


def bottom_row(rows: list[list[str]]) -> list[str]:
    """The lowest name of each column, where the labels of the horizontal axis go."""
    width = max(len(row) for row in rows)
    return [[row[c] for row in rows if c < len(row)][-1] for c in range(width)]
