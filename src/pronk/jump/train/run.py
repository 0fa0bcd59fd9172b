"""`pronk train`: mjlab's training of a task with given gains, and its provenance."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mjlab.scripts.train import TrainConfig

from pronk.errors import ArtefactError, PronkError
from pronk.files import sha256, written_whole
from pronk.jump.train import devices, provenance
from pronk.jump.train.gains import NAIVE, TrainingGains, training_gains
from pronk.jump.train.hosts import Host, check_hosts
from pronk.jump.train.launch import LOCAL_HOST, launch
from pronk.jump.train.phases import STEPS_PER_ITERATION
from pronk.jump.train.provenance import RunFolder
from pronk.jump.train.recipe import (
    ACTION_SCALE,
    Recipe,
    apply_recipe,
    load_recipe,
    load_recipes,
    recipe_content,
    recorded_task_numbers,
    task_numbers,
)
from pronk.jump.train.rl import checkpoint
from pronk.jump.train.rl.runner import JumpRunnerCfg
from pronk.jump.train.settings import TrainSettings
from pronk.jump.train.tasks import Task, load_task
from pronk.jump.train.tasks.jump_env_cfg import draw_weak_drives
from pronk.jump.train.train_process import train_process
from pronk.robots.robot import RobotSpec
from pronk.tables import counted


def run_training(
    settings: TrainSettings, report: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Begin or resume a run, and train until it is finished or stopped.

    Of impossible settings nothing is written.

    Args:
        settings: What is trained, and where.
        report: Called with lines of text before training begins.

    Returns:
        The provenance of the run.

    Raises:
        PronkError: Impossible settings, or learning that has diverged.
    """
    folder = RunFolder(settings.out)
    if settings.resume:
        record = folder.read()
        settings = settings.resumed(record["settings"])
        changes = provenance.changed_versions(record)
        if changes:
            report(f"resumed with other versions: {'; '.join(changes)}")
    else:
        folder.check_fresh()
        settings = settings.completed()
    hosts: tuple[Host, ...] = ()
    is_over = settings.resume and record["finished"]
    if settings.devices.host_names and not is_over:
        if not settings.resume:
            check_training(settings)
        report(f"asking {', '.join(settings.devices.host_names)} whether they can train together")
        hosts = check_hosts(
            settings.devices.host_names,
            robot=folder.robot(str(settings.robot)),
            device=settings.devices.device,
            gpu_ids=settings.devices.gpu_ids,
            out=settings.out,
        )
        gpus = hosts[0].facts.gpus
    else:
        gpus = devices.find_devices(settings.devices.device, settings.devices.gpu_ids)
    # Hide all other GPUs from this process and its children, before any uses CUDA.
    os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(gpus)
    processes = max(len(gpus), 1) * max(len(hosts), 1)
    if not settings.resume:
        record = _begin(folder, settings)
    report(_summary(settings, record, gpus, hosts))
    if record["finished"]:
        return record
    _check_processes(folder, settings, processes)
    report("building the robots and compiling kernels")
    return _train_session(folder, settings, hosts, processes)


def check_training(
    settings: TrainSettings,
) -> tuple[TrainingGains, Recipe | None, dict[str, float]]:
    """Read what a new run trains with, and refuse what cannot be trained with.

    Args:
        settings: Completed settings.

    Returns:
        The gains, the recipe if there is one, and the numbers of the task that it may change.

    Raises:
        PronkError: The robot has no task, the gains are impossible, or the recipe changes what the
            task does not have.
    """
    task = load_task(str(settings.robot))
    gains = settings.training_gains(task.robot)
    recipe = load_recipes(settings.recipe) if settings.recipe else None
    numbers = task_numbers(_env_cfg(task, gains, settings, recipe))
    return gains, recipe, numbers


def _check_processes(folder: RunFolder, settings: TrainSettings, processes: int) -> None:
    """Refuse to go on with another number of processes, and so of robots, than the run has.

    A damaged checkpoint is refused here as well, before robots are built and anything is written.
    """
    last_checkpoint = checkpoint.latest_checkpoint(folder.path)
    if last_checkpoint is None:
        return
    infos = checkpoint.read_checkpoint(last_checkpoint)["infos"] or {}
    # Earlier versions did not record it, and a run that begins with a walking policy has not begun.
    processes_before = infos.get("processes", processes)
    if processes != processes_before:
        raise PronkError(
            f"--resume: the run in {folder.path} has "
            f"{counted(processes_before, 'process', 'processes')} of "
            f"{settings.envs} robots each, and this would be {processes}; give --gpu-ids and "
            "--hosts as before, or a new --out."
        )


def _begin(folder: RunFolder, settings: TrainSettings) -> dict[str, Any]:
    """Make the folder of a new run; returns its provenance."""
    gains, recipe, numbers = check_training(settings)
    start = None
    if settings.init_checkpoint is not None:
        start = initial_state(settings.init_checkpoint, settings.iterations["walk"])
        _check_action_scale(settings, gains, numbers[ACTION_SCALE])
    folder.path.mkdir(parents=True, exist_ok=True)
    gains_file = settings.gains_file
    if gains_file is not None:
        with written_whole(folder.gains) as temporary_path:
            shutil.copyfile(gains_file, temporary_path)
    if settings.recipe:
        with written_whole(folder.recipe) as temporary_path:
            temporary_path.write_bytes(recipe_content(settings.recipe))
    start_sha256 = ""
    if start is not None:
        checkpoint.write_checkpoint(folder.path / f"model_{start['iter']}.pt", start)
        start_sha256 = start["infos"]["start_sha256"]
    record = provenance.new_record(
        settings, gains, task=numbers, recipe=recipe, start_sha256=start_sha256
    )
    folder.write(record)
    return record


def _check_action_scale(settings: TrainSettings, gains: TrainingGains, scale: float) -> None:
    """Refuse to begin with a policy whose actions are other angles than those of this training.

    A checkpoint whose run has no record is taken as it is.

    Args:
        settings: Completed settings.
        gains: Its gains.
        scale: Change of a joint target with an action of 1 in this training [rad].
    """
    assert settings.init_checkpoint is not None
    path = settings.init_checkpoint
    start_folder = RunFolder(path if path.is_dir() else path.parent)
    if not start_folder.provenance.is_file():
        return
    recorded = recorded_task_numbers(start_folder.read())
    if ACTION_SCALE in recorded:
        start_scale = recorded[ACTION_SCALE]
    else:
        cfg = _env_cfg(load_task(str(settings.robot)), gains, settings, None)
        start_scale = task_numbers(cfg)[ACTION_SCALE]
    if scale != start_scale:
        raise PronkError(
            f"--init-checkpoint {path}: an action of 1 is {start_scale:g} rad there and "
            f"{scale:g} rad here; give --recipe with task: {{action_scale: {start_scale:g}}}."
        )


def initial_state(path: Path, iterations: int) -> dict[str, Any]:
    """Read the checkpoint with which the phases after walk begin.

    Args:
        path: The checkpoint of a policy that does not jump yet, or the folder of a run whose phase
            walk is over.
        iterations: Iterations of the phase walk, to which its counters are set.

    Raises:
        ArtefactError: No such checkpoint, or one of a policy that jumps.
    """
    source = path / "walk.pt" if path.is_dir() else path
    if not source.is_file():
        missing = "such file" if source == path else "walk.pt"
        raise ArtefactError(
            f"--init-checkpoint {path}: no {missing}; "
            "expected the folder of a run whose phase walk is over, or one of its checkpoints."
        )
    state = checkpoint.read_checkpoint(source)
    infos = state["infos"] or {}
    phases = infos.get("phases", {})
    if checkpoint.uses_jump_input(state) or "jump_a" in phases or "jump_b" in phases:
        raise ArtefactError(
            f"--init-checkpoint {source}: a policy that jumps; expected one of phase walk."
        )
    state["iter"] = iterations - 1
    state["infos"] = {
        "env_state": {"common_step_counter": iterations * STEPS_PER_ITERATION},
        "speed_ranges": infos.get("speed_ranges", 0.0),
        "start_sha256": sha256(source),
    }
    return state


def run_gains(folder: RunFolder, robot: RobotSpec) -> TrainingGains:
    """Return the gains of a run, from its copy of the file, unless that was changed."""
    record = folder.read()
    recorded = record["gains"]
    by_joint = bool(record["settings"].get("by_joint", False))
    if not recorded["sha256"]:
        return training_gains(NAIVE, robot)
    if not folder.gains.is_file() or sha256(folder.gains) != recorded["sha256"]:
        raise ArtefactError(
            f"{folder.gains}: missing or changed since the run began; put the file with SHA-256 "
            f"{recorded['sha256'][:12]}... back, or begin a new run."
        )
    # What the run began with was accepted then; its hash says that this is the same file.
    if recorded["name"] == NAIVE:
        return training_gains(
            NAIVE, robot, like=folder.gains, allow_unmatched=True, by_joint=by_joint
        )
    return training_gains(folder.gains, robot, allow_unmatched=True, by_joint=by_joint)


def run_recipe(folder: RunFolder) -> Recipe | None:
    """Return the recipe of a run, from its copy of the file, unless that was changed."""
    recorded = folder.read().get("recipe")
    if recorded is None:
        return None
    if not folder.recipe.is_file() or sha256(folder.recipe) != recorded["sha256"]:
        raise ArtefactError(
            f"{folder.recipe}: missing or changed since the run began; put the file with SHA-256 "
            f"{recorded['sha256'][:12]}... back, or begin a new run."
        )
    return load_recipe(folder.recipe)


def _env_cfg(
    task: Task, gains: TrainingGains, settings: TrainSettings, recipe: Recipe | None
) -> Any:
    """Return the configuration of the environment."""
    cfg = task.env_cfg(
        task.robot,
        gains,
        iterations=settings.iterations,
        gain_shape="ellipsoid" if settings.draws.ellipsoid else "box",
        num_envs=settings.envs,
        seed=settings.seed,
    )
    if settings.draws.weakest_drive not in (None, 1.0):
        draw_weak_drives(cfg, settings.draws.weakest_drive)
    if recipe is not None:
        apply_recipe(cfg, recipe)
    return cfg


def _summary(
    settings: TrainSettings, record: dict[str, Any], gpus: tuple[str, ...], hosts: tuple[Host, ...]
) -> str:
    """Return one line on what is trained."""
    phases = []
    for name, iterations in settings.iterations.items():
        if iterations > 0:
            phases.append(f"{name} {iterations}")
    unit = "iteration" if sum(settings.iterations.values()) == 1 else "iterations"
    gains = record["gains"]
    gains_text = f"{gains['name']} gains"
    if gains["file"]:
        ranges_text = "with the ranges " if gains["name"] == NAIVE else ""
        gains_text += f" {ranges_text}of {gains['file']}"
        if gains["virtual"]:
            gains_text += " (of the virtual robot)"
        if gains.get("unmatched"):
            gains_text += f" (NO MATCH of {', '.join(gains['unmatched'])})"
    if settings.draws.by_joint:
        gains_text += " by joint"
    recipe_words = ""
    if settings.recipe:
        recipe_words = f", recipe {' + '.join(map(str, settings.recipe))}"
    device_text = "cpu"
    if len(hosts) > 1:
        processes = len(hosts) * max(len(gpus), 1)
        kind = "GPUs" if gpus else "processes"
        device_text = f"each of {processes} {kind} of {len(hosts)} hosts"
    elif len(gpus) == 1:
        device_text = "cuda"
    elif len(gpus) > 1:
        device_text = f"each of {len(gpus)} GPUs"
    return (
        f"training {settings.task} of {settings.robot}: {', '.join(phases)} {unit}, "
        f"{settings.envs} robots on {device_text}, {gains_text}{recipe_words}, seed "
        f"{settings.seed}; run folder {settings.out}"
    )


def _train_session(
    folder: RunFolder, settings: TrainSettings, hosts: tuple[Host, ...], processes: int
) -> dict[str, Any]:
    """Train in this process, or in one for each GPU; returns the provenance of the run."""
    begin = time.monotonic()
    config = _train_config(folder, settings)
    record = folder.read()
    session = provenance.new_session()
    session["compiled"] = settings.devices.compile  # which rounds otherwise
    session["processes"] = processes
    if hosts:
        session["hosts"] = [host.record() for host in hosts]
    record["sessions"].append(session)
    first_checkpoint = checkpoint.latest_checkpoint(folder.path)
    log_dir = folder.path.resolve()
    try:
        folder.write(record)
        if hosts:
            launch(config, log_dir, settings.devices.host_names, hosts[0].processes)
        elif processes > 1:
            launch(config, log_dir, (LOCAL_HOST,), processes)
        else:
            train_process(config, log_dir)
    except KeyboardInterrupt as interrupt:
        # It may have ended before a checkpoint could say so.
        session["stopped"] = str(interrupt) or "SIGINT"
        raise
    finally:
        session["seconds"] = time.monotonic() - begin
        session["device"] = _session_device(hosts, processes)
        last_checkpoint = checkpoint.latest_checkpoint(folder.path)
        if last_checkpoint is not None:
            state = checkpoint.read_checkpoint(last_checkpoint)
            infos = state["infos"]
            record["phases"] = infos.get("phases", {})
            record["finished"] = state["iter"] + 1 >= config.agent.max_iterations
            if last_checkpoint != first_checkpoint and not session["stopped"]:
                session["stopped"] = infos.get("stopped", "")
        folder.write(record)
    return record


def _session_device(hosts: tuple[Host, ...], processes: int) -> dict[str, Any]:
    """Return the record of the devices of all processes, which are alike."""
    if not hosts:
        is_gpu = os.environ["CUDA_VISIBLE_DEVICES"] != ""
        return devices.device_facts("cuda" if is_gpu else "cpu", processes)
    device = dict(hosts[0].facts.device)
    if "count" in device:
        device["count"] = processes
    return device


def _train_config(folder: RunFolder, settings: TrainSettings) -> TrainConfig:
    """Return mjlab's configuration of a training, which continues the last checkpoint if any."""
    task = load_task(folder.robot(str(settings.robot)))
    gains = run_gains(folder, task.robot)
    iterations = sum(settings.iterations.values())
    agent = task.rl_cfg(iterations=iterations, seed=settings.seed)
    if not isinstance(agent, JumpRunnerCfg):
        raise PronkError(
            f"rl_cfg of {settings.robot} gives a {type(agent).__name__}; expected the "
            "JumpRunnerCfg of jump_rl_cfg, changed as needed."
        )
    agent.save_interval = settings.session.save_interval
    agent.logger = settings.session.logger
    agent.wandb_project = "pronk"
    agent.show_progress = True
    agent.start_sha256 = folder.read()["start_sha256"]
    recipe = run_recipe(folder)
    agent.recipe_sha256 = "" if recipe is None else recipe.sha256
    agent.torch_compile_mode = "default" if settings.devices.compile else None
    if settings.session.minutes is not None:
        agent.stop_at = time.time() + 60.0 * settings.session.minutes
    if checkpoint.latest_checkpoint(folder.path) is not None:
        agent.resume = True
    cfg = _env_cfg(task, gains, settings, recipe)
    _check_task_numbers(folder, task_numbers(cfg))
    return TrainConfig(env=cfg, agent=agent)


def _check_task_numbers(folder: RunFolder, numbers: Mapping[str, float]) -> None:
    """Refuse to go on with a run whose task has changed since it began, with a version of pronk.

    Args:
        folder: The run.
        numbers: Those of the task now (`task_numbers`).
    """
    recorded = recorded_task_numbers(folder.read())
    for name, value in numbers.items():
        if recorded.get(name, value) != value:
            raise PronkError(
                f"--resume: the run in {folder.path} began with {name} {recorded[name]:g}, and the "
                f"task of this pronk has {value:g}; train it to its end with the version that it "
                "began with, or give a new --out."
            )
