"""`pronk trial`: the paper's jumps on the virtual robot, measured from outside."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from pronk.cli import console
from pronk.errors import PronkError
from pronk.tables import counted

if TYPE_CHECKING:
    from pronk.jump.trial.trial import TrialPlan, TrialSetup
    from pronk.tables import Table

RATES_JUMPS = 3
"""Jumps at 2.25 m/s beside the paper's commands: enough for its figure of roll and pitch rates."""


@dataclass(frozen=True, kw_only=True)
class MachineOptions:
    """The virtual robot that jumps."""

    robot: str | None = None
    """A name, or a path to a robot.yaml, MJCF or URDF; the policy's if left out."""
    sim_params: Path | None = None
    """Parameters of the virtual robot, instead of the shipped ones."""
    processes: int | None = None
    """Jumps at once; as many as there are cores if left out."""


@dataclass(frozen=True, kw_only=True)
class JumpOptions:
    """What is commanded."""

    commands: tuple[str, ...] = ()
    """Forward and left velocity in m/s, as "2.25,0"; a yaw rate in rad/s may follow. Give it
    repeatedly; "paper" is the paper's five. If left out, those, and a few jumps at 2.25 m/s for the
    figure of roll and pitch rates."""
    jumps: int = 20
    """Jumps with each command."""
    seed: int = 0
    """Seed of all draws."""


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """What is done besides the jumps, or instead of them."""

    walk: bool = False
    """Also walk 20 s with each velocity, 20 times."""
    crossing: bool = False
    """Also cross gaps and steps of growing size."""
    conditions: str | None = None
    """Instead of all that, jump under other conditions of the virtual robot: a YAML file,
    "tolerance" (weaker and stronger drives, delay, friction, gain error) or "bodies" (random
    robots). A run that was interrupted goes on in its folder."""


@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """What is kept and printed."""

    out: Path = Path("out/trial")
    """Folder for tables, captures, videos and the page."""
    video: bool = True
    """MP4, GIF and strip of each command, where this machine can render."""
    keep_captures: bool = False
    """Keep the capture of every jump (4 MB each), not of the first of each command."""
    overwrite: bool = False
    """Replace the trial in that folder; with conditions, run finished ones again."""
    wide: bool = False
    """Print every table and column: all figures of a jump, loads of the drives, scatter with each
    command as well."""
    definitions: bool = False
    """Also print the equation of every figure."""


def trial(
    policies: tyro.conf.Positional[tuple[Path, ...]],
    output: OutputOptions,
    machine: MachineOptions,
    jump: JumpOptions,
    study: StudyOptions,
    also: tuple[Path, ...] = (),
) -> console.Outcome:
    """Stand, run, jump, stop: 20 times with each command; the paper's table beside ours.

    Example:
        pronk trial policies/matched/policy.onnx --also policies/naive/policy.onnx

    Args:
        policies: policy.onnx, one or more; the others are compared with the first.
        output: What is kept and printed.
        machine: The virtual robot that jumps.
        jump: What is commanded.
        study: What is done besides the jumps, or instead of them.
        also: Another policy to compare with, as one trained with nominal gains. Give it repeatedly.
    """
    from pronk.jump.trial.protocol import parse_cases
    from pronk.jump.trial.trial import TrialPlan, setup_of

    paths = [*policies, *also]
    if not paths:
        raise PronkError("no policy; give one or more, as in `pronk trial policy.onnx`.")
    plan = TrialPlan(
        cases=parse_cases(jump.commands or ["paper"]),
        jumps=jump.jumps,
        rates=0 if jump.commands or study.conditions else RATES_JUMPS,
        seed=jump.seed,
    )
    setup = setup_of(
        paths[0], output.out, machine.sim_params, machine.robot, processes=machine.processes
    )
    if study.conditions is not None:
        if study.walk or study.crossing:
            raise PronkError(
                "--conditions jumps only; give --walk and --crossing in a run without it."
            )
        return _trial_of_conditions(paths, study.conditions, plan, setup, output)
    return _trial_of_jumps(paths, plan, setup, study, output)


def _trial_of_jumps(
    policies: Sequence[Path],
    plan: TrialPlan,
    setup: TrialSetup,
    study: StudyOptions,
    output: OutputOptions,
) -> console.Outcome:
    """Jump, film, walk and cross by the options; print tables and write the page."""
    from pronk.jump.trial import tables
    from pronk.jump.trial.criteria import trial_checks, walk_checks
    from pronk.jump.trial.crossing import CrossingPlan, add_crossings
    from pronk.jump.trial.films.record import record_trial
    from pronk.jump.trial.results import SUMMARY, TABLE
    from pronk.jump.trial.trial import CAPTURES, VIDEOS, run_trial
    from pronk.jump.trial.walk import add_walks
    from pronk.report.trial_page import write_trial_page

    with console.progress() as report:
        results = run_trial(
            policies,
            plan,
            setup,
            keep_captures=output.keep_captures,
            overwrite=output.overwrite,
            progress=report.bar("jumping"),
        )
    jump_tables = tables.trial_tables(results)
    for table in jump_tables:
        if output.definitions or table.title != tables.DEFINITIONS:
            console.show(table, wide=output.wide)
    timing = results.timing
    console.say(
        f"{counted(len(results.rows), 'jump')}, {timing['simulated_s']:.0f} s of the virtual robot "
        f"in {timing['seconds']:.0f} s on "
        f"{counted(round(timing['processes']), 'process', 'processes')}; "
        f"{timing['simulated_s_per_cpu_s']:.1f} simulated seconds per second of a core"
    )
    films: tuple[Path, ...] = ()
    checks = trial_checks(results)
    study_tables: list[Table] = []
    wrote = [output.out / TABLE, output.out / SUMMARY, output.out / CAPTURES]
    with console.progress() as report:
        if output.video:
            films = record_trial(
                results,
                output.out,
                output.out / VIDEOS,
                robot=setup.robot,
                cases=[case.name for case in plan.cases],
                warn=console.warn,
                at_once=setup.processes,
                progress=report.bar("rendering videos"),
            )
        if films:
            wrote.append(output.out / VIDEOS)
        if study.walk:
            walks = add_walks(policies, setup, seed=plan.seed, progress=report.bar("walking"))
            for subject in walks.subjects:
                study_tables.append(tables.walk_table(walks, subject.name))
            checks_of_walks = walk_checks(walks)
            if checks_of_walks:
                checks += checks_of_walks
                study_tables.append(tables.walk_criteria_table(walks))
            wrote.append(output.out / walks.run_kind.table)
        if study.crossing:
            crossing_plan = CrossingPlan(seed=plan.seed)
            crossings = add_crossings(
                policies, crossing_plan, setup, progress=report.bar("crossing")
            )
            study_tables.append(tables.crossing_table(crossings))
            wrote.append(output.out / crossings.run_kind.table)
        report("report", 0.0)
        page = write_trial_page(output.out)
        report("report", 1.0)
    for table in study_tables:
        console.show(table, wide=output.wide)
    wrote.append(page)
    play = ["pronk", "play", str(policies[0]), *console.robot_words(setup.robot.source)]
    return console.Outcome(
        figures={
            "virtual": results.virtual,
            "tables": [*jump_tables, *study_tables],
            "checks": [check.row() for check in checks],
            "cells": results.cells,
            "ratios": results.ratios,
            "timing": dict(timing),
            "page": page,
            "videos": films,
        },
        wrote=wrote,
        following=[f"open {page} in a browser", shlex.join(play)],
    )


def _trial_of_conditions(
    policies: Sequence[Path],
    conditions_text: str,
    plan: TrialPlan,
    setup: TrialSetup,
    output: OutputOptions,
) -> console.Outcome:
    """Jump with every policy under every condition; print the table and draw the figure."""
    from pronk.jump.trial import tables
    from pronk.jump.trial.condition_trial import (
        DECIDING_VERSIONS,
        FIGURE,
        ROBOTS,
        SUMMARY,
        TABLE,
        run_conditions,
    )
    from pronk.jump.trial.conditions import load_conditions
    from pronk.report import style
    from pronk.report.trial_figures import draw_conditions

    conditions = load_conditions(conditions_text, setup.sim_params, setup.robot, seed=plan.seed)
    with console.progress() as report:
        results = run_conditions(
            policies,
            conditions,
            plan,
            setup,
            overwrite=output.overwrite,
            progress=report.bar("jumping"),
        )
    figure = style.save_figure(draw_conditions(results), output.out / FIGURE)
    table = tables.condition_table(results)
    console.show(table, wide=output.wide)
    for versions in results.kept_versions:
        console.warn(
            f"some cells were computed before with {_other_versions(versions, results.versions)}. "
            f"They are kept, since {' and '.join(DECIDING_VERSIONS)} have the same versions; "
            "--overwrite computes them again."
        )
    for versions in results.unused_versions:
        console.warn(
            f"cells of {_other_versions(versions, results.versions)} are in {output.out}; they do "
            "not count, since another version may simulate other jumps."
        )
    if results.damaged:
        console.warn(
            f"the files of {', '.join(results.damaged)} could not be read; computed again."
        )
    was = "was" if results.kept == 1 else "were"
    console.say(
        f"{counted(len(results.cells), 'cell')} of policy and condition in "
        f"{results.seconds:.0f} s, {results.kept} of which {was} there already"
    )
    return console.Outcome(
        figures={
            "virtual": results.virtual,
            "tables": [table],
            "cells": results.cells,
            "figure": figure,
        },
        wrote=[output.out / TABLE, output.out / SUMMARY, output.out / ROBOTS, figure],
        following=[f"open {figure} in a browser"],
    )


def _other_versions(versions: Mapping[str, str], here: Mapping[str, str]) -> str:
    """Return the versions that differ from those of this machine, with both."""
    parts = []
    for name, version in versions.items():
        if here.get(name) != version:
            parts.append(f"{name} {version} (here {here.get(name, 'none')})")
    return ", ".join(parts)
