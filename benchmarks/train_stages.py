"""Where a training step goes: time, operations and host waits of each stage.

Methods of a living environment and runner are wrapped on the instance and unwrapped afterwards, so
any mjlab task can be taken apart and the headline figure, taken with nothing wrapped, stays clean.
A stage that is called inside another is not counted twice: time and operations belong to the
innermost stage. On a GPU the device is waited for at every border of a stage, which takes away
the overlap of host and device: the stages of a step add up to more than a step takes.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from typing import Any

REST = "rest"
"""The stage of everything that belongs to no other."""

Part = tuple[object, str, str]
"""An object, the name of one of its methods, and the stage that the method belongs to."""


@dataclass(frozen=True, kw_only=True)
class StageCost:
    """What one stage costs in a step of the environment, or in an iteration of training."""

    stage: str
    milliseconds: float
    """Wall time [ms]."""
    operations: float
    """PyTorch operations that compute or copy something: on a GPU, about as many launches."""
    waits: float
    """Times that the host waits for a result of the device."""


class Stages:
    """Time spent in each stage, and which stage is on."""

    def __init__(
        self,
        *,
        wait: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Begin with nothing measured.

        Args:
            wait: Waits until the device has done what it was told.
            clock: Gives the time [s].
        """
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._wait = wait
        self._clock = clock
        self._on = [REST]
        self._since = 0.0

    @property
    def current(self) -> str:
        """The stage that is on."""
        return self._on[-1]

    @contextmanager
    def measured(self, parts: Iterable[Part]) -> Iterator[None]:
        """Measure while the block runs; the objects are as before when it ends.

        Args:
            parts: Methods and their stages. A method that an object does not have is left out.
        """
        undo: list[Callable[[], None]] = []
        try:
            for owner, name, stage in parts:
                if hasattr(owner, name):
                    undo.append(_replace(owner, name, self._wrapped(getattr(owner, name), stage)))
            self._wait()
            self._since = self._clock()
            yield
            self._charge()
        finally:
            for step in reversed(undo):
                step()

    def _wrapped(self, method: Callable[..., Any], stage: str) -> Callable[..., Any]:
        @wraps(method)
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._charge()
            self._on.append(stage)
            try:
                return method(*args, **kwargs)
            finally:
                self._charge()
                self._on.pop()

        return timed

    def _charge(self) -> None:
        """Write the time since the last border down to the stage that is on."""
        self._wait()
        now = self._clock()
        self.seconds[self.current] += now - self._since
        self._since = now


def _replace(owner: object, name: str, method: Callable[..., Any]) -> Callable[[], None]:
    """Set a method on an instance; gives the way back."""
    before = vars(owner).get(name)
    setattr(owner, name, method)
    if before is None:
        return lambda: delattr(owner, name)
    return lambda: setattr(owner, name, before)


@contextmanager
def counted(stages: Stages, device: str = "cpu") -> Iterator[tuple[Counter[str], Counter[str]]]:
    """Count operations and host waits by stage while the block runs.

    Views are no operations: they compute nothing. A wait is an operation whose result decides a
    shape or becomes a number of Python (`nonzero`, `item`, an index by a mask), or a copy to the
    host: each stops the host until the device has caught up. What Warp launches is not seen.

    Args:
        stages: Says which stage is on.
        device: Only results on it are waited for; numbers on the host are there already.

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
            if not _is_view(func):
                operations[stages.current] += 1
                waits[stages.current] += _waits(func, args, kwargs or {}, kind)
            return func(*args, **(kwargs or {}))

    mode: Any = Count
    with mode():
        yield operations, waits


_WAITING = frozenset({"nonzero", "_local_scalar_dense", "item", "is_nonzero", "masked_select"})
_INDEXING = frozenset({"index", "index_put", "index_put_", "_index_put_impl_"})


def _is_view(func: Any) -> bool:
    """True if what an operation returns is an argument's memory, unchanged."""
    aliases = [returned.alias_info for returned in func._schema.returns]
    return any(alias is not None and not alias.is_write for alias in aliases)


def _waits(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any], kind: str) -> bool:
    """True if the host must wait for the device to know an operation's result."""
    import torch

    name = func._schema.name.removeprefix("aten::")
    if name in _INDEXING:
        masks = (torch.bool, torch.uint8)
        looked_at = [index for index in args[1] if index is not None and index.dtype in masks]
    elif name == "_to_copy":
        to = kwargs.get("device")
        looked_at = [args[0]] if to is not None and torch.device(to).type != kind else []
    else:
        looked_at = [args[0]] if name in _WAITING else []
    return any(tensor.device.type == kind for tensor in looked_at)


def step_parts(env: Any) -> list[Part]:
    """The stages of one step of an mjlab environment.

    Args:
        env: The environment, unwrapped.
    """
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
    """The stages of one iteration of an rsl_rl runner.

    Args:
        runner: The runner; its environment is one stage.
    """
    return [
        (runner.env, "step", "environment"),
        (runner.alg, "act", "inference"),
        (runner.alg, "process_env_step", "storage and normalizers"),
        (runner.alg.actor, "learn_normalization", "storage and normalizers"),
        (runner.alg.critic, "learn_normalization", "storage and normalizers"),
        (runner.logger, "process_env_step", "logging"),
        (runner.logger, "log", "logging"),
        (getattr(runner, "_episodes", None), "step", "logging"),
        (getattr(runner, "_episodes", None), "figures", "logging"),
        (runner, "_write_figures", "logging"),
        (runner.alg, "compute_returns", "advantages"),
        (runner.alg, "update", "PPO update"),
        (runner.alg, "_update_estimator", "estimator update"),
    ]


def costs(
    count: int, stages: Stages, operations: Counter[str], waits: Counter[str], counted_over: int
) -> tuple[StageCost, ...]:
    """Mean costs, the rest last.

    Args:
        count: Steps or iterations that were timed.
        stages: Their times.
        operations: Operations by stage.
        waits: Host waits by stage.
        counted_over: Steps or iterations in which those were counted.
    """
    names = [name for name in stages.seconds if name != REST] + [REST]
    return tuple(
        StageCost(
            stage=name,
            milliseconds=1e3 * stages.seconds[name] / count,
            operations=operations[name] / counted_over,
            waits=waits[name] / counted_over,
        )
        for name in names
    )
