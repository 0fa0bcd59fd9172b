"""One mjlab task, built and warm: steps of its environment, iterations of its training, stages.

Environment, networks, PPO settings and runner are those registered with mjlab. Only uploads and
checkpoints are off; TensorBoard is written to a temporary folder.

For the stages, methods of the environment and the runner are wrapped on the instance and unwrapped
afterwards. Time and operations belong to the innermost stage. On a GPU the device is waited for at
every border of a stage, which takes away the overlap of host and device: the stages of a step add
up to more than a step takes.
"""

from __future__ import annotations

import gc
import io
import os
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import asdict, dataclass
from functools import wraps
from typing import Any

from rich.console import Console

from pronk.errors import PronkError

ACTION_STD = 0.1
"""Standard deviation of the random actions that step the environment."""
ACTIONS = 16
"""Random actions drawn beforehand and used in turn."""
COUNTED = 5
"""Steps in which operations are counted."""
REST = "rest"
"""The stage of everything that belongs to no other."""

Part = tuple[Any, str, str]
"""An object, the name of one of its methods, and the stage that the method belongs to."""


@dataclass(frozen=True, kw_only=True)
class StageCost:
    """Cost of one stage in a step of the environment, or in an iteration of training."""

    stage: str
    milliseconds: float
    """Wall time [ms]."""
    operations: float
    """PyTorch operations that compute or copy something: on a GPU, about as many launches."""
    waits: float
    """Times that the host waits for a result of the device."""


class Stages:
    """Time spent in each stage, and the present stage."""

    def __init__(
        self,
        *,
        wait: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Begin with nothing measured; `wait` returns when the device is done."""
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.present = REST
        self._wait, self._clock, self._since = wait, clock, 0.0

    @contextmanager
    def measured(self, parts: Iterable[Part]) -> Iterator[None]:
        """Measure while the block runs; methods that an object lacks are left out."""
        wrapped = []
        try:
            for owner, name, stage in parts:
                if hasattr(owner, name):
                    wrapped.append((owner, name, vars(owner).get(name)))
                    setattr(owner, name, self._timed(getattr(owner, name), stage))
            self._wait()
            self._since = self._clock()
            yield
            self._enter(REST)
        finally:
            for owner, name, before in reversed(wrapped):
                delattr(owner, name)
                if before is not None:
                    setattr(owner, name, before)

    def _timed(self, method: Callable[..., Any], stage: str) -> Callable[..., Any]:
        @wraps(method)
        def timed(*args: Any, **kwargs: Any) -> Any:
            before = self._enter(stage)
            try:
                return method(*args, **kwargs)
            finally:
                self._enter(before)

        return timed

    def _enter(self, stage: str) -> str:
        """Book the time since the last border, and change the stage; returns the one before."""
        self._wait()
        now, before = self._clock(), self.present
        self.seconds[before] += now - self._since
        self._since, self.present = now, stage
        return before


@contextmanager
def counted(stages: Stages, device: str = "cpu") -> Iterator[tuple[Counter[str], Counter[str]]]:
    """Count operations and host waits by stage while the block runs.

    Views are no operations. A wait is an operation whose result decides a shape or becomes a
    number of Python (`nonzero`, `item`, an index by a mask), or a copy to the host. What Warp
    launches is not counted.

    Args:
        stages: Gives the present stage.
        device: Only operations on it count as waits.

    Yields:
        Operations and waits by stage.
    """
    from torch.utils._python_dispatch import TorchDispatchMode

    operations: Counter[str] = Counter()
    waits: Counter[str] = Counter()
    kind = device.partition(":")[0]

    class Count(TorchDispatchMode):
        def __torch_dispatch__(
            self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
        ) -> Any:
            aliases = [returned.alias_info for returned in func._schema.returns]
            if not any(alias is not None and not alias.is_write for alias in aliases):
                operations[stages.present] += 1
                waits[stages.present] += _waits(func, args, kwargs or {}, kind)
            return func(*args, **(kwargs or {}))

    mode: Any = Count
    with mode():
        yield operations, waits


_WAITING = frozenset({"nonzero", "_local_scalar_dense", "item", "is_nonzero", "masked_select"})
_INDEXING = frozenset({"index", "index_put", "index_put_", "_index_put_impl_"})


def _waits(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any], kind: str) -> bool:
    """True if the host must wait for the device to know an operation's result."""
    import torch

    name = func._schema.name.removeprefix("aten::")
    if name in _INDEXING:
        masks = (torch.bool, torch.uint8)
        read = [index for index in args[1] if index is not None and index.dtype in masks]
    elif name == "_to_copy":
        to = kwargs.get("device")
        read = [args[0]] if to is not None and torch.device(to).type != kind else []
    else:
        read = [args[0]] if name in _WAITING else []
    return any(tensor.device.type == kind for tensor in read)


def step_parts(env: Any) -> list[Part]:
    """The stages of one step of an unwrapped mjlab environment."""
    return [
        (env.action_manager, "process_action", "actions"),
        (env.action_manager, "apply_action", "actions"),
        (env.scene, "write_data_to_sim", "actuators and write"),
        (env.sim, "step", "physics"),
        (env.scene, "update", "scene update"),
        (env.metrics_manager, "compute_substep", "metrics"),
        (env.metrics_manager, "compute", "metrics"),
        (env.termination_manager, "compute", "terminations"),
        (env.reward_manager, "compute", "rewards"),
        (env.event_manager, "apply", "events and reset"),
        (env, "_reset_idx", "events and reset"),
        (env.sim, "forward", "forward"),
        (env.command_manager, "compute", "commands"),
        (env.sim, "sense", "sense"),
        (env.observation_manager, "compute", "observations"),
    ]


def iteration_parts(runner: Any) -> list[Part]:
    """The stages of one iteration of an rsl_rl runner; its environment is one stage."""
    episodes = getattr(runner, "_episodes", None)
    return [
        (runner.env, "step", "environment"),
        (runner.alg, "act", "inference"),
        (runner.alg, "process_env_step", "storage and normalizers"),
        (runner.alg.actor, "learn_normalization", "storage and normalizers"),
        (runner.alg.critic, "learn_normalization", "storage and normalizers"),
        (runner.logger, "process_env_step", "logging"),
        (runner.logger, "log", "logging"),
        (episodes, "step", "logging"),
        (episodes, "figures", "logging"),
        (runner, "_write_figures", "logging"),
        (runner.alg, "compute_returns", "advantages"),
        (runner.alg, "update", "PPO update"),
        (runner.alg, "_update_estimator", "estimator update"),
    ]


class BenchTask:
    """A task at one number of environments on one device.

    The environment must be stepped before the task is trained: rsl_rl rolls out in inference mode,
    and the tensors of that mode cannot be stepped outside of it.
    """

    def __init__(self, task: str, *, envs: int, device: str, seed: int = 1) -> None:
        """Build environment and runner as mjlab's `train` does, and step until warm.

        Args:
            task: Its name with mjlab.
            envs: Number of environments.
            device: `cpu` or `cuda:0`, `cuda:1` and so on.
            seed: Of environment and networks.

        Raises:
            PronkError: mjlab has no such task.
        """
        # mjlab reads this when it is imported first.
        os.environ.setdefault("MJLAB_WARP_QUIET", "1")
        import torch

        self.task, self.envs, self.device = task, envs, device
        self.build_s = 0.0
        """Time to build, compile and warm up [s]."""
        self.memory_mb = 0.0
        """Memory of the device for this task [MB]; NaN on `cpu`."""
        self._folder = tempfile.TemporaryDirectory(prefix="pronk-bench-")
        with self._building(), redirect_stdout(io.StringIO()):
            self.env, self.runner = _build(task, envs, device, seed, self._folder.name)
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

    @contextmanager
    def _building(self) -> Iterator[None]:
        begin, used = time.perf_counter(), _device_memory(self.device)
        yield
        self._wait()
        self.build_s += time.perf_counter() - begin
        self.memory_mb += (_device_memory(self.device) - used) / 2.0**20

    @property
    def physics_steps(self) -> int:
        """Physics steps of every environment since it was built."""
        return int(self.env._sim_step_counter)

    def step(self, steps: int) -> float:
        """Step the environments with small random actions; returns the wall time [s]."""
        import torch

        with torch.no_grad():
            self._wait()
            begin = time.perf_counter()
            for k in range(steps):
                self.env.step(self._actions[k % ACTIONS])
            self._wait()
            return time.perf_counter() - begin

    def warm_up(self) -> None:
        """Train the first iteration."""
        with self._building():
            self.train(1)
        # The writer stays open from one block of iterations to the next.
        self.runner.logger.init_logging_writer = lambda: None

    def train(self, iterations: int) -> float:
        """Train on, logging included; returns the wall time [s]."""
        with redirect_stdout(io.StringIO()):
            self._wait()
            begin = time.perf_counter()
            self.runner.learn(iterations)
            self._wait()
            return time.perf_counter() - begin

    def step_costs(self, steps: int) -> tuple[StageCost, ...]:
        """Cost of each stage of a step, timed over `steps`."""
        return self._costs(step_parts(self.env), self.step, steps, COUNTED)

    def iteration_costs(self) -> tuple[StageCost, ...]:
        """Cost of each stage of an iteration."""
        return self._costs(iteration_parts(self.runner), self.train, 1, 1)

    def _costs(
        self, parts: list[Part], work: Callable[[int], float], timed: int, counts: int
    ) -> tuple[StageCost, ...]:
        stages, counting = Stages(wait=self._wait), Stages()
        with stages.measured(parts):
            work(timed)
        with counting.measured(parts), counted(counting, self.device) as (operations, waits):
            work(counts)
        return tuple(
            StageCost(
                stage=name,
                milliseconds=1e3 * stages.seconds[name] / timed,
                operations=operations[name] / counts,
                waits=waits[name] / counts,
            )
            for name in [*(name for name in stages.seconds if name != REST), REST]
        )

    def close(self) -> None:
        """Release environment, runner, memory and folder."""
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
    """Memory of the device in use by all processes [bytes]; NaN on `cpu`."""
    if device == "cpu":
        return float("nan")
    import torch

    free, total = torch.cuda.mem_get_info(device)
    return float(total - free)
