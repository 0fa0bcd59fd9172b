"""What the actuators of a model do to each hinge: MuJoCo's compiled numbers, on the joint side.

An actuator whose length changes by `m` when the joint turns by 1 rad (its gear, or the moment of
its tendon) puts `m` times its force on the joint. Its force is

    gain ctrl + biasprm[0] + biasprm[1] length + biasprm[2] velocity,

so a position servo has the stiffness `-biasprm[1] m^2` and the damping `-biasprm[2] m^2`, its force
range times `m` is a torque, and the control range of a motor times its gain and `m` is one too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from pronk.arrays import Array
from pronk.robots.robot import ServoKind

TRANSMISSIONS = (
    mujoco.mjtTrn.mjTRN_JOINT,
    mujoco.mjtTrn.mjTRN_JOINTINPARENT,
    mujoco.mjtTrn.mjTRN_TENDON,
    mujoco.mjtTrn.mjTRN_SLIDERCRANK,
)
"""Transmissions that move joints and not bodies."""


@dataclass(frozen=True, kw_only=True)
class JointServo:
    """The actuators of one joint together; N and N/m in place of N m and N m/rad for a slide."""

    servo_type: ServoKind
    """What they are."""
    actuators: tuple[str, ...] = ()
    """Their names."""
    stiffness: float = 0.0
    """Stiffness of position servos [N m/rad]."""
    damping: float = 0.0
    """Damping of servos and dampers [N m s/rad]."""
    effort_limit: float = math.inf
    """Largest torque in both directions; infinite if the model has none [N m]."""
    effort_source: str = ""
    """Where the effort limit stands."""
    armature: float = 0.0
    """Inertia that the actuators add to the joint's [kg m^2]."""
    is_shared: bool = False
    """Whether an actuator moves other joints too, so that the numbers are those of this joint
    while the others stand still."""
    is_uneven: bool = False
    """Whether the limit of the other direction is larger."""
    has_damper: bool = False
    """Whether the damping is in part that of a damper at its full control."""
    control_scale: str = ""
    """How the control of a position servo differs from the length that it holds, in words; empty
    where it does not."""


def joint_servos(model: mujoco.MjModel, qpos: Array) -> tuple[JointServo, ...]:
    """Describe what drives each joint of a model.

    Args:
        model: The compiled model.
        qpos: Pose in which tendons and cranks are measured.

    Returns:
        One servo a joint.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    count = len(model.actuator_trntype)
    moments = np.zeros((count, model.nv))
    for index in range(count):
        if model.actuator_trntype[index] not in TRANSMISSIONS:
            continue
        row = model.actuator_outadr[index]
        begin = data.moment_rowadr[row]
        columns = slice(begin, begin + data.moment_rownnz[row])
        moments[index, data.moment_colind[columns]] = data.actuator_moment[columns]
    servos = []
    for joint in range(model.njnt):
        servos.append(_joint_servo(model, joint, moments))
    return tuple(servos)


def _joint_servo(model: mujoco.MjModel, joint: int, moments: Array) -> JointServo:
    """Add up the actuators of a joint."""
    dof = model.jnt_dofadr[joint]
    servo_types: list[ServoKind] = []
    names = []
    sources = []
    stiffness = 0.0
    damping = 0.0
    armature = 0.0
    effort_limit = 0.0
    is_shared = False
    is_uneven = False
    has_damper = False
    control_scale = ""
    for index in np.flatnonzero(moments[:, dof]):
        moment = abs(float(moments[index, dof]))
        name = model.actuator(int(index)).name or f"actuator {index}"
        names.append(name)
        is_shared = is_shared or int(np.count_nonzero(moments[index])) > 1
        armature += float(model.actuator_armature[index]) * moment**2
        damping += float(model.actuator_damping[index]) * moment**2
        gain = model.actuator_gainprm[index]
        bias = model.actuator_biasprm[index]
        if model.actuator_gaintype[index] == mujoco.mjtGain.mjGAIN_AFFINE and not gain[0]:
            # Its force is that of a damper times its control.
            control = float(model.actuator_ctrlrange[model.actuator_ctrladr[index], 1])
            damping += -float(gain[2]) * (control or 1.0) * moment**2
            has_damper = True
            continue
        servo_type: ServoKind = "motor"
        if model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_AFFINE:
            stiffness += -float(bias[1]) * moment**2
            damping += -float(bias[2]) * moment**2
            if bias[1] < 0.0:
                servo_type = "position"
                if not math.isclose(gain[0], -bias[1], rel_tol=1e-6) or bias[0]:
                    control_scale = (
                        f"{name} has the gain {gain[0]:.4g} beside the stiffness {-bias[1]:.4g}, "
                        f"and a constant force of {bias[0]:.4g}"
                    )
            elif bias[2] < 0.0:
                servo_type = "velocity"
        servo_types.append(servo_type)
        limit, source, uneven = _force_limit(model, int(index), servo_type)
        effort_limit += limit * moment
        is_uneven = is_uneven or uneven
        if source:
            sources.append(f"{source} of {name}")
    if not servo_types:
        effort_limit = math.inf
    if model.jnt_actfrclimited[joint]:
        limit, uneven = _smaller_side(model.jnt_actfrcrange[joint])
        if limit < effort_limit:
            effort_limit = limit
            is_uneven = uneven
            sources = ["actuatorfrcrange of the joint"]
    combined: ServoKind = "none"
    for servo_type in ("motor", "velocity", "position"):
        if servo_type in servo_types:
            combined = servo_type
    return JointServo(
        servo_type=combined,
        actuators=tuple(names),
        stiffness=stiffness,
        damping=damping,
        effort_limit=effort_limit,
        effort_source=" and ".join(sources),
        armature=armature,
        is_shared=is_shared,
        is_uneven=is_uneven,
        has_damper=has_damper,
        control_scale=control_scale,
    )


def _force_limit(
    model: mujoco.MjModel, index: int, servo_type: ServoKind
) -> tuple[float, str, bool]:
    """Return the largest force of an actuator, where it stands, and whether one side has more."""
    limit = math.inf
    source = ""
    uneven = False
    if model.actuator_forcelimited[index]:
        limit, uneven = _smaller_side(model.actuator_forcerange[index])
        source = "forcerange"
    is_fixed = model.actuator_gaintype[index] == mujoco.mjtGain.mjGAIN_FIXED
    control = model.actuator_ctrladr[index]
    if servo_type == "motor" and is_fixed and model.actuator_ctrllimited[control]:
        side, control_uneven = _smaller_side(model.actuator_ctrlrange[control])
        force = abs(float(model.actuator_gainprm[index, 0])) * side
        if force < limit:
            limit = force
            uneven = control_uneven
            source = "ctrlrange times gain"
    return limit, source, uneven


def _smaller_side(limits: Array) -> tuple[float, bool]:
    """Return the smaller magnitude of a range that is not 0, and whether the other is larger."""
    low, high = abs(float(limits[0])), abs(float(limits[1]))
    if not low or not high:
        return max(low, high), low != high
    return min(low, high), not math.isclose(low, high)
