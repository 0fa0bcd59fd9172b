"""Settings of a training run: everything that its result depends on.

A run that is resumed must be requested the same; what only says how it is watched (logger, save
interval, wall-clock cap) is `WatchSettings` and may differ.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

from pronk.errors import PronkError

Task = Literal["walk", "jump", "all", "together"]
Gains = Literal["naive", "matched"]
Device = Literal["cpu", "cuda"]
Logger = Literal["tensorboard", "wandb", "none"]

PHASES_OF: Mapping[str, tuple[str, ...]] = {
    "walk": ("walk",),
    "jump": ("jump_a", "jump_b"),
    "all": ("walk", "jump_a", "jump_b"),
    "together": ("jump_a", "jump_b"),
}
"""The phases of each task, in order."""


@dataclass(frozen=True, kw_only=True)
class TrainSettings:
    """What is trained. Two runs with equal settings and equal machines are the same run."""

    task: Task
    """`walk` is phase 1; `jump` widens a walking policy and is phases 2a and 2b; `all` is both;
    `together` learns to walk and to jump at once, from random weights (the paper's ablation)."""
    gains: Gains
    """Nominal gains: those of the real drives as they are, or those of a `gains.yaml`."""
    gains_sha256: str = ""
    """Hash of the `gains.yaml` that nominals or, for naive gains, ranges and delay come from;
    empty without one."""
    start: str = ""
    """Path of the checkpoint whose policy is widened, for `jump`; else empty."""
    start_sha256: str = ""
    """Its hash."""
    iterations: Mapping[str, int]
    """PPO iterations of each phase of the task."""
    envs: int = 4096
    """Environments on each device."""
    seed: int = 1
    """Process r of several draws from `seed + r`."""
    device: Device = "cuda"
    gpus: int = 1
    """Processes, one a GPU; 1 on `cpu`."""
    ellipsoid: bool = False
    """Gains are drawn from the joint ellipsoid of each group instead of the box."""

    def __post_init__(self) -> None:
        """Refuse what cannot be trained.

        Raises:
            PronkError: A value is unknown or outside its range; the message says what is expected.
        """
        _one_of("task", self.task, get_args(Task))
        _one_of("gains", self.gains, get_args(Gains))
        _one_of("device", self.device, get_args(Device))
        check_iterations(self.task, self.iterations)
        for phase in self.phases:
            if phase not in self.iterations:
                raise PronkError(f"phase {phase} of {self.task} has no number of iterations.")
        if self.envs < 2:
            raise PronkError(f"envs is {self.envs}; expected 2 or more.")
        if not 0 <= self.seed < 2**31:
            raise PronkError(f"seed is {self.seed}; expected 0 to {2**31 - 1}.")
        if self.gpus < 1 or (self.device == "cpu" and self.gpus != 1):
            raise PronkError(f"{self.gpus} processes on {self.device}; expected 1, or GPUs.")
        if bool(self.start) != (self.task == "jump"):
            raise PronkError("jump, and only jump, starts from a walking policy.")

    @property
    def phases(self) -> tuple[str, ...]:
        """The phases, in order."""
        return PHASES_OF[self.task]

    @property
    def total_iterations(self) -> int:
        """PPO iterations of the whole run."""
        return sum(self.iterations.values())


@dataclass(frozen=True, kw_only=True)
class WatchSettings:
    """How a run is watched and kept; nothing here changes what it computes."""

    logger: Logger = "tensorboard"
    save_interval: int = 50
    """Iterations between checkpoints: at most so many are lost to a crash."""
    minutes: float | None = None
    """The run stops at a checkpoint once this wall-clock time is over; None: never."""

    def __post_init__(self) -> None:
        """Refuse values outside their range.

        Raises:
            PronkError: One is; the message says what is expected.
        """
        _one_of("logger", self.logger, get_args(Logger))
        if self.save_interval < 1:
            raise PronkError(f"save interval is {self.save_interval}; expected 1 or more.")
        if self.minutes is not None and not self.minutes > 0.0:
            raise PronkError(f"minutes is {self.minutes:g}; expected more than 0.")


def check_iterations(task: str, iterations: Mapping[str, int]) -> None:
    """Refuse phases that the task does not have, and numbers below 1.

    Args:
        task: One of `PHASES_OF`.
        iterations: By name of the phase; some may be left out.

    Raises:
        PronkError: One sentence that lists the task's phases.
    """
    phases = PHASES_OF[task]
    for phase, count in iterations.items():
        if phase not in phases:
            raise PronkError(f"{task} has no phase {phase!r}; its phases are {', '.join(phases)}.")
        if count < 1:
            raise PronkError(f"phase {phase} has {count} iterations; expected 1 or more.")


def _one_of(what: str, got: str, known: tuple[str, ...]) -> None:
    if got not in known:
        raise PronkError(f"{what} {got!r}; expected one of {', '.join(known)}.")
