"""How late, how old, how long: a deployment's times as histograms and over the run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from pronk.report import style
from pronk.report.deploy.data import flying, seconds, spread, until_fault
from pronk.runtime.log import DeployLog

Array = NDArray[np.float64]

_LEAST_MS = 1e-3
"""What is shorter is drawn there: a microsecond, about what the clock tells."""
_PER_DECADE = 20
_SHARES = (("p50", "50 %"), ("p99", "99 %"), ("p99_9", "99.9 %"))
_DASHES = ("-", (0, (5, 2)), (0, (1, 1.5)))
_LIMITS = (("hold_s", "held"), ("damp_s", "damped"), ("latch_s", "latched"))


@dataclass(frozen=True, kw_only=True)
class TimeLimit:
    """One kind of time."""

    name: str
    values: Array
    """[s] (N,)"""
    says: str
    """What it is, in one line."""


def times(log: DeployLog) -> tuple[TimeLimit, ...]:
    """Everything that was timed and happened at all."""
    live = flying(log)
    found = (
        TimeLimit(
            name="servo tick late",
            values=log.lateness,
            says="from a tick's deadline to its begin, every tick of the run",
        ),
        TimeLimit(
            name="age of the state at a tick",
            values=log.state_age[: until_fault(log)],
            says="from the newest state to the tick's begin, every tick until a fault",
        ),
        TimeLimit(
            name="state to command",
            values=log.latency[live],
            says="from the state that the policy read to the first command on the wire that "
            "answers it, while the policy decided",
        ),
        TimeLimit(
            name="servo's work",
            values=log.work,
            says="from a tick's begin until its command was on the wire, every tick",
        ),
        TimeLimit(
            name="policy step late",
            values=log.step_lateness[log.step_live],
            says="from a step's deadline to its begin, while the policy decided",
        ),
        TimeLimit(
            name="policy's decision",
            values=log.decision[log.step_live],
            says="observation built and network run, while the policy decided",
        ),
    )
    return tuple(one for one in found if np.isfinite(one.values).any())


def histograms(log: DeployLog, trained: tuple[float, float] | None) -> Figure:
    """Histograms of all times, counts and times on logarithmic axes.

    Args:
        log: Of the run.
        trained: Command delays that the policy was trained for [s].
    """
    found = times(log)
    rows = -(-len(found) // 2)
    with style.styled():
        drawn = Figure(figsize=(style.PAGE_WIDTH_IN, 2.25 * rows + 0.3), layout="constrained")
        grid = drawn.subplots(rows, 2, sharex=True, squeeze=False).ravel()
        for axes, one in zip(grid, found, strict=False):
            _histogram(axes, one)
            if one.name == "state to command" and trained is not None:
                low, high = (1e3 * edge for edge in trained)
                axes.axvspan(max(low, _LEAST_MS), high, color=style.BAND, zorder=0)
                axes.text(
                    0.02, 0.95, f"trained for {low:g} to {high:g} ms", transform=axes.transAxes,
                    ha="left", va="top", fontsize=8.5, color="#6b5d20",
                )  # fmt: skip
            if one.name.startswith("age"):
                _limits(axes, log)
        for axes in grid[len(found) :]:
            axes.set_visible(False)
        for axes in grid[max(len(found) - 2, 0) : len(found)]:
            axes.set_xlabel("[ms]")
            axes.tick_params(labelbottom=True)
        longest = max(float(np.nanmax(one.values)) for one in found)
        grid[0].set_xlim(_LEAST_MS, max(2e3 * longest, 2e2))
        grid[0].set_xscale("log")
        grid[0].xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        grid[0].xaxis.set_minor_formatter(NullFormatter())
    return drawn


def _histogram(axes: Axes, one: TimeLimit) -> None:
    values = np.maximum(1e3 * one.values[np.isfinite(one.values)], _LEAST_MS)
    decades = int(np.ceil(np.log10(max(values.max() / _LEAST_MS, 10.0)))) + 1
    edges = _LEAST_MS * 10.0 ** (np.arange(decades * _PER_DECADE + 1) / _PER_DECADE)
    axes.hist(values, bins=list(edges), color=style.MEASURED_WIDE, histtype="stepfilled")
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.7)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    at = spread(one.values)
    for (key, words), dash in zip(_SHARES, _DASHES, strict=True):
        value = 1e3 * float(getattr(at, key))
        if np.isfinite(value):
            axes.axvline(
                max(value, _LEAST_MS),
                color=style.MATCHED,
                linewidth=1.3,
                linestyle=dash,
                label=f"{words}: {value:{'.0f' if value >= 100.0 else '.3g'}} ms",
            )
    axes.set_title(f"{one.name}, n = {at.n}")
    axes.legend(loc="upper right", fontsize=8, frameon=True, edgecolor="none", framealpha=0.85)


def _limits(axes: Axes, log: DeployLog) -> None:
    """Ages at which the filter holds, damps and latches."""
    limits = log.header.get("limits", {})
    for key, words in _LIMITS:
        if key in limits:
            at = 1e3 * float(limits[key])
            axes.axvline(at, color=style.NAIVE, linewidth=1.0)
            axes.text(
                at * 0.95, 0.03, words, transform=axes.get_xaxis_transform(), rotation=90,
                ha="right", va="bottom", fontsize=7.5, color="#8a3d00",
            )  # fmt: skip


def over_time(log: DeployLog, ends: tuple[float, ...]) -> Figure:
    """Lateness and age of the state at every tick, and each answer, over the run.

    Args:
        log: Of the run.
        ends: When faults began, since the first tick [s].
    """
    t = seconds(log, log.time)
    shown = (
        ("tick late [ms]", log.lateness),
        ("age of state [ms]", log.state_age),
        ("state to command [ms]", log.latency),
    )
    with style.styled():
        drawn = Figure(figsize=(style.PAGE_WIDTH_IN, 5.2), layout="constrained")
        grid = drawn.subplots(3, 1, sharex=True)
        for axes, (words, values) in zip(grid, shown, strict=True):
            axes.plot(
                t,
                np.maximum(1e3 * values, _LEAST_MS),
                linestyle="none",
                marker=".",
                markersize=2.5,
                color=style.MEASURED,
            )
            axes.set_yscale("log")
            low, high = axes.get_ylim()
            axes.set_ylim(10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high)))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
            axes.set_ylabel(words)
            for at in ends:
                axes.axvline(at, color=style.NAIVE, linewidth=1.4)
        grid[-1].set_xlim(0.0, max(float(t[-1]), 1e-3))
        grid[-1].set_xlabel("time since the first tick [s]")
        drawn.align_ylabels()
    return drawn
