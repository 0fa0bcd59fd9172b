"""A deployment over time: modes, speed, tilt, battery, heat; and how the joints followed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from pronk.report import style
from pronk.report.deploy.data import flying, in_force, seconds, stretches, tilt
from pronk.runtime.ipc import Mode
from pronk.runtime.log import DeployLog

Array = NDArray[np.float64]

MODE_WORDS = {
    Mode.IDLE: "idle",
    Mode.PREFLIGHT: "pre-flight",
    Mode.DAMP: "damped",
    Mode.STAND: "stand up",
    Mode.POLICY: "policy",
    Mode.HALT: "halt",
    Mode.SIT: "sit down",
    Mode.FAULT: "fault",
    Mode.ENDED: "ended",
}
_MODE_COLOURS = {
    Mode.STAND: "#dcebf5",
    Mode.POLICY: "#9cc9e6",
    Mode.HALT: "#c3deef",
    Mode.SIT: "#dcebf5",
    Mode.FAULT: "#f3b48a",
}
_QUIET = "#ececec"
_JUMP = "#fbe3a3"
_FAULT = style.NAIVE
_MOVED = 1e-6
"""Smaller differences of what was asked and sent are not drawn [rad]."""
_LETTER = 0.0075
"""Width of a letter in a mode's bar, as a share of the axis."""
WINDOW_S = 1.2
"""Length of the joints' close-up [s]."""


def faults(log: DeployLog) -> tuple[float, ...]:
    """When faults began, since the first tick [s]."""
    return tuple(float(seconds(log, one.time)) for one in log.events if one.kind == "fault")


def jumps(log: DeployLog) -> tuple[tuple[float, float], ...]:
    """When the jump input was given, from and to, since the first tick [s]."""
    if not len(log.step_time):
        return ()
    t = seconds(log, log.step_time)
    edges = np.diff(np.concatenate([[0], (log.jump & log.step_live).astype(int), [0]]))
    ends = np.append(t, t[-1] + 0.02)
    return tuple(
        (float(ends[a]), float(ends[b]))
        for a, b in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True)
    )


def overview(log: DeployLog, heat: tuple[Array, Array] | None) -> Figure:
    """The whole run: modes, speeds asked and estimated, tilt, bus voltage, motor temperatures.

    Args:
        log: Of the run.
        heat: When and how hot each motor was, where it is measured.
    """
    volts = np.where(log.bus_voltage > 0.0, log.bus_voltage, np.nan)
    names = ["modes", "forward", "left", "turn", "tilt"]
    names += ["volts"] if np.isfinite(volts).any() else []
    names += [] if heat is None else ["heat"]
    t = seconds(log, log.time)
    with style.styled():
        drawn = Figure(figsize=(style.PAGE_WIDTH_IN, 1.3 * len(names) + 0.5), layout="constrained")
        ratios = [0.42, *[1.0] * (len(names) - 1)]
        grid = drawn.subplots(len(names), 1, sharex=True, height_ratios=ratios, squeeze=False)
        panels: dict[str, Axes] = dict(zip(names, grid[:, 0], strict=True))
        _modes(panels["modes"], log)
        _speeds(panels, log)
        limit = log.header.get("limits", {}).get("tilt")
        panels["tilt"].plot(t, tilt(log), color=style.MEASURED, linewidth=0.9)
        if limit is not None and np.isfinite(limit):
            panels["tilt"].axhline(limit, color=_FAULT, linewidth=1.0, linestyle=(0, (4, 2)))
        panels["tilt"].set_ylim(bottom=0.0)
        panels["tilt"].set_ylabel("tilt [rad]")
        if "volts" in panels:
            panels["volts"].plot(t, volts, color=style.MEASURED, linewidth=0.7)
            panels["volts"].set_ylabel("battery [V]")
        if heat is not None:
            for motor in heat[1].T:
                panels["heat"].plot(seconds(log, heat[0]), motor, linewidth=0.9)
            panels["heat"].set_ylabel("motors [°C]")
        for name, axes in panels.items():
            if name != "modes":
                for begin, end in jumps(log):
                    axes.axvspan(begin, end, color=_JUMP, zorder=0, linewidth=0.0)
            for at in faults(log):
                axes.axvline(at, color=_FAULT, linewidth=1.4)
        bottom = panels[names[-1]]
        bottom.set_xlim(0.0, max(float(t[-1]), 1e-3))
        bottom.set_xlabel("time since the first tick [s]")
        drawn.align_ylabels()
        drawn.legend(handles=_keys(log, limit), loc="outside lower center", ncols=5)
    return drawn


def _modes(axes: Axes, log: DeployLog) -> None:
    """A bar for each mode, with its name where there is room."""
    found = stretches(log)
    whole = sum(stretch.seconds for stretch in found)
    for stretch in found:
        colour = _MODE_COLOURS.get(stretch.mode, _QUIET)
        axes.axvspan(
            stretch.begin,
            stretch.begin + stretch.seconds,
            facecolor=colour,
            edgecolor="white",
            linewidth=1.0,
        )
        words = MODE_WORDS[stretch.mode]
        if stretch.seconds >= _LETTER * len(words) * whole:
            middle = stretch.begin + 0.5 * stretch.seconds
            axes.text(middle, 0.5, words, ha="center", va="center", fontsize=8.5)
    axes.set_ylim(0.0, 1.0)
    axes.set_yticks([])
    axes.grid(visible=False)
    axes.set_ylabel("mode")


def _speeds(panels: dict[str, Axes], log: DeployLog) -> None:
    """What was asked for, and what the estimator and the gyro say."""
    t, tick = seconds(log, log.step_time), seconds(log, log.time)
    live = log.step_live
    for i, (name, words) in enumerate(
        (("forward", "forward [m/s]"), ("left", "left [m/s]"), ("turn", "turn left [rad/s]"))
    ):
        axes = panels[name]
        if name == "turn":
            gyro = np.where(flying(log), log.gyro[:, 2], np.nan)
            axes.plot(tick, gyro, color=style.MEASURED_WIDE, linewidth=0.7)
        elif len(t):
            estimate = np.where(live, log.linear_velocity[:, i], np.nan)
            axes.plot(t, estimate, color=style.MEASURED_WIDE, linewidth=1.6)
        if len(t):
            asked = np.where(live, log.command[:, i], np.nan)
            axes.step(t, asked, where="post", color=style.MATCHED, linewidth=1.4)
        axes.axhline(0.0, color="#bbbbbb", linewidth=0.7)
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, -0.5), max(high, 0.5))
        axes.set_ylabel(words)


def _keys(log: DeployLog, limit: float | None) -> list[Line2D | Patch]:
    keys: list[Line2D | Patch] = [
        Line2D([], [], color=style.MATCHED, label="asked by the operator"),
        Line2D([], [], color=style.MEASURED_WIDE, label="the policy's estimate; turning: gyro"),
    ]
    if jumps(log):
        keys.append(Patch(color=_JUMP, label="jump input"))
    if limit is not None and np.isfinite(limit):
        keys.append(Line2D([], [], color=_FAULT, linestyle=(0, (4, 2)), label="largest allowed"))
    if faults(log):
        keys.append(Line2D([], [], color=_FAULT, linewidth=1.4, label="fault"))
    return keys


def window(log: DeployLog) -> tuple[float, float, str]:
    """What the close-up shows: from and to since the first tick [s], and what it is, in words.

    The time before the first fault; else about the first jump input; else the middle of the time
    in which the policy decided, or of the whole run.
    """
    ends, asked = faults(log), jumps(log)
    if ends:
        return max(ends[0] - 0.8 * WINDOW_S, 0.0), ends[0] + 0.2 * WINDOW_S, "about the first fault"
    if asked:
        return asked[0][0] - 0.15, asked[0][0] - 0.15 + WINDOW_S, "about the first jump input"
    live = np.flatnonzero(flying(log))
    times = seconds(log, log.time[live] if len(live) else log.time)
    middle = 0.5 * float(times[0] + times[-1])
    words = "while the policy decides" if len(live) else "in the middle of the run"
    return middle - 0.5 * WINDOW_S, middle + 0.5 * WINDOW_S, words


def joints(log: DeployLog, begin: float, end: float) -> Figure | None:
    """Targets and positions of every joint in a short time; None if no tick lies in it.

    Args:
        log: Of the run.
        begin: Since the first tick [s].
        end: The same.
    """
    t = seconds(log, log.time)
    there = (t >= begin) & (t <= end)
    if not there.any():
        return None
    rows = style.grid_of_joints(log.joints)
    with np.errstate(invalid="ignore"):
        moved = bool((np.abs(log.desired - log.sent)[there] > _MOVED).any())
    shown = [(max(a, begin), min(b, end)) for a, b in jumps(log) if a < end and b > begin]
    with style.styled():
        drawn, panels = style.small_multiples(rows, height=1.55, sharey="row")
        lowest = style.bottom_row(rows)
        for i, name in enumerate(log.joints):
            axes = panels[name]
            _joint(axes, log, i, there)
            for at in faults(log):
                if begin <= at <= end:
                    axes.axvline(at, color=_FAULT, linewidth=1.4)
            for a, b in shown:
                axes.axvspan(a, b, color=_JUMP, zorder=0, linewidth=0.0)
            axes.set_title(style.joint_words(name), fontsize=9)
            axes.set_xlim(begin, end)
            if name in lowest:
                axes.set_xlabel("time [s]")
        for row in rows:
            panels[row[0]].set_ylabel("[rad]")
        keys: list[Line2D | Patch] = [
            Line2D([], [], **style.MEASURED_LINE, label="measured"),
            Line2D([], [], color=style.MATCHED, linewidth=1.2, label="target sent"),
        ]
        if moved:
            keys.append(Line2D([], [], **_ASKED, label="target asked, where the filter moved it"))
        if shown:
            keys.append(Patch(color=_JUMP, label="jump input"))
        if any(begin <= at <= end for at in faults(log)):
            keys.append(Line2D([], [], color=_FAULT, linewidth=1.4, label="fault"))
        drawn.legend(handles=keys, loc="outside lower center", ncols=len(keys))
    return drawn


_ASKED: dict[str, Any] = {"color": _FAULT, "linestyle": (0, (2, 1)), "linewidth": 1.2}


def _joint(axes: Axes, log: DeployLog, i: int, there: NDArray[np.bool_]) -> None:
    t = seconds(log, log.time)[there]
    axes.plot(
        seconds(log, log.state_time)[there],
        log.position[there, i],
        color=style.MEASURED_WIDE,
        linewidth=2.6,
    )
    asked, sent = log.desired[there, i], in_force(log)[there, i]
    now = log.sent[there, i]
    with np.errstate(invalid="ignore"):
        axes.step(t, np.where(np.abs(asked - now) > _MOVED, asked, np.nan), where="post", **_ASKED)
    axes.step(t, sent, where="pre", color=style.MATCHED, linewidth=1.0)


def marked(log: DeployLog, names: Sequence[str], rows: Sequence[NDArray[np.bool_]]) -> Figure:
    """When something was the case: a row of marks for each thing.

    Args:
        log: Of the run.
        names: Of the things.
        rows: Ticks in which each was the case. Each (T,).
    """
    t = seconds(log, log.time)
    with style.styled():
        drawn = Figure(figsize=(style.PAGE_WIDTH_IN, 0.7 + 0.32 * len(rows)), layout="constrained")
        axes = drawn.subplots()
        for i, row in enumerate(rows):
            axes.plot(
                t[row], np.full(row.sum(), i), linestyle="none", marker="|", markersize=11.0,
                color=style.MATCHED,
            )  # fmt: skip
        for at in faults(log):
            axes.axvline(at, color=_FAULT, linewidth=1.4)
        axes.set_yticks(range(len(rows)), names)
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlim(0.0, max(float(t[-1]), 1e-3))
        axes.set_xlabel("time since the first tick [s]")
    return drawn
