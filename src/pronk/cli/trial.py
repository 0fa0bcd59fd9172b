"""`pronk trial`: the paper's jumps on the virtual robot, measured from outside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from pronk.cli import console

if TYPE_CHECKING:
    from pronk.evaluation.results import Results
    from pronk.evaluation.tables import Sheet

ROBOT = "mini_cheetah"
RATES_JUMPS = 3
"""At 2.25 m/s, beside the paper's commands: enough to draw its figure of roll and pitch rates."""


def trial(
    policy: tyro.conf.Positional[Path],
    out: Path,
    also: tuple[Path, ...] = (),
    commands: tuple[str, ...] = (),
    jumps: int = 20,
    sim_params: Path | None = None,
    seed: int = 0,
    processes: int | None = None,
    walk: bool = False,
    crossing: bool = False,
    variation: bool = False,
    bodies: bool = False,
    own: tuple[Path, ...] = (),
    video: bool = True,
    keep_captures: bool = False,
    overwrite: bool = False,
    definitions: bool = False,
    json_file: console.JsonFile = None,
) -> None:
    """Stand, run, jump, stop: 20 times with each command; the paper's table beside ours.

    Args:
        policy: policy.onnx.
        out: Folder for tables, captures, videos and the page.
        also: Another policy to compare with, as the naive one. Give it repeatedly.
        commands: Forward and left velocity in m/s, as "2.25,0"; a yaw rate in rad/s may
            follow. Give it repeatedly; "paper" is the paper's five. If left out, those,
            and a few jumps at 2.25 m/s for the figure of roll and pitch rates.
        jumps: Jumps with each command.
        sim_params: Body of the virtual robot; the one that ships with pronk if left
            out.
        seed: Of all draws.
        processes: Jumps at once; as many as there are cores if left out.
        walk: Also walk 20 s with each velocity, 20 times.
        crossing: Also cross gaps and steps of growing size.
        variation: Also vary mass, friction, delay and bus voltage, one by one.
        bodies: Also try three randomized robots, each matched by its own sweep.
        own: A policy trained with the gains of the first body of --bodies; give it
            again for the second and the third.
        video: MP4, GIF and strip of each command, where this machine can render.
        keep_captures: Keep the capture of every jump (4 MB each), not of the first of each
            command.
        overwrite: Replace the trial in that folder.
        definitions: Also print the equation of every figure.
        json_file: Also write the figures to this file.
    """
    from pronk.errors import PronkError
    from pronk.evaluation import tables
    from pronk.evaluation.protocol import parse_cases
    from pronk.evaluation.results import SUMMARY, TABLE
    from pronk.evaluation.trial import CAPTURES, VIDEOS, Plan, cores, run_trial
    from pronk.files import sha256
    from pronk.report.build import write_report
    from pronk.robots import load_robot
    from pronk.virtual.sim_params import SHIPPED, load_sim_params

    if own and not bodies:
        raise PronkError("--own without --bodies; it names policies that are tried on those.")
    plan = Plan(
        cases=parse_cases(commands or ["paper"]),
        jumps=jumps,
        rates=0 if commands else RATES_JUMPS,
        seed=seed,
    )
    file = sim_params or SHIPPED
    # A wrong number of processes is refused by `run_trial`.
    count = cores() if processes is None else processes
    policies = [policy, *also]
    common: dict[str, Any] = {
        "robot": load_robot(ROBOT),
        "sim_params": load_sim_params(file),
        "out": out,
        "about": {
            "file": str(sim_params) if sim_params else "shipped with pronk",
            "sha256": sha256(file),
        },
        "processes": count,
    }
    with console.progress() as report:
        found = run_trial(
            policies,
            plan,
            keep_captures=keep_captures,
            overwrite=overwrite,
            progress=report.bar("jumping"),
            **common,
        )
    for sheet in tables.sheets(found):
        if definitions or sheet.title != tables.DEFINITIONS:
            show(sheet)
    console.say(spent(found))
    console.wrote(out / TABLE, out / SUMMARY, out / CAPTURES)
    extras = {"walk": walk, "crossing": crossing, "variation": variation, "bodies": bodies}
    with console.progress() as report:
        shown = [case.name for case in plan.cases]
        films = painted(found, out, report=report, at_once=count, cases=shown) if video else ()
        sheets, files = more(
            [name for name, wanted in extras.items() if wanted],
            policies,
            common,
            seed=seed,
            jumps=jumps,
            own=[[path] for path in own],
            report=report,
        )
        page, _ = write_report(out, report)
    for sheet in sheets:
        show(sheet)
    console.wrote(*([out / VIDEOS] if films else []), *files, page)
    console.write_json(json_file, figures(found, sheets) | {"page": page, "videos": films})
    console.following(f"open {page} in a browser", f"pronk play {policy}")


def more(
    extras: Sequence[str],
    policies: Sequence[Path],
    common: dict[str, Any],
    *,
    seed: int,
    jumps: int,
    own: Sequence[Sequence[Path]],
    report: console.Reporter,
) -> tuple[list[Sheet], list[Path]]:
    """Run what belongs to a trial besides the jumps; return tables and files.

    Args:
        extras: Of `walk`, `crossing`, `variation` and `bodies`.
        policies: Of the trial.
        common: Arguments that all of them take.
        seed: Of all draws.
        jumps: With each command on each randomized robot.
        own: Policies that were trained with each randomized robot's gains.
        report: Shows the progress.
    """
    from pronk.evaluation import bodies, variation
    from pronk.evaluation.crossing import CROSSING, CrossingPlan, add_crossings
    from pronk.evaluation.trial import Plan
    from pronk.evaluation.walk import WALK, add_walks
    from pronk.report import extra_pages

    sheets: list[Sheet] = []
    files: list[Path] = []
    if "walk" in extras:
        walks = add_walks(policies, seed=seed, progress=report.bar("walking"), **common)
        sheets += [on_virtual("walking", one) for one in extra_pages.walk_tables(walks)]
        files.append(Path(WALK.summary))
    if "crossing" in extras:
        crossed = add_crossings(
            policies, CrossingPlan(seed=seed), progress=report.bar("crossing"), **common
        )
        sheets.append(on_virtual("crossing", extra_pages.crossing_table(crossed)))
        files.append(Path(CROSSING.summary))
    if "variation" in extras:
        plan = Plan(jumps=5, seed=seed)
        varied = variation.add_variation(
            policies, plan, progress=report.bar("varying the robot"), **common
        )
        sheets.append(variation.table(varied))
        files.append(Path(variation.VARIATION.summary))
    if "bodies" in extras:
        plan = Plan(jumps=jumps, seed=seed)
        found = bodies.add_bodies(policies, plan, own=own, seed=seed, progress=report, **common)
        sheets.append(bodies.table(found))
        files += [Path(bodies.FILE), Path(bodies.FOLDER)]
    return sheets, [common["out"] / name for name in files]


def on_virtual(what: str, sheet: Sheet) -> Sheet:
    """Add where and what to the title of a table of the page."""
    return replace(sheet, title=f"Virtual robot, {what}: {sheet.title}")


def painted(
    found: Results,
    out: Path,
    *,
    report: console.Reporter | None,
    at_once: int,
    cases: Sequence[str] | None = None,
    slow: float | None = None,
) -> tuple[Path, ...]:
    """Render the films of a trial, where this machine can; warn of what it lacks.

    Args:
        found: The trial.
        out: Its folder.
        report: Shows the progress.
        at_once: Films at once.
        cases: Names of the commands to show; all if None.
        slow: Slow-down of the flight; the default if None.

    Returns:
        The files.
    """
    from pronk.evaluation.pictures.video import SLOW, record_all
    from pronk.evaluation.trial import VIDEOS

    return record_all(
        found,
        out,
        out / VIDEOS,
        warn=console.warn,
        cases=cases,
        slow=slow or SLOW,
        at_once=at_once,
        progress=report.bar("painting videos") if report else lambda _: None,
    )


def show(sheet: Sheet) -> None:
    """Print a table and its notes."""
    made = console.table(sheet.title, *sheet.columns)
    if sheet.columns[-1] == "equation":
        made.columns[-1].justify = "left"
    for row in sheet.rows:
        console.row(made, *row)
    console.show(made)
    for note in sheet.notes:
        console.say(f"  {note}")


def spent(found: Results) -> str:
    """The computing time, in words."""
    timing = found.timing
    return (
        f"{len(found.rows)} jumps, {timing['simulated_s']:.0f} s of the virtual robot in "
        f"{timing['seconds']:.0f} s on {timing['processes']:.0f} processes; "
        f"{timing['simulated_s_per_s_and_process']:.1f} simulated seconds per second and process, "
        f"{timing['simulated_s_per_cpu_s']:.1f} per second of a core"
    )


def figures(found: Results, more: Sequence[Sheet] = ()) -> dict[str, Any]:
    """Return what `--json` writes: tables and checks; `summary.json` has the numbers in full."""
    from pronk.evaluation import tables
    from pronk.evaluation.criteria import trial_checks

    return {
        "virtual": found.virtual,
        "sheets": [asdict(sheet) for sheet in (*tables.sheets(found), *more)],
        "checks": [check.row() for check in trial_checks(found)],
        "cells": [asdict(cell) for cell in found.cells],
        "ratios": [asdict(ratio) for ratio in found.ratios],
        "timing": dict(found.timing),
    }
