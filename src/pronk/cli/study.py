"""`pronk study`: arms, seeds, robots and comparisons of one file, trained, tried and compared."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from pronk.cli import console
from pronk.errors import PronkError
from pronk.exit_status import ExitStatus
from pronk.jump.study.place import StudyPlace
from pronk.tables import counted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pronk.jump.study.config import StudyConfig
    from pronk.jump.study.place import ChosenPlace, PlannedGpus
    from pronk.jump.study.schedule import TaskStatus
    from pronk.jump.study.study import StudyPlan
    from pronk.jump.study.tasks import StudyTask
    from pronk.jump.study.training_time import TrainingTime
    from pronk.jump.study.trainings import TrainingArm
    from pronk.tables import Table


def study(
    study_file: tyro.conf.Positional[Path],
    place: Annotated[StudyPlace, tyro.conf.arg(name="")],
    out: Path = Path("out/study"),
    arms: tuple[str, ...] = (),
    plan: bool = False,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> console.Outcome:
    """Train every arm from every seed, try every policy on every robot, compare.

    The file names arms, seeds, robots, outcomes and comparisons (docs/study.md). The same command
    goes on where it was interrupted, and does only what is new.

    Example:
        pronk study study.yaml --plan
        pronk study study.yaml --out runs/study

    Args:
        study_file: The file of the study, YAML.
        place: Where trainings and trials run.
        out: Folder of the study: trainings, trials, tables and the page.
        arms: Train and try these arms alone, for now; the results hold what is there of the others.
            With commas between several, or repeat it.
        plan: Print trainings, their time on the GPUs of this host or on --gpus, cores and
            comparisons, and stop.
        device: Device of trainings. auto: GPUs if there are any. The CPU is for tests.
    """
    from pronk.jump.study.config import load_study
    from pronk.jump.study.place import choose_place, planned_gpus
    from pronk.jump.study.study import (
        collect_results,
        completed_trials,
        incomplete_trials,
        plan_figures,
        plan_study,
        selected_arms,
        study_tasks,
        tasks_of,
    )
    from pronk.jump.study.study_results import RUNS_FILE, STUDY_FILE, STUDY_TABLE, study_tables
    from pronk.jump.study.tasks import study_folder
    from pronk.jump.study.trainings import check_arm
    from pronk.report.study_page import write_study_page

    config = load_study(study_file)
    folder = study_file.parent
    training_arms = _training_arms(config, folder, study_file)
    try:
        study_plan = plan_study(config, folder, training_arms)
    except PronkError as error:
        raise PronkError(f"{study_file}: {error}") from None
    selection = selected_arms(study_plan, arms)
    for name, arm in training_arms.items():
        try:
            check_arm(arm)
        except PronkError as error:
            raise PronkError(f"{study_file}: arms.{name}: {error}") from None
    if plan:
        gpus = planned_gpus(place, device)
        estimate = None
        if selection.trainings and gpus.count is not None:
            estimate = selection.time_on(gpus.count, gpus.per_gpu)
        tables = _plan_tables(selection, gpus, estimate)
        for table in tables:
            console.show(table)
        words = ["pronk", "study", str(study_file), "--out", str(out)]
        for arm_name in arms:
            words += ["--arms", arm_name]
        if device != "auto":
            words += ["--device", device]
        return console.Outcome(
            figures={**plan_figures(selection, estimate), "tables": tables},
            following=[shlex.join([*words, *place.words])],
        )
    if selection.trainings == 0 and device == "auto":
        # Trials of finished policies need no GPU, also by a command that gave trainings theirs.
        device = "cpu"
        place = replace(place, gpus=None, per_gpu=None)
    chosen = choose_place(place, device)
    console.say(
        f"{config.title}: {counted(selection.trainings, 'training')}, "
        f"{counted(selection.trials, 'trial')} of {counted(selection.jumps, 'jump')} in all, on "
        f"{chosen.words}; folder {out}"
    )
    with study_folder(out):
        processes = chosen.trial_processes(selection.trials)
        tasks = study_tasks(study_plan, out, chosen.training, trial_processes=processes)
        incomplete = incomplete_trials(tasks, out)
        tasks = tasks_of(selection, tasks, out)
        statuses = run_shown(tasks, chosen, out)
        completed = completed_trials(incomplete, tasks, out, statuses)
        results = collect_results(study_plan, out, statuses)
        page = write_study_page(out)
    if completed.run_again:
        console.say(
            "run again, since their folders were there without their jumps: "
            f"{'; '.join(completed.run_again)}"
        )
    if completed.kept:
        console.say(f"completed from the jumps that their folders had: {'; '.join(completed.kept)}")
    if results.mixed_versions:
        console.warn(results.mixed_versions)
    result_tables = study_tables(results)
    for table in result_tables:
        console.show(table)
    return console.Outcome(
        figures={
            "virtual": results.virtual,
            "tables": result_tables,
            "cells": results.cells,
            "comparisons": results.comparisons,
            "missing": results.missing,
            "run_again": completed.run_again,
            "completed": completed.kept,
            "page": page,
        },
        wrote=[out / STUDY_TABLE, out / STUDY_FILE, out / RUNS_FILE, page],
        following=[f"open {page} in a browser"],
        status=failure_status(statuses),
    )


def _training_arms(config: StudyConfig, folder: Path, study_file: Path) -> dict[str, TrainingArm]:
    """Return the settings of the arms that are trained, read as `pronk train` reads its options."""
    from pronk.cli.main import parsed_command
    from pronk.jump.study.trainings import TrainingArm

    training = config.training
    robot = str(folder / training.robot) if (folder / training.robot).is_file() else training.robot
    arms = {}
    for name, arm in config.arms.items():
        if arm.policies:
            continue
        words = ["train", training.task, "--robot", robot, "--envs", str(training.envs)]
        words += ["--save-interval", str(training.save_interval), "--out", "trainings"]
        options = [*shlex.split(training.options), *shlex.split(arm.options)]
        phases_of_options = set()
        for word in options:
            phases_of_options.add(word.removeprefix("--phase=").partition("=")[0])
        for phase, iterations in training.phases.items():
            # An arm's own takes precedence.
            if phase not in phases_of_options:
                words += ["--phase", f"{phase}={iterations}"]
        gains = "naive" if arm.gains == "naive" else str(folder / str(arm.gains))
        words += ["--gains", gains]
        if arm.ranges_from is not None:
            words += ["--ranges-from", str(folder / arm.ranges_from)]
        for word in options:
            option = word.partition("=")[0]
            if option in _NAMED_ELSEWHERE:
                raise PronkError(
                    f"{study_file}: arms.{name}: {option} is no option of an arm; "
                    f"{_NAMED_ELSEWHERE[option]}."
                )
        try:
            values = parsed_command([*words, *options])
            settings = replace(values["settings"], gains=gains)
            recipe = tuple(folder / path for path in settings.recipe)
            settings = replace(settings, recipe=recipe)
            if settings.init_checkpoint is not None:
                checkpoint = folder / settings.init_checkpoint
                settings = replace(settings, init_checkpoint=checkpoint)
            settings = settings.completed()
        except PronkError as error:
            raise PronkError(f"{study_file}: arms.{name}: {error}") from None
        if arm.randomization is not None and (settings.draws.ellipsoid or settings.draws.by_joint):
            raise PronkError(
                f"{study_file}: arms.{name}: randomization changes the box of each group's gains, "
                "and --ellipsoid and --by-joint do not draw from it; leave one of them out."
            )
        arms[name] = TrainingArm(name=name, settings=settings)
    return arms


_NAMED_ELSEWHERE = {
    "--gains": "its gains are gains",
    "--ranges-from": "it is ranges_from",
    "--robot": "the robot is training.robot",
    "--envs": "their number is training.envs",
    "--seed": "seeds are seeds",
    "--seeds": "seeds are seeds",
    "--out": "--out of `pronk study` is the folder",
    "--resume": "the same command goes on",
    "--minutes": "a study stops by Ctrl-C",
    "--device": "it is an option of `pronk study`",
    "--gpu-ids": "give --gpus to `pronk study`",
    "--hosts": "give --cluster to `pronk study`",
    "--gpus": "give it to `pronk study`",
    "--per-gpu": "give it to `pronk study`",
    "--jobs": "give it to `pronk study`",
    "--cluster": "give it to `pronk study`",
}
"""Options of `pronk train` that a study has elsewhere, and where."""


def _plan_tables(plan: StudyPlan, gpus: PlannedGpus, estimate: TrainingTime | None) -> list[Table]:
    """Return what a study runs and asks, and what that takes.

    Args:
        plan: The study.
        gpus: The GPUs that it is planned for.
        estimate: Time of the trainings on them; None where it is not known.
    """
    from pronk.jump.study.config import comparison_robots
    from pronk.jump.study.study_results import OTHER_ROBOT, OWN_ROBOT, compared_outcome
    from pronk.tables import Cell, Column, Table

    config = plan.config
    amount_rows: list[tuple[Cell, ...]] = [
        ("arms", ", ".join(arm.name for arm in plan.arms)),
        ("seeds", ", ".join(map(str, config.seed_numbers))),
        ("robots", _robots_text(plan)),
        ("commands", ", ".join(case.name for case in config.trial.cases())),
        ("trainings", plan.trainings),
    ]
    notes = []
    if plan.trainings:
        amount_rows.append(("iterations of a training", _iterations_text(plan)))
        amount_rows.append(("robots in a training", f"{config.training.envs:,}"))
        amount_rows.append(("environment steps", f"{plan.env_steps:,}"))
        time_text = f"not known ({gpus.words})"
        hours_text = "not known"
        if estimate is not None:
            amount_rows.append(("GPUs", f"{estimate.gpus} ({gpus.words})"))
            at_once = f"up to {estimate.per_gpu}"
            if not gpus.is_per_gpu_given:
                at_once += " (assumed; found while they run, or --per-gpu)"
            amount_rows.append(("trainings on a GPU at once", at_once))
            time_text = _range_text(estimate.low_s / 60.0, estimate.high_s / 60.0, "minutes")
            hours_text = _range_text(*estimate.gpu_hours, "h")
        amount_rows.append(("time of the trainings", time_text))
        amount_rows.append(("GPU hours", hours_text))
        notes += _time_notes(plan, estimate)
    amount_rows += [
        ("trials (policy on robot)", plan.trials),
        ("jumps", plan.jumps),
        ("core hours of trials", f"{plan.core_hours:.2f}"),
    ]
    notes.append("Core hours: at 3 s a jump. A training needs one core beside its share of a GPU.")
    single_seed = [arm.name for arm in plan.arms if len(plan.seeds(arm)) == 1]
    if single_seed:
        notes.append(
            f"One seed (n = 1) of {', '.join(single_seed)}: no intervals, also of comparisons in "
            "which it counts; two seeds are the fewest."
        )
    amounts = Table(
        title=config.title,
        columns=(Column(heading="what"), Column(heading="how much")),
        rows=tuple(amount_rows),
        notes=tuple(notes),
    )
    rows = []
    for name, comparison in config.comparisons.items():
        robots = comparison_robots(comparison, plan.arms_by_robot)
        compared = " less ".join(comparison.sides)
        if comparison.own:
            compared = f"{OWN_ROBOT} less {OTHER_ROBOT}: {', '.join(comparison.own)}"
        question = "primary" if comparison.primary else "secondary"
        shown = "all" if len(robots) == len(plan.robots) > 1 else ", ".join(robots)
        outcome = compared_outcome(comparison.outcome, comparison.command_names)
        rows.append((question, name, outcome, compared, shown))
    comparisons = Table(
        title="Comparisons",
        columns=(
            Column(heading="question"),
            Column(heading="comparison"),
            Column(heading="outcome"),
            Column(heading="difference of"),
            Column(heading="robots"),
        ),
        rows=tuple(rows),
    )
    return [amounts, comparisons] if rows else [amounts]


def _iterations_text(plan: StudyPlan) -> str:
    """Return the iterations of a training, of each number the arms that have it."""
    arms_by_iterations: dict[int, list[str]] = {}
    for arm in plan.arms:
        if arm.training is not None:
            arms_by_iterations.setdefault(arm.training.iterations, []).append(arm.name)
    if len(arms_by_iterations) == 1:
        return f"{next(iter(arms_by_iterations)):,}"
    parts = []
    for iterations, names in arms_by_iterations.items():
        parts.append(f"{iterations:,} ({', '.join(names)})")
    return ", ".join(parts)


def _range_text(low: float, high: float, unit: str) -> str:
    """Return a range of estimates with two or three digits."""
    digits = 0 if high >= 10.0 else 1 if high >= 1.0 else 2
    texts = [f"{low:,.{digits}f}", f"{high:,.{digits}f}"]
    if texts[0] == texts[1]:
        return f"{texts[0]} {unit}"
    return f"{texts[0]} to {texts[1]} {unit}"


def _time_notes(plan: StudyPlan, estimate: TrainingTime | None) -> list[str]:
    """Return what the time of the trainings rests on, or why there is none."""
    from pronk.jump.study.training_time import (
        COMPILED_RATES,
        MEASURED_ENVS,
        RATES,
        SOURCE,
        START_S,
    )

    if estimate is None:
        return [
            "The time of trainings is estimated for GPUs alone. No rate was measured on the CPU, "
            "which is for tests."
        ]
    compiles = set()
    for arm in plan.arms:
        if arm.training is not None:
            compiles.add(arm.training.settings.devices.compile)
    rate_texts: list[str] = []
    measured_numbers: list[int] = []
    for is_compiled, rates in ((False, RATES), (True, COMPILED_RATES)):
        if is_compiled in compiles:
            text = ", ".join(f"{rate:,.0f} each of {count}" for count, rate in rates.items())
            rate_texts.append(f"{text} with --compile" if is_compiled else text)
            measured_numbers += rates
    notes = [
        f"Time: by steps/s measured with {MEASURED_ENVS:,} Mini Cheetahs in a training on H200 "
        f"under MPS, by the number of trainings on a GPU: {'; '.join(rate_texts)} ({SOURCE}; other "
        f"numbers interpolated), and {START_S[0]:.0f} to {START_S[1]:.0f} s of a training for "
        "building, compiling and export. An environment step is one policy step of one robot. "
        "Other GPUs have other rates. Trainings that are done already count too."
    ]
    at_once = min(estimate.per_gpu, -(-plan.trainings // estimate.gpus))
    if at_once > max(measured_numbers):
        notes.append(
            f"{at_once} trainings on a GPU were not measured: taken to reach together what "
            f"{max(measured_numbers)} do."
        )
    if len(compiles) > 1:
        notes.append("Trainings with --compile beside others on one GPU were not measured.")
    if plan.config.training.envs != MEASURED_ENVS:
        notes.append(
            f"{counted(plan.config.training.envs, 'robot')} in a training: not measured; the time "
            f"is between that of as many iterations and that of as many environment steps of "
            f"{MEASURED_ENVS:,} robots."
        )
    return notes


def _robots_text(plan: StudyPlan) -> str:
    """Return the names of the robots by themselves, and how many points each series has."""
    parts = []
    points: dict[str, int] = {}
    for robot in plan.robots:
        if robot.series:
            points[robot.series] = points.get(robot.series, 0) + 1
        else:
            parts.append(robot.name)
    for series, count in points.items():
        parts.append(f"{count} of {series}")
    return ", ".join(parts)


# ---- shared with `pronk train` ----


def run_shown(
    tasks: Sequence[StudyTask], place: ChosenPlace, root: Path
) -> Mapping[str, TaskStatus]:
    """Run tasks and show their progress; say how to go on if that is interrupted."""
    from pronk.jump.study.place import open_executor
    from pronk.jump.study.schedule import run_tasks
    from pronk.jump.study.show import progress_line, progress_table

    try:
        with open_executor(place, root, console.note) as executor, console.LiveTable() as live:
            statuses = run_tasks(
                tasks,
                executor,
                root,
                report=lambda progress: live.update(
                    progress_line(progress), lambda rows: progress_table(progress, rows)
                ),
            )
    except KeyboardInterrupt:
        console.following(shlex.join(["pronk", *sys.argv[1:]]))
        raise
    kept = 0
    for status in statuses.values():
        kept += status.state == "kept"
        if status.state in ("failed", "skipped"):
            console.warn(f"{status.name}: {status.state}: {status.reason}")
    if kept:
        was = "was" if kept == 1 else "were"
        console.say(f"{kept} of {counted(len(statuses), 'task')} {was} done before")
    return statuses


def failure_status(statuses: Mapping[str, TaskStatus]) -> ExitStatus:
    """Return the exit status of a study: the machine could not do all of it, if a task failed."""
    if any(status.state in ("failed", "skipped") for status in statuses.values()):
        return ExitStatus.REFUSED
    return ExitStatus.DONE
