"""Table III as pictures: every jump of every command, beside the paper's mean and spread."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from pronk.report import style
from pronk.report.trial.style import Look, looks, offsets, paper_key, paper_mark

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
