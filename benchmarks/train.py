"""`pronk bench train`: pronk's jump task beside mjlab's own Go1 task, in one run on one device.

Both tasks live side by side and take turns, block by block, and who goes first changes with every
turn: a device that warms up or slows down does not decide. Every figure of a task is of its own
configuration as it is registered with mjlab. The stages are measured afterwards, in passes of
their own.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from typing import Any

from benchmarks.train_contender import Contender
from benchmarks.train_result import Rate, Scaling, TaskSpeed, TrainBench, stage_table, table
from pronk.errors import PronkError
from pronk.train.runner.devices import find_devices, parse_gpu_ids, require_extra

__all__ = ["PEER", "PRONK", "TrainBench", "run", "stage_table", "table"]

PRONK = "Pronk-Jump-MiniCheetah"
PEER = "Mjlab-Velocity-Flat-Unitree-Go1"
ENVS = (4096, 16384)
STEPS = 50
ITERATIONS = 1
REPEATS = 4


def run(
    tell: Callable[[str], None] = lambda _: None,
    *,
    envs: Sequence[int] = ENVS,
    steps: int = STEPS,
    iterations: int = ITERATIONS,
    repeats: int = REPEATS,
    device: str = "auto",
    gpu_ids: str | None = None,
    tasks: tuple[str, str] = (PRONK, PEER),
) -> TrainBench:
    """Measure both tasks at every number of environments.

    Args:
        tell: Told in a line what was done.
        envs: Numbers of environments.
        steps: Steps of every environment in a block of stepping.
        iterations: Iterations in a block of training.
        repeats: Blocks of each task and kind.
        device: `cpu`, `cuda`, or `auto`.
        gpu_ids: GPUs such as `0,1`, or `all`; the first of them is measured. With several, the
            first task is also trained on one and on all of them, with the first of `envs` on each.
        tasks: pronk's task and its peer, as mjlab knows them.

    Raises:
        PronkError: A number is impossible, a task or device unknown, or mjlab is missing.
    """
    if not envs or min(*envs, steps, iterations, repeats) < 1:
        raise PronkError(
            f"environments {list(envs)}, {steps} steps, {iterations} iterations, {repeats} "
            "repeats; expected 1 or more of each."
        )
    begin = time.perf_counter()
    require_extra()
    devices = find_devices(device, gpu_ids)
    name = "cpu" if devices.device == "cpu" else f"cuda:{_first(gpu_ids)}"
    pairs: list[tuple[TaskSpeed, TaskSpeed]] = []
    for count in envs:
        pairs.append(
            _pair(
                tasks,
                count,
                steps=steps,
                iterations=iterations,
                repeats=repeats,
                device=name,
                tell=tell,
            )
        )
    scaling = None
    if devices.count > 1:
        scaling = _scaling(tasks[0], envs[0], devices.visible, iterations, repeats, tell)
    return TrainBench(
        pairs=tuple(pairs),
        scaling=scaling,
        steps=steps,
        iterations=iterations,
        machine=_machine(name),
        seconds=time.perf_counter() - begin,
    )


def _first(gpu_ids: str | None) -> int:
    ids = parse_gpu_ids(gpu_ids or "0")
    return 0 if ids == "all" else ids[0]


def _pair(
    tasks: tuple[str, str],
    envs: int,
    *,
    steps: int,
    iterations: int,
    repeats: int,
    device: str,
    tell: Callable[[str], None],
) -> tuple[TaskSpeed, TaskSpeed]:
    """Both tasks at one number of environments."""
    contenders: list[Contender] = []
    try:
        for task in tasks:
            contenders.append(Contender(task, envs=envs, device=device))
            tell(f"{envs:,} environments of {task} built in {contenders[-1].build_s:.1f} s")
        before = [one.physics_steps for one in contenders]
        stepping = in_turn([partial(one.step, steps) for one in contenders], repeats)
        physics = [
            (one.physics_steps - begun) / (repeats * steps)
            for one, begun in zip(contenders, before, strict=True)
        ]
        step_costs = [one.step_costs(steps) for one in contenders]
        tell(f"{envs:,} environments: stepped alone")
        for one in contenders:
            one.warm_up()
        training = in_turn([partial(one.train, iterations) for one in contenders], repeats)
        speeds = []
        for one, step_seconds, train_seconds, stages, substeps in zip(
            contenders, stepping, training, step_costs, physics, strict=True
        ):
            speed = TaskSpeed(
                task=one.task,
                envs=envs,
                stepping=_rate(envs * steps, step_seconds),
                training=_rate(envs * one.horizon * iterations, train_seconds),
                physics_per_step=substeps,
                step_stages=stages,
                iteration_stages=one.iteration_costs(),
                horizon=one.horizon,
                memory_mb=one.memory_mb,
                cuda_graphs=one.cuda_graphs,
                build_s=one.build_s,
            )
            tell(
                f"{envs:,} environments of {one.task}: {speed.stepping.median:,.0f} steps/s, "
                f"training {speed.training.median:,.0f} steps/s"
            )
            speeds.append(speed)
        return speeds[0], speeds[1]
    finally:
        for one in contenders:
            one.close()


def in_turn(blocks: Sequence[Callable[[], float]], repeats: int) -> list[list[float]]:
    """Run blocks in turn, each as often; who goes first changes with every turn.

    Args:
        blocks: Each gives its wall time [s].
        repeats: Turns.

    Returns:
        Times of each block, turn by turn.
    """
    times: list[list[float]] = [[] for _ in blocks]
    for turn in range(repeats):
        order = range(len(blocks))
        for k in order if turn % 2 == 0 else reversed(order):
            times[k].append(blocks[k]())
    return times


def _rate(work: int, seconds: Sequence[float]) -> Rate:
    return Rate(blocks=tuple(work / one for one in seconds))


def _scaling(
    task: str,
    envs: int,
    gpu_ids: Sequence[str],
    iterations: int,
    repeats: int,
    tell: Callable[[str], None],
) -> Scaling:
    """Train on the first GPU, then on all of them, in processes of their own."""
    rates = {}
    for count in (1, len(gpu_ids)):
        seconds, horizon = launch(gpu_ids[:count], _train_blocks, task, envs, iterations, repeats)
        rates[count] = _rate(count * envs * horizon * iterations, seconds)
        tell(f"{count} GPUs of {envs:,} environments: {rates[count].median:,.0f} steps/s")
    return Scaling(task=task, envs=envs, rates=rates)


def _train_blocks(task: str, envs: int, iterations: int, repeats: int) -> tuple[list[float], int]:
    """One of the processes: block by block, all wait for one another in every update.

    Returns:
        Time of each block [s], and steps of every environment in an iteration.
    """
    rank = int(os.environ.get("LOCAL_RANK", "0"))
    one = Contender(task, envs=envs, device=f"cuda:{rank}", seed=1 + rank)
    one.warm_up()
    seconds = [one.train(iterations) for _ in range(repeats)]
    horizon = one.horizon
    one.close()
    return seconds, horizon


def launch(gpu_ids: Sequence[str], work: Callable[..., Any], *args: Any) -> Any:
    """Do the same in one process on each GPU, as mjlab trains on several.

    Args:
        gpu_ids: The GPUs, as `CUDA_VISIBLE_DEVICES` names them.
        work: What to do; sees its GPU as `cuda:LOCAL_RANK`.
        args: Of `work`.

    Returns:
        What the first of them gives.
    """
    import torchrunx

    launcher = torchrunx.Launcher(
        hostnames=["localhost"],
        workers_per_host=len(gpu_ids),
        backend=None,  # rsl_rl joins the processes itself
        copy_env_vars=(*torchrunx.DEFAULT_ENV_VARS_FOR_COPY, "MUJOCO*", "MJLAB*", "WARP*"),
        extra_env_vars={"CUDA_VISIBLE_DEVICES": ",".join(gpu_ids)},
    )
    launcher.set_logging_handlers(None)
    return launcher.run(work, *args).rank(0)


def _machine(device: str) -> dict[str, str]:
    """What the figures were taken on."""
    import torch

    return {
        "device": platform.machine() if device == "cpu" else torch.cuda.get_device_name(device),
        "python": platform.python_version(),
        **{name: version(name) for name in ("mjlab", "mujoco-warp", "rsl-rl-lib", "torch")},
    }
