"""What is true of a virtual robot, and of nothing else that pronk may look at.

The truth is a file (`pronk/truth/1`) that can be replaced by any other. It says in which ways
the virtual machine differs from the model that is matched and trained in. `pronk.match` and
`pronk.train` must not import this module; a test holds that.

Everything of a joint is in joint coordinates (through the gear) unless its name says motor.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import yaml

from pronk.errors import RobotError

SCHEMA = "pronk/truth/1"
SHIPPED = Path(__file__).with_name("mini_cheetah_truth.yaml")

_INF = math.inf


@dataclass(frozen=True, kw_only=True)
class JointTruth:
    """One joint of the virtual robot."""

    torque_scale: float
    """Torque that the motor gives per torque that its drive believes to give [1]."""
    link_inertia_scale: float
    """Mass and inertia of the link this joint moves, relative to the model's [1]."""
    rotor_inertia: float
    """Inertia of the rotor about its own axis, motor side [kg m^2]."""
    belt_stiffness: float
    """Between rotor (reflected) and link [N m/rad]."""
    belt_damping: float
    """Between rotor (reflected) and link [N m s/rad]."""
    coulomb: float
    """Dry friction of the rotor while it slips [N m]."""
    breakaway: float
    """Dry friction at the onset of slip; the Stribeck peak, not below `coulomb` [N m]."""
    stribeck_speed: float
    """Speed at which the peak has fallen to 1/e of its height over `coulomb` [rad/s]."""
    presliding_stiffness: float
    """Of the bristles before slip, LuGre sigma_0 [N m/rad]."""
    presliding_damping: float
    """Of the bristles, LuGre sigma_1 [N m s/rad]."""
    viscous: float
    """Viscous friction of the rotor [N m s/rad]."""
    encoder_offset: float
    """Reading minus true angle; the drive closes its loop on the reading [rad]."""

    def __post_init__(self) -> None:
        """Refuse a joint that cannot exist.

        Raises:
            RobotError: A value is out of its physical bounds.
        """
        _check_bounds(self, _JOINT_BOUNDS)
        if self.breakaway < self.coulomb:
            raise RobotError(
                f"breakaway is {self.breakaway:g}, below coulomb = {self.coulomb:g}; "
                "friction at the onset of slip is never below that while slipping."
            )


@dataclass(frozen=True, kw_only=True)
class MachineTruth:
    """What the joints share: timing, supply, sensors, the stand."""

    command_delay_s: float
    """From sending a command to the drives acting on it [s]."""
    measurement_delay_s: float
    """From the instant a state was measured to its timestamp [s]."""
    sampling_jitter_s: float
    """Standard deviation of the sampling instant about its tick; the timestamps tell it [s]."""
    timestamp_error_s: float
    """Standard deviation of the timestamp about the sampling instant plus delay [s]."""
    drive_lag_s: float
    """Time constant from what a drive asks for to what its motor gives: sampling, averaging of
    the speed, current loop [s]."""
    bus_voltage: float
    """Open-circuit voltage of the battery [V]."""
    bus_resistance: float
    """Of battery and wiring [ohm]."""
    encoder_bits: int
    """Of the absolute encoder on each rotor, motor side [bit per revolution]."""
    velocity_window_s: float
    """Span over which a drive differentiates its encoder [s]."""
    velocity_noise: float
    """White, standard deviation [rad/s]."""
    position_noise: float
    """Coloured (vibration of the encoder mount), standard deviation [rad]."""
    position_noise_corner_hz: float
    """Corner of the first-order low-pass that colours it [Hz]."""
    torque_noise: float
    """White, of the current measurement as torque, standard deviation [N m]."""
    gyro_noise: float
    """White, standard deviation per sample [rad/s]."""
    gyro_bias: tuple[float, float, float]
    """[rad/s]"""
    accelerometer_noise: float
    """White, standard deviation per sample [m/s^2]."""
    accelerometer_bias: tuple[float, float, float]
    """[m/s^2]"""
    clamp_stiffness: float
    """Of the fixture that holds a clamped link; no fixture is rigid [N m/rad]."""
    clamp_damping: float
    """[N m s/rad]"""
    stand_stiffness: float
    """Of the stand under the body, about each axis; .inf is rigid [N m/rad]."""
    stand_damping: float
    """[N m s/rad]; of no effect with a rigid stand."""

    def __post_init__(self) -> None:
        """Refuse a machine that cannot exist.

        Raises:
            RobotError: A value is out of its physical bounds.
        """
        _check_bounds(self, _MACHINE_BOUNDS)


@dataclass(frozen=True, kw_only=True)
class Truth:
    """The whole truth of a virtual robot."""

    robot: str
    """Name of the robot whose structure it has."""
    machine: MachineTruth
    joints: Mapping[str, JointTruth]

    def check_joints(self, names: Iterable[str], source: str = "truth") -> None:
        """See that the truth tells of exactly these joints.

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


# Lowest and highest possible value; a bound in `_OPEN` is itself impossible.
_ABOVE_ZERO = (0.0, _INF)
_NOT_NEGATIVE = (-0.0, _INF)
_JOINT_BOUNDS: dict[str, tuple[float, float]] = {
    # A body or a motor cannot be nothing; tenfold is a slip of the pen, not a machine.
    "torque_scale": (0.1, 10.0),
    "link_inertia_scale": (0.1, 10.0),
    "rotor_inertia": (1e-9, 1.0),
    "belt_stiffness": (1.0, 1e5),
    "belt_damping": (0.0, 100.0),
    "coulomb": (0.0, 100.0),
    "breakaway": (0.0, 100.0),
    "stribeck_speed": (1e-6, 100.0),
    "presliding_stiffness": (1e-3, 1e6),
    "presliding_damping": (0.0, 100.0),
    "viscous": (0.0, 100.0),
    "encoder_offset": (-0.1, 0.1),
}
_MACHINE_BOUNDS: dict[str, tuple[float, float]] = {
    "command_delay_s": (0.0, 0.5),
    "measurement_delay_s": (0.0, 0.5),
    "sampling_jitter_s": (0.0, 1e-3),
    "timestamp_error_s": (0.0, 1e-3),
    "drive_lag_s": (1e-6, 0.1),
    "bus_voltage": (1.0, 1e3),
    "bus_resistance": (0.0, 10.0),
    "encoder_bits": (4, 32),
    "velocity_window_s": (1e-6, 0.1),
    "velocity_noise": (0.0, 10.0),
    "position_noise": (0.0, 0.1),
    "position_noise_corner_hz": (0.1, 1e5),
    "torque_noise": (0.0, 10.0),
    "gyro_noise": (0.0, 10.0),
    "gyro_bias": (-1.0, 1.0),
    "accelerometer_noise": (0.0, 10.0),
    "accelerometer_bias": (-5.0, 5.0),
    "clamp_stiffness": (1.0, 1e5),
    "clamp_damping": (0.0, 1e3),
    "stand_stiffness": (100.0, _INF),
    "stand_damping": (0.0, 1e3),
}


def _check_bounds(values: object, bounds: Mapping[str, tuple[float, float]]) -> None:
    for name, (low, high) in bounds.items():
        value = getattr(values, name)
        for part in value if isinstance(value, tuple) else (value,):
            if not low <= part <= high:  # refuses NaN as well
                raise RobotError(f"{name} is {part:g}; expected {low:g} to {high:g}.")


T = TypeVar("T", JointTruth, MachineTruth)


def _number(where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise RobotError(f"{where} is {value!r}; expected a number.")
    return float(value)


def _read(kind: type[T], where: str, entry: Any) -> T:
    """Build one of the dataclasses from a mapping, each field exactly once."""
    if not isinstance(entry, dict):
        raise RobotError(f"{where} is {entry!r}; expected a mapping of its fields.")
    known = [field.name for field in fields(kind)]
    for name in entry:
        if name not in known:
            raise RobotError(f"{where}.{name} is unknown; the fields are {', '.join(known)}.")
    for name in known:
        if name not in entry:
            raise RobotError(f"{where}.{name} is missing.")
    values: dict[str, Any] = {}
    for name in known:
        value = entry[name]
        if name.endswith("_bias"):
            if not isinstance(value, list) or len(value) != 3:
                raise RobotError(f"{where}.{name} is {value!r}; expected three numbers.")
            values[name] = tuple(_number(f"{where}.{name}", part) for part in value)
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


def parse_truth(body: Any, source: str) -> Truth:
    """Read a truth from what a YAML file holds.

    Args:
        body: The parsed document.
        source: What to call it in errors, usually its path.

    Raises:
        RobotError: Another schema, a field missing, unknown or of another type, or a machine that
            cannot exist. The sentence names the field.
    """
    if not isinstance(body, dict) or body.get("schema") != SCHEMA:
        got = body.get("schema") if isinstance(body, dict) else type(body).__name__
        raise RobotError(f"{source}: schema {got!r}; this pronk reads {SCHEMA!r}.")
    known = ("schema", "robot", "machine", "joints")
    for name in body:
        if name not in known:
            raise RobotError(f"{source}: {name} is unknown; the entries are {', '.join(known)}.")
    for name in known:
        if name not in body:
            raise RobotError(f"{source}: {name} is missing.")
    if not isinstance(body["robot"], str):
        raise RobotError(f"{source}: robot is {body['robot']!r}; expected a name.")
    if not isinstance(body["joints"], dict) or not body["joints"]:
        raise RobotError(f"{source}: joints is {body['joints']!r}; expected a mapping by name.")
    return Truth(
        robot=body["robot"],
        machine=_read(MachineTruth, f"{source}: machine", body["machine"]),
        joints={
            str(name): _read(JointTruth, f"{source}: joints.{name}", entry)
            for name, entry in body["joints"].items()
        },
    )


def load_truth(path: Path | str | None = None) -> Truth:
    """Read a truth file.

    Args:
        path: The file; None for the one that ships with pronk, whose match is the paper's Table I.

    Raises:
        RobotError: The file is missing, not YAML, or `parse_truth` refuses it.
    """
    path = SHIPPED if path is None else Path(path)
    try:
        body = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RobotError(f"{path}: no such truth file; copy {SHIPPED} and edit it.") from None
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise RobotError(f"{path}: cannot be read as YAML ({type(error).__name__}).") from error
    return parse_truth(body, str(path))
