"""Conditions of a trial: named changes of the virtual robot's parameters.

A condition is a list of changes; each multiplies, shifts or replaces numbers of `SimParams`, or
scales the gains of drives by an error of the joint's response (`gain_scale_of`):

    weak = Condition(
        name="weak knees",
        changes=(Change(parameters=("joints.torque_scale",), joints=("knee",), factor=0.7),),
    )
    weak_robot = changed_params(weak, sim_params, robot)

A YAML file lists conditions, and series of them that differ in one number (`tolerance.yaml` is the
example). Two sets are built in: `tolerance`, and `bodies`, random robots around the given one.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy.optimize import brentq

from pronk.arrays import Array
from pronk.errors import ArtefactError, PronkError, RobotError
from pronk.files import read_yaml
from pronk.jump.trial.bodies import Number, draw_body
from pronk.jump.virtual.ground import Ground
from pronk.jump.virtual.sim_params import (
    AttitudeParams,
    FixtureParams,
    ImuParams,
    JointParams,
    MachineParams,
    SimParams,
    TrunkParams,
)
from pronk.names import check_names
from pronk.robots.model import bench_inertia
from pronk.robots.robot import RobotSpec

SCHEMA = "pronk/conditions/1"
NOMINAL = "nominal"
"""Name of the condition that changes nothing."""
BODIES = "bodies"
TOLERANCE = "tolerance"
TOLERANCE_FILE = Path(__file__).with_name("tolerance.yaml")
BODY_COUNT = 3
"""Number of random robots in the built-in set `bodies`."""

_PARTS: dict[str, Any] = {
    "joints": JointParams,
    "machine": MachineParams,
    "imu": ImuParams,
    "fixture": FixtureParams,
    "trunk": TrunkParams,
    "attitude": AttitudeParams,
    "ground": Ground,
}
"""Parts of `SimParams` that a condition may change."""
GAIN_SCALE = "joints.gain_scale"
"""The parameter that a gain error changes."""
_LARGEST_GAIN_SCALE = 10.0
"""Largest factor on the gains of a drive; its inverse is the smallest."""
_BAND_POINTS = 200
"""Frequencies of a band at which responses are compared."""
_SCENE = ("terrain", "floor")
"""Fields of the ground that belong to a scene, not to a robot."""


class Change(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One change, by exactly one of its four ways, of one or more numbers."""

    parameters: tuple[str, ...]
    """Part and name of each number, as in `joints.torque_scale`."""
    joints: tuple[str, ...] = ()
    """Joints or joint groups that are changed; all joints if empty."""
    factor: float | None = None
    """What the nominal number is multiplied by [1]."""
    offset: float | None = None
    """What is added to the nominal number, in its unit."""
    value: Number | None = None
    """What replaces the nominal number, in its unit."""
    gain_error_db: float | None = None
    """Of `joints.gain_scale` alone: error of each joint's response, root mean square in its band,
    negative where the drives are softer than they should be [dB]."""

    def __post_init__(self) -> None:
        """Refuse a change of nothing, of unknown numbers, or by more than one of the four."""
        if not self.parameters:
            raise ValueError("parameters is empty; expected one or more, as joints.torque_scale")
        for parameter in self.parameters:
            _check_parameter(parameter)
        ways = (self.factor, self.offset, self.value, self.gain_error_db)
        count = len(ways) - ways.count(None)
        if count != 1:
            raise ValueError(
                f"the change of {', '.join(self.parameters)} has {count} of factor, offset, value "
                "and gain_error_db; expected exactly one"
            )
        if self.gain_error_db is not None and self.parameters != (GAIN_SCALE,):
            raise ValueError(
                f"the change of {', '.join(self.parameters)} has a gain_error_db, which is one of "
                f"{GAIN_SCALE}; give that parameter alone"
            )

    def applied(self, nominal: Number) -> Number:
        """Return the changed number."""
        if self.value is not None:
            return self.value
        if isinstance(nominal, tuple):
            return tuple(self._changed(number) for number in nominal)
        return self._changed(nominal)

    def _changed(self, nominal: float) -> float:
        if self.factor is not None:
            return nominal * self.factor
        if self.offset is not None:
            return nominal + self.offset
        return nominal


class Condition(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Named changes of the virtual robot."""

    name: str
    changes: tuple[Change, ...] = ()
    """None of them is the nominal robot."""
    series: str = ""
    """Series that the condition is a point of, with its unit; empty for a condition by itself."""
    place: float | None = None
    """Place in its series, in the unit of the series; None for a condition by itself."""


class _Series(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Conditions that change the same numbers, each by another number in the same way."""

    name: str
    unit: str = ""
    parameters: tuple[str, ...]
    joints: tuple[str, ...] = ()
    factors: tuple[float, ...] = ()
    offsets: tuple[float, ...] = ()
    values: tuple[float, ...] = ()
    gain_errors_db: tuple[float, ...] = ()

    def conditions(self) -> list[Condition]:
        """Return one condition for each factor, offset, value or gain error."""
        changes = []
        for factor in self.factors:
            changes.append((factor, self._change(factor=factor)))
        for offset in self.offsets:
            changes.append((offset, self._change(offset=offset)))
        for value in self.values:
            changes.append((value, self._change(value=value)))
        for error_db in self.gain_errors_db:
            changes.append((error_db, self._change(gain_error_db=error_db)))
        heading = f"{self.name} [{self.unit}]" if self.unit else self.name
        conditions = []
        for place, change in changes:
            name = f"{self.name} {place:g} {self.unit}".strip()
            conditions.append(Condition(name=name, changes=(change,), series=heading, place=place))
        return conditions

    def _change(
        self,
        *,
        factor: float | None = None,
        offset: float | None = None,
        value: float | None = None,
        gain_error_db: float | None = None,
    ) -> Change:
        return Change(
            parameters=self.parameters,
            joints=self.joints,
            factor=factor,
            offset=offset,
            value=value,
            gain_error_db=gain_error_db,
        )

    def __post_init__(self) -> None:
        """Refuse a series without points, or with points of two kinds."""
        ways = (self.factors, self.offsets, self.values, self.gain_errors_db)
        count = len(ways) - ways.count(())
        if count != 1:
            raise ValueError(
                f"the series {self.name} has {count} of factors, offsets, values and "
                "gain_errors_db; expected exactly one"
            )


class _File(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """Content of a file of conditions."""

    schema: str
    conditions: tuple[Condition, ...] = ()
    series: tuple[_Series, ...] = ()


def changed_params(condition: Condition, sim_params: SimParams, robot: RobotSpec) -> SimParams:
    """Apply the changes of a condition to a virtual robot's parameters.

    Args:
        condition: Its changes are applied in their order.
        sim_params: Parameters of the nominal robot.
        robot: The robot, whose joint groups the changes may name.

    Returns:
        New parameters; those given stay as they are.

    Raises:
        RobotError: A joint is unknown, or the changed robot cannot exist.
    """
    joint_numbers: dict[str, dict[str, Number]] = {name: {} for name in sim_params.joints}
    part_numbers: dict[str, dict[str, Number]] = {name: {} for name in _PARTS}
    for change in condition.changes:
        names = _joints_of(change, robot, condition.name)
        if change.gain_error_db is not None:
            for name in names:
                try:
                    scale = gain_scale_of(
                        robot, name, sim_params.joints[name], change.gain_error_db
                    )
                except RobotError as error:
                    raise RobotError(f"condition {condition.name}: {error}") from None
                nominal = joint_numbers[name].get("gain_scale", sim_params.joints[name].gain_scale)
                assert isinstance(nominal, float)
                joint_numbers[name]["gain_scale"] = nominal * scale
            continue
        for parameter in change.parameters:
            part, _, field = parameter.partition(".")
            if part == "joints":
                for name in names:
                    _apply(change, field, sim_params.joints[name], joint_numbers[name])
            else:
                _apply(change, field, getattr(sim_params, part), part_numbers[part])
    # All numbers of a part at once: two that are valid only together may be changed together.
    try:
        joints = {}
        for name, params in sim_params.joints.items():
            joints[name] = replace(params, **joint_numbers[name])  # type: ignore[arg-type]
        machine: Any = part_numbers["machine"]
        imu: Any = part_numbers["imu"]
        fixture: Any = part_numbers["fixture"]
        trunk: Any = part_numbers["trunk"]
        attitude: Any = part_numbers["attitude"]
        ground: Any = part_numbers["ground"]
        return replace(
            sim_params,
            joints=joints,
            machine=replace(sim_params.machine, **machine),
            imu=replace(sim_params.imu, **imu),
            fixture=replace(sim_params.fixture, **fixture),
            trunk=replace(sim_params.trunk, **trunk),
            attitude=replace(sim_params.attitude, **attitude),
            ground=replace(sim_params.ground, **ground),
        )
    except RobotError as error:
        raise RobotError(f"condition {condition.name}: {error}") from None


def gain_scale_of(robot: RobotSpec, name: str, params: JointParams, error_db: float) -> float:
    """Compute the factor on a drive's gains that changes its joint's response by an error.

    The response is that of a rigid joint with a PD drive (reading A9), |stiffness / (stiffness -
    I w^2 + j w (damping + viscous))|, with the nominal gains of the drive times its scales. The
    error is the root mean square, over the band of the joint, of the change of 20 log10 of it, as
    `error_db` of `gains.yaml` is. It is a matter of the response, not of the gains: half the gains
    are 2.7 to 4 dB on the legs of the Mini Cheetah with its nominal 17 / 0.4, twice the gains 0.9
    to 1.6 dB. A stiff joint follows its command and can do no more, so that the error of stiffer
    drives has an upper bound.

    Args:
        robot: The robot.
        name: Name of the joint.
        params: Its parameters.
        error_db: The error, negative for softer drives [dB].

    Returns:
        The factor, below 1 for softer and above 1 for stiffer drives [1].

    Raises:
        RobotError: No factor from 0.1 to 10 gives such an error.
    """
    if error_db == 0.0:
        return 1.0
    joint = robot.joint(name)
    inertia, _ = bench_inertia(robot, name)
    omega = 2.0 * math.pi * np.linspace(*joint.band_hz, _BAND_POINTS)
    share = params.torque_scale * params.gain_scale
    stiffness = share * joint.stiffness
    damping = share * joint.damping

    def magnitude_db(scale: float) -> Array:
        rest = scale * stiffness - inertia * omega**2
        response = scale * stiffness / (rest + 1j * omega * (scale * damping + params.viscous))
        return np.asarray(20.0 * np.log10(np.abs(response)))

    nominal_db = magnitude_db(1.0)

    def excess(log_scale: float) -> float:
        change = magnitude_db(math.exp(log_scale)) - nominal_db
        return float(np.sqrt(np.mean(change**2))) - abs(error_db)

    farthest = math.copysign(math.log(_LARGEST_GAIN_SCALE), error_db)
    if excess(farthest) < 0.0:
        most = excess(farthest) + abs(error_db)
        word = "stiffer" if error_db > 0.0 else "softer"
        raise RobotError(
            f"a {word} drive of {name} changes its response by {most:.2g} dB at most, not "
            f"{abs(error_db):g} dB; give a smaller gain error."
        )
    return math.exp(float(brentq(excess, 0.0, farthest, xtol=1e-9)))


def _apply(change: Change, field: str, part: object, numbers: dict[str, Number]) -> None:
    """Put the changed number into `numbers`, which has what earlier changes made of it."""
    nominal: Number = numbers[field] if field in numbers else getattr(part, field)
    numbers[field] = change.applied(nominal)


def _joints_of(change: Change, robot: RobotSpec, condition: str) -> list[str]:
    """Return the joints that a change names, by themselves or by their group."""
    if not change.joints:
        return list(robot.joint_names)
    names = []
    for name in change.joints:
        if name in robot.joint_names:
            names.append(name)
        elif name in robot.groups:
            for joint in robot.group(name):
                names.append(joint.name)
        else:
            raise RobotError(
                f"condition {condition}: {name!r} is no joint of {robot.name} and no group of "
                f"joints; the groups are {', '.join(robot.groups)}, the joints "
                f"{', '.join(robot.joint_names)}."
            )
    return names


def _check_parameter(parameter: str) -> None:
    """Raise `ValueError` for a number that no part of the parameters has."""
    part, _, field = parameter.partition(".")
    if part not in _PARTS:
        raise ValueError(
            f"{parameter!r} is no parameter; expected PART.NAME, the parts are {', '.join(_PARTS)}"
        )
    names = [entry.name for entry in fields(_PARTS[part]) if entry.name not in _SCENE]
    if field not in names:
        raise ValueError(
            f"{parameter!r} is no parameter; the numbers of {part} are {', '.join(names)}"
        )


# ---- sets of conditions ----


def load_conditions(
    text: str, sim_params: SimParams, robot: RobotSpec, *, seed: int = 0
) -> list[Condition]:
    """Return the conditions of a built-in set or of a file.

    Args:
        text: `bodies`, `tolerance`, or the path of a YAML file.
        sim_params: Parameters that `bodies` are drawn about.
        robot: The robot.
        seed: Seed of the draws of `bodies`.

    Raises:
        ArtefactError: The file is missing or no file of conditions.
        RobotError: A condition cannot exist on this robot.
    """
    if text == BODIES:
        conditions = body_conditions(sim_params, robot, seed=seed)
    elif text == TOLERANCE:
        conditions = read_conditions(TOLERANCE_FILE)
    else:
        conditions = read_conditions(Path(text))
    for condition in conditions:
        changed_params(condition, sim_params, robot)
    return conditions


def body_conditions(sim_params: SimParams, robot: RobotSpec, *, seed: int) -> list[Condition]:
    """Return the nominal robot and `BODY_COUNT` random ones, drawn from `1000 seed + 1` and on."""
    conditions = [Condition(name=NOMINAL)]
    for number in range(1, BODY_COUNT + 1):
        changes = []
        for drawn in draw_body(sim_params, robot, seed=1000 * seed + number):
            joints = (drawn.joint,) if drawn.joint else ()
            changes.append(Change(parameters=(drawn.parameter,), joints=joints, value=drawn.value))
        conditions.append(Condition(name=f"body {number}", changes=tuple(changes)))
    return conditions


def read_conditions(path: Path) -> list[Condition]:
    """Read the conditions of a YAML file: those it lists, then the points of its series.

    Raises:
        ArtefactError: The file is missing, cannot be read, or holds no conditions.
    """
    body = read_yaml(
        path, ArtefactError, f"give a file, or one of the built-in sets {BODIES}, {TOLERANCE}"
    )
    schema = body.get("schema") if isinstance(body, dict) else None
    if schema != SCHEMA:
        raise ArtefactError(
            f"{path}: schema {schema!r}; expected {SCHEMA!r}. Copy {TOLERANCE_FILE} and edit it."
        )
    try:
        file = msgspec.convert(body, _File)
        conditions = list(file.conditions)
        for series in file.series:
            conditions += series.conditions()
    except (msgspec.ValidationError, ValueError) as error:
        raise ArtefactError(f"{path}: {error}. {TOLERANCE_FILE} is an example.") from None
    check_conditions(conditions, str(path))
    return conditions


def check_conditions(conditions: Sequence[Condition], source: str) -> None:
    """Refuse a set without conditions, with a name that cannot be used, or with one name twice."""
    if not conditions:
        raise PronkError(f"{source}: no conditions; list one or more under conditions or series.")
    names = [condition.name for condition in conditions]
    check_names(names, source, ArtefactError)
    for name, count in Counter(names).items():
        if count > 1:
            raise PronkError(f"{source}: {count} conditions named {name!r}; expected one.")
    for condition in conditions:
        if condition.place is not None and not math.isfinite(condition.place):
            raise PronkError(f"{source}: {condition.name}: the place in a series must be finite.")
