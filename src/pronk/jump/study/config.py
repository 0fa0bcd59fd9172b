"""The file of a study: arms, seeds, robots, outcomes, and comparisons named before the runs.

    schema: pronk/study/1
    title: What a match is worth
    seeds: 1-5
    arms:
      nominal: {gains: naive, ranges_from: gains.yaml}
      matched: {gains: gains.yaml}
    robots:
      shipped: {}
      weak: {changes: [{parameters: [joints.torque_scale], factor: 0.7}]}
    outcomes: [landed, height, distance]
    comparisons:
      a match: {outcome: landed, arm: matched, against: nominal, robots: [shipped]}
      a match forwards: {outcome: distance, arm: matched, against: nominal, commands: ["2,0"]}

Paths are relative to the file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pronk.errors import ArtefactError, PronkError
from pronk.files import converted, read_yaml
from pronk.jump.study.outcomes import OUTCOMES
from pronk.jump.study.trainings import parse_seeds
from pronk.jump.train.phases import TASKS
from pronk.jump.trial.conditions import Change
from pronk.jump.trial.protocol import Case, parse_cases
from pronk.names import check_names

SCHEMA = "pronk/study/1"


@dataclass(frozen=True, kw_only=True)
class RandomizationConfig:
    """Half-widths of the range of each joint group's gains, relative to the middle [1]."""

    stiffness: float
    damping: float

    def __post_init__(self) -> None:
        """Refuse a range that is negative or reaches zero."""
        for name, share in (("stiffness", self.stiffness), ("damping", self.damping)):
            if not 0.0 <= share < 1.0:
                raise PronkError(
                    f"randomization.{name} is {share:g}; expected 0 or more and less than 1, as in "
                    "0.3 for plus or minus 30 %."
                )


@dataclass(frozen=True, kw_only=True)
class ArmConfig:
    """A way to train, or policies that are there already."""

    gains: str | None = None
    """A gains.yaml, or naive for the nominal gains."""
    ranges_from: str | None = None
    """With naive: the gains.yaml whose ranges and delay are used."""
    randomization: RandomizationConfig | None = None
    """Other half-widths of the gains' ranges than those of the file."""
    options: str = ""
    """Further options of `pronk train`, as on the command line."""
    policies: tuple[str, ...] = ()
    """Files of finished policies instead of gains, one for each seed."""

    def __post_init__(self) -> None:
        """Refuse an arm that is neither or both."""
        if self.policies and (self.gains or self.ranges_from or self.options or self.randomization):
            raise PronkError(
                "policies are finished; leave gains, ranges_from, randomization and options out."
            )
        if not self.policies and self.gains is None:
            raise PronkError(
                "gains are missing; give a gains.yaml or naive, or policies that are finished."
            )
        if self.ranges_from is not None and self.gains != "naive":
            raise PronkError(f"ranges_from goes with gains: naive; {self.gains} has its own.")
        if self.randomization is not None and self.gains == "naive" and self.ranges_from is None:
            raise PronkError("randomization of naive gains needs ranges_from, a gains.yaml.")


@dataclass(frozen=True, kw_only=True)
class RobotConfig:
    """A virtual robot, or several."""

    sim_params: str | None = None
    """File of its parameters; those that ship with pronk if left out."""
    changes: tuple[Change, ...] = ()
    """Changes of the parameters, as in a file of conditions."""
    conditions: str | None = None
    """A file of conditions, tolerance or bodies: a robot for each of them."""
    jumps: int | None = None
    """Jumps with each command on this robot; those of the trial if left out."""
    arms: tuple[str, ...] = ()
    """Arms that are tried on it; all if empty."""

    def __post_init__(self) -> None:
        """Refuse changes beside conditions, and a number of jumps out of range."""
        if self.changes and self.conditions is not None:
            raise PronkError("changes and conditions are both given; give one of them.")
        if self.jumps is not None:
            _check_jumps("jumps", self.jumps)


@dataclass(frozen=True, kw_only=True)
class ComparisonConfig:
    """A difference that is asked for before the runs: of arms, or of own and other robots."""

    outcome: str
    arm: str | tuple[str, ...] = ()
    """An arm, or several over which the outcome is averaged, each with one weight."""
    against: str | tuple[str, ...] = ()
    """Arm, or mean of several, that is subtracted."""
    commands: tuple[str, ...] = ()
    """Commands of the trial that count, as in `TrialConfig.commands`; all if empty."""
    robots: tuple[str, ...] = ()
    """Robots over which the outcome is averaged, each with one weight; all if empty."""
    own: dict[str, str] = field(default_factory=dict)
    """Instead of two arms: arms by name, and the robot that each was matched to. On each of these
    robots the arms that were matched to it are compared with the others."""
    primary: bool = False
    """True for a question that the study is made to answer; others are secondary."""

    def __post_init__(self) -> None:
        """Refuse a comparison that is neither or both, and one of a single robot."""
        if self.own:
            if self.arm or self.against or self.robots:
                raise PronkError("own names arms and robots; leave arm, against and robots out.")
            if len(set(self.own.values())) < 2:
                raise PronkError(
                    f"own: {', '.join(self.own)} on one robot; expected arms that were matched to "
                    "two robots or more."
                )
            return
        if not (self.plus and self.minus):
            raise PronkError(
                "expected arm and against, each an arm or a list of arms, or own, arms with their "
                "robots."
            )
        for name in self.plus:
            if name in self.minus:
                raise PronkError(f"arm and against both have {name}; expected different arms.")

    @property
    def plus(self) -> tuple[str, ...]:
        """Names of the arms whose mean counts."""
        return _names(self.arm)

    @property
    def minus(self) -> tuple[str, ...]:
        """Names of the arms whose mean is subtracted."""
        return _names(self.against)

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of all arms that it compares."""
        return tuple(self.own) or (*self.plus, *self.minus)

    @property
    def sides(self) -> tuple[str, str]:
        """What is compared, and against what, in words."""
        return _side_words(self.plus), _side_words(self.minus)

    @property
    def command_names(self) -> tuple[str, ...]:
        """Names of the commands that count; all of the trial if empty."""
        return tuple(case.name for case in parse_cases(self.commands))


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """What all trainings have in common."""

    task: str = "all"
    robot: str = "mini_cheetah"
    envs: int = 4096
    phases: dict[str, int] = field(default_factory=dict)
    """Iterations of phases that differ from the recipe's."""
    save_interval: int = 50
    """Iterations between checkpoints."""
    options: str = ""
    """Further options of `pronk train`, as on the command line."""

    def __post_init__(self) -> None:
        """Refuse a task that cannot jump."""
        tasks = [name for name in TASKS if name != "walk"]
        if self.task not in tasks:
            raise PronkError(f"training.task is {self.task!r}; expected {', '.join(tasks)}.")


@dataclass(frozen=True, kw_only=True)
class TrialConfig:
    """The jumps of every policy on every robot."""

    commands: tuple[str, ...] = ("paper",)
    """Forward and left velocity in m/s, as "2,0"; paper stands for the paper's five."""
    jumps: int = 20
    """Jumps with each command."""
    seed: int = 0
    """Seed of all draws, the same for every policy."""

    def __post_init__(self) -> None:
        """Refuse numbers out of range and commands that cannot be read."""
        _check_jumps("trial.jumps", self.jumps)
        if not 0 <= self.seed < 2**31:
            raise PronkError(f"trial.seed is {self.seed}; expected 0 or more, below 2^31.")
        if not self.commands:
            raise PronkError("trial.commands is empty; expected one or more, as in paper or 2,0.")
        names = [case.name for case in self.cases()]
        if len(set(names)) != len(names):
            raise PronkError(f"trial.commands: one is there twice ({', '.join(names)}).")

    def cases(self) -> tuple[Case, ...]:
        """Return the commands."""
        return parse_cases(self.commands)


@dataclass(frozen=True, kw_only=True)
class StudyConfig:
    """A study, checked when it is built; its messages have the words of the file."""

    schema: str
    title: str
    seeds: int | str | tuple[int, ...] = "1-3"
    """Seeds of every arm, as 1-5, 1,2,5 or a list."""
    arms: dict[str, ArmConfig]
    robots: dict[str, RobotConfig] = field(default_factory=lambda: {"shipped": RobotConfig()})
    outcomes: tuple[str, ...] = ("landed", "height", "distance")
    comparisons: dict[str, ComparisonConfig] = field(default_factory=dict)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    trial: TrialConfig = field(default_factory=TrialConfig)

    def __post_init__(self) -> None:
        """Refuse names that do not exist and lists that are empty or have an entry twice."""
        if self.schema != SCHEMA:
            raise PronkError(f"schema is {self.schema!r}; expected {SCHEMA!r}.")
        if not self.arms:
            raise PronkError("arms is empty; expected one or more.")
        if not self.robots:
            raise PronkError("robots is empty; expected one or more, as in shipped: {}.")
        check_names(self.arms, "arms", PronkError)
        check_names(self.robots, "robots", PronkError)
        folders = {name.replace(" ", "_") for name in self.arms}
        if len(folders) != len(self.arms):
            raise PronkError("arms: two names differ by spaces and underscores only; change one.")
        _ = self.seed_numbers
        _check_known("outcomes", self.outcomes, OUTCOMES)
        for name, comparison in self.comparisons.items():
            place = f"comparisons.{name}"
            _check_known(f"{place}.outcome", [comparison.outcome], OUTCOMES)
            if comparison.commands:
                try:
                    names = comparison.command_names
                except PronkError as error:
                    raise PronkError(f"{place}.commands: {error}") from None
                commands = [case.name for case in self.trial.cases()]
                _check_known(f"{place}.commands", names, commands)
            if comparison.own:
                _check_known(f"{place}.own", list(comparison.own), self.arms)
                continue
            _check_known(f"{place}.arm", comparison.plus, self.arms)
            _check_known(f"{place}.against", comparison.minus, self.arms)
        for name, robot in self.robots.items():
            if robot.arms:
                _check_known(f"robots.{name}.arms", robot.arms, self.arms)

    @property
    def seed_numbers(self) -> tuple[int, ...]:
        """Seeds of every arm that is trained."""
        seeds = self.seeds
        if isinstance(seeds, tuple):
            seeds = ",".join(str(seed) for seed in seeds)
        return parse_seeds(str(seeds))

    def check_robots(self, arms_by_robot: Mapping[str, Sequence[str]]) -> None:
        """Refuse robots with one folder, and comparisons on robots that an arm does not have.

        Args:
            arms_by_robot: Arms that are tried on each robot, by its name; with a robot for each
                condition.
        """
        robot_by_folder: dict[str, str] = {}
        for robot in arms_by_robot:
            other_robot = robot_by_folder.setdefault(robot.replace(" ", "_"), robot)
            if other_robot != robot:
                # Their trials would write to one folder, and one be read as the other.
                raise PronkError(
                    f"robots: {other_robot!r} and {robot!r} differ by spaces and underscores only; "
                    "change one."
                )
        for name, comparison in self.comparisons.items():
            place = f"comparisons.{name}"
            robots = comparison.robots
            if comparison.own:
                robots = tuple(dict.fromkeys(comparison.own.values()))
            if robots:
                section = "own" if comparison.own else "robots"
                _check_known(f"{place}.{section}", robots, arms_by_robot)
            for robot in robots:
                for arm in comparison.arms:
                    if arm not in arms_by_robot[robot]:
                        raise PronkError(
                            f"{place}: {arm} is not tried on {robot}, whose arms are "
                            f"{', '.join(arms_by_robot[robot])}."
                        )
            if not comparison_robots(comparison, arms_by_robot):
                raise PronkError(
                    f"{place}: no robot on which {' and '.join(comparison.arms)} are all tried."
                )


def comparison_robots(
    comparison: ComparisonConfig, arms_by_robot: Mapping[str, Sequence[str]]
) -> tuple[str, ...]:
    """Return the robots of a comparison: those that it names, or all that its arms share.

    Args:
        comparison: The comparison.
        arms_by_robot: Arms that are tried on each robot, by its name.
    """
    if comparison.own:
        return tuple(dict.fromkeys(comparison.own.values()))
    if comparison.robots:
        return comparison.robots
    shared = []
    for robot, arms in arms_by_robot.items():
        if all(arm in arms for arm in comparison.arms):
            shared.append(robot)
    return tuple(shared)


def _names(side: str | tuple[str, ...]) -> tuple[str, ...]:
    """Return the arms of one side of a comparison."""
    if isinstance(side, str):
        return (side,) if side else ()
    return side


def _side_words(arms: Sequence[str]) -> str:
    """Return the arms of one side of a comparison as words."""
    if len(arms) == 1:
        return arms[0]
    return f"mean of {', '.join(arms)}"


def _check_jumps(place: str, jumps: int) -> None:
    """Refuse a number of jumps out of range."""
    if not 1 <= jumps <= 10_000:
        raise PronkError(f"{place} is {jumps}; expected 1 to 10000.")


def _check_known(place: str, names: Sequence[str], known: Any) -> None:
    """Refuse an empty list, a name twice, or one that is not among those that there are."""
    if not names:
        raise PronkError(f"{place} is empty; expected some of {', '.join(known)}.")
    for name in names:
        if name not in known:
            raise PronkError(f"{place}: {name!r}; expected some of {', '.join(known)}.")
    if len(set(names)) != len(names):
        raise PronkError(f"{place}: {', '.join(names)}; one is there twice.")


def load_study(path: Path) -> StudyConfig:
    """Read the file of a study.

    Raises:
        ArtefactError: The file is missing, or something in it is unknown or impossible.
    """
    body = read_yaml(path, ArtefactError, "docs/study.md has an example")
    if not isinstance(body, Mapping):
        raise ArtefactError(f"{path}: no study; expected schema, title, arms and so on.")
    schema = body.get("schema")
    if schema is not None and schema != SCHEMA:
        raise ArtefactError(
            f"{path}: no study, its schema is {schema!r}; expected {SCHEMA!r} (docs/study.md has "
            "an example)."
        )
    _check_parts(path, body)
    try:
        return converted(body, StudyConfig, path)
    except PronkError as error:
        text = str(error)
        raise ArtefactError(text if text.startswith(str(path)) else f"{path}: {text}") from None


def _check_parts(path: Path, body: Mapping[str, Any]) -> None:
    """Read each arm, robot and comparison by itself, so that a message names it."""
    kinds = (("arms", ArmConfig), ("robots", RobotConfig), ("comparisons", ComparisonConfig))
    for section, kind in kinds:
        entries = body.get(section)
        if not isinstance(entries, Mapping):
            continue
        for name, entry in entries.items():
            place = Path(f"{path}: {section}.{name}")
            try:
                converted(entry, kind, place)
            except PronkError as error:
                text = str(error)
                if not text.startswith(str(place)):
                    text = f"{place}: {text}"
                raise ArtefactError(text) from None
