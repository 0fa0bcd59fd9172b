"""One mjlab task, built and warm: steps of its environment and iterations of its own training.

Everything of a task is its own: environment, networks, PPO settings and runner, as registered with
mjlab. Only what leaves the machine or writes checkpoints is off: TensorBoard is written to a
folder that is thrown away, nothing is uploaded, nothing is saved.
"""

from __future__ import annotations

import gc
import io
import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import asdict
from typing import Any

from rich.console import Console

from benchmarks.train_stages import StageCost, Stages, costs, counted, iteration_parts, step_parts
from pronk.errors import PronkError

ACTION_STD = 0.1
"""Standard deviation of the random actions that step the environment."""
_ACTIONS = 16
"""Random actions drawn beforehand and used in turn, so that drawing them takes no time."""
_COUNTED = 5
"""Steps in which operations are counted."""


class Contender:
    """A task at one number of environments on one device.

    First the environment is stepped alone, then the task is trained: rsl_rl rolls out in inference
    mode, and what that leaves in an environment cannot be stepped outside of it.
    """

    def __init__(self, task: str, *, envs: int, device: str, seed: int = 1) -> None:
        """Build the environment and the runner, and step the environment until it is warm.

        Args:
            task: Its name with mjlab.
            envs: Number of environments.
            device: `cpu` or `cuda:0`, `cuda:1` and so on.
            seed: Of environment and networks.

        Raises:
            PronkError: mjlab knows no such task.
        """
        # mjlab reads this when it is imported first.
        os.environ.setdefault("MJLAB_WARP_QUIET", "1")
        import torch

        self.task, self.envs, self.device = task, envs, device
        self.build_s = 0.0
        """Time spent in building and warming up [s]."""
        self.memory_mb = 0.0
        """What the device has given to this task [MB]; NaN on `cpu`."""
        self._folder = tempfile.TemporaryDirectory(prefix="pronk-bench-")
        with self._becoming(), redirect_stdout(io.StringIO()):
            self.env, self.runner = _build(task, envs, device, seed, self._folder.name)
            self.runner.save = lambda *_, **__: None
            self.runner.console = Console(file=io.StringIO())
            shape = (_ACTIONS, envs, self.env.action_manager.total_action_dim)
            self._actions = ACTION_STD * torch.randn(shape, device=device)
            # Episodes end all over the time, as they do in training.
            self.env.episode_length_buf = torch.randint_like(
                self.env.episode_length_buf, high=int(self.env.max_episode_length)
            )
            self.step(2 * _ACTIONS)

    @contextmanager
    def _becoming(self) -> Iterator[None]:
        """Book time and memory of the block."""
        begin, used = time.perf_counter(), _device_memory(self.device)
        yield
        self._wait()
        self.build_s += time.perf_counter() - begin
        self.memory_mb += (_device_memory(self.device) - used) / 2.0**20

    @property
    def cuda_graphs(self) -> bool:
        """Whether the simulation runs as captured graphs."""
        return bool(self.env.sim.use_cuda_graph)

    @property
    def physics_steps(self) -> int:
        """Physics steps of every environment since it was built."""
        return int(self.env._sim_step_counter)

    @property
    def horizon(self) -> int:
        """Steps of every environment in one iteration of training."""
        return int(self.runner.cfg["num_steps_per_env"])

    def step(self, steps: int) -> float:
        """Step the environments with small random actions.

        Args:
            steps: How often.

        Returns:
            Wall time until the device is done [s].
        """
        import torch

        with torch.no_grad():
            self._wait()
            begin = time.perf_counter()
            for k in range(steps):
                self.env.step(self._actions[k % _ACTIONS])
            self._wait()
            return time.perf_counter() - begin

    def warm_up(self) -> None:
        """Train the first iteration, before any that is timed."""
        with self._becoming():
            self.train(1)
        # The writer stays open from one block of iterations to the next.
        self.runner.logger.init_logging_writer = lambda: None

    def train(self, iterations: int) -> float:
        """Train on, logging included.

        Args:
            iterations: How many.

        Returns:
            Wall time until the device is done [s].
        """
        with redirect_stdout(io.StringIO()):
            self._wait()
            begin = time.perf_counter()
            self.runner.learn(iterations)
            self._wait()
            return time.perf_counter() - begin

    def step_costs(self, steps: int) -> tuple[StageCost, ...]:
        """What each stage of a step costs.

        Args:
            steps: Steps to time.
        """
        stages = Stages(wait=self._wait)
        parts = step_parts(self.env)
        with stages.measured(parts):
            self.step(steps)
        seen = Stages()
        with seen.measured(parts), counted(seen, self.device) as (operations, waits):
            self.step(_COUNTED)
        return costs(steps, stages, operations, waits, _COUNTED)

    def iteration_costs(self) -> tuple[StageCost, ...]:
        """What each stage of an iteration costs."""
        stages = Stages(wait=self._wait)
        parts = iteration_parts(self.runner)
        with stages.measured(parts):
            self.train(1)
        seen = Stages()
        operations: Counter[str]
        with seen.measured(parts), counted(seen, self.device) as (operations, waits):
            self.train(1)
        return costs(1, stages, operations, waits, 1)

    def close(self) -> None:
        """Give everything back: what is left of the task is its figures."""
        if self.runner.logger.writer is not None:
            self.runner.logger.writer.close()
        self.env.close()
        del self.env, self.runner, self._actions
        self._folder.cleanup()
        gc.collect()
        if self.device != "cpu":
            import torch

            torch.cuda.empty_cache()

    def _wait(self) -> None:
        if self.device != "cpu":
            import torch

            torch.cuda.synchronize(self.device)


def _build(task: str, envs: int, device: str, seed: int, folder: str) -> tuple[Any, Any]:
    """Environment and runner of a task, as mjlab's own `train` builds them."""
    import mjlab.tasks  # noqa: F401 - registers mjlab's own
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
    from mjlab.tasks.registry import list_tasks, load_env_cfg, load_rl_cfg, load_runner_cls
    from mjlab.utils.torch import configure_torch_backends

    import pronk.train.tasks  # noqa: F401 - registers pronk's

    if task not in list_tasks():
        raise PronkError(f"mjlab knows no task {task!r}; it knows {', '.join(list_tasks())}.")
    configure_torch_backends()
    env_cfg, rl_cfg = load_env_cfg(task), load_rl_cfg(task)
    env_cfg.scene.num_envs = envs
    env_cfg.seed = rl_cfg.seed = seed
    rl_cfg.logger, rl_cfg.upload_model = "tensorboard", False
    env = ManagerBasedRlEnv(cfg=env_cfg, device=device)
    wrapped = RslRlVecEnvWrapper(env, clip_actions=rl_cfg.clip_actions)
    runner_class = load_runner_cls(task) or MjlabOnPolicyRunner
    return env, runner_class(wrapped, asdict(rl_cfg), folder, device)


def _device_memory(device: str) -> float:
    """Memory of the device in use, by anybody [bytes]; NaN on `cpu`."""
    if device == "cpu":
        return float("nan")
    import torch

    free, total = torch.cuda.mem_get_info(device)
    return float(total - free)
