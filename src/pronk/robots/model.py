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

POSITION_INPUT = 1
"""Value of `input_mode` of a dcmotor whose control is a position command."""
STIFFNESS_COLUMN = 4
"""Column of actuator_gainprm in which MuJoCo 3.11 packs controller[0], the proportional gain."""
DAMPING_COLUMN = 6
"""Column of actuator_gainprm in which MuJoCo 3.11 packs controller[2], the derivative gain."""
BRISTLE_COLUMNS = slice(5, 7)
"""Columns of actuator_dynprm in which MuJoCo 3.11 packs lugre[:2]."""
FRICTION_COLUMNS = slice(3, 6)
"""Columns of actuator_biasprm in which MuJoCo 3.11 packs lugre[2:]."""
BRISTLE_ANGLE = 0.5
"""Angle by which the bristles of dry friction with a Stribeck speed turn in a physics step, at a
damping ratio of a half, with the inertia of the joint [rad]. They are as stiff as an explicit step
allows: of a servo of the SO-101 280 N m/rad at 5 ms, which is within 2 mrad of bristles a hundred
times as stiff at a twentieth of the step over a step of the command of 0.1 rad."""
NO_VALUES: Mapping[str, float] = {}
"""Values of no joint."""


def free_spec(robot: RobotSpec) -> mujoco.MjSpec:
    """Build the robot as it stands, without floor and without actuators.

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
    law = robot.law
    option.timestep = law.substep(robot.timestep_s)
    if law.kind == "explicit":
        option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    else:
        option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    if law.passive_damping == "explicit":
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP


def bench_spec(
    robot: RobotSpec,
    joint_name: str,
    *,
    stiffness: Mapping[str, float] = NO_VALUES,
    damping: Mapping[str, float] = NO_VALUES,
    stribeck: Mapping[str, float] = NO_VALUES,
) -> mujoco.MjSpec:
    """Build one joint on the bench: what moves when it is excited, and nothing else.

    The base is fixed, other branches are removed, clamped joints are welded at their default
    position, the other joints of the chain are held by their own drives. There is gravity; there
    are no contacts and no geoms. Keyframe `default` is the default pose and its commands.

    Args:
        robot: The robot.
        joint_name: Joint that is excited.
        stiffness: Stiffness of some drives, as of `add_drives` [N m/rad].
        damping: Damping of some drives [N m s/rad].
        stribeck: Share of the dry friction of some drives that motion takes away.

    Raises:
        RobotError: A joint outside of the chain could move with it.
    """
    joint = robot.joint(joint_name)
    spec = robot.build_spec()
    set_law(spec.option, robot)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    # A chain is one island; to look for more takes a tenth of a step.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    remove_geoms(spec)
    for base_joint in list(spec.body(robot.base_body).joints):
        spec.delete(base_joint)
    bench_joints = {*joint.chain, *joint.clamped}
    _remove_other_branches(spec, spec.worldbody, bench_joints, joint_name)
    for name in joint.clamped:
        _weld(spec, name, robot.joint(name).default_position)
    for name in joint.chain:
        _set_passive(spec, robot.joint(name))
    add_drives(spec, robot, joint.chain, stiffness=stiffness, damping=damping, stribeck=stribeck)
    _add_default_key(spec, robot)
    return spec


def set_inertia(body: Any, model: mujoco.MjModel) -> None:
    """Give a body of a spec the inertia that it has in the compiled model as an explicit one."""
    body.mass = model.body_mass[body.id]
    body.ipos = model.body_ipos[body.id]
    body.iquat = model.body_iquat[body.id]
    body.inertia = model.body_inertia[body.id]
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.fullinertia = [np.nan] * 6
    body.explicitinertial = True


def remove_geoms(spec: mujoco.MjSpec) -> None:
    """Delete all geoms; bodies whose inertia comes from them keep it as an explicit one."""
    from_geoms = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    ignores_explicit = spec.compiler.inertiafromgeom == from_geoms
    inferred = []
    for body in spec.bodies[1:]:
        if ignores_explicit or not body.explicitinertial:
            inferred.append(body)
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
    stiffness: Mapping[str, float] = NO_VALUES,
    damping: Mapping[str, float] = NO_VALUES,
    stribeck: Mapping[str, float] = NO_VALUES,
) -> None:
    """Give joints of a spec a native dcmotor each, of the same name; commands are positions [rad].

    Args:
        spec: Model to add them to.
        robot: The robot.
        joint_names: Joints that get a drive.
        stiffness: Stiffness by joint [N m/rad]; that of the robot's drive where none is given.
        damping: Damping by joint [N m s/rad]; that of the robot's drive where none is given.
        stribeck: Share of the dry friction that motion takes away, by joint. Of these joints the
            actuator takes over the dry friction (`lugre_parameters`).

    Raises:
        RobotError: A gain is of a joint that the robot does not have.
    """
    for name in (*stiffness, *damping):
        robot.joint(name)  # raises RobotError for an unknown joint
    model = spec.compile() if stribeck else None
    timestep = spec.option.timestep
    for name in joint_names:
        joint = robot.joint(name)
        drive = joint.drive
        constant, resistance = drive.motor
        joint_stiffness = stiffness.get(name, joint.stiffness)
        joint_damping = damping.get(name, joint.damping)
        law_damping = robot.law.damping(joint_stiffness, joint_damping, timestep)
        stiffness_gain, damping_gain = _voltage_gains(drive, joint_stiffness, law_damping)
        friction = {}
        if model and name in stribeck:
            hinge = spec.joint(name)
            inertia = float(model.joint(name).M0[0])
            friction["lugre"] = lugre_parameters(
                drive, inertia, hinge.frictionloss, stribeck[name], timestep
            )
            hinge.frictionloss = 0.0
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_dcmotor(
            motorconst=[constant, 0.0],
            resistance=resistance,
            saturation=[drive.effort_limit, 0.0, 0.0],
            controller=[stiffness_gain, 0.0, damping_gain, 0.0, 0.0, drive.bus_voltage],
            input_mode=POSITION_INPUT,
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
    index = _actuator_index(model, joint_name)
    damping = law.damping(stiffness, damping, model.opt.timestep)
    stiffness_gain, damping_gain = _voltage_gains(drive, stiffness, damping)
    model.actuator_gainprm[index, STIFFNESS_COLUMN] = stiffness_gain
    model.actuator_gainprm[index, DAMPING_COLUMN] = damping_gain


def lugre_parameters(
    drive: Drive, inertia: float, frictionloss: float, stribeck: float, timestep: float
) -> list[float]:
    """Return the parameters `lugre` of MuJoCo's dcmotor for dry friction that falls with speed.

    Args:
        drive: Drive with a Stribeck speed.
        inertia: Inertia about the joint [kg m^2].
        frictionloss: Dry friction at rest [N m].
        stribeck: Share of it that motion takes away.
        timestep: Physics step [s].

    Returns:
        Stiffness [N m/rad] and damping [N m s/rad] of the bristles, friction in motion and at rest
        [N m], Stribeck speed [rad/s].
    """
    bristle_damping = inertia * BRISTLE_ANGLE / timestep
    bristle_stiffness = bristle_damping * BRISTLE_ANGLE / timestep
    sliding_friction = frictionloss * (1.0 - stribeck)
    return [
        bristle_stiffness,
        bristle_damping,
        sliding_friction,
        frictionloss,
        drive.stribeck_speed,
    ]


def set_stribeck(
    model: mujoco.MjModel, joint_name: str, drive: Drive, frictionloss: float, stribeck: float
) -> None:
    """Change the dry friction of a joint whose drive was added with `stribeck`."""
    index = _actuator_index(model, joint_name)
    inertia = float(model.dof_M0[model.joint(joint_name).dofadr[0]])
    values = lugre_parameters(drive, inertia, frictionloss, stribeck, model.opt.timestep)
    model.actuator_dynprm[index, BRISTLE_COLUMNS] = values[:2]
    model.actuator_biasprm[index, FRICTION_COLUMNS] = values[2:]


def set_passive(
    model: mujoco.MjModel,
    joint_name: str,
    *,
    armature: float | None = None,
    frictionloss: float | None = None,
) -> None:
    """Change armature [kg m^2] or dry friction [N m] of one joint in a compiled model.

    Constants that MuJoCo derives from them are computed anew, so the model is the one that
    compiling with these values would give.
    """
    dof = model.jnt_dofadr[_joint_index(model, joint_name)]
    if frictionloss is not None:
        model.dof_frictionloss[dof] = frictionloss
    if armature is not None:
        model.dof_armature[dof] = armature
        mujoco.mj_setConst(model, mujoco.MjData(model))


def _joint_index(model: mujoco.MjModel, name: str) -> int:
    """Return the index of a joint of a compiled model; a RobotError lists the joints."""
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
    if index < 0:
        names = [model.joint(number).name for number in range(model.njnt)]
        raise RobotError(f"the model has no joint {name!r}; it has {', '.join(names)}.")
    return int(index)


def _actuator_index(model: mujoco.MjModel, name: str) -> int:
    """Return the index of an actuator of a compiled model; a RobotError lists the actuators."""
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)
    if index < 0:
        names = [model.actuator(number).name for number in range(model.nu)]
        raise RobotError(f"the model has no actuator {name!r}; it has {', '.join(names)}.")
    return int(index)


def _voltage_gains(drive: Drive, stiffness: float, damping: float) -> tuple[float, float]:
    """Return the controller gains in volts that make the torque law `stiffness`, `damping`."""
    constant, resistance = drive.motor
    stiffness_gain = resistance * stiffness / constant
    damping_gain = resistance * damping / constant - constant
    return stiffness_gain, damping_gain


def _set_passive(spec: mujoco.MjSpec, joint: Joint) -> None:
    """Give a joint of a spec the armature and friction of its drive."""
    hinge = spec.joint(joint.name)
    hinge.armature = joint.drive.armature
    hinge.frictionloss = joint.drive.frictionloss
    hinge.damping = [joint.drive.viscous_damping, 0.0, 0.0]
    # The drive has the effort limit; a limit of the model's own would cut its torque too.
    hinge.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE


def _remove_other_branches(
    spec: mujoco.MjSpec, body: Any, bench_joints: set[str], joint_name: str
) -> None:
    """Delete, below a body that is still, every branch that has none of the bench's joints."""
    for child in list(body.bodies):
        joints = {joint.name for joint in child.find_all("joint")}
        strangers = joints - bench_joints
        if not joints:
            continue
        if not joints & bench_joints:
            spec.delete(child)
        elif not len(child.joints):
            _remove_other_branches(spec, child, bench_joints, joint_name)
        elif strangers:
            raise RobotError(
                f"{', '.join(sorted(strangers))} can move when {joint_name} is excited; name them "
                "in its chain (held by their drives) or among its clamped joints."
            )


def _weld(spec: mujoco.MjSpec, joint_name: str, angle: float) -> None:
    """Fix a hinge at an angle: turn its body about the hinge, then delete the hinge."""
    joint = spec.joint(joint_name)
    angle -= joint.ref
    body = joint.parent
    rotation = np.zeros(4)
    mujoco.mju_axisAngle2Quat(rotation, joint.axis / np.linalg.norm(joint.axis), angle)
    quat = np.zeros(4)
    mujoco.mju_mulQuat(quat, body.quat, rotation)
    # The hinge stays where it is, so the body moves by what its rotation moves the hinge.
    hinge_before = np.zeros(3)
    mujoco.mju_rotVecQuat(hinge_before, joint.pos, body.quat)
    hinge_after = np.zeros(3)
    mujoco.mju_rotVecQuat(hinge_after, joint.pos, quat)
    body.pos = body.pos + hinge_before - hinge_after
    body.quat = quat
    spec.delete(joint)


def _add_default_key(spec: mujoco.MjSpec, robot: RobotSpec) -> None:
    """Add keyframe `default`: the default pose, its commands, and the base as the model has it."""
    model = spec.compile()
    qpos = model.qpos0.copy()
    for joint in robot.joints:
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint.name)
        if index >= 0:
            qpos[model.jnt_qposadr[index]] = joint.default_position
    ctrl = []
    for index in range(model.nu):
        ctrl.append(robot.joint(model.actuator(index).name).default_position)
    spec.add_key(name="default", qpos=qpos, ctrl=ctrl)


def model_at_zero(robot: RobotSpec) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the model of a robot, and its kinematics with all joints at zero.

    Args:
        robot: The robot.
    """
    model = robot.build_spec().compile()
    return model, kinematics(model, dict.fromkeys(robot.joint_names, 0.0))


def kinematics(model: mujoco.MjModel, position: Mapping[str, float]) -> mujoco.MjData:
    """Return where the bodies of a model are in a pose, with their centres of mass.

    Args:
        model: The model.
        position: Position by joint [rad] or [m]; other joints are as in the model.
    """
    data = mujoco.MjData(model)
    for name, joint_position in position.items():
        data.qpos[model.joint(name).qposadr[0]] = joint_position
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


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
