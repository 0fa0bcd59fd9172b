"""Settings of `pronk train`; its command line has the same fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import msgspec
import tyro

from pronk.errors import PronkError
from pronk.jump.train.hosts import parse_hosts
from pronk.jump.train.phases import TASKS

if TYPE_CHECKING:
    from pronk.jump.train.gains import TrainingGains
    from pronk.robots.robot import RobotSpec

WEAKEST_DRIVE = 0.3
"""Smallest share of its torque that a drive may be drawn with: with less a robot cannot stand."""


class StoredSettings(msgspec.Struct, kw_only=True):
    """Types of `TrainSettings.stored_values`.

    Runs of earlier versions had no recipes, groups of joints alone, full drives, and no joints that
    are no match.
    """

    task: Literal["walk", "jump", "all", "together"]
    robot: str
    gains: str
    ranges_from: str | None
    init_checkpoint: str | None
    envs: int
    seed: int
    ellipsoid: bool
    phase: list[str]
    by_joint: bool = False
    weakest_drive: float = 1.0
    recipe: str | list[str] | None = None
    allow_unmatched: bool = False


@dataclass(frozen=True, kw_only=True)
class DeviceSettings:
    """The devices that a run computes on."""

    device: Literal["auto", "cpu", "cuda"] = "auto"
    """auto: a GPU if there is one; the CPU is for tests."""
    gpu_ids: str | None = None
    """GPUs of this host, or of each of --hosts, as in 0,1, or all; 0."""
    hosts: str | None = None
    """Machines to train on together, over SSH, as in node1,node2; this one alone. The first has
    process 0, which writes the run. All share --out."""
    compile: bool = False
    """Compile rewards, networks and losses with torch.compile, and record what a step computes
    as CUDA graphs: faster on a GPU. Numbers round otherwise; compiling takes time at first."""

    def __post_init__(self) -> None:
        """Refuse names that are no hosts."""
        _ = self.host_names

    @property
    def host_names(self) -> tuple[str, ...]:
        """The names in `hosts`; empty if it was left out."""
        return () if self.hosts is None else parse_hosts(self.hosts)


@dataclass(frozen=True, kw_only=True)
class DrawSettings:
    """How the robots differ in their drives. None: left out."""

    ellipsoid: bool | None = None
    """Draw gains from each group's ellipsoid, or its box; box."""
    by_joint: bool | None = None
    """Draw each joint about its own gains, with friction and delay, by their intervals in
    gains.yaml, or about those of its group; group."""
    weakest_drive: float | None = None
    """Draw the torque of each robot's drives from this share of nominal to all of it; 1."""

    def __post_init__(self) -> None:
        """Refuse values out of range and options that do not go together."""
        if self.ellipsoid and self.by_joint:
            raise PronkError(
                "--ellipsoid and --by-joint: the ellipsoid is that of a group; give one of them."
            )
        weakest = self.weakest_drive
        if weakest is not None and not WEAKEST_DRIVE <= weakest <= 1.0:
            raise PronkError(f"--weakest-drive is {weakest:g}; expected {WEAKEST_DRIVE:g} to 1.")


@dataclass(frozen=True, kw_only=True)
class SessionSettings:
    """Settings of one session, which do not decide the result of a run."""

    save_interval: int = 50
    """Iterations between checkpoints."""
    minutes: float | None = None
    """Stop at a checkpoint after so long; --resume goes on from there."""
    logger: Literal["tensorboard", "wandb"] = "tensorboard"
    """Where the curves go."""


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
    # The command line has this option beside these settings, since it may be repeated there.
    gains: Annotated[str | None, tyro.conf.Fixed, tyro.conf.Suppress] = None
    """gains.yaml of `pronk match`, or naive: the nominal gains of the real drives."""
    ranges_from: Path | None = None
    """With naive gains: the gains.yaml whose ranges and delay are used."""
    allow_unmatched: bool | None = None
    """Train with gains of joints that are no match too; the policy is marked."""
    init_checkpoint: Path | None = None
    """jump: folder of a walking run, or one of its checkpoints."""
    envs: int | None = None
    """Robots of each process, which has one GPU; 4096."""
    seed: int | None = None
    """Seed of all draws; 1. Process r of several draws from seed + r."""
    phase: tuple[str, ...] = ()
    """PHASE=ITERATIONS, as in walk=300, for walk, jump_a or jump_b; repeat it."""
    draws: Annotated[DrawSettings, tyro.conf.arg(name="")] = field(default_factory=DrawSettings)
    recipe: tuple[Path, ...] = ()
    """YAML file with changed weights of rewards, as those in examples/recipes. Repeat it for
    layers: what a later file names takes precedence, phase by phase."""
    devices: Annotated[DeviceSettings, tyro.conf.arg(name="")] = field(
        default_factory=DeviceSettings
    )
    resume: bool = False
    """Continue the run in --out; options left out are those of the run."""
    session: Annotated[SessionSettings, tyro.conf.arg(name="")] = field(
        default_factory=SessionSettings
    )

    def __post_init__(self) -> None:
        """Refuse values out of range and options that do not go together."""
        self._check_whole_number("envs", self.envs, minimum=2)
        self._check_whole_number("seed", self.seed, minimum=0)
        self._check_whole_number("save-interval", self.session.save_interval, minimum=1)
        minutes = self.session.minutes
        if minutes is not None and not minutes > 0.0:
            raise PronkError(f"--minutes is {minutes:g}; expected more than 0.")
        if self.ranges_from is not None and self.gains not in (None, "naive"):
            raise PronkError(
                f"--ranges-from {self.ranges_from} goes with --gains naive; {self.gains} has its "
                "own ranges."
            )
        if self.draws.by_joint and self.gains == "naive" and self.ranges_from is None:
            raise PronkError(
                "--by-joint draws by the intervals of a gains.yaml; give --ranges-from with "
                "--gains naive, or leave it out."
            )
        if self.init_checkpoint is not None and self.task != "jump":
            raise PronkError(
                f"--init-checkpoint {self.init_checkpoint} goes with jump; {self.task} begins with "
                "random weights."
            )
        if len(set(self.recipe)) != len(self.recipe):
            raise PronkError(
                f"--recipe {', '.join(map(str, self.recipe))}: one is given twice; once is enough."
            )
        _ = self.iterations  # checks the phases

    def _check_whole_number(self, option: str, value: int | None, minimum: int) -> None:
        """Refuse a number out of range."""
        if value is not None and not minimum <= value < 2**31:
            raise PronkError(f"--{option} is {value}; expected {minimum} or more, below 2^31.")

    @property
    def iterations(self) -> Mapping[str, int]:
        """PPO iterations of each phase; `walk` of the task jump is those of the walking policy."""
        iterations = dict(TASKS[self.task])
        allowed = [name for name, count in iterations.items() if count > 0]
        if self.task == "jump":
            allowed.remove("walk")
        changed: set[str] = set()
        for entry in self.phase:
            name, _, count = entry.partition("=")
            if not (name and count.isdigit()):
                raise PronkError(f"--phase {entry!r}: expected PHASE=ITERATIONS, as in walk=300.")
            if name not in allowed:
                raise PronkError(
                    f"{self.task} has no phase {name!r}; its phases are {', '.join(allowed)}."
                )
            if name in changed:
                raise PronkError(f"--phase {name} is given twice; once is enough.")
            if int(count) < 1:
                raise PronkError(f"phase {name} has {count} iterations; expected 1 or more.")
            changed.add(name)
            iterations[name] = int(count)
        return iterations

    @property
    def gains_file(self) -> Path | None:
        """The gains.yaml that is read, if any."""
        if self.gains in (None, "naive"):
            return self.ranges_from
        return Path(self.gains)

    def training_gains(self, robot: RobotSpec) -> TrainingGains:
        """Return the gains that a new run with these settings trains with.

        Args:
            robot: The robot.

        Raises:
            PronkError: As `pronk.jump.train.gains.training_gains`.
        """
        from pronk.jump.train.gains import NAIVE, training_gains

        return training_gains(
            self.gains or NAIVE,
            robot,
            like=self.ranges_from,
            allow_unmatched=bool(self.allow_unmatched),
            by_joint=bool(self.draws.by_joint),
        )

    def completed(self) -> Self:
        """Return them with the defaults of a new run in place of None.

        Raises:
            PronkError: Something is left out that a new run needs.
        """
        if self.gains is None:
            raise PronkError(
                "a new run needs --gains: the gains.yaml of `pronk match`, or naive for the "
                "nominal gains of the real drives."
            )
        if self.task == "jump" and self.init_checkpoint is None:
            raise PronkError(
                "jump needs --init-checkpoint: the folder of a walking run, or one of its "
                "checkpoints; `pronk train all` does both."
            )
        return replace(
            self,
            robot="mini_cheetah" if self.robot is None else self.robot,
            envs=4096 if self.envs is None else self.envs,
            seed=1 if self.seed is None else self.seed,
            draws=DrawSettings(
                ellipsoid=bool(self.draws.ellipsoid),
                by_joint=bool(self.draws.by_joint),
                weakest_drive=1.0 if self.draws.weakest_drive is None else self.draws.weakest_drive,
            ),
            allow_unmatched=bool(self.allow_unmatched),
        )

    def resumed(self, stored: Mapping[str, Any]) -> Self:
        """Return them with the values of the run that is continued.

        Args:
            stored: `stored_values` of the run.

        Raises:
            PronkError: An option has another value than the run.
        """
        for name, value in self.stored_values().items():
            is_given = value is not None and value != []
            stored_value = stored.get(name)
            if is_given and value != stored_value:
                raise PronkError(
                    f"--resume: --{name.replace('_', '-')} is {_option_text(value)}, but the run "
                    f"in {self.out} has {_option_text(stored_value)}; leave it out to continue "
                    "that run, or give a new --out."
                )
        values = msgspec.convert(stored, StoredSettings)
        return replace(
            self,
            task=values.task,
            robot=values.robot,
            gains=values.gains,
            ranges_from=_optional_path(values.ranges_from),
            init_checkpoint=_optional_path(values.init_checkpoint),
            envs=values.envs,
            seed=values.seed,
            draws=DrawSettings(
                ellipsoid=values.ellipsoid,
                by_joint=values.by_joint,
                weakest_drive=values.weakest_drive,
            ),
            recipe=_recipe_files(values.recipe),
            allow_unmatched=values.allow_unmatched,
            phase=tuple(values.phase),
        )

    def stored_values(self) -> dict[str, Any]:
        """Return what decides the result of a run, as JSON holds it."""
        return {
            "task": self.task,
            "robot": self.robot,
            "gains": self.gains,
            "ranges_from": _optional_text(self.ranges_from),
            "init_checkpoint": _optional_text(self.init_checkpoint),
            "envs": self.envs,
            "seed": self.seed,
            "ellipsoid": self.draws.ellipsoid,
            "by_joint": self.draws.by_joint,
            "weakest_drive": self.draws.weakest_drive,
            "recipe": self._stored_recipe(),
            "allow_unmatched": self.allow_unmatched,
            "phase": list(self.phase),
        }

    def _stored_recipe(self) -> str | list[str] | None:
        """Return the file of the recipe, as earlier versions stored it, or several files."""
        files = [str(path) for path in self.recipe]
        if len(files) > 1:
            return files
        return files[0] if files else None


def _optional_path(text: str | None) -> Path | None:
    """Return a path, or None where there is none."""
    return None if text is None else Path(text)


def _recipe_files(stored: str | list[str] | None) -> tuple[Path, ...]:
    """Return the files of the recipe of a run."""
    if stored is None:
        return ()
    files = [stored] if isinstance(stored, str) else stored
    return tuple(Path(file) for file in files)


def _option_text(value: Any) -> str:
    """Return the value of an option for a message; several with commas between them."""
    if value is None or value == []:
        return "none"
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return str(value)


def _optional_text(path: Path | None) -> str | None:
    """Return a path as text, or None where there is none."""
    return None if path is None else str(path)
