"""A usable robot from a bare MJCF or URDF, and the `robot.yaml` that a user then corrects.

Each number has a mark: `read` from the model, `derived` from its numbers by a stated rule, or
`CHECK` where the model says nothing and the number is an assumption.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
import yaml

from pronk.arrays import Array
from pronk.errors import RobotError
from pronk.robots.alike_joints import SAME_ASSUMED, alike_joints, quadruped_legs
from pronk.robots.couplings import Followers, couplings_of
from pronk.robots.held_reasons import held_reasons
from pronk.robots.load import SCHEMA, DriveEntry, GroupEntry, HeldPosition, RobotFile
from pronk.robots.servos import JointServo, joint_servos
from pronk.robots.source_model import SourceModel, read_source

NATURAL_HZ = 3.0
"""Natural frequency of a joint under assumed gains [Hz]: a few times that of a leg that swings
freely, so that the joint holds its pose."""
DAMPING_RATIO = 0.7
"""Damping ratio of such a joint: the step response overshoots by 5 %."""
SAG = 0.05
"""Largest angle by which gravity moves a joint under assumed gains from its command [rad]."""
SWING = 0.1
"""Angle at which assumed gains ask for all the torque that gravity leaves of the effort limit
[rad]."""
NO_LOAD_SPEED = 30.0
"""No-load speed where the model does not say one [rad/s], typical of geared robot joints; small
joints are faster and get that of half a radian at their natural frequency."""
BAND_HZ = (0.2, 10.0)
"""Band of a joint of which nothing is known [Hz]."""
EFFORT_SHARE = 0.5
"""Largest share of an effort limit that gravity may ask for in the pose."""
MOST_SAG = 0.1
"""Largest angle by which gravity may move a joint under its own gains in the pose [rad]."""
RELIEF_ROUNDS = 2
"""Times each joint is turned to relieve the drives of gravity."""
RELIEF_ANGLES = 9
"""Angles at which each is tried."""
STOP_DISTANCE = 0.4
"""Distance of the pose from a stop, for a sweep of 0.25 rad and its overshoot [rad]."""
STOP_SHARE = 0.4
"""Largest distance as a share of the range, so that a small range has room on both sides."""
LARGEST_INERTIA = 1e9
"""Inertia about a joint from which on it is taken for a mistake [kg m^2]: 1,000 t at 30 m."""
DECIMATIONS = (4, 5, 10, 20, 40)
"""Physics steps of a command at 50 Hz: steps of 5, 4, 2, 1 and 0.5 ms."""
COMMAND_HZ = 50.0
"""Rate of the commands [Hz]."""
Mark = Literal["read", "derived", "CHECK"]


@dataclass(frozen=True, kw_only=True)
class Remark:
    """Where a number of a robot.yaml comes from."""

    mark: Mark
    """Whether it was read, derived by a rule, or is to be checked because it is assumed."""
    text: str
    """The place in the model, or the rule."""

    @property
    def comment(self) -> str:
        """The remark as the comment behind a line."""
        return f"  # {self.mark}: {self.text}"


@dataclass(frozen=True, kw_only=True)
class ModelDescription:
    """A bare model as a robot file, with a remark on each of its numbers."""

    file: RobotFile
    """The robot."""
    remarks: Mapping[tuple[str, str], Remark]
    """Joint and name of the number to the remark."""
    notes: tuple[str, ...]
    """Sentences on what the model lacks, and on what was left out."""
    held_joints: Mapping[str, str]
    """Joint that is held to the reason, in the words of a comment."""


def describe_model(path: Path) -> ModelDescription:
    """Describe a bare model: each hinge that something drives is a group of its own.

    Gains are those of the model's position servos. Joints without one get gains that give a natural
    frequency of 3 Hz and a damping ratio of 0.7 in the default pose, or stiffer ones where the
    joint is damped or gravity pulls at it, within its effort limit. Effort limits are those of
    actuators or joints, else twice the torque of gravity and of 0.5 rad of stiffness. The default
    pose is the keyframe `home` or the first one, else zero, moved away from the stops and, where
    gravity asks for more than half of an effort limit, to where it asks for less. Slides, ball
    joints, joints that follow another one, hinges with a range below 0.02 rad, and hinges without
    an actuator in a model with actuators are held at that pose.

    Args:
        path: MJCF or URDF.

    Raises:
        RobotError: The model cannot be read or has no hinge that could be driven.
    """
    source = read_source(path)
    model = source.model
    if not source.hinges:
        raise RobotError(
            f"{path}: the model has no hinge joint, which is what pronk matches; it has "
            f"{model.njnt} slides, ball and free joints."
        )
    qpos, moves = _default_pose(source)
    servos = joint_servos(model, qpos)
    held_joints = held_reasons(source, servos)
    hinges = [index for index in source.hinges if source.joint_names[index] not in held_joints]
    if not hinges:
        raise RobotError(
            f"{path}: no hinge joint of the model has a position servo or a motor, and all are "
            f"held: {', '.join(held_joints)}."
        )
    _relieve(source, hinges, servos, qpos, moves)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    gravity = np.abs(data.qfrc_bias - data.qfrc_passive)
    couplings = couplings_of(source, hinges, held_joints, qpos)
    notes = [*source.notes, *couplings.notes]

    scaled = []
    drives = {}
    groups = {}
    pose = {}
    remarks: dict[tuple[str, str], Remark] = {}
    for hinge in hinges:
        name = source.joint_names[hinge]
        dof = model.jnt_dofadr[hinge]
        inertia = float(mass[dof, dof])
        if not 0.0 < inertia < LARGEST_INERTIA:
            raise RobotError(
                f"{path}: the inertia about joint {name} is {inertia:g} kg m^2; expected a "
                f"positive number below {LARGEST_INERTIA:g}. Check its axis, and the masses and "
                "lengths behind it and their units."
            )
        servo = servos[hinge]
        if servo.control_scale:
            scaled.append(servo.control_scale)
        group, drive, joint_remarks = _joint_entries(
            source, hinge, servo, inertia, float(gravity[dof]), couplings.followers.get(hinge)
        )
        groups[name] = group
        drives[name] = drive
        for number, remark in joint_remarks.items():
            remarks[name, number] = remark
        pose[name] = _short(float(qpos[model.jnt_qposadr[hinge]]))
        remarks[name, "pose"] = moves[hinge]
    if scaled:
        notes.append(
            f"the controls of {len(scaled)} position servos are no angles, as their constant force "
            f"or gain says ({scaled[0]}); commands of pronk are angles"
        )
    decimation = _stable_decimation(model, hinges, mass, groups, source.joint_names)
    held_positions = {}
    for name in held_joints:
        held_positions[name] = _held_position(source, source.joint_names.index(name), qpos)
    return ModelDescription(
        file=RobotFile(
            schema=SCHEMA,
            name=path.stem,
            model=path.name,
            drives=drives,
            groups=groups,
            poses={"default": pose},
            held=held_positions,
            policy_rate_hz=COMMAND_HZ,
            timestep_s=1.0 / (COMMAND_HZ * decimation),
            decimation=decimation,
        ),
        remarks=remarks,
        notes=tuple(notes),
        held_joints=held_joints,
    )


def file_of_model(path: Path) -> RobotFile:
    """Describe a bare model as a robot file; see `describe_model`."""
    return describe_model(path).file


def _default_pose(source: SourceModel) -> tuple[Array, dict[int, Remark]]:
    """Return the pose of the keyframe `home` or the first one, else zero, away from the stops."""
    model = source.model
    pose = model.qpos0.copy()
    origin = Remark(mark="CHECK", text="0, as the model has no keyframe")
    if model.nkey:
        keys = [model.key(index).name for index in range(model.nkey)]
        number = keys.index("home") if "home" in keys else 0
        pose[:] = model.key_qpos[number]
        mujoco.mj_normalizeQuat(model, pose)
        origin = Remark(mark="read", text=f"keyframe {keys[number] or number}")
    remarks = {}
    for index in range(model.njnt):
        remarks[index] = origin
        joint_type = model.jnt_type[index]
        moves = joint_type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        if not moves or not model.jnt_limited[index]:
            continue
        address = model.jnt_qposadr[index]
        low, high = model.jnt_range[index]
        distance = 0.0
        if joint_type == mujoco.mjtJoint.mjJNT_HINGE:
            distance = min(STOP_DISTANCE, STOP_SHARE * (high - low))
        angle = float(np.clip(pose[address], low + distance, high - distance))
        if angle != pose[address]:
            remarks[index] = Remark(
                mark="derived",
                text=f"moved from {pose[address]:.4g}, away from the stop "
                f"(range {low:.4g} to {high:.4g})",
            )
            pose[address] = angle
    return pose, remarks


def _relieve(
    source: SourceModel,
    hinges: list[int],
    servos: tuple[JointServo, ...],
    qpos: Array,
    moves: dict[int, Remark],
) -> None:
    """Turn joints, one after the other, until gravity leaves each drive room for a sweep.

    Gravity may take half of an effort limit, and move a joint under the gains of its position servo
    by 0.1 rad. A pose in which it does is kept.

    Args:
        source: The model.
        hinges: The hinges that are driven.
        servos: What drives each joint.
        qpos: The pose, which is changed.
        moves: Remarks on the pose by joint, to which those of the turned joints are added.
    """
    model = copy.copy(source.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(model)
    dofs = model.jnt_dofadr[hinges]
    allowed = np.full(len(hinges), np.inf)
    for number, hinge in enumerate(hinges):
        servo = servos[hinge]
        if servo.effort_limit > 0.0:
            allowed[number] = EFFORT_SHARE * servo.effort_limit
        if servo.servo_type == "position":
            allowed[number] = min(allowed[number], MOST_SAG * servo.stiffness)

    def excess(pose: Array) -> float:
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        load = np.abs(data.qfrc_bias - data.qfrc_passive)[dofs] / allowed
        return float(np.sum(np.maximum(load - 1.0, 0.0)))

    lowest = excess(qpos)
    for hinge in hinges * RELIEF_ROUNDS:
        if lowest <= 0.0:
            return
        address = model.jnt_qposadr[hinge]
        low, high = -math.pi, math.pi
        if model.jnt_limited[hinge]:
            low, high = model.jnt_range[hinge]
        distance = min(STOP_DISTANCE, STOP_SHARE * (high - low))
        before = float(qpos[address])
        best = before
        for angle in np.linspace(low + distance, high - distance, RELIEF_ANGLES):
            qpos[address] = angle
            angle_excess = excess(qpos)
            if angle_excess < 0.99 * lowest:
                lowest = angle_excess
                best = _short(float(angle))
        qpos[address] = best
        if best != before:
            moves[hinge] = Remark(
                mark="derived",
                text=f"moved from {before:.4g}, so that gravity asks for less torque",
            )


def _held_position(source: SourceModel, index: int, qpos: Array) -> HeldPosition:
    """Return the position at which a joint is held: a number, or the list of a quaternion."""
    model = source.model
    begin = model.jnt_qposadr[index]
    joint_type = mujoco.mjtJoint(model.jnt_type[index])
    if joint_type == mujoco.mjtJoint.mjJNT_FREE:
        return tuple(float(value) for value in qpos[begin : begin + 7])
    if joint_type == mujoco.mjtJoint.mjJNT_BALL:
        return tuple(float(value) for value in qpos[begin : begin + 4])
    return float(qpos[begin])


def _joint_entries(
    source: SourceModel,
    hinge: int,
    servo: JointServo,
    inertia: float,
    gravity: float,
    followers: Followers | None,
) -> tuple[GroupEntry, DriveEntry, dict[str, Remark]]:
    """Make the entries of a joint.

    Args:
        source: The model.
        hinge: Index of the joint.
        servo: What drives it.
        inertia: Inertia about it [kg m^2], without its followers.
        gravity: Torque that holds the pose [N m].
        followers: The joints that follow it, if there are any.

    Returns:
        Its group and its drive, and the remarks on their numbers.
    """
    model = source.model
    if followers:
        inertia += followers.inertia
    name = source.joint_names[hinge]
    dof = model.jnt_dofadr[hinge]
    remarks = {}
    has_limit = 0.0 < servo.effort_limit < math.inf
    names = ", ".join(servo.actuators)

    if servo.servo_type == "position":
        stiffness = servo.stiffness
        damping = servo.damping
        mark: Mark = "derived" if servo.is_shared else "read"
        remarks["stiffness"] = Remark(mark=mark, text=f"kp x gear^2 of {names}")
        remarks["damping"] = Remark(mark=mark, text=f"kv x gear^2 of {names}")
        if servo.has_damper:
            remarks["damping"] = Remark(
                mark="derived", text=f"of {names}, the damper at its full control"
            )
        elif not damping:
            remarks["damping"] = Remark(
                mark="read", text=f"{names} has no kv; the joint has its own in drives"
            )
        if servo.is_shared:
            shared = Remark(mark="CHECK", text=f"{names} moves other joints too; those standing")
            remarks["stiffness"] = shared
            remarks["damping"] = shared
    else:
        natural = 2.0 * math.pi * NATURAL_HZ
        passive_damping = servo.damping + float(model.dof_damping[dof])
        candidates = {
            f"{NATURAL_HZ:g} Hz with {inertia:.3g} kg m^2": inertia * natural**2,
            f"{NATURAL_HZ:g} Hz with {passive_damping:.3g} N m s/rad": passive_damping * natural,
            f"{SAG:g} rad under gravity": gravity / SAG,
            "twice the spring of the joint": 2.0 * float(model.jnt_stiffness[hinge]),
        }
        rule = max(candidates, key=lambda name: candidates[name])
        stiffness = candidates[rule]
        if has_limit:
            available = max(servo.effort_limit - gravity, 0.2 * servo.effort_limit) / SWING
            if available < stiffness:
                stiffness = available
                rule = f"the effort limit less gravity at {SWING:g} rad"
        rule = f"assumed, {rule}"
        remarks["stiffness"] = Remark(mark="CHECK", text=rule)
        damping = servo.damping
        remarks["damping"] = Remark(mark="read", text=f"kv x gear^2 of {names}")
        if not damping:
            damping = 2.0 * DAMPING_RATIO * math.sqrt(stiffness * inertia)
            text = f"assumed, damping ratio {DAMPING_RATIO:g}"
            remarks["damping"] = Remark(mark="CHECK", text=text)
        if servo.servo_type == "motor":
            text = f"{names} is a motor, its gains are in no model"
        else:
            text = "a URDF has no gains" if source.is_urdf else "no actuator moves it"
        remarks["servo"] = Remark(mark="read", text=text)

    if has_limit:
        effort_limit = servo.effort_limit
        place = "effort of the joint's limit" if source.is_urdf else servo.effort_source
        remarks["effort_limit"] = Remark(mark="read", text=place)
        if servo.is_uneven or servo.is_shared:
            reason = "the smaller of two unequal sides" if servo.is_uneven else "moves others too"
            remarks["effort_limit"] = Remark(mark="CHECK", text=f"{place}; {reason}")
    else:
        effort_limit = _short(2.0 * (gravity + 0.5 * stiffness))
        text = "the model has no limit; twice gravity and 0.5 rad of stiffness"
        remarks["effort_limit"] = Remark(mark="CHECK", text=text)
    remarks["stall_torque"] = Remark(mark="CHECK", text="assumed, twice the effort limit")
    no_load_speed = _short(max(NO_LOAD_SPEED, 0.5 * math.sqrt(stiffness / inertia)))
    remarks["no_load_speed"] = Remark(mark="CHECK", text="assumed; the model has no speed limit")
    if name in source.speed_limits:
        no_load_speed = source.speed_limits[name]
        remarks["no_load_speed"] = Remark(
            mark="read", text="velocity of the joint's limit, as if it were the no-load speed"
        )
    passive = {
        "armature": float(model.dof_armature[dof]) + servo.armature,
        "frictionloss": float(model.dof_frictionloss[dof]),
        "viscous_damping": float(model.dof_damping[dof]),
    }
    followed = {}
    if followers:
        followed = {
            "armature": followers.inertia,
            "frictionloss": followers.frictionloss,
            "viscous_damping": followers.viscous_damping,
        }
    missing = {
        "armature": "0 in the model; a real rotor has inertia",
        "frictionloss": "0 in the model; a real gear has dry friction",
    }
    for number, value in passive.items():
        remarks[number] = Remark(mark="read", text="the joint")
        if not value and number in missing:
            remarks[number] = Remark(mark="CHECK", text=missing[number])
        if followers and followed[number]:
            # Followers that turn against the hinge make it lighter, which no armature can.
            passive[number] = _short(max(0.0, value + followed[number]))
            names_of_followers = ", ".join(followers.names)
            remarks[number] = Remark(
                mark="derived",
                text=f"the joint's {value:.4g} and the share of {names_of_followers}",
            )
    for number in ("bus_voltage", "gear_ratio"):
        remarks[number] = Remark(mark="CHECK", text="assumed; a model does not say it")
    remarks["band_hz"] = Remark(mark="CHECK", text="assumed")

    drive = DriveEntry(
        effort_limit=effort_limit,
        stall_torque=_short(2.0 * effort_limit),
        no_load_speed=no_load_speed,
        armature=passive["armature"],
        frictionloss=passive["frictionloss"],
        viscous_damping=passive["viscous_damping"],
    )
    if servo.servo_type != "position":
        stiffness = _short(stiffness)
        damping = damping if servo.damping else _short(damping)
    group = GroupEntry(
        drive=name, stiffness=stiffness, damping=damping, band_hz=BAND_HZ, servo=servo.servo_type
    )
    return group, drive, remarks


def _stable_decimation(
    model: mujoco.MjModel,
    hinges: list[int],
    mass: Array,
    groups: Mapping[str, GroupEntry],
    names: tuple[str, ...],
) -> int:
    """Return the fewest physics steps of a command with which the explicit law is stable."""
    dofs = model.jnt_dofadr[hinges]
    inertia = mass[np.ix_(dofs, dofs)]
    stiffness = np.diag([groups[names[hinge]].stiffness or 0.0 for hinge in hinges])
    damping = np.diag([groups[names[hinge]].damping or 0.0 for hinge in hinges])
    passive = np.diag(model.dof_damping[dofs])
    identity = np.eye(len(hinges))
    for decimation in DECIMATIONS:
        step = 1.0 / (COMMAND_HZ * decimation)
        scaled = np.linalg.pinv(inertia + step * passive) * step
        speed_by_angle = -scaled @ stiffness
        speed_by_speed = identity - scaled @ (damping + passive)
        transition = np.block(
            [
                [identity + step * speed_by_angle, step * speed_by_speed],
                [speed_by_angle, speed_by_speed],
            ]
        )
        if np.max(np.abs(np.linalg.eigvals(transition))) < 1.0:
            return decimation
    return DECIMATIONS[-1]


def yaml_of_model(path: Path) -> str:
    """Write the `robot.yaml` of a bare model, with a comment on each number.

    Args:
        path: MJCF or URDF.

    Raises:
        RobotError: The model has no hinge, or cannot be read.
    """
    description = describe_model(path)
    file = description.file
    drives = ""
    groups = ""
    pose = ""
    assumed: dict[str, set[str]] = {name: set() for name in file.groups}
    for (name, number), remark in description.remarks.items():
        if remark.mark == "CHECK" and number != "pose":
            assumed[name].add(number)
    alike = alike_joints(file, [*file.groups, *description.held_joints], assumed)
    for group_name, joints in alike.items():
        # Of numbers that are assumed, those of the joint that needs the most.
        first = max(joints, key=lambda joint: file.groups[joint].stiffness or 0.0)
        group = file.groups[first]
        drive = file.drives[first]
        numbers = {
            "effort_limit": drive.effort_limit,
            "stall_torque": drive.stall_torque,
            "no_load_speed": drive.no_load_speed,
            "bus_voltage": drive.bus_voltage,
            "gear_ratio": drive.gear_ratio,
            "armature": drive.armature,
            "frictionloss": drive.frictionloss,
            "viscous_damping": drive.viscous_damping,
        }
        entries: dict[str, object] = {}
        comment = ""
        if len(joints) > 1:
            entries["joints"] = f"*_{group_name}"
            comment = f"  # of {first}; the others have the same numbers"
            if assumed[first]:
                comment += f", or assumed ones within {100 * SAME_ASSUMED:g} %"
        entries["drive"] = group_name
        if group.servo not in (None, "position"):
            entries["servo"] = group.servo
        entries["stiffness"] = group.stiffness
        entries["damping"] = group.damping
        entries["band_hz"] = list(BAND_HZ)
        drives += f"  {_yaml(group_name)}:{comment}\n"
        drives += _lines(description, first, numbers)
        groups += f"  {_yaml(group_name)}:\n"
        groups += _lines(description, first, entries)
    for name, angle in file.poses["default"].items():
        comment = description.remarks[name, "pose"].comment
        pose += f"    {_yaml(name)}: {_yaml(angle)}{comment}\n"
    legs = quadruped_legs(alike)
    legs_line = "# legs: [FR, FL, HR, HL]  # for a robot with legs: prefixes of their joints"
    if legs:
        legs_line = f"legs: {_yaml(list(legs))}  # derived: four joints of the same place begin so"
    held_lines = ""
    if description.held_joints:
        held_lines = "\nheld:  # joints that stand still at these positions, and need no gains\n"
        for name, reason in description.held_joints.items():
            position = file.held[name]
            value = list(position) if isinstance(position, tuple) else position
            held_lines += f"  {_yaml(name)}: {_yaml(value)}  # {reason}\n"
    notes = ""
    for note in description.notes:
        notes += f"# CHECK: {' '.join(note.split())}.\n"
    step = "of the simulator that is matched"
    if file.decimation != DECIMATIONS[0]:
        step = "derived: the longest at which the explicit drive law is stable with these gains"
    return f"""\
# Robot of {_yaml(path.name)}. Units: rad, N m, s, kg m^2, V, at the joint. Each number is read from
# the model, derived from it, or assumed: check every line marked CHECK, then run
# `pronk robot check` on this file.
{notes}schema: {file.schema}
name: {_yaml(file.name)}
model: {_yaml(file.model)}
# timestep_s * decimation * policy_rate_hz must be 1.
policy_rate_hz: {_yaml(file.policy_rate_hz)}  # CHECK: rate of the commands
timestep_s: {_yaml(file.timestep_s)}  # {step}
decimation: {file.decimation}
# grid_stiffness and grid_damping, the ranges of `pronk match --method paper`, follow from the gains
# below unless they are given here.
{legs_line}

drives:
{drives}
groups:  # joints built alike share a group, with a pattern such as {{joints: "*_knee"}};
  # `clamped: ["*_hip"]` names joints fixed in the bench test. `servo` says what the model has in
  # place of a position servo; remove it once the gains are those of the real drive.
{groups}{held_lines}
poses:  # the pose of the sweep; a robot that stands up needs `folded` too
  default:
{pose}"""


def _lines(description: ModelDescription, name: str, numbers: Mapping[str, object]) -> str:
    """Write numbers of a joint, a line each with the remark on it."""
    text = ""
    for number, value in numbers.items():
        remark = description.remarks.get((name, number))
        comment = remark.comment if remark else ""
        text += f"    {number}: {_yaml(value)}{comment}\n"
    return text


def _short(value: float) -> float:
    """Round to four significant digits."""
    return float(f"{value:.4g}")


def _yaml(value: object) -> str:
    """Write a name or number as YAML, quoted and with a decimal point where it needs them."""
    text: str = yaml.safe_dump(
        [value], allow_unicode=True, default_flow_style=True, sort_keys=False, width=1000
    )
    return text.strip()[1:-1]  # without the brackets of the list
