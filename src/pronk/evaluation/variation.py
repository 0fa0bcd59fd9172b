"""Virtual robots that differ from the given one: by one parameter at a time, or drawn at random.

Variation: every point has the script, starts, noise and times of every other point; one parameter
has another value. Random robots: seeded draws within `TOLERANCES`; everything else stays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, Unpack

import msgspec
import numpy as np
import yaml

from pronk.errors import PronkError
from pronk.evaluation.jumps import JumpFigures
from pronk.evaluation.results import Cell, Kind, Results
from pronk.evaluation.tables import Sheet, number, sheet
from pronk.evaluation.trial import Plan, Setup, run_plan
from pronk.files import write_text
from pronk.robots.robot import RobotSpec
from pronk.virtual.sim_params import SCHEMA, JointParams, SimParams, with_changes

VARIATION = Kind(
    table="variation.csv",
    summary="variation.json",
    schema="pronk/trial-variation/3",
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
    plan: Plan | None = None,
    *,
    parameters: tuple[Parameter, ...] = PARAMETERS,
    **setup: Unpack[Setup],
) -> Results:
    """Let policies jump on varied virtual robots; write `variation.csv` and `variation.json`.

    Arguments and errors as of `run_trial`; five jumps with each of the paper's commands if `plan`
    is None.
    """
    base = setup["sim_params"]
    varied = [
        (each.name, value, with_changes(base, **{each.name: value}))
        for each in parameters
        for value in each.values
    ]
    return run_plan(
        policies,
        plan or Plan(jumps=5),
        kind=VARIATION,
        varied=[(NOMINAL, 0.0, base), *varied],
        settings={
            "parameters": [asdict(each) for each in parameters],
            "nominal": {each.name: each.of(base) for each in parameters},
        },
        **setup,
    )


def table(results: Results) -> Sheet:
    """Landings and mean height and distance at every value, all commands together."""
    rows = []
    for each in parameters_of(results):
        for value in sorted({*each.values, results.settings["nominal"][each.name]}):
            for policy in (subject.name for subject in results.subjects):
                lines = (line(results, each.name, policy, case.name) for case in results.cases)
                cells = [cell for cells in lines for cell in cells if cell.value == value]
                known = [cell.figures for cell in cells if cell.found]
                row = {
                    "parameter, policy": f"{each.says}, {policy}",
                    "value": f"{value:g} {each.unit}".removesuffix(" 1"),
                    "landed": f"{sum(c.succeeded for c in cells)}/{sum(c.n for c in cells)}",
                }
                for name in ("height", "distance"):
                    mean = sum(one[name].mean for one in known) / len(known) if known else math.nan
                    row[f"{name} [m]"] = number(mean)
                rows.append(row)
    return sheet(
        "Virtual robot, one parameter varied at a time",
        rows,
        "Means of the commands' means, over the jumps that there were.",
    )


# ---- random robots ----


@dataclass(frozen=True)
class Tolerance:
    """How far a number is drawn from the one it is drawn around, uniformly."""

    kind: Literal["relative", "about"]
    """`relative`: a share of the number; `about`: about `centre`, whatever the number was."""
    centre: float
    half: float
    """Half-width of the draw."""
    why: str


def _relative(half: float, why: str) -> Tolerance:
    return Tolerance("relative", 0.0, half, why)


def _about(centre: float, half: float, why: str) -> Tolerance:
    return Tolerance("about", centre, half, why)


GROUP_TORQUE = 0.06
"""Relative half-width of a factor on `torque_scale` that the joints of one group share: motors of
one batch have one magnet material and one winding."""

TOLERANCES: Mapping[str, Mapping[str, Tolerance]] = {
    "joints": {
        "torque_scale": _relative(0.03, "beside the batch: motor to motor, current sensor"),
        "link_inertia_scale": _relative(0.03, "castings, screws, cables"),
        "rotor_inertia": _relative(0.05, "makers give +-5 to 10 %"),
        "belt_stiffness": _relative(0.2, "belt tension, gear preload"),
        "belt_damping": _relative(0.3, "the same"),
        "coulomb": _relative(0.3, "preload of gears and seals, grease"),
        "breakaway": _relative(0.3, "moves with coulomb"),
        "stribeck_speed": _relative(0.3, "grease"),
        "presliding_stiffness": _relative(0.2, "grease, preload"),
        "presliding_damping": _relative(0.2, "the same"),
        "viscous": _relative(0.3, "grease and its temperature"),
        "encoder_offset": _about(0.0, 0.004, "zeroed by hand against a stop [rad]"),
    },
    "machine": {
        "command_delay_s": _about(0.003, 0.002, "half to two and a half 500 Hz cycles [s]"),
        "measurement_delay_s": _about(0.00125, 0.00075, "up to a 500 Hz cycle [s]"),
        "drive_lag_s": _about(0.0005, 0.0002, "filter of the speed, current loop [s]"),
        "bus_voltage": _about(24.1, 1.1, "a 6S battery from nearly flat to full [V]"),
        "bus_resistance": _relative(0.5, "age and cold of the cells"),
        "gyro_bias": _about(0.0, 0.006, "after some minutes of warming up [rad/s]"),
        "accelerometer_bias": _about(0.0, 0.08, "8 mg, a MEMS unit's data sheet [m/s^2]"),
    },
    "trunk": {
        "mass_offset": _about(0.3, 0.6, "another battery, a payload [kg]; training drew -0.4..1.6"),
        "com_offset": _about(0.0, 0.008, "where battery and computer sit [m]"),
        "inertia_scale": _relative(0.02, "castings, screws, cables"),
    },
    "attitude": {
        "bias": _about(0.0, 0.012, "IMU mounted askew by 0.7 degrees [rad]"),
        "yaw_drift": _about(0.0, 0.004, "gyro bias that is left [rad/s]"),
    },
    "ground": {
        "friction": _about(0.8, 0.2, "rubber on vinyl to rubber on concrete [1]"),
        "stiffness": _relative(0.4, "shore hardness of the feet, mats"),
        "damping": _relative(0.4, "the same"),
    },
}
"""By part of the parameters and name of the number."""

_DIGITS = 5
"""Of a drawn number, so that a written file holds it exactly."""


def draw_robot(sim_params: SimParams, robot: RobotSpec, *, seed: int) -> SimParams:
    """Draw a random robot: every number of `TOLERANCES` anew about given parameters.

    Raises:
        RobotError: The parameters are not of this robot, or a drawn robot cannot exist.
    """
    sim_params.check_joints(robot.joint_names)
    rng = np.random.default_rng([seed, 0x707])
    batch = {group: 1.0 + GROUP_TORQUE * rng.uniform(-1.0, 1.0) for group in robot.groups}
    joints: dict[str, JointParams] = {}
    for joint in robot.joints:
        own = sim_params.joints[joint.name]
        drawn = _drawn(own, "joints", rng)
        drawn["torque_scale"] = _rounded(drawn["torque_scale"] * batch[joint.group])
        # Break-away is friction's peak: it moves with the friction, and is never below it.
        ratio = own.breakaway / own.coulomb if own.coulomb else 1.0
        drawn["breakaway"] = max(_rounded(drawn["coulomb"] * ratio), drawn["coulomb"])
        joints[joint.name] = replace(own, **drawn)
    parts: dict[str, Any] = {"joints": joints}
    for name in ("machine", "trunk", "attitude", "ground"):
        part = getattr(sim_params, name)
        parts[name] = replace(part, **_drawn(part, name, rng))
    return replace(sim_params, **parts)


def _drawn(part: object, name: str, rng: np.random.Generator) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for field, tolerance in TOLERANCES[name].items():
        value = getattr(part, field)
        spread = tolerance.half * rng.uniform(-1.0, 1.0, np.shape(value))
        centre = np.asarray(tolerance.centre if tolerance.kind == "about" else value)
        new = centre * (1.0 + spread) if tolerance.kind == "relative" else centre + spread
        values[field] = tuple(map(_rounded, new)) if np.ndim(new) else _rounded(float(new))
    return values


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def save_sim_params(path: Path, sim_params: SimParams, *, says: str) -> None:
    """Write parameters as YAML for `--sim-params`, whole or not at all.

    `says` is the comment at its head.

    Raises:
        PronkError: There are blocks or a lowered floor, which a file does not hold.
    """
    if sim_params.ground != replace(sim_params.ground, terrain=(), floor=0.0):
        raise PronkError(f"{path}: a sim_params file holds no terrain; take the blocks away first.")
    body = msgspec.to_builtins(sim_params)
    for name in ("terrain", "floor"):
        del body["ground"][name]
    body["joints"] = body.pop("joints")
    head = "".join(f"# {line}".rstrip() + "\n" for line in says.splitlines())
    text = yaml.safe_dump(
        {"schema": SCHEMA, **body}, default_flow_style=None, sort_keys=False, width=100
    )
    write_text(path, f"{head}\n{text}")
