"""Read a robot from its `robot.yaml`, or from a bare MJCF or URDF.

`robot.yaml` (schema `pronk/robot/1`) names the model beside it and holds what a model does not:
drives, gains, groups, poses, what is clamped in a bench test, and which joints mirror each other.
Ranges, axes, inertias and kinematic chains come from the model. Joint patterns are those of a shell
(`*_knee`). Joints that are no hinges, and those named under `held`, stand still. A claimed mirror
symmetry is verified with the model's mass matrix and bias forces.
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
import mujoco
import numpy as np
from msgspec import Meta

from pronk.errors import RobotError
from pronk.files import converted, read_yaml
from pronk.robots.held_model import POSITIONS, held_mjcf
from pronk.robots.held_reasons import held_reasons
from pronk.robots.limits import OperatingLimits, StandingUp
from pronk.robots.robot import Drive, Joint, RobotSpec, ServoKind
from pronk.robots.servos import joint_servos
from pronk.robots.source_model import (
    MUJOCO_ERRORS,
    TURN_READ_AS_DEGREES,
    SourceModel,
    read_source,
)

T = TypeVar("T")

SCHEMA = "pronk/robot/1"
MIRROR_TOLERANCE = 1e-9
"""Largest relative difference of inertia and bias forces of joints that mirror each other."""
POSE_ROUNDING = 1e-3
"""Distance by which a pose may be outside of a range by its rounding to four digits [rad]."""
MOTOR_FACTORS = {1: (1.0, 1.0), 3: (1.5, 2.0)}
"""Torque over `kt i` and back-EMF over `kt omega`, by the number of phases. Of a three-phase motor
with peak currents, as in Cheetah-Software's ActuatorModel.h, torque is 1.5 kt i, and the back-EMF
that fits under the bus voltage 2 kt omega."""
_MAY_BE_INFINITE = ("limits.tilt",)
"""Numbers of a robot file that may be infinite: a hung robot has no limit of its tilt."""
_Positive = Annotated[float, Meta(gt=0.0)]
_NotNegative = Annotated[float, Meta(ge=0.0)]
_Band = tuple[_Positive, _Positive]
HeldPosition = float | tuple[float, ...]
"""Position of a joint that is held: of a slide [m], of a hinge [rad], or with a quaternion."""


class _Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A part of a `robot.yaml`."""


class DriveEntry(_Entry, frozen=True):
    """A drive: its torque-speed line or the motor's constants, from which the line follows.

    The torque is at most effort_limit and at most the line from stall_torque at rest to nothing at
    no_load_speed. corner_speed, where the two meet, may stand in place of stall_torque.
    """

    effort_limit: _Positive
    bus_voltage: _Positive = 24.0
    gear_ratio: _Positive = 1.0
    rotor_inertia: _NotNegative | None = None
    armature: _NotNegative | None = None
    stall_torque: _Positive | None = None
    corner_speed: _NotNegative | None = None
    no_load_speed: _Positive | None = None
    torque_constant: _Positive | None = None
    joint_torque_constant: _Positive | None = None
    resistance: _Positive | None = None
    phases: int = 3
    frictionloss: _NotNegative = 0.0
    viscous_damping: _NotNegative = 0.0
    stribeck_speed: _NotNegative = 0.0

    def drive(self, source: str) -> Drive:
        """Make the drive; a RobotError names what is missing of its torque-speed line."""
        if self.phases not in MOTOR_FACTORS:
            raise RobotError(f"{source}: phases is {self.phases}; expected 1 (brushed) or 3.")
        if self.armature is not None and self.rotor_inertia is not None:
            raise RobotError(f"{source}: give rotor_inertia or armature, not both.")
        gear_ratio = self.gear_ratio
        voltage = self.bus_voltage
        torque_factor, emf_factor = MOTOR_FACTORS[self.phases]
        torque_constant = self.torque_constant
        if self.joint_torque_constant is not None:
            torque_constant = self.joint_torque_constant / gear_ratio
        resistance = self.resistance
        stall_torque = self.stall_torque
        no_load_speed = self.no_load_speed
        if self.corner_speed is not None:
            stall_torque = self._stall_torque_of_corner(self.corner_speed, source)
        if torque_constant is not None and resistance is not None:
            stall_torque = torque_factor * gear_ratio * torque_constant * voltage / resistance
            no_load_speed = voltage / (emf_factor * gear_ratio * torque_constant)
        elif stall_torque is not None and no_load_speed is not None:
            torque_constant = voltage / (emf_factor * gear_ratio * no_load_speed)
            resistance = torque_factor * gear_ratio * torque_constant * voltage / stall_torque
        else:
            raise RobotError(
                f"{source}: the torque-speed line is missing; give stall_torque and no_load_speed, "
                "corner_speed and no_load_speed, or torque_constant and resistance."
            )
        rotor_inertia = self.rotor_inertia
        if rotor_inertia is None:
            rotor_inertia = (self.armature or 0.0) / gear_ratio**2
        return Drive(
            gear_ratio=gear_ratio,
            rotor_inertia=rotor_inertia,
            stall_torque=stall_torque,
            no_load_speed=no_load_speed,
            effort_limit=self.effort_limit,
            frictionloss=self.frictionloss,
            viscous_damping=self.viscous_damping,
            bus_voltage=voltage,
            resistance=resistance,
            torque_constant=torque_constant,
            stribeck_speed=self.stribeck_speed,
        )

    def _stall_torque_of_corner(self, corner_speed: float, source: str) -> float:
        """Return where the line through the corner and the no-load speed meets standstill [N m]."""
        others = (self.stall_torque, self.torque_constant, self.joint_torque_constant)
        if self.resistance is not None or any(value is not None for value in others):
            raise RobotError(
                f"{source}: corner_speed and stall_torque, or the constants of the motor, both say "
                "where the torque-speed line begins; give corner_speed and no_load_speed alone."
            )
        if self.no_load_speed is None or not corner_speed < self.no_load_speed:
            raise RobotError(
                f"{source}: corner_speed is {corner_speed:g} rad/s, with no_load_speed "
                f"{self.no_load_speed}; expected a no_load_speed above it."
            )
        return self.effort_limit / (1.0 - corner_speed / self.no_load_speed)


class GroupEntry(_Entry, frozen=True):
    """Joints that are built alike, their drive, gains and test rig."""

    joints: str | None = None
    """Pattern of joint names; the group's own name if left out."""
    drive: str | None = None
    stiffness: _Positive | None = None
    damping: _NotNegative | None = None
    servo: ServoKind | None = None
    """What the model has in place of a position servo, where the gains are assumed."""
    band_hz: _Band | None = None
    clamped: tuple[str, ...] = ()
    """Patterns of joints of the same limb that are fixed while one of these is excited."""
    own_names: str | None = None
    """Names in the models of the robot's maker: a pattern whose star stands for what that of
    `joints` does."""


class SymmetryEntry(_Entry, frozen=True):
    """Limbs that mirror another: prefix of joint names to the prefix of the original."""

    mirror: dict[str, str] = msgspec.field(default_factory=dict)
    negated: tuple[str, ...] = ()
    """Joints whose coordinate has the opposite sign of the original's."""


class AboutEntry(_Entry, frozen=True):
    """Metadata for tables; nothing depends on it."""

    model: str = ""
    """Source and licence of the model."""
    links: tuple[str, ...] = ("sim",)
    task: str = ""
    """Name of the training task with mjlab."""


class StandEntry(_Entry, frozen=True):
    """How a robot stands up, as `pronk.robots.limits.StandingUp` has it."""

    stiffness: _Positive | None = None
    damping: _Positive | None = None
    swing: _Positive = StandingUp.swing
    swing_s: _Positive = StandingUp.swing_s

    def standing_up(self) -> StandingUp:
        """Return the same as a dataclass."""
        return StandingUp(
            stiffness=self.stiffness,
            damping=self.damping,
            swing=self.swing,
            swing_s=self.swing_s,
        )


class LimitsEntry(_Entry, frozen=True):
    """Limits of commands and measurements, as `pronk.robots.limits.OperatingLimits` has them."""

    stiffness: _Positive | None = None
    damping: _Positive | None = None
    margin: _Positive | None = None
    horizon_s: _Positive = OperatingLimits.horizon_s
    change: _Positive = OperatingLimits.change
    power_w: _Positive | None = None
    overrun: _Positive = OperatingLimits.overrun
    tilt: _Positive = OperatingLimits.tilt
    temperature: _Positive = OperatingLimits.temperature
    target_reach: Annotated[float, Meta(ge=0.0)] = OperatingLimits.target_reach
    far_target: _Positive = OperatingLimits.far_target
    bus_voltage: float = OperatingLimits.bus_voltage

    def limits(self, joints: Sequence[Joint], stand: StandingUp) -> OperatingLimits:
        """Return the limits of a robot with some joints, which stands up in some way.

        Where the file states no limit of gains, margin or power, it is that of a legged robot of
        the size of a Mini Cheetah, or what these joints need if that is not enough: twice their
        largest gains, a twentieth of the smallest range, all effort at all speed.
        """
        stiffness = max(OperatingLimits.stiffness, 2.0 * max(joint.stiffness for joint in joints))
        damping = max(OperatingLimits.damping, 2.0 * max(joint.damping for joint in joints))
        smallest_range = min(joint.range[1] - joint.range[0] for joint in joints)
        power_w = 0.0
        for joint in joints:
            power_w += joint.drive.effort_limit * joint.drive.no_load_speed
        return OperatingLimits(
            stiffness=self.stiffness or stiffness,
            damping=self.damping or damping,
            margin=self.margin or min(OperatingLimits.margin, 0.05 * smallest_range),
            horizon_s=self.horizon_s,
            change=self.change,
            power_w=self.power_w or max(OperatingLimits.power_w, power_w),
            overrun=self.overrun,
            tilt=self.tilt,
            temperature=self.temperature,
            target_reach=self.target_reach,
            far_target=self.far_target,
            bus_voltage=self.bus_voltage,
            stand=stand,
        )


class RobotFile(_Entry, frozen=True):
    """Content of a `robot.yaml`."""

    schema: str
    name: str
    model: str
    drives: dict[str, DriveEntry]
    groups: dict[str, GroupEntry]
    poses: dict[str, dict[str, float]] = {}
    defaults: GroupEntry = GroupEntry()
    held: dict[str, HeldPosition] = {}
    """Joints that stand still, by name or pattern, and where; all that are no hinges are held."""
    symmetry: SymmetryEntry = SymmetryEntry()
    base_body: str | None = None
    legs: tuple[str, ...] = ()
    policy_rate_hz: _Positive = 50.0
    timestep_s: _Positive = 0.005
    decimation: Annotated[int, Meta(ge=1, le=1000)] = 4
    grid_stiffness: _Band | None = None
    grid_damping: _Band | None = None
    about: AboutEntry = AboutEntry()
    limits: LimitsEntry = LimitsEntry()
    stand: StandEntry = StandEntry()


@dataclass(frozen=True)
class Model:
    """A model without actuators: builds a fresh specification at each call; can be pickled."""

    xml: str

    def __call__(self) -> mujoco.MjSpec:
        """Build the specification."""
        return mujoco.MjSpec.from_string(self.xml)


def read_robot(path: Path) -> RobotSpec:
    """Read a `robot.yaml`; a RobotError names what is wrong in it."""
    file = read_robot_file(path)
    return make_robot(file, read_source(path.parent / file.model), str(path))


def read_robot_file(path: Path) -> RobotFile:
    """Read the content of a `robot.yaml` without its model."""
    body = read_yaml(path, RobotError)
    if not isinstance(body, dict) or body.get("schema") != SCHEMA:
        raise RobotError(f"{path}: not a robot file; its schema must be {SCHEMA!r}.")
    _refuse_infinite(body, "", path)
    return converted(body, RobotFile, path, error=RobotError)


def _refuse_infinite(value: object, place: str, path: Path) -> None:
    """Refuse a number that is not finite where a robot file must not have one.

    Args:
        value: A mapping, a list, text or a number of the file.
        place: The keys that lead to it, joined by dots.
        path: The file, for the message.
    """
    entries: Iterable[tuple[object, object]] = ()
    if isinstance(value, dict):
        entries = value.items()
    elif isinstance(value, list):
        entries = enumerate(value)
    elif isinstance(value, float) and not math.isfinite(value) and place not in _MAY_BE_INFINITE:
        raise RobotError(f"{path}: {place} is {value}; expected a finite number.")
    for key, inner in entries:
        _refuse_infinite(inner, f"{place}.{key}" if place else str(key), path)


def make_robot(file: RobotFile, source_model: SourceModel, source: str) -> RobotSpec:
    """Join a robot file with its model.

    Args:
        file: Content of the `robot.yaml`.
        source_model: The model.
        source: Name of the file, with which errors begin.

    Raises:
        RobotError: An entry is missing or inconsistent; the message names it.
    """
    ticks = file.timestep_s * file.decimation * file.policy_rate_hz
    if abs(ticks - 1.0) > 1e-9:
        raise RobotError(
            f"{source}: timestep_s * decimation * policy_rate_hz is {ticks:.6g}; expected 1, one "
            "command for `decimation` steps of the simulator."
        )
    _check_order(file, source)
    held_joints = _held_positions(file, source_model, source)
    build = _model_without(source_model, held_joints)
    try:
        model = build().compile()
    except MUJOCO_ERRORS as error:
        raise RobotError(
            f"{source}: the model does not compile with its joints held: {error}."
        ) from None
    base_body = file.base_body or _floating_body(model)
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, base_body) < 0:
        raise RobotError(f"{source}: base_body {base_body!r} is not a body of the model.")
    limbs = {}
    for index in range(model.njnt):
        if model.jnt_type[index] == mujoco.mjtJoint.mjJNT_HINGE:
            body = int(model.jnt_bodyid[index])
            limbs[model.joint(index).name] = _limb(model, body, model.body(base_body).id)
    if not limbs:
        raise RobotError(f"{source}: the model has no hinge joint that is not held.")
    groups = _groups(file, limbs, source)
    joints = []
    for name, limb in limbs.items():
        limb_joints = [other for other in limbs if limbs[other] == limb]
        joints.append(_joint(file, model, name, groups[name], limb_joints, source))
    servos = joint_servos(source_model.model, source_model.model.qpos0)
    robot = RobotSpec(
        name=file.name,
        joints=tuple(joints),
        build_spec=build,
        base_body=base_body,
        held_joints=tuple(source_model.joint_names[index] for index in held_joints),
        held_reasons=held_reasons(source_model, servos),
        legs=file.legs,
        policy_rate_hz=file.policy_rate_hz,
        timestep_s=file.timestep_s,
        decimation=file.decimation,
        grid_stiffness=file.grid_stiffness or _grid(joint.stiffness for joint in joints),
        grid_damping=file.grid_damping or _grid(joint.damping for joint in joints),
        limits=file.limits.limits(joints, file.stand.standing_up()),
    )
    _verify_mirrors(robot, model, source)
    return robot


def _check_order(file: RobotFile, source: str) -> None:
    """Refuse a range whose first number is not the smaller one: it would hold nothing."""
    ranges = {
        "grid_stiffness": file.grid_stiffness,
        "grid_damping": file.grid_damping,
        "defaults.band_hz": file.defaults.band_hz,
    }
    for name, group in file.groups.items():
        ranges[f"groups.{name}.band_hz"] = group.band_hz
    for place, numbers in ranges.items():
        if numbers is not None and not numbers[0] < numbers[1]:
            raise RobotError(
                f"{source}: {place} is {list(numbers)}; expected the smaller number first."
            )


def _grid(gains: Iterable[float]) -> tuple[float, float]:
    """Return the range of a search about the gains of some joints, from a tenth to four times."""
    positive = [gain for gain in gains if gain > 0.0]
    if not positive:
        return (1e-3, 1.0)
    return 0.1 * min(positive), 4.0 * max(positive)


def _held_positions(
    file: RobotFile, source_model: SourceModel, source: str
) -> dict[int, HeldPosition]:
    """Return the joints that are held_joints, with their positions.

    Joints that are no hinges are held at the position that the model has, unless `held` says one;
    only the free joint of the base stays.
    """
    model = source_model.model
    names = source_model.joint_names
    base_joint = source_model.base_joint
    if file.base_body in source_model.body_names:
        for free_joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
            if source_model.body_names[model.jnt_bodyid[free_joint]] == file.base_body:
                base_joint = int(free_joint)
    held_joints: dict[int, HeldPosition] = {}
    for index in range(model.njnt):
        joint_type = mujoco.mjtJoint(model.jnt_type[index])
        if joint_type == mujoco.mjtJoint.mjJNT_HINGE or index == base_joint:
            continue
        address = model.jnt_qposadr[index]
        position = model.qpos0[address : address + POSITIONS[joint_type]]
        if joint_type == mujoco.mjtJoint.mjJNT_SLIDE and model.jnt_limited[index]:
            position = np.clip(position, *model.jnt_range[index])
        held_joints[index] = tuple(float(value) for value in position)
    for pattern, value in file.held.items():
        members = [pattern] if pattern in names else fnmatch.filter(names, pattern)
        if not members:
            raise RobotError(
                f"{source}: held.{pattern} matches no joint of the model; those are "
                f"{', '.join(names)}."
            )
        for name in members:
            index = names.index(name)
            joint_type = mujoco.mjtJoint(model.jnt_type[index])
            position = np.atleast_1d(np.asarray(value, dtype=np.float64))
            if len(position) != POSITIONS[joint_type] or not np.all(np.isfinite(position)):
                raise RobotError(
                    f"{source}: held.{pattern} is {value} for {name}; expected "
                    f"{POSITIONS[joint_type]} finite numbers: m of a slide, rad of a hinge, a "
                    "quaternion of a ball joint, position and quaternion of a free joint."
                )
            if len(position) > 1 and not np.linalg.norm(position[-4:]) > 0.5:
                raise RobotError(f"{source}: held.{pattern} has a quaternion of length 0.")
            if model.jnt_limited[index] and len(position) == 1:
                low, high = model.jnt_range[index]
                if not low - POSE_ROUNDING <= position[0] <= high + POSE_ROUNDING:
                    raise RobotError(
                        f"{source}: held.{pattern} puts {name} at {position[0]:g}, outside its "
                        f"range of {low:g} to {high:g}."
                    )
            held_joints[index] = tuple(float(number) for number in position)
    return held_joints


def _model_without(source: SourceModel, held_joints: Mapping[int, HeldPosition]) -> Model:
    """Return the model of a robot: the file as it is where nothing has to be left out."""
    text = source.plain_text()
    if text and not held_joints:
        return Model(text)  # with all digits of its numbers
    return Model(held_mjcf(source, held_joints))


def _floating_body(model: mujoco.MjModel) -> str:
    """Return the name of the body that floats; the world of a model with a fixed base."""
    free_joints = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if not len(free_joints):
        return "world"
    return str(model.body(model.jnt_bodyid[free_joints[0]]).name)


def _limb(model: mujoco.MjModel, body: int, base: int) -> int:
    """Return the topmost moving body above a body: below the base, or below what is fixed."""
    fixed = (model.body_weldid[base], 0)
    limb = body
    while body != 0 and body != base:
        if model.body_jntnum[body]:
            limb = body
        body = int(model.body_parentid[body])
        if model.body_weldid[body] in fixed:
            break
    return limb


def _groups(file: RobotFile, joints: Collection[str], source: str) -> dict[str, str]:
    """Return the group of each hinge joint."""
    groups: dict[str, str] = {}
    for name, group in file.groups.items():
        members = [name]
        if group.joints or name not in joints:
            members = fnmatch.filter(joints, group.joints or name)
        if not members:
            raise RobotError(
                f"{source}: groups.{name} matches no hinge joint of the model; those are "
                f"{', '.join(joints)}."
            )
        for joint in members:
            if joint in groups:
                raise RobotError(f"{source}: {joint} is in the groups {groups[joint]} and {name}.")
            groups[joint] = name
    missing = [name for name in joints if name not in groups]
    if missing:
        raise RobotError(f"{source}: {', '.join(missing)} is in no group; add one that matches it.")
    return groups


def _joint(
    file: RobotFile,
    model: mujoco.MjModel,
    name: str,
    group: str,
    limb_joints: Sequence[str],
    source: str,
) -> Joint:
    """Make a joint from its group, the defaults, the poses and the model."""
    entry = file.groups[group]
    defaults = file.defaults
    place = f"{source}: groups.{group}"
    drive = _stated(entry.drive, defaults.drive, f"{place}.drive")
    if drive not in file.drives:
        drives = ", ".join(file.drives)
        raise RobotError(f"{place}.drive is {drive!r}; the drives are {drives}.")
    stiffness = _stated(entry.stiffness, defaults.stiffness, f"{place}.stiffness")
    damping = _stated(entry.damping, defaults.damping, f"{place}.damping")
    band_hz = _stated(entry.band_hz, defaults.band_hz, f"{place}.band_hz")

    clamped = []
    for other in limb_joints:
        if _matches_any(other, entry.clamped or defaults.clamped):
            clamped.append(other)
    chain = [other for other in limb_joints if other not in clamped]
    folded_position = None
    if "folded" in file.poses:
        folded_position = _pose_angle(file, model, "folded", name, group, source)
    joint_range = (-math.pi, math.pi)
    if model.jnt_limited[model.joint(name).id]:
        low, high = model.joint(name).range
        joint_range = (float(low), float(high))
    return Joint(
        name=name,
        own_name=_maker_name(entry, name, group, source),
        group=group,
        drive=file.drives[drive].drive(f"{source}: drives.{drive}"),
        range=joint_range,
        default_position=_pose_angle(file, model, "default", name, group, source),
        folded_position=folded_position,
        stiffness=stiffness,
        damping=damping,
        band_hz=band_hz,
        servo=entry.servo or defaults.servo or "position",
        clamped=tuple(clamped),
        chain=tuple(chain),
        mirror=_mirror(file.symmetry, name),
    )


def _stated(value: T | None, default: T | None, place: str) -> T:
    """Return the value of a group, or else that of the defaults; refuse if there is neither."""
    if value is not None:
        return value
    if default is not None:
        return default
    raise RobotError(f"{place} is missing.")


def _matches_any(name: str, patterns: Iterable[str]) -> bool:
    """Return whether a name matches one of some patterns of a shell."""
    return any(fnmatch.fnmatch(name, pattern) for pattern in patterns)


def _mirror(symmetry: SymmetryEntry, name: str) -> tuple[str, float] | None:
    """Return the joint that a joint mirrors and the sign between their coordinates."""
    mirror = None
    for prefix, original in symmetry.mirror.items():
        if name.startswith(f"{prefix}_"):
            sign = -1.0 if name in symmetry.negated else 1.0
            mirror = (original + name.removeprefix(prefix), sign)
    return mirror


def _pose_angle(
    file: RobotFile, model: mujoco.MjModel, pose: str, name: str, group: str, source: str
) -> float:
    """Return the position of a joint in a pose by its entry, or else by its group's [rad]."""
    angles = file.poses.get(pose, {})
    if name not in angles and group not in angles:
        raise RobotError(f"{source}: poses.{pose} has no entry for {name} or {group}.")
    angle = float(angles[name] if name in angles else angles[group])
    low, high = model.joint(name).range
    limited = model.jnt_limited[model.joint(name).id]
    if limited and not low - POSE_ROUNDING <= angle <= high + POSE_ROUNDING:
        hint = ""
        reach = max(abs(low), abs(high))
        if reach <= TURN_READ_AS_DEGREES and low <= math.radians(angle) <= high:
            hint = (
                " The range looks like one in rad that was read in degrees, as MuJoCo reads an "
                'MJCF without <compiler angle="radian"/>.'
            )
        raise RobotError(
            f"{source}: poses.{pose} puts {name} at {angle:g} rad, outside its range of "
            f"{low:g} to {high:g} rad.{hint}"
        )
    return angle


def _maker_name(entry: GroupEntry, name: str, group: str, source: str) -> str:
    """Return the name of a joint in the models of the robot's maker; empty if none is stated."""
    pattern = entry.joints or group
    maker_pattern = entry.own_names or ""
    if not maker_pattern:
        return ""
    if pattern.count("*") != 1 or maker_pattern.count("*") != 1:
        raise RobotError(
            f"{source}: groups.{group}.own_names is {maker_pattern!r} for joints {pattern!r}; "
            "expected one star in both."
        )
    before, _, after = pattern.partition("*")
    stem = name.removeprefix(before).removesuffix(after)
    return maker_pattern.replace("*", stem)


def _verify_mirrors(robot: RobotSpec, model: mujoco.MjModel, source: str) -> None:
    """Compare mass matrix and bias forces of each limb with those of its original."""
    mirrored = [joint for joint in robot.joints if joint.mirror]
    if not mirrored:
        return
    data = mujoco.MjData(model)
    dof = {joint.name: int(model.joint(joint.name).dofadr[0]) for joint in robot.joints}
    # The same pose about the default one, and the same speeds, in the originals' coordinates.
    for joint in robot.joints:
        original, sign = joint.original
        phase = 1.0 + robot.joint_names.index(original)
        address = model.joint(joint.name).qposadr[0]
        data.qpos[address] = joint.default_position + sign * (0.2 * math.sin(phase))
        data.qvel[dof[joint.name]] = sign * math.cos(phase)
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    force = data.qfrc_bias
    largest_mass = max(np.abs(mass[index, index]) for index in dof.values())
    largest_force = max(np.abs(force[index]) for index in dof.values())
    for joint in mirrored:
        original, sign = joint.original
        force_difference = force[dof[joint.name]] - sign * force[dof[original]]
        error = abs(force_difference) / largest_force
        for other in joint.chain:
            other_original, other_sign = robot.joint(other).original
            joint_mass = mass[dof[joint.name], dof[other]]
            original_mass = sign * other_sign * mass[dof[original], dof[other_original]]
            error = max(error, abs(joint_mass - original_mass) / largest_mass)
        if not error <= MIRROR_TOLERANCE:
            raise RobotError(
                f"{source}: {joint.name} does not mirror {original} with sign {sign:+.0f}: inertia "
                f"or gravity differ by {error:.2g} of the largest; correct symmetry.mirror or "
                "symmetry.negated, or leave them out."
            )
