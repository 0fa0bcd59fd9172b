"""Random robots: numbers of a virtual robot drawn within the tolerances of real machines.

Every number of `TOLERANCES` is drawn uniformly, by itself but for two: the joints of one group
share a part of their torque scale, because the motors of one batch have one magnet material and
one winding; and the friction at the onset of slip moves with the friction while slipping.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from pronk.jump.virtual.sim_params import JointParams, SimParams
from pronk.robots.robot import RobotSpec

Number = float | tuple[float, ...]
"""A parameter: one number, or one for each axis."""

GROUP_TORQUE = 0.06
"""Relative half-width of the factor on `torque_scale` that the joints of one group share [1]."""
_STREAM = 0x707
"""Second half of the seed, which keeps these draws apart from the noise of the same seed."""
_DIGITS = 5
"""Significant digits of a drawn number, so that a YAML file holds it exactly."""


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """How far a number is drawn, uniformly, from a centre."""

    about: Literal["nominal", "centre"]
    """`nominal`: about the robot's own number, `half_width` being a share of it. `centre`: about
    `centre`, whatever the robot's own number is."""
    centre: float = 0.0
    """Centre of the draw, in the unit of the number; of no meaning about the nominal number."""
    half_width: float
    """Half of the width of the draw: a share [1], or in the unit of the number."""
    reason: str
    """Where the width comes from."""


def _relative(half_width: float, reason: str) -> Tolerance:
    return Tolerance(about="nominal", half_width=half_width, reason=reason)


def _absolute(centre: float, half_width: float, reason: str) -> Tolerance:
    return Tolerance(about="centre", centre=centre, half_width=half_width, reason=reason)


TOLERANCES: Mapping[str, Mapping[str, Tolerance]] = {
    "joints": {
        "torque_scale": _relative(0.03, "beside the batch: motor to motor, current sensor"),
        "link_inertia_scale": _relative(0.03, "castings, screws, cables"),
        "rotor_inertia": _relative(0.05, "makers give +-5 to 10 %"),
        "belt_stiffness": _relative(0.2, "belt tension, gear preload"),
        "belt_damping": _relative(0.3, "belt tension, gear preload"),
        "coulomb": _relative(0.3, "preload of gears and seals, grease"),
        "breakaway": _relative(0.3, "moves with coulomb"),
        "stribeck_speed": _relative(0.3, "grease"),
        "presliding_stiffness": _relative(0.2, "grease, preload"),
        "presliding_damping": _relative(0.2, "grease, preload"),
        "viscous": _relative(0.3, "grease and its temperature"),
        "encoder_offset": _absolute(0.0, 0.004, "zeroed by hand against a stop [rad]"),
    },
    "machine": {
        "command_delay_s": _absolute(0.003, 0.002, "half to two and a half 500 Hz cycles [s]"),
        "measurement_delay_s": _absolute(0.00125, 0.00075, "up to a 500 Hz cycle [s]"),
        "drive_lag_s": _absolute(0.0005, 0.0002, "filter of the speed, current loop [s]"),
        "bus_voltage": _absolute(24.1, 1.1, "a 6S battery from nearly flat to full [V]"),
        "bus_resistance": _relative(0.5, "age and cold of the cells"),
    },
    "imu": {
        "gyro_bias": _absolute(0.0, 0.006, "after some minutes of warming up [rad/s]"),
        "accelerometer_bias": _absolute(0.0, 0.08, "8 mg, a MEMS unit's data sheet [m/s^2]"),
    },
    "trunk": {
        "mass_offset": _absolute(
            0.3, 0.6, "another battery, a payload [kg]; training draws -0.4 to 1.6 kg"
        ),
        "com_offset": _absolute(0.0, 0.008, "where battery and computer sit [m]"),
        "inertia_scale": _relative(0.02, "castings, screws, cables"),
    },
    "attitude": {
        "bias": _absolute(0.0, 0.012, "IMU mounted askew by 0.7 degrees [rad]"),
        "yaw_drift": _absolute(0.0, 0.004, "gyro bias that calibration leaves [rad/s]"),
    },
    "ground": {
        "friction": _absolute(0.8, 0.2, "rubber on vinyl to rubber on concrete [1]"),
        "stiffness": _relative(0.4, "shore hardness of the feet, mats"),
        "damping": _relative(0.4, "shore hardness of the feet, mats"),
    },
}
"""Tolerances by part of `SimParams` and name of the number, of a robot of `MASS` and `VOLTAGE`."""
MASS = 12.0
"""Mass of the robot that the tolerance of the trunk's mass is for [kg]; another's is in proportion.
"""
VOLTAGE = 24.0
"""Rated voltage of the drives that the tolerance of the battery is for [V]. Another battery is
drawn about the robot's own number, as far in proportion."""


@dataclass(frozen=True, kw_only=True)
class DrawnNumber:
    """One drawn number of a random robot."""

    parameter: str
    """Part and name of the number, as in `ground.friction`."""
    joint: str = ""
    """Joint that the number belongs to; empty outside of the joints."""
    value: Number


def tolerances_of(robot: RobotSpec) -> Mapping[str, Mapping[str, Tolerance]]:
    """Return the tolerances of a robot, those in kilograms and volts by its mass and drives.

    Args:
        robot: The robot.
    """
    mass_scale = round(float(robot.build_spec().compile().body_mass.sum()) / MASS, 3)
    trunk = dict(TOLERANCES["trunk"])
    trunk["mass_offset"] = replace(
        trunk["mass_offset"],
        centre=trunk["mass_offset"].centre * mass_scale,
        half_width=trunk["mass_offset"].half_width * mass_scale,
    )
    machine = dict(TOLERANCES["machine"])
    battery = machine["bus_voltage"]
    if any(joint.drive.bus_voltage != VOLTAGE for joint in robot.joints):
        share = battery.half_width / battery.centre
        machine["bus_voltage"] = _relative(share, "a battery from nearly flat to full")
    return {**TOLERANCES, "machine": machine, "trunk": trunk}


def draw_body(sim_params: SimParams, robot: RobotSpec, *, seed: int) -> list[DrawnNumber]:
    """Draw a random robot about given parameters.

    Args:
        sim_params: Parameters to draw about; they must have the robot's joints.
        robot: The robot, whose joint groups share a factor on the torque.
        seed: Seed of all draws; the same one gives the same robot.

    Returns:
        Every number of `TOLERANCES`, of each joint those of the joints.
    """
    sim_params.check_joints(robot.joint_names)
    rng = np.random.default_rng([seed, _STREAM])
    tolerances = tolerances_of(robot)
    group_factors = {}
    for group in robot.groups:
        group_factors[group] = 1.0 + GROUP_TORQUE * rng.uniform(-1.0, 1.0)
    drawn_numbers = []
    for joint in robot.joints:
        nominal = sim_params.joints[joint.name]
        drawn = _draw_part(nominal, tolerances["joints"], rng)
        drawn["torque_scale"] = _rounded(drawn["torque_scale"] * group_factors[joint.group])
        drawn["breakaway"] = _breakaway(nominal, drawn["coulomb"])
        for name, value in drawn.items():
            drawn_numbers.append(
                DrawnNumber(parameter=f"joints.{name}", joint=joint.name, value=value)
            )
    for part in ("machine", "imu", "trunk", "attitude", "ground"):
        drawn = _draw_part(getattr(sim_params, part), tolerances[part], rng)
        for name, value in drawn.items():
            drawn_numbers.append(DrawnNumber(parameter=f"{part}.{name}", value=value))
    return drawn_numbers


def _draw_part(
    part: object, tolerances: Mapping[str, Tolerance], rng: np.random.Generator
) -> dict[str, Any]:
    """Draw every number of one part of the parameters, in the order of its tolerances."""
    drawn: dict[str, Any] = {}
    for name, tolerance in tolerances.items():
        nominal = np.asarray(getattr(part, name), dtype=float)
        shift = tolerance.half_width * rng.uniform(-1.0, 1.0, nominal.shape)
        if tolerance.about == "nominal":
            values = nominal * (1.0 + shift)
        else:
            values = tolerance.centre + shift
        if nominal.ndim:
            drawn[name] = tuple(_rounded(value) for value in values)
        else:
            drawn[name] = _rounded(float(values))
    return drawn


def _breakaway(nominal: JointParams, coulomb: float) -> float:
    """Return the friction at the onset of slip, which is never below that while slipping [N m]."""
    ratio = nominal.breakaway / nominal.coulomb if nominal.coulomb else 1.0
    return max(_rounded(coulomb * ratio), coulomb)


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
