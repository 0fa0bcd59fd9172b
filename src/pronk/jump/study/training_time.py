"""How long the trainings of a study take on GPUs, by rates that were measured on others.

The rates are those of trainings of 4,096 robots on H200 under MPS. Trainings take the GPUs as
`pronk.jump.study.local` gives them out: in their order, each on the GPU with the fewest, and the
rate of all on a GPU changes with their number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

MEASURED_ENVS = 4096
"""Number of robots of the trainings whose rates were measured."""
RATES = {1: 160_000.0, 3: 97_000.0, 4: 87_000.0, 5: 74_000.0}
"""Environment steps/s of each training, by the number of trainings on one H200 under MPS: one alone
(docs/evidence/results.md, `benchmarks train`), twelve and sixteen at once on four H200, and five on
one (the same page, many trainings at once). An environment step is one policy step of one robot."""
COMPILED_RATES = {1: 207_000.0, 5: 83_000.0}
"""The same with `--compile`: one alone on its GPU, and fifteen at once on the three others of the
same host (docs/evidence/training.md, "Speed of one training")."""
START_S = (40.0, 146.0)
"""Time of a training in which it takes no steps: building, compiling, checkpoints, export [s]. Of
three on one H200 it was 36 to 41 s, of sixteen on four H200 146 s (1,366 s in all, less 1,220 s at
87,000 steps/s); docs/evidence/results.md."""
SOURCE = "docs/evidence/results.md, many trainings at once, and training.md"


@dataclass(frozen=True, kw_only=True)
class TrainingSize:
    """How much one training computes."""

    env_steps: float
    """Environment steps: policy steps of all robots."""
    envs: int
    """Number of robots."""
    is_compiled: bool = False
    """Whether it is trained with `--compile`."""

    @property
    def bounds(self) -> tuple[float, float]:
        """Fewest and most steps of 4,096 robots that take as long.

        An iteration of more robots takes at least as long and at most as much longer as there are
        more of them, so that the time is known within these bounds only.
        """
        of_measured = self.env_steps * MEASURED_ENVS / self.envs
        return min(self.env_steps, of_measured), max(self.env_steps, of_measured)


@dataclass(frozen=True, kw_only=True)
class TrainingTime:
    """Estimated time of all trainings of a study."""

    low_s: float
    """Shortest time that the measured rates allow [s]."""
    high_s: float
    """Longest time [s]."""
    gpus: int
    """Number of GPUs."""
    per_gpu: int
    """Most trainings on one GPU at once."""

    @property
    def gpu_hours(self) -> tuple[float, float]:
        """Time for which the GPUs are taken, all of them together [h]."""
        return self.gpus * self.low_s / 3600.0, self.gpus * self.high_s / 3600.0


@dataclass(kw_only=True)
class _Running:
    """A training that has a GPU."""

    start_s: float
    """Time until it takes steps [s]."""
    steps: float
    """Steps of 4,096 robots that are to be taken."""
    is_compiled: bool
    """Whether it is trained with `--compile`."""

    def remaining_s(self, count: int) -> float:
        """Return the time until it begins to step, or else until it is over [s].

        Args:
            count: Number of trainings on its GPU.
        """
        if self.start_s > 0.0:
            return self.start_s
        return self.steps / training_rate(count, is_compiled=self.is_compiled)

    def advance(self, interval_s: float, count: int) -> None:
        """Let time pass, no more than `remaining_s`."""
        if self.start_s > 0.0:
            self.start_s = _less(self.start_s, interval_s)
        else:
            rate = training_rate(count, is_compiled=self.is_compiled)
            self.steps = _less(self.steps, interval_s * rate)


def training_rate(count: int, *, is_compiled: bool = False) -> float:
    """Return the rate of each training of 4,096 robots where some run on one GPU [steps/s].

    Between measured numbers the rate of all together is interpolated. More than were measured are
    taken to reach together what the most that were measured reach.

    Args:
        count: Number of trainings on the GPU, 1 or more.
        is_compiled: Whether they are trained with `--compile`.
    """
    rates = COMPILED_RATES if is_compiled else RATES
    numbers = sorted(rates)
    together = [number * rates[number] for number in numbers]
    return float(np.interp(count, numbers, together)) / count


def training_time(trainings: Sequence[TrainingSize], gpus: int, per_gpu: int) -> TrainingTime:
    """Return the time that trainings take.

    Args:
        trainings: The trainings in the order in which they start; one or more.
        gpus: Number of GPUs, 1 or more.
        per_gpu: Most trainings on one GPU at once, 1 or more.
    """
    return TrainingTime(
        low_s=_wall_time(trainings, gpus, per_gpu, bound=0),
        high_s=_wall_time(trainings, gpus, per_gpu, bound=1),
        gpus=gpus,
        per_gpu=per_gpu,
    )


def _wall_time(sizes: Sequence[TrainingSize], gpus: int, per_gpu: int, *, bound: int) -> float:
    """Return the time until the last of some trainings is over [s].

    Args:
        sizes: The trainings in the order in which they start.
        gpus: Number of GPUs.
        per_gpu: Most trainings on one GPU at once.
        bound: 0 for as few steps, and as short a start, as each may take, 1 for as many and as
            long.
    """
    waiting = []
    for size in sizes:
        waiting.append(
            _Running(start_s=START_S[bound], steps=size.bounds[bound], is_compiled=size.is_compiled)
        )
    gpu_trainings: list[list[_Running]] = [[] for _ in range(gpus)]
    now = 0.0
    while waiting or any(gpu_trainings):
        while waiting and min(len(running) for running in gpu_trainings) < per_gpu:
            min(gpu_trainings, key=len).append(waiting.pop(0))
        # The time until something changes: a training begins to step, or is over.
        interval = math.inf
        for running in gpu_trainings:
            for training in running:
                interval = min(interval, training.remaining_s(len(running)))
        now += interval
        for running in gpu_trainings:
            count = len(running)
            for training in running:
                training.advance(interval, count)
            running[:] = [training for training in running if training.steps > 0.0]
    return now


def _less(amount: float, taken: float) -> float:
    """Return what is left of an amount; nothing if that is within rounding."""
    difference = amount - taken
    return difference if difference > 1e-9 * amount else 0.0
