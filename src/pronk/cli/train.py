"""`pronk train`: from random weights to a policy that walks and jumps."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from pronk.cli import console
from pronk.errors import PronkError

if TYPE_CHECKING:
    from pronk.train.runner.run_folder import RunFolder
    from pronk.train.runner.settings import TrainSettings


CPU_RATE = 300.0
"""Environment steps a second that two cores were seen to train with."""


Task = Literal["walk", "jump", "all", "together"]
"""What is trained."""


Device = Literal["auto", "cpu", "cuda"]
"""What computes."""


Logger = Literal["tensorboard", "wandb", "none"]
"""Where the curves go."""


def train(
    task: tyro.conf.Positional[Task],
    out: Path,
    gains: str | None = None,
    like: Annotated[Path | None, tyro.conf.arg(name="ranges-from")] = None,
    start: Annotated[Path | None, tyro.conf.arg(name="init-checkpoint")] = None,
    envs: int | None = None,
    seed: int | None = None,
    phase: tuple[str, ...] = (),
    ellipsoid: bool | None = None,
    device: Device | None = None,
    gpu_ids: str | None = None,
    resume: bool = False,
    save_interval: int = 50,
    minutes: float | None = None,
    logger: Logger = "tensorboard",
    json_file: console.JsonFile = None,
) -> None:
    """Train a policy that walks, runs and jumps on command.

    Args:
        task: walk: phase 1. jump: widen a walking policy, then phases 2a and 2b. all:
            both. together: walk and jump at once from random weights, the paper's
            ablation.
        out: Folder of the run, new or empty.
        gains: gains.yaml of `pronk match`, or naive: the gains of the real drives as
            they are.
        like: With naive gains: the gains.yaml whose ranges and delay are used.
        start: jump: folder of a walking run, or one of its checkpoints.
        envs: Robots on each device; 4096.
        seed: Of all draws; 1.
        phase: PHASE=ITERATIONS, as in walk=300, for walk, jump_a or jump_b; repeat it.
        ellipsoid: Draw gains from each group's ellipsoid, or its box; box.
        device: auto: a GPU if there is one; the CPU is for tests.
        gpu_ids: GPUs of this host, as in 0,1, or all; 0.
        resume: Continue the run in --out; options left out are those of the run.
        save_interval: Iterations between checkpoints.
        minutes: Stop at a checkpoint after so long; --resume goes on from there.
        logger: Where the curves go.
        json_file: Also write the figures to this file.
    """
    from pronk.train.runner import provenance
    from pronk.train.runner.launch import begin_run, launch
    from pronk.train.runner.request import Request, new_settings, resumed_settings
    from pronk.train.runner.run_folder import RunFolder
    from pronk.train.runner.settings import WatchSettings

    watch = WatchSettings(logger=logger, save_interval=save_interval, minutes=minutes)
    request = Request(
        task=task,
        gains=gains,
        like=like,
        start=start,
        iterations=iterations_of(phase or ()),
        envs=envs,
        seed=seed,
        ellipsoid=ellipsoid,
        device=None if device is None else device,
        gpu_ids=gpu_ids,
    )
    folder = RunFolder(out)
    if resume:
        settings, devices = resumed_settings(request, folder)
        found = provenance.read(folder.provenance)
        changes = provenance.changed_versions(found)
        if changes:
            console.warn(f"not the same run any more: {'; '.join(changes)}")
    else:
        folder.check_fresh()
        settings, devices = new_settings(request)
        found = begin_run(folder, settings, gains_file=request.gains_file)
    announce(settings, found, folder)
    if not found["finished"]:
        try:
            found = launch(folder, settings, watch, devices)
        except KeyboardInterrupt:
            console.following(again(settings, folder))
            raise
    show(found, folder)
    console.write_json(json_file, found)
    if not found["finished"]:
        console.following(again(settings, folder))
        if found["sessions"][-1]["stopped"].startswith("SIG"):
            raise KeyboardInterrupt
        return
    console.following(*next_steps(settings, folder, logger))


def iterations_of(entries: Sequence[str]) -> dict[str, int]:
    """`walk=300` and the like, as a mapping.

    Raises:
        PronkError: An entry is not PHASE=ITERATIONS, or a phase is given twice.
    """
    found: dict[str, int] = {}
    for entry in entries:
        name, _, count = entry.partition("=")
        if not (name and count.isdigit()):
            raise PronkError(f"--phase {entry!r}: expected PHASE=ITERATIONS, as in walk=300.")
        if name in found:
            raise PronkError(f"--phase {name} is given twice; once is enough.")
        found[name] = int(count)
    return found


def announce(settings: TrainSettings, found: Mapping[str, Any], folder: RunFolder) -> None:
    """Say what is trained, and shout if that will take for ever."""
    phases = ", ".join(f"{name} {count}" for name, count in settings.iterations.items())
    gains = found["gains"]
    words = f"{gains['name']} gains"
    if gains["file"]:
        words += f" {'with the ranges ' if gains['name'] == 'naive' else ''}of {gains['file']}"
        words += " (of the virtual robot)" if gains["virtual"] else ""
    devices = settings.device if settings.gpus == 1 else f"each of {settings.gpus} GPUs"
    console.say(
        f"training {settings.task}: {phases} iterations, {settings.envs} robots on {devices}, "
        f"{words}, seed {settings.seed}; run folder {folder.path}"
    )
    if settings.device == "cpu":
        from pronk.train.runner.progress import duration
        from pronk.train.tasks import STEPS_PER_ITERATION

        steps = settings.total_iterations * STEPS_PER_ITERATION * settings.envs
        console.warn(
            "training on the processor is for tests only; on two cores this run takes about "
            f"{duration(steps / CPU_RATE)}"
        )


def show(found: Mapping[str, Any], folder: RunFolder) -> None:
    """Print what every phase took, and what was written."""
    made = console.table(
        "Training",
        "phase",
        "iterations",
        "environment steps",
        "steps/s",
        "wall clock [s]",
        "non-finite robots",
    )
    for name, one in found["phases"].items():
        console.row(
            made,
            name,
            f"{one['iterations']}",
            f"{one['env_steps']:,}",
            f"{one['steps_per_second']:,.0f}",
            console.number(one["seconds"], 1),
            f"{one['non_finite']}",
        )
    if found["phases"]:
        console.show(made)
    seconds = sum(session["seconds"] or 0.0 for session in found["sessions"])
    building = sum(session["build_s"] or 0.0 for session in found["sessions"])
    console.say(f"{seconds:.0f} s in all, {building:.0f} s of it building and compiling")
    stopped = found["sessions"][-1]["stopped"]
    if stopped:
        console.say(f"stopped: {stopped}")
    console.wrote(
        *(
            path
            for path in (folder.walk, folder.policy, folder.config, folder.provenance)
            if path.is_file()
        )
    )


def again(settings: TrainSettings, folder: RunFolder) -> str:
    """The command that goes on with a run."""
    return shlex.join(["pronk", "train", settings.task, "--resume", "--out", str(folder.path)])


def next_steps(settings: TrainSettings, folder: RunFolder, logger: Logger) -> list[str]:
    """What to do with a finished run."""
    gains = ["--gains", str(folder.gains) if settings.gains == "matched" else "naive"]
    if settings.gains == "naive" and settings.gains_sha256:
        gains += ["--ranges-from", str(folder.gains)]
    judged = str(folder.path / "evaluation.json")
    steps = [shlex.join(["pronk", "evaluate", str(folder.policy), *gains, "--out", judged])]
    if settings.task == "walk":
        words = ["pronk", "train", "jump", "--init-checkpoint", str(folder.path), *gains]
        steps.append(shlex.join([*words, "--out", f"{folder.path}_jump"]))
    if logger != "none":
        steps.append(shlex.join(["tensorboard", "--logdir", str(folder.path)]))
    return steps
