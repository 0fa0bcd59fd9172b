"""The results of a trial: a JSON file with what was run, every run and sums, and a CSV table.

Jumps, walks and crossings differ by their `RunKind`. Unknown numbers are NaN, in CSV an empty cell,
in JSON null. pronk reads the runs in the JSON file; its sums, and the table with one row a run, are
for other readers.
"""

from __future__ import annotations

import csv
import io
import json
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, Self

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from pronk.arrays import Array
from pronk.errors import ArtefactError
from pronk.files import write_text
from pronk.jump.trial.jumps import JumpFigures, figures_of, flags_of, measure_jump
from pronk.jump.trial.protocol import PAPER_COMMANDS, Case
from pronk.policy.script import Script

RESAMPLES = 4999
"""Number of resamples of a bootstrap."""
FEWEST = 5
"""Fewest jumps, the paper's number, with which the bootstrap gives an interval. With fewer, a
resample is too often one jump alone, which does not scatter."""


class MeasuredRun(Protocol):
    """What the figures of every kind of runs have in common."""

    @property
    def standing(self) -> bool:
        """Whether the robot had not fallen before what was to be measured."""

    @property
    def found(self) -> bool:
        """Whether there was something to measure."""

    @property
    def success(self) -> bool:
        """Whether the run ended as it should."""

    @property
    def fell(self) -> bool:
        """Whether the robot fell."""

    @property
    def non_foot_contact(self) -> bool:
        """Whether something but a foot touched the ground."""


@dataclass(frozen=True, kw_only=True)
class RunKind:
    """A kind of runs: how one is measured, and the files of its results."""

    table: str
    """Name of the CSV file."""
    summary: str
    """Name of the JSON file."""
    schema: str
    """Schema of the JSON file."""
    writer: str
    """Command that writes them."""
    figures: type[Any] = JumpFigures
    """Dataclass of one run's figures: flags, texts, and numbers with `Figure` metadata."""
    measure: Callable[..., Any] = measure_jump
    """Function of a module that makes the figures of a capture."""
    compared: tuple[str, ...] = ()
    """Figures whose scatter is compared between policies."""
    jump: bool = True
    """The policies need the jump input."""


JUMPS = RunKind(
    table="trials.csv",
    summary="summary.json",
    schema="pronk/trial/5",
    writer="pronk trial POLICY --out FOLDER",
    compared=(
        "height",
        "apex_gain",
        "lift_off_velocity",
        "distance",
        "along",
        "distance_minima",
        "gap",
    ),
)
TABLE = JUMPS.table
SUMMARY = JUMPS.summary


def study_kind(
    name: str, figures: type[Any], measure: Callable[..., Any], *, jump: bool = True
) -> RunKind:
    """Return the kind of a study beside the jumps.

    Args:
        name: The option of `pronk trial` that asks for it, which names its files.
        figures: Dataclass of one run's figures.
        measure: Function that makes them of a capture.
        jump: Whether the policies need the jump input.
    """
    return RunKind(
        table=f"{name}.csv",
        summary=f"{name}.json",
        schema=f"pronk/trial-{name}/5",
        writer=f"pronk trial POLICY --{name}",
        figures=figures,
        measure=measure,
        jump=jump,
    )


@dataclass(frozen=True, kw_only=True)
class TriedPolicy:
    """A policy under trial."""

    name: str
    path: str
    """Path of its file."""
    sha256: str
    """Hash of its file."""
    contract: Mapping[str, Any]
    """Robot, gains with their hash, rates, delays and ranges that it was trained for."""


@dataclass(frozen=True, kw_only=True)
class TrialRun:
    """One run of one policy with one command."""

    policy: str
    """Name of the policy."""
    case: str
    """Name of the command."""
    number: int
    """Number of the run, 0 for the first with this command."""
    seed: int
    """Seed of the virtual robot's noise."""
    script: Script
    """Commands over time, with the time of this run's jump input."""
    figures: Any = None
    """Figures of the kind's class, `JumpFigures` for jumps; None before the run."""
    capture: str = ""
    """File of the capture beside the table; empty if it was not kept."""
    began: float = 0.0
    """When the policy took over, on the capture's clock [s]."""


@dataclass(frozen=True, kw_only=True)
class Spread:
    """A figure over the `n` runs that have it; NaN where there are none."""

    mean: float = math.nan
    std: float = math.nan
    """Standard deviation with n - 1; NaN for one run."""
    minimum: float = math.nan
    p05: float = math.nan
    p50: float = math.nan
    p95: float = math.nan
    maximum: float = math.nan
    n: int = 0

    @classmethod
    def of(cls, values: ArrayLike) -> Self:
        """Sum up one value a run; unknown ones are left out."""
        numbers = np.asarray(values, dtype=float)
        numbers = numbers[np.isfinite(numbers)]
        if not len(numbers):
            return cls()
        minimum, p05, p50, p95, maximum = np.quantile(numbers, [0.0, 0.05, 0.5, 0.95, 1.0]).tolist()
        return cls(
            mean=float(numbers.mean()),
            std=float(numbers.std(ddof=1)) if len(numbers) > 1 else math.nan,
            minimum=minimum,
            p05=p05,
            p50=p50,
            p95=p95,
            maximum=maximum,
            n=len(numbers),
        )


@dataclass(frozen=True, kw_only=True)
class RunCell:
    """The runs of one policy with one command."""

    policy: str
    case: str
    """Name of the command."""
    n: int
    """Number of runs."""
    standing: int
    """Number of robots that had not fallen when the jump input came."""
    found: int
    """Number of jumps that there were."""
    succeeded: int
    """Number of landings; of another kind, of runs that ended as they should."""
    success: float
    """Share of those of all runs [1]."""
    success_ci95: tuple[float, float]
    """Wilson's 95 % interval of that share [1]."""
    fell: int
    """Number of runs in which the robot fell."""
    non_foot_contact: int
    """Number of runs in which something but a foot touched the ground."""
    figures: Mapping[str, Spread]
    """Figures over the runs with a jump; over all runs of another kind."""
    joints: Mapping[str, Mapping[str, Spread]]
    """Figures of each joint, by figure, then by joint."""


@dataclass(frozen=True, kw_only=True)
class ScatterRatio:
    """Scatter of another policy over that of the first."""

    figure: str
    case: str | None
    """Name of the command. None: ratio of the sums of the standard deviations over the paper's
    commands, which is that of their means; over all commands if none of the paper's was run."""
    policy: str
    """Name of the first policy."""
    other: str
    """Name of the other policy."""
    value: float
    """Standard deviation of the other over that of the first [1]."""
    low: float
    """Lower end of the 95 % bootstrap interval; NaN with fewer than `FEWEST` jumps of either policy
    in a command [1]."""
    high: float
    """Upper end of that interval [1]."""
    n: tuple[int, int]
    """Number of jumps of the first and of the other."""


@dataclass(frozen=True, kw_only=True)
class TrialResults:
    """The runs of one kind, and what was run."""

    run_kind: RunKind = JUMPS
    rows: tuple[TrialRun, ...] = ()
    """Runs by policy, then command, then number."""
    robot: str
    """Name of the robot."""
    virtual: bool = True
    """Measured on pronk's virtual robot."""
    subjects: tuple[TriedPolicy, ...]
    cases: tuple[Case, ...]
    joint_names: tuple[str, ...] = ()
    seed: int
    """Seed of all draws."""
    sim_params: Mapping[str, Any]
    """File of the virtual robot's parameters, and its hash."""
    script: Script
    """Times of all runs, without the spread of the jump input's time."""
    spread_s: float = 0.0
    """Time by which the jump input rises later at most [s]."""
    rules: Mapping[str, float] = field(default_factory=dict)
    """`JumpRules` of the definitions."""
    mass: float = 0.0
    """Mass of the robot, for the cost of transport [kg]; 0 where there is none."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Further settings of the kind."""
    versions: Mapping[str, str] = field(default_factory=dict)
    timing: Mapping[str, float] = field(default_factory=dict)
    """Wall seconds, simulated seconds, processes: the only numbers that a repeat changes."""

    @property
    def policy_names(self) -> list[str]:
        """Names of the policies."""
        return [subject.name for subject in self.subjects]

    @property
    def pooled(self) -> tuple[str, ...]:
        """Commands that an overall figure is over: the paper's, or all without them."""
        paper = []
        commands = []
        for case in self.cases:
            commands.append(case.name)
            if case in PAPER_COMMANDS:
                paper.append(case.name)
        return tuple(paper or commands)

    def of(self, policy: str, case: str) -> list[TrialRun]:
        """Return the runs of one policy with one command."""
        return [row for row in self.rows if row.policy == policy and row.case == case]

    def values(self, policy: str, case: str, figure: str) -> Array:
        """Return the finite values of one figure, of the jumps that there were. (n,)."""
        definition = figures_of(self.run_kind.figures)[figure]
        values = []
        for row in self.of(policy, case):
            if row.figures.found:
                values.append(definition.value(row.figures))
        numbers: Array = np.array(values, dtype=float)
        return numbers[np.isfinite(numbers)]

    @cached_property
    def cells(self) -> list[RunCell]:
        """Sums of every policy with every command."""
        groups: dict[tuple[str, str], list[TrialRun]] = {}
        for row in self.rows:
            groups.setdefault((row.policy, row.case), []).append(row)
        return list(map(self._sum_up, groups.values()))

    def cells_of(self, policy: str) -> list[RunCell]:
        """Return the sums of one policy with every command."""
        return [cell for cell in self.cells if cell.policy == policy]

    def cell(self, policy: str, case: str) -> RunCell:
        """Return the sums of one policy with one command."""
        for cell in self.cells:
            if cell.policy == policy and cell.case == case:
                return cell
        raise KeyError(f"{policy}, {case}")

    def _sum_up(self, rows: Sequence[TrialRun]) -> RunCell:
        standing = 0
        succeeded = 0
        fell = 0
        non_foot_contact = 0
        with_jump = []
        for row in rows:
            figures: MeasuredRun = row.figures
            standing += figures.standing
            succeeded += figures.success
            fell += figures.fell
            non_foot_contact += figures.non_foot_contact
            if figures.found:
                with_jump.append(figures)
        spreads: dict[str, Spread] = {}
        joint_spreads: dict[str, dict[str, Spread]] = {}
        for name, definition in figures_of(self.run_kind.figures).items():
            values = [definition.value(figures) for figures in with_jump]
            if definition.joints:
                joint_spreads[name] = self._joint_spreads(name, values)
            else:
                spreads[name] = Spread.of(values)
        return RunCell(
            policy=rows[0].policy,
            case=rows[0].case,
            n=len(rows),
            standing=standing,
            found=len(with_jump),
            succeeded=succeeded,
            success=succeeded / len(rows),
            success_ci95=share_interval(succeeded, len(rows)),
            fell=fell,
            non_foot_contact=non_foot_contact,
            figures=spreads,
            joints=joint_spreads,
        )

    def _joint_spreads(self, name: str, values: Sequence[tuple[float, ...]]) -> dict[str, Spread]:
        """Sum up a figure of each joint; runs that do not have it are left out."""
        columns: dict[str, list[float]] = {joint: [] for joint in self.joint_names}
        for value in values:
            if not value:
                continue
            if len(value) != len(self.joint_names):
                raise ValueError(f"{name} has not one number for each joint")
            for joint, number in zip(self.joint_names, value, strict=True):
                columns[joint].append(number)
        spreads = {}
        for joint, column in columns.items():
            spreads[joint] = Spread.of(column)
        return spreads

    @cached_property
    def ratios(self) -> list[ScatterRatio]:
        """Scatter of every other policy over that of the first, altogether and by command."""
        ratios = []
        for other in self.subjects[1:]:
            for figure in self.run_kind.compared:
                ratios.append(self._ratio(other.name, figure, None))
                for case in self.cases:
                    ratios.append(self._ratio(other.name, figure, case.name))
        return ratios

    def _ratio(self, other: str, figure: str, case: str | None) -> ScatterRatio:
        policy = self.subjects[0].name
        cases = self.pooled if case is None else (case,)
        samples = [self.values(policy, name, figure) for name in cases]
        other_samples = [self.values(other, name, figure) for name in cases]
        value, low, high = ratio_of_scatter(samples, other_samples, seed=self.seed)
        return ScatterRatio(
            figure=figure,
            case=case,
            policy=policy,
            other=other,
            value=value,
            low=low,
            high=high,
            n=(sum(map(len, samples)), sum(map(len, other_samples))),
        )


def share_interval(count: int, n: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share `count` / `n`."""
    from scipy.stats import binomtest

    low, high = binomtest(count, n).proportion_ci(0.95, method="wilson")
    return float(low), float(high)


def ratio_of_scatter(
    samples: Sequence[Array],
    other_samples: Sequence[Array],
    *,
    seed: int,
    resamples: int = RESAMPLES,
) -> tuple[float, float, float]:
    """Compare the scatter of two policies.

    Args:
        samples: A figure of the first policy's jumps, one array (n,) for each command.
        other_samples: The same of the other policy.
        seed: Seed of the resamples.
        resamples: Number of resamples of the percentile bootstrap, each sample by itself.

    Returns:
        Sum of the standard deviations of the other policy over that of the first, and its 95 %
        interval. All NaN where a sample has fewer than two values or the first does not scatter;
        the interval alone with fewer than `FEWEST` values in a sample.
    """
    from scipy.stats import DegenerateDataWarning, bootstrap

    # A resample of one value alone scatters by rounding only.
    rounding = 1e-9 * float(np.abs(np.concatenate(samples)).max(initial=0.0))

    def ratio(*resampled: Array, axis: int = -1) -> Array:
        stds = [np.std(sample, axis=axis, ddof=1) for sample in resampled]
        below = np.asarray(sum(stds[: len(samples)]))
        above = np.asarray(sum(stds[len(samples) :]))
        unknown = np.full(below.shape, np.nan)
        quotient: Array = np.divide(above, below, out=unknown, where=below > rounding)
        return quotient

    all_samples = (*samples, *other_samples)
    fewest = min(map(len, all_samples))
    value = float(ratio(*all_samples)) if fewest > 1 else math.nan
    if not math.isfinite(value) or fewest < FEWEST:
        return value, math.nan, math.nan
    with warnings.catch_warnings():
        # About resamples without scatter, which the quantiles below leave out.
        warnings.simplefilter("ignore", DegenerateDataWarning)
        drawn = bootstrap(
            all_samples,
            ratio,
            rng=np.random.default_rng(seed),
            n_resamples=resamples,
            method="percentile",
            vectorized=True,
            batch=1000,
        )
    low, high = np.nanquantile(drawn.bootstrap_distribution, [0.025, 0.975])
    return value, float(low), float(high)


# ---- files ----


def to_csv(results: TrialResults) -> str:
    """Return one row a run; unknown figures are empty, flags 1 and 0, numbers exact."""
    rows = [_csv_row(results, row) for row in results.rows]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _csv_row(results: TrialResults, row: TrialRun) -> dict[str, Any]:
    """Return the cells of one run by their headings."""
    cells: dict[str, Any] = {
        "policy": row.policy,
        "command": row.case,
        "number": row.number,
        "seed": row.seed,
        "capture": row.capture,
        "success": row.figures.success,
        "run_s": row.script.run_s,
        "began_s": row.began,
    }
    for name in flags_of(results.run_kind.figures):
        cells[name] = getattr(row.figures, name)
    for name, definition in figures_of(results.run_kind.figures).items():
        value = definition.value(row.figures)
        if not definition.joints:
            cells[definition.column] = value
            continue
        unit = definition.column.removeprefix(name)
        for index, joint in enumerate(results.joint_names):
            cells[f"{name}_{joint}{unit}"] = value[index] if value else math.nan
    for heading, value in cells.items():
        if isinstance(value, bool):
            cells[heading] = int(value)
        elif isinstance(value, float) and math.isnan(value):
            cells[heading] = ""
    return cells


def save_json(path: Path, schema: str, body: Mapping[str, Any]) -> Path:
    """Write a body of dataclasses and plain values as JSON, whole or not at all.

    Args:
        path: The file.
        schema: Its first entry.
        body: Its other entries; NaN becomes null.

    Returns:
        The path.
    """
    text = msgspec.json.format(msgspec.json.encode({"schema": schema, **body}), indent=2)
    write_text(path, text.decode() + "\n")
    return path


@contextmanager
def load_json(path: Path, schema: str, writer: str) -> Iterator[dict[str, Any]]:
    """Read a JSON file of one schema; errors of the block count as damage of the file.

    Args:
        path: The file.
        schema: The schema it must have.
        writer: Command that writes such files, for the messages.

    Raises:
        ArtefactError: The file is missing, of another schema or damaged.
    """
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ArtefactError(f"{path}: no such file; `{writer}` writes it.") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ArtefactError(f"{path}: cannot be read ({type(error).__name__}).") from None
    stored_schema = body.get("schema") if isinstance(body, dict) else None
    if stored_schema != schema:
        raise ArtefactError(
            f"{path}: schema {stored_schema!r}; this pronk reads {schema!r}. `{writer}` writes it "
            "anew."
        )
    try:
        yield body
    except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        raise ArtefactError(
            f"{path}: damaged ({type(error).__name__}: {error}); `{writer}` writes it anew."
        ) from error


def save_results(folder: Path, results: TrialResults) -> tuple[Path, Path]:
    """Write table and summary, each whole or not at all, the summary last; return the files."""
    run_kind = results.run_kind
    table = folder / run_kind.table
    write_text(table, to_csv(results))
    body = {
        "rows": results.rows,
        "robot": results.robot,
        "virtual": results.virtual,
        "subjects": results.subjects,
        "cases": results.cases,
        "joint_names": results.joint_names,
        "seed": results.seed,
        "sim_params": results.sim_params,
        "script": results.script,
        "spread_s": results.spread_s,
        "rules": results.rules,
        "mass": results.mass,
        "settings": results.settings,
        "versions": results.versions,
        "timing": results.timing,
        "definitions": figures_of(run_kind.figures),
        "cells": results.cells,
        "ratios": results.ratios,
    }
    return table, save_json(folder / run_kind.summary, run_kind.schema, body)


def load_results(folder: Path, run_kind: RunKind = JUMPS) -> TrialResults:
    """Read the summary that `save_results` wrote; the table is for other readers.

    Raises:
        ArtefactError: The summary is missing, of another schema or damaged.
    """
    with load_json(folder / run_kind.summary, run_kind.schema, run_kind.writer) as body:
        rows = tuple(load_run(stored, run_kind.figures) for stored in body.pop("rows"))
        sums = body.pop("cells")
        for name in ("schema", "definitions", "ratios"):
            del body[name]
        results = replace(msgspec.convert(body, TrialResults), run_kind=run_kind, rows=rows)
        for stored, cell in zip(sums, results.cells, strict=True):
            if (stored["policy"], stored["case"], stored["n"]) != (cell.policy, cell.case, cell.n):
                raise ValueError("runs and sums do not fit together")
        return results


def load_run(stored: Mapping[str, Any], figures_class: type[Any]) -> TrialRun:
    """Return a run of a JSON file, whose figures are of a class of figures."""
    figures = msgspec.convert(_without_nulls(stored["figures"]), figures_class)
    run = msgspec.convert({**stored, "figures": None}, TrialRun)
    return replace(run, figures=figures)


def _without_nulls(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out what is null: the default, NaN, means unknown as well."""
    entries: dict[str, Any] = {}
    for name, value in entry.items():
        if isinstance(value, dict):
            entries[name] = _without_nulls(value)
        elif value is not None:
            entries[name] = value
    return entries
