"""Results against something that is varied: obstacles that grow, a robot that changes, gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from pronk.report import style
from pronk.report.trial.cells import Values, commands_of, finite, spread
from pronk.report.trial.style import Look, looks, offsets

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Line:
    """A result over something that was varied. Arrays of the same length, (n,)."""

    x: Array
    """What was varied, in its unit."""
    y: Array
    """The result: a mean or a share."""
    low: Array
    """Lower end of its bar; NaN for none."""
    high: Array
    """Upper end of its bar; NaN for none."""

    def sorted(self) -> Line:
        """The same from the smallest `x` to the largest."""
        order = np.argsort(self.x, kind="stable")
        return Line(x=self.x[order], y=self.y[order], low=self.low[order], high=self.high[order])


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One panel of a figure of lines."""

    title: str
    x_label: str
    y_label: str
    lines: Mapping[str, Line]
    """By policy."""
    marks: tuple[float, ...] = ()
    """Places along x that are marked: what the robot has of itself, or what the paper reached."""
    share: bool = False
    """The result is a share, 0 to 1."""


def _draw(axes: Axes, panel: Panel, drawn_as: Mapping[str, Look]) -> None:
    width = np.ptp(np.concatenate([line.x for line in panel.lines.values()] or [np.zeros(1)]))
    for shift, (name, line) in zip(
        offsets(len(panel.lines), 0.012), panel.lines.items(), strict=True
    ):
        look, points = drawn_as[name], line.sorted()
        x = points.x + shift * width
        axes.plot(
            x,
            points.y,
            color=look.colour,
            marker=look.marker,
            markersize=5.0,
            linewidth=1.4,
            linestyle="-" if name != "naive" else (0, (5, 2)),
            zorder=3,
        )
        shown = np.isfinite(points.low) & np.isfinite(points.high)
        axes.vlines(
            x[shown], points.low[shown], points.high[shown], color=look.colour, linewidth=1.0
        )
    for mark in panel.marks:
        axes.axvline(mark, color="#888888", linewidth=0.9, linestyle=(0, (2, 2)), zorder=1)
    axes.set_title(panel.title)
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)
    if panel.share:
        axes.set_ylim(-0.04, 1.04)


def lines(
    panels: Sequence[Panel],
    *,
    across: int,
    mark: str = "",
    bar: str = "",
    sharex: Literal["none", "row"] = "none",
) -> Figure:
    """Panels of lines.

    Args:
        panels: Row by row.
        across: Panels in a row.
        mark: What the dotted lines are.
        bar: What the bars are.
        sharex: Panels of a row vary the same thing.
    """
    names = list(dict.fromkeys(name for panel in panels for name in panel.lines))
    drawn_as = looks(names)
    rows = -(-len(panels) // across)
    with style.styled():
        drawn = Figure(figsize=(style.PAGE_WIDTH_IN, 2.35 * rows + 0.5), layout="constrained")
        grid = drawn.subplots(rows, across, sharex=sharex, squeeze=False)
        for axes, panel in zip(grid.flat, panels, strict=False):
            _draw(axes, panel, drawn_as)
        for axes in list(grid.flat)[len(panels) :]:
            axes.set_visible(False)
        keys = [
            Line2D([], [], color=look.colour, marker=look.marker, label=f"{name}, virtual robot")
            for name, look in drawn_as.items()
        ]
        if mark:
            keys.append(Line2D([], [], color="#888888", linestyle=(0, (2, 2)), label=mark))
        if bar:
            keys.append(
                Line2D([], [], color="#444444", marker="|", markersize=9, linestyle="", label=bar)
            )
        drawn.legend(handles=keys, loc="outside lower center", ncols=len(keys))
    return drawn


def _name_ends(axes: Axes, x: float, ends: Sequence[tuple[float, str]]) -> None:
    """Write what each line is at its right end, no word over another."""
    room = 0.06 * axes.get_ylim()[1]
    y = -room
    for end, words in sorted(ends):
        y = max(end, y + room)
        axes.annotate(
            words,
            (x, y),
            textcoords="offset points",
            xytext=(22, 0),
            va="center",
            annotation_clip=False,
            fontsize=7.5,
            color="#555555",
        )


def argument(
    bode_error_db: Mapping[str, float], panels: Mapping[str, Values], *, named: bool = True
) -> Figure:
    """The paper's argument: the error of each policy's training gains beside its jumps' scatter.

    Args:
        bode_error_db: By policy, how far its training gains are from the sweep, RMS over the
            joints' bands [dB].
        panels: By what scatters, with its unit as in `height [m]`: one number a jump.
        named: Write the commands' names, and join the marks of a command.
    """
    drawn_as = looks(list(bode_error_db))
    with style.styled():
        drawn = Figure(figsize=(style.PAGE_WIDTH_IN, 3.4), layout="constrained")
        grid = drawn.subplots(1, len(panels), squeeze=False)[0]
        for axes, (label, values) in zip(grid, panels.items(), strict=True):
            ends: list[tuple[float, str]] = []
            for command in commands_of(values):
                points = [
                    (bode_error_db[name], spread(values[name][command]))
                    for name in drawn_as
                    if command in values.get(name, {})
                ]
                points = sorted(point for point in points if np.isfinite(point[1]))
                if points and named:
                    axes.plot(*zip(*points, strict=True), color="#b0b0b0", linewidth=0.8)
                    ends.append((points[-1][1], command))
            for name, look in drawn_as.items():
                stds = finite(np.array([spread(v) for v in values.get(name, {}).values()]))
                at = np.full(len(stds), bode_error_db[name])
                axes.plot(at, stds, **look.marks | {"alpha": 0.8, "zorder": 3})
                if len(stds):
                    axes.plot(
                        bode_error_db[name],
                        stds.mean(),
                        marker="_",
                        markersize=22.0,
                        markeredgewidth=2.6,
                        color=look.colour,
                        zorder=4,
                    )
            axes.set_xlim(0.0, 1.3 * max(bode_error_db.values()))
            axes.set_ylim(0.0, 1.12 * axes.get_ylim()[1])
            _name_ends(axes, max(bode_error_db.values()), ends)
            axes.set_xlabel("error of the training gains on the sweep [dB RMS]")
            axes.set_ylabel(f"standard deviation of the {label}")
        keys = list(
            {
                look.colour: look.key(f"{name.split(',')[0]}, virtual robot")
                for name, look in drawn_as.items()
            }.values()
        )
        keys.append(Line2D([], [], color="#444444", linewidth=2.6, label="mean over the commands"))
        drawn.legend(handles=keys, loc="outside lower center", ncols=len(keys))
    return drawn
