"""Figures of trials: jumps beside the paper's, traces over time, lines over a varied parameter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from pronk.arrays import Array
from pronk.jump.trial.results import Spread
from pronk.report import style
from pronk.report.style import drawing, key, legend

Values = Mapping[str, Mapping[str, Array]]
"""By policy, then by command: one number a jump."""
Published = Mapping[str, Mapping[str, tuple[float, float]]]
"""By policy, then by command: mean and standard deviation that the paper gives."""
Traces = Mapping[str, Mapping[str, Sequence[Array]]]
"""By policy, then by command: runs as time [s] and value, each (2, T)."""

_NAMED = {"naive": (style.NAIVE, "D"), "matched": (style.MATCHED, "o")}
_OTHERS = (("#009E73", "s"), ("#56B4E9", "^"), ("#E69F00", "v"), ("#7a5195", "P"))
_DASH: dict[str, Any] = {"color": "#666666", "linewidth": 0.9, "linestyle": (0, (2, 2))}
_PAPER: dict[str, Any] = {"linestyle": "none", "markersize": 6.5, "markerfacecolor": "white"}
_PAPER |= {"markeredgecolor": style.PAPER, "markeredgewidth": 1.4}


def looks(policies: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return colour and marker of each policy; text after a comma (`naive, body 1`) is ignored."""
    found, spare = {}, iter(_OTHERS * (1 + len(policies) // len(_OTHERS)))
    for name in policies:
        base = name.split(",")[0]
        colour, marker = _NAMED[base] if base in _NAMED else next(spare)
        found[name] = {"color": colour, "marker": marker}
    return found


def _keys(policies: Sequence[str], *, marks: bool = True) -> list[Line2D]:
    named = {name.split(",")[0]: look for name, look in looks(policies).items()}
    line = {"linestyle": "none"} if marks else {}
    return [key(f"{name}, virtual robot", **look, **line) for name, look in named.items()]


def offsets(count: int, width: float) -> Array:
    """Return places of `count` things about zero, `width` from first to last."""
    return np.linspace(-0.5, 0.5, count) * width if count > 1 else np.zeros(1)


def commands_of(values: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the commands in the order in which they first appear."""
    return list(dict.fromkeys(name for cases in values.values() for name in cases))


def cells(panels: Sequence[tuple[str, Values, Published]]) -> Figure:
    """Draw every jump with mean and standard deviation, beside the paper's.

    Panels, one below the other, have the label of the axis with its unit, ours and the paper's.
    """
    height = 2.9 if len(panels) < 3 else 2.1
    size = height * len(panels) + 0.5
    with drawing(len(panels), height=size, sharex=True) as (figure, grid):
        for axes, (label, values, published) in zip(grid[:, 0], panels, strict=True):
            _cells_panel(axes, values, published)
            axes.set_ylabel(label)
        policies = list(panels[0][1])
        paper = [name for name in policies if any(name in given for _, _, given in panels)]
        keys = [key(f"paper, hardware, {n}", marker=_NAMED[n][1], **_PAPER) for n in paper]
        legend(figure, [*_keys(policies), *keys])
    return figure


def _cells_panel(axes: Axes, values: Values, published: Published) -> None:
    commands, policies = commands_of(values), looks(list(values))
    places = offsets(len(policies) + sum(name in published for name in policies), 0.62)
    for i, command in enumerate(commands):
        slot = iter(i + places)
        for name, look in policies.items():
            if name in published:
                x = next(slot)
                if command in published[name]:
                    mean, spread = published[name][command]
                    bar: dict[str, Any] = {"ecolor": style.PAPER, "capsize": 3.0, "zorder": 3}
                    axes.errorbar(x, mean, yerr=spread, marker=look["marker"], **_PAPER, **bar)
            x = next(slot)
            known = np.asarray(values[name].get(command, ()), dtype=float)
            known = known[np.isfinite(known)]
            sums = Spread.of(known)
            if len(known):
                many: dict[str, Any] = {"linestyle": "none", "alpha": 0.45, "markersize": 4.5}
                axes.plot(x + np.linspace(-0.05, 0.03, len(known)), known, **look, **many)
                bar = {"capsize": 3.5, "markeredgecolor": "white", "zorder": 4}
                spread = sums.std if sums.n > 1 else 0.0
                axes.errorbar(x + 0.06, sums.mean, yerr=spread, **look, **bar)
    axes.set_xticks(range(len(commands)), commands)
    axes.set_xlim(-0.55, len(commands) - 0.45)
    axes.grid(visible=False, axis="x")
    axes.set_ylim(min(0.0, axes.get_ylim()[0]), 1.04 * axes.get_ylim()[1])


def scatter_over_error(errors_db: Mapping[str, float], panels: Mapping[str, Values]) -> Figure:
    """Draw the scatter of each command's jumps over the error of the policy's training gains.

    Errors are by policy, RMS over the joints' bands; panels by quantity as in `height [m]`.
    """
    policies = looks(list(errors_db))
    with drawing(1, len(panels), height=3.4) as (figure, grid):
        for axes, (label, values) in zip(grid[0], panels.items(), strict=True):
            for name, look in policies.items():
                stds = np.array([Spread.of(one).std for one in values.get(name, {}).values()])
                at = np.full(len(stds), errors_db[name])
                axes.plot(at, stds, linestyle="none", alpha=0.7, **look)
                if np.isfinite(stds).any():
                    bar = {"markersize": 22.0, "markeredgewidth": 2.6, "color": look["color"]}
                    axes.plot(errors_db[name], np.nanmean(stds), marker="_", **bar)
            axes.set_xlim(0.0, 1.1 * max(errors_db.values()))
            axes.set_ylim(0.0, 1.12 * axes.get_ylim()[1])
            axes.set_xlabel("error of the training gains on the sweep [dB RMS]")
            axes.set_ylabel(f"standard deviation of the {label}")
        mean = key("mean over the commands", color="#444444", linewidth=2.6)
        legend(figure, [*_keys(list(errors_db)), mean])
    return figure


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One panel of a figure of lines."""

    title: str
    x_label: str
    y_label: str
    lines: Mapping[str, Array]
    """By policy: rows of x, the result, and the ends of its error bar, (4, n)."""
    marks: tuple[float, ...] = ()
    """Places along x that are marked."""
    share: bool = False
    """The result is a share, 0 to 1."""


def lines(panels: Sequence[Panel], *, columns: int, mark: str, bar: str) -> Figure:
    """Draw panels of lines, row by row; `mark` and `bar` name the marks and the error bars."""
    policies = list(dict.fromkeys(name for panel in panels for name in panel.lines))
    rows = -(-len(panels) // columns)
    with drawing(rows, columns, height=2.35 * rows + 0.5) as (figure, grid):
        for axes, panel in zip(grid.flat, panels, strict=True):
            width = max((float(np.ptp(line[0])) for line in panel.lines.values()), default=0.0)
            shifts = width * offsets(len(panel.lines), 0.012)
            for shift, (name, line) in zip(shifts, panel.lines.items(), strict=False):
                x, y, low, high = line[:, np.argsort(line[0], kind="stable")]
                look = looks(policies)[name]
                axes.plot(x + shift, y, markersize=5.0, linewidth=1.4, zorder=3, **look)
                axes.vlines(x + shift, low, high, color=look["color"], linewidth=1.0)
            for place in panel.marks:
                axes.axvline(place, **_DASH)
            axes.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label)
            if panel.share:
                axes.set_ylim(-0.04, 1.04)
        tick: dict[str, Any] = {"color": "#444444", "marker": "|", "linestyle": "none"}
        legend(figure, [*_keys(policies, marks=False), key(mark, **_DASH), key(bar, **tick)])
    return figure


def traces(found: Mapping[str, Traces], *, x_label: str, level: float) -> Figure:
    """Draw runs over time, a row for each quantity and policy, a column a command.

    `found` is by quantity with its unit; `level` is drawn dashed in each panel.
    """
    first = next(iter(found.values()))
    commands, policies = commands_of(first), looks(list(first))
    rows = [(quantity, name) for quantity in found for name in policies]
    options: dict[str, Any] = {"sharex": True, "sharey": "row", "height": 1.7 * len(rows) + 0.6}
    with drawing(len(rows), len(commands), **options) as (figure, grid):
        for row, (quantity, name) in zip(grid, rows, strict=True):
            for axes, command in zip(row, commands, strict=True):
                for time, value in found[quantity][name].get(command, ()):
                    look = {"color": policies[name]["color"], "linewidth": 0.7, "alpha": 0.55}
                    axes.plot(time, value, **look)
                axes.axhline(level, **_DASH)
            row[0].set_ylabel(f"{name}\n{quantity}")
        for top, bottom, command in zip(grid[0], grid[-1], commands, strict=True):
            top.set_title(command)
            bottom.set_xlabel(x_label)
        legend(figure, [key(f"{n}, virtual robot", color=p["color"]) for n, p in policies.items()])
    return figure
