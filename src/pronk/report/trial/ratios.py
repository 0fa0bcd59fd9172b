"""The paper's claim as a picture: how much more the naive policy's jumps scatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from pronk.report import style
from pronk.report.trial.style import PAPER_WORDS

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


def _draw(axes: Axes, ratios: Sequence[Ratio], title: str) -> None:
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
            _draw(axes, found, title)
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
