"""Read a robot from its `robot.yaml`, or from a bare MJCF or URDF.

`robot.yaml` (schema `pronk/robot/1`) names the model beside it and holds what a model does not:
drives, gains, groups, poses, what is clamped in a bench test, and which joints mirror each other.
Ranges, axes, inertias and kinematic chains come from the model. Joint patterns are those of a shell
(`*_knee`). A claimed mirror symmetry is verified with the model's mass matrix and bias forces.
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import msgspec
import mujoco
import numpy as np
from msgspec import Meta

from pronk.errors import RobotError
from pronk.files import converted, read_yaml
from pronk.robots.limits import OperatingLimits
from pronk.robots.model import set_inertia
from pronk.robots.robot import Drive, Joint, RobotSpec

SCHEMA = "pronk/robot/1"
_MIRROR_TOLERANCE = 1e-9
"""Largest relative difference of inertia and bias forces of joints that mirror each other."""
_ROUNDING = 1e-3
"""How far a pose may be outside of a range by its rounding to four digits [rad]."""
_MOTORS = {1: (1.0, 1.0), 3: (1.5, 2.0)}
"""By phases: torque over `kt i`, and back-EMF over `kt omega`. Of a three-phase motor with peak
currents, as in Cheetah-Software's ActuatorModel.h, torque is 1.5 kt i, and the back-EMF that fits
under the bus voltage 2 kt omega."""
_Positive = Annotated[float, Meta(gt=0.0)]
_Least = Annotated[float, Meta(ge=0.0)]
_Band = tuple[_Positive, _Positive]


class _Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A part of a `robot.yaml`."""


class DriveEntry(_Entry, frozen=True):
    """A drive: its torque-speed line or the motor's constants, from which the line follows."""

    effort_limit: _Positive
    bus_voltage: _Positive = 24.0
    gear_ratio: _Positive = 1.0
    rotor_inertia: _Least | None = None
    armature: _Least | None = None
    stall_torque: _Positive | None = None
    no_load_speed: _Positive | None = None
    torque_constant: _Positive | None = None
    joint_torque_constant: _Positive | None = None
    resistance: _Positive | None = None
    phases: int = 3
    frictionloss: _Least = 0.0
    viscous_damping: _Least = 0.0
    stribeck_speed: _Least = 0.0

    def drive(self, source: str) -> Drive:
        """Make the drive; a RobotError names what is missing of its torque-speed line."""
        gear, volts = self.gear_ratio, self.bus_voltage
        if self.phases not in _MOTORS:
            raise RobotError(f"{source}: phases is {self.phases}; expected 1 (brushed) or 3.")
        if self.armature is not None and self.rotor_inertia is not None:
            raise RobotError(f"{source}: give rotor_inertia or armature, not both.")
        torque_factor, emf_factor = _MOTORS[self.phases]
        constant, resistance = self.torque_constant, self.resistance
        if self.joint_torque_constant is not None:
            constant = self.joint_torque_constant / gear
        stall, free = self.stall_torque, self.no_load_speed
        if constant is not None and resistance is not None:
            stall = torque_factor * gear * constant * volts / resistance
            free = volts / (emf_factor * gear * constant)
        elif stall is not None and free is not None:
            constant = volts / (emf_factor * gear * free)
            resistance = torque_factor * gear * constant * volts / stall
        else:
            raise RobotError(
                f"{source}: the torque-speed line is missing; give stall_torque and no_load_speed, "
                "or torque_constant and resistance."
            )
        rotor = (self.armature or 0.0) / gear**2
        friction = ("frictionloss", "viscous_damping", "stribeck_speed")
        same = ("gear_ratio", "bus_voltage", "effort_limit", *friction)
        return Drive(
            rotor_inertia=rotor if self.rotor_inertia is None else self.rotor_inertia,
            stall_torque=stall,
            no_load_speed=free,
            resistance=resistance,
            torque_constant=constant,
            **{name: getattr(self, name) for name in same},
        )


class GroupEntry(_Entry, frozen=True):
    """Joints that are built alike, their drive, gains and test rig."""

    joints: str | None = None
    """Pattern of joint names; the group's own name if left out."""
    drive: str | None = None
    stiffness: _Positive | None = None
    damping: _Positive | None = None
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


class LimitsEntry(_Entry, frozen=True):
    """Limits of commands and measurements, as `pronk.robots.limits.OperatingLimits` has them."""

    stiffness: _Positive = OperatingLimits.stiffness
    damping: _Positive = OperatingLimits.damping
    margin: _Positive = OperatingLimits.margin
    horizon_s: _Positive = OperatingLimits.horizon_s
    change: _Positive = OperatingLimits.change
    power_w: _Positive = OperatingLimits.power_w
    overrun: _Positive = OperatingLimits.overrun
    tilt: _Positive = OperatingLimits.tilt
    temperature: _Positive = OperatingLimits.temperature

    def limits(self) -> OperatingLimits:
        """Return the limits of the robot."""
        return OperatingLimits(
            stiffness=self.stiffness,
            damping=self.damping,
            margin=self.margin,
            horizon_s=self.horizon_s,
            change=self.change,
            power_w=self.power_w,
            overrun=self.overrun,
            tilt=self.tilt,
            temperature=self.temperature,
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
    symmetry: SymmetryEntry = SymmetryEntry()
    base_body: str | None = None
    legs: tuple[str, ...] = ()
    policy_rate_hz: _Positive = 50.0
    timestep_s: _Positive = 0.005
    decimation: Annotated[int, Meta(ge=1, le=1000)] = 4
    grid_stiffness: _Band = (13.0, 27.0)
    grid_damping: _Band = (0.1, 0.7)
    about: AboutEntry = AboutEntry()
    limits: LimitsEntry = LimitsEntry()


@dataclass(frozen=True)
class Model:
    """A model without actuators: builds a fresh specification at each call; can be pickled."""

    xml: str

    def __call__(self) -> mujoco.MjSpec:
        """Build the specification."""
        return mujoco.MjSpec.from_string(self.xml)


@lru_cache
def read_model(path: Path) -> Model:
    """Read an MJCF or URDF; angles in radians, explicit inertias, no meshes and drives."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        text = path.read_text(encoding="utf-8")
        compiler = spec.compiler
        # An MJCF that needs nothing resolved keeps all digits of its numbers.
        if not (
            path.suffix == ".urdf" or "<include" in text or compiler.degree or compiler.fusestatic
        ) and not (spec.actuators or spec.meshes or spec.frames or spec.sensors):
            spec.compile()
            return Model(text)
        compiler.fusestatic = False
        model = spec.compile()
        for body in spec.bodies[1:]:
            if not body.explicitinertial:
                set_inertia(body, model)
        for geom in [g for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_MESH]:
            spec.delete(geom)
        unused = (spec.pairs, spec.sensors, spec.keys, spec.actuators, spec.skins, spec.meshes)
        for elements in (*unused, spec.materials, spec.textures):
            for element in list(elements):
                spec.delete(element)
        spec.compile()
        made = Model(spec.to_xml())
        made().compile()  # MuJoCo writes XML that it cannot read where a number is not finite.
        return made
    except (ValueError, OSError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise RobotError(f"{path}: not a model that MuJoCo can read ({reason}).") from None


def read_robot(path: Path) -> RobotSpec:
    """Read a `robot.yaml`; a RobotError names what is wrong in it."""
    body = read_yaml(path, RobotError)
    if not isinstance(body, dict) or body.get("schema") != SCHEMA:
        raise RobotError(f"{path}: not a robot file; its schema must be {SCHEMA!r}.")
    file = converted(body, RobotFile, path, error=RobotError)
    return make_robot(file, read_model(path.parent / file.model), str(path))


def make_robot(file: RobotFile, build: Model, source: str) -> RobotSpec:
    """Join a robot file with its model; a RobotError names the entry that is inconsistent."""
    ticks = file.timestep_s * file.decimation * file.policy_rate_hz
    if abs(ticks - 1.0) > 1e-9:
        raise RobotError(
            f"{source}: timestep_s * decimation * policy_rate_hz is {ticks:.6g}; expected 1, one "
            "command for `decimation` steps of the simulator."
        )
    model = build().compile()
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    base = file.base_body or (model.body(model.jnt_bodyid[free[0]]).name if len(free) else "world")
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, base) < 0:
        raise RobotError(f"{source}: base_body {base!r} is not a body of the model.")
    hinges = {
        model.joint(i).name: _limb(model, int(model.jnt_bodyid[i]), model.body(base).id)
        for i in range(model.njnt)
        if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE
    }
    groups = _groups(file, hinges, source)
    timing = ("policy_rate_hz", "timestep_s", "decimation")
    copied = ("legs", *timing, "grid_stiffness", "grid_damping")
    robot = RobotSpec(
        name=file.name,
        joints=tuple(_joint(file, model, name, hinges, groups[name], source) for name in hinges),
        build_spec=build,
        base_body=base,
        **{name: getattr(file, name) for name in copied},
        limits=file.limits.limits(),
    )
    _verify_mirrors(robot, model, source)
    return robot


def _groups(file: RobotFile, hinges: Iterable[str], source: str) -> dict[str, str]:
    """The group of each hinge."""
    found: dict[str, str] = {}
    for name, group in file.groups.items():
        members = fnmatch.filter(hinges, group.joints or name)
        if not members:
            raise RobotError(
                f"{source}: groups.{name} matches no hinge joint of the model; those are "
                f"{', '.join(hinges)}."
            )
        for joint in members:
            if joint in found:
                raise RobotError(f"{source}: {joint} is in the groups {found[joint]} and {name}.")
            found[joint] = name
    if missing := [name for name in hinges if name not in found]:
        raise RobotError(f"{source}: {', '.join(missing)} is in no group; add one that matches it.")
    return found


def _joint(
    file: RobotFile,
    model: mujoco.MjModel,
    name: str,
    limbs: Mapping[str, int],
    group: str,
    source: str,
) -> Joint:
    """One joint, from its group, the defaults, the poses and the model."""
    own = file.groups[group]
    entry: dict[str, Any] = {}
    for field in ("drive", "stiffness", "damping", "band_hz"):
        stated = (getattr(one, field) for one in (own, file.defaults))
        entry[field] = next((value for value in stated if value is not None), None)
        if entry[field] is None:
            raise RobotError(f"{source}: groups.{group}.{field} is missing.")
    drive = entry.pop("drive")
    if drive not in file.drives:
        drives = ", ".join(file.drives)
        raise RobotError(f"{source}: groups.{group}.drive is {drive!r}; the drives are {drives}.")
    limb = [other for other in limbs if limbs[other] == limbs[name]]
    patterns = own.clamped or file.defaults.clamped
    clamped = tuple(other for other in limb if any(fnmatch.fnmatch(other, p) for p in patterns))
    (low, high), limited = model.joint(name).range, model.jnt_limited[model.joint(name).id]
    mirror = None
    for prefix, original in file.symmetry.mirror.items():
        if name.startswith(f"{prefix}_"):
            sign = -1.0 if name in file.symmetry.negated else 1.0
            mirror = (original + name.removeprefix(prefix), sign)
    position: dict[str, float] = {}
    for pose in ("default", "folded") if "folded" in file.poses else ("default",):
        angles = file.poses.get(pose, {})
        if name not in angles and group not in angles:
            raise RobotError(f"{source}: poses.{pose} has no entry for {name} or {group}.")
        position[pose] = angle = float(angles[name if name in angles else group])
        if limited and not low - _ROUNDING <= angle <= high + _ROUNDING:
            raise RobotError(
                f"{source}: poses.{pose} puts {name} at {angle:g} rad, outside its range of "
                f"{low:g} to {high:g} rad."
            )
    pattern, theirs = own.joints or group, own.own_names or ""
    if theirs and not pattern.count("*") == theirs.count("*") == 1:
        raise RobotError(
            f"{source}: groups.{group}.own_names is {theirs!r} for joints {pattern!r}; expected "
            "one star in both."
        )
    before, _, after = pattern.partition("*")
    stem = name.removeprefix(before).removesuffix(after)
    return Joint(
        name=name,
        own_name=theirs.replace("*", stem),
        group=group,
        drive=file.drives[drive].drive(f"{source}: drives.{drive}"),
        range=(float(low), float(high)) if limited else (-math.pi, math.pi),
        default_position=position["default"],
        folded_position=position.get("folded"),
        clamped=clamped,
        chain=tuple(other for other in limb if other not in clamped),
        mirror=mirror,
        **entry,
    )


def _limb(model: mujoco.MjModel, body: int, base: int) -> int:
    """The child of the base under which a body is."""
    while model.body_parentid[body] not in (base, 0):
        body = int(model.body_parentid[body])
    return int(body)


def _verify_mirrors(robot: RobotSpec, model: mujoco.MjModel, source: str) -> None:
    """Compare mass matrix and bias forces of each limb with those of its original."""
    mirrored = [joint for joint in robot.joints if joint.mirror]
    if not mirrored:
        return
    data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    dof = {joint.name: int(model.joint(joint.name).dofadr[0]) for joint in robot.joints}
    # The same pose about the default one, and the same speeds, in the originals' coordinates.
    for joint in robot.joints:
        original, sign = joint.original
        phase = 1.0 + robot.joint_names.index(original)
        at = model.joint(joint.name).qposadr[0]
        data.qpos[at] = joint.default_position + sign * (0.2 * math.sin(phase))
        data.qvel[dof[joint.name]] = sign * math.cos(phase)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)
    scale = max(np.abs(full[d, d]) for d in dof.values())
    force = max(np.abs(data.qfrc_bias[d]) for d in dof.values())
    for joint in mirrored:
        original, sign = joint.original
        error = abs(data.qfrc_bias[dof[joint.name]] - sign * data.qfrc_bias[dof[original]]) / force
        for other in joint.chain:
            first, other_sign = robot.joint(other).original
            own = full[dof[joint.name], dof[other]]
            theirs = sign * other_sign * full[dof[original], dof[first]]
            error = max(error, abs(own - theirs) / scale)
        if not error <= _MIRROR_TOLERANCE:
            raise RobotError(
                f"{source}: {joint.name} does not mirror {original} with sign {sign:+.0f}: inertia "
                f"or gravity differ by {error:.2g} of the largest; correct symmetry.mirror or "
                "symmetry.negated, or leave them out."
            )
