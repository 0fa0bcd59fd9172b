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
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.table import Table

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

Kind = Literal["hip_roll", "hip_pitch", "knee"]
JOINTS: tuple[Kind, ...] = ("hip_roll", "hip_pitch", "knee")
GAINS = ("stiffness", "damping")
NOMINAL = "nominal with delay"
PLAIN = "plain fit"
PRONK = "pronk"
PAPER = "pronk, paper's method"
DRY, CMA = "plain fit, friction free", "CMA-ES, friction free"
ON_ARM = (PRONK, NOMINAL, PLAIN, DRY, CMA)
"""Methods for joints that move together."""
FITTED = ("chirp_sweep", "multisine", "backlash_detection")
RECORDED = ("step_response", "sinusoidal_sweep")
"""Recordings of the SO-101 that give the drives, and that judge them."""
Intervals = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class Found:
    """Result of one method for one log."""

    values: Mapping[str, float]
    """stiffness, damping, armature, frictionloss, delay."""
    repeat: Intervals = field(default_factory=dict)
    """95 % intervals from repeats, or of the tool's own kind."""
    total: Intervals = field(default_factory=dict)
    """95 % intervals with everything that the tool takes for uncertain."""
    flags: tuple[str, ...] = ()


Fit = Callable[[JointRigs, JointLog, str], Found]


def _pronk(method: Method, rigs: JointRigs, log: JointLog, joint: str) -> Found:
    settings = MatchSettings(zero_armature=False, threads=1)
    result = match_logs([log], rigs.robot, method=method, settings=settings)
    joint_result = result.joints[joint]
    return Found(
        values=drives_of(rigs.robot, result.gains)[joint],
        repeat=joint_result.fit.ci95,
        total=joint_result.fit.total95,
        flags=joint_result.gains.flags,
    )


def _sysid(rigs: JointRigs, log: JointLog, joint: str) -> Found:
    found = fit_mujoco_sysid(log, joint, rigs.robot)
    fitted = {"stiffness": found.stiffness, "damping": found.damping, "delay": found.delay_s or 0.0}
    own = dict(zip(GAINS, found.interval or (), strict=False))
    return Found(values=start_values(rigs.robot, joint) | fitted, repeat=own)


def methods() -> dict[str, Fit]:
    """Methods by name; that of the nominal gains first, for the others are related to it."""
    return {
        NOMINAL: lambda rigs, log, joint: Found(values=fit_plain(rigs, log, joint, ("delay",))),
        PLAIN: lambda rigs, log, joint: Found(values=fit_plain(rigs, log, joint)),
        PRONK: partial(_pronk, "time"),
        PAPER: partial(_pronk, "paper"),
        "mujoco.sysid": _sysid,
        "CMA-ES": lambda rigs, log, joint: Found(values=search_cma(rigs, log, joint, seed=0)),
    }


def compare(rigs: JointRigs, logs: Recorded, chosen: Mapping[str, Fit]) -> Iterator[dict[str, Any]]:
    """Yield a row for each method on one joint; `refused` has the reason where it gave none."""
    held_out = recordings(logs.held_out, logs.joint, rigs.robot)
    for name, fit in chosen.items():
        row: dict[str, Any] = {"joint": logs.joint, "method": name}
        begin = time.perf_counter()
        try:
            found = fit(rigs, logs.sweep, logs.joint)
        except PronkError as error:
            yield row | {"refused": str(error)}
            continue
        row |= {"seconds": time.perf_counter() - begin, **vars(found)}
        errors = [simulated(rigs, one, [found.values])[0] - one.positions[0] for one in held_out]
        rmse = [float(np.sqrt(np.mean(error**2))) for error in errors]
        row["rmse"] = dict(zip(HELD_OUT, rmse, strict=True))
        row["moving"] = dict(zip(HELD_OUT, [float(e.std()) for e in errors], strict=True))
        if name != NOMINAL:
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
) -> Iterator[list[dict[str, Any]]]:
    """Yield the rows of one robot after the other, of the methods `names` or all.

    Raises:
        PronkError: The number of robots or a joint is impossible.
    """
    if robots < 1 or not joints or not set(joints) <= set(JOINTS):
        raise PronkError(
            f"{robots} robots, joints {', '.join(joints)}; expected 1 or more of each, joints out "
            f"of {', '.join(JOINTS)}."
        )
    work = partial(_robot, seed=seed, joints=joints, names=names or methods(), folder=folder)
    for done, rows in enumerate(in_parallel(work, range(robots), jobs)):
        progress("match", (done + 1) / robots)
        yield rows


def _robot(
    number: int, *, seed: int, joints: Sequence[str], names: Collection[str], folder: Path | None
) -> list[dict[str, Any]]:
    """Rows of one robot."""
    chosen = {name: fit for name, fit in methods().items() if name in names}
    with joint_rigs("mujoco", load_robot(ROBOT), threads=1) as rigs:
        return [
            {"robot": number} | row
            for logs in recorded(seed, number, joints, folder)
            for row in compare(rigs, logs, chosen)
        ]


def on_recordings(folder: Path, report: Progress, wanted: Collection[str]) -> list[dict[str, Any]]:
    """Rows of the SO-101: `FITTED` give the drives, `RECORDED` judge them.

    Raises:
        LogError: A recording is missing.
    """
    robot = load_robot("so101")
    logs, held_out = (
        [read_log(folder / name, robot=robot) for name in names] for names in (FITTED, RECORDED)
    )
    rows: list[dict[str, Any]] = []
    with (
        ChainSimulation(robot, logs, threads=1) as arm,
        ChainSimulation(robot, held_out, joints=arm.joints, threads=1) as judge,
    ):
        nominal = {name: start_values(robot, name) for name in arm.joints}
        found: DriveValues = {}

        def pronk(_: DriveValues) -> DriveValues:
            result = match_logs(
                logs, robot, settings=MatchSettings(threads=1), drive_gains="default"
            )
            return drives_of(robot, result.gains)

        def given(pronks: DriveValues) -> DriveValues:
            return {
                name: drive | {"frictionloss": pronks[name]["frictionloss"]}
                for name, drive in nominal.items()
            }

        dry = ("stiffness", "damping", "frictionloss", "delay")
        chosen: dict[str, Callable[[DriveValues], DriveValues]] = {
            PRONK: pronk,
            NOMINAL: lambda _: fit_arm(arm, ("delay",), nominal),
            PLAIN: lambda pronks: fit_arm(arm, FREE, given(pronks)),
            DRY: lambda pronks: fit_arm(arm, dry, given(pronks)),
            CMA: lambda pronks: search_cma_arm(arm, dry, given(pronks), 0),
        }
        chosen = {name: fit for name, fit in chosen.items() if name in {PRONK, *wanted}}
        for k, (method, fit) in enumerate(chosen.items()):
            begin = time.perf_counter()
            drives = fit(found)
            seconds = time.perf_counter() - begin
            found = found or drives
            report("fit", (k + 1) / len(chosen))
            errors = [
                simulated - measured
                for simulated, measured in zip(
                    judge.run([drives])[0], judge.measured(), strict=True
                )
            ]
            for i, joint in enumerate(arm.joints):
                own = {
                    name: error[:, i]
                    for name, error in zip(RECORDED, errors, strict=True)
                    if np.isfinite(error[:, i]).all()
                }
                row = {"robot": 0, "joint": joint, "method": method, "seconds": seconds}
                row |= {"values": drives[joint]}
                row |= {"rmse": {s: float(np.sqrt(np.mean(e**2))) for s, e in own.items()}}
                rows.append(row | {"moving": {s: float(e.std()) for s, e in own.items()}})
    return rows


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Summarize each method over its joints; NaN where there is no number.

    `ratio` of a joint is the geometric mean over the held-out signals of its RMSE over that of the
    nominal gains with delay.
    """
    by: dict[str, dict[tuple[int, str], Mapping[str, Any]]] = {}
    for row in rows:
        by.setdefault(row["method"], {})[row["robot"], row["joint"]] = row
    signals = tuple(dict.fromkeys(s for row in rows for s in row.get("rmse", ())))
    out = []
    for name, mine in by.items():
        good = {key: row for key, row in mine.items() if "rmse" in row}
        ratios = _ratios(good, by.get(NOMINAL, {}), signals)
        plain, moving = (
            _ratios(good, by.get(PLAIN, {}), signals, kind) for kind in ("rmse", "moving")
        )
        joint = np.exp(np.nanmean(np.log(ratios), axis=1)) if len(ratios) else np.array([np.nan])
        both = [row for row in good.values() if "exact" in row]
        bias = [[100.0 * (r["values"][g] / r["exact"][g] - 1.0) for g in GAINS] for r in both]
        one: dict[str, Any] = {
            "method": name,
            "joints": len(good),
            "refused": len(mine) - len(good),
            "below": int((joint < 1.0).sum()),
            "cells_below": int((ratios < 1.0).sum()),
            "median": float(np.median(joint)),
            "signals": dict(zip(signals, np.nanmedian(ratios, axis=0).tolist(), strict=True))
            if len(ratios)
            else {},
            "over_plain": float(np.exp(np.nanmean(np.log(plain)))) if len(plain) else float("nan"),
            "moving": float(np.exp(np.nanmean(np.log(moving)))) if len(moving) else float("nan"),
            "bias": np.mean(bias, axis=0).tolist() if bias else [float("nan")] * 2,
            "absolute": np.median(np.abs(bias), axis=0).tolist() if bias else [float("nan")] * 2,
            "seconds": float(np.mean([r["seconds"] for r in good.values()] or [float("nan")])),
        }
        for kind in ("repeat", "total"):
            pairs = [
                (r[kind][g], r["exact"][g], r["values"][g])
                for r in both
                for g in GAINS
                if g in r[kind]
            ]
            one[kind] = {
                "intervals": len(pairs),
                "covered": sum(low <= exact <= high for (low, high), exact, _ in pairs),
                "half_width": float(
                    np.median([50.0 * (high - low) / value for (low, high), _, value in pairs])
                )
                if pairs
                else float("nan"),
            }
        out.append(one)
    return out


def _ratios(
    mine: Mapping[Any, Mapping[str, Any]],
    other: Mapping[Any, Mapping[str, Any]],
    signals: Sequence[str],
    kind: str = "rmse",
) -> Any:
    """RMSE over that of another method, shape (joints that both have, signals).

    NaN where a signal does not excite a joint.
    """
    both = [key for key in mine if kind in other.get(key, {})]
    ratios = [
        [mine[k][kind].get(s, np.nan) / other[k][kind].get(s, np.nan) for s in signals]
        for k in both
    ]
    return np.array(ratios).reshape(-1, len(signals))


def show(summaries: Sequence[Mapping[str, Any]], title: str, caption: str) -> Table:
    """Make the table of `summary`."""
    signals = next((one["signals"] for one in summaries if one["signals"]), HELD_OUT)
    columns = ["method", "joints", "below", "median", *signals, "over plain", "moving", "bias [%]"]
    columns += ["|bias| [%]", "repeat 95 %", "total 95 %", "fit [s]"]
    made = console.table(title, columns, caption=caption)

    def coverage(one: Mapping[str, Any]) -> str:
        if not one["intervals"]:
            return "none"
        return f"{one['covered']} of {one['intervals']} (+-{one['half_width']:.2f} %)"

    for one in summaries:
        known = np.isfinite(one["bias"]).all()
        refused = f", {one['refused']} refused" if one["refused"] else ""
        made.add_row(
            one["method"],
            f"{one['joints']}{refused}",
            f"{one['below']}",
            f"{one['median']:.2f}",
            *(f"{one['signals'].get(name, float('nan')):.2f}" for name in signals),
            f"{one['over_plain']:.3f}",
            f"{one['moving']:.3f}",
            "{:+.1f} / {:+.1f}".format(*one["bias"]) if known else "none",
            "{:.1f} / {:.1f}".format(*one["absolute"]) if known else "none",
            coverage(one["repeat"]),
            coverage(one["total"]),
            f"{one['seconds']:.1f}",
        )
    return made


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
    begin, known = time.perf_counter(), methods()
    joints = joints or JOINTS
    names = ON_ARM if arm else tuple(known)
    if unknown := set(method) - set(names):
        raise PronkError(f"methods {', '.join(unknown)}; expected some of {', '.join(names)}.")
    wanted = {NOMINAL, PLAIN, *(method or names)}
    names = tuple(name for name in known if name in wanted)
    rows: list[dict[str, Any]] = []
    with console.progress() as report:
        try:
            virtual = run(robots, seed, report, joints=joints, names=names, folder=cache, jobs=jobs)
            for more in [on_recordings(arm, report, wanted)] if arm else virtual:
                rows += more
        except KeyboardInterrupt:
            console.warn("interrupted")
    found = {
        "schema": "pronk/bench-match/4",
        "seed": seed,
        "robots": len({row["robot"] for row in rows}),
        "summary": (summaries := summary(rows)),
        "rows": rows,
        "machine": (computer := machine("mujoco")),
        "seconds": time.perf_counter() - begin,
    }
    title = "a real SO-101, fitted to " + ", ".join(FITTED)
    if not arm:
        title = f"{found['robots']} virtual robots, seed {seed}, {', '.join(joints)} of one leg"
    caption = (
        "joints: with a result. below: joints whose held-out RMSE (geometric mean over the "
        "signals) is below that of the nominal gains with delay; median and medians of each "
        "signal: of that ratio. over plain: geometric mean of the RMSE over the plain fit's; "
        "moving: the same without the mean error of each signal, which is sag under gravity. "
        "bias, |bias|: mean, median of the absolute value, of stiffness / damping, against the "
        "same method on a noise-free chirp of a third amplitude. repeat, total: intervals of both "
        "gains that contain those; in brackets the median half-width. One thread; "
        f"{computer['processor']}, MuJoCo {computer['mujoco']}; {found['seconds']:.0f} s in all."
    )
    return finish(found, show(summaries, title, caption))
