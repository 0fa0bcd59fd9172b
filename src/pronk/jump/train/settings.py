"""Settings of `pronk train`; its command line has the same fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self

import tyro

from pronk.errors import PronkError
from pronk.jump.train.phases import TASKS


@dataclass(frozen=True, kw_only=True)
class TrainSettings:
    """Settings of a run. None: left out, so the default or, with `resume`, that of the run."""

    task: tyro.conf.Positional[Literal["walk", "jump", "all", "together"]]
    """walk: phase 1. jump: a walking policy, then phases 2a and 2b. all: both. together: walk and
    jump at once from random weights, the paper's ablation."""
    out: Path
    """Folder of the run, new or empty."""
    robot: str | None = None
    """Name or robot.yaml of a robot with a task; mini_cheetah."""
    gains: str | None = None
    """gains.yaml of `pronk match`, or naive: the gains of the real drives as they are."""
    ranges_from: Path | None = None
    """With naive gains: the gains.yaml whose ranges and delay are used."""
    init_checkpoint: Path | None = None
    """jump: folder of a walking run, or one of its checkpoints."""
    envs: int | None = None
    """Robots on each device; 4096."""
    seed: int | None = None
    """Of all draws; 1. Process r of several draws from seed + r."""
    phase: tuple[str, ...] = ()
    """PHASE=ITERATIONS, as in walk=300, for walk, jump_a or jump_b; repeat it."""
    ellipsoid: bool | None = None
    """Draw gains from each group's ellipsoid, or its box; box."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """auto: a GPU if there is one; the CPU is for tests."""
    gpu_ids: str | None = None
    """GPUs of this host, as in 0,1, or all; 0."""
    resume: bool = False
    """Continue the run in --out; options left out are those of the run."""
    save_interval: int = 50
    """Iterations between checkpoints."""
    minutes: float | None = None
    """Stop at a checkpoint after so long; --resume goes on from there."""
    logger: Literal["tensorboard", "wandb"] = "tensorboard"
    """Where the curves go."""

    def __post_init__(self) -> None:
        """Refuse values out of range and options that do not go together."""
        for option, value, least in (
            ("envs", self.envs, 2),
            ("seed", self.seed, 0),
            ("save-interval", self.save_interval, 1),
        ):
            if value is not None and not least <= value < 2**31:
                raise PronkError(f"--{option} is {value}; expected {least} or more, below 2^31.")
        if self.minutes is not None and not self.minutes > 0.0:
            raise PronkError(f"--minutes is {self.minutes:g}; expected more than 0.")
        if self.ranges_from is not None and self.gains not in (None, "naive"):
            raise PronkError(
                f"--ranges-from {self.ranges_from} goes with --gains naive; {self.gains} has its "
                "own ranges."
            )
        if self.init_checkpoint is not None and self.task != "jump":
            raise PronkError(
                f"--init-checkpoint {self.init_checkpoint} goes with jump; {self.task} begins with "
                "random weights."
            )
        self.iterations  # noqa: B018 (checks them)

    @property
    def iterations(self) -> Mapping[str, int]:
        """PPO iterations of each phase; `walk` of the task jump is those of the walking policy."""
        known = {n: count for n, count in TASKS[self.task].items() if count > 0}
        if self.task == "jump":
            del known["walk"]
        given: dict[str, int] = {}
        for entry in self.phase:
            name, _, count = entry.partition("=")
            if not (name and count.isdigit()):
                raise PronkError(f"--phase {entry!r}: expected PHASE=ITERATIONS, as in walk=300.")
            if name not in known:
                raise PronkError(
                    f"{self.task} has no phase {name!r}; its phases are {', '.join(known)}."
                )
            if name in given:
                raise PronkError(f"--phase {name} is given twice; once is enough.")
            if int(count) < 1:
                raise PronkError(f"phase {name} has {count} iterations; expected 1 or more.")
            given[name] = int(count)
        return {**TASKS[self.task], **given}

    @property
    def gains_file(self) -> Path | None:
        """The gains.yaml that is read, if any."""
        return self.ranges_from if self.gains in (None, "naive") else Path(self.gains)

    def completed(self) -> Self:
        """With the defaults of a new run in place of None; refuses what a new run lacks."""
        if self.gains is None:
            raise PronkError(
                "a new run needs --gains: the gains.yaml of `pronk match`, or naive for the gains "
                "of the real drives as they are."
            )
        if self.task == "jump" and self.init_checkpoint is None:
            raise PronkError(
                "jump needs --init-checkpoint: the folder of a walking run, or one of its "
                "checkpoints; `pronk train all` does both."
            )
        defaults: Mapping[str, Any]
        defaults = {"robot": "mini_cheetah", "envs": 4096, "seed": 1, "ellipsoid": False}
        return replace(self, **{n: v for n, v in defaults.items() if getattr(self, n) is None})

    def resumed(self, stored: Mapping[str, Any]) -> Self:
        """With the values of the run, as of `stored_values`; another value of it is refused."""
        for name, value in self.stored_values().items():
            if value and value != stored[name]:
                raise PronkError(
                    f"--resume: --{name.replace('_', '-')} is {value}, but the run in {self.out} "
                    f"has {'none' if stored[name] is None else stored[name]}; leave it out to "
                    "continue that run, or give a new --out."
                )
        values: dict[str, Any] = {**stored, "phase": tuple(stored["phase"])}
        for name in ("ranges_from", "init_checkpoint"):
            values[name] = values[name] and Path(values[name])
        return replace(self, **values)

    def stored_values(self) -> dict[str, Any]:
        """What decides the result of a run, as JSON holds it."""
        names = ("task", "robot", "gains", "ranges_from", "init_checkpoint", "envs", "seed")
        values = {name: getattr(self, name) for name in (*names, "ellipsoid")}
        stored = {n: str(v) if isinstance(v, Path) else v for n, v in values.items()}
        return {**stored, "phase": list(self.phase)}
