"""Figures of trials, from arrays: cells beside the paper, traces, sweeps, ratios."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

from pronk.actuator.model import torque_limits
from pronk.report import style
from pronk.robots.robot import Robot

PAPER_WORDS = "paper, hardware"
"""What the paper's figures are called beside ours."""
_NAMED = {"naive": (style.NAIVE, "D"), "matched": (style.MATCHED, "o")}
_OTHERS = (("#009E73", "s"), ("#56B4E9", "^"), ("#E69F00", "v"), ("#7a5195", "P"))


@dataclass(frozen=True, kw_only=True)
class Look:
    """Colour and mark of one policy."""

    name: str
    colour: str
    marker: str

    @property
    def marks(self) -> dict[str, Any]:
        """For single jumps: filled, without an edge, so that many may overlap."""
        return {
            "linestyle": "none",
            "marker": self.marker,
            "markersize": 4.5,
            "color": self.colour,
            "alpha": 0.45,
            "markeredgewidth": 0.0,
        }

    def key(self, words: str | None = None) -> Line2D:
        """Its entry in a legend."""
        return Line2D(
            [],
            [],
            linestyle="none",
            marker=self.marker,
            color=self.colour,
            markersize=6.0,
            label=words or f"{self.name}, virtual robot",
        )


def looks(policies: Sequence[str]) -> dict[str, Look]:
    """A look for each policy: `naive` and `matched` always the same, others by their place.

    Args:
        policies: Their names; what follows a comma (`naive, body 1`) does not change the look.
    """
    found, spare = {}, iter(_OTHERS * (1 + len(policies) // len(_OTHERS)))
    for name in policies:
        base = name.split(",")[0]
        colour, marker = _NAMED[base] if base in _NAMED else next(spare)
        found[name] = Look(name=name, colour=colour, marker=marker)
    return found


def offsets(count: int, width: float = 0.5) -> list[float]:
    """Places of `count` things beside each other about zero, `width` from first to last."""
    if count == 1:
        return [0.0]
    return [width * (i / (count - 1) - 0.5) for i in range(count)]


def paper_key(*, policies: Sequence[str]) -> list[Line2D]:
    """Entries of a legend for the paper's marks of these of its two policies."""
    return [
        Line2D(
            [],
            [],
            linestyle="none",
            marker=_NAMED[name][1],
            markerfacecolor="white",
            markeredgecolor=style.PAPER,
            markeredgewidth=1.4,
            markersize=6.5,
            label=f"{PAPER_WORDS}, {name}",
        )
        for name in policies
    ]


def paper_mark(
    axes: Axes,
    x: float,
    y: float,
    *,
    policy: str,
    xerr: float | None = None,
    yerr: float | None = None,
) -> None:
    """Mean and standard deviation as the paper has them: an open mark of its own colour."""
    axes.errorbar(
        x,
        y,
        xerr=xerr,
        yerr=yerr,
        marker=_NAMED[policy][1],
        markersize=6.5,
        markerfacecolor="white",
        markeredgecolor=style.PAPER,
        markeredgewidth=1.4,
        ecolor=style.PAPER,
        elinewidth=1.4,
        capsize=3.0,
        linestyle="none",
        zorder=3,
    )


Array = NDArray[np.float64]
Values = Mapping[str, Mapping[str, Array]]
"""By policy, then by command: one number a jump; NaN where there was none."""
Published = Mapping[str, Mapping[str, tuple[float, float]]]
"""By policy, then by command: mean and standard deviation that the paper gives."""


def finite(values: Array) -> Array:
    """Those that are numbers."""
    kept: Array = np.asarray(values, dtype=float)[np.isfinite(values)]
    return kept


def spread(values: Array) -> float:
    """Standard deviation of a sample, of those that are numbers; NaN for fewer than two."""
    kept = finite(values)
    return float(np.std(kept, ddof=1)) if len(kept) > 1 else float("nan")


def commands_of(values: Values) -> list[str]:
    """Commands in the order in which they first appear."""
    return list(dict.fromkeys(name for cases in values.values() for name in cases))


def _column(axes: Axes, x: float, values: Array, look: Look) -> None:
    """Jumps of one cell, a little apart from each other, and their mean and spread."""
    kept = finite(values)
    if not len(kept):
        return
    axes.plot(x + np.linspace(-0.05, 0.03, len(kept)), kept, **look.marks)
    axes.errorbar(
        x + 0.06,
        kept.mean(),
        yerr=spread(kept) if len(kept) > 1 else None,
        marker=look.marker,
        markersize=6.0,
        color=look.colour,
        elinewidth=1.8,
        capsize=3.5,
        markeredgecolor="white",
        markeredgewidth=0.7,
        linestyle="none",
        zorder=4,
    )


def _panel(axes: Axes, values: Values, published: Published, label: str) -> None:
    commands, drawn = commands_of(values), looks(list(values))
    shown = [name for name in drawn if name in published]
    places = offsets(len(drawn) + len(shown), 0.62)
    for i, command in enumerate(commands):
        slot = iter(places)
        for name, look in drawn.items():
            if name in shown:
                at = i + next(slot)
                if command in published[name]:
                    mean, std = published[name][command]
                    paper_mark(axes, at, mean, policy=name, yerr=std)
            _column(axes, i + next(slot), values[name].get(command, np.empty(0)), look)
    axes.set_xticks(range(len(commands)), commands)
    axes.set_xlim(-0.55, len(commands) - 0.45)
    axes.grid(visible=False, axis="x")
    axes.set_ylim(min(0.0, axes.get_ylim()[0]), 1.04 * axes.get_ylim()[1])
    axes.set_ylabel(label)


def _keys(policies: Sequence[str], published: Sequence[Published]) -> list[Line2D]:
    shown = [name for name in policies if any(name in one for one in published)]
    return [*(look.key() for look in looks(policies).values()), *paper_key(policies=shown)]


def cells(panels: Sequence[tuple[str, Values, Published]]) -> Figure:
    """Every jump, with mean and standard deviation, beside the paper's.

    Args:
        panels: One below the other: label of the vertical axis with its unit, ours, the paper's.
    """
    with style.styled():
        height = 2.9 if len(panels) < 3 else 2.1
        drawn = Figure(
            figsize=(style.PAGE_WIDTH_IN, height * len(panels) + 0.5), layout="constrained"
        )
        grid = drawn.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (label, values, published) in zip(grid, panels, strict=True):
            _panel(axes, values, published, label)
        policies = list(panels[0][1])
        keys = _keys(policies, [published for _, _, published in panels])
        drawn.legend(handles=keys, loc="outside lower center", ncols=len(keys))
    return drawn


def scatter(
    heights: Values, distances: Values, paper_heights: Published, paper_distances: Published
) -> Figure:
    """Height over distance of every jump, one panel a command, the paper's means with crosses.

    Args:
        heights: [m]
        distances: [m]
        paper_heights: [m]
        paper_distances: [m]
    """
    commands, drawn_as = commands_of(heights), looks(list(heights))
    width = min(3, max(1, len(commands)))
    rows = -(-len(commands) // width)
    with style.styled():
        drawn = Figure(figsize=(style.PAGE_WIDTH_IN, 2.75 * rows + 0.5), layout="constrained")
        grid = drawn.subplots(rows, width, sharex=True, sharey=True, squeeze=False)
        for axes, command in zip(grid.flat, commands, strict=False):
            for name, look in drawn_as.items():
                x = distances.get(name, {}).get(command, np.empty(0))
                y = heights[name].get(command, np.empty(0))
                axes.plot(x, y, **look.marks)
                far, high = (
                    paper.get(name, {}).get(command) for paper in (paper_distances, paper_heights)
                )
                if far and high:
                    paper_mark(axes, far[0], high[0], policy=name, xerr=far[1], yerr=high[1])
            axes.set_title(command)
        for axes in grid[:, 0]:
            axes.set_ylabel("height [m]")
        for column in range(width):
            used = [row for row in range(rows) if row * width + column < len(commands)]
            grid[used[-1], column].set_xlabel("distance [m]")
            grid[used[-1], column].tick_params(labelbottom=True)
        for axes in list(grid.flat)[len(commands) :]:
            axes.set_visible(False)
        keys = _keys(list(heights), [paper_heights])
        drawn.legend(handles=keys, loc="outside lower center", ncols=len(keys))
    return drawn


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


def _draw_lines(axes: Axes, panel: Panel, drawn_as: Mapping[str, Look]) -> None:
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
            _draw_lines(axes, panel, drawn_as)
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
    margin = 0.06 * axes.get_ylim()[1]
    y = -margin
    for end, words in sorted(ends):
        y = max(end, y + margin)
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


_TICKS = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 20.0, 50.0)


@dataclass(frozen=True, kw_only=True)
class Ratio:
    """Standard deviation of one policy over that of another, with its interval."""

    words: str
    value: float
    interval: tuple[float, float]
    """95 %, from resampled jumps."""
    paper: float | None = None
    """What the paper's printed table gives."""
    overall: bool = False
    """Over all commands: drawn more strongly than one command."""


def _draw_ratios(axes: Axes, ratios: Sequence[Ratio], title: str) -> None:
    for i, ratio in enumerate(ratios):
        y = len(ratios) - 1 - i
        weight = 2.6 if ratio.overall else 1.4
        # An interval may begin at nothing, which has no place on this axis, or have no end.
        ends = np.clip(ratio.interval, 1e-3, 1e3)
        axes.plot(ends, (y, y), color=style.MATCHED, linewidth=weight, zorder=3)
        axes.plot(
            ratio.value,
            y,
            marker="o",
            markersize=7.5 if ratio.overall else 5.0,
            color=style.MATCHED,
            zorder=4,
        )
        if ratio.paper is not None:
            axes.plot(
                ratio.paper,
                y,
                marker="D",
                markersize=6.5,
                markerfacecolor="white",
                markeredgecolor=style.PAPER,
                markeredgewidth=1.4,
                linestyle="none",
                zorder=5,
            )
    axes.axvline(1.0, color="#666666", linewidth=1.0, zorder=1)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(FixedLocator(_TICKS))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_yticks(range(len(ratios)), [ratio.words for ratio in reversed(ratios)])
    axes.set_ylim(-0.6, len(ratios) - 0.4)
    axes.grid(visible=False, axis="y")
    axes.set_title(title)


def ratios(panels: Sequence[tuple[str, Sequence[Ratio]]], *, over: tuple[str, str]) -> Figure:
    """Ratios with their intervals beside the paper's, on a logarithmic axis.

    Args:
        panels: Beside each other: what is compared, and its ratios from top to bottom.
        over: The two policies; a ratio above one says that the first scatters more.
    """
    rows = max(len(found) for _, found in panels)
    ends = [v for _, found in panels for r in found for v in (*r.interval, r.value, r.paper or 1.0)]
    inside = [v for v in ends if _TICKS[0] <= v <= _TICKS[-1]]
    low, high = min([*inside, 0.8]) / 1.2, max([*inside, 1.25]) * 1.2
    with style.styled():
        drawn = Figure(figsize=(style.PAGE_WIDTH_IN, 0.36 * rows + 1.6), layout="constrained")
        grid = drawn.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
        for axes, (title, found) in zip(grid, panels, strict=True):
            _draw_ratios(axes, found, title)
            axes.set_xlabel(f"standard deviation, {over[0]} over {over[1]} [1]")
            axes.set_xlim(low, high)
        keys = [
            Line2D(
                [], [], color=style.MATCHED, marker="o", label="virtual robot, 95 % of resamples"
            ),
            Line2D(
                [],
                [],
                linestyle="none",
                marker="D",
                markerfacecolor="white",
                markeredgecolor=style.PAPER,
                markeredgewidth=1.4,
                label=f"{PAPER_WORDS}",
            ),
        ]
        drawn.legend(handles=keys, loc="outside lower center", ncols=2)
    return drawn


@dataclass(frozen=True, kw_only=True)
class Trace:
    """One quantity of one run over time."""

    time: Array
    """[s]. (T,)"""
    value: Array
    """(T,)"""


Traces = Mapping[str, Mapping[str, Sequence[Trace]]]
"""By policy, then by command: the runs."""


def _grid(
    names: Sequence[str], columns: Sequence[str], height: float
) -> tuple[Figure, dict[tuple[str, str], Axes]]:
    """A panel for each pair of row and column; call inside `styled`."""
    drawn = Figure(figsize=(style.PAGE_WIDTH_IN, height * len(names) + 0.6), layout="constrained")
    grid = drawn.subplots(len(names), len(columns), sharex=True, sharey="row", squeeze=False)
    return drawn, {
        (row, column): grid[i, j] for i, row in enumerate(names) for j, column in enumerate(columns)
    }


def heights(traces: Traces, *, standing: float) -> Figure:
    """Trunk height of every run over the time since the jump input, one panel a command.

    Args:
        traces: Height [m] over time since the jump input rose [s].
        standing: Height of the trunk in the default pose [m].
    """
    commands = list(dict.fromkeys(name for runs in traces.values() for name in runs))
    drawn_as = looks(list(traces))
    with style.styled():
        drawn, panels = _grid(list(drawn_as), commands, 1.75)
        first, *_, last = [*drawn_as, *drawn_as]
        for (name, command), axes in panels.items():
            for trace in traces[name].get(command, ()):
                axes.plot(
                    trace.time, trace.value, color=drawn_as[name].colour, linewidth=0.7, alpha=0.55
                )
            axes.axhline(standing, color="#666666", linewidth=0.8, linestyle=(0, (2, 2)))
        for j, command in enumerate(commands):
            panels[first, command].set_title(command)
            panels[last, command].set_xlabel("time since input [s]")
            if j == 0:
                for name in drawn_as:
                    panels[name, command].set_ylabel(f"{name}\ntrunk height [m]")
        keys = [Line2D([], [], color=look.colour, label=name) for name, look in drawn_as.items()]
        keys.append(
            Line2D([], [], color="#666666", linewidth=0.8, linestyle=(0, (2, 2)), label="standing")
        )
        drawn.legend(handles=keys, loc="outside lower center", ncols=len(keys))
    return drawn


def rates(roll: Traces, pitch: Traces) -> Figure:
    """Roll and pitch rate while accelerating, one column a policy (paper R7).

    Args:
        roll: Roll rate in the trunk's frame [rad/s] over the time since the command [s]; of one
            command.
        pitch: The same for the pitch rate.
    """
    drawn_as = looks(list(roll))
    with style.styled():
        rows = {"roll rate [rad/s]": roll, "pitch rate [rad/s]": pitch}
        upper, lower = rows
        drawn, panels = _grid(list(rows), list(drawn_as), 1.9)
        for (label, name), axes in panels.items():
            runs = [trace for found in rows[label][name].values() for trace in found]
            # One run to be read, as the paper has it, before the others.
            for i, trace in enumerate(reversed(runs), start=1):
                last = i == len(runs)
                axes.plot(
                    trace.time,
                    trace.value,
                    color=drawn_as[name].colour,
                    linewidth=1.2 if last else 0.5,
                    alpha=1.0 if last else 0.25,
                )
            axes.axhline(0.0, color="#666666", linewidth=0.8)
            axes.text(
                0.99,
                0.96,
                f"RMS {rms(runs):.2f} rad/s over {len(runs)} runs",
                transform=axes.transAxes,
                ha="right",
                va="top",
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.5},
            )
        for label in rows:
            panels[label, next(iter(drawn_as))].set_ylabel(label)
        for name in drawn_as:
            panels[upper, name].set_title(f"{name}, virtual robot")
            panels[lower, name].set_xlabel("time since the command to run [s]")
    return drawn


def rms(runs: Sequence[Trace]) -> float:
    """Root mean square over all samples of all runs; NaN without any."""
    values = np.concatenate([trace.value for trace in runs]) if runs else np.empty(0)
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def torque_speed(
    robot: Robot, velocity: Array, torque: Array, *, look_of: str, words: str
) -> Figure:
    """What one jump needs of the drives, beside what a drive can give, one panel a joint group.

    Args:
        robot: Whose drives.
        velocity: Of the joints [rad/s]. (T, joints)
        torque: Of the motors, joint side [N m]. (T, joints)
        look_of: The policy, for its colour.
        words: What jump it is.
    """
    groups = list(dict.fromkeys(joint.group for joint in robot.joints))
    look = looks([look_of])[look_of]
    with style.styled():
        drawn = Figure(figsize=(style.PAGE_WIDTH_IN, 3.4), layout="constrained")
        grid = drawn.subplots(1, len(groups), squeeze=False)[0]
        for axes, group in zip(grid, groups, strict=True):
            inside = [i for i, joint in enumerate(robot.joints) if joint.group == group]
            drive = robot.joints[inside[0]].drive
            speed = np.linspace(-1.1 * drive.no_load_speed, 1.1 * drive.no_load_speed, 401)
            low, high = torque_limits(
                speed, drive.stall_torque, drive.no_load_speed, drive.effort_limit
            )
            for limit in (low, high):
                axes.plot(speed, limit, color=style.MEASURED, linewidth=1.3)
            axes.plot(
                velocity[:, inside].ravel(),
                torque[:, inside].ravel(),
                linestyle="none",
                marker=".",
                markersize=2.2,
                color=look.colour,
                alpha=0.5,
                rasterized=True,
            )
            axes.set_title(style.joint_words(group))
            axes.set_xlabel("speed [rad/s]")
        grid[0].set_ylabel("torque [N m]")
        keys = [
            Line2D([], [], linestyle="none", marker=".", color=look.colour, label=words),
            Line2D([], [], color=style.MEASURED, label="limits of the drive at nominal voltage"),
        ]
        drawn.legend(handles=keys, loc="outside lower center", ncols=2)
    return drawn
