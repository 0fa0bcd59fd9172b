"""What a bench found: a row for each tool in each scenario, as JSON and as a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import orjson
from rich.table import Table

from benchmarks.known_truth import Scenario, Truth
from benchmarks.peers import POPULATION, Estimate
from pronk.files import write_text

SCHEMA = "pronk/bench-match/1"


@dataclass(frozen=True, kw_only=True)
class Row:
    """One tool in one scenario. Errors are relative to the truth [%]; stiffness, then damping."""

    scenario: str
    tool: str
    free: str
    """Free parameters."""
    trials: int
    stiffness_bias: float
    stiffness_sd: float
    """Standard deviation over the trials; NaN for one trial."""
    damping_bias: float
    damping_sd: float
    intervals: int
    """Intervals given, two a trial; 0 for a tool without."""
    covered: int
    """Those that hold the truth."""
    stiffness_half_width: float
    """Mean half-width of the 95 % intervals; NaN without."""
    damping_half_width: float
    seconds: float
    """Mean wall time of a fit [s]."""
    delay_ms: float
    """Mean delay found; NaN where none was fitted [ms]."""
    estimates: tuple[tuple[float, float], ...]
    """(stiffness, damping) of each trial [N m/rad, N m s/rad]."""


@dataclass(frozen=True, kw_only=True)
class BenchResult:
    """The table and what it rests on."""

    rows: tuple[Row, ...]
    truth: Truth
    scenarios: tuple[Scenario, ...]
    joint: str
    trials: int
    seed: int
    repeats: int
    """Chirps in each log."""
    start: tuple[float, float]
    """Stiffness and damping that every peer begins with: those on the real drive."""
    bounds: tuple[tuple[float, float], tuple[float, float]]
    machine: dict[str, str]
    seconds: float
    """Wall time of the whole run [s]."""

    def to_json(self, path: Path | None = None) -> str:
        """The result as JSON; NaN becomes null.

        Args:
            path: Also write it there, whole or not at all.
        """
        body = {"schema": SCHEMA, **asdict(self)}
        text = orjson.dumps(body, option=orjson.OPT_INDENT_2).decode()
        if path is not None:
            write_text(path, text + "\n")
        return text


def row(scenario: str, tool: str, free: str, estimates: Sequence[Estimate], truth: Truth) -> Row:
    """Sum up one tool in one scenario."""
    gains = np.array([(one.stiffness, one.damping) for one in estimates])
    right = np.array([truth.stiffness, truth.damping])
    error = 100.0 * (gains / right - 1.0)
    count = len(estimates)
    sd = error.std(axis=0, ddof=1) if count > 1 else np.full(2, np.nan)
    given = [one.interval for one in estimates if one.interval is not None]
    bounds = np.array(given).reshape(-1, 2, 2)
    inside = (bounds[..., 0] <= right) & (right <= bounds[..., 1])
    half = np.full(2, np.nan)
    if given:
        half = 100.0 * np.mean(0.5 * np.diff(bounds, axis=-1)[..., 0], axis=0) / right
    delays = [one.delay_s for one in estimates if one.delay_s is not None]
    return Row(
        scenario=scenario,
        tool=tool,
        free=free,
        trials=count,
        stiffness_bias=float(error[:, 0].mean()),
        stiffness_sd=float(sd[0]),
        damping_bias=float(error[:, 1].mean()),
        damping_sd=float(sd[1]),
        intervals=2 * len(given),
        covered=int(inside.sum()),
        stiffness_half_width=float(half[0]),
        damping_half_width=float(half[1]),
        seconds=float(np.mean([one.seconds for one in estimates])),
        delay_ms=1e3 * float(np.mean(delays)) if delays else float("nan"),
        estimates=tuple((one.stiffness, one.damping) for one in estimates),
    )


def table(result: BenchResult) -> Table:
    """The result as one table for a terminal."""
    scenarios = "; ".join(f"{one.name}: {one.words}" for one in result.scenarios)
    shown = Table(
        title=f"{result.joint}, truth {result.truth.stiffness:g} N m/rad and "
        f"{result.truth.damping:g} N m s/rad; {result.trials} logs of {result.repeats} chirps a "
        f"scenario, seed {result.seed}",
        caption=f"{scenarios}.\nFree: stiffness and damping, and a delay where the name says so. "
        "Errors: estimate over truth, mean +/- sd over the logs. Coverage: 95 % intervals, of "
        "stiffness and of damping, that hold the truth. Half-widths: of stiffness / damping.\n"
        f"CMA-ES in PACE's manner: {POPULATION} simulations a generation on this CPU; PACE runs "
        f"4,096 on a GPU. {result.machine['cores']} cores ({result.machine['processor']}), MuJoCo "
        f"{result.machine['mujoco']}, Python {result.machine['python']}; {result.seconds:.0f} s "
        "in all.",
        caption_justify="left",
    )
    shown.add_column("tool", no_wrap=True)
    for name in ("logs", "stiffness [%]", "damping [%]", "coverage", "half-widths [%]"):
        shown.add_column(name, justify="right")
    shown.add_column("fit [s]", justify="right")
    shown.add_column("delay [ms]", justify="right")
    for scenario in result.scenarios:
        shown.add_section()
        shown.add_row(f"[bold]{scenario.name}[/]")
        for one in result.rows:
            if one.scenario == scenario.name:
                shown.add_row(*_cells(one))
    return shown


def _cells(one: Row) -> tuple[str, ...]:
    def error(bias: float, sd: float) -> str:
        return f"{bias:+.2f}" if np.isnan(sd) else f"{bias:+.2f} +/- {sd:.2f}"

    halves = f"{one.stiffness_half_width:.2f} / {one.damping_half_width:.2f}"
    return (
        one.tool,
        str(one.trials),
        error(one.stiffness_bias, one.stiffness_sd),
        error(one.damping_bias, one.damping_sd),
        f"{one.covered} of {one.intervals}" if one.intervals else "no intervals",
        halves if one.intervals else "",
        f"{one.seconds:.2f}",
        "" if np.isnan(one.delay_ms) else f"{one.delay_ms:.1f}",
    )
