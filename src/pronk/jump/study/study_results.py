"""The results of a study: outcomes of every arm on every robot, and the comparisons.

study.json, study.csv    estimates with intervals; the page is made of the first
runs.csv                 every jump
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import msgspec

from pronk.files import write_text
from pronk.jump.study.outcomes import OUTCOMES
from pronk.jump.trial.condition_trial import DECIDING_VERSIONS
from pronk.jump.trial.results import load_json, save_json
from pronk.tables import Cell, Column, Table, counted, number

STUDY_FILE = "study.json"
STUDY_TABLE = "study.csv"
RUNS_FILE = "runs.csv"
SCHEMA = "pronk/study-results/1"
WRITER = "pronk study STUDY.yaml"
OWN_ROBOT = "arms on their own robot"
"""What is compared where a comparison names the robot that each arm was matched to."""
OTHER_ROBOT = "arms of other robots"
"""What that is compared with."""


MAX_UNEVEN = 5
"""Largest number of robots that the note on unequal shares of jumps names."""
SEVERAL_VERSIONS = " and "
"""What joins the versions of a software where trials have several."""
SOURCES = "sources"
"""Name of the hashes of pronk's sources among versions. The version of pronk is the same in many
commits."""
TRAINING_VERSIONS = (
    "pronk",
    SOURCES,
    "mjlab",
    "mujoco",
    "mujoco_warp",
    "warp",
    "torch",
    "rsl_rl",
)
"""Software whose version decides what a training computes."""
TRIALS = "trials"
"""Folder of the trials in that of a study."""
NO_INTERVAL = (
    "A single seed (n = 1) has a value but no interval: how far policies of other seeds lie from "
    "it is not known."
)
"""Note of tables with values of a single seed."""


@dataclass(frozen=True, kw_only=True)
class OutcomeCell:
    """One outcome of one arm on one robot, mean over seeds."""

    arm: str
    robot: str
    series: str = ""
    """Series of conditions that the robot is a point of; empty for a robot by itself."""
    place: float | None = None
    """Place of the robot in its series, in the unit of the series."""
    outcome: str
    value: float = math.nan
    """Mean over seeds of the means over jumps, in the unit of the outcome; of a share 0 to 1."""
    low: float = math.nan
    """Lower end of the 95 % interval; NaN with fewer than two seeds."""
    high: float = math.nan
    by_seed: dict[str, float | None] = field(default_factory=dict)
    """Mean over the jumps of each seed."""
    jumps: int
    """Number of commanded jumps of all seeds."""
    jumps_with_value: int | None = None
    """Number of those that have this outcome; None in results of an earlier pronk."""
    jumps_not_standing: int = 0
    """Number of those before which the drives did not hold the robot up, so that no policy started;
    0 in results of an earlier pronk."""

    @property
    def seeds(self) -> int:
        """Number of seeds with a value."""
        values = [value for value in self.by_seed.values() if value is not None]
        return sum(math.isfinite(value) for value in values)


def compared_outcome(outcome: str, commands: Sequence[str]) -> str:
    """Return the words for an outcome of some commands; all if empty."""
    return f"{outcome}, {', '.join(commands)}" if commands else outcome


@dataclass(frozen=True, kw_only=True)
class ComparedArms:
    """The difference of arms in one outcome, as the study's file asked for it."""

    name: str
    outcome: str
    arm: str
    """The arm, or the words for several."""
    against: str
    robots: tuple[str, ...]
    commands: tuple[str, ...] = ()
    """Names of the commands that count; empty for all of the trial."""
    value: float = math.nan
    """Mean of one side less that of the other, in the unit of the outcome; of a share -1 to 1."""
    low: float = math.nan
    high: float = math.nan
    seeds: tuple[int, ...] = ()
    """Number of seeds, with a value on every robot, of each arm that has a part in it."""
    counted_arms: tuple[str, ...] = ()
    """Names of these arms, in the same order; empty in results of an earlier pronk."""
    primary: bool = False
    """True for a question that the study was made to answer."""

    @property
    def outcome_words(self) -> str:
        """The outcome, and the commands if not all of them count."""
        return compared_outcome(self.outcome.replace("_", " "), self.commands)

    @property
    def few_seeds(self) -> str:
        """Why there is no interval: the arms with fewer than two seeds; empty if there is one."""
        if math.isfinite(self.low):
            return ""
        arms_by_count: dict[int, list[str]] = {0: [], 1: []}
        for arm, count in zip(self.counted_arms, self.seeds, strict=False):
            if count < 2:
                arms_by_count[count].append(arm)
        place = " on every robot here" if len(self.robots) > 1 else ""
        reasons = []
        if arms_by_count[0]:
            reasons.append(f"no seed with a value{place} of {', '.join(arms_by_count[0])}")
        if arms_by_count[1]:
            seed_words = "one seed each" if len(arms_by_count[1]) > 1 else "one seed"
            reasons.append(
                f"{seed_words}{place} of {', '.join(arms_by_count[1])} (n = 1), which shows no "
                "scatter over seeds"
            )
        return "; ".join(reasons) or "fewer than two seeds of an arm"

    @property
    def verdict(self) -> str:
        """What the interval allows to say, or why there is none."""
        if not math.isfinite(self.value):
            return f"no value: {self.few_seeds}"
        if not math.isfinite(self.low):
            return f"no interval: {self.few_seeds}"
        if self.low > 0.0:
            return "more"
        if self.high < 0.0:
            return "less"
        return "no clear difference"


@dataclass(frozen=True, kw_only=True)
class StudyResults:
    """Estimates of a study, and what they rest on."""

    title: str
    robot: str
    virtual: bool = True
    """Measured on pronk's virtual robot."""
    arms: tuple[str, ...]
    robots: tuple[str, ...]
    outcomes: tuple[str, ...]
    commands: tuple[str, ...]
    jumps: int
    """Number of jumps with each command, of each policy on each robot without another number."""
    robot_jumps: dict[str, int] = field(default_factory=dict)
    """Number of jumps with each command by robot; empty in results of an earlier pronk."""
    trial_seed: int
    """Seed of the draws of all trials."""
    cells: tuple[OutcomeCell, ...]
    comparisons: tuple[ComparedArms, ...] = ()
    missing: tuple[str, ...] = ()
    """Names of trials that are not in the results."""
    failed: tuple[str, ...] = ()
    """Trainings that failed, with the reasons."""
    versions: dict[str, str] = field(default_factory=dict)
    """Versions of software that the trials were computed with, several joined by
    `SEVERAL_VERSIONS`, and under `SOURCES` the hashes of pronk's sources; by `version_of_training`
    the same of the trainings, except of finished policies and in results of an earlier pronk."""

    @property
    def tried_arms(self) -> tuple[str, ...]:
        """The arms of which a policy was tried, in the order of the study's file."""
        arms_with_jumps = {cell.arm for cell in self.cells if cell.jumps}
        return tuple(arm for arm in self.arms if arm in arms_with_jumps)

    @property
    def mixed_versions(self) -> str:
        """Sentences on trials and trainings of several versions; empty if all are of the same."""
        sentences = []
        mixed = _several(self.versions, (*DECIDING_VERSIONS, SOURCES))
        if mixed:
            sentences.append(
                f"The trials are not all of one version ({mixed}), which decides what is "
                "simulated: a difference between arms or robots may be one between versions. "
                f"Delete the folder {TRIALS} and run the command again; trainings are kept."
            )
        mixed = _several(self.versions, [version_of_training(name) for name in TRAINING_VERSIONS])
        if mixed:
            sentences.append(
                f"The trainings are not all of one version ({mixed}), which decides what is "
                "trained: a difference between arms may be one between versions. state.json and "
                "each training's provenance.json say which has which."
            )
        return " ".join(sentences)

    def cell(self, arm: str, robot: str, outcome: str) -> OutcomeCell:
        """Return one outcome of one arm on one robot; without a value if it was not tried there."""
        for cell in self.cells:
            if (cell.arm, cell.robot, cell.outcome) == (arm, robot, outcome):
                return cell
        return OutcomeCell(arm=arm, robot=robot, outcome=outcome, jumps=0)


def version_of_training(name: str) -> str:
    """Return under which name the version of a software has its place that trainings ran with."""
    return f"training {name}"


def _several(versions: Mapping[str, str], names: Sequence[str]) -> str:
    """Return the software of which there are several versions, with these versions."""
    several = []
    for name in names:
        version = versions.get(name, "")
        if SEVERAL_VERSIONS in version:
            several.append(f"{name} {version}")
    return ", ".join(several)


def save_study(path: Path, results: StudyResults) -> None:
    """Write the results as JSON, and beside them a table of all cells."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["arm", "robot", "series", "place", "outcome", "value", "low", "high", "seeds", "jumps"]
    )
    for cell in results.cells:
        row: list[Any] = [cell.arm, cell.robot, cell.series]
        row.append("" if cell.place is None else cell.place)
        row.append(cell.outcome)
        for value in (cell.value, cell.low, cell.high):
            row.append(value if math.isfinite(value) else "")
        row += [cell.seeds, cell.jumps]
        writer.writerow(row)
    write_text(path.with_name(STUDY_TABLE), text.getvalue())
    save_json(path, SCHEMA, msgspec.to_builtins(results))


def load_study_results(path: Path) -> StudyResults:
    """Read what `save_study` wrote.

    Raises:
        ArtefactError: The file is missing, damaged or of another schema.
    """
    with load_json(path, SCHEMA, WRITER) as body:
        del body["schema"]
        for section in ("cells", "comparisons"):
            for entry in body[section]:
                for name in ("value", "low", "high"):
                    if entry[name] is None:
                        entry[name] = math.nan
        # msgspec takes no NaN for a number of JSON, but it does in Python's own values.
        return msgspec.convert(body, StudyResults)


# ---- tables ----


def estimate_text(value: float, low: float, high: float, outcome: str, *, signed: bool) -> str:
    """Return an estimate with its interval in the unit of tables."""
    definition = OUTCOMES[outcome]
    if not math.isfinite(value):
        return "-"
    texts = []
    for edge in (value, low, high):
        text = number(definition.scale * edge, definition.digits)
        texts.append(f"+{text}" if signed and edge > 0.0 else text)
    if not math.isfinite(low):
        return texts[0]
    return f"{texts[0]} ({texts[1]} to {texts[2]})"


def outcome_table(results: StudyResults, outcome: str, *, in_series: bool = False) -> Table:
    """Return one outcome, a row a robot and a column an arm.

    Args:
        results: The study.
        outcome: Name of the outcome.
        in_series: Whether the rows are the points of the series of conditions. Otherwise they are
            the robots by themselves.
    """
    definition = OUTCOMES[outcome]
    columns = [Column(heading="robot")]
    for arm in results.tried_arms:
        columns.append(Column(heading=arm))
    rows: list[tuple[Cell, ...]] = []
    single_seed = []
    shown = {cell.robot for cell in results.cells if bool(cell.series) == in_series}
    for robot in results.robots:
        if robot not in shown:
            continue
        row: list[Cell] = [robot]
        for arm in results.tried_arms:
            cell = results.cell(arm, robot, outcome)
            if not cell.jumps:
                row.append("-")
                continue
            text = estimate_text(cell.value, cell.low, cell.high, outcome, signed=False)
            row.append(f"{text}, {counted(cell.seeds, 'seed')}")
            if cell.seeds == 1:
                single_seed.append(f"{arm} on {robot}")
        rows.append(tuple(row))
    notes = [f"{outcome.replace('_', ' ')}: {definition.meaning}."]
    not_standing = _not_standing(results, outcome, shown)
    if not_standing:
        notes.append(
            "Before some jumps the drives did not hold the robot up, so that no policy started. "
            f"They count here as if the policy had failed: {'; '.join(not_standing)}."
        )
    uneven = _uneven_counts(results, outcome, shown)
    if uneven:
        notes.append(
            "Where arms have a value of unequal shares of their jumps, their means may be over "
            f"different commands. Jumps with a value: {'; '.join(uneven)}."
        )
    if single_seed:
        notes.append(f"{NO_INTERVAL} Here: {'; '.join(single_seed)}.")
    return Table(
        title=f"{definition.label}: mean over seeds (95 % interval)",
        columns=tuple(columns),
        rows=tuple(rows),
        notes=tuple(notes),
        is_detail=in_series,
    )


def _cells_on(results: StudyResults, robot: str, outcome: str) -> list[OutcomeCell]:
    """Return one outcome on one robot of the arms that were tried there, in their order."""
    cells = [results.cell(arm, robot, outcome) for arm in results.arms]
    return [cell for cell in cells if cell.jumps]


def _not_standing(results: StudyResults, outcome: str, robots: Collection[str]) -> list[str]:
    """Return how many jumps have an outcome although the robot did not stand before them.

    Args:
        results: The study.
        outcome: Name of the outcome.
        robots: Names of the robots that count.
    """
    texts = []
    for robot in results.robots:
        jumps = 0
        not_standing = 0
        for cell in _cells_on(results, robot, outcome):
            if robot in robots and cell.jumps_with_value == cell.jumps:
                jumps += cell.jumps
                not_standing += cell.jumps_not_standing
        if not_standing:
            texts.append(f"{not_standing} of {jumps} on {robot}")
    return texts


def _uneven_counts(results: StudyResults, outcome: str, robots: Collection[str]) -> list[str]:
    """Return how many jumps have an outcome on robots where that share differs between arms.

    Args:
        results: The study.
        outcome: Name of the outcome.
        robots: Names of the robots that count.
    """
    texts = []
    for robot in results.robots:
        counts = []
        shares = set()
        for cell in _cells_on(results, robot, outcome):
            if robot in robots and cell.jumps_with_value is not None:
                shares.add(Fraction(cell.jumps_with_value, cell.jumps))
                counts.append(f"{cell.arm} {cell.jumps_with_value} of {cell.jumps}")
        if len(shares) > 1:
            texts.append(f"on {robot} {', '.join(counts)}")
    if len(texts) > MAX_UNEVEN:
        texts[MAX_UNEVEN:] = [f"and on {len(texts) - MAX_UNEVEN} more"]
    return texts


def comparison_table(results: StudyResults) -> Table:
    """Return the comparisons that the study's file asked for."""
    rows: list[tuple[Cell, ...]] = []
    ordered = sorted(results.comparisons, key=lambda comparison: not comparison.primary)
    for comparison in ordered:
        robots = ", ".join(comparison.robots)
        if comparison.robots == results.robots and len(results.robots) > 1:
            robots = "all"
        seeds = " and ".join(map(str, comparison.seeds))
        if len(comparison.seeds) > 2:
            seeds = f"{min(comparison.seeds)} to {max(comparison.seeds)}"
            if min(comparison.seeds) == max(comparison.seeds):
                seeds = str(comparison.seeds[0])
        rows.append(
            (
                "primary" if comparison.primary else "secondary",
                comparison.name,
                compared_outcome(OUTCOMES[comparison.outcome].label, comparison.commands),
                f"{comparison.arm} less {comparison.against}",
                robots,
                estimate_text(
                    comparison.value,
                    comparison.low,
                    comparison.high,
                    comparison.outcome,
                    signed=True,
                ),
                seeds,
                comparison.verdict,
            )
        )
    notes = [
        "Intervals: hierarchical bootstrap over seeds and jumps, widened for few seeds; of shares "
        "at least as wide as the jumps alone make them."
    ]
    if any(comparison.few_seeds for comparison in results.comparisons):
        notes.append(
            f"{NO_INTERVAL} Nor has a comparison in which that arm counts, also in a mean of arms: "
            "seeds are drawn within each arm, and an interval without the scatter of one of them "
            "would be too narrow. Train another seed of the arm, or compare without it."
        )
    if len(results.comparisons) > 1:
        notes.append(
            f"Each of the {len(results.comparisons)} intervals covers the truth with 95 % by "
            "itself, all of them together less often."
        )
    return Table(
        title="Comparisons named before the runs",
        columns=(
            Column(heading="question"),
            Column(heading="comparison"),
            Column(heading="outcome"),
            Column(heading="difference of"),
            Column(heading="robots"),
            Column(heading="difference (95 % interval)"),
            Column(heading="seeds"),
            Column(heading="verdict"),
        ),
        rows=tuple(rows),
        notes=tuple(notes),
    )


def seed_table(results: StudyResults, outcome: str) -> Table:
    """Return the mean of one outcome by seed, a row an arm and robot."""
    definition = OUTCOMES[outcome]
    rows: list[tuple[Cell, ...]] = []
    for cell in results.cells:
        if cell.outcome != outcome:
            continue
        texts = []
        for value in cell.by_seed.values():
            shown = math.nan if value is None else definition.scale * value
            texts.append(number(shown, definition.digits))
        rows.append((f"{cell.robot}: {cell.arm}", ", ".join(texts)))
    return Table(
        title=f"{definition.label} of each seed",
        columns=(Column(heading="robot: arm"), Column(heading="seed by seed")),
        rows=tuple(rows),
    )


def study_tables(results: StudyResults) -> list[Table]:
    """Return the comparisons, if any, and the tables of each outcome."""
    tables = outcome_tables(results)
    if results.comparisons:
        tables.insert(0, comparison_table(results))
    return tables


def outcome_tables(results: StudyResults) -> list[Table]:
    """Return a table of each outcome on the robots by themselves, and one of those in series."""
    tables = []
    for in_series in (False, True):
        if any(bool(cell.series) == in_series for cell in results.cells):
            for outcome in results.outcomes:
                tables.append(outcome_table(results, outcome, in_series=in_series))
    return tables
