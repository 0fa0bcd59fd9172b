"""`python -m benchmarks train`: pronk's jump task beside mjlab's own Go1 task, on one device.

Both tasks take turns, block by block, each with its own configuration as registered with mjlab.
The stages are measured afterwards, in passes of their own.
"""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from benchmarks.runner import in_turn, machine, paired_ratio, spread, table
from benchmarks.train_task import REST, BenchTask, StageCost
from pronk.cli import console
from pronk.errors import PronkError
from pronk.train.runner.devices import find_devices, parse_gpu_ids, require_extra

TASKS = ("Pronk-Jump-MiniCheetah", "Mjlab-Velocity-Flat-Unitree-Go1")
Rates = tuple[float, ...]
"""Environment steps per second of all blocks of one kind, in the order they were run."""


@dataclass(frozen=True, kw_only=True)
class TaskSpeed:
    """One task at one number of environments."""

    task: str
    envs: int
    stepping: Rates
    """Environments alone, random actions."""
    training: Rates
    """The task's own PPO, everything included but checkpoints."""
    physics_per_step: float
    """Physics steps in a step of the environment, mean over the blocks of stepping."""
    step_stages: tuple[StageCost, ...]
    iteration_stages: tuple[StageCost, ...]
    horizon: int
    """Steps of every environment in one iteration."""
    memory_mb: float
    """Memory of the device, the first iteration included [MB]; NaN on the CPU."""
    cuda_graphs: bool
    build_s: float
    """Time to build, compile and warm up [s]."""


@dataclass(frozen=True, kw_only=True)
class TrainBench:
    """Both tasks at every number of environments."""

    pairs: tuple[tuple[TaskSpeed, TaskSpeed], ...]
    """pronk and its peer, for each number of environments."""
    scaling: dict[int, Rates]
    """Training of the first task by number of GPUs, all of them together; empty with one GPU."""
    steps: int
    """Steps of every environment in a block of stepping."""
    iterations: int
    """Iterations in a block of training."""
    machine: dict[str, str]
    seconds: float
    """Wall time of the whole run [s]."""

    def figures(self) -> dict[str, Any]:
        """All figures, and the ratios (median, least, greatest), for JSON."""
        ratios = [
            {
                "envs": ours.envs,
                "stepping": paired_ratio(ours.stepping, peer.stepping),
                "training": paired_ratio(ours.training, peer.training),
            }
            for ours, peer in self.pairs
        ]
        return {"schema": "pronk/bench-train/2", **asdict(self), "ratios": ratios}


def run(
    tell: Callable[[str], None] = lambda _: None,
    *,
    envs: Sequence[int] = (4096, 16384),
    steps: int = 50,
    iterations: int = 1,
    repeats: int = 4,
    device: str = "auto",
    gpu_ids: str | None = None,
    tasks: tuple[str, str] = TASKS,
) -> TrainBench:
    """Measure both tasks at every number of environments.

    Args:
        tell: Called with a line on what was done.
        envs: Numbers of environments.
        steps: Steps of every environment in a block of stepping.
        iterations: Iterations in a block of training.
        repeats: Blocks of each task and kind.
        device: `cpu`, `cuda`, or `auto`.
        gpu_ids: GPUs such as `0,1`, or `all`; the first of them is measured. With several, the
            first task is also trained on one and on all of them, with the first of `envs` on each.
        tasks: pronk's task and its peer, as registered with mjlab.

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
    ids = parse_gpu_ids(gpu_ids or "0")
    name = "cpu" if devices.device == "cpu" else f"cuda:{0 if ids == 'all' else ids[0]}"
    pairs = [_pair(tasks, count, steps, iterations, repeats, name, tell) for count in envs]
    scaling = {}
    for count in (1, devices.count) if devices.count > 1 else ():
        arguments = (tasks[0], envs[0], iterations, repeats)
        seconds, horizon = launch(devices.visible[:count], _train_blocks, *arguments)
        scaling[count] = _rates(count * envs[0] * horizon * iterations, seconds)
        tell(f"{count} GPUs of {envs[0]:,} environments: {np.median(scaling[count]):,.0f} steps/s")
    return TrainBench(
        pairs=tuple(pairs),
        scaling=scaling,
        steps=steps,
        iterations=iterations,
        machine=_machine(name),
        seconds=time.perf_counter() - begin,
    )


def _pair(
    names: tuple[str, str],
    envs: int,
    steps: int,
    iterations: int,
    repeats: int,
    device: str,
    tell: Callable[[str], None],
) -> tuple[TaskSpeed, TaskSpeed]:
    """Both tasks at one number of environments."""
    tasks: list[BenchTask] = []
    try:
        for name in names:
            tasks.append(BenchTask(name, envs=envs, device=device))
            tell(f"{envs:,} environments of {name} built in {tasks[-1].build_s:.1f} s")
        before = [one.physics_steps for one in tasks]
        stepping = in_turn([partial(one.step, steps) for one in tasks], repeats)
        physics = [
            (one.physics_steps - count) / (repeats * steps)
            for one, count in zip(tasks, before, strict=True)
        ]
        step_costs = [one.step_costs(steps) for one in tasks]
        tell(f"{envs:,} environments: stepped alone")
        for one in tasks:
            one.warm_up()
        training = in_turn([partial(one.train, iterations) for one in tasks], repeats)
        speeds = []
        for k, one in enumerate(tasks):
            speed = TaskSpeed(
                task=one.task,
                envs=envs,
                stepping=_rates(envs * steps, stepping[k]),
                training=_rates(envs * one.horizon * iterations, training[k]),
                physics_per_step=physics[k],
                step_stages=step_costs[k],
                iteration_stages=one.iteration_costs(),
                horizon=one.horizon,
                memory_mb=one.memory_mb,
                cuda_graphs=one.cuda_graphs,
                build_s=one.build_s,
            )
            tell(
                f"{envs:,} environments of {one.task}: {np.median(speed.stepping):,.0f} steps/s, "
                f"training {np.median(speed.training):,.0f} steps/s"
            )
            speeds.append(speed)
        return speeds[0], speeds[1]
    finally:
        for one in tasks:
            one.close()


def _rates(work: int, seconds: Sequence[float]) -> Rates:
    return tuple(work / one for one in seconds)


def _train_blocks(task: str, envs: int, iterations: int, repeats: int) -> tuple[list[float], int]:
    """One of several processes; they synchronize in every update.

    Returns:
        Time of each block [s], and steps of every environment in an iteration.
    """
    rank = int(os.environ.get("LOCAL_RANK", "0"))
    one = BenchTask(task, envs=envs, device=f"cuda:{rank}", seed=1 + rank)
    one.warm_up()
    seconds = [one.train(iterations) for _ in range(repeats)]
    one.close()
    return seconds, one.horizon


def launch(gpu_ids: Sequence[str], work: Callable[..., Any], *args: Any) -> Any:
    """Run `work(*args)` in one process on each GPU; returns the result of the first.

    Args:
        gpu_ids: The GPUs, as `CUDA_VISIBLE_DEVICES` names them.
        work: Finds its GPU as `cuda:LOCAL_RANK`.
        args: Of `work`.
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
    import torch

    name = platform.machine() if device == "cpu" else torch.cuda.get_device_name(device)
    return {"device": name, **machine("mjlab", "mujoco-warp", "rsl-rl-lib", "torch")}


def rate_table(result: TrainBench) -> Table:
    """Rates of both tasks and their ratios."""
    version, blocks = result.machine, len(result.pairs[0][0].stepping)
    captured = all(speed.cuda_graphs for pair in result.pairs for speed in pair)
    caption = (
        f"{blocks} blocks of {result.steps} steps and {blocks} of {result.iterations} iterations "
        "for each task, in turn; the ratio is of neighbouring blocks. Stepping: small random "
        "actions, nothing but the environment. Training: the task's own networks and PPO, with "
        "logging, without checkpoints.\n"
        f"{version['device']}, {'with' if captured else 'WITHOUT'} CUDA graphs, mjlab "
        f"{version['mjlab']}, MuJoCo Warp {version['mujoco-warp']}, rsl_rl "
        f"{version['rsl-rl-lib']}, PyTorch {version['torch']}; {result.seconds:.0f} s in all."
    )

    def rate(blocks: Rates) -> str:
        thousands = np.array(blocks) / 1e3
        return spread((float(np.median(thousands)), thousands.min(), thousands.max()), 1)

    title = "Environment steps per second, in thousands: median (slowest to fastest block)"
    columns = ["environments", "what", *(speed.task for speed in result.pairs[0]), "ratio"]
    made = table(title, columns, caption=caption)
    for pair in result.pairs:
        made.add_section()
        for what in ("stepping", "training"):
            ours, peer = (getattr(speed, what) for speed in pair)
            ratio = spread(paired_ratio(ours, peer))
            made.add_row(f"{pair[0].envs:,}", what, rate(ours), rate(peer), ratio)
        memory = [speed.memory_mb / 1024.0 for speed in pair]
        made.add_row("", "physics steps a step", *(f"{s.physics_per_step:.2f}" for s in pair))
        made.add_row(
            "", "GPU memory [GB]", *(f"{m:.2f}" if math.isfinite(m) else "-" for m in memory)
        )
        made.add_row("", "build and warm up [s]", *(f"{speed.build_s:.1f}" for speed in pair))
    if result.scaling:
        made.add_section()
    for count, found in result.scaling.items():
        what = f"training, {count} GPU{'s' if count > 1 else ''}"
        times = f"x{np.median(found) / np.median(result.scaling[1]):.2f}"
        made.add_row(f"{result.pairs[0][0].envs:,} each", what, rate(found), "", times)
    return made


def stage_table(result: TrainBench) -> Table:
    """Cost of each stage of a step and of an iteration."""
    speeds = [speed for pair in result.pairs for speed in pair]
    short = [speed.task.rsplit("-", 1)[-1] for speed in speeds]
    made = table(
        "Stages [ms], waited for one by one; operations and host waits per step",
        [
            "stage",
            *(f"{name}\n{speed.envs:,}" for name, speed in zip(short, speeds, strict=True)),
            *(f"{name}\noperations / waits" for name in short[-2:]),
        ],
        caption="The wait after each stage takes away the overlap of host and device, so that the "
        "sums are more than a step takes. Operations: of PyTorch, views left out, counted apart "
        "from the times; waits: for a result of the device.",
    )

    def counts(costs: Iterable[StageCost]) -> str:
        both = [(cost.operations, cost.waits) for cost in costs]
        return " / ".join(f"{total:.0f}" for total in np.sum(both, axis=0))

    for what, title in (
        ("step_stages", "one step"),
        ("iteration_stages", f"one iteration of {speeds[0].horizon} steps"),
    ):
        made.add_section()
        tables = [{cost.stage: cost for cost in getattr(speed, what)} for speed in speeds]
        sums = [f"{sum(cost.milliseconds for cost in one.values()):.2f}" for one in tables]
        made.add_row(Text(title, "bold"), *sums, *(counts(one.values()) for one in tables[-2:]))
        for name in [*dict.fromkeys(name for one in tables for name in one if name != REST), REST]:
            cells = [f"{one[name].milliseconds:.2f}" if name in one else "" for one in tables]
            cells += [counts([one[name]]) if name in one else "" for one in tables[-2:]]
            made.add_row(f"  {name}", *cells)
    return made


def train(
    envs: str = "4096,16384",
    steps: int = 50,
    iterations: int = 1,
    repeats: int = 4,
    device: str = "auto",
    gpu_ids: str | None = None,
    json_file: console.JsonFile = None,
) -> None:
    """Steps per second of the jump task and of mjlab's own Go1 task, stage by stage.

    Args:
        envs: Numbers of environments.
        steps: Steps in a block of stepping.
        iterations: Iterations in a block of training.
        repeats: Blocks of each task, taken in turn.
        device: auto, cuda or cpu (to try it out).
        gpu_ids: GPUs, such as 0,1: training on one and on all of them as well.
        json_file: Also write the figures to this file.
    """
    words = [word.strip() for word in envs.split(",")]
    if not all(word.isdigit() for word in words):
        raise PronkError(f"--envs {envs!r}: expected whole numbers, such as 4096,16384.")
    begin = time.perf_counter()

    def line(text: str) -> None:
        console.err().print(f"{time.perf_counter() - begin:6.1f} s  {text}", markup=False)

    result = run(
        line,
        envs=[int(word) for word in words],
        steps=steps,
        iterations=iterations,
        repeats=repeats,
        device=device,
        gpu_ids=gpu_ids,
    )
    console.show(rate_table(result))
    console.show(stage_table(result))
    console.write_json(json_file, result.figures())
