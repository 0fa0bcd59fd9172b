"""`python -m benchmarks train`: pronk's jump task beside mjlab's own Go1 task, on one device.

Both tasks take turns, block by block, each with environment, networks, PPO settings and runner as
registered with mjlab. Only uploads and checkpoints are off; TensorBoard is written to a temporary
folder.
"""

from __future__ import annotations

import gc
import io
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, redirect_stdout
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.runner import finish, in_turn, machine, paired_ratio, spread
from pronk.cli import console
from pronk.errors import PronkError
from pronk.tables import Cell, Column, Table

TASKS = ("Pronk-Jump-MiniCheetah", "Mjlab-Velocity-Flat-Unitree-Go1")
ACTION_STD = 0.1
"""Standard deviation of the random actions that step the environment."""
ACTIONS = 16
"""Random actions drawn beforehand and used in turn."""


class BenchTask:
    """A task at one number of environments on one device, built and warm.

    The environment must be stepped before the task is trained: rsl_rl rolls out in inference mode,
    and the tensors of that mode cannot be stepped outside of it.
    """

    def __init__(
        self, task: str, *, envs: int, device: str, seed: int = 1, compiles: bool = False
    ) -> None:
        """Build environment and runner as mjlab's `train` does; PronkError for an unknown task.

        With `compiles` pronk's tasks are compiled, as by `pronk train --compile`.
        """
        # mjlab reads this when it is imported first.
        os.environ.setdefault("MJLAB_WARP_QUIET", "1")
        import torch

        self.task, self.device, self._trained = task, device, False
        self._folder = tempfile.TemporaryDirectory(prefix="pronk-bench-")
        with redirect_stdout(io.StringIO()):
            self.env, self.runner = _build(task, envs, device, seed, self._folder.name, compiles)
            self.runner.save = lambda *_, **__: None
            self.runner.console = Console(file=io.StringIO())
            shape = (ACTIONS, envs, self.env.action_manager.total_action_dim)
            self._actions = ACTION_STD * torch.randn(shape, device=device)
            # Episodes end at different times, as in training.
            self.env.episode_length_buf = torch.randint_like(
                self.env.episode_length_buf, high=int(self.env.max_episode_length)
            )
            self.step(2 * ACTIONS)
        self.cuda_graphs = bool(self.env.sim.use_cuda_graph)
        self.horizon = int(self.runner.cfg["num_steps_per_env"])
        """Steps of every environment in one iteration of training."""

    @property
    def physics_steps(self) -> int:
        """Physics steps of every environment since it was built."""
        return int(self.env._sim_step_counter)

    def step(self, steps: int) -> float:
        """Step the environments with small random actions; returns the wall time [s]."""
        import torch

        begin = self._now()
        with torch.no_grad():
            for k in range(steps):
                self.env.step(self._actions[k % ACTIONS])
        return self._now() - begin

    def train(self, iterations: int) -> float:
        """Train on, logging included; returns the wall time [s]. The first iteration warms up."""
        if not self._trained:
            self._trained = True
            self.train(1)
            # The writer stays open from one block of iterations to the next.
            self.runner.logger.init_logging_writer = lambda: None
        begin = self._now()
        with redirect_stdout(io.StringIO()):
            self.runner.learn(iterations)
        return self._now() - begin

    def _now(self) -> float:
        """The time when the device has done all that was launched [s]."""
        if self.device != "cpu":
            import torch

            torch.cuda.synchronize(self.device)
        return time.perf_counter()

    def close(self) -> None:
        """Release environment, runner, memory and folder."""
        import torch

        if self.runner.logger.writer is not None:
            self.runner.logger.writer.close()
        self.env.close()
        del self.env, self.runner, self._actions
        self._folder.cleanup()
        gc.collect()
        torch.cuda.empty_cache()  # no-op where CUDA was not used


def _build(
    task: str, envs: int, device: str, seed: int, folder: str, compiles: bool = False
) -> tuple[Any, Any]:
    import mjlab.tasks  # noqa: F401 - registers mjlab's own
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
    from mjlab.tasks.registry import list_tasks, load_env_cfg, load_rl_cfg, load_runner_cls
    from mjlab.utils.torch import configure_torch_backends

    import pronk.jump.train.tasks  # noqa: F401 - registers pronk's
    from pronk.jump.train.rl.runner import JumpRunnerCfg

    if task not in list_tasks():
        raise PronkError(f"mjlab knows no task {task!r}; it knows {', '.join(list_tasks())}.")
    configure_torch_backends()
    env_cfg, rl_cfg = load_env_cfg(task), load_rl_cfg(task)
    env_cfg.scene.num_envs = envs
    env_cfg.seed = rl_cfg.seed = seed
    rl_cfg.logger, rl_cfg.upload_model = "tensorboard", False
    if compiles and isinstance(rl_cfg, JumpRunnerCfg):
        rl_cfg.torch_compile_mode = "default"
    env = ManagerBasedRlEnv(cfg=env_cfg, device=device)
    wrapped = RslRlVecEnvWrapper(env, clip_actions=rl_cfg.clip_actions)
    runner_class = load_runner_cls(task) or MjlabOnPolicyRunner
    return env, runner_class(wrapped, asdict(rl_cfg), folder, device)


def run(
    report: Callable[[str], None] = lambda _: None,
    *,
    envs: Sequence[int] = (4096, 16384),
    steps: int = 50,
    iterations: int = 1,
    repeats: int = 4,
    device: str = "cuda:0",
    gpus: Sequence[str] = (),
    tasks: tuple[str, str] = TASKS,
    compiles: bool = False,
) -> dict[str, Any]:
    """Measure both tasks at every number of environments, in blocks of steps and of iterations.

    With several `gpus`, named as in `CUDA_VISIBLE_DEVICES`, the first task is also trained on one
    and on all of them, with the first of `envs` on each. Returns `pairs`: for each number of
    environments, figures of both tasks; `ratios` of their rates, median, least and greatest;
    `scaling`: rates of training by number of GPUs. Rates are environment steps per second of each
    block. PronkError for an impossible number or an unknown task.
    """
    if not envs or min(*envs, steps, iterations, repeats) < 1:
        raise PronkError(
            f"environments {list(envs)}, {steps} steps, {iterations} iterations, {repeats} "
            "repeats; expected 1 or more of each."
        )
    begin = time.perf_counter()
    blocks = {"steps": steps, "iterations": iterations, "repeats": repeats}
    pairs = []
    for count in envs:
        pairs.append(_pair(tasks, count, device, report, compiles=compiles, **blocks))
        report(f"{count:,} environments: measured")
    scaling = {}
    for count in (1, len(gpus)) if len(gpus) > 1 else ():
        seconds, horizon = _launch(gpus[:count], tasks[0], envs[0], iterations, repeats)
        scaling[count] = [count * envs[0] * horizon * iterations / one for one in seconds]
        report(f"{count} GPUs of {envs[0]:,}: {np.median(scaling[count]):,.0f} steps/s")
    ratios = [
        {name: paired_ratio(ours[name], peer[name]) for name in ("stepping", "training")}
        for ours, peer in pairs
    ]
    about = machine("mjlab", "mujoco-warp", "rsl-rl-lib", "torch")
    return {
        "schema": "pronk/bench-train/3",
        "pairs": pairs,
        "ratios": ratios,
        "scaling": scaling,
        "blocks": blocks,
        "compiled": compiles,
        "machine": {"device": _device_name(device), **about},
        "seconds": time.perf_counter() - begin,
    }


def _pair(
    names: Sequence[str],
    envs: int,
    device: str,
    report: Callable[[str], None],
    *,
    steps: int,
    iterations: int,
    repeats: int,
    compiles: bool = False,
) -> list[dict[str, Any]]:
    """Figures of both tasks at one number of environments."""
    with ExitStack() as stack:
        tasks: list[BenchTask] = []
        for name in names:
            tasks.append(BenchTask(name, envs=envs, device=device, compiles=compiles))
            stack.callback(tasks[-1].close)
            report(f"{envs:,} environments of {name} built")
        before = [one.physics_steps for one in tasks]
        stepping = in_turn([partial(one.step, steps) for one in tasks], repeats)
        physics = [one.physics_steps - count for one, count in zip(tasks, before, strict=True)]
        training = in_turn([partial(one.train, iterations) for one in tasks], repeats)
        return [
            {
                "task": one.task,
                "envs": envs,
                "stepping": [envs * steps / seconds for seconds in stepping[k]],
                "training": [envs * one.horizon * iterations / seconds for seconds in training[k]],
                "physics_per_step": physics[k] / (repeats * steps),
                "horizon": one.horizon,
                "cuda_graphs": one.cuda_graphs,
            }
            for k, one in enumerate(tasks)
        ]


def _train_blocks(task: str, envs: int, iterations: int, repeats: int) -> tuple[list[float], int]:
    """Time of each block [s] and the horizon; one of several processes that synchronize."""
    rank = int(os.environ.get("LOCAL_RANK", "0"))
    one = BenchTask(task, envs=envs, device=f"cuda:{rank}", seed=1 + rank)
    seconds = [one.train(iterations) for _ in range(repeats)]
    one.close()
    return seconds, one.horizon


def _launch(gpus: Sequence[str], *arguments: Any) -> Any:
    """Run `_train_blocks` in one process on each GPU; returns the result of the first."""
    import torchrunx

    launcher = torchrunx.Launcher(
        hostnames=["localhost"],
        workers_per_host=len(gpus),
        backend=None,  # rsl_rl joins the processes itself
        copy_env_vars=(*torchrunx.DEFAULT_ENV_VARS_FOR_COPY, "MUJOCO*", "MJLAB*", "WARP*"),
        extra_env_vars={"CUDA_VISIBLE_DEVICES": ",".join(gpus)},
    )
    launcher.set_logging_handlers(None)
    return launcher.run(_train_blocks, *arguments).rank(0)


def _device_name(device: str) -> str:
    import torch

    return machine()["processor"] if device == "cpu" else torch.cuda.get_device_name(device)


def rate_table(found: dict[str, Any]) -> Table:
    """Rates of both tasks and their ratios."""
    version, blocks = found["machine"], found["blocks"]
    captured = all(one["cuda_graphs"] for pair in found["pairs"] for one in pair)
    blocks_note = (
        f"{blocks['repeats']} blocks of {blocks['steps']} steps and of {blocks['iterations']} "
        "iterations for each task, in turn; the ratio is of neighbouring blocks. Stepping: small "
        "random actions, nothing but the environment. Training: the task's own networks and PPO, "
        "with logging, without checkpoints."
    )
    machine_note = (
        f"{version['device']}, "
        f"{'with' if captured else 'WITHOUT'} CUDA graphs, pronk's task "
        f"{'compiled' if found.get('compiled') else 'not compiled'}, mjlab {version['mjlab']}, "
        f"MuJoCo Warp {version['mujoco-warp']}, rsl_rl {version['rsl-rl-lib']}, "
        f"PyTorch {version['torch']}; "
        f"{found['seconds']:.0f} s in all."
    )

    def rate(rates: Sequence[float]) -> str:
        thousands = np.array(rates) / 1e3
        return spread((float(np.median(thousands)), thousands.min(), thousands.max()), 1)

    title = "Environment steps per second, in thousands: median (slowest to fastest block)"
    columns = [Column(heading="environments"), Column(heading="what")]
    for task_rates in found["pairs"][0]:
        columns.append(Column(heading=task_rates["task"]))
    columns.append(Column(heading="ratio"))
    rows: list[tuple[Cell, ...]] = []
    for pair, ratios in zip(found["pairs"], found["ratios"], strict=True):
        for what, ratio in ratios.items():
            task_cells = [rate(task_rates[what]) for task_rates in pair]
            rows.append((f"{pair[0]['envs']:,}", what, *task_cells, spread(ratio)))
        physics_cells = [f"{task_rates['physics_per_step']:.2f}" for task_rates in pair]
        rows.append(("", "physics steps a step", *physics_cells, ""))
    for count, rates in found["scaling"].items():
        times = f"x{np.median(rates) / np.median(found['scaling'][1]):.2f}"
        envs = f"{found['pairs'][0][0]['envs']:,} each"
        rows.append((envs, f"training, GPUs: {count}", rate(rates), "", times))
    return Table(
        title=title, columns=tuple(columns), rows=tuple(rows), notes=(blocks_note, machine_note)
    )


def train(
    envs: str = "4096,16384",
    steps: int = 50,
    iterations: int = 1,
    repeats: int = 4,
    device: str = "auto",
    gpu_ids: str = "0",
    compile: bool = False,
) -> console.Outcome:
    """Steps per second of the jump task and of mjlab's own Go1 task.

    Args:
        envs: Numbers of environments.
        steps: Steps in a block of stepping.
        iterations: Iterations in a block of training.
        repeats: Blocks of each task, taken in turn.
        device: auto, cuda or cpu (to try it out).
        gpu_ids: GPUs, such as 0,1: training on one and on all of them as well.
        compile: Compile pronk's task, as `pronk train --compile` does.
    """
    counts, gpus = ([word.strip() for word in text.split(",")] for text in (envs, gpu_ids))
    for option, words in (("--envs", counts), ("--gpu-ids", gpus)):
        if not all(word.isdigit() for word in words):
            raise PronkError(f"{option} {','.join(words)}: expected whole numbers, such as 0,1.")
    try:
        import torch
    except ImportError:
        raise PronkError('PyTorch is missing; pip install "pronk[train]".') from None
    on_gpu = torch.cuda.is_available() if device == "auto" else device == "cuda"
    begin = time.perf_counter()

    def line(text: str) -> None:
        console.note(f"{time.perf_counter() - begin:6.1f} s  {text}")

    found = run(
        line,
        envs=[int(word) for word in counts],
        steps=steps,
        iterations=iterations,
        repeats=repeats,
        device=f"cuda:{gpus[0]}" if on_gpu else "cpu",
        gpus=gpus if on_gpu else (),
        compiles=compile,
    )
    return finish(found, rate_table(found))
