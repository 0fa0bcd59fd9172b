"""Virtual robots that differ from the given one by one parameter at a time.

Every point has the script, starts, noise and times of every other point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from pronk.jump.trial import tables
from pronk.jump.trial.results import Cell, Results, extra_kind
from pronk.jump.trial.tables import Sheet, landed
from pronk.jump.trial.trial import Plan, Setup, run_trial
from pronk.jump.virtual.sim_params import SimParams, with_changes

VARIATION = extra_kind("variation")
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
"""Figures whose definitions the report shows."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A parameter of the virtual robot, and its values."""

    name: str
    """As of `pronk.jump.virtual.sim_params.with_changes`."""
    says: str
    unit: str
    values: tuple[float, ...]
    trained: str
    """Its range in training, in words."""

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
    return msgspec.convert(results.settings["parameters"], tuple[Parameter, ...])


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
    plan: Plan,
    setup: Setup,
    *,
    parameters: tuple[Parameter, ...] = PARAMETERS,
    progress: Callable[[float], None] | None = None,
) -> Results:
    """Let policies jump on varied virtual robots; write `variation.csv` and `variation.json`.

    Arguments and errors as of `run_trial`.
    """
    base = setup.sim_params
    varied = [(NOMINAL, 0.0, base)]
    for each in parameters:
        varied += [(each.name, v, with_changes(base, **{each.name: v})) for v in each.values]
    settings = {
        "parameters": [asdict(each) for each in parameters],
        "nominal": {each.name: each.of(base) for each in parameters},
    }
    how: Any = {"varied": varied, "settings": settings, "progress": progress}
    return run_trial(policies, plan, setup, kind=VARIATION, **how)


def table(results: Results) -> Sheet:
    """Landings and mean height and distance at every value, all commands together."""
    rows = []
    for each in parameters_of(results):
        for value in sorted({*each.values, results.settings["nominal"][each.name]}):
            for policy in (subject.name for subject in results.subjects):
                lines = (line(results, each.name, policy, case.name) for case in results.cases)
                cells = [cell for cells in lines for cell in cells if cell.value == value]
                known = [cell.figures for cell in cells if cell.found]
                means = [
                    sum(one[name].mean for one in known) / len(known) if known else None
                    for name in ("height", "distance")
                ]
                at = f"{value:g} {each.unit}".removesuffix(" 1")
                rows.append((f"{each.says}, {policy}", at, landed(cells), *means))
    return tables.table(
        "parameter, policy | value | landed | height [m] | distance [m]",
        rows,
        "Means of the commands' means, over the jumps that there were.",
        title="Virtual robot, one parameter varied at a time",
    )
