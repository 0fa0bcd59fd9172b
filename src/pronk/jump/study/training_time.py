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
"""The same with `--compile`: one alone on its GPU and fifteen at once on the three others of the same
host (docs/evidence/training.md, "Speed of one training")."""
START_S = (40.0, 146.0)
"""Time of a training in which it takes no steps: building, compiling, checkpoints, export [s]. Of
three on one H200 it was 36 to 41 s, of sixteen on four H200 146 s (1,366 s in all, less 1,220 s at
87,000 steps/s); docs/evidence/results.md."""
SOURCE = "docs/evidence/results.md, many trainings at once"


@dataclass(frozen=True, kw_only=True)
class TrainingSize:
    """How much one training computes."""

    env_steps: float
    """Environment steps: policy steps of all robots."""
    envs: int
    """Number of robots."""

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


def training_rate(count: int) -> float:
    """Return the rate of each training of 4,096 robots where some run on one GPU [steps/s].

    Between measured numbers the rate of all together is interpolated. More than were measured are
    taken to reach together what the most that were measured reach.

    Args:
        count: Number of trainings on the GPU, 1 or more.
    """
    numbers = sorted(RATES)
    together = [number * RATES[number] for number in numbers]
    return float(np.interp(count, numbers, together)) / count


def training_time(trainings: Sequence[TrainingSize], gpus: int, per_gpu: int) -> TrainingTime:
    """Return the time that trainings take.

    Args:
        trainings: The trainings in the order in which they start; one or more.
        gpus: Number of GPUs, 1 or more.
        per_gpu: Most trainings on one GPU at once, 1 or more.
    """
    low_steps = [training.bounds[0] for training in trainings]
    high_steps = [training.bounds[1] for training in trainings]
    return TrainingTime(
        low_s=_wall_time(low_steps, gpus, per_gpu, START_S[0]),
        high_s=_wall_time(high_steps, gpus, per_gpu, START_S[1]),
        gpus=gpus,
        per_gpu=per_gpu,
    )


def _wall_time(steps: Sequence[float], gpus: int, per_gpu: int, start_s: float) -> float:
    """Return the time until the last of some trainings is over [s].

    Args:
        steps: Steps of 4,096 robots that each takes, in the order in which they start.
        gpus: Number of GPUs.
        per_gpu: Most trainings on one GPU at once.
        start_s: Time of each in which it takes no steps, at its beginning [s].
    """
    waiting = list(steps)
    # Of each training that runs: the time until it steps [s], and the steps that are left.
    running: list[list[list[float]]] = [[] for _ in range(gpus)]
    now = 0.0
    while waiting or any(running):
        while waiting and min(len(trainings) for trainings in running) < per_gpu:
            gpu = min(running, key=len)
            gpu.append([start_s, waiting.pop(0)])
        # The time until something changes: a training begins to step, or is over.
        interval = math.inf
        for trainings in running:
            for until_steps, steps_to_go in trainings:
                remaining = steps_to_go / training_rate(len(trainings))
                interval = min(interval, until_steps if until_steps > 0.0 else remaining)
        now += interval
        for trainings in running:
            rate = training_rate(len(trainings)) if trainings else 0.0
            for training in trainings:
                if training[0] > 0.0:
                    training[0] = _less(training[0], interval)
                else:
                    training[1] = _less(training[1], interval * rate)
            trainings[:] = [training for training in trainings if max(training) > 0.0]
    return now


def _less(amount: float, taken: float) -> float:
    """Return what is left of an amount; nothing if that is within rounding."""
    difference = amount - taken
    return difference if difference > 1e-9 * amount else 0.0
