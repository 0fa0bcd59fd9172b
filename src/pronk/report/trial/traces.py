"""Jumps over time, and what they ask of the drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from pronk.actuator.model import torque_limits
from pronk.report import style
from pronk.report.trial.style import looks
from pronk.robots.robot import Robot

Array = NDArray[np.float64]


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
    """What one jump asks of the drives, beside what a drive can give, one panel a joint group.

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
