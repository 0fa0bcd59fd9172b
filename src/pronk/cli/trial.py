"""`pronk trial`: the paper's jumps on the virtual robot, measured from outside."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from pronk.cli import console
from pronk.errors import PronkError

if TYPE_CHECKING:
    from pronk.jump.trial.tables import Sheet
    from pronk.jump.trial.trial import Plan, Setup

RATES_JUMPS = 3
"""At 2.25 m/s, beside the paper's commands: enough to draw its figure of roll and pitch rates."""


def trial(
    policy: tyro.conf.Positional[Path],
    out: Path,
    robot: str | None = None,
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
) -> console.Outcome:
    """Stand, run, jump, stop: 20 times with each command; the paper's table beside ours.

    Args:
        policy: policy.onnx.
        robot: A name, or a path to a robot.yaml, MJCF or URDF; the policy's if left out.
        out: Folder for tables, captures, videos and the page.
        also: Another policy to compare with, as the naive one. Give it repeatedly.
        commands: Forward and left velocity in m/s, as "2.25,0"; a yaw rate in rad/s may
            follow. Give it repeatedly; "paper" is the paper's five. If left out, those,
            and a few jumps at 2.25 m/s for the figure of roll and pitch rates.
        jumps: Jumps with each command.
        sim_params: Parameters of the virtual robot, instead of the shipped ones.
        seed: Of all draws.
        processes: Jumps at once; as many as there are cores if left out.
        walk: Also walk 20 s with each velocity, 20 times.
        crossing: Also cross gaps and steps of growing size.
        variation: Also vary mass, friction, delay and bus voltage, one by one.
        bodies: Also try three randomized robots, each matched by its own sweep.
        own: A policy trained with the gains of the first robot of --bodies; give it
            again for the second and the third.
        video: MP4, GIF and strip of each command, where this machine can render.
        keep_captures: Keep the capture of every jump (4 MB each), not of the first of each
            command.
        overwrite: Replace the trial in that folder.
        definitions: Also print the equation of every figure.
    """
    from pronk.jump.trial import tables
    from pronk.jump.trial.criteria import trial_checks
    from pronk.jump.trial.films.video import record_all
    from pronk.jump.trial.protocol import parse_cases
    from pronk.jump.trial.results import SUMMARY, TABLE
    from pronk.jump.trial.trial import CAPTURES, VIDEOS, Plan, run_trial, setup_of
    from pronk.report.build import write_report

    if own and not bodies:
        raise PronkError("--own without --bodies; it names policies that are tried on those.")
    cases, rates = parse_cases(commands or ["paper"]), 0 if commands else RATES_JUMPS
    plan = Plan(cases=cases, jumps=jumps, rates=rates, seed=seed)
    policies = [policy, *also]
    setup = setup_of(policy, out, sim_params, robot, processes=processes)
    with console.progress() as report:
        found = run_trial(
            policies,
            plan,
            setup,
            keep_captures=keep_captures,
            overwrite=overwrite,
            progress=report.bar("jumping"),
        )
    sheets = list(tables.sheets(found))
    for sheet in sheets:
        if definitions or sheet.title != tables.DEFINITIONS:
            console.show_sheet(sheet)
    timing = found.timing
    console.say(
        f"{len(found.rows)} jumps, {timing['simulated_s']:.0f} s of the virtual robot in "
        f"{timing['seconds']:.0f} s on {timing['processes']:.0f} processes; "
        f"{timing['simulated_s_per_cpu_s']:.1f} simulated seconds per second of a core"
    )
    films: tuple[Path, ...] = ()
    with console.progress() as report:
        if video:
            films = record_all(
                found,
                out,
                out / VIDEOS,
                robot=setup.robot,
                cases=[case.name for case in plan.cases],
                warn=console.warn,
                at_once=setup.processes,
                progress=report.bar("rendering videos"),
            )
        wanted = {"walk": walk, "crossing": crossing, "variation": variation, "bodies": bodies}
        names = [name for name, on in wanted.items() if on]
        extra = list(_extra_sheets(names, policies, setup, plan, own, report))
        page, _ = write_report(out, report)
    for sheet in extra:
        console.show_sheet(sheet)
    figures = {
        "virtual": found.virtual,
        "sheets": [*sheets, *extra],
        "checks": [check.row() for check in trial_checks(found)],
        "cells": found.cells,
        "ratios": found.ratios,
        "timing": dict(timing),
        "page": page,
        "videos": films,
    }
    files = (TABLE, SUMMARY, CAPTURES, *[VIDEOS] * bool(films))
    return console.Outcome(
        figures=figures,
        wrote=[*(out / name for name in files), page],
        following=[f"open {page} in a browser", f"pronk play {policy}"],
    )


def _extra_sheets(
    names: Sequence[str],
    policies: Sequence[Path],
    setup: Setup,
    plan: Plan,
    own: Sequence[Path],
    report: console.Reporter,
) -> Iterator[Sheet]:
    """Run what belongs to a trial besides its jumps, and yield the tables."""
    from pronk.jump.trial import bodies, variation
    from pronk.jump.trial.crossing import CrossingPlan, add_crossings
    from pronk.jump.trial.trial import Plan
    from pronk.jump.trial.walk import add_walks
    from pronk.report import extra_pages

    seed = plan.seed
    if "walk" in names:
        walks = add_walks(policies, setup, seed=seed, progress=report.bar("walking"))
        for sheet in extra_pages.walk_tables(walks):
            yield replace(sheet, title=f"Virtual robot, walking: {sheet.title}")
    if "crossing" in names:
        bar = report.bar("crossing")
        crossed = add_crossings(policies, CrossingPlan(seed=seed), setup, progress=bar)
        sheet = extra_pages.crossing_table(crossed)
        yield replace(sheet, title=f"Virtual robot, crossing: {sheet.title}")
    if "variation" in names:
        bar, few = report.bar("varying the robot"), Plan(jumps=5, seed=seed)
        yield variation.table(variation.add_variation(policies, few, setup, progress=bar))
    if "bodies" in names:
        plan_n = Plan(jumps=plan.jumps, seed=seed)
        yield bodies.table(bodies.add_bodies(policies, plan_n, setup, own=own, stages=report))
