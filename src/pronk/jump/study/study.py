"""A study: every arm is trained from every seed, and every policy jumps on every robot.

plan = plan_study(load_study(path), path.parent, arms)
tasks = study_tasks(plan, root, place)
statuses = run_tasks(tasks, executor, root, report=show)
results = collect_results(plan, root, statuses)
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pronk.arrays import Array
from pronk.errors import ArtefactError, PronkError
from pronk.files import sha256, write_text
from pronk.identify.match.gains import MatchedGains, load_gains, save_gains
from pronk.jump.study.bootstrap import (
    WeightedCell,
    contrast_interval,
    mean_interval,
    seed_mean,
)
from pronk.jump.study.config import (
    ComparisonConfig,
    RandomizationConfig,
    StudyConfig,
    comparison_robots,
)
from pronk.jump.study.outcomes import OUTCOMES
from pronk.jump.study.robot_inputs import RobotInput, robot_input
from pronk.jump.study.schedule import TaskStatus
from pronk.jump.study.study_results import (
    OTHER_ROBOT,
    OWN_ROBOT,
    RUNS_FILE,
    SEVERAL_VERSIONS,
    SOURCES,
    STUDY_FILE,
    TRAINING_VERSIONS,
    TRIALS,
    ComparedArms,
    OutcomeCell,
    StudyResults,
    save_study,
    version_of_training,
)
from pronk.jump.study.study_results import (
    WRITER as STUDY_WRITER,
)
from pronk.jump.study.tasks import (
    INPUTS,
    StudyState,
    StudyTask,
    TaskRecord,
    copied_input,
    written_input,
)
from pronk.jump.study.training_time import TrainingSize, TrainingTime, training_time
from pronk.jump.study.trainings import (
    TrainingArm,
    TrainingPlace,
    training_folder,
    training_name,
    training_tasks,
)
from pronk.jump.trial.condition_trial import (
    CELLS,
    SUMMARY,
    TABLE,
    StoredCell,
    load_cell,
    save_sim_params,
)
from pronk.jump.trial.condition_trial import SCHEMA as CONDITION_TRIAL_SCHEMA
from pronk.jump.trial.conditions import Condition, changed_params, load_conditions
from pronk.jump.trial.results import TrialRun, load_json
from pronk.jump.trial.trial import software_versions
from pronk.jump.virtual.sim_params import SimParams, load_sim_params
from pronk.names import file_name
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec

NOMINAL_CONDITION = b"schema: pronk/conditions/1\nconditions:\n- name: nominal\n"
"""File of conditions of a trial whose robot is in its `--sim-params`."""
SECONDS_A_JUMP = 3.0
"""Time of a jump on one core by which `--plan` counts [s]; docs/try.md."""


@dataclass(frozen=True, kw_only=True)
class StudiedRobot:
    """A virtual robot of a study."""

    name: str
    sim_params: SimParams
    series: str = ""
    """Series of conditions that it is a point of; empty for a robot by itself."""
    place: float | None = None
    """Place in its series, in the unit of the series."""
    jumps: int
    """Jumps with each command."""
    arms: tuple[str, ...]
    """Names of the arms that are tried on it."""


@dataclass(frozen=True, kw_only=True)
class StudyArm:
    """An arm: a way to train, or policies that are there already."""

    name: str
    training: TrainingArm | None = None
    randomization: RandomizationConfig | None = None
    policies: tuple[Path, ...] = ()

    @property
    def folder_name(self) -> str:
        """Name of the arm as that of a folder."""
        return file_name(self.name).replace(" ", "_")


@dataclass(frozen=True, kw_only=True)
class StudyPlan:
    """All that a study runs."""

    config: StudyConfig
    arms: tuple[StudyArm, ...]
    robots: tuple[StudiedRobot, ...]
    robot: RobotSpec

    def seeds(self, arm: StudyArm) -> tuple[int, ...]:
        """Return the seeds of an arm; finished policies are numbered from 1."""
        if arm.policies:
            return tuple(range(1, len(arm.policies) + 1))
        return self.config.seed_numbers

    @property
    def trainings(self) -> int:
        """Number of trainings."""
        return sum(len(self.seeds(arm)) for arm in self.arms if not arm.policies)

    @property
    def env_steps(self) -> int:
        """Environment steps of all trainings."""
        steps = 0
        for arm in self.arms:
            if arm.training is not None:
                steps += arm.training.env_steps * len(self.seeds(arm))
        return steps

    @property
    def trials(self) -> int:
        """Number of pairs of policy and robot."""
        return sum(self._policies_on(robot) for robot in self.robots)

    @property
    def jumps(self) -> int:
        """Number of jumps of all trials."""
        jumps = sum(self._policies_on(robot) * robot.jumps for robot in self.robots)
        return jumps * len(self.config.trial.cases())

    def _policies_on(self, robot: StudiedRobot) -> int:
        """Return the number of policies that are tried on a robot."""
        return sum(len(self.seeds(arm)) for arm in self.arms if arm.name in robot.arms)

    @property
    def arms_by_robot(self) -> dict[str, tuple[str, ...]]:
        """Names of the arms that are tried on each robot."""
        return {robot.name: robot.arms for robot in self.robots}

    def time_on(self, gpus: int, per_gpu: int) -> TrainingTime:
        """Return the estimated time of all trainings; there has to be one.

        Args:
            gpus: Number of GPUs.
            per_gpu: Most trainings on one GPU at once.
        """
        sizes = []
        # In the order of `training_tasks`.
        for _ in self.config.seed_numbers:
            for arm in self.arms:
                if arm.training is not None:
                    training = arm.training
                    size = TrainingSize(
                        env_steps=training.env_steps,
                        envs=training.envs,
                        is_compiled=training.settings.devices.compile,
                    )
                    sizes.append(size)
        return training_time(sizes, gpus, per_gpu)

    @property
    def core_hours(self) -> float:
        """Estimated time of all trials on one core [h]."""
        return self.jumps * SECONDS_A_JUMP / 3600.0


def plan_study(config: StudyConfig, folder: Path, arms: Mapping[str, TrainingArm]) -> StudyPlan:
    """Read all that a study names; nothing is written.

    Args:
        config: The study.
        folder: Folder of its file, to which its paths are relative.
        arms: Settings of the arms that are trained, by name.

    Raises:
        PronkError: A file is missing, or an arm or robot is impossible.
    """
    spec = load_robot(_robot_name(config, folder))
    robots = []
    for name, robot_config in config.robots.items():
        try:
            path = robot_config.sim_params
            base = _sim_params(None if path is None else folder / path, spec)
            jumps = config.trial.jumps if robot_config.jumps is None else robot_config.jumps
            arms_on_it = robot_config.arms or tuple(config.arms)
            if robot_config.conditions is None:
                condition = Condition(name=name, changes=robot_config.changes)
                params = changed_params(condition, base, spec)
                robots.append(
                    StudiedRobot(name=name, sim_params=params, jumps=jumps, arms=arms_on_it)
                )
                continue
            text = robot_config.conditions
            if (folder / text).is_file():
                text = str(folder / text)
            for condition in load_conditions(text, base, spec, seed=config.trial.seed):
                robots.append(
                    StudiedRobot(
                        name=f"{name}: {condition.name}",
                        sim_params=changed_params(condition, base, spec),
                        series=condition.series,
                        place=condition.place,
                        jumps=jumps,
                        arms=arms_on_it,
                    )
                )
        except PronkError as error:
            raise PronkError(f"robots.{name}: {error}") from None
    config.check_robots({robot.name: robot.arms for robot in robots})
    study_arms = []
    for name, arm_config in config.arms.items():
        policies = tuple(folder / path for path in arm_config.policies)
        try:
            _check_policies(policies)
        except PronkError as error:
            raise PronkError(f"arms.{name}: {error}") from None
        study_arms.append(
            StudyArm(
                name=name,
                training=None if policies else arms[name],
                randomization=arm_config.randomization,
                policies=policies,
            )
        )
    return StudyPlan(config=config, arms=tuple(study_arms), robots=tuple(robots), robot=spec)


def _robot_name(config: StudyConfig, folder: Path) -> str:
    """Return name or path of the robot that is trained and tried."""
    name = config.training.robot
    return str(folder / name) if (folder / name).is_file() else name


def _sim_params(path: Path | None, spec: RobotSpec) -> SimParams:
    """Return the parameters of a file, the shipped ones, or those derived from the robot."""
    return load_sim_params(path, spec)


def _check_policies(paths: Sequence[Path]) -> None:
    """Refuse policies that are missing, or there twice."""
    hashes = []
    for path in paths:
        if not path.is_file():
            raise ArtefactError(f"{path}: no such file; expected the policy.onnx of a training.")
        hashes.append(sha256(path))
    if len(set(hashes)) != len(hashes):
        raise PronkError("one policy is there twice; give each once.")


# ---- tasks ----


def study_tasks(
    plan: StudyPlan, root: Path, place: TrainingPlace, *, trial_processes: int = 1
) -> list[StudyTask]:
    """Return the trainings and behind them the trials, and write their inputs.

    Args:
        plan: The study.
        root: Its folder.
        place: The devices of trainings.
        trial_processes: Jumps of one trial at once, each on a core.
    """
    trained = []
    for arm in plan.arms:
        if arm.training is not None:
            trained.append(_with_randomization(arm, arm.training, root))
    tasks = training_tasks(trained, plan.config.seed_numbers, root, place)
    nominal = written_input(root, NOMINAL_CONDITION, "nominal", ".yaml")
    tried = robot_input(root, plan.robot.source)
    params_by_robot = {}
    for robot in plan.robots:
        params_by_robot[robot.name] = _params_input(root, robot)
    single = [robot for robot in plan.robots if not robot.series]
    in_series = [robot for robot in plan.robots if robot.series]
    most_seeds = max(len(plan.seeds(arm)) for arm in plan.arms)
    # Robots by themselves first: comparisons are of them, and series take the most time.
    for robots in (single, in_series):
        for index in range(most_seeds):
            for arm in plan.arms:
                if index >= len(plan.seeds(arm)):
                    continue
                seed = plan.seeds(arm)[index]
                needs: tuple[str, ...] = ()
                if arm.training is not None:
                    policy = f"{training_folder(arm.training, seed)}/policy.onnx"
                    needs = (training_name(arm.name, seed),)
                else:
                    policy = copied_input(root, arm.policies[index], "policy")
                for robot in robots:
                    if arm.name in robot.arms:
                        inputs = (policy, params_by_robot[robot.name], nominal)
                        task = _trial_task(plan, arm, seed, robot, tried, inputs, needs)
                        tasks.append(on_cores(task, trial_processes))
    return tasks


def selected_arms(plan: StudyPlan, names: Sequence[str]) -> StudyPlan:
    """Return the plan of some arms alone.

    Args:
        plan: The study.
        names: Names of arms, several in one text with commas between them; all if empty.

    Raises:
        PronkError: The study has no such arm.
    """
    selected = set()
    for text in names:
        for name in text.split(","):
            selected.add(name.strip())
    known = [arm.name for arm in plan.arms]
    for name in sorted(selected):
        if name not in known:
            raise PronkError(f"--arms {name!r}: expected some of {', '.join(known)}.")
    if not selected:
        return plan
    return replace(plan, arms=tuple(arm for arm in plan.arms if arm.name in selected))


def tasks_of(selection: StudyPlan, tasks: Sequence[StudyTask], root: Path) -> list[StudyTask]:
    """Return the tasks of the arms of a plan, and of other arms those that are done.

    Args:
        selection: The study with the arms that are run now.
        tasks: Tasks of the whole study.
        root: Its folder.
    """
    names = set()
    for arm in selection.arms:
        for seed in selection.seeds(arm):
            names.add(training_name(arm.name, seed))
            for robot in selection.robots:
                names.add(trial_name(arm.name, seed, robot.name))
    state = StudyState(root)
    kept: list[StudyTask] = []
    done: set[str] = set()
    for task in tasks:
        is_ready = all(name in done for name in task.needs)
        if task.name in names:
            kept.append(task)
        elif is_ready and state.is_done(task):
            kept.append(task)
            done.add(task.name)
    return kept


def incomplete_trials(tasks: Sequence[StudyTask], root: Path) -> list[str]:
    """Return the names of trials whose folders are there in part, and have them run again.

    Such are trials that were interrupted, and those of a copy of the folder that lacks files. What
    their folders have is kept: a trial whose jumps are there runs none of them again.

    Args:
        tasks: Tasks of the whole study.
        root: Its folder.
    """
    state = StudyState(root)
    names = []
    for task in tasks:
        if task.kind != "trial":
            continue
        if state.is_done(task):
            try:
                read_trial(root / task.folder)
            except ArtefactError:
                state.forget(task.name)
                names.append(task.name)
            continue
        folder = root / task.folder
        if not folder.is_dir() or not any(folder.iterdir()):
            continue
        record = state.records.get(task.name)
        if not all((root / path).is_file() for path in task.inputs):
            continue
        # With another hash it is a trial of another policy or plan.
        if record is None or record.key == task.key(root):
            names.append(task.name)
    return names


@dataclass(frozen=True, kw_only=True)
class CompletedTrials:
    """Trials that were there in part before, and are whole now."""

    run_again: tuple[str, ...] = ()
    """Their jumps were missing or damaged."""
    kept: tuple[str, ...] = ()
    """Their jumps were there, and other files were missing."""


def completed_trials(
    names: Sequence[str],
    tasks: Sequence[StudyTask],
    root: Path,
    statuses: Mapping[str, TaskStatus],
) -> CompletedTrials:
    """Return which of the trials that were there in part were run again.

    Args:
        names: What `incomplete_trials` returned before they were run.
        tasks: The tasks that were run.
        root: Folder of the study.
        statuses: How they ended, by name.
    """
    run_again = []
    kept = []
    for task in tasks:
        if task.name not in names or statuses[task.name].state != "done":
            continue
        path = root / task.folder / SUMMARY
        with load_json(path, CONDITION_TRIAL_SCHEMA, STUDY_WRITER) as body:
            if body["kept"]:
                kept.append(task.name)
            else:
                run_again.append(task.name)
    return CompletedTrials(run_again=tuple(run_again), kept=tuple(kept))


def trial_name(arm: str, seed: int, robot: str) -> str:
    """Return the name of a trial's task."""
    return f"{arm}, seed {seed}, on {robot}"


def trial_folder(arm: StudyArm, seed: int, robot: StudiedRobot) -> str:
    """Return the folder of a trial, relative to that of the study."""
    robot_folder = file_name(robot.name).replace(" ", "_")
    return f"{TRIALS}/{arm.folder_name}/seed-{seed}/{robot_folder}"


def _trial_task(
    plan: StudyPlan,
    arm: StudyArm,
    seed: int,
    robot: StudiedRobot,
    tried: RobotInput,
    inputs: tuple[str, str, str],
    needs: tuple[str, ...],
) -> StudyTask:
    """Return the task of a trial.

    Args:
        plan: The study.
        arm: Arm of the policy.
        seed: Its seed.
        robot: The virtual robot.
        tried: The robot that both are of.
        inputs: The policy, the parameters of the virtual robot, and the condition.
        needs: Names of the tasks that have to be done before.
    """
    trial = plan.config.trial
    policy, params, nominal = inputs
    folder = trial_folder(arm, seed, robot)
    words = ["trial", policy, "--sim-params", params, "--conditions", nominal]
    words += ["--jumps", str(robot.jumps), "--seed", str(trial.seed)]
    for command in trial.commands:
        words.append(f"--commands={command}")
    if tried.files:
        words += ["--robot", tried.name]
    words += ["--out", folder]
    settings = {"commands": list(trial.commands), "jumps": robot.jumps, "seed": trial.seed}
    return StudyTask(
        name=trial_name(arm.name, seed, robot.name),
        kind="trial",
        folder=folder,
        command=tuple(words),
        settings=settings,
        inputs=(*inputs, *tried.files),
        outputs=(f"{folder}/{SUMMARY}", f"{folder}/{TABLE}"),
        needs=needs,
    )


def on_cores(trial: StudyTask, processes: int) -> StudyTask:
    """Return a trial whose jumps run on so many cores, one process on each."""
    command = (*trial.command, "--processes", str(processes))
    return replace(trial, command=command, cores=float(processes), processes=processes)


def _params_input(root: Path, robot: StudiedRobot) -> str:
    """Write the parameters of a robot to the inputs; return the path relative to the study."""
    stem = file_name(robot.name).replace(" ", "_")
    draft = root / INPUTS / f".{stem}.draft.yaml"
    save_sim_params(draft, robot.sim_params, comment=f"Robot {robot.name!r} of a study.")
    content = draft.read_bytes()
    draft.unlink()
    return written_input(root, content, stem, ".yaml")


def _with_randomization(arm: StudyArm, training: TrainingArm, root: Path) -> TrainingArm:
    """Return an arm whose gains have the ranges that the study asks for."""
    if arm.randomization is None:
        return training
    settings = training.settings
    source = settings.gains_file
    assert source is not None
    gains = load_gains(source)
    changed = randomized_gains(
        gains, arm.randomization, load_robot(str(settings.robot)) if settings.ranges_from else None
    )
    draft = root / INPUTS / f".{arm.folder_name}.draft.yaml"
    save_gains(draft, changed)
    path = root / written_input(root, draft.read_bytes(), f"gains-{arm.folder_name}", ".yaml")
    draft.unlink()
    if settings.ranges_from is not None:
        return replace(training, settings=replace(settings, ranges_from=path))
    return replace(training, settings=replace(settings, gains=str(path)))


def randomized_gains(
    gains: MatchedGains, randomization: RandomizationConfig, robot: RobotSpec | None
) -> MatchedGains:
    """Return gains with other half-widths of the ranges of each joint group.

    Args:
        gains: The gains.
        randomization: Half-widths relative to the middle of the range.
        robot: Robot about whose nominal gains training draws; None for those of the file.
    """
    groups = {}
    for name, group in gains.groups.items():
        stiffness = group.stiffness
        damping = group.damping
        if robot is not None:
            joint = robot.group(name)[0]
            stiffness = joint.stiffness
            damping = joint.damping
        groups[name] = replace(
            group,
            stiffness_range=randomization.stiffness * stiffness,
            damping_range=randomization.damping * damping,
        )
    return replace(gains, groups=groups)


# ---- results ----


Jumps = dict[tuple[str, str], dict[int, list[TrialRun]]]
"""Jumps by arm and robot, then by seed."""


def collect_results(
    plan: StudyPlan, root: Path, statuses: Mapping[str, TaskStatus]
) -> StudyResults:
    """Read every trial that is done, compute outcomes and comparisons, and write them.

    Args:
        plan: The study.
        root: Its folder.
        statuses: How its tasks ended, by name.

    Returns:
        The results, which are in `study.json` and `study.csv`, with every jump in `runs.csv`.
    """
    jumps, versions, missing = _read_jumps(plan, root, statuses)
    cells = []
    for arm in plan.arms:
        for robot in plan.robots:
            if arm.name not in robot.arms:
                continue
            for outcome_name in plan.config.outcomes:
                cells.append(_outcome_cell(jumps, arm.name, robot, outcome_name))
    robot_names = [robot.name for robot in plan.robots]
    comparisons = []
    for name, comparison in plan.config.comparisons.items():
        robots = comparison_robots(comparison, plan.arms_by_robot)
        if comparison.own:
            comparisons += own_and_other(jumps, name, comparison)
        else:
            comparisons.append(compared_arms(jumps, name, comparison, robots))
    trial = plan.config.trial
    failed = []
    for status in statuses.values():
        if status.kind == "training" and status.state == "failed":
            failed.append(f"{status.name}: {status.reason}")
    results = StudyResults(
        title=plan.config.title,
        robot=plan.robot.name,
        arms=tuple(plan.config.arms),
        robots=tuple(robot_names),
        outcomes=plan.config.outcomes,
        commands=tuple(case.name for case in trial.cases()),
        jumps=trial.jumps,
        trial_seed=trial.seed,
        cells=tuple(cells),
        comparisons=tuple(comparisons),
        robot_jumps={robot.name: robot.jumps for robot in plan.robots},
        missing=tuple(missing),
        failed=tuple(failed),
        versions={
            **(_joined_versions(versions) or software_versions()),
            **_joined_versions(_training_versions(plan, root, statuses)),
        },
    )
    write_text(root / RUNS_FILE, runs_csv(plan, jumps))
    save_study(root / STUDY_FILE, results)
    return results


def _read_jumps(
    plan: StudyPlan, root: Path, statuses: Mapping[str, TaskStatus]
) -> tuple[Jumps, list[Mapping[str, str]], list[str]]:
    """Return the jumps of all trials that are done, their versions, and names of the others."""
    jumps: Jumps = {}
    versions: list[Mapping[str, str]] = []
    missing = []
    records = StudyState(root).records
    for arm in plan.arms:
        for robot in plan.robots:
            if arm.name not in robot.arms:
                continue
            by_seed: dict[int, list[TrialRun]] = {}
            for seed in plan.seeds(arm):
                name = trial_name(arm.name, seed, robot.name)
                if name not in statuses or statuses[name].state not in ("done", "kept"):
                    missing.append(name)
                    continue
                trial = read_trial(root / trial_folder(arm, seed, robot))
                by_seed[seed] = trial.rows
                versions.append(trial.versions)
                versions += _sources_of_record(records[name])
            jumps[arm.name, robot.name] = by_seed
    return jumps, versions, missing


def read_trial(folder: Path) -> StoredCell:
    """Return the jumps of the trial in a folder of a study, and the versions of its software."""
    with load_json(folder / SUMMARY, CONDITION_TRIAL_SCHEMA, STUDY_WRITER) as body:
        (cell,) = body["cells"]
        versions: dict[str, str] = body["versions"]
        key = cell["key"]
    stored = load_cell(folder / CELLS / f"{key}.json", key)
    # A cell of an earlier pronk has its versions in the summary.
    return replace(stored, versions=stored.versions or versions)


def _training_versions(
    plan: StudyPlan, root: Path, statuses: Mapping[str, TaskStatus]
) -> list[Mapping[str, str]]:
    """Return the versions that decided each session of the trainings that are done."""
    versions: list[Mapping[str, str]] = []
    records = StudyState(root).records
    for arm in plan.arms:
        if arm.training is None:
            continue
        for seed in plan.seeds(arm):
            name = training_name(arm.name, seed)
            if name not in statuses or statuses[name].state not in ("done", "kept"):
                continue
            sessions = _sources_of_record(records[name])
            path = root / training_folder(arm.training, seed) / "provenance.json"
            # The copy of a study needs the policies of its trainings alone.
            with suppress(OSError, ValueError, LookupError, TypeError):
                for session in json.loads(path.read_text(encoding="utf-8"))["sessions"]:
                    sessions.append(msgspec.convert(session["versions"], dict[str, str]))
            for session_versions in sessions:
                deciding = {}
                for software in TRAINING_VERSIONS:
                    if software in session_versions:
                        deciding[version_of_training(software)] = session_versions[software]
                versions.append(deciding)
    return versions


def _sources_of_record(record: TaskRecord) -> list[Mapping[str, str]]:
    """Return the hashes of pronk's sources that the result of a task goes back to."""
    return [{SOURCES: sources} for sources in record.sources]


def _joined_versions(stored_versions: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """Return the versions of software of all trials or trainings, several of one as one text.

    Those that are kept may be of other versions than those of this process.

    Args:
        stored_versions: Versions of each.
    """
    versions: dict[str, set[str]] = {}
    for stored in stored_versions:
        for name, version in stored.items():
            versions.setdefault(name, set()).add(version)
    return {name: SEVERAL_VERSIONS.join(sorted(several)) for name, several in versions.items()}


def values_by_command(runs: Sequence[TrialRun], outcome: str) -> list[Array]:
    """Return an outcome of the jumps of one seed, an array (n,) for each command."""
    values: dict[str, list[float]] = {}
    for run in runs:
        values.setdefault(run.case, []).append(OUTCOMES[outcome].value(run))
    return [np.array(numbers) for numbers in values.values()]


def _outcome_cell(jumps: Jumps, arm: str, robot: StudiedRobot, outcome_name: str) -> OutcomeCell:
    by_seed = jumps[arm, robot.name]
    seeds = []
    means: dict[str, float | None] = {}
    count = 0
    with_value = 0
    not_standing = 0
    for seed, runs in by_seed.items():
        strata = values_by_command(runs, outcome_name)
        seeds.append(strata)
        means[str(seed)] = seed_mean(strata)
        count += len(runs)
        not_standing += sum(not run.figures.stood for run in runs)
        for values in strata:
            with_value += int(np.isfinite(values).sum())
    estimate = mean_interval(seeds, is_share=OUTCOMES[outcome_name].is_share)
    return OutcomeCell(
        arm=arm,
        robot=robot.name,
        series=robot.series,
        place=robot.place,
        outcome=outcome_name,
        value=estimate.value,
        low=estimate.low,
        high=estimate.high,
        by_seed=means,
        jumps=count,
        jumps_with_value=with_value,
        jumps_not_standing=not_standing,
    )


def compared_arms(
    jumps: Jumps, name: str, comparison: ComparisonConfig, robots: Sequence[str]
) -> ComparedArms:
    """Return the difference of two arms or of two means of arms.

    An arm counts by its seeds that were tried on all of the robots. The means weigh arms alike,
    and each arm has a scatter of its own: what the arms of one side differ by, on average, makes
    the interval of their mean no wider.
    """
    weights = {}
    for robot in robots:
        for arm in comparison.plus:
            weights[arm, robot] = 1.0 / len(robots) / len(comparison.plus)
        for arm in comparison.minus:
            weights[arm, robot] = -1.0 / len(robots) / len(comparison.minus)
    return _contrast(jumps, weights, name, comparison, comparison.sides, tuple(robots))


def own_and_other(jumps: Jumps, name: str, comparison: ComparisonConfig) -> list[ComparedArms]:
    """Return what arms do on the robot they were matched to, less what the others do there.

    Args:
        jumps: Jumps of every arm on every robot.
        name: Name of the comparison.
        comparison: A comparison of own and other robots.

    Returns:
        First the mean over the robots, each with one weight, then each robot by itself.
    """
    by_robot: dict[str, dict[tuple[str, str], float]] = {}
    for robot in dict.fromkeys(comparison.own.values()):
        own = [arm for arm, matched_to in comparison.own.items() if matched_to == robot]
        others = [arm for arm in comparison.own if arm not in own]
        by_robot[robot] = {}
        for arm in own:
            by_robot[robot][arm, robot] = 1.0 / len(own)
        for arm in others:
            by_robot[robot][arm, robot] = -1.0 / len(others)
    weights = {}
    for robot_weights in by_robot.values():
        for pair, weight in robot_weights.items():
            weights[pair] = weight / len(by_robot)
    words = (OWN_ROBOT, OTHER_ROBOT)
    compared = [_contrast(jumps, weights, name, comparison, words, tuple(by_robot))]
    for robot, robot_weights in by_robot.items():
        single = replace(comparison, primary=False)
        compared.append(_contrast(jumps, robot_weights, name, single, words, (robot,)))
    return compared


def _contrast(
    jumps: Jumps,
    weights: Mapping[tuple[str, str], float],
    name: str,
    comparison: ComparisonConfig,
    words: tuple[str, str],
    robots: tuple[str, ...],
) -> ComparedArms:
    """Return a weighted sum of outcomes.

    Args:
        jumps: Jumps of every arm on every robot.
        weights: Weights by arm and robot.
        name: Name of the comparison.
        comparison: The comparison.
        words: What is compared, and against what.
        robots: Names of the robots.
    """
    commands = comparison.command_names
    cells_by_arm: dict[str, list[WeightedCell]] = {}
    for (arm, robot), weight in weights.items():
        values = {}
        for seed, runs in jumps[arm, robot].items():
            counted = [run for run in runs if not commands or run.case in commands]
            values[seed] = values_by_command(counted, comparison.outcome)
        cells_by_arm.setdefault(arm, []).append(WeightedCell(weight=weight, seeds=values))
    is_share = OUTCOMES[comparison.outcome].is_share
    estimate = contrast_interval(list(cells_by_arm.values()), is_share=is_share)
    return ComparedArms(
        name=name,
        outcome=comparison.outcome,
        arm=words[0],
        against=words[1],
        robots=robots,
        commands=commands,
        value=estimate.value,
        low=estimate.low,
        high=estimate.high,
        seeds=estimate.seeds,
        counted_arms=tuple(cells_by_arm),
        primary=comparison.primary,
    )


def runs_csv(plan: StudyPlan, jumps: Jumps) -> str:
    """Return one row a jump with every outcome that there is; unknown ones are empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["arm", "seed", "robot", "command", "number", *OUTCOMES])
    for arm in plan.arms:
        for robot in plan.robots:
            for seed, runs in jumps.get((arm.name, robot.name), {}).items():
                for run in runs:
                    row: list[Any] = [arm.name, seed, robot.name, run.case, run.number]
                    for outcome in OUTCOMES.values():
                        value = outcome.value(run)
                        if not math.isfinite(value):
                            row.append("")
                        elif outcome.is_share:
                            row.append(int(value))
                        else:
                            row.append(value)
                    writer.writerow(row)
    return text.getvalue()


def plan_figures(plan: StudyPlan, estimate: TrainingTime | None) -> dict[str, Any]:
    """Return the figures of a plan for `--json`.

    Args:
        plan: The study.
        estimate: Time of its trainings; None where it is not known.
    """
    seconds = None
    gpu_hours = None
    if estimate is not None:
        seconds = [estimate.low_s, estimate.high_s]
        gpu_hours = list(estimate.gpu_hours)
    return {
        "trainings": plan.trainings,
        "env_steps": plan.env_steps,
        "training_seconds": seconds,
        "gpu_hours": gpu_hours,
        "gpus": None if estimate is None else estimate.gpus,
        "per_gpu": None if estimate is None else estimate.per_gpu,
        "trials": plan.trials,
        "jumps": plan.jumps,
        "core_hours": plan.core_hours,
        "arms": list(plan.config.arms),
        "robots": [robot.name for robot in plan.robots],
        "comparisons": msgspec.to_builtins(plan.config.comparisons),
    }
