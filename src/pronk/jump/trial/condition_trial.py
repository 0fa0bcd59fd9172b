"""Several policies under several conditions of the virtual robot, in one run.

    conditions = load_conditions("tolerance", setup.sim_params, setup.robot)
    results = run_conditions([Path("policy.onnx")], conditions, TrialPlan(jumps=20), setup)

Every policy does every jump of the plan under every condition, with the same starts, noise and
times throughout. The jumps of one policy under one condition are a cell. A finished cell is a file
of its own, named by the hash of all that it depends on, so that a run that was interrupted, or that
has more policies or conditions than the one before, does only what is new. This holds on another
machine too: cells that were computed there are kept if pronk and MuJoCo had the same versions:

    cells/HASH.json                 the jumps of one cell, and the versions it was computed with
    robots/CONDITION.yaml           its parameters, for `--sim-params` of other commands
    conditions.csv, .json           one row a cell
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from pronk.errors import ArtefactError, NotStandingError, PronkError
from pronk.files import write_text
from pronk.jump.trial.conditions import Condition, changed_params, check_conditions
from pronk.jump.trial.jumps import JumpFigures
from pronk.jump.trial.results import (
    Spread,
    TrialRun,
    TriedPolicy,
    load_json,
    load_run,
    save_json,
    share_interval,
)
from pronk.jump.trial.trial import (
    TrialJob,
    TrialPlan,
    TrialSetup,
    load_subjects,
    plan_jobs,
    run_job,
    software_versions,
)
from pronk.jump.virtual.sim_params import SCHEMA as SIM_PARAMS_SCHEMA
from pronk.jump.virtual.sim_params import SimParams
from pronk.names import file_name
from pronk.processes import FEWER_PROCESSES, results_in_order
from pronk.robots.robot_files import robot_key

SCHEMA = "pronk/condition-trial/1"
CELL_SCHEMA = "pronk/condition-cell/1"
SUMMARY = "conditions.json"
TABLE = "conditions.csv"
CELLS = "cells"
ROBOTS = "robots"
FIGURE = "conditions.svg"
WRITER = "pronk trial POLICY --conditions FILE"
DECIDING_VERSIONS = ("pronk", "mujoco")
"""Software whose version decides the jumps: what is simulated, and by which physics. Of the others,
Python 3.11 and 3.12, NumPy 2.4 and 2.5, SciPy 1.17 and 1.18, ONNX Runtime 1.30 and 1.31 gave the
same jumps to the last digit; docs/try.md."""
_ROBOT_COMMENT = "Condition "
"""Beginning of the comment of the files in `robots`."""


@dataclass(frozen=True, kw_only=True)
class ConditionCell:
    """The jumps of one policy under one condition, all commands together."""

    policy: str
    condition: str
    key: str
    """Hash of all that the jumps depend on; the name of the cell's file."""
    jumps: int
    """Number of commanded jumps."""
    landed: int
    """Number of landings: upright 2 s after touchdown, nothing but feet touched the ground."""
    landed_share: float
    """Share of landings of all jumps [1]."""
    landed_interval: tuple[float, float]
    """Wilson's 95 % interval of that share [1]."""
    stood: int
    """Number of runs in which the robot stood when the policy was to start."""
    fell: int | None
    """Number of those runs in which the robot fell; None without any of them."""
    height: Spread
    """Height of the jumps that there were [m]."""
    distance: Spread
    """Distance of the jumps that there were [m]."""
    velocity_error: Spread
    """Difference of mean and commanded velocity along the command before the jump [m/s]."""


@dataclass(frozen=True, kw_only=True)
class ConditionResults:
    """The cells of several policies under several conditions."""

    robot: str
    virtual: bool = True
    """Measured on pronk's virtual robot."""
    subjects: tuple[TriedPolicy, ...]
    conditions: tuple[Condition, ...]
    cells: tuple[ConditionCell, ...]
    """By condition, then by policy."""
    commands: tuple[str, ...]
    """Names of the commands."""
    jumps: int
    """Number of jumps with each command in each cell."""
    seed: int
    sim_params: dict[str, Any]
    """File and hash of the nominal robot's parameters."""
    versions: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    """Wall time of this run, without cells that were there already [s]."""
    kept: int = 0
    """Number of cells that were there already."""
    kept_versions: tuple[Mapping[str, str], ...] = ()
    """Versions of other software with which some of those were computed."""
    unused_versions: tuple[Mapping[str, str], ...] = ()
    """Versions of the cells in the folder that are of another pronk or MuJoCo, and do not count."""
    damaged: tuple[str, ...] = ()
    """Policies and conditions whose files could not be read, so that they were run again."""

    @property
    def policy_names(self) -> list[str]:
        """Names of the policies."""
        return [subject.name for subject in self.subjects]

    def cell(self, policy: str, condition: str) -> ConditionCell:
        """Return the cell of one policy under one condition."""
        for cell in self.cells:
            if cell.policy == policy and cell.condition == condition:
                return cell
        raise KeyError(f"{policy}, {condition}")


@dataclass(frozen=True, kw_only=True)
class StoredCell:
    """A cell as its file has it."""

    rows: list[TrialRun]
    """Its jumps."""
    versions: dict[str, str]
    """Versions of software that it was computed with; empty in a cell of an earlier pronk."""


@dataclass(frozen=True, kw_only=True)
class _PlannedCell:
    """A cell before its jumps."""

    subject: TriedPolicy
    condition: Condition
    sim_params: SimParams
    key: str


@dataclass(kw_only=True)
class _KeptCells:
    """The cells of a plan that the folder has already."""

    keys: dict[str, str] = field(default_factory=dict)
    """Name of each cell's file by the key that it would have here."""
    versions: list[Mapping[str, str]] = field(default_factory=list)
    """Versions of other software with which some of them were computed."""
    unused_versions: list[Mapping[str, str]] = field(default_factory=list)
    """Versions of cells in the folder that are of another pronk or MuJoCo."""
    damaged: list[str] = field(default_factory=list)
    """Policies and conditions whose files cannot be read."""


def run_conditions(
    policies: Sequence[Path],
    conditions: Sequence[Condition],
    plan: TrialPlan,
    setup: TrialSetup,
    *,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> ConditionResults:
    """Run every policy under every condition, and save the results.

    Args:
        policies: Files of the policies.
        conditions: Changes of the virtual robot, all of different names.
        plan: Commands, number of jumps and seed of every cell.
        setup: The robot, its nominal parameters, the folder and the number of processes.
        overwrite: Run cells again that the folder has already.
        progress: Called with the share of the new jumps that are done, 0 to 1.

    Raises:
        PronkError: A policy, a condition or the folder is impossible; nothing was run then.
    """
    begun = time.perf_counter()
    check_conditions(conditions, "the conditions")
    subjects = load_subjects(policies, setup.robot)
    cells = _plan_cells(subjects, conditions, plan, setup)
    prepare_conditions(setup.out, overwrite=overwrite)
    for condition in conditions:
        params = changed_params(condition, setup.sim_params, setup.robot)
        stem = file_name(condition.name).replace(" ", "_")
        path = setup.out / ROBOTS / f"{stem}.yaml"
        comment = f"{_ROBOT_COMMENT}{condition.name!r} of `{WRITER}`."
        save_sim_params(path, params, comment=comment)

    kept = _kept_cells(cells, plan, setup)
    missing: dict[str, _PlannedCell] = {}
    for cell in cells:
        if cell.key not in kept.keys:
            missing.setdefault(cell.key, cell)
    _run_cells(list(missing.values()), plan, setup, progress)

    summed_cells = []
    for cell in cells:
        key = kept.keys.get(cell.key, cell.key)
        stored = load_cell(_cell_path(setup.out, key), key)
        summed_cells.append(_sum_up(replace(cell, key=key), stored.rows))
    results = ConditionResults(
        robot=setup.robot.name,
        subjects=subjects,
        conditions=tuple(conditions),
        cells=tuple(summed_cells),
        commands=tuple(case.name for case in plan.cases),
        jumps=plan.jumps,
        seed=plan.seed,
        sim_params=dict(setup.about),
        versions=software_versions(),
        seconds=time.perf_counter() - begun,
        kept=len(cells) - len(missing),
        kept_versions=tuple(kept.versions),
        unused_versions=tuple(kept.unused_versions) if missing else (),
        damaged=tuple(kept.damaged),
    )
    save_conditions(setup.out, results)
    return results


def _plan_cells(
    subjects: Sequence[TriedPolicy],
    conditions: Sequence[Condition],
    plan: TrialPlan,
    setup: TrialSetup,
) -> list[_PlannedCell]:
    """Return every cell, by condition and policy; refuse robots that cannot exist."""
    cells = []
    versions = software_versions()
    for condition in conditions:
        params = changed_params(condition, setup.sim_params, setup.robot)
        changed_setup = replace(setup, sim_params=params)
        first_job = plan_jobs(subjects[:1], plan, changed_setup)[0]
        try:
            first_job.build()
        except PronkError as error:
            raise PronkError(f"condition {condition.name}: {error}") from None
        for subject in subjects:
            cells.append(
                _PlannedCell(
                    subject=subject,
                    condition=condition,
                    sim_params=params,
                    key=cell_key(subject, params, plan, setup, versions),
                )
            )
    return cells


def _kept_cells(cells: Sequence[_PlannedCell], plan: TrialPlan, setup: TrialSetup) -> _KeptCells:
    """Find the cells that were computed before, here or where other software has other versions."""
    kept = _KeptCells()
    versions = software_versions()
    usable_versions = [versions]
    for other in _stored_versions(setup.out):
        if any(other.get(name) != versions[name] for name in DECIDING_VERSIONS):
            kept.unused_versions.append(other)
        elif other != versions:
            usable_versions.append(other)
    for cell in cells:
        if cell.key in kept.keys:
            continue
        is_damaged = False
        for other in usable_versions:
            key = cell_key(cell.subject, cell.sim_params, plan, setup, other)
            path = _cell_path(setup.out, key)
            if not path.exists():
                continue
            try:
                load_cell(path, key)
            except ArtefactError:
                is_damaged = True
                continue
            kept.keys[cell.key] = key
            if other != versions and other not in kept.versions:
                kept.versions.append(other)
            break
        if is_damaged and cell.key not in kept.keys:
            kept.damaged.append(f"{cell.subject.name} under {cell.condition.name}")
    return kept


def cell_key(
    subject: TriedPolicy,
    sim_params: SimParams,
    plan: TrialPlan,
    setup: TrialSetup,
    versions: Mapping[str, str],
) -> str:
    """Return the hash of what the jumps of a cell depend on, and of versions, 16 hex digits."""
    settings = {
        "schema": CELL_SCHEMA,
        "policy": subject.sha256,
        "robot": robot_key(setup.robot),
        "sim_params": sim_params,
        "plan": plan,
        "versions": versions,
    }
    return hashlib.sha256(msgspec.json.encode(settings, order="sorted")).hexdigest()[:16]


def _run_cells(
    cells: Sequence[_PlannedCell],
    plan: TrialPlan,
    setup: TrialSetup,
    progress: Callable[[float], None] | None,
) -> None:
    """Run all jumps of some cells, and save each cell as soon as its last jump is done."""
    jobs: list[TrialJob] = []
    names: list[str] = []
    last_jobs: dict[int, _PlannedCell] = {}
    for cell in cells:
        cell_jobs = plan_jobs([cell.subject], plan, replace(setup, sim_params=cell.sim_params))
        for job in cell_jobs:
            names.append(f"{job.name} under {cell.condition.name}")
        jobs += cell_jobs
        last_jobs[len(jobs) - 1] = cell
    rows: list[TrialRun] = []
    versions = software_versions()
    results = results_in_order(
        run_condition_job,
        jobs,
        processes=setup.processes,
        names=names,
        way_out=FEWER_PROCESSES,
    )
    for index, row in enumerate(results):
        rows.append(row)
        if index in last_jobs:
            cell = last_jobs[index]
            path = _cell_path(setup.out, cell.key)
            save_json(path, CELL_SCHEMA, {"key": cell.key, "rows": rows, "versions": versions})
            rows = []
        if progress is not None:
            progress((index + 1) / len(jobs))


def run_condition_job(job: TrialJob) -> TrialRun:
    """Run one job; a robot that does not stand under its condition has not landed."""
    try:
        return run_job(job)
    except NotStandingError:
        # An outcome of the condition: drives that are too soft for the robot's weight.
        return replace(job.row, figures=JumpFigures(standing=False))


def _sum_up(cell: _PlannedCell, rows: Sequence[TrialRun]) -> ConditionCell:
    landed = 0
    stood = 0
    fell = 0
    heights = []
    distances = []
    velocity_errors = []
    for row in rows:
        landed += row.figures.success
        stood += row.figures.stood
        fell += row.figures.fell
        velocity_errors.append(velocity_error(row))
        if row.figures.found:
            heights.append(row.figures.height)
            distances.append(row.figures.flight.distance)
    return ConditionCell(
        policy=cell.subject.name,
        condition=cell.condition.name,
        key=cell.key,
        jumps=len(rows),
        landed=landed,
        landed_share=landed / len(rows),
        landed_interval=share_interval(landed, len(rows)),
        stood=stood,
        fell=fell if stood else None,
        height=Spread.of(heights),
        distance=Spread.of(distances),
        velocity_error=Spread.of(velocity_errors),
    )


def velocity_error(row: TrialRun) -> float:
    """Return how far the mean velocity before the jump is from the commanded one [m/s].

    Both are along the command; NaN where none is commanded, or the robot fell before.
    """
    commanded = math.hypot(*row.script.command[:2])
    return abs(row.figures.approach.speed - commanded) if commanded else math.nan


# ---- files ----


def prepare_conditions(out: Path, *, overwrite: bool = False) -> None:
    """Make the folder of the results before anything is computed.

    Args:
        out: A folder that is new, empty, or has something of a run before, which may be a part of
            it: a copy without its cells, or a run that was ended before its first cell.
        overwrite: Delete the cells.
    """
    if out.exists() and not out.is_dir():
        raise PronkError(f"--out {out}: a file; expected the name of a folder.")
    try:
        if out.is_dir() and not (out / CELLS).is_dir() and not _is_part_of_run(out):
            raise PronkError(
                f"--out {out}: not empty, and not the folder of a run with --conditions, which "
                "would go on; give another folder."
            )
        (out / CELLS).mkdir(parents=True, exist_ok=True)
        if overwrite:
            for path in (out / CELLS).glob("*.json"):
                path.unlink()
    except OSError as error:
        raise PronkError(
            f"--out {out}: cannot be written to ({error.strerror}); give another folder."
        ) from None


def _is_part_of_run(out: Path) -> bool:
    """Return whether a folder without cells holds nothing but what a run writes beside them."""
    for path in out.iterdir():
        # Names of files that are being written begin with a dot.
        if path.name not in (SUMMARY, TABLE, FIGURE, ROBOTS) and not path.name.startswith("."):
            return False
    for path in (out / ROBOTS).glob("*"):
        if path.name.startswith("."):
            continue
        if not path.is_file() or not path.read_bytes().startswith(f"# {_ROBOT_COMMENT}".encode()):
            return False
    return True


def _stored_versions(out: Path) -> list[dict[str, str]]:
    """Return the versions of software that the cells of a folder were computed with."""
    stored: list[dict[str, str]] = []
    for path in (*sorted((out / CELLS).glob("*.json")), out / SUMMARY):
        try:
            body = json.loads(path.read_text(encoding="utf-8"))
            versions = msgspec.convert(body["versions"], dict[str, str])
        except (OSError, ValueError, LookupError, TypeError, RecursionError):
            # Damaged or missing; cells of an earlier pronk have their versions in the summary.
            continue
        if versions not in stored:
            stored.append(versions)
    return stored


def _cell_path(out: Path, key: str) -> Path:
    return out / CELLS / f"{key}.json"


def load_cell(path: Path, key: str) -> StoredCell:
    """Read one cell; a damaged file is an `ArtefactError` that names it."""
    with load_json(path, CELL_SCHEMA, WRITER) as body:
        if body["key"] != key:
            raise ArtefactError(
                f"{path}: has the jumps of another cell, {body['key']}; delete it, and run the "
                "command again."
            )
        return StoredCell(
            rows=[load_run(stored, JumpFigures) for stored in body["rows"]],
            versions=msgspec.convert(body.get("versions", {}), dict[str, str]),
        )


def save_conditions(folder: Path, results: ConditionResults) -> tuple[Path, Path]:
    """Write the table and the summary; return their paths, the summary last."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        [
            *("policy", "condition", "series", "place", "jumps", "landed", "landed_share"),
            *("landed_low", "landed_high", "stood", "fell", "height_m", "height_std_m"),
            *(
                "distance_m",
                "distance_std_m",
                "velocity_error_m_per_s",
                "velocity_error_std_m_per_s",
            ),
        ]
    )
    conditions = {condition.name: condition for condition in results.conditions}
    for cell in results.cells:
        condition = conditions[cell.condition]
        low, high = cell.landed_interval
        writer.writerow(
            [
                cell.policy,
                cell.condition,
                condition.series,
                "" if condition.place is None else condition.place,
                cell.jumps,
                cell.landed,
                cell.landed_share,
                low,
                high,
                cell.stood,
                "" if cell.fell is None else cell.fell,
                _csv_number(cell.height.mean),
                _csv_number(cell.height.std),
                _csv_number(cell.distance.mean),
                _csv_number(cell.distance.std),
                _csv_number(cell.velocity_error.mean),
                _csv_number(cell.velocity_error.std),
            ]
        )
    write_text(folder / TABLE, text.getvalue())
    body = msgspec.to_builtins(results)
    return folder / TABLE, save_json(folder / SUMMARY, SCHEMA, body)


def _csv_number(value: float) -> float | str:
    return value if np.isfinite(value) else ""


def save_sim_params(path: Path, sim_params: SimParams, *, comment: str) -> None:
    """Write parameters as YAML for `--sim-params`, whole, under a comment of one line.

    Raises:
        PronkError: The ground has terrain, which belongs to a scene, not to a robot.
    """
    if sim_params.ground.terrain or sim_params.ground.floor:
        raise PronkError(f"{path}: a sim_params file holds no terrain; take the blocks away first.")
    parts = msgspec.to_builtins(sim_params)
    del parts["ground"]["terrain"]
    del parts["ground"]["floor"]
    joints = parts.pop("joints")
    body = {"schema": SIM_PARAMS_SCHEMA, **parts, "joints": joints}
    text = yaml.safe_dump(body, default_flow_style=None, sort_keys=False, width=100)
    write_text(path, f"# {comment}\n\n{text}")
