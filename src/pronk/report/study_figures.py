"""Figures of a study: outcomes by arm and robot, and tolerance curves, with 95 % intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as MplFigure

from pronk.arrays import Array
from pronk.jump.study.outcomes import OUTCOMES
from pronk.jump.study.study_results import OutcomeCell, StudyResults
from pronk.report.style import Look, drawing, key, legend
from pronk.report.trial_figures import offsets

ROOM = 0.7
"""Share of the room of a robot that the marks of all arms take [1]."""
LARGEST_ARM_DISTANCE = 0.3
"""Largest distance of the marks of two arms, so that those of few arms stay by their robot [1]."""
_LOOKS: tuple[Look, ...] = (
    {"color": "#D55E00", "marker": "D", "linestyle": "-"},
    {"color": "#0072B2", "marker": "o", "linestyle": "-"},
    {"color": "#009E73", "marker": "s", "linestyle": "-"},
    {"color": "#CC79A7", "marker": "^", "linestyle": "-"},
    {"color": "#E69F00", "marker": "v", "linestyle": "-"},
    {"color": "#56B4E9", "marker": "P", "linestyle": "-"},
    {"color": "#4d4d4d", "marker": "X", "linestyle": "-"},
    {"color": "#7a5195", "marker": "<", "linestyle": "-"},
)
"""Colours of Okabe and Ito, and two more that stay apart from them, each with a marker."""
_DASHES: tuple[object, ...] = ("-", (0, (4, 2)), (0, (1, 1.5)))
"""Lines of the first eight arms, of the next eight, and of the eight after them."""
_MAX_DISTANCE = 0.12
"""Largest distance of two arms of which places of seeds are a share; robots are 1 apart [1]."""
SEED_MARKER = "$\\circ$"
"""Marker of a single seed."""
_SEEDS_FROM = 0.3
"""Place of an arm's first seed, right of its mark, as a share of the distance of two arms [1]."""
_SEEDS_TO = 0.7
"""Place of its last seed [1]."""
LEGEND_COLUMNS = 4
"""Columns of the legend: names of arms are long."""


def arm_looks(arms: Sequence[str]) -> dict[str, Look]:
    """Return colour, marker and line of each arm; no two of 24 are alike."""
    look_by_arm: dict[str, Look] = {}
    for index, arm in enumerate(arms):
        look = _LOOKS[index % len(_LOOKS)].copy()
        look["linestyle"] = _DASHES[index // len(_LOOKS) % len(_DASHES)]
        look["markersize"] = 5.0
        look_by_arm[arm] = look
    return look_by_arm


def has_robots(results: StudyResults) -> bool:
    """Return whether a study has robots that are no points of a series."""
    return any(not cell.series for cell in results.cells)


def has_series(results: StudyResults) -> bool:
    """Return whether a study has robots that are points of a series."""
    return any(cell.series for cell in results.cells)


def draw_robots(results: StudyResults, outcomes: Sequence[str]) -> MplFigure:
    """Draw outcomes of every arm on every robot that is not in a series, a row an outcome.

    Marks are means over seeds with 95 % intervals. The circles right of a mark are the means of its
    single seeds, in their order; on the line of the interval they could hardly be seen.

    Args:
        results: The study.
        outcomes: Names of the outcomes.
    """
    names = {cell.robot for cell in results.cells if not cell.series}
    robots = [robot for robot in results.robots if robot in names]
    looks_of_all = arm_looks(results.arms)
    look_by_arm = {arm: looks_of_all[arm] for arm in results.tried_arms}
    row_height = 3.0 if len(outcomes) == 1 else 1.9
    height = row_height * len(outcomes) + 0.7 + 0.2 * _legend_rows(results)
    with drawing(len(outcomes), height=height, sharex=True) as (figure, grid):
        width = min(ROOM, LARGEST_ARM_DISTANCE * (len(look_by_arm) - 1))
        shifts = offsets(len(look_by_arm), width)
        distance = min(ROOM / len(look_by_arm), _MAX_DISTANCE)
        for axes, outcome in zip(grid[:, 0], outcomes, strict=True):
            for shift, (arm, look) in zip(shifts, look_by_arm.items(), strict=True):
                for place, robot in enumerate(robots):
                    cell = results.cell(arm, robot, outcome)
                    _draw_mark(axes, cell, place + shift, look)
                    _draw_seeds(axes, cell, place + shift, distance, look)
            _dress(axes, outcome)
            axes.grid(visible=False, axis="x")
            for boundary in range(1, len(robots)):
                axes.axvline(boundary - 0.5, color="#e3e3e3", linewidth=0.7)
            axes.set_xlim(-0.5, len(robots) - 0.5)
            axes.set_xticks(range(len(robots)), robots)
        keys = []
        for arm, look in look_by_arm.items():
            mark: Look = {**look, "linestyle": "none"}
            keys.append(key(arm, **mark))
        legend(figure, keys, columns=LEGEND_COLUMNS)
    return figure


def _draw_mark(axes: Axes, cell: OutcomeCell, place: float, look: Look) -> None:
    """Draw the mean of a cell and its interval."""
    scale = OUTCOMES[cell.outcome].scale
    if np.isfinite(cell.low):
        axes.vlines(place, scale * cell.low, scale * cell.high, color=look["color"], linewidth=1.3)
    if np.isfinite(cell.value):
        axes.plot(
            place,
            scale * cell.value,
            linestyle="none",
            color=look["color"],
            marker=look["marker"],
            markersize=look["markersize"],
            zorder=3,
        )


def _draw_seeds(axes: Axes, cell: OutcomeCell, place: float, distance: float, look: Look) -> None:
    """Draw the means of the seeds of a cell beside its mark.

    Args:
        axes: Where to draw.
        cell: The cell.
        place: Place of its mark.
        distance: Distance of the marks of two arms.
        look: Look of its arm.
    """
    scale = OUTCOMES[cell.outcome].scale
    places = place + distance * np.linspace(_SEEDS_FROM, _SEEDS_TO, max(len(cell.by_seed), 2))
    for seed_place, value in zip(places, cell.by_seed.values(), strict=False):
        if value is not None:
            axes.plot(
                seed_place,
                scale * value,
                linestyle="none",
                marker=SEED_MARKER,
                markersize=4.0,
                markerfacecolor="none",
                markeredgecolor=look["color"],
                markeredgewidth=1.1,
                zorder=2,
            )


def draw_tolerance(results: StudyResults) -> MplFigure:
    """Draw outcomes over each series of conditions: rows are outcomes, columns series.

    Lines are means over the seeds of an arm, bands their 95 % intervals. A point without an
    interval has no band.
    """
    series = list(dict.fromkeys(cell.series for cell in results.cells if cell.series))
    tried = {cell.arm for cell in results.cells if cell.series and cell.jumps}
    arms = [arm for arm in results.arms if arm in tried]
    look_by_arm = arm_looks(results.arms)
    cells: dict[tuple[str, str, str], list[OutcomeCell]] = {}
    for cell in results.cells:
        if cell.series:
            cells.setdefault((cell.series, cell.outcome, cell.arm), []).append(cell)
    rows = len(results.outcomes)
    height = 1.75 * rows + 0.7 + 0.2 * _legend_rows(results)
    with drawing(rows, len(series), height=height, sharex="col", sharey="row") as (figure, grid):
        for column, name in enumerate(series):
            grid[-1, column].set_xlabel(name)
            for row, outcome in enumerate(results.outcomes):
                for arm in arms:
                    points = cells.get((name, outcome, arm), [])
                    _draw_curve(grid[row, column], points, look_by_arm[arm])
        for row, outcome in enumerate(results.outcomes):
            # The panels of a row share their axis.
            _dress(grid[row, 0], outcome)
        legend(figure, [key(arm, **look_by_arm[arm]) for arm in arms], columns=min(len(arms), 5))
    return figure


def _draw_curve(axes: Axes, cells: Sequence[OutcomeCell], look: Look) -> None:
    """Draw the points of one series of an arm in one outcome, with their band."""
    points = sorted(cells, key=lambda cell: cell.place or 0.0)
    if not points:
        return
    scale = OUTCOMES[points[0].outcome].scale
    places: Array = np.array([cell.place for cell in points], dtype=float)
    values: Array = scale * np.array([cell.value for cell in points])
    low: Array = scale * np.array([cell.low for cell in points])
    high: Array = scale * np.array([cell.high for cell in points])
    axes.fill_between(places, low, high, color=look["color"], alpha=0.13, linewidth=0.0)
    axes.plot(
        places,
        values,
        color=look["color"],
        linestyle=look["linestyle"],
        marker=look["marker"],
        markersize=3.0,
        linewidth=1.2,
    )


def _dress(axes: Axes, outcome: str) -> None:
    """Label an axis of an outcome; that of a share ends just outside of 0 to 100 %."""
    axes.set_ylabel(OUTCOMES[outcome].label)
    if OUTCOMES[outcome].is_share:
        low, high = axes.get_ylim()
        axes.set_ylim(max(low, -4.0), min(high, 104.0))


def _legend_rows(results: StudyResults) -> int:
    """Return the number of rows of the legend of the arms that were tried."""
    return -(-len(results.tried_arms) // LEGEND_COLUMNS)
