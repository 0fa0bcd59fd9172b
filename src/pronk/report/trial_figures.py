"""Figures of trials: jumps beside the paper's, traces over time, outcomes over conditions."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as MplFigure
from matplotlib.lines import Line2D

from pronk.arrays import Array
from pronk.jump.trial.condition_trial import ConditionCell, ConditionResults
from pronk.jump.trial.conditions import Condition
from pronk.jump.trial.results import Spread
from pronk.report import style
from pronk.report.style import drawing, key, legend

Values = Mapping[str, Mapping[str, Array]]
"""By policy, then by command: one number a jump."""
Published = Mapping[str, Mapping[str, tuple[float, float]]]
"""By policy, then by command: mean and standard deviation that the paper gives."""
Traces = Mapping[str, Mapping[str, Sequence[Array]]]
"""By policy, then by command: runs as time [s] and value, each (2, T)."""

_PAPER_LOOKS = {"naive": (style.NAIVE, "D"), "matched": (style.MATCHED, "o")}
"""Colour and marker of the policies that the paper has."""
_OTHER_LOOKS = (("#009E73", "s"), ("#56B4E9", "^"), ("#E69F00", "v"), ("#7a5195", "P"))
"""Colours and markers of other policies, in turn."""
_DASHED: dict[str, Any] = {"color": "#666666", "linewidth": 0.9, "linestyle": (0, (2, 2))}
_PAPER: dict[str, Any] = {
    "linestyle": "none",
    "markersize": 6.5,
    "markerfacecolor": "white",
    "markeredgecolor": style.PAPER,
    "markeredgewidth": 1.4,
}
FEWEST_JUMPS = 5
"""Jumps of a command from which on a standard deviation is drawn; the paper has five."""


def looks(policies: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return colour and marker of each policy."""
    spare = itertools.cycle(_OTHER_LOOKS)
    look_by_policy = {}
    for name in policies:
        colour, marker = _PAPER_LOOKS[name] if name in _PAPER_LOOKS else next(spare)
        look_by_policy[name] = {"color": colour, "marker": marker}
    return look_by_policy


def _policy_keys(policies: Sequence[str], **changes: Any) -> list[Line2D]:
    """Return the legend's entries of the policies; `changes` are of their lines."""
    keys = []
    for name, look in looks(policies).items():
        keys.append(key(f"{name}, virtual robot", **(look | changes)))
    return keys


def offsets(count: int, width: float) -> Array:
    """Return the places of several marks about zero, `width` from the first to the last."""
    if count == 1:
        return np.zeros(1)
    return np.linspace(-0.5, 0.5, count) * width


def commands_of(values: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the commands of all policies in the order in which they first appear."""
    commands: list[str] = []
    for cases in values.values():
        for name in cases:
            if name not in commands:
                commands.append(name)
    return commands


# ---- jumps beside the paper's ----


@dataclass(frozen=True, kw_only=True)
class JumpPanel:
    """One figure of every jump, and what the paper published of it."""

    label: str
    """Label of the axis, with the unit."""
    values: Values
    published: Published


def draw_jumps(panels: Sequence[JumpPanel]) -> MplFigure:
    """Draw every jump with mean and standard deviation, beside the paper's; a row a panel."""
    panel_height = 2.9 if len(panels) < 3 else 2.1
    height = panel_height * len(panels) + 0.5
    with drawing(len(panels), height=height, sharex=True) as (figure, grid):
        for axes, panel in zip(grid[:, 0], panels, strict=True):
            _draw_jump_panel(axes, panel)
        policies = list(panels[0].values)
        keys = _policy_keys(policies, linestyle="none")
        for name in policies:
            if any(name in panel.published for panel in panels):
                marker = _PAPER_LOOKS[name][1]
                keys.append(key(f"paper, hardware, {name}", marker=marker, **_PAPER))
        legend(figure, keys)
    return figure


def _draw_jump_panel(axes: Axes, panel: JumpPanel) -> None:
    """Draw one figure of every jump: a group of marks a command, in it a column a policy."""
    commands = commands_of(panel.values)
    look_by_policy = looks(list(panel.values))
    published_count = sum(name in panel.published for name in look_by_policy)
    places = offsets(len(look_by_policy) + published_count, 0.62)
    for index, command in enumerate(commands):
        columns = iter(index + places)
        for name, look in look_by_policy.items():
            if name in panel.published:
                place = next(columns)
                if command in panel.published[name]:
                    mean, std = panel.published[name][command]
                    _draw_published(axes, place, mean, std, look["marker"])
            place = next(columns)
            jumps = np.asarray(panel.values[name].get(command, ()), dtype=float)
            jumps = jumps[np.isfinite(jumps)]
            if len(jumps):
                _draw_measured(axes, place, jumps, look)
    axes.set_ylabel(panel.label)
    axes.set_xticks(range(len(commands)), commands)
    axes.set_xlim(-0.55, len(commands) - 0.45)
    axes.grid(visible=False, axis="x")
    low, high = axes.get_ylim()
    axes.set_ylim(min(0.0, low), 1.04 * high)


def _draw_published(axes: Axes, place: float, mean: float, std: float, marker: str) -> None:
    axes.errorbar(
        place, mean, yerr=std, marker=marker, ecolor=style.PAPER, capsize=3.0, zorder=3, **_PAPER
    )


def _draw_measured(axes: Axes, place: float, jumps: Array, look: Mapping[str, Any]) -> None:
    """Draw every jump as a small mark, and mean and standard deviation beside them."""
    spread = Spread.of(jumps)
    marks = place + np.linspace(-0.05, 0.03, len(jumps))
    axes.plot(marks, jumps, linestyle="none", alpha=0.45, markersize=4.5, **look)
    std = spread.std if spread.n >= FEWEST_JUMPS else 0.0
    axes.errorbar(
        place + 0.06,
        spread.mean,
        yerr=std,
        capsize=3.5,
        markeredgecolor="white",
        zorder=4,
        **look,
    )


# ---- outcomes over conditions ----


@dataclass(frozen=True, kw_only=True)
class _Outcome:
    """One row of the figure of conditions."""

    label: str
    value: Array
    """One number a condition. (n,)"""
    low: Array
    """Lower end of its bar. (n,)"""
    high: Array
    """Upper end of its bar. (n,)"""


def draw_conditions(results: ConditionResults) -> MplFigure:
    """Draw landings, height, distance and velocity error over the conditions, a line a policy.

    Each series of conditions is a column of panels; conditions by themselves are one more.
    """
    look_by_policy = looks(results.policy_names)
    columns: dict[str, list[Condition]] = {}
    for condition in results.conditions:
        columns.setdefault(condition.series, []).append(condition)
    with drawing(4, len(columns), height=9.0, sharex="col", sharey="row") as (figure, grid):
        for column, (series, conditions) in enumerate(columns.items()):
            if series:
                conditions = sorted(conditions, key=lambda condition: condition.place or 0.0)
                places = np.array([condition.place for condition in conditions])
                grid[-1, column].set_xlabel(series)
            else:
                places = np.arange(len(conditions))
                labels = [condition.name for condition in conditions]
                grid[-1, column].set_xticks(places, labels, rotation=30, ha="right")
            for policy, look in look_by_policy.items():
                cells = []
                for condition in conditions:
                    cells.append(results.cell(policy, condition.name))
                for row, outcome in enumerate(_outcomes(cells)):
                    axes = grid[row, column]
                    line = "-" if series else "none"
                    axes.plot(places, outcome.value, linestyle=line, **look)
                    axes.vlines(places, outcome.low, outcome.high, color=look["color"])
                    if column == 0:
                        axes.set_ylabel(outcome.label)
        grid[0, 0].set_ylim(-0.04, 1.04)
        keys = _policy_keys(results.policy_names)
        bar_look: dict[str, Any] = {"color": "#444444", "marker": "|", "linestyle": "none"}
        keys.append(key("95 % interval of the share; standard deviation", **bar_look))
        legend(figure, keys)
    return figure


def _outcomes(cells: Sequence[ConditionCell]) -> list[_Outcome]:
    """Return the rows of the figure, of one policy under several conditions."""
    shares = []
    intervals = []
    heights = []
    distances = []
    velocity_errors = []
    for cell in cells:
        shares.append(cell.landed_share)
        intervals.append(cell.landed_interval)
        heights.append((cell.height.mean, cell.height.std))
        distances.append((cell.distance.mean, cell.distance.std))
        velocity_errors.append((cell.velocity_error.mean, cell.velocity_error.std))
    low, high = np.array(intervals).T
    return [
        _Outcome(label="landed [1]", value=np.array(shares), low=low, high=high),
        _spread_outcome("height [m]", heights),
        _spread_outcome("distance [m]", distances),
        _spread_outcome("velocity error [m/s]", velocity_errors),
    ]


def _spread_outcome(label: str, spreads: Sequence[tuple[float, float]]) -> _Outcome:
    """Return the row of an outcome by its means and standard deviations, NaN of one jump."""
    mean, std = np.array(spreads).T
    std = np.nan_to_num(std)
    return _Outcome(label=label, value=mean, low=mean - std, high=mean + std)


# ---- traces ----


def draw_traces(quantities: Mapping[str, Traces], *, x_label: str, level: float) -> MplFigure:
    """Draw runs over time: a row for each quantity and policy, a column for each command.

    Args:
        quantities: Runs by the quantity's name with its unit.
        x_label: Label of the time axis.
        level: A value that is drawn dashed in each panel.
    """
    first = next(iter(quantities.values()))
    commands = commands_of(first)
    look_by_policy = looks(list(first))
    rows = list(itertools.product(quantities, look_by_policy))
    height = 1.7 * len(rows) + 0.6
    with drawing(len(rows), len(commands), height=height, sharex=True, sharey="row") as drawn:
        figure, grid = drawn
        for row, (quantity, policy) in enumerate(rows):
            colour = look_by_policy[policy]["color"]
            for column, command in enumerate(commands):
                axes = grid[row, column]
                for time, value in quantities[quantity][policy].get(command, ()):
                    axes.plot(time, value, color=colour, linewidth=0.7, alpha=0.55)
                axes.axhline(level, **_DASHED)
            grid[row, 0].set_ylabel(f"{policy}\n{quantity}")
        for column, command in enumerate(commands):
            grid[0, column].set_title(command)
            grid[-1, column].set_xlabel(x_label)
        keys = []
        for policy, look in look_by_policy.items():
            keys.append(key(f"{policy}, virtual robot", color=look["color"]))
        legend(figure, keys)
    return figure
