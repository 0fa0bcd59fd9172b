"""`pronk trial`: the paper's jumps on the virtual robot, measured from outside."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from pronk.cli import console

if TYPE_CHECKING:
    from pronk.evaluation.outcome.table_text import Sheet
    from pronk.evaluation.result import Trial

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
        bodies: Also try three bodies never seen, each matched anew.
        own: A policy trained with the gains of the first body of --bodies; give it
            again for the second and the third.
        video: MP4, GIF and strip of each command, where this machine can paint.
        keep_captures: Keep what was seen of every jump (4 MB each), not of the first of
            each command.
        overwrite: Replace the trial in that folder.
        definitions: Also print the equation of every figure.
        json_file: Also write the figures to this file.
    """
    from pronk.cli.trial_more import more
    from pronk.errors import PronkError
    from pronk.evaluation.folder import CAPTURES, VIDEOS
    from pronk.evaluation.outcome import tables
    from pronk.evaluation.processes import cores
    from pronk.evaluation.protocol import parse_cases
    from pronk.evaluation.result import SUMMARY, TABLE
    from pronk.evaluation.run import Plan, run
    from pronk.files import sha256
    from pronk.report.whole import write_report
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
    # A wrong number of processes is refused by `run`; None is left to the machine.
    count = cores() if processes is None else processes
    policies = [policy, *(also or ())]
    asked: dict[str, Any] = {
        "robot": load_robot(ROBOT),
        "sim_params": load_sim_params(file),
        "about": {
            "file": str(sim_params) if sim_params else "shipped with pronk",
            "sha256": sha256(file),
        },
        "processes": count,
    }
    with console.progress() as report:
        found = run(
            policies,
            plan,
            out=out,
            keep_captures=keep_captures,
            overwrite=overwrite,
            progress=report.bar("jumping"),
            **asked,
        )
    for sheet in tables.sheets(found):
        if definitions or sheet.title != tables.DEFINITIONS:
            show(sheet)
    console.say(spent(found))
    console.wrote(out / TABLE, out / SUMMARY, out / CAPTURES)
    with console.progress() as report:
        shown = [case.name for case in plan.cases]
        films = painted(found, out, report=report, at_once=count, cases=shown) if video else ()
        sheets, files = more(
            policies,
            out,
            seed=seed,
            report=report,
            walk=walk,
            crossing=crossing,
            variation=variation,
            bodies=bodies,
            own=[[path] for path in own or ()],
            jumps=jumps,
            **asked,
        )
        page, _ = write_report(out, report)
    for sheet in sheets:
        show(sheet)
    console.wrote(*([out / VIDEOS] if films else []), *files, page)
    console.write_json(json_file, figures(found, sheets) | {"page": page, "videos": films})
    console.following(f"open {page} in a browser", f"pronk play {policy}")


def painted(
    found: Trial,
    out: Path,
    *,
    report: console.Reporter | None,
    at_once: int,
    cases: Sequence[str] | None = None,
    slow: float | None = None,
) -> tuple[Path, ...]:
    """Paint the films of a trial, where this machine can; one line says what it lacks.

    Args:
        found: The trial.
        out: Its folder.
        report: Told the share that is painted.
        at_once: How many films at once.
        cases: Names of the commands to show; all if None.
        slow: How many times slower than real time the flight is shown; as usual if None.

    Returns:
        The files.
    """
    from pronk.evaluation.folder import VIDEOS
    from pronk.evaluation.pictures.videos import SLOW, record_all

    return record_all(
        found,
        out,
        out / VIDEOS,
        tell=console.warn,
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


def spent(found: Trial) -> str:
    """How long it took."""
    timing = found.timing
    return (
        f"{len(found.rows)} jumps, {timing['simulated_s']:.0f} s of the virtual robot in "
        f"{timing['seconds']:.0f} s on {timing['processes']:.0f} processes; "
        f"{timing['simulated_s_per_s_and_process']:.1f} simulated seconds per second and process, "
        f"{timing['simulated_s_per_cpu_s']:.1f} per second of a core"
    )


def figures(found: Trial, more: Sequence[Sheet] = ()) -> dict[str, Any]:
    """What `--json` writes: tables and bars; `summary.json` has the numbers in full.

    Args:
        found: The trial.
        more: Tables of what else was tried.
    """
    from dataclasses import asdict

    from pronk.evaluation.outcome import criteria as bars
    from pronk.evaluation.outcome import tables

    return {
        "virtual": found.virtual,
        "sheets": [asdict(sheet) for sheet in (*tables.sheets(found), *more)],
        "checks": [check.row() for check in bars.checks(found)],
        "cells": [asdict(cell) for cell in found.cells],
        "ratios": [asdict(ratio) for ratio in found.ratios],
        "timing": dict(found.timing),
    }
