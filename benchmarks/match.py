"""`python -m benchmarks match`: pronk and its peers on virtual robots drawn at random.

Each robot is swept on the virtual bench as `pronk sweep` does, one leg of it. Every method gets the
same logs and the same model of the joint, whose armature and dry friction are not those of the
robot, and gives drive parameters of the training simulator. These are judged twice:

- Held-out error: a falling chirp, a multisine and random steps are simulated with them. RMSE
  against the recorded position, at the physics steps, over that of the nominal gains with the
  delay that fits the sweep best.
- Equivalent gains: the same method is given a chirp of a third amplitude, recorded without noise.
  Bias is the mean of the gains of the sweep over these, less 1, and coverage how many of the
  sweep's 95 % intervals of stiffness and damping contain them.

With `--arm FOLDER` the logs are recordings of a real SO-101 whose joints move together, judged on
two more. The plain fit is there given pronk's dry friction at rest, and all use the samples that
pronk uses.

An interrupt ends with the table of those that are done.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks.random_robots import HELD_OUT, ROBOT, Recorded, recorded
from benchmarks.runner import Progress, finish, in_parallel, machine
from benchmarks.time_fit import (
    FREE,
    fit_arm,
    fit_mujoco_sysid,
    fit_plain,
    recordings,
    search_cma,
    search_cma_arm,
    simulated,
    start_values,
)
from pronk.arrays import Array
from pronk.cli import console
from pronk.errors import PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.readers import read_log
from pronk.identify.match.match import Method
from pronk.identify.match.match import match as match_logs
from pronk.identify.match.predict import drives_of
from pronk.identify.match.settings import MatchSettings
from pronk.identify.simulators.chain import ChainSimulation, DriveValues
from pronk.identify.simulators.load import joint_rigs
from pronk.identify.simulators.simulator import JointRigs
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from pronk.tables import Cell, Column, Table

Kind = Literal["hip_roll", "hip_pitch", "knee"]
JOINTS: tuple[Kind, ...] = ("hip_roll", "hip_pitch", "knee")
GAINS = ("stiffness", "damping")
NOMINAL = "nominal with delay"
PLAIN = "plain fit"
PRONK = "pronk"
PAPER = "pronk, paper's method"
DRY = "plain fit, friction free"
CMA = "CMA-ES, friction free"
ON_ARM = (PRONK, NOMINAL, PLAIN, DRY, CMA)
"""Methods for joints that move together."""
DRY_FREE = ("stiffness", "damping", "frictionloss", "delay")
"""Parameters of the methods with the friction free."""
FITTED = ("chirp_sweep", "multisine", "backlash_detection")
"""Recordings of the SO-101 that give the drives."""
RECORDED = ("step_response", "sinusoidal_sweep")
"""Recordings of the SO-101 that judge the drives."""
NAN = float("nan")

Intervals = Mapping[str, tuple[float, float]]
Row = dict[str, Any]
"""Figures of one method on one joint: robot, joint, method, seconds, those of `Found`, `rmse` and
`moving` by signal, `exact`; or `refused` with the reason."""
Rows = Mapping[tuple[int, str], Mapping[str, Any]]
"""Rows of one method by robot and joint."""


@dataclass(frozen=True, kw_only=True)
class Found:
    """Result of one method for one log."""

    values: Mapping[str, float]
    """Stiffness, damping, armature, frictionloss and delay."""
    repeat: Intervals = field(default_factory=dict)
    """95 % intervals from repeats, or of the tool's own kind."""
    total: Intervals = field(default_factory=dict)
    """95 % intervals with everything that the tool takes for uncertain."""
    flags: tuple[str, ...] = ()
    """Warnings of the tool."""


Fit = Callable[[JointRigs, JointLog, str], Found]


def fit_nominal(rigs: JointRigs, log: JointLog, joint: str) -> Found:
    """Nominal gains with the best delay."""
    return Found(values=fit_plain(rigs, log, joint, ("delay",)))


def fit_plainly(rigs: JointRigs, log: JointLog, joint: str) -> Found:
    """Stiffness, damping and delay by nonlinear least squares."""
    return Found(values=fit_plain(rigs, log, joint))


def fit_by_pronk(method: Method, rigs: JointRigs, log: JointLog, joint: str) -> Found:
    """The match of pronk."""
    settings = MatchSettings(zero_armature=False, threads=1)
    result = match_logs([log], rigs.robot, method=method, settings=settings)
    joint_result = result.joints[joint]
    return Found(
        values=drives_of(rigs.robot, result.gains)[joint],
        repeat=joint_result.fit.ci95,
        total=joint_result.fit.total95,
        flags=joint_result.gains.flags,
    )


def fit_by_sysid(rigs: JointRigs, log: JointLog, joint: str) -> Found:
    """The least squares of mujoco.sysid."""
    estimate = fit_mujoco_sysid(log, joint, rigs.robot)
    values = start_values(rigs.robot, joint)
    values["stiffness"] = estimate.stiffness
    values["damping"] = estimate.damping
    values["delay"] = estimate.delay_s or 0.0
    intervals = {}
    if estimate.interval is not None:
        intervals["stiffness"], intervals["damping"] = estimate.interval
    return Found(values=values, repeat=intervals)


def fit_by_cma(rigs: JointRigs, log: JointLog, joint: str) -> Found:
    """CMA-ES over the parameters of the plain fit."""
    return Found(values=search_cma(rigs, log, joint, seed=0))


def methods() -> dict[str, Fit]:
    """Methods by name; that of the nominal gains first, for the others are related to it."""
    return {
        NOMINAL: fit_nominal,
        PLAIN: fit_plainly,
        PRONK: partial(fit_by_pronk, "time"),
        PAPER: partial(fit_by_pronk, "paper"),
        "mujoco.sysid": fit_by_sysid,
        "CMA-ES": fit_by_cma,
    }


def compare(rigs: JointRigs, logs: Recorded, chosen: Mapping[str, Fit]) -> Iterator[Row]:
    """Yield a row for each method on one joint; `refused` has the reason where it gave none."""
    held_out = recordings(logs.held_out, logs.joint, rigs.robot)
    for name, fit in chosen.items():
        row: Row = {"joint": logs.joint, "method": name}
        begin = time.perf_counter()
        try:
            result = fit(rigs, logs.sweep, logs.joint)
        except PronkError as error:
            yield row | {"refused": str(error)}
            continue
        row |= {"seconds": time.perf_counter() - begin, **asdict(result)}
        row["rmse"] = {}
        row["moving"] = {}
        for signal, recording in zip(logs.signals, held_out, strict=True):
            position = simulated(rigs, recording, [result.values])[0]
            difference = position - recording.positions[0]
            row["rmse"][signal] = float(np.sqrt(np.mean(difference**2)))
            row["moving"][signal] = float(difference.std())
        if name != NOMINAL and logs.exact is not None:
            try:
                row["exact"] = dict(fit(rigs, logs.exact, logs.joint).values)
            except PronkError as error:
                row["exact_refused"] = str(error)
        yield row


def run(
    robots: int,
    seed: int,
    progress: Progress,
    *,
    joints: Sequence[str] = JOINTS,
    names: Collection[str] = (),
    folder: Path | None = None,
    jobs: int = 1,
) -> Iterator[list[Row]]:
    """Yield the rows of one robot after the other, of the methods `names` or all.

    Raises:
        PronkError: The number of robots or a joint is impossible.
    """
    if robots < 1 or not joints or not set(joints) <= set(JOINTS):
        raise PronkError(
            f"{robots} robots, joints {', '.join(joints)}; expected 1 or more of each, joints out "
            f"of {', '.join(JOINTS)}."
        )
    work = partial(
        compare_on_robot, seed=seed, joints=joints, names=names or methods(), folder=folder
    )
    for done, rows in enumerate(in_parallel(work, range(robots), jobs)):
        progress("match", (done + 1) / robots)
        yield rows


def compare_on_robot(
    number: int, *, seed: int, joints: Sequence[str], names: Collection[str], folder: Path | None
) -> list[Row]:
    """Rows of one robot."""
    chosen = {name: fit for name, fit in methods().items() if name in names}
    rows = []
    with joint_rigs("mujoco", load_robot(ROBOT), threads=1) as rigs:
        for logs in recorded(seed, number, joints, folder):
            for row in compare(rigs, logs, chosen):
                rows.append({"robot": number} | row)
    return rows


def read_recordings(folder: Path, names: Sequence[str], robot: RobotSpec) -> list[JointLog]:
    """Read some recordings of the SO-101."""
    return [read_log(folder / name, robot=robot) for name in names]


def on_recordings(folder: Path, report: Progress, chosen_methods: Collection[str]) -> list[Row]:
    """Rows of the SO-101: `FITTED` give the drives, `RECORDED` judge them.

    Raises:
        LogError: A recording is missing.
    """
    robot = load_robot("so101")
    logs = read_recordings(folder, FITTED, robot)
    held_out = read_recordings(folder, RECORDED, robot)
    rows: list[Row] = []
    with (
        ChainSimulation(robot, logs, threads=1) as arm,
        ChainSimulation(robot, held_out, joints=arm.joints, threads=1) as judge,
    ):
        nominal = {name: start_values(robot, name) for name in arm.joints}
        dry_start: DriveValues = {}
        chosen = [name for name in ON_ARM if name == PRONK or name in chosen_methods]
        for number, method in enumerate(chosen, 1):
            begin = time.perf_counter()
            drives: DriveValues
            if method == PRONK:
                settings = MatchSettings(threads=1)
                result = match_logs(logs, robot, settings=settings, drive_gains="default")
                drives = drives_of(robot, result.gains)
                dry_start = with_friction(nominal, drives)
            elif method == NOMINAL:
                drives = fit_arm(arm, ("delay",), nominal)
            elif method == PLAIN:
                drives = fit_arm(arm, FREE, dry_start)
            elif method == DRY:
                drives = fit_arm(arm, DRY_FREE, dry_start)
            else:
                drives = search_cma_arm(arm, DRY_FREE, dry_start, 0)
            seconds = time.perf_counter() - begin
            report("fit", number / len(chosen))
            rows += arm_rows(judge, drives, method, seconds)
    return rows


def with_friction(drives: DriveValues, source: DriveValues) -> dict[str, dict[str, float]]:
    """Some drives with the dry friction at rest of others."""
    changed = {}
    for name, values in drives.items():
        changed[name] = {**values, "frictionloss": source[name]["frictionloss"]}
    return changed


def arm_rows(judge: ChainSimulation, drives: DriveValues, method: str, seconds: float) -> list[Row]:
    """Errors of one method on the recordings that judge it, a row a joint."""
    (positions,) = judge.run([drives])
    rows = []
    for column, joint in enumerate(judge.joints):
        rmse = {}
        moving = {}
        for signal, position, measured in zip(RECORDED, positions, judge.measured(), strict=True):
            error = position[:, column] - measured[:, column]
            if np.isfinite(error).all():
                rmse[signal] = float(np.sqrt(np.mean(error**2)))
                moving[signal] = float(error.std())
        rows.append(
            {
                "robot": 0,
                "joint": joint,
                "method": method,
                "seconds": seconds,
                "values": dict(drives[joint]),
                "rmse": rmse,
                "moving": moving,
            }
        )
    return rows


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Summarize each method over its joints; NaN where there is no number.

    `ratio` of a joint is the geometric mean over the held-out signals of its RMSE over that of the
    nominal gains with delay.
    """
    by_method: dict[str, dict[tuple[int, str], Mapping[str, Any]]] = {}
    signals: dict[str, None] = {}
    for row in rows:
        by_method.setdefault(row["method"], {})[row["robot"], row["joint"]] = row
        signals.update(dict.fromkeys(row.get("rmse", ())))
    summaries = []
    for name, method_rows in by_method.items():
        results = {key: row for key, row in method_rows.items() if "rmse" in row}
        ratios = error_ratios(results, by_method.get(NOMINAL, {}), tuple(signals))
        over_plain = error_ratios(results, by_method.get(PLAIN, {}), tuple(signals))
        moving = error_ratios(results, by_method.get(PLAIN, {}), tuple(signals), "moving")
        by_joint = np.array([NAN])
        by_signal = {}
        if len(ratios):
            by_joint = np.exp(np.nanmean(np.log(ratios), axis=1))
            by_signal = dict(zip(signals, np.nanmedian(ratios, axis=0).tolist(), strict=True))
        compared = [row for row in results.values() if "exact" in row]
        bias = gain_bias(compared)
        summaries.append(
            {
                "method": name,
                "joints": len(results),
                "refused": len(method_rows) - len(results),
                "below": int((by_joint < 1.0).sum()),
                "cells_below": int((ratios < 1.0).sum()),
                "median": float(np.median(by_joint)),
                "signals": by_signal,
                "over_plain": geometric_mean(over_plain),
                "moving": geometric_mean(moving),
                "bias": np.mean(bias, axis=0).tolist(),
                "absolute": np.median(np.abs(bias), axis=0).tolist(),
                "seconds": float(np.mean([row["seconds"] for row in results.values()] or [NAN])),
                "repeat": coverage(compared, "repeat"),
                "total": coverage(compared, "total"),
            }
        )
    return summaries


def geometric_mean(ratios: Array) -> float:
    """Geometric mean of ratios, those that are NaN left out; NaN of none."""
    return float(np.exp(np.nanmean(np.log(ratios)))) if len(ratios) else NAN


def gain_bias(rows: Sequence[Mapping[str, Any]]) -> Array:
    """Gains of the sweep over those without noise, less 1 [%], shape (rows, 2); NaN of none."""
    if not rows:
        return np.full((1, len(GAINS)), NAN)
    bias = np.empty((len(rows), len(GAINS)))
    for number, row in enumerate(rows):
        for column, gain in enumerate(GAINS):
            bias[number, column] = 100.0 * (row["values"][gain] / row["exact"][gain] - 1.0)
    return bias


def coverage(rows: Sequence[Mapping[str, Any]], figure: str) -> dict[str, Any]:
    """How many intervals of one kind hold the gains without noise, and how wide they are."""
    covered = 0
    half_widths = []
    for row in rows:
        for gain in GAINS:
            if gain not in row[figure]:
                continue
            low, high = row[figure][gain]
            covered += low <= row["exact"][gain] <= high
            half_widths.append(50.0 * (high - low) / row["values"][gain])
    return {
        "intervals": len(half_widths),
        "covered": covered,
        "half_width": float(np.median(half_widths)) if half_widths else NAN,
    }


def error_ratios(
    rows: Rows, other_rows: Rows, signals: Sequence[str], figure: str = "rmse"
) -> Array:
    """Errors over those of another method, shape (joints that both have, signals).

    NaN where a signal does not excite a joint.
    """
    ratios = []
    for key, row in rows.items():
        other = other_rows.get(key, {})
        if figure in other:
            ratios.append([row[figure].get(s, NAN) / other[figure].get(s, NAN) for s in signals])
    return np.array(ratios).reshape(-1, len(signals))


def summary_table(
    summaries: Sequence[Mapping[str, Any]], title: str, notes: Sequence[str]
) -> Table:
    """Make the table of `summary`."""
    signals: Sequence[str] = HELD_OUT
    for entry in summaries:
        if entry["signals"]:
            signals = tuple(entry["signals"])
            break
    columns = [
        Column(heading="method"),
        Column(heading="joints"),
        Column(heading="refused"),
        Column(heading="below"),
        Column(heading="median", digits=2),
    ]
    columns += [Column(heading=name, digits=2) for name in signals]
    columns += [
        Column(heading="over plain"),
        Column(heading="moving"),
        Column(heading="bias, stiffness", unit="%", digits=1),
        Column(heading="bias, damping", unit="%", digits=1),
        Column(heading="|bias|, stiffness", unit="%", digits=1),
        Column(heading="|bias|, damping", unit="%", digits=1),
        Column(heading="repeat 95 %"),
        Column(heading="total 95 %"),
        Column(heading="fit", unit="s", digits=1),
    ]
    rows: list[tuple[Cell, ...]] = []
    for entry in summaries:
        by_signal = [entry["signals"].get(name, NAN) for name in signals]
        rows.append(
            (
                entry["method"],
                entry["joints"],
                entry["refused"],
                entry["below"],
                entry["median"],
                *by_signal,
                entry["over_plain"],
                entry["moving"],
                *entry["bias"],
                *entry["absolute"],
                coverage_text(entry["repeat"]),
                coverage_text(entry["total"]),
                entry["seconds"],
            )
        )
    return Table(title=title, columns=tuple(columns), rows=tuple(rows), notes=tuple(notes))


def coverage_text(covered: Mapping[str, Any]) -> str:
    """Text of a coverage, with the half-width of the intervals."""
    if not covered["intervals"]:
        return "none"
    half_width = covered["half_width"]
    return f"{covered['covered']} of {covered['intervals']} (+-{half_width:.2f} %)"


def match(
    robots: int = 20,
    seed: int = 27,
    joints: tuple[Kind, ...] = (),
    method: tuple[str, ...] = (),
    cache: Path | None = None,
    arm: Path | None = None,
    jobs: int = 1,
) -> console.Outcome:
    """Match virtual robots drawn at random by pronk and its peers; held-out error, coverage.

    Args:
        robots: Number of robots.
        seed: Of the parameters of the robots and of the noise.
        joints: Joints of one leg; all if left out.
        method: Methods beside the nominal gains and the plain fit; repeat it. All if left out.
        cache: Folder of the recorded logs; in the system's temporary folder if left out.
        arm: Folder of the recordings of a real SO-101, which are matched instead, by all methods
            but mujoco.sysid, whose rig here is one joint.
        jobs: Processes, a robot each.
    """
    begin = time.perf_counter()
    joints = joints or JOINTS
    names = ON_ARM if arm else tuple(methods())
    unknown = set(method) - set(names)
    if unknown:
        raise PronkError(f"methods {', '.join(unknown)}; expected some of {', '.join(names)}.")
    chosen_methods = {NOMINAL, PLAIN, *(method or names)}
    rows: list[Row] = []
    with console.progress() as report:
        try:
            if arm:
                rows = on_recordings(arm, report, chosen_methods)
            else:
                chosen = [name for name in names if name in chosen_methods]
                for robot_rows in run(
                    robots, seed, report, joints=joints, names=chosen, folder=cache, jobs=jobs
                ):
                    rows += robot_rows
        except KeyboardInterrupt:
            console.warn("interrupted")
    summaries = summary(rows)
    computer = machine("mujoco")
    seconds = time.perf_counter() - begin
    count = len({row["robot"] for row in rows})
    figures = {
        "schema": "pronk/bench-match/4",
        "seed": seed,
        "robots": count,
        "summary": summaries,
        "rows": rows,
        "machine": computer,
        "seconds": seconds,
    }
    title = f"{count} virtual robots, seed {seed}, {', '.join(joints)} of one leg"
    if arm:
        title = "a real SO-101, fitted to " + ", ".join(FITTED)
    notes = (
        "joints: with a result. below: joints whose held-out RMSE (geometric mean over the "
        "signals) is below that of the nominal gains with delay; median and medians of each "
        "signal: of that ratio.",
        "over plain: geometric mean of the RMSE over the plain fit's; moving: the same without the "
        "mean error of each signal, which is sag under gravity.",
        "bias, |bias|: mean and median of the absolute value, against the same method on a "
        "noise-free chirp of a third amplitude. repeat, total: intervals of both gains that "
        "contain those; in brackets the median half-width.",
        f"One thread; {computer['processor']}, MuJoCo {computer['mujoco']}; {seconds:.0f} s.",
    )
    return finish(figures, summary_table(summaries, title, notes))
