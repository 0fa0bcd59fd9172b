"""What a trial found: `trials.csv`, one row a jump, and `summary.json`, where it comes from.

`summary.json` (schema pronk/trial/1) says what was run (policies with their hashes and contracts,
the hash of the parameters, script, seed, versions) and sums. Means and spreads are over jumps
that were found; how many those are of how many, and the success rate, stand beside them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.errors import ArtefactError
from pronk.evaluation.metrics import FIGURES
from pronk.evaluation.protocol import PAPER_COMMANDS, Case
from pronk.evaluation.rows import Row, of_csv, to_csv
from pronk.evaluation.summary import Cell, Ratio, Spread, ratio_of_scatter, share_interval
from pronk.files import write_text
from pronk.runtime.script import Script

SCHEMA = "pronk/trial/1"
TABLE = "trials.csv"
SUMMARY = "summary.json"
COMPARED = (
    "height",
    "apex_gain",
    "lift_off_velocity",
    "distance",
    "along",
    "distance_minima",
    "gap",
)
"""Figures whose scatter is compared between policies."""
Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A policy that was tried."""

    name: str
    path: str
    sha256: str
    contract: Mapping[str, Any]
    """What of the contract tells it apart: robot, gains, hash of the gains, rates, delays."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """All of it."""

    robot: str
    virtual: bool
    """True: measured on pronk's virtual robot."""
    subjects: tuple[Subject, ...]
    cases: tuple[Case, ...]
    rows: tuple[Row, ...]
    """By policy, then command, then number."""
    joint_names: tuple[str, ...]
    seed: int
    sim_params: Mapping[str, Any]
    """The virtual robot's body: its file and the hash of it."""
    script: Script
    """Without the spread of the jump input's time."""
    spread_s: float
    rules: Mapping[str, float]
    """Of the definitions, see `pronk.evaluation.jumps.JumpRules`."""
    mass: float
    """Of the robot as the cost of transport has it [kg]."""
    versions: Mapping[str, str] = field(default_factory=dict)
    timing: Mapping[str, float] = field(default_factory=dict)
    """Wall seconds, simulated seconds, processes: the only numbers that a repeat changes."""

    @property
    def pooled(self) -> tuple[str, ...]:
        """Commands that one figure for all stands for: those of the paper, or all without them."""
        paper = tuple(case.name for case in self.cases if case in PAPER_COMMANDS)
        return paper or tuple(case.name for case in self.cases)

    def of(self, policy: str, case: str) -> tuple[Row, ...]:
        """The jumps of one policy with one command."""
        return tuple(row for row in self.rows if (row.policy, row.case) == (policy, case))

    def values(self, policy: str, case: str, figure: str) -> Array:
        """One figure of the jumps that were found, unknown ones left out."""
        rows = (row.figures for row in self.of(policy, case) if row.figures.found)
        known = np.array([getattr(figures, figure) for figures in rows], dtype=float)
        finite: Array = known[np.isfinite(known)]
        return finite

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """Every policy with every command."""
        return tuple(
            self._cell(subject.name, case.name) for subject in self.subjects for case in self.cases
        )

    def cell(self, policy: str, case: str) -> Cell:
        """One of `cells`."""
        return next(c for c in self.cells if (c.policy, c.case) == (policy, case))

    def _cell(self, policy: str, case: str) -> Cell:
        rows = self.of(policy, case)
        figures = [row.figures for row in rows]
        found = [each for each in figures if each.found]
        succeeded = sum(each.success for each in figures)
        return Cell(
            policy=policy,
            case=case,
            n=len(rows),
            told=sum(each.told for each in figures),
            found=len(found),
            succeeded=succeeded,
            success=succeeded / len(rows),
            success_ci95=share_interval(succeeded, len(rows)),
            fell=sum(each.fell for each in figures),
            figures={
                name: Spread.of([getattr(each, name) for each in found])
                for name, figure in FIGURES.items()
                if not figure.joints
            },
            joints={
                name: {
                    joint: Spread.of([getattr(each, name)[i] for each in found])
                    for i, joint in enumerate(self.joint_names)
                }
                for name, figure in FIGURES.items()
                if figure.joints
            },
        )

    @cached_property
    def ratios(self) -> tuple[Ratio, ...]:
        """Scatter of every other policy over that of the first, by command and altogether."""
        first = self.subjects[0].name
        cases = tuple(case.name for case in self.cases)
        return tuple(
            self._ratio(figure, first, other.name, case)
            for other in self.subjects[1:]
            for figure in COMPARED
            for case in (None, *cases)
        )

    def _ratio(self, figure: str, first: str, other: str, case: str | None) -> Ratio:
        cases = self.pooled if case is None else (case,)
        own, others = (
            [self.values(name, each, figure) for each in cases] for name in (first, other)
        )
        value, low, high = ratio_of_scatter(own, others, seed=self.seed)
        counts = (sum(map(len, own)), sum(map(len, others)))
        return Ratio(
            figure=figure,
            case=case,
            policy=first,
            other=other,
            value=value,
            low=low,
            high=high,
            n=counts,
        )


def save(folder: Path, trial: Trial) -> tuple[Path, Path]:
    """Write `trials.csv` and `summary.json`, each whole or not at all, the summary last.

    Returns:
        The two files.
    """
    table, summary = folder / TABLE, folder / SUMMARY
    write_text(table, to_csv(trial.rows, trial.joint_names))
    write_text(summary, json.dumps(_plain(_body(trial)), indent=2, allow_nan=False) + "\n")
    return table, summary


def _body(trial: Trial) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "robot": trial.robot,
        "virtual": trial.virtual,
        "policies": [asdict(subject) for subject in trial.subjects],
        "sim_params": trial.sim_params,
        "protocol": {
            "commands": [asdict(case) for case in trial.cases],
            "script": {k: v for k, v in asdict(trial.script).items() if k != "command"},
            "spread_s": trial.spread_s,
            "rules": trial.rules,
        },
        "seed": trial.seed,
        "mass": trial.mass,
        "joint_names": trial.joint_names,
        "versions": trial.versions,
        "timing": trial.timing,
        "definitions": {name: asdict(figure) for name, figure in FIGURES.items()},
        "cells": [asdict(cell) for cell in trial.cells],
        "ratios": [asdict(ratio) for ratio in trial.ratios],
    }


def _plain(value: Any) -> Any:
    """What strict JSON can hold: unknown numbers are null, infinite ones text."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and math.isinf(value):
        return "inf" if value > 0.0 else "-inf"
    return None if isinstance(value, float) and math.isnan(value) else value


def load(folder: Path) -> Trial:
    """Read what `save` wrote. What is summed up is summed up anew, from the rows.

    Args:
        folder: Of the trial.

    Raises:
        ArtefactError: Missing, damaged or of another schema; the sentence names file and field.
    """
    path = folder / SUMMARY
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
        table = (folder / TABLE).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise ArtefactError(
            f"{error.filename}: no such file; `pronk trial POLICY --out {folder}` writes it."
        ) from None
    except (OSError, ValueError) as error:
        raise ArtefactError(f"{folder}: cannot be read ({type(error).__name__}).") from None
    schema = body.get("schema") if isinstance(body, dict) else None
    if schema != SCHEMA:
        raise ArtefactError(f"{path}: schema {schema!r}; this pronk reads {SCHEMA!r}.")
    try:
        return _trial(body, table, folder)
    except ArtefactError:
        raise
    except Exception as error:
        raise ArtefactError(
            f"{path}: damaged ({type(error).__name__}: {error}); `pronk trial` writes it anew."
        ) from error


def _trial(body: Mapping[str, Any], table: str, folder: Path) -> Trial:
    protocol = body["protocol"]
    cases = tuple(
        Case(name=entry["name"], command=_velocity(entry["command"]))
        for entry in protocol["commands"]
    )
    times = {name: float(value) for name, value in protocol["script"].items()}
    joints = tuple(body["joint_names"])
    subjects = tuple(Subject(**entry) for entry in body["policies"])
    rows = tuple(of_csv(table, cases=cases, times=times, joint_names=joints, path=folder / TABLE))
    expected = {(cell["policy"], cell["case"]): cell["n"] for cell in body["cells"]}
    counted = {
        (subject.name, case.name): sum(
            (r.policy, r.case) == (subject.name, case.name) for r in rows
        )
        for subject in subjects
        for case in cases
    }
    if counted != expected or len(rows) != sum(counted.values()):
        raise ArtefactError(
            f"{folder / TABLE}: {len(rows)} jumps do not fit the {sum(expected.values())} that "
            f"{SUMMARY} counts; run the trial again."
        )
    return Trial(
        robot=body["robot"],
        virtual=body["virtual"],
        subjects=subjects,
        cases=cases,
        rows=rows,
        joint_names=joints,
        seed=body["seed"],
        sim_params=body["sim_params"],
        script=Script(command=cases[0].command, **times),
        spread_s=protocol["spread_s"],
        rules=protocol["rules"],
        mass=body["mass"],
        versions=body["versions"],
        timing=body["timing"],
    )


def _velocity(values: list[float]) -> tuple[float, float, float]:
    forward, left, yaw = map(float, values)
    return forward, left, yaw
