"""The one MuJoCo model that match, train and trial build on.

The training simulator is mjlab's `DcMotorActuator` on MuJoCo: at the start of each 5 ms step

    torque = clip(stiffness (command - q) - damping qdot, low, high),
    high = min(effort_limit, stall_torque (1 - qdot / no_load_speed)), low its mirror image,

held over the step, integrator implicitfast. The bench gets the very same trajectories from a
native model with no Python in the loop, so `mujoco.rollout` can run it on every core:

- Integrator Euler. Like implicitfast it treats passive joint damping implicitly; unlike it, it
  leaves the forces of native actuators explicit, which is what a torque computed outside is. The
  implicit laws of other simulators (`RobotSpec.law`) are implicitfast at the step of the law.
- One native `dcmotor` a joint, in joint-side units with voltage as the control variable:
  K = V / no_load_speed and R = K V / stall_torque put the torque-speed line where it belongs.
  Torque is K/R times voltage less back-EMF, so the controller gain kp_V = R stiffness / K gives
  the stiffness and kd_V = R damping / K - K the damping, once back-EMF has added its own K^2/R;
  the voltage clipped at V is the torque clipped at stall_torque (+-1 - qdot / no_load_speed), and
  the actuator's saturation is the effort limit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import mujoco
import numpy as np

from pronk.errors import RobotError
from pronk.robots.drive_law import EXPLICIT, DriveLaw
from pronk.robots.robot import Drive, Joint, RobotSpec

_POSITION_INPUT = 1  # dcmotor input_mode: control is a position command
_KP, _KD = 4, 6  # where MuJoCo 3.11 packs controller[0] and controller[2] in actuator_gainprm
_BRISTLE, _FRICTION = slice(5, 7), slice(3, 6)
"""Where it packs lugre[:2] in actuator_dynprm and lugre[2:] in actuator_biasprm."""
_BRISTLE_ANGLE = 0.5
"""Radians that the bristles of dry friction with a Stribeck speed turn a physics step, at a damping
ratio of a half, with the inertia of the joint. They are as stiff as an explicit step allows: of a
servo of the SO-101 280 N m/rad at 5 ms, which is within 2 mrad of bristles a hundred times as stiff
at a twentieth of the step over a step of the command of 0.1 rad."""


def free_spec(robot: RobotSpec) -> mujoco.MjSpec:
    """The robot as it stands, without floor and without actuators.

    Joints have their armature, dry friction and viscous damping; the timestep is the training
    simulator's, the integrator implicitfast; keyframe `default` is the default pose.
    """
    spec = robot.build_spec()
    spec.option.timestep = robot.timestep_s
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for joint in robot.joints:
        _set_passive(spec, joint)
    _add_default_key(spec, robot)
    return spec


def set_law(option: mujoco.MjOption, robot: RobotSpec) -> None:
    """Give options the step and the integrator of a robot's drive law."""
    law, names = robot.law, mujoco.mjtIntegrator
    option.timestep = law.substep(robot.timestep_s)
    explicit = law.kind == "explicit"
    option.integrator = names.mjINT_EULER if explicit else names.mjINT_IMPLICITFAST
    if law.passive_damping == "explicit":
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP


def bench_spec(
    robot: RobotSpec,
    joint_name: str,
    **drives: Mapping[str, float],
) -> mujoco.MjSpec:
    """One joint on the bench: what moves when it is excited, and nothing else.

    The base is fixed, other branches are removed, clamped joints are welded at their default
    position, the other joints of the chain are held by their own drives. There is gravity; there
    are no contacts and no geoms. Keyframe `default` is the default pose and its commands.

    `drives` are `stiffness`, `damping` and `stribeck` of `add_drives`. A RobotError names a joint
    outside the chain that could move with it.
    """
    joint = robot.joint(joint_name)
    spec = robot.build_spec()
    set_law(spec.option, robot)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    remove_geoms(spec)
    base = spec.body(robot.base_body)
    for base_joint in list(base.joints):
        spec.delete(base_joint)
    _remove_other_branches(spec, base, {*joint.chain, *joint.clamped}, joint_name)
    for name in joint.clamped:
        _weld(spec, name, robot.joint(name).default_position)
    for name in joint.chain:
        _set_passive(spec, robot.joint(name))
    add_drives(spec, robot, joint.chain, **drives)
    _add_default_key(spec, robot)
    return spec


def set_inertia(body: Any, model: mujoco.MjModel) -> None:
    """Give a body of a spec the inertia that it has in the compiled model as an explicit one."""
    body.mass = model.body_mass[body.id]
    body.ipos, body.iquat = model.body_ipos[body.id], model.body_iquat[body.id]
    body.inertia = model.body_inertia[body.id]
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.fullinertia = [np.nan] * 6
    body.explicitinertial = True


def remove_geoms(spec: mujoco.MjSpec) -> None:
    """Delete all geoms; bodies whose inertia comes from them keep it as an explicit one."""
    ignored = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    inferred = [body for body in spec.bodies[1:] if ignored or not body.explicitinertial]
    if inferred:
        try:
            model = spec.compile()
        except ValueError as error:
            raise RobotError(f"the model does not compile: {error}.") from None
        for body in inferred:
            set_inertia(body, model)
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    for pair in list(spec.pairs):
        spec.delete(pair)
    for geom in list(spec.geoms):
        spec.delete(geom)


def add_drives(
    spec: mujoco.MjSpec,
    robot: RobotSpec,
    joint_names: Iterable[str],
    *,
    stiffness: Mapping[str, float] = {},
    damping: Mapping[str, float] = {},
    stribeck: Mapping[str, float] = {},
) -> None:
    """Give joints of a spec a native dcmotor each, of the same name; commands are positions [rad].

    Gains by joint name [N m/rad, N m s/rad] replace those of the robot's drives. Of joints with a
    `stribeck` share (see `lugre`) the actuator takes over the dry friction that the joint has.
    """
    for name in (*stiffness, *damping):
        robot.joint(name)
    model = spec.compile() if stribeck else None
    step = spec.option.timestep
    for name in joint_names:
        joint = robot.joint(name)
        drive = joint.drive
        constant, resistance = drive.motor
        kp, kd = stiffness.get(name, joint.stiffness), damping.get(name, joint.damping)
        kp, kd = _voltage_gains(drive, kp, robot.law.damping(kp, kd, step))
        friction = {}
        if model and name in stribeck:
            hinge, inertia = spec.joint(name), float(model.joint(name).M0[0])
            friction["lugre"] = lugre(drive, inertia, hinge.frictionloss, stribeck[name], step)
            hinge.frictionloss = 0.0
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_dcmotor(
            motorconst=[constant, 0.0],
            resistance=resistance,
            saturation=[drive.effort_limit, 0.0, 0.0],
            controller=[kp, 0.0, kd, 0.0, 0.0, drive.bus_voltage],
            input_mode=_POSITION_INPUT,
            **friction,
        )


def set_drive_gains(
    model: mujoco.MjModel,
    joint_name: str,
    drive: Drive,
    stiffness: float,
    damping: float,
    law: DriveLaw = EXPLICIT,
) -> None:
    """Change the gains of one drive in a compiled model, exactly as compiling anew would."""
    index = _index(model, "actuator", model.nu, joint_name)
    damping = law.damping(stiffness, damping, model.opt.timestep)
    model.actuator_gainprm[index, [_KP, _KD]] = _voltage_gains(drive, stiffness, damping)


def lugre(
    drive: Drive, inertia: float, frictionloss: float, stribeck: float, timestep: float
) -> list[float]:
    """Parameters `lugre` of MuJoCo's dcmotor for dry friction that falls with speed.

    Stiffness [N m/rad] and damping [N m s/rad] of the bristles, friction in motion and at rest
    [N m], Stribeck speed [rad/s]. `stribeck` is the share of `frictionloss` that motion takes away.
    """
    damping = inertia * _BRISTLE_ANGLE / timestep
    stiffness = damping * _BRISTLE_ANGLE / timestep
    moving = frictionloss * (1.0 - stribeck)
    return [stiffness, damping, moving, frictionloss, drive.stribeck_speed]


def set_stribeck(
    model: mujoco.MjModel, joint_name: str, drive: Drive, frictionloss: float, stribeck: float
) -> None:
    """Change the dry friction of a joint whose drive was added with `stribeck`, as `lugre`."""
    index = _index(model, "actuator", model.nu, joint_name)
    inertia = float(model.dof_M0[model.joint(joint_name).dofadr[0]])
    values = lugre(drive, inertia, frictionloss, stribeck, model.opt.timestep)
    model.actuator_dynprm[index, _BRISTLE] = values[:2]
    model.actuator_biasprm[index, _FRICTION] = values[2:]


def set_passive(model: mujoco.MjModel, joint_name: str, **values: float) -> None:
    """Change `armature` [kg m^2] or `frictionloss` [N m] of one joint in a compiled model.

    Constants that MuJoCo derives from them are computed anew, so the model is the one that
    compiling with these values would give.
    """
    dof = model.jnt_dofadr[_index(model, "joint", model.njnt, joint_name)]
    for name, value in values.items():
        getattr(model, f"dof_{name}")[dof] = value
    if "armature" in values:
        mujoco.mj_setConst(model, mujoco.MjData(model))


def _index(model: mujoco.MjModel, kind: str, count: int, name: str) -> int:
    """Index of a named joint or actuator of a compiled model."""
    index = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if index < 0:
        names = ", ".join(getattr(model, kind)(i).name for i in range(count))
        raise RobotError(f"the model has no {kind} {name!r}; it has {names}.")
    return int(index)


def _voltage_gains(drive: Drive, stiffness: float, damping: float) -> tuple[float, float]:
    """Controller gains in volts that make the torque law `stiffness`, `damping`."""
    constant, resistance = drive.motor
    return resistance * stiffness / constant, resistance * damping / constant - constant


def _set_passive(spec: mujoco.MjSpec, joint: Joint) -> None:
    """Give a joint of a spec the armature and friction of its drive."""
    hinge, drive = spec.joint(joint.name), joint.drive
    hinge.armature, hinge.frictionloss = drive.armature, drive.frictionloss
    hinge.damping = [drive.viscous_damping, 0.0, 0.0]


def _remove_other_branches(
    spec: mujoco.MjSpec, body: Any, wanted: set[str], joint_name: str
) -> None:
    """Delete, below a body that is still, every branch that moves without the wanted joints."""
    for child in list(body.bodies):
        joints = {joint.name for joint in child.find_all("joint")}
        if joints and not joints & wanted:
            spec.delete(child)
        elif strangers := joints - wanted:
            raise RobotError(
                f"{', '.join(sorted(strangers))} can move when {joint_name} is excited; name them "
                "in its chain (held by their drives) or among its clamped joints."
            )


def _weld(spec: mujoco.MjSpec, joint_name: str, angle: float) -> None:
    """Fix a hinge at an angle: turn its body about the hinge, then delete the hinge."""
    joint = spec.joint(joint_name)
    body = joint.parent
    turn, turned = np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, joint.axis / np.linalg.norm(joint.axis), angle)
    mujoco.mju_mulQuat(turned, body.quat, turn)
    before, after = np.zeros(3), np.zeros(3)
    mujoco.mju_rotVecQuat(before, joint.pos, body.quat)
    mujoco.mju_rotVecQuat(after, joint.pos, turned)
    body.pos = body.pos + before - after
    body.quat = turned
    spec.delete(joint)


def _add_default_key(spec: mujoco.MjSpec, robot: RobotSpec) -> None:
    """Keyframe `default`: the default pose and its commands, the base where the model puts it."""
    model = spec.compile()
    qpos = model.qpos0.copy()
    for joint in robot.joints:
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint.name)
        if index >= 0:
            qpos[model.jnt_qposadr[index]] = joint.default_position
    names = [model.actuator(i).name for i in range(model.nu)]
    ctrl = [robot.joint(name).default_position for name in names]
    spec.add_key(name="default", qpos=qpos, ctrl=ctrl)


def bench_inertia(robot: RobotSpec, joint_name: str) -> tuple[float, float]:
    """Measure the inertia and the pull of gravity of a joint in its bench model.

    Args:
        robot: The robot.
        joint_name: The joint, at the default pose.

    Returns:
        Inertia, armature included [kg m^2], and how much gravity moves the joint back [N m/rad];
        the latter is negative where gravity pulls the joint over.
    """
    model = bench_spec(robot, joint_name).compile()
    data = mujoco.MjData(model)
    dof = int(model.joint(joint_name).dofadr[0])
    step = 1e-3
    bias = {}
    for shift in (step, -step, 0.0):
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qpos[dof] += shift
        mujoco.mj_forward(model, data)
        bias[shift] = float(data.qfrc_bias[dof])
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    # The bias is the torque that holds the pose: where it grows with the angle, gravity pulls back.
    return float(inertia[dof, dof]), (bias[step] - bias[-step]) / (2.0 * step)
