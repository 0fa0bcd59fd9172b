"""Trainings of several arms and seeds: their tasks, and the summary with the spread over seeds.

An arm is a way to train, by its gains and options; each arm is trained from every seed. The folder
of a study holds

    inputs/                  copies of gains, recipes and robots, named by their content
    trainings/ARM/seed-N/    the folder of one run, as `pronk train` writes it
    logs/, state.json        what each task printed, and which are done
    trainings.json           every training, and the spread over seeds of each arm
"""

from __future__ import annotations

import importlib.util
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pronk.errors import PronkError
from pronk.files import sha256, write_text
from pronk.jump.study.robot_inputs import robot_input
from pronk.jump.study.schedule import TaskStatus
from pronk.jump.study.tasks import StudyTask, copied_input, written_input
from pronk.jump.train.phases import STEPS_PER_ITERATION
from pronk.jump.train.settings import TrainSettings
from pronk.jump.train.training_progress import read_progress
from pronk.names import check_names, file_name
from pronk.tables import Cell, Column, Table, number

TRAININGS_FILE = "trainings.json"
"""Name of the summary; `summary.json` is that of a trial."""
SCHEMA = "pronk/trainings/1"
TRAININGS = "trainings"
MAX_SEEDS = 1000
"""Largest number of seeds of an arm."""


@dataclass(frozen=True, kw_only=True)
class TrainingArm:
    """A way to train."""

    name: str
    settings: TrainSettings
    """Settings but for the seed and the folder."""

    @property
    def folder_name(self) -> str:
        """Name of the arm as that of a folder."""
        return file_name(self.name).replace(" ", "_")

    @property
    def envs(self) -> int:
        """Number of robots."""
        return self.settings.envs or 4096

    @property
    def iterations(self) -> int:
        """Number of iterations of one training."""
        iterations = self.settings.iterations
        total = sum(iterations.values())
        if self.settings.task == "jump":
            total -= iterations["walk"]
        return total

    @property
    def env_steps(self) -> int:
        """Number of environment steps of one training."""
        return self.iterations * STEPS_PER_ITERATION * self.envs


@dataclass(frozen=True, kw_only=True)
class TrainingPlace:
    """The devices of trainings."""

    device: str
    """cpu or cuda."""
    cores: float = 1.0
    """Number of cores of each training."""


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of a text as 1-4 or 1,2,5.

    Raises:
        PronkError: The text is none of that, or has a seed twice.
    """
    seeds: list[int] = []
    for word in str(text).split(","):
        word = word.strip()
        span = re.fullmatch(r"(\d{1,9})-(\d{1,9})", word)
        if span is not None:
            first = int(span.group(1))
            final = int(span.group(2))
            if final < first or final - first >= MAX_SEEDS:
                raise PronkError(
                    f"seeds {word!r}: expected a span that rises, of {MAX_SEEDS} seeds at most, as "
                    "in 1-4."
                )
            seeds += range(first, final + 1)
        elif re.fullmatch(r"\d{1,9}", word):
            seeds.append(int(word))
        else:
            raise PronkError(f"seeds {text!r}: expected whole numbers, as in 1-4 or 1,2,5.")
    if len(set(seeds)) != len(seeds):
        raise PronkError(f"seeds {text!r}: one of them is there twice; give each once.")
    return tuple(seeds)


def arm_names(gains: Sequence[str]) -> list[str]:
    """Return a name for each choice of gains: of the file, or with its folder where two are alike.

    Raises:
        PronkError: A choice is there twice.
    """
    if len(set(gains)) != len(gains):
        raise PronkError(f"--gains {', '.join(gains)}: one is there twice; give each once.")
    names = []
    for choice in gains:
        names.append("naive" if choice == "naive" else Path(choice).stem)
    if len(set(names)) != len(names):
        names = []
        for choice in gains:
            path = Path(choice)
            name = f"{path.resolve().parent.name}-{path.stem}"
            names.append("naive" if choice == "naive" else name)
    if len(set(names)) != len(names):
        names = [f"{name}-{number}" for number, name in enumerate(names, start=1)]
    check_names(names, "--gains", PronkError)
    return names


def training_name(arm: str, seed: int) -> str:
    """Return the name of a training's task."""
    return f"{arm}, seed {seed}"


def training_folder(arm: TrainingArm, seed: int) -> str:
    """Return the folder of a training, relative to that of the study."""
    return f"{TRAININGS}/{arm.folder_name}/seed-{seed}"


def check_arm(arm: TrainingArm) -> None:
    """Refuse what cannot be trained with, before anything is written.

    A recipe is applied to the robot's task where the libraries of training are installed; on a
    host that only sends trainings to others its form alone is checked.

    Raises:
        PronkError: The robot cannot be trained, or the gains, the recipe or the phases are
            impossible.
    """
    from pronk.jump.train.recipe import load_recipes
    from pronk.robots import ROBOT_NAMES, load_robot, robot_file_path
    from pronk.robots.quadruped import require_quadruped

    settings = replace(arm.settings, seed=0).completed()
    robot = load_robot(str(settings.robot))
    task_file = robot_file_path(robot.source).with_name("env_cfgs.py")
    if robot.source not in ROBOT_NAMES and not task_file.is_file():
        raise PronkError(
            f"{settings.robot} has no training task: expected {task_file} with a function env_cfg, "
            "as docs/train-your-robot.md has one."
        )
    require_quadruped(robot)
    if settings.recipe and importlib.util.find_spec("mjlab") is not None:
        from pronk.jump.train.run import check_training

        check_training(settings)
        return
    settings.training_gains(robot)
    if settings.recipe:
        load_recipes(settings.recipe)


def training_tasks(
    arms: Sequence[TrainingArm],
    seeds: Sequence[int],
    root: Path,
    place: TrainingPlace,
) -> list[StudyTask]:
    """Return a task for each arm and seed, and copy their files to the inputs.

    The first seed of each arm comes first, so that an interrupted study has something of each arm.

    Args:
        arms: The arms, all of different names.
        seeds: The seeds of each arm.
        root: Folder of the study.
        place: The devices.
    """
    from pronk.jump.train.recipe import recipe_content

    prepared = []
    for arm in arms:
        settings = arm.settings
        inputs: list[str] = []
        if settings.robot is not None:
            robot = robot_input(root, settings.robot, is_trained=True)
            inputs += robot.files
            settings = replace(settings, robot=robot.name)
        if settings.gains_file is not None:
            copy = copied_input(root, settings.gains_file, "gains")
            inputs.append(copy)
            if settings.gains == "naive":
                settings = replace(settings, ranges_from=Path(copy))
            else:
                settings = replace(settings, gains=copy)
        if settings.recipe:
            # One name for the merged file; a single file keeps its ending.
            suffix = settings.recipe[0].suffix if len(settings.recipe) == 1 else ".yaml"
            copy = written_input(root, recipe_content(settings.recipe), "recipe", suffix)
            inputs.append(copy)
            settings = replace(settings, recipe=(Path(copy),))
        if settings.init_checkpoint is not None:
            checkpoint = settings.init_checkpoint
            if checkpoint.is_dir():
                checkpoint = checkpoint / "walk.pt"
            copy = copied_input(root, checkpoint, "walk")
            inputs.append(copy)
            settings = replace(settings, init_checkpoint=Path(copy))
        prepared.append((replace(arm, settings=settings), tuple(inputs)))
    tasks = []
    for seed in seeds:
        for arm, arm_inputs in prepared:
            tasks.append(_training_task(arm, seed, arm_inputs, place))
    return tasks


def _training_task(
    arm: TrainingArm, seed: int, inputs: tuple[str, ...], place: TrainingPlace
) -> StudyTask:
    folder = training_folder(arm, seed)
    settings = replace(arm.settings, seed=seed, out=Path(folder)).completed()
    command = [*training_words(settings), "--device", place.device]
    command += ["--save-interval", str(settings.session.save_interval)]
    command += ["--logger", settings.session.logger]
    if settings.devices.compile:
        command.append("--compile")
    return StudyTask(
        name=training_name(arm.name, seed),
        kind="training",
        folder=folder,
        command=tuple(command),
        resume_command=(*command, "--resume"),
        resume_marker=f"{folder}/provenance.json",
        settings=settings.stored_values(),
        inputs=inputs,
        outputs=(f"{folder}/policy.onnx",),
        gpu=place.device == "cuda",
        cores=place.cores,
    )


def training_words(settings: TrainSettings) -> list[str]:
    """Return the words after `pronk` that train with some settings."""
    words = ["train", settings.task]
    for name, value in settings.stored_values().items():
        option = f"--{name.replace('_', '-')}"
        if name == "task" or value is None:
            continue
        if value is True:
            words.append(option)
        elif value is False:
            words.append(f"--no-{name.replace('_', '-')}")
        elif isinstance(value, list):
            for entry in value:
                words += [option, str(entry)]
        else:
            words += [option, str(value)]
    return [*words, "--out", str(settings.out)]


# ---- summary ----


def training_figures(root: Path, status: TaskStatus, folder: str) -> dict[str, Any]:
    """Return what is kept of one training.

    Args:
        root: Folder of the study.
        status: How it ended.
        folder: Its folder, relative to that of the study.
    """
    figures: dict[str, Any] = {
        "name": status.name,
        "folder": folder,
        "state": status.state,
        "attempts": status.attempts,
        "reason": status.reason,
        "policy_sha256": "",
        "seconds": None,
        "steps_per_second": None,
        "reward": None,
        "episode_steps": None,
        "speed_range": None,
    }
    policy = root / folder / "policy.onnx"
    if status.state in ("done", "kept") and policy.is_file():
        figures["policy_sha256"] = sha256(policy)
    try:
        record = json.loads((root / folder / "provenance.json").read_text(encoding="utf-8"))
        phases = record["phases"].values()
        figures["seconds"] = math.fsum(phase["seconds"] for phase in phases)
        steps = math.fsum(phase["env_steps"] for phase in phases)
        if figures["seconds"]:
            figures["steps_per_second"] = steps / figures["seconds"]
    except (OSError, ValueError, LookupError, TypeError):
        pass
    progress = read_progress(root / folder)
    if progress is not None and status.state in ("done", "kept"):
        figures["reward"] = progress.reward
        figures["episode_steps"] = progress.episode_steps
        figures["speed_range"] = progress.speed_range
    return figures


SPREADS = ("reward", "episode_steps", "speed_range", "steps_per_second", "seconds")
"""Figures of a training whose spread over the seeds is summed up."""


def spread_over_seeds(runs: Sequence[Mapping[str, Any]], figure: str) -> dict[str, Any]:
    """Sum up a figure over the trainings that have it.

    Args:
        runs: Figures of the trainings of one arm.
        figure: Name of the figure.

    Returns:
        Mean, standard deviation with n - 1, smallest, largest and number; None where unknown.
    """
    values = [run[figure] for run in runs if run[figure] is not None]
    spread: dict[str, Any] = {"mean": None, "std": None, "min": None, "max": None, "n": len(values)}
    if not values:
        return spread
    mean = math.fsum(values) / len(values)
    spread["mean"] = mean
    spread["min"] = min(values)
    spread["max"] = max(values)
    if len(values) > 1:
        squares = math.fsum((value - mean) ** 2 for value in values)
        spread["std"] = math.sqrt(squares / (len(values) - 1))
    return spread


def summarize_trainings(
    arms: Sequence[TrainingArm],
    seeds: Sequence[int],
    root: Path,
    statuses: Mapping[str, TaskStatus],
    seconds: float,
) -> dict[str, Any]:
    """Write `trainings.json` and return its content.

    Args:
        arms: The arms.
        seeds: The seeds of each.
        root: Folder of the study.
        statuses: How the tasks ended, by name.
        seconds: Wall time of this command [s].
    """
    entries = []
    for arm in arms:
        runs = []
        for seed in seeds:
            status = statuses[training_name(arm.name, seed)]
            figures = training_figures(root, status, training_folder(arm, seed))
            runs.append({"seed": seed, **figures})
        finished = [run for run in runs if run["policy_sha256"]]
        spreads = {figure: spread_over_seeds(finished, figure) for figure in SPREADS}
        entries.append({"name": arm.name, "trainings": runs, "spread_over_seeds": spreads})
    body = {"schema": SCHEMA, "seeds": list(seeds), "seconds": seconds, "arms": entries}
    write_text(root / TRAININGS_FILE, json.dumps(body, indent=2, allow_nan=False) + "\n")
    return body


def trainings_table(summary: Mapping[str, Any]) -> Table:
    """Return the spread over seeds of each arm of a summary."""
    rows: list[tuple[Cell, ...]] = []
    single = []
    for arm in summary["arms"]:
        finished = [run for run in arm["trainings"] if run["state"] in ("done", "kept")]
        if len(finished) == 1:
            single.append(arm["name"])
        spreads = arm["spread_over_seeds"]
        rows.append(
            (
                arm["name"],
                f"{len(finished)}/{len(arm['trainings'])}",
                spread_words(spreads["reward"], 2),
                spread_words(spreads["episode_steps"], 0),
                spread_words(spreads["speed_range"], 2),
                spreads["steps_per_second"]["mean"],
                spreads["seconds"]["mean"],
            )
        )
    notes = [
        "reward, episode, speed range: of the last iteration, in the training simulator. "
        "steps/s, wall clock: means of one training."
    ]
    if single:
        notes.append(
            f"One finished training (n = 1) has no spread over seeds: {', '.join(single)}."
        )
    return Table(
        title="Trainings: mean +- standard deviation over seeds (smallest to largest)",
        columns=(
            Column(heading="arm"),
            Column(heading="finished"),
            Column(heading="reward"),
            Column(heading="episode", unit="steps"),
            Column(heading="speed range", unit="1"),
            Column(heading="steps/s", digits=0),
            Column(heading="wall clock", unit="s", digits=0),
        ),
        rows=tuple(rows),
        notes=tuple(notes),
    )


def spread_words(spread: Mapping[str, Any], digits: int) -> str:
    """Return a spread over seeds as text."""
    if spread["mean"] is None:
        return "-"
    text = number(spread["mean"], digits)
    if spread["std"] is not None:
        text += f" +- {number(spread['std'], digits)}"
        text += f" ({number(spread['min'], digits)} to {number(spread['max'], digits)})"
    return text


def failures(statuses: Mapping[str, TaskStatus]) -> list[str]:
    """Return a sentence for each task that has failed or was skipped."""
    sentences = []
    for status in statuses.values():
        if status.state in ("failed", "skipped"):
            sentences.append(f"{status.name} {status.state}: {status.reason}")
    return sentences
