"""A usable robot from a bare MJCF or URDF, and the `robot.yaml` that a user then corrects."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from pronk.errors import RobotError
from pronk.robots.load import SCHEMA, DriveEntry, GroupEntry, RobotFile, read_model

NATURAL_HZ, DAMPING_RATIO = 3.0, 0.7
"""Of the joint under its nominal gains, where the model has no position servo."""
_NO_LOAD_SPEED = 30.0
"""[rad/s], where the model does not say; typical of geared robot joints."""
_BAND_HZ = (0.2, 10.0)
_FIELDS = (
    *("effort_limit", "stall_torque", "no_load_speed", "bus_voltage", "gear_ratio", "armature"),
    *("frictionloss", "viscous_damping"),
)
"""Fields of a drive that are written."""


def file_of_model(path: Path) -> RobotFile:
    """Describe a bare model: each hinge is a group of its own.

    Gains are those of the model's position servos, else they give the joint a natural frequency of
    3 Hz and a damping ratio of 0.7 in the default pose. Effort limits come from the actuators or
    joints, else they are twice the torque of gravity and 0.5 rad of stiffness. The default pose is
    the keyframe `home` or the first one, else zero, moved into the ranges. A RobotError says that
    the model has no hinge, or cannot be read.
    """
    read_model(path)
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = False
    model = spec.compile()
    data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    if model.nkey:
        keys = [model.key(i).name for i in range(model.nkey)]
        data.qpos[:] = model.key_qpos[keys.index("home") if "home" in keys else 0]
    hinges = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    if not len(hinges):
        raise RobotError(f"{path}: the model has no hinge joint.")
    for j in hinges:
        if model.jnt_limited[j]:
            at, (low, high) = model.jnt_qposadr[j], model.jnt_range[j]
            if not low < data.qpos[at] < high:
                data.qpos[at] = 0.5 * (low + high)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)
    drives, groups, pose = {}, {}, {}
    for j in hinges:
        name, dof = model.joint(j).name, model.jnt_dofadr[j]
        inertia = float(full[dof, dof])
        if not 0.0 < inertia < math.inf:
            raise RobotError(
                f"{path}: the inertia about joint {name} is {inertia:g} kg m^2; expected a "
                "positive number. Check its axis and the masses behind it."
            )
        stiffness = inertia * (2.0 * math.pi * NATURAL_HZ) ** 2
        damping = 2.0 * DAMPING_RATIO * math.sqrt(stiffness * inertia)
        effort = 2.0 * (abs(float(data.qfrc_bias[dof])) + 0.5 * stiffness)
        if model.jnt_actfrclimited[j]:
            effort = float(model.jnt_actfrcrange[j, 1])
        for i in range(model.nu):
            if model.actuator_trntype[i] or model.actuator_trnid[i, 0] != j:
                continue
            gear = abs(float(model.actuator_gear[i, 0]))
            if model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE and gear == 1.0:
                stiffness = float(model.actuator_gainprm[i, 0]) or stiffness
                damping = -float(model.actuator_biasprm[i, 2]) or damping
            elif model.actuator_ctrllimited[i] and not model.actuator_forcelimited[i]:
                effort = gear * float(model.actuator_ctrlrange[i, 1])
            if model.actuator_forcelimited[i]:
                effort = gear * float(model.actuator_forcerange[i, 1])
        if not effort > 0.0:
            raise RobotError(
                f"{path}: the effort limit of {name} is {effort:g} N m; expected a positive one "
                "(effort in a URDF, forcerange or actuatorfrcrange in MJCF)."
            )
        drives[name] = DriveEntry(
            effort_limit=_short(effort),
            armature=float(model.dof_armature[dof]),
            stall_torque=_short(2.0 * effort),
            no_load_speed=_NO_LOAD_SPEED,
            frictionloss=float(model.dof_frictionloss[dof]),
            viscous_damping=float(model.dof_damping[dof]),
        )
        groups[name] = GroupEntry(
            drive=name, stiffness=_short(stiffness), damping=_short(damping), band_hz=_BAND_HZ
        )
        pose[name] = _short(float(data.qpos[model.jnt_qposadr[j]]))
    kp = [group.stiffness for group in groups.values() if group.stiffness]
    kd = [group.damping for group in groups.values() if group.damping]
    return RobotFile(
        schema=SCHEMA,
        name=path.stem,
        model=path.name,
        drives=drives,
        groups=groups,
        poses={"default": pose},
        grid_stiffness=(_short(0.3 * min(kp)), _short(3.0 * max(kp))),
        grid_damping=(_short(0.1 * min(kd)), _short(4.0 * max(kd))),
    )


def yaml_of_model(path: Path) -> str:
    """Write the `robot.yaml` of a bare model, with comments on what to check."""
    file = file_of_model(path)
    drives = groups = pose = ""
    for name, drive in file.drives.items():
        drives += f"  {_yaml(name)}:\n"
        drives += "".join(f"    {field}: {_yaml(getattr(drive, field))}\n" for field in _FIELDS)
        fields = ("drive", "stiffness", "damping")
        group: dict[str, Any] = {field: getattr(file.groups[name], field) for field in fields}
        groups += f"  {_yaml(name)}: {_yaml({**group, 'band_hz': list(_BAND_HZ)})}\n"
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
    return float(f"{value:.4g}")


def _yaml(value: object) -> str:
    """A name or number as YAML, quoted and with a decimal point where it needs them."""
    flow: dict[str, Any] = {"default_flow_style": True, "sort_keys": False, "width": 1000}
    made: str = yaml.safe_dump([value], allow_unicode=True, **flow)
    return made.strip()[1:-1]
