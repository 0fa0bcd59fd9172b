"""`pronk train`: mjlab's training of a task with given gains, and its provenance."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from types import FrameType
from typing import Any

import torch

from pronk.errors import ArtefactError
from pronk.files import sha256, written_whole
from pronk.jump.train import devices, provenance
from pronk.jump.train.gains import NAIVE, TrainingGains, training_gains
from pronk.jump.train.phases import STEPS_PER_ITERATION
from pronk.jump.train.provenance import RunFolder
from pronk.jump.train.rl import checkpoint
from pronk.jump.train.settings import TrainSettings

_COPIED = ("MUJOCO*", "MJLAB*", "WARP*", "WANDB*")
"""Variables of the environment that the processes get, beside torchrunx's own."""


def train(
    settings: TrainSettings, report: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Begin or resume a run, train until it is finished or stopped, and return its provenance.

    `report` is called with lines of text before training begins. Of impossible settings nothing is
    written; learning that has diverged is a PronkError as well.
    """
    folder = RunFolder(settings.out)
    found: dict[str, Any] = {}
    if settings.resume:
        found = folder.read()
        settings = settings.resumed(found["settings"])
        changes = provenance.changed_versions(found)
        if changes:
            report(f"resumed with other versions: {'; '.join(changes)}")
    else:
        folder.check_fresh()
        settings = settings.completed()
    gpus = devices.find_devices(settings.device, settings.gpu_ids)
    # Hide all other GPUs from this process and its children, before any uses CUDA.
    os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(gpus)
    if not settings.resume:
        found = _begin(folder, settings)
    report(_summary(settings, found, gpus))
    return found if found["finished"] else _launch(folder, settings, max(len(gpus), 1))


def _begin(folder: RunFolder, settings: TrainSettings) -> dict[str, Any]:
    """Make the folder of a new run."""
    from pronk.jump.train.tasks import load_task

    task = load_task(str(settings.robot))
    gains = training_gains(settings.gains or NAIVE, task.robot, like=settings.ranges_from)
    first, file = settings.init_checkpoint, settings.gains_file
    start = None if first is None else initial_state(first, settings.iterations["walk"])
    task.env_cfg(task.robot, gains, **_options(settings))  # refuses impossible gains
    folder.path.mkdir(parents=True, exist_ok=True)
    if file is not None:
        with written_whole(folder.gains) as aside:
            shutil.copyfile(file, aside)
    if start is not None:
        checkpoint.write(folder.path / f"model_{start['iter']}.pt", start)
    about = {"sha256": gains.sha256, "virtual": gains.virtual}
    found: dict[str, Any] = {
        "schema": provenance.SCHEMA,
        "settings": settings.stored_values(),
        "gains": {"name": gains.name, "file": file and file.name, **about},
        "start_sha256": "" if start is None else start["infos"]["start_sha256"],
        "phases": {},
        "finished": False,
        "sessions": [],
    }
    folder.write(found)
    return found


def initial_state(path: Path, iterations: int) -> dict[str, Any]:
    """The checkpoint with which the phases after walk begin, its counters set to `iterations`.

    `path` is the checkpoint of a policy that does not jump yet, or the folder of a run whose phase
    walk is over; an ArtefactError for any other.
    """
    source = path / "walk.pt" if path.is_dir() else path
    if not source.is_file():
        raise ArtefactError(
            f"--init-checkpoint {path}: no {'such file' if source == path else 'walk.pt'}; "
            "expected the folder of a run whose phase walk is over, or one of its checkpoints."
        )
    state = checkpoint.read(source)
    infos = state["infos"] or {}
    if checkpoint.jumps(state) or {"jump_a", "jump_b"} & set(infos.get("phases", ())):
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


def _options(settings: TrainSettings) -> dict[str, Any]:
    return {
        "iterations": settings.iterations,
        "gain_shape": "ellipsoid" if settings.ellipsoid else "box",
        "num_envs": settings.envs,
    }


def run_gains(folder: RunFolder, robot: Any) -> TrainingGains:
    """The gains of a run, from its copy of the file, unless that was changed."""
    about = folder.read()["gains"]
    if not about["sha256"]:
        return training_gains(NAIVE, robot)
    if not folder.gains.is_file() or sha256(folder.gains) != about["sha256"]:
        raise ArtefactError(
            f"{folder.gains}: missing or changed since the run began; put the file with SHA-256 "
            f"{about['sha256'][:12]}... back, or begin a new run."
        )
    if about["name"] == NAIVE:
        return training_gains(NAIVE, robot, like=folder.gains)
    return training_gains(folder.gains, robot)


def _summary(settings: TrainSettings, found: dict[str, Any], gpus: tuple[str, ...]) -> str:
    phases = ", ".join(f"{n} {c}" for n, c in settings.iterations.items() if c > 0)
    gains = found["gains"]
    words = f"{gains['name']} gains"
    if gains["file"]:
        words += f" {'with the ranges ' if gains['name'] == NAIVE else ''}of {gains['file']}"
        words += " (of the virtual robot)" if gains["virtual"] else ""
    on = f"each of {len(gpus)} GPUs" if len(gpus) > 1 else "cuda" if gpus else "cpu"
    return (
        f"training {settings.task} of {settings.robot}: {phases} iterations, {settings.envs} "
        f"robots on {on}, {words}, seed {settings.seed}; run folder {settings.out}"
    )


def _launch(folder: RunFolder, settings: TrainSettings, processes: int) -> dict[str, Any]:
    """Train in this process, or in one for each GPU."""
    begin = time.monotonic()
    with folder.locked():
        with folder.changed() as found:
            found["sessions"].append(provenance.new_session())
        try:
            if processes == 1:
                train_run(folder, settings)
            else:
                import torchrunx

                os.environ.setdefault("TORCHRUNX_LOG_DIR", str(folder.path / "torchrunx"))
                torchrunx.Launcher(
                    hostnames=["localhost"],
                    workers_per_host=processes,
                    backend=None,  # rsl_rl makes the process group itself
                    copy_env_vars=(*torchrunx.DEFAULT_ENV_VARS_FOR_COPY, *_COPIED),
                ).run(train_run, folder, settings)
        finally:
            with folder.changed() as found:
                found["sessions"][-1]["seconds"] = time.monotonic() - begin
    return found


def train_run(folder: RunFolder, settings: TrainSettings) -> None:
    """Do what one process does: all of a run, or the rest of it."""
    rank = int(os.environ.get("RANK", "0"))
    log = folder.path / ("train.log" if rank == 0 else f"train.{rank}.log")
    with log.open("a", encoding="utf-8", buffering=1) as file, contextlib.redirect_stdout(file):
        _train_run(folder, settings, rank)


def _train_run(folder: RunFolder, settings: TrainSettings, rank: int) -> None:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl import RslRlVecEnvWrapper
    from mjlab.utils.os import dump_yaml
    from mjlab.utils.torch import configure_torch_backends

    from pronk.jump.train.rl.runner import PronkRunner, note
    from pronk.jump.train.tasks import load_task

    begin = time.monotonic()
    device = "cpu"
    if os.environ.get("CUDA_VISIBLE_DEVICES"):
        device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
        torch.cuda.set_device(device)
    configure_torch_backends()
    note(rank, f"building {settings.envs} robots on {device} and compiling kernels")
    task = load_task(str(settings.robot))
    gains = run_gains(folder, task.robot)
    seed = int(settings.seed or 0) + rank
    env_cfg = task.env_cfg(task.robot, gains, seed=seed, **_options(settings))
    agent = replace(
        task.rl_cfg(iterations=sum(settings.iterations.values()), seed=seed),
        save_interval=settings.save_interval,
        logger=settings.logger,
        wandb_project="pronk",
    )
    if rank == 0:
        dump_yaml(folder.path / "params" / "env.yaml", asdict(env_cfg))
        dump_yaml(folder.path / "params" / "agent.yaml", asdict(agent))
    devices.compile_kernels(device)
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(env_cfg, device=device), agent.clip_actions)
    runner = PronkRunner(env, asdict(agent), str(folder.path), device)
    runner.provenance = {"start_sha256": folder.read()["start_sha256"]}
    runner.show_progress = True
    last = checkpoint.latest(folder.path)
    if last is not None:
        runner.load(str(last))
    built = time.monotonic() - begin
    note(rank, f"built in {built:.0f} s")
    if device != "cpu" and (warning := devices.check_cuda_graphs(env.unwrapped.sim)) is not None:
        note(rank, f"warning: {warning}")
    if settings.minutes is not None:
        runner.deadline = begin + 60.0 * settings.minutes
    with stop_signals(runner):
        runner.learn(runner.curriculum.total - runner.iteration, init_at_random_ep_len=True)
    env.close()
    if rank == 0:
        with folder.changed() as found:
            found["phases"] = runner.phases
            found["finished"] = runner.iteration >= runner.curriculum.total
            found["sessions"][-1] |= {
                "stopped": runner.stop_reason,
                "build_s": built,
                "device": devices.device_facts(device.partition(":")[0], runner.gpu_world_size),
            }


@contextmanager
def stop_signals(runner: Any) -> Iterator[None]:
    """Inside the block the first SIGINT or SIGTERM ends training after the present iteration.

    The next one has its usual effect. Python delivers signals to the main thread alone; in another
    thread the block changes nothing.
    """
    main = threading.current_thread() is threading.main_thread()
    before = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM) if main}

    def stop(number: int, _: FrameType | None) -> None:
        signal.signal(number, before[signal.Signals(number)])
        runner.stop_reason = signal.Signals(number).name

    for number in before:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
