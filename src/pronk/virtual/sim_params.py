"""What is true of a virtual robot, and of nothing else that pronk may look at.

The file (`pronk/sim_params/1`) can be replaced by any other. It says in which ways
the virtual machine differs from the model that is matched and trained in. `pronk.match` and
`pronk.train` must not import this module; a test holds that.

The entries `trunk`, `attitude` and `ground` matter off the bench only. A file may leave them out,
or some of their fields: then they are as in `sim_params.py` and `ground.py`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import yaml

from pronk.errors import RobotError
from pronk.virtual.ground import Ground
from pronk.virtual.sim_params_parts import AttitudeParams, JointParams, MachineParams, TrunkParams

SCHEMA = "pronk/sim_params/1"
SHIPPED = Path(__file__).with_name("mini_cheetah_sim_params.yaml")


@dataclass(frozen=True, kw_only=True)
class SimParams:
    """The whole sim_params of a virtual robot."""

    robot: str
    """Name of the robot whose structure it has."""
    machine: MachineParams
    joints: Mapping[str, JointParams]
    trunk: TrunkParams = field(default_factory=TrunkParams)
    attitude: AttitudeParams = field(default_factory=AttitudeParams)
    ground: Ground = field(default_factory=Ground)

    def check_joints(self, names: Iterable[str], source: str = "sim_params") -> None:
        """See that the parameters tells of exactly these joints.

        Raises:
            RobotError: A joint is missing or unknown.
        """
        wanted = tuple(names)
        for missing in (name for name in wanted if name not in self.joints):
            raise RobotError(f"{source}: joints.{missing} is missing; {self.robot} has that joint.")
        for extra in (name for name in self.joints if name not in wanted):
            raise RobotError(
                f"{source}: joints.{extra} is not a joint of {self.robot}; "
                f"those are {', '.join(wanted)}."
            )


T = TypeVar("T", JointParams, MachineParams, TrunkParams, AttitudeParams, Ground)

_REQUIRED = ("schema", "robot", "machine", "joints")
_OPTIONAL: dict[str, Any] = {"trunk": TrunkParams, "attitude": AttitudeParams, "ground": Ground}
# Written by who sets a scene up, not by who describes a machine.
_NOT_IN_FILES = ("terrain", "floor")
_VECTORS = ("bias", "gyro_bias", "accelerometer_bias", "com_offset", "inertia_scale")


def with_changes(sim_params: SimParams, **changes: float) -> SimParams:
    """The same machine with a few numbers changed.

    Args:
        sim_params: To start from; it stays as it is.
        changes: `trunk_mass_offset` [kg], `friction` (of the ground), or any number of
            `MachineParams`, as `command_delay_s` or `bus_voltage`; the values replace the old ones.

    Raises:
        RobotError: A name is unknown, or a value impossible.
    """
    numbers = [f.name for f in fields(MachineParams) if f.name not in _VECTORS]
    known = ["trunk_mass_offset", "friction", *numbers]
    for name in changes:
        if name not in known:
            raise RobotError(
                f"a set of parameters has no {name!r} to change; it has {', '.join(known)}."
            )
    machine: dict[str, Any] = {name: changes[name] for name in changes if name in numbers}
    if machine:
        sim_params = replace(sim_params, machine=replace(sim_params.machine, **machine))
    if "trunk_mass_offset" in changes:
        mass = changes["trunk_mass_offset"]
        sim_params = replace(sim_params, trunk=replace(sim_params.trunk, mass_offset=mass))
    if "friction" in changes:
        sim_params = replace(
            sim_params, ground=replace(sim_params.ground, friction=changes["friction"])
        )
    return sim_params


def _number(where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise RobotError(f"{where} is {value!r}; expected a number.")
    return float(value)


def _read(kind: type[T], where: str, entry: Any) -> T:
    """Build one of the dataclasses from a mapping, each field without a default exactly once."""
    if not isinstance(entry, dict):
        raise RobotError(f"{where} is {entry!r}; expected a mapping of its fields.")
    known = {part.name: part for part in fields(kind) if part.name not in _NOT_IN_FILES}
    for name in entry:
        if name not in known:
            raise RobotError(f"{where}.{name} is unknown; the fields are {', '.join(known)}.")
    for name, part in known.items():
        if name not in entry and part.default is MISSING:
            raise RobotError(f"{where}.{name} is missing.")
    values: dict[str, Any] = {}
    for name, value in entry.items():
        if name in _VECTORS:
            if not isinstance(value, list) or len(value) != 3:
                raise RobotError(f"{where}.{name} is {value!r}; expected three numbers.")
            values[name] = tuple(_number(f"{where}.{name}", number) for number in value)
        elif name == "encoder_bits":
            if isinstance(value, bool) or not isinstance(value, int):
                raise RobotError(f"{where}.{name} is {value!r}; expected a whole number.")
            values[name] = value
        else:
            values[name] = _number(f"{where}.{name}", value)
    try:
        return kind(**values)
    except RobotError as error:
        raise RobotError(f"{where}.{error}") from None


def parse_sim_params(body: Any, source: str) -> SimParams:
    """Read a set of parameters from what a YAML file holds.

    Args:
        body: The parsed document.
        source: What to call it in errors, usually its path.

    Raises:
        RobotError: Another schema, a field missing, unknown or of another type, or a machine that
            cannot exist. The sentence names the field.
    """
    if not isinstance(body, dict) or body.get("schema") != SCHEMA:
        got = body.get("schema") if isinstance(body, dict) else type(body).__name__
        hint = " The fields of pronk/truth/1 are the same." if got == "pronk/truth/1" else ""
        raise RobotError(f"{source}: schema {got!r}; this pronk reads {SCHEMA!r}.{hint}")
    known = (*_REQUIRED, *_OPTIONAL)
    for name in body:
        if name not in known:
            raise RobotError(f"{source}: {name} is unknown; the entries are {', '.join(known)}.")
    for name in _REQUIRED:
        if name not in body:
            raise RobotError(f"{source}: {name} is missing.")
    if not isinstance(body["robot"], str):
        raise RobotError(f"{source}: robot is {body['robot']!r}; expected a name.")
    if not isinstance(body["joints"], dict) or not body["joints"]:
        raise RobotError(f"{source}: joints is {body['joints']!r}; expected a mapping by name.")
    return SimParams(
        robot=body["robot"],
        machine=_read(MachineParams, f"{source}: machine", body["machine"]),
        joints={
            str(name): _read(JointParams, f"{source}: joints.{name}", entry)
            for name, entry in body["joints"].items()
        },
        **{
            name: _read(kind, f"{source}: {name}", body[name])
            for name, kind in _OPTIONAL.items()
            if name in body
        },
    )


def load_sim_params(path: Path | str | None = None) -> SimParams:
    """Read a sim_params file.

    Args:
        path: The file; None for the one that ships with pronk, whose match is the paper's Table I.

    Raises:
        RobotError: The file is missing, not YAML, or `parse_sim_params` refuses it.
    """
    path = SHIPPED if path is None else Path(path)
    try:
        body = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RobotError(f"{path}: no such sim_params file; copy {SHIPPED} and edit it.") from None
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise RobotError(f"{path}: cannot be read as YAML ({type(error).__name__}).") from error
    return parse_sim_params(body, str(path))
