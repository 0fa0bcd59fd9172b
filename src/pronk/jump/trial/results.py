"""The results of a trial: a JSON file with what was run, every run and sums, and a CSV table.

Jumps, walks, varied robots and crossings differ by their `Kind`. Unknown numbers are NaN, in CSV an
empty cell, in JSON null. pronk reads the runs in the JSON file; its sums, and the table with one
row a run, are for other readers.
"""

from __future__ import annotations

import csv
import io
import json
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from pronk.arrays import Array
from pronk.errors import ArtefactError
from pronk.files import write_text
from pronk.jump.trial.jumps import JumpFigures, figures_of, measure
from pronk.jump.trial.protocol import PAPER_COMMANDS, Case
from pronk.policy.script import Script

RESAMPLES = 4999
"""Of a bootstrap."""
FEWEST = 5
"""Jumps, the paper's number, below which the bootstrap gives no interval: a resample is too often
one jump alone, which does not scatter."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of runs: how one is measured, and the files of its results."""

    table: str
    summary: str
    schema: str
    writer: str
    """The command that writes it."""
    figures: type[Any] = JumpFigures
    """Dataclass of one run's figures: flags, texts, and numbers with `Figure` metadata."""
    measure: Callable[..., Any] = measure
    """From capture to figures; a function of a module."""
    compared: tuple[str, ...] = ()
    """Figures whose scatter is compared between policies."""
    jump: bool = True
    """The policies need the jump input."""


JUMPS = Kind(
    table="trials.csv",
    summary="summary.json",
    schema="pronk/trial/4",
    writer="pronk trial POLICY --out FOLDER",
    compared=(
        *("height", "apex_gain", "lift_off_velocity", "distance", "along"),
        *("distance_minima", "gap"),
    ),
)
TABLE, SUMMARY = JUMPS.table, JUMPS.summary


def extra_kind(name: str, **fields: Any) -> Kind:
    """Return the kind of an option of `pronk trial`, which names its files."""
    return Kind(
        table=f"{name}.csv",
        summary=f"{name}.json",
        schema=f"pronk/trial-{name}/4",
        writer=f"pronk trial POLICY --{name}",
        **fields,
    )


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A policy under trial."""

    name: str
    path: str
    sha256: str
    contract: Mapping[str, Any]
    """Robot, gains with their hash, rates, delays, ranges."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One run."""

    policy: str
    case: str
    """Name of the command."""
    number: int
    """0 for the first run with this command."""
    seed: int
    """Of the virtual robot's noise."""
    script: Script
    """With the time of this run's jump input."""
    figures: Any = None
    """Of the kind's class, `JumpFigures` for jumps; None before the run."""
    capture: str = ""
    """The capture's file beside the table; empty if it was not kept."""
    began: float = 0.0
    """When the policy took over, on the capture's clock [s]."""
    parameter: str = ""
    """Of the body, that is varied; empty for none."""
    value: float = math.nan


@dataclass(frozen=True, kw_only=True)
class Spread:
    """A figure over the `n` runs that have it; NaN where there are none."""

    mean: float = math.nan
    std: float = math.nan
    """With n - 1; NaN for one."""
    least: float = math.nan
    p05: float = math.nan
    p50: float = math.nan
    p95: float = math.nan
    most: float = math.nan
    n: int = 0

    @classmethod
    def of(cls, values: ArrayLike) -> Self:
        """Sum up one value a run; unknown ones are left out."""
        known = np.asarray(values, dtype=float)
        known = known[np.isfinite(known)]
        if not len(known):
            return cls()
        quantiles = np.quantile(known, [0.0, 0.05, 0.5, 0.95, 1.0]).tolist()
        return cls(
            **dict(zip(("least", "p05", "p50", "p95", "most"), quantiles, strict=True)),
            mean=float(known.mean()),
            std=float(known.std(ddof=1)) if len(known) > 1 else math.nan,
            n=len(known),
        )


@dataclass(frozen=True, kw_only=True)
class Cell:
    """The runs of one policy with one command, and of one varied body if there are any."""

    policy: str
    case: str
    parameter: str
    value: float
    n: int
    standing: int
    """Robots that had not fallen when the jump input came."""
    found: int
    """Jumps there were."""
    succeeded: int
    success: float
    """Share of all n."""
    success_ci95: tuple[float, float]
    """Wilson's interval of it."""
    fell: int
    non_foot_contact: int
    figures: Mapping[str, Spread]
    """Over the runs with a jump; over all runs of another kind."""
    joints: Mapping[str, Mapping[str, Spread]]
    """By figure, then by joint."""


@dataclass(frozen=True)
class Ratio:
    """Scatter of another policy over that of the first."""

    figure: str
    case: str | None
    """None: sums of the standard deviations over the paper's commands, which is the ratio of their
    means (reading A4); over all commands if none of the paper's was run."""
    policy: str
    other: str
    value: float
    """Standard deviation of the other over that of the first."""
    low: float
    high: float
    """95 % bootstrap interval; NaN with fewer than `FEWEST` jumps of either policy in a command."""
    n: tuple[int, int]
    """Jumps of the first and of the other."""


@dataclass(frozen=True, kw_only=True)
class Results:
    """The runs of one kind, and what was run."""

    kind: Kind = JUMPS
    rows: tuple[Row, ...] = ()
    """By policy, then command, then number."""
    robot: str
    virtual: bool = True
    """Measured on pronk's virtual robot."""
    subjects: tuple[Subject, ...]
    cases: tuple[Case, ...]
    joint_names: tuple[str, ...] = ()
    seed: int
    sim_params: Mapping[str, Any]
    """The virtual robot's parameters: their file and its hash."""
    script: Script
    """Without the spread of the jump input's time."""
    spread_s: float = 0.0
    rules: Mapping[str, float] = field(default_factory=dict)
    """`JumpRules` of the definitions."""
    mass: float = 0.0
    """Of the robot, for the cost of transport [kg]; 0 where there is none."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """What else belongs to the kind."""
    versions: Mapping[str, str] = field(default_factory=dict)
    timing: Mapping[str, float] = field(default_factory=dict)
    """Wall seconds, simulated seconds, processes: the only numbers that a repeat changes."""

    @property
    def pooled(self) -> tuple[str, ...]:
        """Commands that an overall figure is over: the paper's, or all without them."""
        paper = tuple(case.name for case in self.cases if case in PAPER_COMMANDS)
        return paper or tuple(case.name for case in self.cases)

    def of(self, policy: str, case: str) -> tuple[Row, ...]:
        """Return the runs of one policy with one command."""
        return tuple(row for row in self.rows if (row.policy, row.case) == (policy, case))

    def values(self, policy: str, case: str, figure: str) -> Array:
        """Return the known values of one figure, of the jumps that were found."""
        rows = [row.figures for row in self.of(policy, case) if getattr(row.figures, "found", True)]
        known: Array = np.array([getattr(figures, figure) for figures in rows], dtype=float)
        return known[np.isfinite(known)]

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """Every policy with every command, on every varied body."""
        groups: dict[tuple[str, ...], list[Row]] = {}
        for row in self.rows:
            # The value as text: NaN is equal to nothing.
            key = (row.parameter, str(row.value), row.policy, row.case)
            groups.setdefault(key, []).append(row)
        return tuple(self._cell(rows) for rows in groups.values())

    def cell(self, policy: str, case: str) -> Cell:
        """Return one of `cells`."""
        return next(c for c in self.cells if (c.policy, c.case) == (policy, case))

    def _cell(self, rows: Sequence[Row]) -> Cell:
        every = [row.figures for row in rows]
        found = [each for each in every if getattr(each, "found", True)]
        succeeded, figures, joints = sum(each.success for each in every), {}, {}
        for name, figure in figures_of(self.kind.figures).items():
            values = [getattr(each, name) for each in found]
            if figure.joints:
                known = [value for value in values if value]
                columns = zip(*known, strict=True) if known else [()] * len(self.joint_names)
                joints[name] = dict(zip(self.joint_names, map(Spread.of, columns), strict=True))
            else:
                figures[name] = Spread.of(values)
        head = {name: getattr(rows[0], name) for name in ("policy", "case", "parameter", "value")}
        flags = ("standing", "fell", "non_foot_contact")
        counts = {k: sum(getattr(each, k, k == "standing") for each in every) for k in flags}
        return Cell(
            **head,
            **counts,
            n=len(rows),
            found=len(found),
            succeeded=succeeded,
            success=succeeded / len(rows),
            success_ci95=share_interval(succeeded, len(rows)),
            figures=figures,
            joints=joints,
        )

    @cached_property
    def ratios(self) -> tuple[Ratio, ...]:
        """Scatter of every other policy over that of the first, by command and altogether."""
        first, found = self.subjects[0].name, []
        for other in (subject.name for subject in self.subjects[1:]):
            for figure in self.kind.compared:
                for case in (None, *(case.name for case in self.cases)):
                    cases = self.pooled if case is None else (case,)
                    own = [self.values(first, each, figure) for each in cases]
                    others = [self.values(other, each, figure) for each in cases]
                    scatter = ratio_of_scatter(own, others, seed=self.seed)
                    n = (sum(map(len, own)), sum(map(len, others)))
                    found.append(Ratio(figure, case, first, other, *scatter, n))
        return tuple(found)


def share_interval(count: int, n: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    from scipy.stats import binomtest

    low, high = binomtest(count, n).proportion_ci(0.95, method="wilson")
    return float(low), float(high)


def ratio_of_scatter(
    own: Sequence[Array], others: Sequence[Array], *, seed: int, resamples: int = RESAMPLES
) -> tuple[float, float, float]:
    """Sum of the standard deviations of `others` over that of `own`, and its 95 % interval.

    One sample of a figure for each command. The interval is of the percentile bootstrap, every
    sample resampled by itself. All NaN where a sample has fewer than two values or `own` does not
    scatter; with fewer than `FEWEST` values in a sample the interval alone is NaN.
    """
    from scipy.stats import DegenerateDataWarning, bootstrap

    least = 1e-9 * max((float(np.abs(each).max()) for each in own if len(each)), default=0.0)

    def ratio(*samples: Array, axis: int = -1) -> Array:
        spreads = [np.std(sample, axis=axis, ddof=1) for sample in samples]
        above, below = sum(spreads[len(own) :]), sum(spreads[: len(own)])
        # A resample of one value alone scatters by rounding only.
        out = np.full(np.shape(below), np.nan)
        share: Array = np.divide(above, below, out=out, where=np.asarray(below) > least)
        return share

    samples = (*own, *others)
    value = float(ratio(*samples)) if min(map(len, samples)) > 1 else math.nan
    if not math.isfinite(value) or min(map(len, samples)) < FEWEST:
        return value, math.nan, math.nan
    how: Any = {"n_resamples": resamples, "method": "percentile", "vectorized": True, "batch": 1000}
    with warnings.catch_warnings():
        # Of resamples without scatter, which the quantiles below leave out.
        warnings.simplefilter("ignore", DegenerateDataWarning)
        drawn = bootstrap(samples, ratio, rng=np.random.default_rng(seed), **how)
    low, high = np.nanquantile(drawn.bootstrap_distribution, [0.025, 0.975])
    return value, float(low), float(high)


# ---- files ----


def to_csv(results: Results) -> str:
    """One row a run; unknown figures are empty, flags 1 and 0, numbers exact."""
    figures, table = figures_of(results.kind.figures), []
    varied = any(row.parameter for row in results.rows)
    for row in results.rows:
        cells: dict[str, Any] = {"policy": row.policy, "command": row.case}
        cells |= {"parameter": row.parameter, "value": row.value} if varied else {}
        cells |= {"number": row.number, "seed": row.seed, "capture": row.capture}
        cells |= {"success": row.figures.success, "run_s": row.script.run_s, "began_s": row.began}
        for name, value in vars(row.figures).items():
            column = figures[name].column if name in figures else name
            if name in figures and figures[name].joints:
                unit = column.removeprefix(name)
                values = value or [math.nan] * len(results.joint_names)
                columns = [f"{name}_{joint}{unit}" for joint in results.joint_names]
                cells |= dict(zip(columns, values, strict=True))
            else:
                cells[column] = value
        table.append({k: int(v) if isinstance(v, bool) else v for k, v in cells.items()})
    text = io.StringIO()
    writer = csv.DictWriter(text, list(table[0]) if table else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: "" if v != v else v for k, v in cells.items()} for cells in table)
    return text.getvalue()


def save_json(path: Path, schema: str, body: Mapping[str, Any]) -> Path:
    """Write a body of dataclasses and plain values as JSON, whole or not at all; return the path.

    NaN becomes null.
    """
    text = msgspec.json.format(msgspec.json.encode({"schema": schema, **body}), indent=2)
    write_text(path, text.decode() + "\n")
    return path


@contextmanager
def load_json(path: Path, schema: str, writer: str) -> Iterator[dict[str, Any]]:
    """Read a JSON file of one schema; errors of the block count as damage of the file."""
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ArtefactError(f"{path}: no such file; `{writer}` writes it.") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ArtefactError(f"{path}: cannot be read ({type(error).__name__}).") from None
    found = body.get("schema") if isinstance(body, dict) else None
    if found != schema:
        raise ArtefactError(
            f"{path}: schema {found!r}; this pronk reads {schema!r}. `{writer}` writes it anew."
        )
    try:
        yield body
    except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        raise ArtefactError(
            f"{path}: damaged ({type(error).__name__}: {error}); `{writer}` writes it anew."
        ) from error


def save(folder: Path, results: Results) -> tuple[Path, Path]:
    """Write table and summary, each whole or not at all, the summary last; return the files."""
    kind = results.kind
    table = folder / kind.table
    write_text(table, to_csv(results))
    head = {name: getattr(results, name) for name in _STORED}
    sums = {"cells": results.cells, "ratios": results.ratios}
    body = {**head, "definitions": figures_of(kind.figures), **sums}
    return table, save_json(folder / kind.summary, kind.schema, body)


_STORED = [entry.name for entry in fields(Results) if entry.name != "kind"]


def load(folder: Path, kind: Kind = JUMPS) -> Results:
    """Read the summary that `save` wrote; the table is for other readers."""
    with load_json(folder / kind.summary, kind.schema, kind.writer) as body:
        stored = {name: body[name] for name in _STORED}
        stored["rows"] = [
            _known(row) | {"figures": msgspec.convert(_known(row["figures"]), kind.figures)}
            for row in stored["rows"]
        ]
        results = replace(msgspec.convert(stored, Results), kind=kind)
        counts = [(cell["policy"], cell["case"], cell["n"]) for cell in body["cells"]]
        if counts != [(cell.policy, cell.case, cell.n) for cell in results.cells]:
            raise ValueError("runs and sums do not fit together")
        return results


def _known(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out what is null: the default, NaN, means unknown as well."""
    return {name: value for name, value in entry.items() if value is not None}
