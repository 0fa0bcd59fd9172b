"""Jumps of virtual robots that differ in one parameter from the nominal one.

Every point has the script, starts, noise and times of every other point; one parameter has another
value. `PARAMETERS` has the values, and the range of training.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pronk.errors import PronkError
from pronk.evaluation.metrics import JumpFigures
from pronk.evaluation.results import Cell, Kind, Results
from pronk.evaluation.tables import Sheet, number
from pronk.evaluation.trial import Plan, build, load_subjects, plan_jobs, run_jobs
from pronk.robots.robot import Robot
from pronk.virtual.sim_params import SimParams, with_changes

VARIATION = Kind(
    table="variation.csv",
    summary="variation.json",
    schema="pronk/trial-variation/2",
    writer="pronk trial POLICY --variation",
    figures=JumpFigures,
)
NOMINAL = "nominal"
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
"""Figures that tables show."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A parameter of the virtual robot, and its values."""

    name: str
    """As of `pronk.virtual.sim_params.with_changes`."""
    says: str
    unit: str
    values: tuple[float, ...]
    trained: str
    """Its range in training, in words."""

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
        """Return the nominal value."""
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
"""The values reach beyond the ranges of training, to show where the policy fails."""


def parameters_of(results: Results) -> tuple[Parameter, ...]:
    """Return the varied parameters."""
    return tuple(
        Parameter(**{**entry, "values": tuple(entry["values"])})
        for entry in results.settings["parameters"]
    )


def line(results: Results, parameter: str, policy: str, case: str) -> tuple[Cell, ...]:
    """Return the cells of one parameter in order of its value, the nominal one among them."""
    nominal = results.settings["nominal"][parameter]
    found = [
        replace(cell, parameter=parameter, value=nominal) if cell.parameter == NOMINAL else cell
        for cell in results.cells
        if cell.parameter in (NOMINAL, parameter) and (cell.policy, cell.case) == (policy, case)
    ]
    return tuple(sorted(found, key=lambda cell: cell.value))


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
) -> Results:
    """Let policies jump on varied virtual robots; write `variation.csv` and `variation.json`.

    Arguments and errors as of `run_trial`; the plan has five jumps with each of the paper's
    commands if None.
    """
    plan = plan or Plan(jumps=5)
    subjects = load_subjects(policies, robot)
    nominal = {each.name: each.of(sim_params) for each in parameters}
    varied = [(NOMINAL, 0.0, sim_params)] + [
        (each.name, value, with_changes(sim_params, **{each.name: value}))
        for each in parameters
        for value in each.values
    ]
    planned = []
    for name, value, params in varied:
        jobs = plan_jobs(subjects, plan, robot=robot, sim_params=params, out=out, keep="none")
        build(jobs[0][1])  # refuses impossible parameters
        planned += [(replace(row, parameter=name, value=value), job) for row, job in jobs]
    return run_jobs(
        planned,
        kind=VARIATION,
        subjects=subjects,
        plan=plan,
        robot=robot,
        out=out,
        about=about,
        settings={"parameters": [asdict(each) for each in parameters], "nominal": nominal},
        processes=processes,
        progress=progress,
    )


def table(results: Results) -> Sheet:
    """Landings and heights at every value, all commands together."""
    rows = []
    for each in parameters_of(results):
        for value in sorted({*each.values, results.settings["nominal"][each.name]}):
            for subject in results.subjects:
                cells = [
                    cell
                    for case in results.cases
                    for cell in line(results, each.name, subject.name, case.name)
                    if cell.value == value
                ]
                means = (
                    [cell.figures[name].mean for cell in cells if cell.found]
                    for name in ("height", "distance")
                )
                rows.append(
                    (
                        f"{each.says}, {subject.name}",
                        f"{value:g} {each.unit}".removesuffix(" 1"),
                        f"{sum(c.succeeded for c in cells)}/{sum(c.n for c in cells)}",
                        *(number(float(np.mean(one)) if one else math.nan) for one in means),
                    )
                )
    return Sheet(
        title="Virtual robot, one parameter varied at a time",
        columns=("parameter, policy", "value", "landed", "height [m]", "distance [m]"),
        rows=tuple(rows),
        notes=("Means of the commands' means, over the jumps that there were.",),
    )
