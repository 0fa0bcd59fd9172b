"""Look of every figure, and how figures are made and saved.

Colours are those of Okabe and Ito (*Color Universal Design*, 2008), which stay apart under the
common colour-vision deficiencies. Figures are `matplotlib.figure.Figure` objects: no display, no
global state.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

from pronk.files import written_whole
from pronk.robots.leg_names import (
    FRONT_LEFT,
    FRONT_RIGHT,
    LEG_NAMES,
    PLACES,
    REAR_LEFT,
    REAR_RIGHT,
)

MEASURED = "#1a1a1a"
MEASURED_WIDE = "#909090"
NAIVE = "#D55E00"
MATCHED = "#0072B2"
ZERO_ARMATURE = "#009E73"
COMMAND = "#3d3d3d"
PAPER = "#CC79A7"
BAND = "#f3efe2"

PAGE_WIDTH_IN = 10.0
"""Width of a figure: 10 in at 96 px/in is the 960 px column of the page."""
_MARGINS_IN = {"left": 0.8, "right": 0.1, "bottom": 0.95, "top": 0.3}
"""Room about the axes of a figure with fixed margins, for labels of up to five characters, a title,
and a legend of two rows below [in]."""
LEG_MARKERS = {FRONT_RIGHT: "o", FRONT_LEFT: "s", REAR_RIGHT: "^", REAR_LEFT: "D"}
"""Marker of each leg by its place; joints of no leg take the first."""
Sharing = bool | Literal["row", "col"]


class Look(TypedDict, total=False):
    """Properties of a line or a mark, by their names in matplotlib."""

    color: str
    linestyle: Any
    linewidth: float
    marker: str
    markersize: float
    markerfacecolor: str
    markeredgecolor: str
    markeredgewidth: float
    zorder: float


NAIVE_LINE: Look = {"color": NAIVE, "linestyle": (0, (5, 2)), "linewidth": 1.5}
MATCHED_LINE: Look = {"color": MATCHED, "linestyle": "-", "linewidth": 1.4}
MEASURED_LINE: Look = {"color": MEASURED_WIDE, "linestyle": "-", "linewidth": 3.4}
"""Wide and grey: a good match shows as a thin line inside it."""
ZERO_LINE: Look = {"color": ZERO_ARMATURE, "linestyle": (0, (6, 2, 1, 2))}

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
    # The same figure gives the same bytes.
    "svg.hashsalt": "pronk",
    "svg.fonttype": "path",
    "image.composite_image": False,
}


def joint_words(name: str) -> str:
    """Return a joint's name for a title: `FR_hip_roll` becomes `FR hip roll`."""
    return name.replace("_", " ")


def leg_of(name: str) -> str:
    """Return the leg of a joint named `LEG_JOINT`; an empty string for a robot without legs."""
    head = name.split("_", 1)[0]
    return head if head in LEG_NAMES else ""


def leg_marker(leg: str) -> str:
    """Return the marker of the joints of a leg."""
    if leg.upper() not in PLACES:
        return "o"
    return LEG_MARKERS[PLACES[leg.upper()]]


@contextmanager
def drawing(
    rows: int = 1,
    columns: int = 1,
    *,
    height: float,
    sharex: Sharing = False,
    sharey: Sharing = False,
    height_ratios: Sequence[float] | None = None,
    fixed_margins: bool = False,
) -> Iterator[tuple[Figure, NDArray[Any]]]:
    """Make a figure of page width, with a grid of axes in pronk's look.

    Args:
        rows: Rows of axes.
        columns: Columns of axes.
        height: Height of the figure [in].
        sharex: Axes that share the horizontal axis: none, all, or those of a row or column.
        sharey: Axes that share the vertical axis.
        height_ratios: Relative heights of the rows; equal if None.
        fixed_margins: Whether the margins are `_MARGINS_IN`. Otherwise they are fitted to the
            labels, which takes as long as the drawing itself.

    Yields:
        The figure, and its axes, shape (rows, columns).
    """
    with mpl.rc_context(_RC):  # type: ignore[arg-type]
        layout = "none" if fixed_margins else "constrained"
        figure = Figure(figsize=(PAGE_WIDTH_IN, height), layout=layout)  # type: ignore[arg-type]
        axes = figure.subplots(
            rows,
            columns,
            squeeze=False,
            sharex=sharex,
            sharey=sharey,
            height_ratios=height_ratios,
        )
        if fixed_margins:
            figure.subplots_adjust(
                left=_MARGINS_IN["left"] / PAGE_WIDTH_IN,
                right=1.0 - _MARGINS_IN["right"] / PAGE_WIDTH_IN,
                bottom=_MARGINS_IN["bottom"] / height,
                top=1.0 - _MARGINS_IN["top"] / height,
                hspace=0.1,
            )
        yield figure, axes


@contextmanager
def joint_panels(
    names: Sequence[str],
    x_label: str,
    y_label: str,
    *,
    height: float,
    sharey: Sharing = True,
) -> Iterator[tuple[Figure, dict[str, Axes]]]:
    """Make a figure with one titled panel for each joint.

    The lowest panel of each column and the first of each row are labelled.

    Args:
        names: Names of the joints.
        x_label: Label of the horizontal axes.
        y_label: Label of the vertical axes.
        height: Height of a row of panels [in].
        sharey: As of `drawing`.

    Yields:
        The figure, and the axes by joint.
    """
    rows = grid_of_joints(names)
    column_count = max(map(len, rows))
    figure_height = height * len(rows) + 0.7
    with drawing(len(rows), column_count, height=figure_height, sharex=True, sharey=sharey) as (
        figure,
        grid,
    ):
        panels: dict[str, Axes] = {}
        lowest: dict[int, Axes] = {}
        for axes in grid.flat:
            axes.set_visible(False)
        for row_number, row in enumerate(rows):
            for column_number, name in enumerate(row):
                axes = grid[row_number, column_number]
                axes.set_visible(True)
                axes.set_title(joint_words(name))
                panels[name] = axes
                lowest[column_number] = axes
            panels[row[0]].set_ylabel(y_label)
        for axes in lowest.values():
            axes.set_xlabel(x_label)
            axes.tick_params(labelbottom=True)
        yield figure, panels


def grid_of_joints(names: Sequence[str]) -> list[list[str]]:
    """Return joint names in rows: a row for each joint group if equally long, otherwise threes."""
    groups: dict[str, list[str]] = {}
    for name in names:
        leg = leg_of(name)
        group = name.removeprefix(f"{leg}_") if leg else ""
        groups.setdefault(group, []).append(name)
    rows = list(groups.values())
    lengths = {len(row) for row in rows}
    if "" not in groups and len(lengths) == 1 and len(rows[0]) > 1:
        return rows
    return [list(names[start : start + 3]) for start in range(0, len(names), 3)]


def key(label: str, **look: Unpack[Look]) -> Line2D:
    """Return an entry of a legend."""
    return Line2D([], [], label=label, **look)


def legend(
    figure: Figure,
    keys: Sequence[Any],
    columns: int | None = None,
    *,
    facecolor: str | None = None,
) -> None:
    """Put a legend below all axes of a figure.

    Args:
        figure: The figure.
        keys: Entries, as `key` makes them.
        columns: Columns of the legend; up to six if None.
        facecolor: Colour of a frame behind it; no frame if None.
    """
    figure.legend(
        handles=keys,
        loc="outside lower center" if figure.get_layout_engine() else "lower center",
        ncols=columns or min(len(keys), 6),
        facecolor=facecolor,
        frameon=facecolor is not None,
        edgecolor="none",
    )


def frequency_axis(axes: Axes, low_hz: float, high_hz: float) -> None:
    """Set a logarithmic frequency axis with plain numbers; 1, 2, 5 a decade where they fit."""
    digits = (1, 2, 5) if high_hz < 1000.0 * low_hz else (1,)
    ticks_hz = []
    for power in range(-3, 4):
        for digit in digits:
            tick_hz = digit * 10.0**power
            if low_hz * 0.999 <= tick_hz <= high_hz * 1.001:
                ticks_hz.append(tick_hz)
    axes.set_xscale("log")
    axes.set_xlim(low_hz, high_hz)
    axes.xaxis.set_major_locator(FixedLocator(ticks_hz))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(NullLocator())


def render(figure: Figure, kind: str = "svg", *, dpi: float = 130.0) -> bytes:
    """Return the figure as an `svg` or `png` file, without a date in it."""
    buffer = io.BytesIO()
    metadata = {"Date": None} if kind == "svg" else {"Software": None}
    with mpl.rc_context(_RC):  # type: ignore[arg-type]
        figure.savefig(buffer, format=kind, dpi=dpi, metadata=metadata)
    return buffer.getvalue()


def data_uri(data: bytes, kind: str) -> str:
    """Return an image file as a `data:` address; `kind` is `svg+xml`, `png` or `gif`."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def picture(figure: Figure, *, dense: bool = False) -> str:
    """Return a figure as a `data:` address; as PNG if `dense`.

    Many marks make a large SVG.
    """
    if dense:
        return data_uri(render(figure, "png"), "png")
    return data_uri(render(figure), "svg+xml")


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a figure as SVG or PNG, by the suffix of the path, whole or not at all."""
    with written_whole(path) as temporary:
        temporary.write_bytes(render(figure, path.suffix.lstrip("."), dpi=150))
    return path
