"""Randomized robots: seeded draws around given parameters, within stated tolerances.

`TOLERANCES` has how far each number may lie from the one it is drawn around, and why that far.
Everything else stays. A drawn robot is written as a file (`pronk/sim_params/1`) that `--sim-params`
reads.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import yaml

from pronk.errors import PronkError
from pronk.files import write_text
from pronk.robots.robot import Robot
from pronk.virtual.sim_params import SCHEMA, JointParams, SimParams


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """How far a number is drawn from the one it is drawn around, uniformly."""

    half: float
    """Half-width of the draw."""
    kind: Literal["relative", "about"]
    """`relative`: a share of the number; `about`: about `centre`, whatever the number was."""
    why: str
    centre: float = 0.0


def _relative(half: float, why: str) -> Tolerance:
    return Tolerance(half=half, kind="relative", why=why)


def _about(centre: float, half: float, why: str) -> Tolerance:
    return Tolerance(half=half, kind="about", why=why, centre=centre)


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


def draw(sim_params: SimParams, robot: Robot, *, seed: int) -> SimParams:
    """Draw a randomized robot: every number of `TOLERANCES` anew about given parameters.

    The numbers are rounded to five digits, so that a written file holds them exactly.

    Args:
        sim_params: To draw around.
        robot: Its joints and groups.
        seed: Of the draw. Same seed, same robot.

    Raises:
        RobotError: The parameters are not of this robot, or a drawn robot cannot exist.
    """
    sim_params.check_joints(robot.joint_names)
    rng = np.random.default_rng([seed, 0x707])
    batch = {group: 1.0 + GROUP_TORQUE * rng.uniform(-1.0, 1.0) for group in robot.groups}
    joints: dict[str, JointParams] = {}
    for joint in robot.joints:
        true = sim_params.joints[joint.name]
        drawn = _drawn(true, "joints", rng)
        drawn["torque_scale"] = _rounded(drawn["torque_scale"] * batch[joint.group])
        # Break-away is friction's peak: it moves with the friction, and is never below it.
        ratio = true.breakaway / true.coulomb if true.coulomb else 1.0
        drawn["breakaway"] = max(_rounded(drawn["coulomb"] * ratio), drawn["coulomb"])
        joints[joint.name] = replace(true, **drawn)
    return replace(
        sim_params,
        machine=replace(sim_params.machine, **_drawn(sim_params.machine, "machine", rng)),
        joints=joints,
        trunk=replace(sim_params.trunk, **_drawn(sim_params.trunk, "trunk", rng)),
        attitude=replace(sim_params.attitude, **_drawn(sim_params.attitude, "attitude", rng)),
        ground=replace(sim_params.ground, **_drawn(sim_params.ground, "ground", rng)),
    )


def _drawn(part: object, name: str, rng: np.random.Generator) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for field, tolerance in TOLERANCES[name].items():
        value = getattr(part, field)
        spread = tolerance.half * rng.uniform(-1.0, 1.0, np.shape(value))
        centre = np.asarray(tolerance.centre if tolerance.kind == "about" else value)
        new = centre * (1.0 + spread) if tolerance.kind == "relative" else centre + spread
        values[field] = (
            tuple(_rounded(number) for number in new) if np.ndim(new) else _rounded(float(new))
        )
    return values


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def save_sim_params(path: Path, sim_params: SimParams, *, says: str) -> None:
    """Write parameters as YAML, whole or not at all.

    Args:
        path: The file.
        sim_params: On an empty floor.
        says: What it is and where it comes from, as the comment at its head.

    Raises:
        PronkError: There are blocks or a lowered floor, which a file does not hold.
    """
    if sim_params.ground != replace(sim_params.ground, terrain=(), floor=0.0):
        raise PronkError(f"{path}: a sim_params file holds no terrain; take the blocks away first.")
    body = msgspec.to_builtins(asdict(sim_params))
    for name in ("terrain", "floor"):
        del body["ground"][name]
    joints = body.pop("joints")
    head = "".join(f"# {line}".rstrip() + "\n" for line in says.splitlines())
    text = yaml.safe_dump(
        _lists({"schema": SCHEMA, **body, "joints": joints}),
        default_flow_style=None,
        sort_keys=False,
        width=100,
    )
    write_text(path, f"{head}\n{text}")


def _lists(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _lists(part) for key, part in value.items()}
    return [_lists(part) for part in value] if isinstance(value, tuple) else value
