"""`pronk train`: from random weights to a policy that walks and jumps."""

from __future__ import annotations

import shlex
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import tyro

from pronk.cli import console
from pronk.errors import PronkError
from pronk.exit_status import ExitStatus
from pronk.jump.study.place import StudyPlace
from pronk.jump.train.settings import TrainSettings
from pronk.tables import Column, Table, counted


@dataclass(frozen=True, kw_only=True)
class ManyOptions:
    """Several trainings at once, one for each --gains and seed."""

    seeds: str | None = None
    """Seeds, as in 1-4 or 1,2,5."""
    place: Annotated[StudyPlace, tyro.conf.arg(name="")] = field(default_factory=StudyPlace)


def train_command(
    settings: TrainSettings, many: ManyOptions, gains: tuple[str, ...] = ()
) -> console.Outcome:
    """Train a policy that walks, runs and jumps on command, or several at once.

    With several --gains, with --seeds, --gpus, --jobs or --cluster, one is trained for each --gains
    and seed, side by side. The same command goes on where it was interrupted.

    Example:
        pronk train all --gains gains.yaml --out runs/matched
        pronk train all --gains naive --gains gains.yaml --seeds 1-4 --gpus all --out runs/study
        pronk train all --gains gains.yaml --hosts node1,node2 --gpu-ids all --out /shared/matched

    Args:
        settings: What is trained.
        many: Several trainings at once.
        gains: gains.yaml of `pronk match`, or naive: the nominal gains of the real drives. Repeat
            it to train with each.
    """
    if len(gains) > 1 or many.seeds is not None or many.place.is_given:
        return _train_many(settings, many, gains)
    settings = replace(settings, gains=gains[0] if gains else None)
    from pronk.jump.train.devices import require_extra

    require_extra()

    from pronk.jump.train.run import run_training

    resume = _resume_command(settings)
    try:
        record = run_training(settings, report=console.say)
    except KeyboardInterrupt:
        console.following(resume)
        raise
    _show_phases(record["phases"])
    session = record["sessions"][-1]
    console.say(f"{session['seconds']:.0f} s in all")
    if session["stopped"]:
        console.say(f"stopped: {session['stopped']}")
    if record["finished"]:
        return console.Outcome(figures=record, following=_next_steps(settings, record))
    status = ExitStatus.DONE
    if session["stopped"].startswith("SIG"):
        status = ExitStatus.INTERRUPTED
    return console.Outcome(figures=record, following=[resume], status=status)


def _train_many(
    settings: TrainSettings, many: ManyOptions, gains: tuple[str, ...]
) -> console.Outcome:
    """Train with each of the gains from each seed; print and write the spread over seeds."""
    from pronk.cli.study import failure_status, run_shown
    from pronk.jump.study.place import choose_place
    from pronk.jump.study.tasks import study_folder
    from pronk.jump.study.trainings import (
        TRAININGS_FILE,
        TrainingArm,
        arm_names,
        check_arm,
        parse_seeds,
        summarize_trainings,
        training_tasks,
        trainings_table,
    )

    _check_many(settings, many, gains)
    seeds: tuple[int, ...] = (1 if settings.seed is None else settings.seed,)
    if many.seeds is not None:
        seeds = parse_seeds(many.seeds)
    arms = []
    for name, choice in zip(arm_names(gains), gains, strict=True):
        ranges_from = settings.ranges_from if choice == "naive" else None
        arm_settings = replace(settings, gains=choice, ranges_from=ranges_from).completed()
        arms.append(TrainingArm(name=name, settings=arm_settings))
    for arm in arms:
        check_arm(arm)
    place = choose_place(many.place, settings.devices.device)
    root = settings.out
    seed_word = "seed" if len(seeds) == 1 else "seeds"
    console.say(
        f"{counted(len(arms) * len(seeds), 'training')}: {', '.join(arm.name for arm in arms)}, "
        f"{seed_word} {', '.join(map(str, seeds))}, on {place.words}; folder {root}"
    )
    with study_folder(root):
        tasks = training_tasks(arms, seeds, root, place.training)
        begun = time.monotonic()
        statuses = run_shown(tasks, place, root)
        summary = summarize_trainings(arms, seeds, root, statuses, time.monotonic() - begun)
    table = trainings_table(summary)
    console.show(table)
    policies = []
    for arm in summary["arms"]:
        for training in arm["trainings"]:
            if training["policy_sha256"]:
                policies.append(str(root / training["folder"] / "policy.onnx"))
    following = []
    if policies:
        words = ["pronk", "trial", *policies, *console.robot_words(settings.robot)]
        following.append(shlex.join(words))
    return console.Outcome(
        figures={**summary, "tables": [table]},
        wrote=[root / TRAININGS_FILE],
        following=following,
        status=failure_status(statuses),
    )


def _check_many(settings: TrainSettings, many: ManyOptions, gains: tuple[str, ...]) -> None:
    """Refuse options that go with a single training only."""
    if not gains:
        raise PronkError("several trainings need --gains, one or more: gains.yaml, or naive.")
    if settings.ranges_from is not None and "naive" not in gains:
        raise PronkError(f"--ranges-from {settings.ranges_from} goes with --gains naive.")
    if many.seeds is not None and settings.seed is not None:
        raise PronkError("--seed and --seeds are both given; give one of them.")
    if settings.devices.gpu_ids is not None:
        raise PronkError(
            "--gpu-ids spreads one training over GPUs; give --gpus for several trainings."
        )
    if settings.devices.hosts is not None:
        raise PronkError(
            "--hosts spreads one training over machines; give --cluster for several trainings."
        )
    if settings.session.minutes is not None:
        raise PronkError("--minutes goes with a single training; stop several by Ctrl-C.")
    if settings.resume:
        raise PronkError(
            "several trainings need no --resume: the command that began them goes on in its folder."
        )


def _resume_command(settings: TrainSettings) -> str:
    """Return the command that continues a run on the same devices."""
    words = ["pronk", "train", settings.task, "--resume", "--out", str(settings.out)]
    if settings.devices.device != "auto":
        words += ["--device", settings.devices.device]
    if settings.devices.gpu_ids is not None:
        words += ["--gpu-ids", settings.devices.gpu_ids]
    if settings.devices.hosts is not None:
        words += ["--hosts", settings.devices.hosts]
    if settings.devices.compile:
        words.append("--compile")
    return shlex.join(words)


def _show_phases(phases: Mapping[str, Mapping[str, Any]]) -> None:
    """Print the figures of the phases that are over, if any."""
    if not phases:
        return
    rows = []
    for name, figures in phases.items():
        rows.append(
            (
                name,
                figures["iterations"],
                figures["env_steps"],
                figures["steps_per_second"],
                figures["seconds"],
            )
        )
    columns = (
        Column(heading="phase"),
        Column(heading="iterations"),
        Column(heading="environment steps"),
        Column(heading="steps/s", digits=0),
        Column(heading="wall clock", unit="s", digits=1),
    )
    console.show(Table(title="Training", columns=columns, rows=tuple(rows)))


def _next_steps(settings: TrainSettings, record: Mapping[str, Any]) -> list[str]:
    """Return the commands that may follow a finished run."""
    folder = settings.out
    policy = str(folder / "policy.onnx")
    gains_copy = str(folder / "gains.yaml")
    if record["gains"]["name"] == "matched":
        gains_options = ["--gains", gains_copy]
    else:
        gains_options = ["--gains", "naive"]
        if record["gains"]["sha256"]:
            gains_options += ["--ranges-from", gains_copy]
    evaluation = str(folder / "evaluation.json")
    robot_options = console.robot_words(settings.robot)
    evaluate = ["pronk", "evaluate", policy, *gains_options, *robot_options, "--out", evaluation]
    if settings.task == "walk":
        start = ["--init-checkpoint", str(folder)]
        out = ["--out", f"{folder}_jump"]
        use = ["pronk", "train", "jump", *start, *gains_options, *robot_options, *out]
    else:
        use = ["pronk", "trial", policy, *robot_options]
    curves = ["tensorboard", "--logdir", str(folder)]
    return [shlex.join(evaluate), shlex.join(use), shlex.join(curves)]
