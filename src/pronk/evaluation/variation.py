"""How each result moves when the virtual robot's body is varied, one number at a time.

Every point is the paper's script with the same starts, noise and times as every other point; only
one number of the parameters is another. `PARAMETERS` has the values, and what training had of them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from pronk.errors import PronkError
from pronk.evaluation import result_io as sheet
from pronk.evaluation.job import Job, body, jump
from pronk.evaluation.metrics import FIGURES
from pronk.evaluation.processes import in_processes
from pronk.evaluation.protocol import Case
from pronk.evaluation.result import Subject
from pronk.evaluation.run import Plan, jobs_of
from pronk.evaluation.subjects import load_subjects
from pronk.evaluation.summary import Spread, share_interval
from pronk.robots.robot import Robot
from pronk.virtual.sim_params import SimParams, with_changes

SCHEMA = "pronk/trial-variation/1"
FILE = "variation.json"
WRITER = "pronk trial POLICY --variation"
AS_IT_IS = "as it is"
"""Name of the point that changes nothing."""
VARIED_FIGURES = (
    "height",
    "apex_gain",
    "distance",
    "along",
    "gap",
    "clearance",
    "lift_off_velocity",
    "speed",
    "energy",
)
"""Figures of `pronk.evaluation.metrics` that are kept of every jump."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A number of the parameters, and the values it is given."""

    name: str
    """As `pronk.virtual.sim_params.with_changes` calls it."""
    says: str
    unit: str
    values: tuple[float, ...]
    trained: str
    """What training had of it, in words."""

    def __post_init__(self) -> None:
        """Refuse a parameter without values.

        Raises:
            PronkError: There are none, or the same twice.
        """
        if not self.values or len(set(self.values)) != len(self.values):
            raise PronkError(
                f"values {self.values} of {self.name!r}; expected one or more, all different."
            )

    def of(self, sim_params: SimParams) -> float:
        """The value that a set of parameters has."""
        if self.name == "trunk_mass_offset":
            return sim_params.trunk.mass_offset
        if self.name == "friction":
            return sim_params.ground.friction
        return float(getattr(sim_params.machine, self.name))


PARAMETERS = (
    Parameter(
        name="trunk_mass_offset",
        says="mass added to the trunk",
        unit="kg",
        values=(-1.0, -0.4, 0.6, 1.6, 2.6),
        trained="-0.4 to 1.6 kg (paper D6)",
    ),
    Parameter(
        name="friction",
        says="friction between feet and ground",
        unit="1",
        values=(0.3, 0.45, 0.6, 1.0, 1.5),
        trained="0.05 to 3.0 (paper D2)",
    ),
    Parameter(
        name="command_delay_s",
        says="delay from a command to the drives",
        unit="s",
        values=(0.0, 0.005, 0.01, 0.015, 0.02),
        trained="`delay_range_s` of the contract, beyond the delay of the simulator",
    ),
    Parameter(
        name="bus_voltage",
        says="open-circuit voltage of the battery",
        unit="V",
        values=(18.0, 20.0, 22.0, 25.2),
        trained="22.2 to 25.2 V behind 0.03 to 0.1 ohm; a 6S battery has 18 V empty, 25.2 V full",
    ),
)
"""What is varied. The values reach beyond what training drew, so that it shows where it ends."""


@dataclass(frozen=True, kw_only=True)
class Varied:
    """One jump at one point."""

    parameter: str
    """`as it is` for the point that changes nothing."""
    value: float
    """NaN there."""
    policy: str
    case: str
    number: int
    seed: int
    found: bool
    success: bool
    fell: bool
    height: float
    apex_gain: float
    distance: float
    along: float
    gap: float
    clearance: float
    lift_off_velocity: float
    speed: float
    energy: float


@dataclass(frozen=True, kw_only=True)
class Point:
    """All jumps of one policy with one command at one value."""

    parameter: str
    value: float
    policy: str
    case: str
    n: int
    found: int
    succeeded: int
    success_ci95: tuple[float, float]
    fell: int
    figures: Mapping[str, Spread]
    """Over the jumps that were found."""


@dataclass(frozen=True, kw_only=True)
class Variation:
    """All of it."""

    origin: sheet.Origin
    cases: tuple[Case, ...]
    parameters: tuple[Parameter, ...]
    own: Mapping[str, float]
    """The value that the robot has of itself, by parameter."""
    rows: tuple[Varied, ...]

    @cached_property
    def points(self) -> tuple[Point, ...]:
        """By parameter, value, policy and command; the robot as it is comes first."""
        values = [(AS_IT_IS, math.nan)]
        values += [(each.name, value) for each in self.parameters for value in each.values]
        return tuple(
            self._point(name, value, subject.name, case.name)
            for name, value in values
            for subject in self.origin.subjects
            for case in self.cases
        )

    def line(self, parameter: str, policy: str, case: str) -> tuple[Point, ...]:
        """The points of one parameter in order of its value, the robot as it is among them."""
        found = [
            replace(point, parameter=parameter, value=self.own[parameter])
            if point.parameter == AS_IT_IS
            else point
            for point in self.points
            if point.parameter in (AS_IT_IS, parameter)
            and (point.policy, point.case) == (policy, case)
        ]
        return tuple(sorted(found, key=lambda point: point.value))

    def _point(self, parameter: str, value: float, policy: str, case: str) -> Point:
        rows = [
            row
            for row in self.rows
            if (row.parameter, row.policy, row.case) == (parameter, policy, case)
            and (parameter == AS_IT_IS or row.value == value)
        ]
        found = [row for row in rows if row.found]
        succeeded = sum(row.success for row in rows)
        return Point(
            parameter=parameter,
            value=value,
            policy=policy,
            case=case,
            n=len(rows),
            found=len(found),
            succeeded=succeeded,
            success_ci95=share_interval(succeeded, len(rows)),
            fell=sum(row.fell for row in rows),
            figures={
                name: Spread.of([getattr(row, name) for row in found]) for name in VARIED_FIGURES
            },
        )


def add_variation(
    policies: Sequence[Path],
    plan: Plan | None = None,
    *,
    robot: Robot,
    sim_params: SimParams,
    out: Path,
    about: Mapping[str, Any] | None = None,
    parameters: tuple[Parameter, ...] = PARAMETERS,
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Variation:
    """Let policies jump on bodies that differ in one number, and write `variation.json`.

    Args:
        policies: `policy.onnx` of each.
        plan: What is asked at every point; five jumps with each of the paper's commands if None.
        robot: Which robot they are for.
        sim_params: The body that is varied.
        out: Folder of the trial.
        about: Where the parameters come from, kept with the result.
        parameters: What is varied.
        processes: How many jumps at once; the numbers do not depend on it.
        progress: Called with the share done, 0 to 1.

    Raises:
        PronkError: Of policies, sim_params or plan, before the first step; or a value makes a
            body that cannot exist.
    """
    begun, plan = time.perf_counter(), plan or Plan(jumps=5)
    subjects = load_subjects(policies, robot)
    bodies = [(AS_IT_IS, math.nan, sim_params)]
    bodies += [
        (each.name, value, with_changes(sim_params, **{each.name: value}))
        for each in parameters
        for value in each.values
    ]
    planned = [
        planned
        for name, value, varied in bodies
        for planned in _planned(name, value, subjects, plan, robot, varied, out)
    ]
    for _, _, varied in bodies:  # a body that cannot exist is refused here
        body(replace(planned[0][1], sim_params=varied))
    jumped = in_processes(jump, [job for _, job in planned], processes=processes, progress=progress)
    rows = []
    for (row, _), each in zip(planned, jumped, strict=True):
        figures = each.figures
        rows.append(
            replace(
                row,
                found=figures.found,
                success=figures.success,
                fell=figures.fell,
                **{name: getattr(figures, name) for name in VARIED_FIGURES},
            )
        )
    variation = Variation(
        origin=replace(
            sheet.origin(robot, subjects, about=about, seed=plan.seed),
            seconds=time.perf_counter() - begun,
        ),
        cases=plan.cases,
        parameters=parameters,
        own={each.name: each.of(sim_params) for each in parameters},
        rows=tuple(rows),
    )
    save(out, variation)
    return variation


def _planned(
    parameter: str,
    value: float,
    subjects: Sequence[Subject],
    plan: Plan,
    robot: Robot,
    sim_params: SimParams,
    out: Path,
) -> list[tuple[Varied, Job]]:
    """Every jump at one point, with its row as far as it is known before."""
    return [
        (
            Varied(
                parameter=parameter,
                value=value,
                policy=row.policy,
                case=row.case,
                number=row.number,
                seed=row.seed,
                found=False,
                success=False,
                fell=False,
                **dict.fromkeys(VARIED_FIGURES, math.nan),
            ),
            replace(job, keep=None),
        )
        for row, job in jobs_of(subjects, plan, robot=robot, sim_params=sim_params, out=out)
    ]


def save(folder: Path, variation: Variation) -> Path:
    """Write `variation.json`; returns its path."""
    return sheet.save(
        folder / FILE,
        SCHEMA,
        variation.origin,
        {
            "cases": variation.cases,
            "parameters": variation.parameters,
            "own": variation.own,
            "definitions": sheet.definitions({name: FIGURES[name] for name in VARIED_FIGURES}),
            "points": variation.points,
            "rows": variation.rows,
        },
    )


def load(folder: Path) -> Variation:
    """Read what `save` wrote.

    Raises:
        ArtefactError: Missing, damaged or of another schema.
    """
    with sheet.load(folder / FILE, SCHEMA, writer=WRITER) as (where, told):
        return Variation(
            origin=where,
            cases=tuple(sheet.entry_of(Case, entry) for entry in told["cases"]),
            parameters=tuple(sheet.entry_of(Parameter, entry) for entry in told["parameters"]),
            own={name: float(value) for name, value in told["own"].items()},
            rows=tuple(sheet.entry_of(Varied, entry) for entry in told["rows"]),
        )
