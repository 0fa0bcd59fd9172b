"""A usable robot from a bare MJCF or URDF, and the `robot.yaml` that a user then corrects."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import yaml
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.errors import RobotError
from pronk.robots.load import SCHEMA, DriveEntry, GroupEntry, RobotFile, read_model

NATURAL_HZ = 3.0
"""Natural frequency of a joint under its nominal gains, where the model has no position servo [Hz]:
a few times that of a leg that swings freely, so that the joint holds its pose."""
DAMPING_RATIO = 0.7
"""Damping ratio of such a joint: the step response overshoots by 5 %."""
NO_LOAD_SPEED = 30.0
"""No-load speed where the model does not say one [rad/s]; typical of geared robot joints."""
BAND_HZ = (0.2, 10.0)
"""Band of a joint of which nothing is known [Hz]."""


@dataclass(frozen=True, kw_only=True)
class _Servo:
    """What the actuators of a model say of one joint."""

    stiffness: float
    """Stiffness [N m/rad]."""
    damping: float
    """Damping [N m s/rad]."""
    effort_limit: float
    """Largest torque [N m]."""


def file_of_model(path: Path) -> RobotFile:
    """Describe a bare model: each hinge is a group of its own.

    Gains are those of the model's position servos, else they give the joint a natural frequency of
    3 Hz and a damping ratio of 0.7 in the default pose. Effort limits come from the actuators or
    joints, else they are twice the torque of gravity and 0.5 rad of stiffness. The default pose is
    the keyframe `home` or the first one, else zero, moved into the ranges.

    Args:
        path: MJCF or URDF.

    Raises:
        RobotError: The model has no hinge, or cannot be read.
    """
    read_model(path)
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = False
    model = spec.compile()
    hinges = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    if not len(hinges):
        raise RobotError(f"{path}: the model has no hinge joint.")
    data = mujoco.MjData(model)
    data.qpos[:] = _default_pose(model, data, hinges)
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)

    drives = {}
    groups = {}
    pose = {}
    stiffnesses = []
    dampings = []
    for hinge in hinges:
        name = model.joint(hinge).name
        dof = model.jnt_dofadr[hinge]
        inertia = float(mass[dof, dof])
        if not 0.0 < inertia < math.inf:
            raise RobotError(
                f"{path}: the inertia about joint {name} is {inertia:g} kg m^2; expected a "
                "positive number. Check its axis and the masses behind it."
            )
        servo = _servo(model, int(hinge), inertia, abs(float(data.qfrc_bias[dof])))
        if not servo.effort_limit > 0.0:
            raise RobotError(
                f"{path}: the effort limit of {name} is {servo.effort_limit:g} N m; expected a "
                "positive one (effort in a URDF, forcerange or actuatorfrcrange in MJCF)."
            )
        drives[name] = DriveEntry(
            effort_limit=_short(servo.effort_limit),
            armature=float(model.dof_armature[dof]),
            stall_torque=_short(2.0 * servo.effort_limit),
            no_load_speed=NO_LOAD_SPEED,
            frictionloss=float(model.dof_frictionloss[dof]),
            viscous_damping=float(model.dof_damping[dof]),
        )
        stiffness = _short(servo.stiffness)
        damping = _short(servo.damping)
        groups[name] = GroupEntry(drive=name, stiffness=stiffness, damping=damping, band_hz=BAND_HZ)
        if stiffness:
            stiffnesses.append(stiffness)
        if damping:
            dampings.append(damping)
        pose[name] = _short(float(data.qpos[model.jnt_qposadr[hinge]]))
    return RobotFile(
        schema=SCHEMA,
        name=path.stem,
        model=path.name,
        drives=drives,
        groups=groups,
        poses={"default": pose},
        grid_stiffness=(_short(0.3 * min(stiffnesses)), _short(3.0 * max(stiffnesses))),
        grid_damping=(_short(0.1 * min(dampings)), _short(4.0 * max(dampings))),
    )


def _default_pose(model: mujoco.MjModel, data: mujoco.MjData, hinges: NDArray[np.int64]) -> Array:
    """Return the pose of the keyframe `home` or the first one, else zero, inside the ranges."""
    pose = np.array(data.qpos)
    if model.nkey:
        keys = [model.key(index).name for index in range(model.nkey)]
        pose[:] = model.key_qpos[keys.index("home") if "home" in keys else 0]
    for hinge in hinges:
        if model.jnt_limited[hinge]:
            address = model.jnt_qposadr[hinge]
            low, high = model.jnt_range[hinge]
            if not low < pose[address] < high:
                pose[address] = 0.5 * (low + high)
    return pose


def _servo(model: mujoco.MjModel, hinge: int, inertia: float, gravity: float) -> _Servo:
    """Return gains and effort limit of a joint, by its actuators or else by its inertia.

    `gravity` is the torque that holds the joint in the default pose [N m].
    """
    stiffness = inertia * (2.0 * math.pi * NATURAL_HZ) ** 2
    damping = 2.0 * DAMPING_RATIO * math.sqrt(stiffness * inertia)
    effort_limit = 2.0 * (gravity + 0.5 * stiffness)
    if model.jnt_actfrclimited[hinge]:
        effort_limit = float(model.jnt_actfrcrange[hinge, 1])
    for index in range(model.nu):
        moves_joint = model.actuator_trntype[index] == mujoco.mjtTrn.mjTRN_JOINT
        if not moves_joint or model.actuator_trnid[index, 0] != hinge:
            continue
        gear = abs(float(model.actuator_gear[index, 0]))
        is_servo = model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_AFFINE
        if is_servo and gear == 1.0:
            stiffness = float(model.actuator_gainprm[index, 0]) or stiffness
            damping = -float(model.actuator_biasprm[index, 2]) or damping
        elif model.actuator_ctrllimited[index] and not model.actuator_forcelimited[index]:
            effort_limit = gear * float(model.actuator_ctrlrange[index, 1])
        if model.actuator_forcelimited[index]:
            effort_limit = gear * float(model.actuator_forcerange[index, 1])
    return _Servo(stiffness=stiffness, damping=damping, effort_limit=effort_limit)


def yaml_of_model(path: Path) -> str:
    """Write the `robot.yaml` of a bare model, with comments on what to check.

    Args:
        path: MJCF or URDF.

    Raises:
        RobotError: The model has no hinge, or cannot be read.
    """
    file = file_of_model(path)
    drives = ""
    groups = ""
    pose = ""
    for name, drive in file.drives.items():
        group = file.groups[name]
        group_entry = {
            "drive": group.drive,
            "stiffness": group.stiffness,
            "damping": group.damping,
            "band_hz": list(BAND_HZ),
        }
        drives += f"""\
  {_yaml(name)}:
    effort_limit: {_yaml(drive.effort_limit)}
    stall_torque: {_yaml(drive.stall_torque)}
    no_load_speed: {_yaml(drive.no_load_speed)}
    bus_voltage: {_yaml(drive.bus_voltage)}
    gear_ratio: {_yaml(drive.gear_ratio)}
    armature: {_yaml(drive.armature)}
    frictionloss: {_yaml(drive.frictionloss)}
    viscous_damping: {_yaml(drive.viscous_damping)}
"""
        groups += f"  {_yaml(name)}: {_yaml(group_entry)}\n"
        pose += f"    {_yaml(name)}: {_yaml(file.poses['default'][name])}\n"
    return f"""\
# Robot of {_yaml(path.name)}. Units: rad, N m, s, kg m^2, V. Check every line marked CHECK,
# then run `pronk robot check` on this file.
schema: {file.schema}
name: {_yaml(file.name)}
model: {_yaml(file.model)}
policy_rate_hz: 50.0  # rate of the commands; timestep_s * decimation * rate must be 1
timestep_s: 0.005     # of the simulator that is matched
decimation: 4
grid_stiffness: {_yaml(list(file.grid_stiffness))}  # range of `pronk match`'s search
grid_damping: {_yaml(list(file.grid_damping))}
# legs: [FR, FL, HR, HL]  # for a robot with legs: prefixes of their joints

drives:  # CHECK against the data sheet: limits, torque-speed line, rotor inertia
{drives}
groups:  # CHECK: gains on the real drives; joints built alike may share a group, with
  # a pattern such as {{joints: "*_knee"}}; `clamped: ["*_hip"]` names joints fixed in the
  # bench test.
{groups}
poses:  # CHECK: the pose of the sweep; a robot that stands up needs `folded` too
  default:
{pose}"""


def _short(value: float) -> float:
    """Round to four significant digits."""
    return float(f"{value:.4g}")


def _yaml(value: object) -> str:
    """Write a name or number as YAML, quoted and with a decimal point where it needs them."""
    text: str = yaml.safe_dump(
        [value], allow_unicode=True, default_flow_style=True, sort_keys=False, width=1000
    )
    return text.strip()[1:-1]  # without the brackets of the list
